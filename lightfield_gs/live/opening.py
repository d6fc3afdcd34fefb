"""The source that the command line names."""

from __future__ import annotations

import re

from lightfield_gs.base.errors import InputError
from lightfield_gs.io.atomic import checked_path
from lightfield_gs.io.file_kinds import VIDEO_INPUTS
from lightfield_gs.live.cameras import find_camera, find_screen
from lightfield_gs.live.rgbd_cameras import RGBD_KINDS, open_rgbd
from lightfield_gs.live.sources import DeviceSource, FilmSource, FolderSource, Source, StreamSource

_STREAM = re.compile(r"(?i)(rtsps?|rtmps?|https?|udp|srt|tcp)://")


def open_source(words: str, rate: float, is_looped: bool = False) -> Source:
    """Return the source that the command line names; nothing is read yet. Raises InputError.

    Args:
        words: camera:N, camera:NAME, screen:, screen:X,Y,WxH, realsense:, orbbec:, kinect:, record3d: (each may name a
            serial number), an address, a video, or a folder.
        rate: Pictures a second that a screen is asked for.
        is_looped: Whether a film begins again at its end.
    """
    kind, _, rest = words.partition(":")
    source: Source
    if kind in RGBD_KINDS and words != kind:
        source = open_rgbd(kind, rest)
    elif kind == "camera":
        if not rest:
            raise InputError("camera: expected its number or a part of its name, as camera:0")
        source = DeviceSource(find_camera(rest))
    elif kind == "screen" and words != "screen":
        source = DeviceSource(find_screen(rest, rate))
    elif _STREAM.match(words):
        source = StreamSource(words)
    else:
        path = checked_path(words)
        if path.is_dir():
            source = FolderSource(path)
        elif path.suffix.lower() in VIDEO_INPUTS or path.is_file():
            return FilmSource(path, is_looped)
        else:
            raise InputError(
                f"{words}: there is no such file; expected a video, a folder, camera:N, screen:, "
                f"{':, '.join(RGBD_KINDS)}:, or an address as rtsp://..."
            )
    if is_looped:
        raise InputError(f"--loop is of a video, and {words} is none; leave it out")
    return source
