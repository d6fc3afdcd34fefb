"""The items of a batch: one for each photo, scene, capture or video of a folder or a list."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path, PurePath, PurePosixPath
from typing import Any, Literal

from lightfield_gs.base.checks import shown
from lightfield_gs.base.errors import InputError, named, reading
from lightfield_gs.base.system import split_words
from lightfield_gs.io.atomic import checked_path
from lightfield_gs.io.captures.colmap import model_folder
from lightfield_gs.io.captures.transforms import transforms_file
from lightfield_gs.io.depth_names import depth_maps_beside
from lightfield_gs.io.file_kinds import VIDEO_INPUTS, refuse_unsupported
from lightfield_gs.io.scenes.files import SUFFIXES, is_scene_path
from lightfield_gs.io.text_files import parse_json, read_text
from lightfield_gs.video.scene_sequence import find_scene_sequence
from lightfield_gs.video.sequence import PICTURES, is_sequence

Command = Literal["encode", "fit", "video"]
COMMANDS: tuple[Command, ...] = ("encode", "fit", "video")
_LIST_LIMIT_BYTES = 1 << 30
_IMAGES_AND_SCENES = {*PICTURES, *SUFFIXES}
_IMAGE_SUFFIXES = (".png", ".tif", ".tiff", ".exr")


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
    """Return the items of a folder or a list, in order, and the number of the folder's other files by suffix.

    Args:
        source: the folder or the list.
        suffix: suffix of the images.
        output: the folder of the batch, which is left out if it lies in the source.
        with_maps: whether photos and videos of a folder take the depth maps beside them. Depth maps are never items.

    Raises:
        InputError: there is no item, or two items would become one file.
    """
    source = checked_path(source)
    left: Counter[str] = Counter()
    if source.is_dir():
        items = [
            _item(source / name, name, suffix, command, (f"--depth={source / beside}",) if beside and with_maps else ())
            for name, command, beside in _find_inputs(source, PurePosixPath(), output, left)
        ]
    else:
        if source.is_file() and (source.suffix.lower() in PICTURES or is_scene_path(source)):
            raise InputError(
                f"{source} is not a list of inputs; batch takes a folder, or a text file with a path on each line, and "
                "lightfield-gs encode takes one scene or photo"
            )
        refuse_unsupported(source)
        items = list(_read_list(source, suffix))
    if not items:
        raise InputError(f"{source}: expected photos, scenes, captures or videos, got none")
    first: dict[str, str] = {}
    for item in items:
        if (other := first.setdefault(item.name, item.input)) is not item.input:
            one, two, name = (
                text if len(text) <= 300 else f"...{text[-300:]}" for text in (other, item.input, item.name)
            )
            raise InputError(
                f'{one} and {two} would both become {name}; name outputs in a list, {{"input": "...", "output": "..."}}'
            )
    return items, left


def _find_inputs(
    source: Path, at: PurePosixPath, output: Path, left: Counter[str]
) -> Iterator[tuple[PurePosixPath, Command, PurePosixPath | None]]:
    """Yield the names and commands of the inputs in source / at and below, in order, each with the depth map beside it.

    Hidden files and folders are left out.
    """
    folder = source / at
    if (command := _find_command(folder, is_folder=True)) in ("fit", "encode"):
        raise InputError(f"{folder} is one {'capture' if command == 'fit' else 'scene'}; give the folder it is in")
    with reading(folder), os.scandir(folder) as entries:
        inside = sorted((entry.name, entry.is_dir()) for entry in entries if not entry.name.startswith("."))
    beside: dict[str, list[str]] = {}
    for kinds, of_maps in ((PICTURES, (*PICTURES, ".npy", ".npz")), (VIDEO_INPUTS, VIDEO_INPUTS)):
        files = (name for name, is_folder in inside if not is_folder and _suffix(name) in of_maps)
        beside |= {name: maps for name, maps in depth_maps_beside(files).items() if _suffix(name) in kinds}
    maps = {name for names in beside.values() for name in names}
    for name, is_folder in inside:
        path = folder / name
        if name in maps or is_folder and _is_output_or_parent(path, folder, output):
            continue
        command = _find_command(path, is_folder)
        if is_folder and command in (None, "video"):  # a folder of photos is as many items as it holds
            yield from _find_inputs(source, at / name, output, left)
        elif command is None:
            left[_suffix(name) or name] += 1
        else:
            yield at / name, command, at / beside[name][0] if name in beside else None


def _suffix(name: str) -> str:
    return PurePosixPath(name).suffix.lower()


def _is_output_or_parent(path: Path, folder: Path, output: Path) -> bool:
    """Return whether a path in a folder is the output, or a link that leads back."""
    return path.resolve() == output.resolve() or folder.resolve().is_relative_to(path.resolve())


def _find_command(path: Path, is_folder: bool) -> Command | None:
    """Return the command that takes a path; None if there is none."""
    if not is_folder:
        end = path.suffix.lower()
        return "encode" if end in _IMAGES_AND_SCENES else "video" if end in VIDEO_INPUTS else None
    if model_folder(path) is not None or transforms_file(path) is not None:
        return "fit"
    if is_scene_path(path):
        return "encode"
    return "video" if is_sequence(path) or find_scene_sequence(path) else None


def _item(
    path: Path,
    name: PurePosixPath,
    suffix: str,
    command: Command | None = None,
    words: tuple[str, ...] = (),
    fit_words: tuple[str, ...] = (),
) -> Item:
    """Return the item of a path; `name` in the source gives the name of the output."""
    is_folder = path.suffix.lower() not in PICTURES and os.path.isdir(path)  # any name, however long
    command = command or _find_command(path, is_folder) or "encode"
    stem = name.name if is_folder else name.stem
    output = name.parent / (stem + ("" if command == "video" else suffix))
    return Item(output.as_posix(), str(path), command, words, fit_words)


def _read_list(source: Path, suffix: str) -> Iterator[Item]:
    """Yield the items of a text file, a path or a JSON object a line; empty lines and lines with # are skipped."""
    for number, line in enumerate(read_text(source, _LIST_LIMIT_BYTES, "a list of inputs").splitlines(), 1):
        line = line.strip()
        if line and not line.startswith("#"):
            with named(f"{source}, line {number}"):
                if line.startswith("{"):
                    yield _parse_object(line, suffix)
                else:
                    path = checked_path(line)
                    yield _item(path, _relative(path), suffix)


def _relative(path: Path) -> PurePosixPath:
    """Return a path as it was written, or from its root if it leads elsewhere."""
    plain = path if not path.is_absolute() and ".." not in path.parts else Path(os.path.abspath(path))
    return PurePosixPath(*(part for part in plain.parts if part != plain.anchor))


def _parse_object(line: str, suffix: str) -> Item:
    """Parse {"input": PATH, "output": NAME, "command": ..., "fit_options": TEXT} with options by name."""
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
    item = _item(path, _relative(path), suffix, texts["command"], words, split(texts["fit_options"]))
    if output is None:
        return item
    target = PurePath(output)
    if target.anchor or ".." in target.parts or not target.name:
        raise InputError(f"output: expected a name in the folder of the batch, got {shown(output)}")
    if item.command != "video" and target.suffix.lower() not in _IMAGE_SUFFIXES:
        raise InputError(f"output: expected a .png, .tif or .exr, got {shown(output)}")
    return replace(item, name=target.as_posix())


def _word(name: str, value: Any) -> str:
    """Return an option as on the command line: --depth-amount=0.5, --antialiased, --no-antialiased, --pan=0,1."""
    option = name.replace("_", "-")
    if isinstance(value, bool):
        return f"--{option}" if value else f"--no-{option}"
    parts = value if isinstance(value, list) else [value]
    if not parts or not all(isinstance(part, (str, int, float)) for part in parts):
        raise InputError(f"{name}: expected a text, a number, true, false or a list of numbers, got {shown(value)}")
    return f"--{option}={','.join(map(str, parts))}"


def split(text: str | None) -> tuple[str, ...]:
    """Split options of a command line into words. Raises InputError where a quotation mark is left open."""
    try:
        return tuple(split_words(text or ""))
    except ValueError as error:
        raise InputError(f"expected options as on the command line, got {shown(text)} ({error})") from None
