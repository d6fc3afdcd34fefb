"""What a batch does: one item for each photo, scene, capture or video of a folder or a list."""

from __future__ import annotations

import os
import shlex
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any, Literal

from lightfield_gs.base.checks import checked_path, shown
from lightfield_gs.base.errors import InputError, named, reading
from lightfield_gs.io.captures.colmap import model_folder
from lightfield_gs.io.captures.transforms import transforms_file
from lightfield_gs.io.depth_names import depth_maps_beside
from lightfield_gs.io.file_kinds import VIDEO_INPUTS, refuse_unsupported
from lightfield_gs.io.scenes.files import SUFFIXES, is_scene_path
from lightfield_gs.io.text_files import parse_json, read_text
from lightfield_gs.video.sequence import PICTURES, is_sequence

Command = Literal["encode", "fit", "video"]
COMMANDS: tuple[Command, ...] = ("encode", "fit", "video")
_LIST_LIMIT_BYTES = 1 << 30
_IMAGES_AND_SCENES = {*PICTURES, *SUFFIXES}


@dataclass(frozen=True)
class Item:
    """A photo or scene to encode, a capture to fit and encode, or a video to make.

    Attributes:
        name: of its output in the folder of the batch, with / between folders. It identifies the item.
        input: path of the input.
        words: options of this item alone, as on the command line.
        fit_words: options of this item's fit.
    """

    name: str
    input: str
    command: Command = "encode"
    words: tuple[str, ...] = ()
    fit_words: tuple[str, ...] = ()

    @property
    def is_long(self) -> bool:
        """Whether the item takes minutes."""
        return self.command != "encode"


def read_items(
    source: str | Path, suffix: str, output: Path, with_maps: bool = True
) -> tuple[list[Item], Counter[str]]:
    """Return the items of a folder or a list, in order.

    Return also the counts of the folder's other files by the ends of their names.

    Args:
        suffix: Suffix of the images.
        output: The folder of the batch, which is left out if it lies in the source.
        with_maps: Whether photos and videos of a folder take the depth maps beside them. Depth maps are never items.

    Raises:
        InputError: there is no item, or two items would become one file.
    """
    source = checked_path(source)
    left: Counter[str] = Counter()
    if source.is_dir():
        found = _found(source, PurePosixPath(), output, left)
        items = [
            _item(
                source / name,
                name,
                suffix,
                command,
                words=(f"--depth={source / beside}",) if beside and with_maps else (),
            )
            for name, command, beside in found
        ]
    else:
        if source.is_file() and (source.suffix.lower() in PICTURES or is_scene_path(source)):
            raise InputError(
                f"{source} is not a list of inputs; batch takes a folder, or a text file with a path on each line, and "
                "lightfield-gs encode takes one scene or photo"
            )
        refuse_unsupported(source)
        items = list(_listed(source, suffix))
    if not items:
        raise InputError(f"{source}: expected photos, scenes, captures or videos, got none")
    first: dict[str, str] = {}
    for item in items:
        if (other := first.setdefault(item.name, item.input)) is not item.input:
            raise InputError(
                f"{_brief(other)} and {_brief(item.input)} would both become {_brief(item.name)}; name outputs in a "
                'list, {"input": "...", "output": "..."}'
            )
    return items, left


def _found(
    source: Path, at: PurePosixPath, output: Path, left: Counter[str]
) -> Iterator[tuple[PurePosixPath, Command, PurePosixPath | None]]:
    """Yield the inputs in a folder and below it, in order, each with the depth map beside it.

    Hidden files and folders are left out.

    Args:
        at: Name of the folder itself, relative to `source`.
    """
    folder = source / at
    if (command := _command(folder, is_folder=True)) in ("fit", "encode"):
        raise InputError(f"{folder} is one {'capture' if command == 'fit' else 'scene'}; give the folder it is in")
    with reading(folder), os.scandir(folder) as entries:
        inside = sorted((entry.name, entry.is_dir()) for entry in entries if not entry.name.startswith("."))
    beside = _maps_beside([name for name, is_folder in inside if not is_folder])
    maps = {name for names in beside.values() for name in names}
    for name, is_folder in inside:
        path = folder / name
        if name in maps:
            continue
        command = _command(path, is_folder)
        if not is_folder:
            if command is None:
                left[path.suffix.lower() or name] += 1
            else:
                yield at / name, command, at / beside[name][0] if name in beside else None
        elif path.resolve() == output.resolve() or folder.resolve().is_relative_to(path.resolve()):
            continue  # a link that leads back
        elif command in ("fit", "encode"):
            yield at / name, command, None
        else:  # a folder of photos is as many items as it holds
            yield from _found(source, at / name, output, left)


def _maps_beside(names: list[str]) -> dict[str, list[str]]:
    """The depth maps beside photos and videos, of these names in one folder."""
    beside: dict[str, list[str]] = {}
    for kinds, of_maps in ((PICTURES, (*PICTURES, ".npy", ".npz")), (VIDEO_INPUTS, VIDEO_INPUTS)):
        found = depth_maps_beside(name for name in names if PurePosixPath(name).suffix.lower() in of_maps)
        beside |= {name: maps for name, maps in found.items() if PurePosixPath(name).suffix.lower() in kinds}
    return beside


def _command(path: Path, is_folder: bool) -> Command | None:
    """Return the default command for a path; None: the path is no input."""
    if not is_folder:
        end = path.suffix.lower()
        return "encode" if end in _IMAGES_AND_SCENES else "video" if end in VIDEO_INPUTS else None
    if model_folder(path) is not None or transforms_file(path) is not None:
        return "fit"
    if is_scene_path(path):
        return "encode"
    return "video" if is_sequence(path) else None


def _item(path: Path, name: PurePosixPath, suffix: str, command: Command | None = None, **more: Any) -> Item:
    """Return the item of a path.

    Args:
        name: Name of the path in the source, from which the name of the output is made.
    """
    is_folder = path.suffix.lower() not in PICTURES and os.path.isdir(path)  # any name, however long
    command = command or _command(path, is_folder) or "encode"
    end = "" if command == "video" else suffix
    stem = name.name if is_folder else name.stem
    return Item((name.parent / (stem + end)).as_posix(), str(path), command, **more)


def _listed(path: Path, suffix: str) -> Iterator[Item]:
    """Return the items of a text file: a path or a JSON object on each line.

    Empty lines and lines that begin with # are skipped.
    """
    for number, line in enumerate(read_text(path, _LIST_LIMIT_BYTES, "a list of inputs").splitlines(), 1):
        line = line.strip()
        if line and not line.startswith("#"):
            with named(f"{path}, line {number}"):
                yield _of_object(line, suffix) if line.startswith("{") else _of_path(line, suffix)


def _of_path(text: str, suffix: str) -> Item:
    path = checked_path(text)
    return _item(path, _relative(path), suffix)


def _relative(path: Path) -> PurePosixPath:
    """A path as it was written; one that leads elsewhere from its root."""
    plain = path if not path.is_absolute() and ".." not in path.parts else Path(os.path.abspath(path))
    return PurePosixPath(*(part for part in plain.parts if part != plain.anchor))


def _of_object(line: str, suffix: str) -> Item:
    """Parse an object of a list.

    Keys are input, output, command, fit_options, and options of `encode` or of `video` by their names.
    """
    try:
        given = parse_json(line)
    except ValueError as error:
        raise InputError(f"expected a path or a JSON object, got {shown(line)} ({error})") from None
    texts = {name: given.pop(name, None) for name in ("input", "output", "command", "fit_options")}
    for name, text in texts.items():
        if not isinstance(text, str) and (text is not None or name == "input"):
            raise InputError(f"{name}: expected a text, got {shown(text)}")
    if texts["command"] not in (None, *COMMANDS):
        raise InputError(f"command: expected {', '.join(COMMANDS)}, got {shown(texts['command'])}")
    path, output = checked_path(texts["input"]), texts["output"]
    words = tuple(_word(name, value) for name, value in given.items())
    item = _item(path, _relative(path), suffix, texts["command"], words=words, fit_words=split(texts["fit_options"]))
    if output is None:
        return item
    place = PurePosixPath(output)
    if place.is_absolute() or ".." in place.parts or not place.name:
        raise InputError(f"output: expected a name in the folder of the batch, got {shown(output)}")
    if item.command != "video" and place.suffix.lower() not in (".png", ".tif", ".tiff", ".exr"):
        raise InputError(f"output: expected a .png, .tif or .exr, got {shown(output)}")
    return Item(place.as_posix(), item.input, item.command, item.words, item.fit_words)


def _word(name: str, value: Any) -> str:
    """Return an option as on the command line.

    {"depth_amount": 0.5} is --depth-amount=0.5; true is the option by itself, false is --no-..., a list has commas
    between.
    """
    option = name.replace("_", "-")
    if isinstance(value, bool):
        return f"--{option}" if value else f"--no-{option}"
    parts = value if isinstance(value, list) else [value]
    if not parts or not all(isinstance(part, (str, int, float)) for part in parts):
        raise InputError(f"{name}: expected a text, a number, true, false or a list of numbers, got {shown(value)}")
    return f"--{option}={','.join(str(part) for part in parts)}"


def _brief(path: str) -> str:
    """The end of a path that is too long for a message."""
    return path if len(path) <= 300 else f"...{path[-300:]}"


def split(text: str | None) -> tuple[str, ...]:
    """Words of a command line. Raises InputError where a quotation mark is left open."""
    try:
        return tuple(shlex.split(text or ""))
    except ValueError as error:
        raise InputError(f"expected options as on the command line, got {shown(text)} ({error})") from None
