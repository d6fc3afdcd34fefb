"""Gaussians and their .ply: hand-written bytes, files of other programs, and files that lie."""

import math
import struct

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from lightfield_gs.base.errors import InputError
from lightfield_gs.io.scenes.files import read_scene
from lightfield_gs.scene.gaussians import Gaussians

NAMES = [
    "x",
    "y",
    "z",
    "f_dc_0",
    "f_dc_1",
    "f_dc_2",
    "opacity",
    "scale_0",
    "scale_1",
    "scale_2",
    "rot_0",
    "rot_1",
    "rot_2",
    "rot_3",
]
VALUES = {
    "x": 1.5,
    "y": -2.0,
    "z": 3.25,
    "f_dc_0": 0.1,
    "f_dc_1": 0.2,
    "f_dc_2": 0.3,
    "opacity": 0.0,
    "scale_0": math.log(0.5),
    "scale_1": math.log(0.25),
    "scale_2": 0.0,
    "rot_0": 0.5,
    "rot_1": -0.5,
    "rot_2": 0.25,
    "rot_3": 1.0,
}


def write(
    path,
    names=NAMES,
    rows=(VALUES,),
    count=None,
    kind="float",
    extra="",
    tail=b"",
    first="ply\nformat binary_little_endian 1.0\n",
):
    """A .ply written by hand, one row a Gaussian."""
    code = {"float": "f", "double": "d"}[kind]
    header = first + f"element vertex {len(rows) if count is None else count}\n"
    header += "".join(f"property {kind} {name}\n" for name in names) + extra + "end_header\n"
    body = b"".join(struct.pack("<" + code * len(names), *(row[name] for name in names)) for row in rows)
    path.write_bytes(header.encode() + body + tail)
    return path


def random_gaussians(count=20, degree=3, seed=0) -> Gaussians:
    r = torch.Generator().manual_seed(seed)
    return Gaussians(
        torch.randn(count, 3, generator=r),
        torch.randn(count, 4, generator=r),
        torch.rand(count, 3, generator=r) + 1e-3,
        torch.rand(count, generator=r) * 0.99 + 0.005,
        torch.randn(count, (degree + 1) ** 2, 3, generator=r),
    )


@pytest.mark.parametrize("kind", ["float", "double"])
@pytest.mark.parametrize("order", [1, -1])
def test_hand_written_bytes(tmp_path, kind, order):
    scene = Gaussians.load(write(tmp_path / "a.ply", NAMES[::order], kind=kind))
    assert scene.count == 1 and scene.sh_degree == 0 and scene.dtype == torch.float32
    assert scene.means.tolist() == [[1.5, -2.0, 3.25]]
    assert scene.quaternions.tolist() == [[0.5, -0.5, 0.25, 1.0]]
    assert scene.scales.tolist() == [pytest.approx([0.5, 0.25, 1.0])]
    assert scene.opacities.tolist() == [0.5]
    assert scene.sh.tolist() == [[pytest.approx([0.1, 0.2, 0.3])]]


def test_rest_is_channel_by_channel(tmp_path):
    names = NAMES + [f"f_rest_{i}" for i in range(9)]
    scene = Gaussians.load(write(tmp_path / "a.ply", names, [{**VALUES, **{f"f_rest_{i}": i for i in range(9)}}]))
    assert scene.sh_degree == 1
    assert scene.sh[0, 1:].tolist() == [[0, 3, 6], [1, 4, 7], [2, 5, 8]]  # red 0 1 2, green 3 4 5, blue 6 7 8


def test_other_elements_and_properties_are_ignored(tmp_path):
    first = (
        "ply\r\nformat binary_little_endian 1.0\r\ncomment made by hand\r\nelement thing 2\r\n"
        "property uchar a\r\nproperty short b\r\n"
    )
    names = ["nx", *NAMES, "extra"]
    row = {**VALUES, "nx": math.nan, "extra": math.inf}
    path = write(
        tmp_path / "a.ply",
        names,
        [row],
        first=first,
        tail=b"\x02\1\0\0\0\2\0\0\0",
        extra="property uchar red\nelement face 1\nproperty list uchar int v\n",
    )
    text = path.read_bytes()
    cut = text.index(b"end_header\n") + 11
    path.write_bytes(text[:cut] + bytes(6) + text[cut : cut + 64] + b"\xff" + text[cut + 64 :])
    assert Gaussians.load(path).means.tolist() == [[1.5, -2.0, 3.25]]


def test_opacities_and_scales_stay_in_range(tmp_path):
    rows = [{**VALUES, "opacity": value, "scale_0": scale} for value, scale in ((40, -300), (-200, 0), (17.5, 5))]
    scene = Gaussians.load(write(tmp_path / "a.ply", rows=rows))
    assert scene.opacities[0] == 1 and 0 < scene.opacities[1] < 1e-30 and scene.scales[0, 0] > 0
    scene.validate()
    scene.save(tmp_path / "b.ply")
    again = Gaussians.load(tmp_path / "b.ply")
    assert again.opacities[0] == 1 and torch.allclose(again.opacities, scene.opacities, atol=0, rtol=1e-5)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_round_trip(tmp_path, degree, dtype):
    scene = random_gaussians(degree=degree)
    scene.to(dtype).save(tmp_path / "a.ply")
    again = Gaussians.load(tmp_path / "a.ply")
    for name in ("means", "quaternions", "sh"):
        assert torch.equal(getattr(again, name), getattr(scene, name))
    assert torch.allclose(again.scales, scene.scales, rtol=1e-6, atol=0)
    assert torch.allclose(again.opacities, scene.opacities, rtol=1e-6, atol=0)
    assert [p.name for p in tmp_path.iterdir()] == ["a.ply"]


def test_real_capture(shared_dir):
    """Values read by hand: little-endian floats at the record's offsets of guitar.ply."""
    path = shared_dir / "data/gaussians/guitar.ply"
    data = path.read_bytes()
    start = data.index(b"end_header\n") + 11
    scene = Gaussians.load(path)
    assert (scene.count, scene.sh_degree) == (90854, 0)
    for index in (0, 12345, 90853):
        record = struct.unpack_from("<17f", data, start + 68 * index)
        assert scene.means[index].tolist() == list(record[:3])
        assert scene.sh[index, 0].tolist() == list(record[6:9])
        assert scene.opacities[index].item() == pytest.approx(1 / (1 + math.exp(-record[9])), rel=1e-6)
        assert scene.scales[index].tolist() == pytest.approx([math.exp(v) for v in record[10:13]], rel=1e-6)
        assert scene.quaternions[index].tolist() == list(record[13:])
    scene.validate()


def test_same_gaussians_as_a_splat_file(shared_dir):
    """Three Gaussians in two formats: .splat has 32-byte records of position, scale, RGBA bytes, rotation bytes."""
    folder = shared_dir / "data/gaussians/three-formats"
    scene = Gaussians.load(next(folder.glob("*.ply")))
    data = next(folder.glob("*.splat")).read_bytes()
    assert (scene.count, scene.sh_degree) == (3, 3)
    found = set()
    for offset in range(0, len(data), 32):
        values = struct.unpack_from("<6f8B", data, offset)
        index = int((scene.means - torch.tensor(values[:3])).norm(dim=1).argmin())
        found.add(index)
        assert scene.means[index].tolist() == pytest.approx(values[:3], abs=1e-5)
        assert scene.scales[index].tolist() == pytest.approx(values[3:6], rel=1e-4)
        assert (scene.opacities[index] * 255).item() == pytest.approx(values[9], abs=1)
        colour = (0.5 + 0.28209479177387814 * scene.sh[index, 0]).clamp(0, 1) * 255
        assert colour.tolist() == pytest.approx(values[6:9], abs=1)
        unit = scene.quaternions[index] / scene.quaternions[index].norm()
        stored = torch.tensor(values[10:]) / 128 - 1
        assert abs((unit * stored / stored.norm()).sum()) == pytest.approx(1, abs=2e-3)
    assert found == {0, 1, 2}


def test_comments_and_small_elements_are_kept(tmp_path):
    first = (
        "ply\nformat binary_little_endian 1.0\ncomment  by M\u00fcller\u2028& end_header\n"
        "obj_info Vertical Axis: z\nelement face 2\nproperty list uchar int v\nproperty uchar flag\n"
    )
    extra = "element size 2\nproperty uint px\nelement big 16385\nproperty int v\n"
    path = write(tmp_path / "a.ply", first=first, extra=extra, tail=struct.pack("<2I", 640, 480) + bytes(65540) + b"\n")
    data = path.read_bytes()
    start = data.index(b"\nend_header\n") + 12
    faces = struct.pack("<BiB", 1, 7, 0) + struct.pack("<B3iB", 3, 0, 1, 2, 9)
    path.write_bytes(data[:start] + faces + data[start:])
    file = read_scene(path)
    assert file.gaussians.means.tolist() == [[1.5, -2.0, 3.25]] and file.notes == []
    assert file.comments == ("by M\u00fcller\u2028& end_header", "Vertical Axis: z")
    assert list(file.elements) == ["size"] and file.elements["size"]["px"].tolist() == [640, 480]


def test_written_comments_come_back(tmp_path):
    texts = ("Vertical Axis: z", "M\u00fcller", "")
    random_gaussians().save(tmp_path / "a.ply", texts)
    assert read_scene(tmp_path / "a.ply").comments == texts
    for bad in ("one\ntwo", "\ud800", "x" * (1 << 16), 3):
        with pytest.raises(InputError, match="comments"):
            random_gaussians().save(tmp_path / "b.ply", [bad])
    with pytest.raises(InputError, match="comments"):
        random_gaussians().save(tmp_path / "b.ply", "text")
    assert not (tmp_path / "b.ply").exists()


BAD_HEADERS = {
    "huge count": (dict(count=10**18), "cut or its header is wrong"),
    "count too large": (dict(count=2), "cut or its header is wrong"),
    "count too small": (dict(count=1, rows=(VALUES, VALUES)), "bytes are left"),
    "no gaussians": (dict(rows=()), "no Gaussians"),
    "negative count": (dict(count=-1), "header line"),
    "overlong count": (dict(count=10**40), "header line"),
    "ascii": (dict(first="ply\nformat ascii 1.0\n"), "cannot read the rows|cut or its header"),
    "unknown format": (dict(first="ply\nformat binary_middle_endian 1.0\n"), "binary_little_endian"),
    "no format": (dict(first="ply\n"), "binary_little_endian"),
    "other file": (dict(first="PNG\n"), "does not begin"),
    "missing": (dict(names=NAMES[:-2]), "missing rot_2, rot_3"),
    "odd rest": (dict(extra="property float f_rest_0\n", tail=bytes(4)), "1 properties f_rest"),
    "gap in rest": (
        dict(extra="".join(f"property float f_rest_{i}\n" for i in range(1, 10)), tail=bytes(36)),
        "f_rest",
    ),
    "twice": (dict(names=NAMES + ["x"]), "twice"),
    "unknown type": (dict(extra="property quad q\n"), "header line"),
    "stray line": (dict(extra="hello\n"), "header line"),
    "list in vertex": (dict(extra="property list uchar int v\n"), "list"),
    "lists before": (
        dict(first="ply\nformat binary_little_endian 1.0\nelement face 1\nproperty list uchar int v\n"),
        "cut or its header",
    ),
    "huge element before": (
        dict(first="ply\nformat binary_little_endian 1.0\nelement a 99999999999\nproperty int v\n"),
        "cut or its header",
    ),
    "mesh": (dict(names=["x", "y", "z"]), "missing f_dc_0"),
}


@pytest.mark.parametrize("case", BAD_HEADERS)
def test_hostile_headers(tmp_path, case):
    arguments, words = BAD_HEADERS[case]
    with pytest.raises(InputError, match=words) as caught:
        Gaussians.load(write(tmp_path / "a.ply", **arguments))
    assert "\n" not in str(caught.value) and "a.ply" in str(caught.value)


@pytest.mark.parametrize("name", ["x", "f_dc_1", "opacity", "scale_2", "rot_0"])
@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_values_that_have_no_meaning_are_named(tmp_path, name, value):
    path = write(tmp_path / "a.ply", rows=[VALUES, VALUES, {**VALUES, name: value}])
    if name == "opacity" and math.isinf(value) or (name, value) == ("scale_2", -math.inf):
        Gaussians.load(path).validate()
        return
    with pytest.raises(InputError, match=f"{name} of Gaussian 2 is"):
        Gaussians.load(path)


def test_overflow_and_zero_rotation(tmp_path):
    for change, words in (({"scale_1": 200.0}, "scale_1 of Gaussian 0"), (dict.fromkeys(NAMES[-4:], 0.0), "all zero")):
        with pytest.raises(InputError, match=words):
            Gaussians.load(write(tmp_path / "a.ply", rows=[{**VALUES, **change}]))
    with pytest.raises(InputError, match="x of Gaussian 0"):  # too large for float32
        Gaussians.load(write(tmp_path / "a.ply", rows=[{**VALUES, "x": 1e300}], kind="double"))


@pytest.mark.parametrize(
    "data",
    [b"", b"ply\n", b"ply\nformat binary_little_endian 1.0\nelement vertex 1\n" * 2000, b"ply\n\xff\xfe\nend_header\n"],
)
def test_damaged_headers(tmp_path, data):
    path = tmp_path / "a.ply"
    path.write_bytes(data)
    with pytest.raises(InputError):
        Gaussians.load(path)
    with pytest.raises(InputError, match="cannot read"):
        Gaussians.load(tmp_path / "absent.ply")
    with pytest.raises(InputError, match=r"folder with one scene in it; give .*a\.ply"):
        Gaussians.load(tmp_path)


@settings(max_examples=150, deadline=None)
@given(st.data())
def test_damage_is_never_anything_but_an_input_error(tmp_path_factory, data):
    path = write(tmp_path_factory.mktemp("fuzz") / "a.ply", rows=[VALUES] * 3)
    text = bytearray(path.read_bytes())
    for _ in range(data.draw(st.integers(1, 4))):
        text[data.draw(st.integers(0, len(text) - 1))] = data.draw(st.integers(0, 255))
    path.write_bytes(text[: data.draw(st.integers(0, len(text)))] if data.draw(st.booleans()) else text)
    try:
        Gaussians.load(path).validate()
    except InputError as error:
        assert "\n" not in str(error)


# Writing


def test_nothing_half_written(tmp_path):
    scene = random_gaussians()
    scene.scales[3, 1] = 0
    with pytest.raises(InputError, match=r"scales\[3, 1\]"):
        scene.save(tmp_path / "a.ply")
    with pytest.raises(InputError, match="no folder"):
        random_gaussians().save(tmp_path / "none/a.ply")
    with pytest.raises(InputError, match="batch"):
        Gaussians(*(t[None] for t in random_gaussians().fields().values())).save(tmp_path / "a.ply")
    with pytest.raises(InputError, match="no Gaussians to write"):
        Gaussians(*(t[:0] for t in random_gaussians().fields().values())).save(tmp_path / "a.ply")
    assert list(tmp_path.iterdir()) == []


# The dataclass


@pytest.mark.parametrize(
    "field, index, value, words",
    [
        ("means", (4, 1), math.nan, r"means\[4, 1\].*finite"),
        ("sh", (2, 3, 0), math.inf, r"sh\[2, 3, 0\]"),
        ("scales", (1, 2), -1.0, r"scales\[1, 2\].*> 0"),
        ("opacities", (7,), 1.5, r"opacities\[7\].*0..1"),
        ("opacities", (7,), -0.1, r"opacities\[7\]"),
        ("quaternions", (9,), 0.0, r"quaternions\[9\].*zero"),
    ],
)
def test_validate_names_the_first_bad_index(field, index, value, words):
    scene = random_gaussians()
    getattr(scene, field)[index] = value
    with pytest.raises(InputError, match=words):
        scene.validate()


@pytest.mark.parametrize(
    "change, words",
    [
        (dict(means=torch.zeros(20)), "means: expected shape"),
        (dict(means=torch.zeros(20, 4)), "means: expected shape"),
        (dict(quaternions=torch.zeros(19, 4)), "quaternions: expected shape"),
        (dict(opacities=torch.zeros(20, 1)), "opacities"),
        (dict(sh=torch.zeros(20, 3)), "sh"),
        (dict(sh=torch.zeros(20, 5, 3)), "1, 4, 9 or 16"),
        (dict(scales=torch.ones(20, 3, dtype=torch.float64)), "scales: expected torch.float32"),
        (dict(means=torch.zeros(20, 3, dtype=torch.int32)), "float32 or float64"),
        (dict(sh=np.zeros((20, 1, 3))), "torch.Tensor"),
        (dict(scales=torch.ones(20, 3, device="meta")), "on cpu"),
    ],
)
def test_validate_layout(change, words):
    with pytest.raises(InputError, match=words):
        Gaussians(**{**random_gaussians().fields(), **change}).validate()


def test_properties_and_conversions():
    scene = random_gaussians(degree=2)
    scene.sh.requires_grad_()
    batch = Gaussians(*(tensor[None] for tensor in scene.fields().values())).validate()
    assert (batch.is_batched, scene.is_batched, batch.count, batch.sh_degree) == (True, False, 20, 2)
    assert scene.to(torch.float64).dtype == torch.float64 and scene.device.type == "cpu"
    assert not scene.detach().sh.requires_grad
