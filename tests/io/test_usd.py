"""OpenUSD with Gaussians: against text packed by hand, the geometry of its prims, and the schema of usd-core."""

import sys

import numpy as np
import pytest
import scene_formats as made
import torch
from command_line import PANEL, complaint, run, scene
from test_gltf import close, colours, covariances
from test_scene_formats import difference, expected

from lightfield_gs import Gaussians, InputError
from lightfield_gs.base.arrays import encode_srgb
from lightfield_gs.base.harmonics import spiral
from lightfield_gs.io.scenes.files import read_scene, write_scene

UsdVol = pytest.importorskip("pxr.UsdVol", reason="needs the extra `usd`")
SPLAT = "ParticleField3DGaussianSplat"
STAGE = '(\n upAxis = "{up}"\n{unit})\n'


def rows(numbers) -> str:
    flat = np.asarray(numbers, float)
    if flat.ndim == 1:
        return "[" + ", ".join(f"{value:.9g}" for value in flat) + "]"
    return "[" + ", ".join("(" + ", ".join(f"{value:.9g}" for value in row) + ")" for row in flat) + "]"


def values(degree=3, half=False):
    """The attributes of the four Gaussians by name, as text, in the axes right, up, back; quaternions are wxyz."""
    count, kind, h = (degree + 1) ** 2 - 1, "h" if half else "f", "h" if half else ""
    numbers = "half" if half else "float"
    first = np.array([made.dc(colour) for colour in made.COLOURS])[:, None]
    sh = np.concatenate([first, made.FLIPPED_REST[:, :count]], 1).reshape(-1, 3)
    return {
        "positions": f"point3{kind}[] positions{h} = {rows(np.array(made.MEANS) * (1, -1, -1))}",
        "orientations": f"quat{kind}[] orientations{h} = {rows(np.array(made.ROTATIONS) * (1, 1, -1, -1))}",
        "scales": f"{numbers}3[] scales{h} = {rows(np.exp(made.LOG_SCALES))}",
        "opacities": f"{numbers}[] opacities{h} = {rows(made.OPACITIES)}",
        "degree": f"uniform int radiance:sphericalHarmonicsDegree = {degree}",
        "sh": f"{numbers}3[] radiance:sphericalHarmonicsCoefficients{h} = {rows(sh)}",
    }


def prim(attributes=None, kind=SPLAT, head="", more="") -> str:
    lines = (values() if attributes is None else attributes).values()
    return f'def {kind} "splat" {head}\n{{\n' + "\n".join(lines) + f"\n{more}\n}}\n"


def load(tmp_path, body, up="Y", unit=""):
    (tmp_path / "a.usda").write_text("#usda 1.0\n" + STAGE.format(up=up, unit=unit) + body)
    return read_scene(tmp_path / "a.usda")


@pytest.mark.parametrize("degree", [0, 2, 3])
def test_a_usda_gives_what_was_packed(degree, tmp_path):
    read = load(tmp_path, prim(values(degree)))
    close(read.gaussians.validate(), expected(degree))
    assert read.notes == [] and "OpenUSD" in read.kind and read.comments == ("Vertical Axis: -y",)


def test_half_floats_are_read_and_full_ones_preferred(tmp_path):
    half = load(tmp_path, prim(values(1, half=True)))
    found = difference(half.gaussians, expected(1))
    assert 0 < found["scales"] < 1e-3 and found["means"] < 1e-3 and found["rest"] < 1e-3
    both = {**values(1), **{f"{name}h": line for name, line in values(1, half=True).items() if name != "degree"}}
    close(load(tmp_path, prim(both)).gaussians, expected(1))


def test_up_axis_and_unit_of_the_stage_count(tmp_path):
    read = load(tmp_path, prim(), up="Z", unit=" metersPerUnit = 0.01\n")
    assert read.notes == ["lengths are times 0.01, in metres (metersPerUnit)"]
    # The stage's right, forward, up: its y is a .ply's forward, and its z is up
    linear = torch.tensor([[1, 0, 0], [0, 0, -1], [0, 1, 0.0]]).double() @ torch.diag(
        torch.tensor([1, -1, -1.0]).double()
    )
    given, found = expected(3), read.gaussians
    assert torch.allclose(found.means.double(), 0.01 * given.means.double() @ linear.T, atol=1e-7)
    assert torch.allclose(covariances(found), 1e-4 * linear @ covariances(given) @ linear.T, rtol=1e-4, atol=1e-12)
    directions = torch.from_numpy(spiral(40))
    assert torch.allclose(colours(found, directions @ linear.T), colours(given, directions), atol=1e-5)


def test_transforms_place_the_prims_and_hidden_ones_are_left_out(tmp_path):
    moved = (
        "double3 xformOp:translate = (5000000, 2, 3)\nfloat xformOp:rotateZ = 90\nfloat3 xformOp:scale = (2, 2, 2)\n"
    )
    moved += 'uniform token[] xformOpOrder = ["xformOp:translate", "xformOp:rotateZ", "xformOp:scale"]\n'
    hidden = prim(values(0), more='token visibility = "invisible"').replace("splat", "hidden")
    mesh = 'def Mesh "mesh" {}\ndef Xform "x" {}\n'
    body = 'def Xform "world" {\n' + moved + prim() + hidden + mesh + "}\n"
    read = load(tmp_path, body)
    turn = np.diag([1.0, -1, -1])
    linear = torch.from_numpy(turn @ (2 * np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1.0]])) @ turn)
    given, found = expected(3), read.gaussians
    means = given.means.double() @ linear.T + torch.tensor([5e6, -2, -3]).double()
    assert any(found.origin) and torch.allclose(found.means.double() + torch.tensor(found.origin), means, atol=1e-5)
    assert torch.allclose(covariances(found), linear @ covariances(given) @ linear.T, rtol=1e-4, atol=1e-7)
    assert read.notes == [
        "1 prim of Gaussians is invisible in the stage and left out",
        "1 prim of other geometry is left out: the Gaussians alone are drawn",
    ]
    found.save(tmp_path / "b.usdc")
    again = Gaussians.load(tmp_path / "b.usdc")
    places = [each.means.double() + torch.tensor(each.origin) for each in (again, found)]
    assert torch.allclose(*places, rtol=0, atol=1e-6)


def test_absent_and_short_values_have_the_defaults_of_the_schema(tmp_path):
    read = load(tmp_path, prim({"positions": values()["positions"], "scales": "float3[] scales = [(1, 2, 3)]"}))
    found = read.gaussians
    assert found.scales.tolist() == [[1, 1, 1]] * 4 and found.opacities.tolist() == [1] * 4
    assert found.quaternions.tolist() == [[1, 0, 0, 0]] * 4 and not found.sh.any()
    assert sorted(note.split()[0] for note in read.notes) == ["scales", "there"]


def test_fields_of_applied_kernels_are_read(tmp_path):
    disc = prim(values(0), "ParticleField", '(prepend apiSchemas = ["ParticleFieldKernelGaussianSurfletAPI"])')
    read = load(tmp_path, disc)
    assert read.gaussians.scales[:, 2].max() < 1e-30 and read.notes == ["surflets are drawn as flat discs"]
    other = prim(values(0), "ParticleField", '(prepend apiSchemas = ["ParticleFieldKernelConstantSurfletAPI"])')
    with pytest.raises(InputError, match="1 prim of other geometry; .*lightfield-gs fit"):
        load(tmp_path, other)


def test_values_that_vary_are_read_at_one_time(tmp_path):
    lines = values(0)
    means = [np.array(made.MEANS) * (1, -1, -1) + (number, 0, 0) for number in (0, 1)]
    lines["positions"] = f"point3f[] positions.timeSamples = {{ 10: {rows(means[0])}, 20: {rows(means[1])} }}"
    read = load(tmp_path, prim(lines))
    close(read.gaussians, expected(0))
    assert read.notes == ["it moves, and is drawn at its time 10 (another: time=)"]
    later = read_scene(tmp_path / "a.usda", time=20.0).gaussians
    assert torch.allclose(later.means, expected(0).means + torch.tensor([1.0, 0, 0]))


def test_linear_light_is_converted_to_srgb(tmp_path):
    lines = values(0)
    lines["sh"] += ' (colorSpace = "lin_rec709_scene")'
    read = load(tmp_path, prim(lines))
    found = 0.5 + made.C0 * read.gaussians.sh[:, 0].double().numpy()
    assert np.allclose(found, encode_srgb(np.array(made.COLOURS)), atol=1e-6) and "linear light" in read.notes[0]


# Writing


@pytest.mark.parametrize("suffix", [".usd", ".usda", ".usdc", ".usdz"])
def test_what_is_written_is_read_again_to_float32(suffix, tmp_path):
    given = scene(300)
    lost = write_scene(given, tmp_path / f"b{suffix}", ["by hand"])
    read = read_scene(tmp_path / f"b{suffix}")
    close(read.gaussians, given, 1e-6)
    assert lost == [] and read.comments == ("Vertical Axis: -y", "by hand") and read.notes == []


def test_the_schema_knows_what_is_written(tmp_path):
    from pxr import Usd, UsdGeom

    expected(3).save(tmp_path / "a.usda")
    stage = Usd.Stage.Open(str(tmp_path / "a.usda"))
    own = stage.GetDefaultPrim()
    assert own.IsA(getattr(UsdVol, SPLAT)) and own.HasAPI(UsdVol.ParticleFieldSphericalHarmonicsAttributeAPI)
    known = own.GetPrimDefinition()
    for attribute in own.GetAuthoredAttributes():
        name = attribute.GetName()
        assert attribute.GetTypeName() == known.GetAttributeDefinition(name).GetTypeName(), name
        assert attribute.GetVariability() == known.GetAttributeDefinition(name).GetVariability(), name
    assert UsdGeom.GetStageUpAxis(stage) == "Y" and UsdGeom.GetStageMetersPerUnit(stage) == 1
    low, high = np.array(UsdGeom.Boundable(own).GetExtentAttr().Get())
    assert (low < np.array(made.MEANS).min(0) * (1, 0, 0)).any() and (high > low).all()


def test_three_formats_of_one_scene_agree_with_openusd(shared_dir, tmp_path):
    given = Gaussians.load(shared_dir / "data/gaussians/three-formats/test-splat.3-points-from-train.ply")
    given.save(tmp_path / "a.usdc")
    close(Gaussians.load(tmp_path / "a.usdc"), given, 1e-6)


def test_commands_take_and_keep_openusd_with_its_framing(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    PANEL.to_yaml("p.yaml")
    scene().save("s.ply")
    run(capsys, "encode s.ply -o a.png --panel p.yaml --device cpu --save-gaussians s.usdz")
    run(capsys, "encode s.usdz -o b.png --panel p.yaml --device cpu")
    from lightfield_gs.io.images import read_image

    assert np.abs(read_image("a.png").astype(int) - read_image("b.png").astype(int)).max() <= 1


# Refusals


@pytest.mark.parametrize("is_old", [False, True])
def test_without_the_package_or_with_an_old_one_one_command_is_named(is_old, tmp_path, monkeypatch, capsys):
    (tmp_path / "a.usda").write_text("#usda 1.0\n")
    if is_old:  # before 26.3
        monkeypatch.delattr(UsdVol, SPLAT)
    else:
        monkeypatch.setitem(sys.modules, "pxr", None)
    for line in (f"info {tmp_path}/a.usda", f"encode {tmp_path}/a.usda -o {tmp_path}/o.png --panel toy-8v"):
        assert "pip install --upgrade 'lightfield-gs[usd]'" in complaint(capsys, line)
    with pytest.raises(InputError, match="b.usdc: .*lightfield-gs.usd."):
        write_scene(scene(), tmp_path / "b.usdc")
    assert not (tmp_path / "b.usdc").exists()


DAMAGED = {
    "text": ("a.usda", b"#usda 1.0\ndef Foo(", "cannot be read as OpenUSD"),
    "binary": ("a.usdc", b"PXR-USDC" + bytes(100), "cannot be read as OpenUSD"),
    "zip": ("a.usdz", made.zipped({"a.txt": b""}), "cannot be read as OpenUSD"),
    "empty": ("a.usda", b"#usda 1.0\n", "OpenUSD without Gaussians"),
    "renamed": ("a.png", b"#usda 1.0\n", "rename it to end in .usd"),
    "columns": (
        "a.usda",
        b"#usda 1.0\n" + prim({**values(0), "scales": "float2[] scales = [(1, 1)]"}).encode(),
        "/splat: scales: expected rows of 3 numbers",
    ),
    "nothing": ("a.usda", b"#usda 1.0\n" + prim({}).encode(), "/splat: expected positions, got none"),
    "degree": (
        "a.usda",
        b"#usda 1.0\n" + prim({**values(0), "degree": "uniform int radiance:sphericalHarmonicsDegree = 99"}).encode(),
        "expected 0..4, got 99",
    ),
    "opacity": (
        "a.usda",
        b"#usda 1.0\n" + prim({**values(0), "opacities": "float[] opacities = [1, 2, 1, 1]"}).encode(),
        "an opacity that is no number",
    ),
    "unit": ("a.usda", b"#usda 1.0\n(\n metersPerUnit = -1\n)\n" + prim().encode(), "metersPerUnit"),
}


@pytest.mark.parametrize("name", DAMAGED)
def test_damaged_files_are_refused_in_a_line(name, tmp_path):
    path, content, words = DAMAGED[name]
    (tmp_path / path).write_bytes(content)
    with pytest.raises(InputError, match=words) as found:
        read_scene(tmp_path / path)
    assert "\n" not in str(found.value) and path in str(found.value)
    assert len(str(found.value)) < 500
