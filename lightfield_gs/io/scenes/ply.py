"""The .ply of 3D Gaussian splatting (Kerbl et al., 2023), one vertex a Gaussian, and the compressed .ply of SuperSplat.

A vertex has x y z, the logarithms of the standard deviations (scale_0..2), the logit of the opacity and the quaternion
wxyz (rot_0..3). Spherical harmonics are f_dc_0..2, and f_rest_* channel by channel: all of red, then green, then blue.
Instead of f_dc there may be red, green and blue: colours, not coefficients. 2D Gaussians (2DGS) have no scale_2, and
some files an opacity of one byte. Properties of other trainers: see ply_extensions.py.

A compressed .ply has chunks of 256 Gaussians, each packed into 16 bytes between the extremes of its chunk.
packed_position and packed_scale (logarithms) have 11, 10 and 11 bits, packed_color four bytes: colour and opacity
itself. packed_rotation has the index of the largest component of wxyz, and the others in 10 bits within +-sqrt(1/2).
An element "sh" may hold f_rest_* as bytes, 0..255 for -4..4. Layout: PlayCanvas, splat-transform and engine.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from lightfield_gs.base.checks import expect, is_row, shown
from lightfield_gs.base.errors import InputError
from lightfield_gs.base.harmonics import SH_CONSTANT
from lightfield_gs.io.atomic import atomic_path
from lightfield_gs.io.ply_file import HEADER_LIMIT_BYTES, Element, Header, Property, read_elements, read_header
from lightfield_gs.io.scenes.plausibility import check_or_skip, step_notes, unknown_motion_notes, value_notes
from lightfield_gs.io.scenes.ply_extensions import (
    FILTER,
    FILTER_NOTE,
    MOTION,
    apply_filter,
    evaluate_motion,
    holds_colours,
)
from lightfield_gs.io.scenes.scene_arrays import (
    HIGH_DEGREE_NOTE,
    MAX_SH_REST,
    TINY,
    Fields,
    Origin,
    SceneArrays,
    check_not_empty,
    checked_fields,
    complete_quaternions,
    limit_degree,
    relative_centres,
    rgb_to_sh,
)

_CENTRE = ("x", "y", "z")
_DC = ("f_dc_0", "f_dc_1", "f_dc_2")
_RGB = ("red", "green", "blue")
_SHAPE = ("opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3")
_FLAT = "scale_2"  # 2D Gaussians lack it
_FLAT_NOTE = f"there is no {_FLAT}: they are 2D Gaussians (2DGS), and drawn as flat discs"
_BYTE_OPACITY_NOTE = "opacity has one byte and is taken for 0..255"
_ANCHORS = ("f_anchor_feat_", "f_offset_")
# Names that trainers give their tensors
_TENSORS = ("features_", "scaling", "rotation", "scales", "quats", "opacities", "sh0", "shN")
_REST_COUNTS = (0, 9, 24, 45, 72)  # 3 ((degree + 1)^2 - 1), degree 0..4
_MAX_LOGIT = 20.0  # above 17.4 the sigmoid is 1 in float32
_ROWS_AT_ONCE = 2048  # they and their conversions fit the cache: eleven times as quick
_CHUNK = 256  # Gaussians
_PACKED = ("packed_position", "packed_rotation", "packed_scale", "packed_color")
_BOUNDS = tuple(f"{end}_{prefix}{axis}" for prefix in ("", "scale_") for end in ("min", "max") for axis in "xyz")
_COLOURS = tuple(f"{end}_{name}" for end in ("min", "max") for name in "rgb")


def read(path: Path, skip_invalid: bool, time: float | None = None) -> SceneArrays:
    """Read a .ply, compressed or not; see files.read_arrays."""
    with open(path, "rb") as file:
        header = read_header(path, file.read(HEADER_LIMIT_BYTES))
    if any(element.name == "chunk" for element in header.elements):
        refuse_time(path, time)
        _check_compressed_header(path, header)
        return _read_compressed(path, header, read_elements(path, header), skip_invalid)
    _check_header(path, header)
    elements = read_elements(path, header)
    fields, origin, notes = _read_fields(path, elements.pop("vertex"), skip_invalid, time)
    return SceneArrays(fields, origin, header.comments, elements, notes, "3DGS .ply")


def refuse_time(path: Path, time: float | None) -> None:
    """Raise InputError if a time is given for a format without moving Gaussians."""
    if time is not None:
        raise InputError(f"{path}: its format holds no Gaussians that move; leave out time=")


def _check_header(path: Path, header: Header) -> None:
    """Raise InputError unless the header describes Gaussians."""
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
    """Raise InputError where logarithms, logits or coefficients are integers.

    An opacity may have one byte, and coordinates and quaternions may be whole numbers.
    """
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
    """Tell whether colours are coefficients of harmonics, or absent."""
    return any(name in names for name in _DC) or not all(name in names for name in _RGB)


def _rest_names(names: Sequence[str]) -> list[str]:
    return [f"f_rest_{i}" for i in range(sum(name.startswith("f_rest_") for name in names))]


def _read_fields(
    path: Path, records: np.ndarray, skip_invalid: bool, time: float | None
) -> tuple[dict[str, np.ndarray], Origin, list[str]]:
    """Convert vertices, whose header has been checked, to fields.

    Opacities are in (0, 1]: the logit inf is 1, and values that underflow float32 become the smallest normal number,
    which is never drawn. Likewise the log scale -inf becomes a flat disc.

    Returns:
        The five fields (see scene/gaussians.py) as float32 arrays, the origin of their centres, and notes.
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
    has_filter = FILTER in names
    if has_filter:
        scales, opacities = apply_filter(scales, opacities, _columns(records, (FILTER,))[:, 0])
    means, origin = _centres(records, scales)
    moves = set(MOTION) <= set(names)
    sh, notes = _harmonics(records, moves)
    fields = {
        "means": means,
        "quaternions": _columns(records, _SHAPE[4:]),
        "scales": scales,
        "opacities": opacities,
        "sh": sh,
    }
    if moves:
        state = evaluate_motion(path, records, time)
        with np.errstate(over="ignore", invalid="ignore"):
            fields["means"] = (means + state.offsets).astype(np.float32)
            fields["quaternions"] = (fields["quaternions"] + state.quaternion_offsets).astype(np.float32)
            fields["opacities"] = (opacities * state.opacity_factors).astype(np.float32)
        decided += state.notes
    elif time is not None:
        raise InputError(f"{path}: no motion of its Gaussians is known (trbf_center, trbf_scale); leave out time=")
    fields, skipped = check_or_skip(path, records, fields, skip_invalid)
    notes = [*decided, *notes, *unknown_motion_notes(path, names, moves), *([FILTER_NOTE] if has_filter else [])]
    notes += [*skipped, *value_notes(log_scales, logits, means), *step_notes(records, scales)]
    for name in ("scales", "opacities"):
        np.maximum(fields[name], TINY, out=fields[name])
    return fields, origin, notes


def _columns(records: np.ndarray, names: Sequence[str]) -> np.ndarray:
    """Return these properties as float32 [N, len(names)]."""
    out = np.empty((len(records), len(names)), np.float32)
    with np.errstate(over="ignore"):
        for start in range(0, len(records), _ROWS_AT_ONCE):
            rows, target = records[start : start + _ROWS_AT_ONCE], out[start : start + _ROWS_AT_ONCE]
            for i, name in enumerate(names):
                target[:, i] = rows[name]
    return out


def _centres(records: np.ndarray, scales: np.ndarray) -> tuple[np.ndarray, Origin]:
    """Return centres, float32 [N, 3], and their origin, which is zero except for doubles far from zero."""
    if all(records.dtype[name] != np.float64 for name in _CENTRE):
        return _columns(records, _CENTRE), (0.0, 0.0, 0.0)
    return relative_centres(np.stack([records[name] for name in _CENTRE], 1, dtype=np.float64), scales)


def _harmonics(records: np.ndarray, moves: bool) -> tuple[np.ndarray, list[str]]:
    """Return sh [N, K, 3], and notes on omissions and guesses; moves: f_dc may be colours."""
    names = records.dtype.names or ()
    bands = len(_rest_names(names)) // 3
    drawn = min(bands, MAX_SH_REST)
    rest = [f"f_rest_{channel * bands + band}" for band in range(drawn) for channel in range(3)]
    first = _DC if _is_harmonic(names) else _RGB
    sh = _columns(records, (*first, *rest)).reshape(len(records), 1 + drawn, 3)
    notes = [HIGH_DEGREE_NOTE] if drawn < bands else []
    if first is _DC and moves:
        are_colours, words = holds_colours(sh[:, 0])
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


def write(path: str | Path, fields: Fields, origin: Origin, comments: Sequence[str] = ()) -> list[str]:
    """Write the float64 fields of N >= 1 valid Gaussians, without losses; see files.write_arrays."""
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
    header = _format_header(count, kinds, comments)
    with atomic_path(path) as temporary, open(temporary, "wb") as file:
        file.write(header)
        rows.tofile(file)
    return []


def _format_header(count: int, kinds: dict[str, str], comments: Sequence[str]) -> bytes:
    """Format the header of `count` vertices with properties of these kinds, by name; raise InputError."""
    columns = "".join(f"property {kind} {name}\n" for name, kind in kinds.items())
    header = (
        b"ply\nformat binary_little_endian 1.0\n"
        + _format_comments(comments)
        + f"element vertex {count}\n{columns}end_header\n".encode()
    )
    if len(header) > HEADER_LIMIT_BYTES:
        raise InputError(
            f"comments: expected at most {HEADER_LIMIT_BYTES} bytes with the rest of the header, got {len(header)}"
        )
    return header


def _format_comments(comments: Sequence[str]) -> bytes:
    """Format comments as lines of the header; raise InputError for texts of several lines."""
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


# The compressed .ply


def _check_compressed_header(path: Path, header: Header) -> None:
    """Raise InputError unless the header describes a compressed .ply with enough chunks."""
    elements = {element.name: element for element in reversed(header.elements)}
    vertex = elements.get("vertex", Element("vertex", 0, []))
    for element, names in ((elements["chunk"], _BOUNDS), (vertex, _PACKED)):
        kinds = {column.name: column.kind for column in element.properties if column.length_kind is None}
        if missing := [name for name in names if name not in kinds]:
            raise InputError(f"{path}: missing {', '.join(missing)}; expected the properties of a compressed .ply")
        if element is vertex and any(kinds[name] != "u4" for name in names):
            raise InputError(f"{path}: expected uint for {', '.join(names)}; export it again")
        if element.has_lists:
            raise InputError(f"{path}: element {element.name} has list properties; this is no compressed .ply")
    check_not_empty(path, vertex.count)
    if not vertex.count <= _CHUNK * elements["chunk"].count:
        raise InputError(
            f"{path}: {elements['chunk'].count} chunks are too few for {vertex.count} Gaussians, {_CHUNK} each; "
            "its header is wrong"
        )
    if "sh" in elements:
        _check_packed_rest(path, elements["sh"], vertex.count)


def _check_packed_rest(path: Path, element: Element, count: int) -> None:
    names = [column.name for column in element.properties]
    if len(names) not in _REST_COUNTS[1:] or names != [f"f_rest_{i}" for i in range(len(names))] or element.has_lists:
        raise InputError(
            f"{path}: element sh: expected f_rest_0 on, 9, 24, 45 or 72 of them, got {len(names)} properties"
        )
    if element.count != count or any(column.kind != "u1" for column in element.properties):
        raise InputError(f"{path}: element sh: expected a row of uchar for each of {count} Gaussians")


def _read_compressed(path: Path, header: Header, elements: dict[str, np.ndarray], skip_invalid: bool) -> SceneArrays:
    """Convert elements whose header has been checked."""
    chunks, rows = elements.pop("chunk"), elements.pop("vertex")
    chunk = np.arange(len(rows)) // _CHUNK
    rest, left_out = limit_degree(_unpack_rest(elements.pop("sh", None), len(rows)))
    with np.errstate(over="ignore", invalid="ignore"):
        logs = _interpolate(chunks, chunk, "scale_", _unpack_11_10_11(rows["packed_scale"]))
        colours = _unpack_bytes(rows["packed_color"])
        rgb = colours[:, :3]
        if all(name in (chunks.dtype.names or ()) for name in _COLOURS):
            rgb = _interpolate(chunks, chunk, "", rgb, "rgb")
        fields = {
            "means": _interpolate(chunks, chunk, "", _unpack_11_10_11(rows["packed_position"])),
            "quaternions": _unpack_rotations(rows["packed_rotation"]),
            "scales": np.exp(logs),
            "opacities": colours[:, 3],
            "sh": np.concatenate([rgb_to_sh(rgb)[:, None], rest], 1),
        }
    fields, notes = checked_fields(path, fields, skip_invalid)
    return SceneArrays(
        fields, comments=header.comments, elements=elements, notes=left_out + notes, kind="compressed .ply (SuperSplat)"
    )


def _interpolate(
    chunks: np.ndarray, chunk: np.ndarray, prefix: str, fractions: np.ndarray, axes: str = "xyz"
) -> np.ndarray:
    """Interpolate between the extremes of the Gaussians' chunks, by fractions [N, 3] in 0..1."""
    low, high = (
        np.stack([chunks[f"{end}_{prefix}{axis}"] for axis in axes], 1).astype(np.float64)[chunk]
        for end in ("min", "max")
    )
    return low + (high - low) * fractions


def _unpack_11_10_11(words: np.ndarray) -> np.ndarray:
    return np.stack([(words >> 21) / 2047, (words >> 11 & 1023) / 1023, (words & 2047) / 2047], 1)


def _unpack_bytes(words: np.ndarray) -> np.ndarray:
    return np.stack([(words >> shift & 255) / 255 for shift in (24, 16, 8, 0)], 1)


def _unpack_rotations(words: np.ndarray) -> np.ndarray:
    three = np.stack([(words >> shift & 1023) / 1023 for shift in (20, 10, 0)], 1)
    return complete_quaternions((three - 0.5) * math.sqrt(2), words >> 30)


def _unpack_rest(rows: np.ndarray | None, count: int) -> np.ndarray:
    """Return harmonics above degree 0, [N, K - 1, 3]."""
    if rows is None:
        return np.zeros((count, 0, 3))
    stored = np.stack([rows[name] for name in rows.dtype.names or ()], 1).astype(np.float64)
    fractions = np.where(stored == 0, 0.0, np.where(stored == 255, 1.0, (stored + 0.5) / 256))
    return ((fractions - 0.5) * 8).reshape(count, 3, -1).transpose(0, 2, 1)
