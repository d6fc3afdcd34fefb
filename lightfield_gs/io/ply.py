"""The standard .ply of 3D Gaussian splatting (Kerbl et al., 2023): binary little-endian, one vertex a Gaussian.

Stored are x y z, the log of the standard deviations (scale_0..2), the logit of the opacity, the quaternion wxyz
(rot_0..3) and the spherical harmonics: f_dc_0..2, and f_rest_* channel by channel (all of red, then green, then blue).
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch

from lightfield_gs.checks import expect, is_row, shown
from lightfield_gs.errors import InputError
from lightfield_gs.gaussians import Gaussians
from lightfield_gs.io.atomic import atomic_path
from lightfield_gs.io.ply_header import HEADER_LIMIT_BYTES, Header

_REQUIRED = ("x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", "scale_0", "scale_1", "scale_2",
             "rot_0", "rot_1", "rot_2", "rot_3")
_REST_COUNTS = (0, 9, 24, 45)  # 3 ((degree + 1)^2 - 1), degree 0..3
_TINY = np.finfo(np.float32).tiny
_MAX_LOGIT = 20.0  # above 17.4 the sigmoid is 1 in float32


def check_header(path: Path, header: Header) -> None:
    """Raises InputError unless the header is that of a file of Gaussians."""
    elements = {element.name: element for element in reversed(header.elements)}
    if "chunk" in elements:
        raise InputError(f"{path} is a compressed .ply (SuperSplat), which this version does not read; "
                         "export it as a standard 3DGS .ply")
    if "vertex" not in elements:
        raise InputError(f"{path}: no element 'vertex'; this is not a file of Gaussians")
    vertex = elements["vertex"]
    if vertex.has_lists:
        raise InputError(f"{path}: the vertices have list properties; this is not a file of Gaussians")
    if vertex.count == 0:
        raise InputError(f"{path} has no Gaussians (element vertex 0)")
    names = tuple(column.name for column in vertex.properties)
    missing = [name for name in _REQUIRED if name not in names]
    if missing:
        raise InputError(f"{path}: missing {', '.join(missing)}; expected the properties of a 3DGS .ply")
    rest = _rest_names(names)
    if len(rest) not in _REST_COUNTS or any(name not in names for name in rest):
        raise InputError(f"{path}: {len(rest)} properties f_rest_*; expected f_rest_0 on, 0, 9, 24 or 45 of them")


def _rest_names(names: tuple[str, ...]) -> list[str]:
    return [f"f_rest_{i}" for i in range(sum(name.startswith("f_rest_") for name in names))]


def gaussians_of(path: Path, records: np.ndarray) -> Gaussians:
    """The Gaussians of the vertices, whose header has been checked.

    An opacity that underflows float32 becomes the smallest normal number, so opacities are in (0, 1]; scales likewise.
    Raises InputError that names the property and the index of a value that has no meaning.
    """
    def columns(*names: str) -> np.ndarray:
        out = np.empty((len(records), len(names)), np.float32)
        for i, name in enumerate(names):
            with np.errstate(over="ignore"):
                out[:, i] = records[name]
            _check_finite(path, name, out[:, i])
        return out

    log_scales = columns("scale_0", "scale_1", "scale_2")
    with np.errstate(over="ignore", under="ignore"):
        scales = np.exp(log_scales)
        logits = columns("opacity")[:, 0].astype(np.float64)
        opacities = (1 / (1 + np.exp(-logits))).astype(np.float32)
    for i in range(3):
        _check_finite(path, f"scale_{i}", scales[:, i], " after exp")
    rest_names = _rest_names(records.dtype.names or ())
    rest = columns(*rest_names).reshape(len(records), 3, -1)
    sh = np.concatenate([columns("f_dc_0", "f_dc_1", "f_dc_2")[:, None], rest.transpose(0, 2, 1)], 1)
    quaternions = columns("rot_0", "rot_1", "rot_2", "rot_3")
    zero = np.flatnonzero(~quaternions.any(1))
    if len(zero):
        raise InputError(f"{path}: rot_0..rot_3 of Gaussian {zero[0]} are all zero, which is no rotation")
    tensors = (columns("x", "y", "z"), quaternions, np.maximum(scales, _TINY), np.maximum(opacities, _TINY), sh)
    return Gaussians(*(torch.from_numpy(array) for array in tensors))


def _check_finite(path: Path, name: str, values: np.ndarray, when: str = "") -> None:
    bad = np.flatnonzero(~np.isfinite(values))
    if len(bad):
        raise InputError(f"{path}: {name} of Gaussian {bad[0]} is {values[bad[0]]}{when} ({len(bad)} such); "
                         "remove these Gaussians or export the file again")


def write_ply(path: str | Path, gaussians: Gaussians, comments: Sequence[str] = ()) -> None:
    """Writes one set of Gaussians as a standard 3DGS .ply (float32), complete or not at all.

    comments: texts of one line each for the header, 64 KiB in all at most with it.
    Raises InputError on a batch of sets, a set of none, on values that `Gaussians.validate` refuses, on comments that
    are no single lines, or when it cannot be written.
    """
    if gaussians.is_batched:
        raise InputError(f"a .ply holds one set of Gaussians, got a batch of {gaussians.means.shape[0]}; save one")
    if gaussians.count == 0:
        raise InputError(f"{path}: there are no Gaussians to write; expected at least one")
    arrays = {name: tensor.cpu().double().numpy() for name, tensor in gaussians.detach().validate().fields().items()}
    count, coefficients = gaussians.count, gaussians.sh.shape[-2]
    with np.errstate(divide="ignore"):
        logits = np.log(arrays["opacities"]) - np.log1p(-arrays["opacities"])
    rest = arrays["sh"][:, 1:].transpose(0, 2, 1).reshape(count, 3 * (coefficients - 1))
    names = ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2",
             *(f"f_rest_{i}" for i in range(rest.shape[1])), *_REQUIRED[6:]]
    table = np.concatenate([arrays["means"], np.zeros((count, 3)), arrays["sh"][:, 0], rest,
                            np.clip(logits, -1e3, _MAX_LOGIT)[:, None], np.log(arrays["scales"]),
                            arrays["quaternions"]], 1, dtype="<f4")
    header = "ply\nformat binary_little_endian 1.0\n".encode() + _comment_lines(comments)
    header += f"element vertex {count}\n".encode()
    header += "".join(f"property float {name}\n" for name in names).encode() + b"end_header\n"
    if len(header) > HEADER_LIMIT_BYTES:
        raise InputError(f"{path}: expected comments that leave the header within {HEADER_LIMIT_BYTES} bytes, got "
                         f"{len(header)}")
    with atomic_path(path) as temporary, open(temporary, "wb") as file:
        file.write(header)
        file.write(table.tobytes())


def _comment_lines(comments: Sequence[str]) -> bytes:
    """Lines of the header. Raises InputError."""
    if not is_row(comments):
        raise InputError(f"comments: expected texts of one line each, got {shown(comments)}")
    lines = []
    for text in comments:
        expect("comments", text, str)
        try:
            line = f"comment {text}".encode()
        except UnicodeEncodeError:
            line = b"\n"
        if b"\n" in line or b"\r" in line:
            raise InputError(f"comments: expected texts of one line each, got {shown(text)}")
        lines.append(line + b"\n")
    return b"".join(lines)
