"""The options of a video, and the files its frames go to."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field, replace
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lightfield_gs.app.options import (
    WHITE,
    CameraOptions,
    LookOptions,
    PanelOptions,
    RenderOptions,
    SceneOptions,
    StereoOptions,
    files_read,
)
from lightfield_gs.app.panel import software
from lightfield_gs.app.stereo import refuse_files
from lightfield_gs.base.errors import InputError
from lightfield_gs.base.options import CodecName, Compression, QualityName, VideoKind, Views
from lightfield_gs.io.atomic import check_folder, check_output_path
from lightfield_gs.io.stereo_names import stereo_paths
from lightfield_gs.panels.framing import FramingConstants
from lightfield_gs.panels.panel import Panel
from lightfield_gs.panels.quilt import QuiltLayout, stated_layout, with_suffix
from lightfield_gs.video.video_file import VIDEO_SUFFIXES, choose_codec

if TYPE_CHECKING:
    from lightfield_gs.app.shots import Shots

DEFAULT_FPS = Fraction(30)
# Fractions of the height above and below the subject of a Hololuminescent display: 9 % and 3 %, and a hundredth more
# for soft rims, which framing leaves out
_ROOM = 0.10, 0.04
_MOST_SIDE_PX = 4096  # of a quilt without a given size: many decoders of H.264 take no more


@dataclass(frozen=True, slots=True)
class MotionOptions:
    """The motion of a video's cameras, and its number of frames.

    Attributes:
        turntable: seconds of one turn.
        degrees: angle of the turntable.
        path: file of keyframes.
        reframe: whether each picture of a sequence is framed by itself.
        fps: frames a second.
        frames: number of frames.
    """

    turntable: float | None = None
    degrees: float | None = None
    path: Path | None = None
    reframe: bool = False
    fps: Fraction | None = None
    frames: int | None = None


@dataclass(frozen=True, slots=True)
class VideoOptions:
    """A scene with moving cameras, or pictures in a row, that become frames.

    Attributes:
        output: a folder of PNG files, or a video.
        scene, panel, camera, look, render, motion: see there.
        kind: what a frame shows. None: by the other options and the name.
        codec, crf: of a video.
        quilt: layout, or columns and rows, of a quilt.
        quilt_size: width and height of a quilt, pixels.
        sway: seconds of the eye's way to both sides and back.
        compression, writers: of PNG files, and how many threads write them.
        overwrite: whether to remove frames that are in the folder.
        bridge: address of Looking Glass Bridge, which shows the quilt.
        views, quality, threads: see `lightfield_gs.encode`.
        device: auto, cpu, cuda, webgpu or webgpu:N; the one that was chosen, once it is.
        stereo: pictures of two eyes.
        preset: a kind of display that takes ordinary videos, see `for_preset`.
        stats: whether to print the times of the stages.
    """

    output: Path
    scene: SceneOptions
    panel: PanelOptions
    camera: CameraOptions
    look: LookOptions
    render: RenderOptions
    motion: MotionOptions
    kind: VideoKind | None = None
    codec: CodecName | None = None
    crf: int = 18
    quilt: QuiltLayout | tuple[int, ...] | None = None
    quilt_size: tuple[int, ...] | None = None
    sway: float | None = None
    compression: Compression = "fast"
    writers: int | None = None
    overwrite: bool = False
    bridge: str | None = None
    views: Views = "integer"
    quality: QualityName = "exact"
    device: str = "auto"
    threads: int | None = None
    stereo: StereoOptions = field(default_factory=StereoOptions)
    preset: str | None = None
    stats: bool = False

    def inputs(self) -> tuple[Path | str | None, ...]:
        """Return all files to read, the scene first; None for missing files."""
        return files_read(self.scene, self.camera, self.panel, self.motion.path)


@dataclass(frozen=True)
class VideoTarget:
    """The destination of the frames.

    Attributes:
        path: a folder, or a video.
        kind: what a frame shows.
        codec: of a video. None: a folder of PNG files.
        layout: of a quilt, with its size.
    """

    path: Path
    kind: VideoKind
    codec: CodecName | None
    layout: QuiltLayout | None

    def words(self) -> str:
        """Return kind and codec in words."""
        kind = {"native": "native", "quilt": "quilt", "2d": "one eye", "stereo": "two eyes"}[self.kind]
        if self.layout is not None:
            kind += f" of {self.layout.columns} x {self.layout.rows} views"
        return f"{kind}, {self.codec or 'PNG'}"


def for_preset(options: VideoOptions) -> VideoOptions:
    """Return the options of a video as its display wants it: white around, and the subject with room above it.

    Looking Glass's Hololuminescent displays show an ordinary video, whose white is clear, before a floor of light: the
    subject keeps 9 % of the height above it and 3 % below. Raises InputError.
    """
    if options.preset is None:
        return options
    if options.kind not in (None, "2d") or options.stereo.stereo is not None:
        raise InputError(f"--preset {options.preset} is an ordinary video, of --kind 2d; leave out one of them")
    look, render = options.look, options.render
    if look.zoom is None and look.pan is None:
        look = replace(look, zoom=(1 - sum(_ROOM)) / FramingConstants().fill, pan=(0.0, (_ROOM[0] - _ROOM[1]) / 2))
    if render.background is None:
        render = replace(render, background=WHITE)
    return replace(options, kind="2d", look=look, render=render)


def video_target(options: VideoOptions, panel: Panel) -> VideoTarget:
    """Return where the frames go. Raises InputError where options exclude each other, or it cannot be written."""
    path = options.output
    stated = stated_layout(path)
    kind = options.kind or ("quilt" if options.quilt or options.quilt_size or stated else "native")
    if options.kind is None and options.sway is not None:
        kind = "2d"
    if options.stereo.stereo is not None:
        if options.kind not in (None, "stereo"):
            raise InputError(f"--stereo is for --kind stereo, not {options.kind}; leave out one of them")
        refuse_files(options.stereo.stereo, "a video")
        kind = "stereo"
    elif kind == "stereo":
        raise InputError("--kind stereo needs --stereo sbs, half-sbs, tab or anaglyph")
    _refuse_others(options, kind)
    layout = _layout(options, panel, stated) if kind == "quilt" else None
    if not path.suffix or path.is_dir():
        if options.codec is not None:
            raise InputError(f"--codec is of videos, and {path} is a folder of PNG files; leave out one of them")
        return VideoTarget(check_folder(path), kind, None, layout)
    if options.stereo.stereo is not None:
        path = stereo_paths(path, options.stereo.stereo)[0]
    codec = choose_codec(path, kind, options.codec)
    if options.overwrite:
        raise InputError("--overwrite is about folders of frames; a video is written anew in any case, leave it out")
    return VideoTarget(check_output_path(path if layout is None else with_suffix(path, layout)), kind, codec, layout)


def _refuse_others(options: VideoOptions, kind: VideoKind) -> None:
    """Raise InputError for options of another kind, and for options that exclude each other."""
    for name, own in (("quilt", "quilt"), ("quilt_size", "quilt"), ("bridge", "quilt"), ("sway", "2d")):
        if getattr(options, name) is not None and kind != own:
            raise InputError(f"--{name.replace('_', '-')} is for --kind {own}, not {kind}; leave out one of them")
    if options.bridge is not None and options.output.suffix.lower() not in VIDEO_SUFFIXES:
        raise InputError(f"--bridge shows one file, and {options.output} is a folder; give a name that ends in .mp4")
    motion, camera = options.motion, options.camera
    values: dict[str, object] = {"turntable": motion.turntable, "degrees": motion.degrees}
    values |= {"rig": camera.rig, "camera": camera.camera, "up": camera.up}
    pairs: list[tuple[str, object, str, object]]
    pairs = [("path", motion.path, name, value) for name, value in values.items()]
    for one, first, other, second in (*pairs, ("turntable", motion.turntable, "frames", motion.frames)):
        if first is not None and second is not None:
            raise InputError(f"--{one} and --{other} take each other's place; leave out one of them")


def _layout(options: VideoOptions, panel: Panel, stated: QuiltLayout | None) -> QuiltLayout:
    """Return the layout of a quilt with its size. Raises InputError.

    Its sides are even, which 4:2:0 needs, and its tiles fill it.
    """
    aspect = stated.aspect if stated is not None else panel.width_px / panel.height_px
    base = options.quilt or stated or QuiltLayout(8, 6, aspect)  # as many as Looking Glass Portrait
    if not isinstance(base, QuiltLayout):
        base = QuiltLayout(base[0], base[1], aspect)
    width, height = options.quilt_size or (base.width_px, base.height_px)
    if width is None or height is None:
        across = min(_MOST_SIDE_PX // base.columns, int(_MOST_SIDE_PX // base.rows * base.aspect))
        width, height = across * base.columns, round(across / base.aspect) * base.rows
    sides = [_even_multiple(side, tiles) for side, tiles in ((width, base.columns), (height, base.rows))]
    if min(sides) < 1:
        raise InputError(f"--quilt-size: {width} x {height} pixels are too few for {base.columns} x {base.rows} views")
    return replace(base, width_px=sides[0], height_px=sides[1])


def _even_multiple(side_px: int, tiles: int) -> int:
    """Return the largest even multiple of the number of tiles up to a side."""
    each = side_px // tiles
    return tiles * (each - each * tiles % 2)


def frame_drawer(options: VideoOptions, panel: Panel, target: VideoTarget, shots: Shots) -> Any:
    """Return what draws a frame. Raises InputError."""
    from lightfield_gs.video.rendering import EyeRenderer, FrameOptions, NativeRenderer, QuiltRenderer, StereoRenderer

    render = shots.render
    device = options.device if options.device.startswith("webgpu") else None
    of_scene = render.background, options.quality, render.antialiased, render.view_filter
    drawing = FrameOptions(options.views, *of_scene, device)
    if target.kind != "native" and (options.views, options.quality) != ("integer", "exact"):
        raise InputError(f"--views and --quality are of native pictures, not of --kind {target.kind}; leave them out")
    if target.layout is not None:
        return QuiltRenderer(panel, drawing, target.layout)
    if options.stereo.stereo is not None:
        return StereoRenderer(panel, drawing, options.stereo.stereo)
    if target.kind == "2d":
        sway = None if options.sway is None else float(options.sway * shots.fps)
        return EyeRenderer(panel, drawing, sway, *([panel.width_px] if options.preset else []))
    return NativeRenderer(panel, drawing, shots.is_one_scene)


def frame_sink(options: VideoOptions, panel: Panel, target: VideoTarget, shots: Shots, size_px: tuple[int, int]) -> Any:
    """Return the video or the folder for the frames; a folder may hold some frames already. Raises InputError."""
    if target.codec is not None:
        from lightfield_gs.video.video_file import VideoFile

        return VideoFile(target.path, shots.count, size_px, shots.fps, target.codec, options.crf, options.stereo.stereo)
    from lightfield_gs.video.frame_folder import FrameFolder

    maker = software()
    native = {"panel": json.dumps(panel.to_dict())} if target.kind == "native" else {}

    def metadata(number: int) -> dict[str, str]:
        rig = shots.rig_of_file(number)
        more = {} if rig is None else {"rig": json.dumps(rig.to_dict())}
        return {"software": maker, "input": options.scene.input.name, **native, **more, "frame": str(number)}

    render = shots.render
    job = {
        "software": maker,
        "kind": target.kind,
        "size": list(size_px),
        "quilt": None if target.layout is None else asdict(target.layout),
        "panel": panel.to_dict(),
        "views": options.views,
        "quality": options.quality,
        "background": list(render.background),
        "antialiased": render.antialiased,
        "view_filter": render.view_filter,
        "compression": options.compression,
        "sway": options.sway,
        **({"stereo": options.stereo.stereo} if options.stereo.stereo else {}),
        "frames": shots.count,
        "fps": str(shots.fps),
        **shots.job,
    }
    return FrameFolder(
        target.path,
        shots.count,
        job,
        fps=float(shots.fps),
        metadata=metadata,
        compression=options.compression,
        writers=options.writers,
        overwrite=options.overwrite,
    )
