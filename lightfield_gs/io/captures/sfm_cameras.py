"""What COLMAP is given of photographs of unknown cameras: which of them one camera took, and files that it can read."""

from __future__ import annotations

import contextlib
import shutil
import warnings
from collections import defaultdict
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from lightfield_gs.base.assumptions import assume
from lightfield_gs.base.errors import reading
from lightfield_gs.io.images import as_floats, read_info, read_picture

_EXIF, _ORIENTATION = 0x8769, 0x0112
_MAKE_MODEL = (0x010F, 0x0110)
_FOCAL_MM, _FOCAL_35_MM, _LENS_MODEL = 0x920A, 0xA405, 0xA434
_DIGITS = 3  # of a focal length in mm: phones write the same one with other digits behind
_COLMAP_READS = (b"\xff\xd8", b"\x89PNG", b"II*\0", b"MM\0*", b"BM")  # how files of JPEG, PNG, TIFF and BMP begin
_MOST_SAID = 4

Camera = tuple[Any, ...]


def cameras_of(paths: Mapping[str, Path]) -> list[list[str]]:
    """Names of photographs by the camera that took them: of one size, and with one lens by their Exif, where they have
    any. Says which. Raises InputError for what is no photograph."""
    groups: dict[Camera, list[str]] = defaultdict(list)
    for name, path in paths.items():
        info = read_info(path)
        groups[(info.width_px, info.height_px, *_lens(path))].append(name)
    if len(groups) == 1:
        assume(f"the {len(paths)} photographs are of one camera")
    else:
        words = [f"{len(names)} of {_words(camera)}" for camera, names in groups.items()]
        more = f" and {len(words) - _MOST_SAID} more" if len(words) > _MOST_SAID else ""
        assume(
            f"the {len(paths)} photographs are of {len(groups)} cameras, by size and Exif: "
            f"{', '.join(words[:_MOST_SAID])}{more}"
        )
    return list(groups.values())


def readable(paths: Mapping[str, Path], folder: Path, work: Path) -> Path:
    """The folder of the photographs, if COLMAP reads all of them; else one in `work` with links to those that it reads
    and JPEG files, with the same Exif, of the others, all by their names. Raises InputError."""
    others = [name for name, path in paths.items() if not _start(path).startswith(_COLMAP_READS)]
    if not others:
        return folder
    assume(f"COLMAP reads {len(others)} of {len(paths)} photographs as JPEG files, for it knows no {_kinds(others)}")
    copies = work / "photographs"
    for name, path in paths.items():
        target = copies / name
        target.parent.mkdir(parents=True, exist_ok=True)
        if name in others:
            _write_jpeg(path, target)
        else:
            _link(path, target)
    return copies


def _start(path: Path) -> bytes:
    with reading(path), path.open("rb") as file:
        return file.read(4)


def _kinds(names: Sequence[str]) -> str:
    return " or ".join(sorted({Path(name).suffix.lower() for name in names}))


def _lens(path: Path) -> tuple[Any, ...]:
    """What Exif says of the camera and its lens: make, model, lens and focal lengths, as far as it does."""
    exif = _exif(path)
    inner = exif.get_ifd(_EXIF)
    words = [str(exif.get(tag, "")).strip("\0 ") for tag in _MAKE_MODEL] + [
        str(inner.get(_LENS_MODEL, "")).strip("\0 ")
    ]
    return (*words, *(_millimetres(inner.get(tag)) for tag in (_FOCAL_MM, _FOCAL_35_MM)))


def _millimetres(value: Any) -> float:
    """A focal length to _DIGITS digits; 0 where there is none."""
    with contextlib.suppress(TypeError, ValueError, ZeroDivisionError, OverflowError):
        number = float(value)
        return float(f"{number:.{_DIGITS}g}") if 0 < number < np.inf else 0.0
    return 0.0


def _words(camera: Camera) -> str:
    width, height, *_, focal, equivalent = camera
    length = f" at {equivalent:g} mm (35 mm film)" if equivalent else f" at {focal:g} mm" if focal else ""
    return f"{width} x {height}{length}"


def _exif(path: Path) -> Any:
    """Pillow's Exif of a photograph that read_info read; empty where Pillow finds none."""
    from PIL import Image

    with warnings.catch_warnings(), contextlib.suppress(OSError, ValueError, SyntaxError, RuntimeError, EOFError):
        warnings.simplefilter("ignore")  # of large pictures, which are not decoded here, and of damaged Exif
        with Image.open(path) as image:
            exif = image.getexif()
            exif.get_ifd(_EXIF)
            return exif
    return Image.Exif()


def _write_jpeg(path: Path, target: Path) -> None:
    """A photograph as stored, as JPEG; its Exif too, but for the orientation, which COLMAP and poses leave alone."""
    from PIL import Image

    pixels = as_floats(read_picture(path, turn=False).pixels)
    colours = np.repeat(pixels[..., :1], 3, 2) if pixels.shape[2] < 3 else pixels[..., :3]
    exif = _exif(path)
    exif.pop(_ORIENTATION, None)
    image = Image.fromarray(np.rint(255 * np.clip(colours, 0, 1)).astype(np.uint8))
    image.save(target, "JPEG", quality=95, subsampling=0, exif=exif)


def _link(path: Path, target: Path) -> None:
    """A link to a file, or a copy where there are no links."""
    try:
        target.symlink_to(path.resolve())
    except OSError:
        shutil.copyfile(path, target)
