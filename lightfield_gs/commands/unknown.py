"""What a mistyped command or file may have been meant for."""

from __future__ import annotations

import os
import re
from collections.abc import Collection, Sequence
from contextlib import suppress
from pathlib import Path

from lightfield_gs.base.errors import InputError
from lightfield_gs.base.suggestions import did_you_mean, nearest
from lightfield_gs.base.system import quoted
from lightfield_gs.io.file_kinds import POSITION_TEXTS, SCENE_SUFFIXES, VIDEO_INPUTS

_PHOTOS = (".jpg", ".jpeg", ".png", ".webp", ".heic", ".heif", ".avif", ".tif", ".tiff", ".bmp", ".exr", ".mpo", ".jps")
_VIDEOS = (".mp4", ".mov", ".mkv", ".webm", ".gif")
_MOST_NAMES = 5000  # of files beside, that are compared
_KIND = re.compile(r"\w{2,}:")  # of a source that is no file, as camera: and https:
_DESCRIBED = (".yaml", ".yml", ".json", ".safetensors")


def unknown_command(words: Sequence[str], commands: Collection[str]) -> InputError:
    """Return the error for a command line whose first word is no command, with what may be meant."""
    word = words[0]
    if meant := _for_file(Path(word)):
        hint = f"; did you mean `{quoted('lightfield-gs', *meant, *words[1:])}`?"
        return InputError(f"invalid choice: '{word}' is a file, and a command is expected before it{hint}")
    if word == "help":
        return InputError(
            f"there is no command 'help'; did you mean `{quoted('lightfield-gs', *words[1:], '--help')}`?"
        )
    hint = did_you_mean(word, commands) or f": {', '.join(commands)}"
    return InputError(f"invalid choice: there is no command '{word}'{hint}; see lightfield-gs --help")


def check_input(path: Path) -> None:
    """Raise InputError where there is no such file, with one of a name like it: at once, before torch is imported."""
    try:
        os.stat(path)
    except FileNotFoundError as error:
        with suppress(OSError):
            beside = [Path(name) for name in os.listdir(path.parent)[:_MOST_NAMES]]
            stem = nearest(path.stem, (one.stem for one in beside))  # extensions alone make no names alike
            alike = [one.name for one in beside if one.stem == stem]
            hint = did_you_mean(path.name, alike, "" if path.parent == Path() else f"{path.parent}{os.sep}")
            raise InputError(f"cannot read {path}: {error.strerror}{hint}") from None
    except (OSError, ValueError):  # its reader says what is wrong
        return


def check_source(words: str) -> None:
    """Check a source of live pictures or of eyes as check_input does, where its name is that of a film or a text."""
    path = Path(words)
    if path.suffix.lower() in (*VIDEO_INPUTS, *POSITION_TEXTS) and not _KIND.match(words):
        check_input(path)


def _for_file(path: Path) -> list[str]:
    """Return the command for a file, [] where its name tells of none."""
    name, suffix = str(path), path.suffix.lower()
    if "_qs" in path.stem.lower() and suffix in (*_PHOTOS, *_VIDEOS):
        return ["weave", name, "-o", f"{path.stem.partition('_qs')[0]}-3d{suffix if suffix in _VIDEOS else '.png'}"]
    if suffix in _VIDEOS:
        return ["video", name, "-o", f"{path.stem}-3d.mp4"]
    if suffix in (".png", ".tif", ".tiff", ".exr") and _is_encoded(path):
        return ["show", name]
    if suffix in (*SCENE_SUFFIXES, *_PHOTOS):
        return ["encode", name, "-o", f"{path.stem}-3d.png"]
    if suffix in _DESCRIBED:
        return ["info", name]
    return ["batch", name, "-o", f"{path.name}-3d"] if path.is_dir() else []


def _is_encoded(path: Path) -> bool:
    """Return whether an image says which panel it is for."""
    from lightfield_gs.io.images import read_info

    try:
        return "panel" in read_info(path).metadata
    except InputError:
        return False
