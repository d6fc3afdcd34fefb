"""glTF with Gaussians: against bytes packed by hand, the geometry of its nodes, and a reader of another program."""

import math

import gltf_maker
import numpy as np
import pytest
import scene_formats as made
import torch
from command_line import PANEL, run, scene
from gltf_maker import KHR, Gltf, attributes
from test_scene_formats import difference, expected, zstd

from lightfield_gs import Gaussians, InputError
from lightfield_gs.base.arrays import encode_srgb
from lightfield_gs.base.harmonics import harmonics, rotations, spiral
from lightfield_gs.io.scenes.files import read_scene, write_scene


def close(one, other, within=1e-6):
    assert max(difference(one, other).values()) <= within, difference(one, other)


def load(tmp_path, gltf):
    (tmp_path / "a.glb").write_bytes(gltf.glb())
    return read_scene(tmp_path / "a.glb")


@pytest.mark.parametrize("degree", [0, 1, 3])
def test_a_glb_gives_what_was_packed(degree, tmp_path):
    read = load(tmp_path, Gltf().gaussians(attributes(degree)))
    close(read.gaussians.validate(), expected(degree))
    assert read.notes == [] and read.gaussians.sh_degree == degree and "glTF (KHR_gaussian_splatting)" in read.kind


def test_a_gltf_has_its_data_inside_or_beside_it(tmp_path):
    made_of = Gltf().gaussians()
    (tmp_path / "inside.gltf").write_bytes(made_of.gltf())
    (tmp_path / "beside.gltf").write_bytes(made_of.gltf("its%20data.bin"))
    with pytest.raises(InputError, match="its data.bin.*not beside it"):
        read_scene(tmp_path / "beside.gltf")
    (tmp_path / "its data.bin").write_bytes(made_of.data)
    for name in ("inside.gltf", "beside.gltf"):
        close(read_scene(tmp_path / name).gaussians, expected(3))


def test_numbers_may_be_small_integers_and_rows_interleaved(tmp_path):
    gltf = Gltf()
    columns = attributes(0)
    rotation = gltf.accessor(columns.pop(f"{KHR}:ROTATION"), "<i2", True)
    opacity = gltf.accessor(columns.pop(f"{KHR}:OPACITY"), "<u1", True)
    rows = np.concatenate([columns["POSITION"], columns[f"{KHR}:SCALE"]], 1).astype("<f4")
    view = gltf.view(rows.tobytes())
    gltf.root["bufferViews"][view]["byteStride"] = 24
    for start in (0, 12):
        found = {"bufferView": view, "byteOffset": start, "componentType": 5126, "count": 4, "type": "VEC3"}
        gltf.root["accessors"].append(found)
    at = len(gltf.root["accessors"])
    columns |= {"POSITION": at - 2, f"{KHR}:SCALE": at - 1, f"{KHR}:ROTATION": rotation, f"{KHR}:OPACITY": opacity}
    found = difference(load(tmp_path, gltf.gaussians(columns)).gaussians, expected(0))
    assert found["means"] == 0 and found["scales"] < 1e-6 and found["rotations"] < 1e-4 and found["opacities"] < 1e-7


# Nodes


def covariances(gaussians):
    axes = rotations(gaussians.quaternions.double()) * gaussians.scales.double()[:, None]
    return axes @ axes.mT


def colours(gaussians, directions):
    """The colours in directions [P, 3], before the cut at zero, [N, P, 3]."""
    basis = harmonics(directions, gaussians.sh.shape[1]).double()
    return torch.einsum("pk,nkc->npc", basis, gaussians.sh.double())


TURNED = {"rotation": [math.sin(0.4), 0, 0, math.cos(0.4)], "scale": [2, 2, 2], "translation": [1, 2, -3]}
MIRRORED = {"matrix": [0, 0, -1.5, 0, 0, 1.5, 0, 0, -1.5, 0, 0, 0, 3, 1, 0, 1]}  # determinant below 0
STRETCHED = {"scale": [3, 1, 0.5], "translation": [0, 0, 4]}


@pytest.mark.parametrize("below", [TURNED, MIRRORED, STRETCHED])
def test_nodes_place_the_gaussians(below, tmp_path):
    gltf = Gltf().gaussians()
    gltf.root["nodes"] = [{"rotation": [0, 0.6, 0, 0.8], "children": [1]}, {"mesh": 0, **below}]
    found = load(tmp_path, gltf).gaussians.validate()
    about_y = np.array([[0.28, 0, 0.96], [0, 1, 0], [-0.96, 0, 0.28]])
    a, b = math.cos(0.8), math.sin(0.8)
    own = {
        id(TURNED): 2 * np.array([[1, 0, 0], [0, a, -b], [0, b, a]]),
        id(MIRRORED): 1.5 * np.array([[0, 0, -1], [0, 1, 0], [-1, 0, 0]]),
        id(STRETCHED): np.diag([3, 1, 0.5]),
    }[id(below)]
    shift = {id(TURNED): (1, 2, -3), id(MIRRORED): (3, 1, 0), id(STRETCHED): (0, 0, 4)}[id(below)]
    turn = np.diag([1.0, -1, -1])
    linear = torch.from_numpy(turn @ about_y @ own @ turn)  # from a .ply's axes to a .ply's axes
    given = expected(3)
    means = given.means.double() @ linear.T + torch.from_numpy(turn @ about_y @ np.array(shift))
    assert torch.allclose(found.means.double(), means, atol=1e-5)
    assert torch.allclose(covariances(found), linear @ covariances(given) @ linear.T, rtol=1e-4, atol=1e-6)
    directions = torch.from_numpy(spiral(40))
    left, _, right = np.linalg.svd(linear.numpy())
    seen = colours(found, directions @ torch.from_numpy(left @ right).T)
    assert torch.allclose(seen, colours(given, directions), atol=1e-5)


def test_every_primitive_of_the_shown_scene_counts_and_others_are_said(tmp_path):
    gltf = Gltf().gaussians().gaussians(attributes(1))
    triangles = {"attributes": {"POSITION": gltf.accessor(np.eye(3))}}
    gltf.root["meshes"][1]["primitives"].append(triangles)
    gltf.root["meshes"].append({"primitives": [triangles, triangles]})
    gltf.root["nodes"] = [{"mesh": 0, "children": [2]}, {"mesh": 1}, {"mesh": 1}, {"mesh": 0, "translation": [9, 9, 9]}]
    gltf.root |= {"scenes": [{"nodes": [3]}, {"nodes": [0, 1]}], "scene": 1, "animations": [{}]}
    read = load(tmp_path, gltf)
    assert read.gaussians.count == 12 and read.gaussians.sh_degree == 3 and "3 primitives" in read.kind
    assert read.gaussians.means.abs().max() < 5  # the other scene is not shown
    assert [note.split(" ")[0] for note in read.notes] == ["2", "animations"]
    gltf.root["nodes"] = [{"mesh": 2}]
    gltf.root["scenes"] = [{"nodes": [0]}]
    gltf.root["scene"] = 0
    with pytest.raises(InputError, match="2 primitives of meshes or points, and no Gaussians; .*lightfield-gs fit"):
        load(tmp_path, gltf)


def test_copies_of_a_node_are_said(tmp_path):
    gltf = Gltf().gaussians()
    gltf.root["nodes"][0]["extensions"] = {"EXT_mesh_gpu_instancing": {}}
    read = load(tmp_path, gltf)
    assert read.gaussians.count == 4 and "copies by EXT_mesh_gpu_instancing are left out" in read.notes[0]


def test_a_place_far_away_becomes_the_origin(tmp_path):
    gltf = Gltf().gaussians()
    gltf.root["nodes"] = [{"mesh": 0, "translation": [4e6, 1e6 + 0.25, 0]}]
    far = load(tmp_path, gltf).gaussians
    assert torch.allclose(
        far.means.double() + torch.tensor(far.origin),
        expected(3).means + far.means.new_tensor([4e6, -1e6 - 0.25, 0]).double(),
        atol=1e-5,
    )
    write_scene(far, tmp_path / "b.glb")
    again = read_scene(tmp_path / "b.glb").gaussians
    places = [each.means.double() + torch.tensor(each.origin) for each in (again, far)]
    assert torch.allclose(*places, rtol=0, atol=1e-6)


# Drafts and variants


@pytest.mark.parametrize("name", ["spz_2", "spz", "old"])
def test_gaussians_packed_as_spz_are_read(name, tmp_path):
    gltf = Gltf()
    packed = {"bufferView": gltf.view(made.spz(2))}
    promise = {"componentType": 5126, "count": 4, "type": "VEC3"}
    gltf.root["accessors"].append(promise)
    if name == "old":
        own = {"KHR_spz_gaussian_splats_compression": packed}
    else:
        own = {KHR: {**gltf.extension, "extensions": {f"KHR_gaussian_splatting_compression_{name}": packed}}}
    gltf.gaussians({"POSITION": 0}, extensions=own)
    read = load(tmp_path, gltf).gaussians
    (tmp_path / "b.spz").write_bytes(made.spz(2))
    plain = Gaussians.load(tmp_path / "b.spz")
    if name != "old":  # left, up, front: half a turn about the vertical axis, for a .ply's axes too
        plain = plain.rotated([[-1, 0, 0], [0, 1, 0], [0, 0, -1]])
    found = difference(read, plain)  # the axes of an ellipsoid have no sign: quaternions may differ
    assert max(found[name] for name in found if name != "rotations") <= 2e-6
    assert torch.allclose(covariances(read), covariances(plain), rtol=1e-5, atol=1e-8)
    promise["count"] = 5
    with pytest.raises(InputError, match="promise 5 Gaussians, and its SPZ holds 4"):
        load(tmp_path, gltf)


def test_an_spz_of_version_4_is_read_inside(tmp_path):
    gltf = Gltf()
    packed = {"bufferView": gltf.view(made.spz4(zstd().compress, flags=1))}
    gltf.extension["extensions"] = {"KHR_gaussian_splatting_compression_spz_2": packed}
    read = load(tmp_path, gltf.gaussians({}))
    assert read.gaussians.count == 4 and read.comments == ("Vertical Axis: -y", "SplatRenderMode: mip")


def test_scales_of_drafts_are_logarithms_and_colours_in_color_0(tmp_path):
    read = load(tmp_path, Gltf().gaussians({**attributes(0), f"{KHR}:SCALE": np.array(made.LOG_SCALES)}))
    close(read.gaussians, expected(0))
    assert ["logarithms" in note for note in read.notes] == [True]
    gltf, columns = Gltf(), attributes(0)
    del columns[f"{KHR}:OPACITY"], columns[f"{KHR}:SH_DEGREE_0_COEF_0"]
    colour = gltf.accessor(np.concatenate([made.COLOURS, gltf_maker.OPACITIES], 1), "<u1", True)
    read = load(tmp_path, gltf.gaussians({**columns, "COLOR_0": colour}))
    close(read.gaussians, expected(0))
    assert ["COLOR_0" in note for note in read.notes] == [True]


def test_linear_light_is_converted_to_srgb_and_unknown_words_are_said(tmp_path):
    light = np.array([[0.0, 0.002, 0.1], [0.2, 0.4, 0.5], [0.7, 0.9, 1.0], [1.5, 0.25, 0.75]])
    columns = {**attributes(1), f"{KHR}:SH_DEGREE_0_COEF_0": (light - 0.5) / made.C0}
    columns |= {name: 1e-4 * value for name, value in columns.items() if "DEGREE_1" in name}
    read = load(tmp_path, Gltf(colorSpace="lin_rec709_display", kernel="box", sortingMethod="none").gaussians(columns))
    directions = torch.from_numpy(spiral(20))
    linear = (
        np.einsum(
            "pk,nkc->npc",
            harmonics(directions * torch.tensor([1, -1, -1.0]), 4).numpy(),
            np.stack([value for name, value in columns.items() if "SH_" in name], 1),
        )
        + 0.5
    )
    assert np.abs(colours(read.gaussians, directions).numpy() + 0.5 - encode_srgb(linear)).max() < 2e-4
    assert [note.split()[0] for note in read.notes] == ["kernel", "sortingMethod", "its"]


# Writing


@pytest.mark.parametrize("name", ["b.glb", "b.gltf"])
def test_what_is_written_is_read_again_to_float32(name, tmp_path):
    given = scene(300)
    lost = write_scene(given, tmp_path / name, ["by hand", "Vertical Axis: z"])
    read = read_scene(tmp_path / name)
    close(read.gaussians, given, 1e-6)
    assert torch.equal(read.gaussians.means, given.means) and read.comments[1:] == ("by hand", "Vertical Axis: z")
    assert len(lost) == 1 and "on its side" in lost[0]
    with pytest.raises(InputError, match="a .spz holds|expected a name"):
        write_scene(given, tmp_path / "b.ksplat")


def test_another_program_reads_what_is_written(tmp_path):
    pygltflib = pytest.importorskip("pygltflib")
    given = expected(3)
    given.save(tmp_path / "a.glb")
    read = pygltflib.GLTF2().load(str(tmp_path / "a.glb"))
    own = vars(read.meshes[0].primitives[0].attributes)
    blob = read.binary_blob()
    for name, numbers in {**attributes(), "COLOR_0": np.concatenate([made.COLOURS, gltf_maker.OPACITIES], 1)}.items():
        accessor = read.accessors[own[name]]
        view = read.bufferViews[accessor.bufferView]
        stored = blob[view.byteOffset : view.byteOffset + view.byteLength]
        found = np.frombuffer(stored, {5126: "<f4", 5121: "u1"}[accessor.componentType]).reshape(numbers.shape)
        found = found / 255 if accessor.normalized else found
        assert accessor.count == 4 and np.allclose(found, numbers, atol=1e-6), name
    position = read.accessors[own["POSITION"]]
    assert np.allclose([position.min, position.max], [gltf_maker.MEANS.min(0), gltf_maker.MEANS.max(0)])
    assert read.meshes[0].primitives[0].mode == 0 and read.extensionsUsed == [KHR]


def test_three_formats_of_one_scene_agree_with_the_fourth(shared_dir, tmp_path):
    given = Gaussians.load(shared_dir / "data/gaussians/three-formats/test-splat.3-points-from-train.ply")
    given.save(tmp_path / "a.glb")
    close(Gaussians.load(tmp_path / "a.glb"), given, 1e-6)


def test_commands_take_and_keep_a_glb_with_its_framing(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    PANEL.to_yaml("p.yaml")
    scene().save("s.ply")
    run(capsys, "encode s.ply -o a.png --panel p.yaml --device cpu --save-gaussians s.glb")
    assert not (tmp_path / "s.rig.yaml").exists()
    run(capsys, "encode s.glb -o b.png --panel p.yaml --device cpu")
    from lightfield_gs.io.images import read_image

    assert np.array_equal(read_image("a.png"), read_image("b.png"))
    assert "format: glTF" in run(capsys, "info s.glb")


# Damaged files


def broken(**changes):
    gltf = Gltf().gaussians()
    for place, value in changes.items():
        kind, index, key = place.split("__")
        gltf.root[kind][int(index)][key] = value
    return gltf.glb()


DAMAGED = {
    "cut": (lambda: broken()[:-40], "promises .* bytes, and there are"),
    "header": (lambda: b"glTF\2\0\0\0", "has a header of 20 bytes"),
    "version": (lambda: b"glTF\1" + broken()[5:], "glTF of version 2, got 1"),
    "json": (lambda: broken().replace(b'{"asset', b'{"asse"'), "its JSON cannot be read"),
    "count": (lambda: broken(accessors__0__count=1 << 40), "POSITION: .* rows end"),
    "columns": (lambda: broken(accessors__2__type="VEC4"), "SCALE: .*expected|SCALE: 4 rows end"),
    "kind": (lambda: broken(accessors__0__componentType=7), "componentType"),
    "view": (lambda: broken(bufferViews__0__byteLength=1 << 40), "ends behind its buffer"),
    "index": (lambda: broken(accessors__0__bufferView=99), "bufferViews must be 0"),
    "rows": (lambda: broken(accessors__3__count=3), "OPACITY: expected 4 of 1 numbers, got 3 x 1"),
    "circle": (lambda: broken(nodes__0__children=[0]), "several parents"),
    "turn": (lambda: broken(nodes__0__rotation=[0, 0, 0, 0]), "quaternion of any length"),
    "matrix": (lambda: broken(nodes__0__matrix=[1] * 15), "expected 16 numbers"),
    "mesh": (lambda: broken(nodes__0__mesh=4), "meshes must be 0..0"),
    "meshopt": (
        lambda: broken(bufferViews__0__extensions={"EXT_meshopt_compression": {}}),
        "compressed by EXT_meshopt_compression.*export it without",
    ),
    "sparse": (lambda: broken(accessors__0__sparse={}), "sparse accessors"),
    "harmonics": (
        lambda: Gltf().gaussians({name: one for name, one in attributes().items() if "2_COEF_1" not in name}).glb(),
        "missing attribute KHR_gaussian_splatting:SH_DEGREE_2_COEF_1",
    ),
    "lines": (lambda: Gltf().gaussians(mode=1).glb(), "mode 0 .points., got 1"),
    "opacity": (
        lambda: Gltf().gaussians({**attributes(), f"{KHR}:OPACITY": np.full((4, 1), 1.5)}).glb(),
        "an opacity that is no number",
    ),
    "elsewhere": (lambda: Gltf().gaussians().gltf("../a.bin"), "the name of a file beside it"),
    "web": (lambda: Gltf().gaussians().gltf("https://a.b/c.bin"), "the name of a file beside it"),
    "base64": (lambda: Gltf().gaussians().gltf("data:a;base64,@@"), "base64 is broken"),
    "no data": (lambda: Gltf().gaussians({**attributes(0)}).glb().replace(b'"bufferView"', b'"bufferWiew"'), "no data"),
}


@pytest.mark.parametrize("name", DAMAGED)
def test_damaged_files_are_refused_in_a_line(name, tmp_path):
    content, words = DAMAGED[name]
    (tmp_path / "a.glb").write_bytes(content())
    with pytest.raises(InputError, match=words) as found:
        read_scene(tmp_path / "a.glb")
    assert str(found.value).startswith(str(tmp_path / "a.glb")) and "\n" not in str(found.value)
