"""The standard .ply of 3D Gaussian splatting (Kerbl et al., 2023), one vertex a Gaussian.

Stored are x y z, the log of the standard deviations (scale_0..2), the logit of the opacity, the quaternion wxyz
(rot_0..3) and the spherical harmonics: f_dc_0..2, and f_rest_* channel by channel (all of red, then green, then blue).
In place of f_dc there may be red, green and blue: colours, not coefficients. 2D Gaussians (2DGS) have no scale_2, and
others an opacity of one byte. Gaussians that move have more properties: see motion.py.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from lightfield_gs.base.checks import expect, is_row, shown
from lightfield_gs.base.errors import InputError
from lightfield_gs.base.harmonics import SH_CONSTANT
from lightfield_gs.io.atomic import atomic_path
from lightfield_gs.io.scenes import doubts, filter_3d, motion
from lightfield_gs.io.scenes.invalid import check_or_skip
from lightfield_gs.io.scenes.ply_header import HEADER_LIMIT_BYTES, Element, Header, Property
from lightfield_gs.io.scenes.stored_scene import HIGH_DEGREE_NOTE, MOST_BANDS

_CENTRE = ("x", "y", "z")
_DC = ("f_dc_0", "f_dc_1", "f_dc_2")
_RGB = ("red", "green", "blue")
_SHAPE = ("opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3")
_FLAT = "scale_2"  # which 2D Gaussians lack
_FLAT_NOTE = f"there is no {_FLAT}: they are 2D Gaussians (2DGS), and drawn as flat discs"
_BYTE_OPACITY_NOTE = "opacity has one byte and is taken for 0..255"
_ANCHORS = ("f_anchor_feat_", "f_offset_")
_TENSORS = ("features_", "scaling", "rotation", "scales", "quats", "opacities", "sh0", "shN")  # names of trainers' own
_REST_COUNTS = (0, 9, 24, 45, 72)  # 3 ((degree + 1)^2 - 1), degree 0..4
_TINY = np.finfo(np.float32).tiny
_MAX_LOGIT = 20.0  # above 17.4 the sigmoid is 1 in float32
_ROWS_AT_ONCE = 2048  # so few that they and what becomes of them stay in the cache, which is eleven times as quick
# Where rounding to float32 would move centres by more than this share of the usual Gaussian's size, they are given from
# an origin
_ORIGIN_STEP = 1e-3


def check_header(path: Path, header: Header) -> None:
    """Raises InputError unless the header is that of a file of Gaussians."""
    elements = {element.name: element for element in reversed(header.elements)}
    if "vertex" not in elements:
        raise InputError(f"{path}: no element 'vertex'; this is not a file of Gaussians")
    vertex = elements["vertex"]
    if vertex.has_lists:
        raise InputError(f"{path}: the vertices have list properties; this is not a file of Gaussians")
    if vertex.count == 0:
        raise InputError(f"{path} has no Gaussians (element vertex 0)")
    _check_properties(path, vertex, "face" in elements)


def _check_properties(path: Path, vertex: Element, has_faces: bool) -> None:
    names = tuple(column.name for column in vertex.properties)
    required = (*_CENTRE, *(_DC if _is_harmonic(names) else ()), *_SHAPE)
    missing = [name for name in required if name not in names]
    if missing and any(name.startswith(_ANCHORS) for name in names):
        raise InputError(
            f"{path}: these are anchors of Scaffold-GS, Octree-GS or the like, of which networks beside the file make "
            "Gaussians for each view; write those as a 3DGS .ply with its program, or fit the photographs: "
            "lightfield-gs fit"
        )
    if missing == [_FLAT]:
        missing = []
    if missing and any(f"scalar_{name}" in names for name in missing):
        raise InputError(
            f"{path}: properties begin with scalar_, as CloudCompare renames those of Gaussians; give the .ply from "
            "before, and edit it in SuperSplat, which keeps them"
        )
    if missing and (tensors := [name for name in names if name.startswith(_TENSORS)]):
        raise InputError(
            f"{path}: missing {', '.join(missing)}; it has {', '.join(tensors[:3])}, as a trainer calls its tensors; "
            "have the trainer export a 3DGS .ply, or rename them to f_dc_0.., f_rest_0.., scale_0.. and rot_0.."
        )
    if missing and not set(_SHAPE[1:]) & set(names) and set(_CENTRE) <= set(names):
        kind = "mesh" if has_faces else "point cloud, the start of a fit to photographs"
        raise InputError(
            f"{path}: missing {', '.join(missing)}; this is a {kind}, and no scene of Gaussians; give "
            "the .ply that a 3DGS trainer wrote"
        )
    if missing:
        raise InputError(f"{path}: missing {', '.join(missing)}; expected the properties of a 3DGS .ply")
    rest = _rest_names(names)
    _refuse_integers(path, [column for column in vertex.properties if column.name in (*required, *rest)])
    if len(rest) not in _REST_COUNTS or any(name not in names for name in rest):
        raise InputError(f"{path}: {len(rest)} properties f_rest_*; expected f_rest_0 on, 0, 9, 24, 45 or 72 of them")


def _refuse_integers(path: Path, columns: list[Property]) -> None:
    """Raises InputError where logarithms, logits or coefficients are integers; an opacity may have one byte, and
    coordinates and quaternions may be whole numbers."""
    whole = [
        column
        for column in columns
        if column.kind in ("i2", "u2")
        or column.kind[0] in "iu"
        and column.name not in (*_CENTRE, *_SHAPE[4:])
        and (column.name, column.kind) != (_SHAPE[0], "u1")
    ]
    if not whole:
        return
    halves = "; it looks like half floats that were written as integers" if whole[0].kind in ("i2", "u2") else ""
    raise InputError(
        f"{path}: expected float or double for {whole[0].name}, got integers of {8 * int(whole[0].kind[1])} bits, in "
        f"{len(whole)} of {len(columns)} properties{halves}; export it again with float properties"
    )


def _is_harmonic(names: Sequence[str]) -> bool:
    """Whether colours are coefficients of harmonics (or nothing at all)."""
    return any(name in names for name in _DC) or not all(name in names for name in _RGB)


def _rest_names(names: Sequence[str]) -> list[str]:
    return [f"f_rest_{i}" for i in range(sum(name.startswith("f_rest_") for name in names))]


def fields_of(
    path: Path, records: np.ndarray, skip_invalid: bool = False, time: float | None = None
) -> tuple[dict[str, np.ndarray], tuple[float, float, float], list[str]]:
    """The five fields of the Gaussians (see scene/gaussians.py) as float32 arrays, of vertices whose header has been
    checked; the origin that their centres are given from; and notes on what looks wrong in them.

    An infinite logit is the opacity 1 or, as what underflows float32, the smallest normal number, which is never drawn;
    so opacities are in (0, 1]. Scales likewise: the log -inf is a flat disc.
    skip_invalid: leaves out the Gaussians that `check_or_skip` complains of. time: at which those that move are drawn,
    see motion.py. Raises InputError.
    """
    names = records.dtype.names or ()
    log_scales, logits = _columns(records, [name for name in _SHAPE[1:4] if name in names]), None
    with np.errstate(over="ignore", under="ignore"):
        scales = np.exp(log_scales)
        if records.dtype["opacity"] == np.uint8:
            opacities = _columns(records, _SHAPE[:1])[:, 0] / np.float32(255)
        else:
            logits = _columns(records, _SHAPE[:1])[:, 0]
            opacities = (1 / (1 + np.exp(-logits.astype(np.float64)))).astype(np.float32)
    decided = [] if logits is not None else [_BYTE_OPACITY_NOTE]
    if _FLAT not in names:
        scales = np.pad(scales, ((0, 0), (0, 1)))
        decided.append(_FLAT_NOTE)
    has_filter = filter_3d.PROPERTY in names
    if has_filter:
        scales, opacities = filter_3d.filtered(scales, opacities, _columns(records, (filter_3d.PROPERTY,))[:, 0])
    means, origin = _centres(records, scales)
    sh, notes = _harmonics(records)
    fields = {
        "means": means,
        "quaternions": _columns(records, _SHAPE[4:]),
        "scales": scales,
        "opacities": opacities,
        "sh": sh,
    }
    if motion.is_moving(names):
        moved = motion.moved(path, records, time)
        with np.errstate(over="ignore", invalid="ignore"):
            fields["means"] = (means + moved.shifts).astype(np.float32)
            fields["quaternions"] = (fields["quaternions"] + moved.turns).astype(np.float32)
            fields["opacities"] = (opacities * moved.shares).astype(np.float32)
        decided += moved.notes
    elif time is not None:
        raise InputError(f"{path}: no motion of its Gaussians is known (trbf_center, trbf_scale); leave out --time")
    fields, skipped = check_or_skip(path, records, fields, skip_invalid)
    notes = [*decided, *notes, *motion.still_notes(path, names), *([filter_3d.NOTE] if has_filter else [])]
    notes += [*skipped, *doubts.about_values(log_scales, logits, means), *doubts.about_steps(records, scales)]
    for name in ("scales", "opacities"):
        np.maximum(fields[name], _TINY, out=fields[name])
    return fields, origin, notes


def _columns(records: np.ndarray, names: Sequence[str]) -> np.ndarray:
    """These properties as float32 [N, len(names)]."""
    out = np.empty((len(records), len(names)), np.float32)
    with np.errstate(over="ignore"):
        for start in range(0, len(records), _ROWS_AT_ONCE):
            rows, target = records[start : start + _ROWS_AT_ONCE], out[start : start + _ROWS_AT_ONCE]
            for i, name in enumerate(names):
                target[:, i] = rows[name]
    return out


def _centres(records: np.ndarray, scales: np.ndarray) -> tuple[np.ndarray, tuple[float, float, float]]:
    """Centres float32 [N, 3] and the origin they are given from, which is not zero only for doubles far from it."""
    if all(records.dtype[name] != np.float64 for name in _CENTRE):
        return _columns(records, _CENTRE), (0.0, 0.0, 0.0)
    exact = np.stack([records[name] for name in _CENTRE], 1, dtype=np.float64)
    origin = np.zeros(3)
    with np.errstate(over="ignore", invalid="ignore"):
        usual = doubts.usual(exact)
        if usual is not None and doubts.float_step(usual) > _ORIGIN_STEP * doubts.usual_size(scales):
            origin = np.round(usual)
        return (exact - origin).astype(np.float32), tuple((origin + 0.0).tolist())


def _harmonics(records: np.ndarray) -> tuple[np.ndarray, list[str]]:
    """sh [N, K, 3], and notes on what was left out, or had to be guessed at."""
    names = records.dtype.names or ()
    bands = len(_rest_names(names)) // 3
    drawn = min(bands, MOST_BANDS)
    rest = [f"f_rest_{channel * bands + band}" for band in range(drawn) for channel in range(3)]
    first = _DC if _is_harmonic(names) else _RGB
    sh = _columns(records, (*first, *rest)).reshape(len(records), 1 + drawn, 3)
    notes = [HIGH_DEGREE_NOTE] if drawn < bands else []
    if first is _DC and motion.is_moving(names):
        are_colours, words = motion.holds_colours(sh[:, 0])
        notes.append(words)
        if are_colours:
            sh[:, 0] = (sh[:, 0] - np.float32(0.5)) / np.float32(SH_CONSTANT)
    if first is _RGB:
        kind, full = records.dtype["red"], 255.0
        if kind.kind == "f" and not np.nanmax(sh[:, 0], initial=0) > 1:
            full = 1.0
        elif kind.kind == "f":
            notes.append("red, green and blue have numbers above 1 and are taken for 0..255")
        elif kind == np.uint16:
            full = 65535.0
        sh[:, 0] = (sh[:, 0] / np.float32(full) - np.float32(0.5)) / np.float32(SH_CONSTANT)
    return sh, notes


def write(
    path: str | Path, fields: dict[str, np.ndarray], origin: tuple[float, float, float], comments: Sequence[str] = ()
) -> None:
    """Writes the float64 fields of N >= 1 valid Gaussians; see Gaussians.save. Raises InputError."""
    count, coefficients = fields["sh"].shape[:2]
    with np.errstate(divide="ignore"):
        logits = np.log(fields["opacities"]) - np.log1p(-fields["opacities"])
    rest = fields["sh"][:, 1:].transpose(0, 2, 1).reshape(count, 3 * (coefficients - 1))
    names = ["nx", "ny", "nz", *_DC, *(f"f_rest_{i}" for i in range(rest.shape[1])), *_SHAPE]
    rows = np.empty(count, [("centre", "<f8" if any(origin) else "<f4", 3), ("rest", "<f4", len(names))])
    rows["centre"] = fields["means"] + origin
    np.concatenate(
        [
            np.zeros((count, 3)),
            fields["sh"][:, 0],
            rest,
            np.clip(logits, -1e3, _MAX_LOGIT)[:, None],
            np.log(fields["scales"]),
            fields["quaternions"],
        ],
        1,
        out=rows["rest"],
        casting="same_kind",
    )
    kinds = dict.fromkeys(_CENTRE, "double" if any(origin) else "float") | dict.fromkeys(names, "float")
    header = _header(count, kinds, comments)
    with atomic_path(path) as temporary, open(temporary, "wb") as file:
        file.write(header)
        file.write(rows.tobytes())


def _header(count: int, kinds: dict[str, str], comments: Sequence[str]) -> bytes:
    """Header for `count` vertices with properties of these kinds, by name. Raises InputError."""
    columns = "".join(f"property {kind} {name}\n" for name, kind in kinds.items())
    header = (
        b"ply\nformat binary_little_endian 1.0\n"
        + _comment_lines(comments)
        + f"element vertex {count}\n{columns}end_header\n".encode()
    )
    if len(header) > HEADER_LIMIT_BYTES:
        raise InputError(
            f"comments: expected at most {HEADER_LIMIT_BYTES} bytes with the rest of the header, got {len(header)}"
        )
    return header


def _comment_lines(comments: Sequence[str]) -> bytes:
    """The comments as lines of the header. Raises InputError for texts that are no single lines."""
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
