"""glTF 2.0 with Gaussians (KHR_gaussian_splatting), also packed as SPZ.

A primitive of points with the extension has POSITION and, under the extension's name, ROTATION (xyzw), SCALE (standard
deviations), OPACITY (0..1) and SH_DEGREE_d_COEF_n: red, green and blue of each harmonic. Nodes place it. The axes of
glTF are turned about x to those of a .ply (right, down, forward), as an .spz is, so that up and front stay. Drafts of
the extension differ: SCALE was the logarithm, and COLOR_0 had the colour and the opacity. In the extensions for SPZ a
buffer view is an .spz, whose axes they put into glTF's as left, up, front; before there was a kernel, as they are.
Specifications: Khronos, KHR_gaussian_splatting (ratified) and KHR_gaussian_splatting_compression_spz_2 (draft).
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from lightfield_gs.base.checks import counted, shown
from lightfield_gs.base.errors import InputError, named
from lightfield_gs.base.harmonics import SH_COEFFICIENTS
from lightfield_gs.io.file_kinds import FIT_ADVICE
from lightfield_gs.io.scenes import spz
from lightfield_gs.io.scenes.comments import ANTIALIASED, Y_DOWN, is_antialiased
from lightfield_gs.io.scenes.gltf_file import GltfFile, Object, extensions
from lightfield_gs.io.scenes.placement import gather_placed, place
from lightfield_gs.io.scenes.scene_arrays import (
    HIGH_DEGREE_NOTE,
    LINEAR_NOTE,
    Y_UP_TURN,
    Fields,
    SceneArrays,
    encode_light,
    rgb_to_sh,
)

GAUSSIANS = "KHR_gaussian_splatting"
SRGB, LINEAR = "srgb_rec709_display", "lin_rec709_display"
_TURN = np.diag([*Y_UP_TURN, 1.0])  # of glTF's axes (y up, z to the viewer) to a .ply's
_SPZ = ("KHR_gaussian_splatting_compression_spz_2", "KHR_gaussian_splatting_compression_spz")
_OLD_SPZ = "KHR_spz_gaussian_splats_compression"  # on the primitive itself
_SPZ_TURN = np.diag([-1.0, -1.0, 1.0, 1.0])  # of a .ply's axes to left, up, front
_ROWS_AT_ONCE = 2048  # they fit the cache
_INSTANCES = "EXT_mesh_gpu_instancing"
_POINTS = 0  # mode of a primitive
_COEFFICIENT = re.compile(GAUSSIANS + r":SH_DEGREE_(\d+)_COEF_(\d+)")
_LOGS_NOTE = "scales below 0 are taken for logarithms, as programs wrote them before the extension was ratified"
_KNOWN = {"kernel": "ellipse", "colorSpace": SRGB, "projection": "perspective", "sortingMethod": "cameraDistance"}


@dataclass
class _Found:
    """Primitives of Gaussians, in the axes of a .ply, and everything else in the scene, counted."""

    parts: list[Fields] = field(default_factory=list)
    notes: dict[str, None] = field(default_factory=dict)
    others: int = 0
    is_moved: bool = False
    is_antialiased: bool = True


def read(path: Path, skip_invalid: bool) -> SceneArrays:
    """Read the Gaussians of a .glb or .gltf; see files.read_arrays."""
    with named(path):
        file = GltfFile(path)
        found = _collect(file)
    fields, origin, notes = gather_placed(path, found.parts, found.is_moved, skip_invalid)
    notes += found.notes
    if found.others:
        left_out = counted(found.others, "other primitive", does="are left out")
        notes.append(f"{left_out} (meshes, lines, points): the Gaussians alone are drawn")
    if file.root.get("animations"):
        notes.append("animations are left out: nodes stay at their first places")
    kind = f"glTF ({GAUSSIANS}), {counted(len(found.parts), 'primitive')}, axes turned from y up to right-down-forward"
    return SceneArrays(fields, origin, _comments(file, found), notes=notes, kind=kind)


def _comments(file: GltfFile, found: _Found) -> tuple[str, ...]:
    """Return the line on the axes, those of the asset's extras, and one on anti-aliasing where every SPZ says so."""
    extras = file.root["asset"].get("extras")
    stored = extras.get("comments") if isinstance(extras, dict) else None
    lines = [line for line in stored if isinstance(line, str)] if isinstance(stored, list) else []
    return (Y_DOWN, *lines, *([ANTIALIASED] if found.is_antialiased else []))


def _collect(file: GltfFile) -> _Found:
    """Collect the primitives of the scene; raise InputError where none has Gaussians."""
    found = _Found()
    for node, matrix in file.placed_nodes():
        if "mesh" not in node:
            continue
        primitives = file.item("meshes", node["mesh"]).get("primitives")
        for primitive in primitives if isinstance(primitives, list) else []:
            own = extensions(primitive) if isinstance(primitive, dict) else {}
            if GAUSSIANS not in own and _OLD_SPZ not in own:
                found.others += 1
                continue
            if _INSTANCES in extensions(node):
                found.notes[f"copies by {_INSTANCES} are left out: such Gaussians are drawn once"] = None
            found.is_moved |= bool(matrix[:3, 3].any())
            found.parts.append(_read_primitive(file, primitive, matrix, found))
    if not found.parts:
        raise InputError(
            f"glTF without Gaussians ({GAUSSIANS}): its scene has "
            f"{counted(found.others, 'primitive')} of meshes or points, and no Gaussians; {FIT_ADVICE}"
        )
    return found


def _read_primitive(file: GltfFile, primitive: Object, matrix: np.ndarray, found: _Found) -> Fields:
    """Read a primitive, place it, and turn it to the axes of a .ply; add notes to `found`."""
    extension = extensions(primitive).get(GAUSSIANS)
    extension = extension if isinstance(extension, dict) else {}
    if primitive.get("mode", 4) != _POINTS:
        raise InputError(f"Gaussians: expected a primitive of mode 0 (points), got {shown(primitive.get('mode', 4))}")
    for key, known in _KNOWN.items():
        value = extension.get(key, known)
        if value != known and (key, value) != ("colorSpace", LINEAR):
            found.notes[f"{key} {shown(value)} is not known here, and drawn as {known}"] = None
    nested = {**extensions(extension), **{name: one for name, one in extensions(primitive).items() if name == _OLD_SPZ}}
    packed = [nested[name] for name in (*_SPZ, _OLD_SPZ) if isinstance(nested.get(name), dict)]
    attributes = primitive.get("attributes")
    attributes = attributes if isinstance(attributes, dict) else {}
    if packed:
        fields, says_so = _unpack(file, packed[0].get("bufferView"), attributes, found)
        found.is_antialiased &= says_so
        axes = _SPZ_TURN if "kernel" in extension else _TURN
    else:
        found.is_antialiased = False
        fields, axes = _read_attributes(file, attributes, found), np.eye(4)
    if extension.get("colorSpace") == LINEAR:
        found.notes[LINEAR_NOTE] = None
        fields["sh"] = encode_light(fields["sh"])
    return place(fields, _TURN @ matrix @ axes)


def _unpack(file: GltfFile, view: object, attributes: Object, found: _Found) -> tuple[Fields, bool]:
    """Decode the .spz in a buffer view; return its fields, and whether it says that it is anti-aliased."""
    data, _ = file.view(view)
    stored = spz.decode(file.path, data.tobytes(), False)
    found.notes.update(dict.fromkeys(stored.notes))
    count = len(stored.fields["means"])
    if "POSITION" in attributes and (told := file.item("accessors", attributes["POSITION"]).get("count")) != count:
        raise InputError(f"its accessors promise {shown(told)} Gaussians, and its SPZ holds {count}; export it again")
    return stored.fields, is_antialiased(stored.comments) is True


@np.errstate(over="ignore", invalid="ignore")
def _read_attributes(file: GltfFile, attributes: Object, found: _Found) -> Fields:
    """Read the fields of a primitive in its own axes, float32."""

    def column(name: str, width: int) -> np.ndarray:
        if name not in attributes:
            raise InputError(f"missing attribute {name}; expected those of {GAUSSIANS}: export it again")
        numbers = file.numbers(attributes[name], name)
        if numbers.shape[1] != width or name != "POSITION" and len(numbers) != count:
            raise InputError(
                f"{name}: expected {count or 'rows'} of {width} numbers, got {' x '.join(map(str, numbers.shape))}; "
                "its accessors are wrong"
            )
        return numbers

    count = 0
    means = np.array(column("POSITION", 3), np.float32)
    count = len(means)
    quaternions = np.roll(column(f"{GAUSSIANS}:ROTATION", 4).astype(np.float32), 1, axis=1)
    scales = np.array(column(f"{GAUSSIANS}:SCALE", 3), np.float32)
    if (scales < 0).any():
        found.notes[_LOGS_NOTE] = None
        scales = np.exp(scales)
    colour = None
    if f"{GAUSSIANS}:OPACITY" not in attributes or f"{GAUSSIANS}:SH_DEGREE_0_COEF_0" not in attributes:
        colour = column("COLOR_0", 4).astype(np.float32)
        found.notes["colours or opacities are from COLOR_0, as in drafts of the extension"] = None
    if f"{GAUSSIANS}:OPACITY" in attributes:
        opacities = np.array(column(f"{GAUSSIANS}:OPACITY", 1)[:, 0], np.float32)
    else:
        assert colour is not None
        opacities = colour[:, 3].copy()
    opacities[(opacities < 0) | (opacities > 1)] = np.nan
    degree = _degree(attributes, found)
    names = [f"{GAUSSIANS}:SH_DEGREE_{each}_COEF_{n}" for each in range(degree + 1) for n in range(2 * each + 1)]
    drawn = rgb_to_sh(colour[:, :3]) if colour is not None and names[0] not in attributes else column(names[0], 3)
    harmonics = [drawn, *(column(name, 3) for name in names[1:])]
    sh = np.empty((count, SH_COEFFICIENTS[degree], 3), np.float32)
    for start in range(0, count, _ROWS_AT_ONCE):
        rows = slice(start, start + _ROWS_AT_ONCE)
        for index, coefficients in enumerate(harmonics):
            sh[rows, index] = coefficients[rows]
    return {"means": means, "quaternions": quaternions, "scales": scales, "opacities": opacities, "sh": sh}


def _degree(attributes: Object, found: _Found) -> int:
    """Return the highest degree of harmonics among attributes, 0..3."""
    degrees = [int(match[1]) for name in attributes if (match := _COEFFICIENT.fullmatch(name))]
    most = max(degrees, default=0)
    if most >= len(SH_COEFFICIENTS):
        found.notes[HIGH_DEGREE_NOTE] = None
    return min(most, len(SH_COEFFICIENTS) - 1)
