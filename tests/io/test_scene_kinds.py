"""Scenes beside the usual .ply: .ply files of other trainers, Gaussians that move, packed scenes, and scenes in many
files."""

import gzip
import io
import math
import struct

import numpy as np
import pytest
import scene_formats as made
import torch
from command_line import PANEL, complaint
from PIL import Image
from test_gaussians_ply import NAMES, VALUES, random_gaussians, write

from lightfield_gs import InputError
from lightfield_gs.io.scenes.files import read_scene
from lightfield_gs.scene.gaussians import Gaussians

MOTION = [f"motion_{i}" for i in range(9)]
OMEGA = [f"omega_{i}" for i in range(4)]


def notes(path, **options) -> str:
    return " | ".join(read_scene(path, **options).notes)


# .ply files of other trainers


def test_2d_gaussians_are_flat_discs_and_said_so(tmp_path):
    names = [name for name in NAMES if name != "scale_2"]
    scene = read_scene(write(tmp_path / "a.ply", names))
    flat = read_scene(write(tmp_path / "b.ply", rows=[{**VALUES, "scale_2": -math.inf}]))
    assert all(torch.equal(one, flat.gaussians.fields()[name]) for name, one in scene.gaussians.fields().items())
    assert ["2D Gaussians" in note for note in scene.notes] == [True] and flat.notes == []
    with pytest.raises(InputError, match="missing scale_1, scale_2"):
        read_scene(write(tmp_path / "c.ply", [name for name in names if name != "scale_1"]))


def test_harmonics_of_degree_4_are_read_to_degree_3(tmp_path):
    rest = [f"f_rest_{i}" for i in range(72)]
    row = {**VALUES, **{name: i for i, name in enumerate(rest)}}
    scene = read_scene(write(tmp_path / "a.ply", NAMES + rest, [row]))
    assert scene.gaussians.sh[0, 1:].tolist() == [[i, 24 + i, 48 + i] for i in range(15)]
    assert scene.notes == ["harmonics of degree 4 were left out; those of degree 0..3 are drawn"]


@pytest.mark.parametrize("name", ["a.ply", "a.sog", "first.sog", "gsplat"])
def test_harmonics_of_degree_4_are_read_to_degree_3_of_packed_scenes_too(name, tmp_path):
    if name == "gsplat":
        made.gsplat_png(tmp_path / name, 4)
    else:
        content = made.compressed_ply(4) if name == "a.ply" else made.zipped(made.sog(1 + (name == "a.sog"), 4))
        (tmp_path / name).write_bytes(content)
    scene = read_scene(tmp_path / name)
    assert torch.allclose(scene.gaussians.sh[:, 1:], torch.tensor(made.REST, dtype=torch.float32), atol=0.02)
    assert scene.notes == ["harmonics of degree 4 were left out; those of degree 0..3 are drawn"]


def test_an_opacity_of_one_byte_is_of_255(tmp_path):
    header = "ply\nformat binary_little_endian 1.0\nelement vertex 3\n"
    header += "".join(f"property {'uchar' if name == 'opacity' else 'float'} {name}\n" for name in NAMES)
    rows = b"".join(
        struct.pack("<6fB7f", *(byte if name == "opacity" else VALUES[name] for name in NAMES)) for byte in (51, 0, 255)
    )
    (tmp_path / "a.ply").write_bytes(header.encode() + b"end_header\n" + rows)
    scene = read_scene(tmp_path / "a.ply")
    assert scene.gaussians.opacities.tolist() == pytest.approx([0.2, 0, 1], abs=1e-7)
    assert ["one byte" in note for note in scene.notes] == [True]


@pytest.mark.parametrize("name", ["f_offset_0", "f_anchor_feat_31"])
def test_anchors_are_named(tmp_path, name):
    names = [*(each for each in NAMES if not each.startswith("f_dc")), name]
    with pytest.raises(InputError, match="anchors of Scaffold-GS.*lightfield-gs fit"):
        read_scene(write(tmp_path / "a.ply", names, [{**VALUES, name: 0.5}]))


@pytest.mark.parametrize(
    "names, words",
    [
        (["x", "y", "z", "red", "green", "blue"], "this is a point cloud.*3DGS trainer"),
        (["x", "y", "z", "opacity"], "this is a point cloud"),
        (["x", "y", "z", "scalar_f_dc_0", "scalar_opacity"], "CloudCompare.*SuperSplat"),
        (["x", "y", "z", "features_dc_0", "scaling_0", "rotation_0"], "as a trainer calls its tensors.*scale_0"),
        (["x", "y", "z", "scale_0"], "missing .*expected the properties of a 3DGS .ply"),
    ],
)
def test_points_without_gaussians_are_named(tmp_path, names, words):
    with pytest.raises(InputError, match=words):
        read_scene(write(tmp_path / "a.ply", names, [dict.fromkeys(names, 0.5)]))


@pytest.mark.parametrize("kind, code", [("char", "b"), ("int", "i"), ("uint", "I")])
@pytest.mark.parametrize("name", ["opacity", "scale_1", "f_dc_0", "f_rest_8"])
def test_integers_are_no_logits_logarithms_or_coefficients(tmp_path, name, kind, code):
    names = [*NAMES, *(f"f_rest_{i}" for i in range(9))]
    header = "ply\nformat binary_little_endian 1.0\nelement vertex 1\n"
    header += "".join(f"property {kind if each == name else 'float'} {each}\n" for each in names) + "end_header\n"
    row = b"".join(struct.pack("<" + (code if each == name else "f"), 1) for each in names)
    (tmp_path / "a.ply").write_bytes(header.encode() + row)
    with pytest.raises(InputError, match=f"expected float or double for {name}, got integers"):
        read_scene(tmp_path / "a.ply")


def test_opacities_of_255_are_noted(tmp_path):
    rows = [{**VALUES, "x": i, "opacity": 8 * i} for i in range(30)]
    assert "look like opacities of 0..255" in notes(write(tmp_path / "a.ply", rows=rows))
    assert notes(write(tmp_path / "b.ply", rows=[{**row, "opacity": row["opacity"] + 0.5} for row in rows])) == ""
    assert notes(write(tmp_path / "c.ply", rows=[{**row, "opacity": row["opacity"] / 16} for row in rows])) == ""


# Gaussians that move


def moving(path, names=(*MOTION, *OMEGA), **changes):
    """Three Gaussians of Spacetime Gaussians, at rest but for what `changes` says; f_dc are colours."""
    row = {**VALUES, **dict.fromkeys([*MOTION, *OMEGA], 0.0), "trbf_center": 0.5, "trbf_scale": math.log(0.25)}
    rows = [{**row, **changes, "trbf_center": centre} for centre in (0.25, 0.5, 0.625)]
    return write(path, [*NAMES, "trbf_center", "trbf_scale", *names], rows)


def test_gaussians_that_move_are_read_at_one_time(tmp_path):
    motion = {f"motion_{i}": i + 1.0 for i in range(9)}
    turn = {"omega_0": 1.0, "omega_3": -2.0}
    path = moving(tmp_path / "a.ply", **motion, **turn)
    scene = read_scene(path, time=0.75).gaussians
    for index, since in enumerate((0.5, 0.25, 0.125)):
        place = [
            VALUES[axis] + (i + 1) * since + (i + 4) * since**2 + (i + 7) * since**3 for i, axis in enumerate("xyz")
        ]
        assert scene.means[index].tolist() == pytest.approx(place)
        assert scene.quaternions[index].tolist() == pytest.approx([0.5 + since, -0.5, 0.25, 1 - 2 * since])
        assert float(scene.opacities[index]) == pytest.approx(0.5 * math.exp(-((since / 0.25) ** 2)))
    with pytest.warns(UserWarning, match="drawn at the time 0.5, of about 0.25"):
        assert torch.equal(Gaussians.load(path).means, read_scene(path, time=0.5).gaussians.means)


def test_colours_of_gaussians_that_move_are_colours_or_harmonics(tmp_path):
    path = moving(tmp_path / "a.ply")
    colours = 0.5 + made.C0 * read_scene(path).gaussians.sh[0, 0]
    assert colours.tolist() == pytest.approx([0.1, 0.2, 0.3]) and "taken for colours" in notes(path)
    path = moving(tmp_path / "b.ply", f_dc_0=-1.5, f_dc_1=1.75)
    assert read_scene(path).gaussians.sh[0, 0].tolist() == pytest.approx([-1.5, 1.75, 0.3])
    assert "taken for harmonics" in notes(path)


def test_motion_may_be_partly_there_and_is_refused_where_it_is_broken(tmp_path):
    path = moving(tmp_path / "a.ply", MOTION[:3], motion_0=4.0)
    assert float(read_scene(path, time=0.75).gaussians.means[0, 0]) == pytest.approx(VALUES["x"] + 2)
    with pytest.raises(InputError, match="three of each degree"):
        read_scene(moving(tmp_path / "b.ply", MOTION[:4]))
    with pytest.raises(InputError, match="motion_1 of Gaussian 0 is nan"):
        read_scene(moving(tmp_path / "c.ply", motion_1=math.nan))
    with pytest.raises(InputError, match="no motion.*time="):
        read_scene(write(tmp_path / "d.ply"), time=0.5)
    (tmp_path / "e.splat").write_bytes(made.splat())
    with pytest.raises(InputError, match="time="):
        read_scene(tmp_path / "e.splat", time=0.5)


def test_motion_that_is_not_known_is_said(tmp_path):
    assert "scale_t" in notes(write(tmp_path / "a.ply", [*NAMES, "t", "scale_t"], [{**VALUES, "t": 0, "scale_t": 1}]))
    (tmp_path / "deformation.pth").write_bytes(b"")
    assert "deformation.pth beside it moves" in notes(write(tmp_path / "b.ply"))


def test_a_network_of_motion_in_a_folder_of_its_own_is_said(tmp_path):
    for name in ("point_cloud/iteration_7", "deform/iteration_7"):
        (tmp_path / name).mkdir(parents=True)
    write(tmp_path / "point_cloud/iteration_7/point_cloud.ply")
    assert "deform.pth" not in notes(tmp_path)
    (tmp_path / "deform/iteration_7/deform.pth").touch()
    assert "deform.pth beside it moves its Gaussians" in notes(tmp_path)


def test_a_time_at_which_nothing_shows_is_said(tmp_path):
    path = moving(tmp_path / "a.ply")
    assert "none of its Gaussians shows at the time 9" in notes(path, time=9.0)
    assert "none of its" not in notes(path, time=0.4)


def test_commands_draw_at_the_time_that_is_given(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    PANEL.to_yaml("p.yaml")
    moving(tmp_path / "a.ply", motion_0=8.0)
    facts = [run_noted(capsys, f"info a.ply --time {time}") for time in (0.25, 0.5)]
    assert "at the time 0.25" in facts[0] and facts[0] != facts[1]
    assert "at the time 0.5" in run_noted(capsys, "encode a.ply -o o.png --panel p.yaml --device cpu")
    Image.new("RGBA", (64, 64)).save("photo.png")
    assert "--time is for files of Gaussians" in complaint(capsys, "encode photo.png -o o.png --time 0.5")


def run_noted(capsys, line: str) -> str:
    """All that a command says that must succeed, its notes too."""
    from lightfield_gs import cli

    assert cli.main(line.split()) == 0
    return "".join(capsys.readouterr())


# Scenes inside something else


def plain_ply(seed=0) -> bytes:
    file = io.BytesIO()
    scene = random_gaussians(4, 0, seed)
    fields = [scene.means, scene.sh[:, 0], torch.logit(scene.opacities)[:, None], scene.scales.log(), scene.quaternions]
    file.write(b"ply\nformat binary_little_endian 1.0\nelement vertex 4\n")
    file.write("".join(f"property float {name}\n" for name in NAMES).encode() + b"end_header\n")
    file.write(torch.cat(fields, 1).numpy().tobytes())
    return file.getvalue()


JUNK = {"__MACOSX/export/._a.ply": b"Mac", "export/.DS_Store": b"", "export/readme.txt": b"words"}
PACKED = {
    "one.zip": lambda: made.zipped({**JUNK, "export/a.ply": plain_ply()}, 8),
    "scene.ply.gz": lambda: gzip.compress(plain_ply()),
    "named-wrong.ply": lambda: gzip.compress(plain_ply()),
    "trainer.zip": lambda: made.zipped(
        {
            "out/input.ply": b"ply\n",
            "out/point_cloud/iteration_7000/point_cloud.ply": plain_ply(1),
            "out/point_cloud/iteration_30000/point_cloud.ply": plain_ply(),
        }
    ),
}


@pytest.mark.parametrize("name", PACKED)
def test_the_one_scene_inside_is_read(name, tmp_path):
    (tmp_path / name).write_bytes(PACKED[name]())
    scene = read_scene(tmp_path / name)
    (tmp_path / "plain.ply").write_bytes(plain_ply())
    assert torch.equal(scene.gaussians.means, read_scene(tmp_path / "plain.ply").gaussians.means)
    assert any("in the ZIP" in note for note in scene.notes) == name.endswith(".zip")


def test_what_a_killed_process_had_unpacked_is_removed(tmp_path, monkeypatch):
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "temporary"))
    left = tmp_path / "temporary/.lightfield-gs.partial-0"
    left.mkdir(parents=True)
    (left / "scene.ply").write_bytes(plain_ply())
    (tmp_path / "a.zip").write_bytes(made.zipped({"a.ply": plain_ply()}))
    assert read_scene(tmp_path / "a.zip").gaussians.count == 4
    assert list((tmp_path / "temporary").iterdir()) == []


def test_other_formats_inside_are_read_too(tmp_path):
    (tmp_path / "a.splat.gz").write_bytes(gzip.compress(made.splat()))
    (tmp_path / "b.zip").write_bytes(made.zipped({"deep/in/" + name: data for name, data in made.sog().items()}))
    (tmp_path / "c.zip").write_bytes(made.zipped({"a.sog": made.zipped(made.sog())}))
    kinds = [read_scene(tmp_path / name).kind for name in ("a.splat.gz", "b.zip", "c.zip")]
    assert kinds == [".splat, 32 bytes a Gaussian", *["SOG version 2, a ZIP"] * 2]


def test_an_spz_that_gzip_has_packed_again_is_read(tmp_path):
    (tmp_path / "a.spz.gz").write_bytes(gzip.compress(made.spz(3)))
    assert read_scene(tmp_path / "a.spz.gz").gaussians.count == 4


def test_what_is_wrong_inside_is_said_of_what_was_given(tmp_path):
    (tmp_path / "a.zip").write_bytes(made.zipped({"in/mesh.ply": b"ply\nformat ascii 1.0\nend_header\n"}))
    with pytest.raises(InputError, match=r"a\.zip \(in/mesh\.ply\): no element 'vertex'"):
        read_scene(tmp_path / "a.zip")
    (tmp_path / "b.ply.gz").write_bytes(gzip.compress(plain_ply() * 9)[:-30])
    with pytest.raises(InputError, match=r"b\.ply\.gz.*(cut|broken)"):
        read_scene(tmp_path / "b.ply.gz")
    (tmp_path / "bomb.ply.gz").write_bytes(gzip.compress(b"ply\n" + bytes(1 << 25)))
    with pytest.raises(InputError, match="more is packed"):
        read_scene(tmp_path / "bomb.ply.gz")


@pytest.mark.parametrize(
    "folder, names, last",
    [
        ("run", ["point_cloud/iteration_7000/point_cloud.ply", "point_cloud/iteration_30000/point_cloud.ply"], 1),
        ("point_cloud", ["iteration_10/point_cloud.ply", "iteration_9/point_cloud.ply"], 0),
        ("iteration_30000", ["point_cloud.ply"], 0),
        ("results", ["ply/point_cloud_6999.ply", "ply/point_cloud_29999.ply"], 1),
    ],
)
def test_the_last_scene_of_a_trainer_is_read(folder, names, last, tmp_path):
    for index, name in enumerate(names):
        (tmp_path / folder / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / folder / name).write_bytes(plain_ply(index))
    (tmp_path / "plain.ply").write_bytes(plain_ply(last))
    scene = read_scene(tmp_path / folder)
    assert torch.equal(scene.gaussians.means, read_scene(tmp_path / "plain.ply").gaussians.means)
    assert names[last] in scene.notes[0] and ("the last of 2" in scene.notes[0]) == (len(names) > 1)


# Scenes in many files


def test_the_finest_level_of_a_streamed_sog_is_read_with_its_environment(tmp_path):
    for path in (made.streamed(tmp_path), tmp_path / "lod-meta.json"):
        scene = read_scene(path)
        one = read_scene(tmp_path / "0_0").gaussians.means
        assert torch.equal(scene.gaussians.means, torch.cat([one[1:3], one, one]))
        assert scene.gaussians.sh_degree == 3
        assert scene.notes[0] == (
            "level 0 of 0..1 is read of a streamed SOG, 6 Gaussians (the finest; another: lod=N); its environment is "
            "read too"
        )


def test_a_level_of_a_streamed_sog_is_chosen_by_option_or_by_memory(tmp_path, monkeypatch, capsys):
    made.streamed(tmp_path)
    one = read_scene(tmp_path / "1_0").gaussians.means
    coarse = torch.cat([one, one[:1], one])  # a leaf without the level has its own coarsest; files in their order
    scene = read_scene(tmp_path, lod=1)
    assert torch.equal(scene.gaussians.means, coarse) and "level 1 of 0..1" in scene.notes[0]
    monkeypatch.setattr("lightfield_gs.io.scenes.streamed_sog.free_host_memory", lambda: 2 * 5 * 1024)
    scene = read_scene(tmp_path)
    assert torch.equal(scene.gaussians.means, coarse)
    assert (
        "level 1 of 0..1 is read of a streamed SOG, 5 Gaussians (the finest that fits: level 0 has 6" in scene.notes[0]
    )
    monkeypatch.undo()
    assert "level 1 of 0..1" in run_noted(capsys, f"info {tmp_path} --lod 1")
    with pytest.raises(InputError, match="lod must be 0..1, got 2"):
        read_scene(tmp_path, lod=2)
    with pytest.raises(InputError, match="no levels of detail; leave out lod="):
        read_scene(tmp_path / "env", lod=0)


@pytest.mark.parametrize(
    "changes, words",
    [
        ({"filenames": ["../a/meta.json"] * 3}, "in its folder"),
        ({"filenames": ["0_0/meta.json"]}, "tree: file must be 0..0"),
        ({"tree": {"lods": {"0": {"file": 0, "offset": 3, "count": 2}}}}, "more Gaussians than the 4"),
        ({"tree": {}}, "leaves with lods"),
        ({"tree": {"lods": {"fine": {}}}}, "nodes with children"),
        ({"version": 2}, "version"),
    ],
)
def test_lies_of_a_lod_meta_json_are_refused(changes, words, tmp_path):
    with pytest.raises(InputError, match=words):
        read_scene(made.streamed(tmp_path, **changes))


@pytest.mark.parametrize("degree", [0, 1, 3])
def test_png_compression_of_gsplat_is_read(degree, tmp_path):
    scene = read_scene(made.gsplat_png(tmp_path / "s", degree))
    made_of = scene.gaussians
    assert scene.kind.startswith("gsplat") and made_of.sh_degree == degree
    assert torch.allclose(made_of.means, torch.tensor(made.MEANS), atol=1e-3)
    assert torch.allclose(made_of.scales.log(), torch.tensor(made.LOG_SCALES), atol=0.02)
    assert torch.allclose(made_of.quaternions, torch.tensor(made.ROTATIONS), atol=0.01)
    assert torch.allclose(made_of.opacities, torch.tensor(made.OPACITIES), atol=0.02)
    rest = torch.tensor(made.REST[:, : (degree + 1) ** 2 - 1], dtype=torch.float32)
    assert torch.allclose(made_of.sh[:, 1:], rest, atol=0.02)


def test_a_wrong_palette_of_gsplat_is_refused(tmp_path):
    folder = made.gsplat_png(tmp_path / "s")
    np.savez_compressed(folder / "shN.npz", centroids=np.zeros((4, 9), np.uint8), labels=np.full(4, 4, np.uint16))
    with pytest.raises(InputError, match="4 labels of a palette of 9"):
        read_scene(folder)
