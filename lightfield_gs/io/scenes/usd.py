"""OpenUSD with Gaussians (UsdVol: ParticleField3DGaussianSplat), by the package usd-core: .usd, .usda, .usdc, .usdz.

A prim of this type has positions, orientations, scales (standard deviations), opacities (0..1), and
radiance:sphericalHarmonicsCoefficients, all harmonics of a particle in a row. Half floats have an h behind their name.
The axes of the stage (y or z up) are turned to those of a .ply, and metersPerUnit makes lengths metres. Files that are
written have y up and units of a metre.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from lightfield_gs.base.checks import counted, shown
from lightfield_gs.base.errors import InputError, named
from lightfield_gs.base.harmonics import SH_COEFFICIENTS
from lightfield_gs.io.atomic import atomic_path, scratch_folder
from lightfield_gs.io.file_kinds import FIT_ADVICE
from lightfield_gs.io.scenes.comments import Y_DOWN, is_antialiased
from lightfield_gs.io.scenes.placement import gather_placed, place
from lightfield_gs.io.scenes.scene_arrays import (
    HIGH_DEGREE_NOTE,
    LINEAR_NOTE,
    Y_UP_SIGNS,
    Y_UP_TURN,
    Fields,
    Origin,
    SceneArrays,
    encode_light,
    up_losses,
)

SUFFIXES = (".usd", ".usda", ".usdc", ".usdz")
STARTS = (b"#usd", b"PXR-")
SPLAT = "ParticleField3DGaussianSplat"
_FIELD = "ParticleField"  # made of applied schemas
_ELLIPSOID, _DISC = "ParticleFieldKernelGaussianEllipsoidAPI", "ParticleFieldKernelGaussianSurfletAPI"
_DEGREE, _HARMONICS = "radiance:sphericalHarmonicsDegree", "radiance:sphericalHarmonicsCoefficients"
_MOST_DEGREE = 4
_KEY = "lightfield_gs"  # of the layer's own data
_Z_UP_TURN = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])  # right, forward, up to a .ply's right, down, forward


@dataclass
class _Found:
    """Prims of Gaussians in the axes of a .ply, and everything else, counted."""

    parts: list[Fields] = field(default_factory=list)
    notes: dict[str, None] = field(default_factory=dict)
    hidden: int = 0
    others: int = 0
    is_moved: bool = False


def import_usd() -> Any:
    """Import usd-core; raise InputError without it, or for a release without the schema (before 26.03)."""
    try:
        from pxr import Gf, Sdf, Tf, Usd, UsdGeom, UsdVol, Vt

        if hasattr(UsdVol, SPLAT):
            return SimpleNamespace(Gf=Gf, Sdf=Sdf, Tf=Tf, Usd=Usd, UsdGeom=UsdGeom, Vt=Vt)
    except ImportError:
        pass
    raise InputError(
        "Gaussians in OpenUSD need the package usd-core, 26.3 or newer; pip install --upgrade 'lightfield-gs[usd]', or "
        "take a .ply or .glb"
    )


def read(path: Path, skip_invalid: bool, time: float | None = None) -> SceneArrays:
    """Read the Gaussians of a stage.

    Args:
        path: the file; its name ends in one of SUFFIXES.
        skip_invalid: see files.read_arrays.
        time: time code at which values that vary are read. None: their default, or else the stage's first time.

    Raises:
        InputError: usd-core is missing, the file is broken, or it has no Gaussians.
    """
    if path.suffix.lower() not in SUFFIXES:
        raise InputError(f"{path} is OpenUSD by its content; rename it to end in .usd, or in .usdz if it is a ZIP")
    with named(path):
        usd = import_usd()
        stage = _open(usd, path)
        found = _collect(usd, stage, time)
    fields, origin, notes = gather_placed(path, found.parts, found.is_moved, skip_invalid)
    notes += found.notes
    if found.hidden:
        notes.append(counted(found.hidden, "prim", does="of Gaussians are invisible in the stage and left out"))
    if found.others:
        left_out = counted(found.others, "prim", does="of other geometry are left out")
        notes.append(f"{left_out}: the Gaussians alone are drawn")
    up = usd.UsdGeom.GetStageUpAxis(stage).lower()
    kind = f"OpenUSD ({SPLAT}), {counted(len(found.parts), 'prim')}, axes turned from {up} up to right-down-forward"
    return SceneArrays(fields, origin, (Y_DOWN, *_stored_comments(stage)), notes=notes, kind=kind)


def _open(usd: Any, path: Path) -> Any:
    """Open a stage; raise InputError for a broken file."""
    try:
        stage = usd.Usd.Stage.Open(str(path))
    except usd.Tf.ErrorException as error:
        raise InputError(f"it cannot be read as OpenUSD ({_reason(error)}); export it or download it again") from None
    if stage is None:
        raise InputError("it cannot be read as OpenUSD; export it or download it again")
    return stage


def _reason(error: Exception) -> str:
    """Return the first reason in an error of OpenUSD, without its place in the library."""
    words = " ".join(str(error).split())
    return words.partition(" : ")[2].strip("' ")[:150] or words[:150]


def _stored_comments(stage: Any) -> list[str]:
    data = stage.GetRootLayer().customLayerData
    own = data.get(_KEY)
    return [str(line) for line in own.get("comments", ())] if isinstance(own, dict) else []


def _collect(usd: Any, stage: Any, time: float | None) -> _Found:
    """Collect the prims of Gaussians; raise InputError where there is none."""
    found = _Found()
    when = usd.Usd.TimeCode.Default() if time is None else usd.Usd.TimeCode(time)
    axes = np.eye(4)
    axes[:3, :3] = _Z_UP_TURN if usd.UsdGeom.GetStageUpAxis(stage) == usd.UsdGeom.Tokens.z else np.diag(Y_UP_TURN)
    if usd.UsdGeom.StageHasAuthoredMetersPerUnit(stage):
        unit = usd.UsdGeom.GetStageMetersPerUnit(stage)
        if not 1e-12 < unit < 1e12:
            raise InputError(f"metersPerUnit: expected a length above 0, got {shown(unit)}")
        axes[:3, :3] *= unit
        if unit != 1:
            found.notes[f"lengths are times {unit:g}, in metres (metersPerUnit)"] = None
    for prim in _particle_prims(usd, stage, found):
        if usd.UsdGeom.Imageable(prim).ComputeVisibility(when) == usd.UsdGeom.Tokens.invisible:
            found.hidden += 1
            continue
        values = _Values(usd, stage, prim, when, found)
        # Rows times matrices, there
        world = usd.UsdGeom.XformCache(values.when("xformOpOrder")).GetLocalToWorldTransform(prim)
        matrix = np.array(world).T
        found.is_moved |= bool(matrix[:3, 3].any())
        with named(prim.GetPath()):
            found.parts.append(place(_read_prim(prim, values), axes @ matrix))
    if not found.parts:
        hidden = f", {found.hidden} invisible ones" if found.hidden else ""
        raise InputError(
            f"OpenUSD without Gaussians ({SPLAT}{hidden}): the stage has "
            f"{counted(found.others, 'prim')} of other geometry; {FIT_ADVICE}"
        )
    return found


def _particle_prims(usd: Any, stage: Any, found: _Found) -> Iterator[Any]:
    """Yield the prims of Gaussians; count other geometry."""
    for prim in stage.Traverse(usd.Usd.TraverseInstanceProxies()):
        kind, applied = prim.GetTypeName(), prim.GetMetadata("apiSchemas")
        names = set(applied.GetAddedOrExplicitItems()) if applied else set()
        if kind == SPLAT or kind == _FIELD and names & {_ELLIPSOID, _DISC}:
            yield prim
        elif kind == _FIELD or prim.IsA(usd.UsdGeom.Gprim):
            found.others += 1


class _Values:
    """The values of a prim's attributes, as NumPy arrays."""

    def __init__(self, usd: Any, stage: Any, prim: Any, when: Any, found: _Found):
        self._usd, self._stage, self._prim, self._when, self._found = usd, stage, prim, when, found

    def when(self, name: str) -> Any:
        """Return the time at which an attribute is read: its default if there is one, else the first."""
        attribute = self._prim.GetAttribute(name)
        is_given = not self._when.IsDefault()
        samples = attribute.GetTimeSamples() if attribute and not is_given else []
        if not samples or attribute.Get() is not None:
            return self._when
        first = min(samples)
        self._found.notes[f"it moves, and is drawn at its time {first:g} (another: time=)"] = None
        return self._usd.Usd.TimeCode(first)

    def rows(self, name: str, width: int, count: int | None = None) -> np.ndarray | None:
        """Return the rows [count, width] of an attribute, float32; None where it is absent or too short."""
        for each in (name, f"{name}h"):  # full floats go before half ones
            attribute = self._prim.GetAttribute(each)
            if not attribute or not attribute.HasAuthoredValue():
                continue
            value = attribute.Get(self.when(each))
            array = np.array(() if value is None else value, np.float32)
            if array.size and array.shape[1:] != ((width,) if width > 1 else ()):
                raise InputError(f"{each}: expected rows of {width} numbers, got shape {list(array.shape)}")
            array = array.reshape(-1, width)
            if count is None or len(array) >= count:
                return array[:count]
            self._found.notes[f"{each} has {len(array)} rows for {count}, and is not used"] = None
        return None

    def is_linear(self) -> bool:
        """Tell whether the colours are declared as linear light."""
        attribute = self._prim.GetAttribute(_HARMONICS)
        return bool(attribute) and str(attribute.GetColorSpace()).startswith("lin_")

    def degree(self) -> int:
        """Return the degree of the harmonics."""
        attribute = self._prim.GetAttribute(_DEGREE)
        value = attribute.Get() if attribute else None
        value = 3 if value is None else value  # the schema's default
        if not 0 <= value <= _MOST_DEGREE:
            raise InputError(f"{_DEGREE}: expected 0..{_MOST_DEGREE}, got {value}")
        return value

    def note(self, words: str) -> None:
        self._found.notes[words] = None


def _read_prim(prim: Any, values: _Values) -> Fields:
    """Read the fields of a prim in its own axes."""
    means = values.rows("positions", 3)
    if means is None or not len(means):
        raise InputError("expected positions, got none; export it again")
    count = len(means)
    turns, scales = values.rows("orientations", 4, count), values.rows("scales", 3, count)
    opacities = values.rows("opacities", 1, count)
    degree = values.degree()
    each = (degree + 1) ** 2
    harmonics = values.rows(_HARMONICS, 3, count * each)
    if harmonics is None:
        sh = np.zeros((count, 1, 3), np.float32)
        values.note("there are no harmonics of all Gaussians: they are grey")
    else:
        sh = harmonics.reshape(count, each, 3)
    if degree >= len(SH_COEFFICIENTS):
        sh = sh[:, : SH_COEFFICIENTS[-1]]
        values.note(
            HIGH_DEGREE_NOTE if degree == len(SH_COEFFICIENTS) else f"harmonics of degree {degree} are cut to 3"
        )
    if values.is_linear():
        values.note(LINEAR_NOTE)
        sh = encode_light(sh)
    if scales is None:
        scales = np.ones((count, 3), np.float32)
    if prim.GetTypeName() == _FIELD and _DISC in str(prim.GetMetadata("apiSchemas")):
        scales[:, 2] = 0
        values.note("surflets are drawn as flat discs")
    shown_part = np.ones(count, np.float32) if opacities is None else opacities[:, 0]
    shown_part = np.where((shown_part < 0) | (shown_part > 1), np.float32(np.nan), shown_part)
    return {
        "means": means,
        "quaternions": np.tile(np.array([1, 0, 0, 0], np.float32), (count, 1))
        if turns is None
        else np.roll(turns, 1, axis=1),
        "scales": scales,
        "opacities": shown_part,
        "sh": np.ascontiguousarray(sh),
    }


# Writing


def write(path: str | Path, fields: Fields, origin: Origin, comments: Sequence[str] = ()) -> list[str]:
    """Write float64 fields of N >= 1 valid Gaussians as float32; return losses, see files.write_arrays."""
    path = Path(path)
    with named(path):
        usd = import_usd()
        stage = _make_stage(usd, fields, origin, comments)
    with atomic_path(path) as temporary:
        try:
            _export(usd, stage, temporary)
        except usd.Tf.ErrorException as error:
            raise InputError(f"cannot write {path}: {_reason(error)}") from None
    lost = up_losses(comments, "OpenUSD")
    if is_antialiased(comments):
        lost.append("OpenUSD cannot say that it was trained with anti-aliasing: only this program reads it")
    return lost


def _export(usd: Any, stage: Any, path: Path) -> None:
    """Write a stage: text, binary, or binary in a ZIP, by the name of the file."""
    if path.suffix.lower() != ".usdz":
        stage.GetRootLayer().Export(str(path))
        return
    with scratch_folder(path) as folder:
        inside = folder / "scene.usdc"
        stage.GetRootLayer().Export(str(inside))
        with usd.Sdf.ZipFileWriter.CreateNew(str(path)) as archive:
            archive.AddFile(str(inside), inside.name)


def _make_stage(usd: Any, fields: Fields, origin: Origin, comments: Sequence[str]) -> Any:
    """Return a stage in memory."""
    sdf, vt = usd.Sdf, usd.Vt
    stage = usd.Usd.Stage.CreateInMemory()
    usd.UsdGeom.SetStageUpAxis(stage, usd.UsdGeom.Tokens.y)
    usd.UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    prim = stage.DefinePrim("/gaussians", SPLAT)
    stage.SetDefaultPrim(prim)
    if comments:
        stage.GetRootLayer().customLayerData = {_KEY: {"comments": vt.StringArray(list(comments))}}
    means = (fields["means"] * Y_UP_TURN).astype(np.float32)
    turns = fields["quaternions"] * np.append(1.0, Y_UP_TURN)
    turns = np.roll(turns / np.linalg.norm(turns, axis=1, keepdims=True), -1, axis=1)  # the real part is last
    reach = 3 * fields["scales"].max(1, keepdims=True)
    extent = np.stack([(means - reach).min(0), (means + reach).max(0)])
    sh = (fields["sh"] * Y_UP_SIGNS[: fields["sh"].shape[1]]).reshape(-1, 3)
    types = sdf.ValueTypeNames
    columns = {
        "extent": (types.Float3Array, vt.Vec3fArray, extent),
        "positions": (types.Point3fArray, vt.Vec3fArray, means),
        "orientations": (types.QuatfArray, vt.QuatfArray, turns),
        "scales": (types.Float3Array, vt.Vec3fArray, fields["scales"]),
        "opacities": (types.FloatArray, vt.FloatArray, fields["opacities"]),
        _HARMONICS: (types.Float3Array, vt.Vec3fArray, sh),
    }
    for name, (kind, array, numbers) in columns.items():
        values = array.FromNumpy(np.ascontiguousarray(numbers, np.float32))
        prim.CreateAttribute(name, kind, False).Set(values)
    degree = SH_COEFFICIENTS.index(fields["sh"].shape[1])
    prim.CreateAttribute(_DEGREE, types.Int, False, sdf.VariabilityUniform).Set(degree)
    if any(origin):
        shift = (np.array(origin) * Y_UP_TURN + 0.0).tolist()
        usd.UsdGeom.Xformable(prim).AddTranslateOp().Set(usd.Gf.Vec3d(*shift))
    return stage
