"""Scene files in practice: extreme values, values without a meaning, coordinates far from zero, other encodings of the
same numbers, and suspicious files."""

import math
import struct
import warnings

import numpy as np
import pytest
import torch
from command_line import PANEL, complaint, run, scene
from test_gaussians_ply import NAMES, VALUES, random_gaussians, write

from lightfield_gs import InputError, SplatterNet, cli
from lightfield_gs.commands.info import describe
from lightfield_gs.encoding.encode import encode
from lightfield_gs.io.npy import open_array
from lightfield_gs.io.ply_file import read_elements, read_header
from lightfield_gs.io.scenes.files import read_scene
from lightfield_gs.panels.rig import Rig
from lightfield_gs.reference import subpixel_colours
from lightfield_gs.scene.gaussians import Gaussians

FAR = (500123.0, 5412345.0, -420.0)


def stored_rows(gaussians: Gaussians, **changes) -> list[dict[str, float]]:
    """Rows of a hand-written .ply of degree 0. changes: by property, a function of the stored value and the index."""
    table = torch.cat(
        [
            gaussians.means,
            gaussians.sh[:, 0],
            torch.logit(gaussians.opacities)[:, None],
            gaussians.scales.log(),
            gaussians.quaternions,
        ],
        1,
    ).tolist()
    rows = [dict(zip(NAMES, row)) for row in table]
    return [{**row, **{name: change(row[name], i) for name, change in changes.items()}} for i, row in enumerate(rows)]


def vertices(path) -> np.ndarray:
    return read_elements(path, read_header(path, path.read_bytes()))["vertex"]


# Values at the ends


def test_infinite_logits_and_logs_are_drawn_for_what_they_mean(tmp_path):
    """Opaque and invisible Gaussians, discs, needles and points, against the float64 oracle."""
    rows = stored_rows(
        scene(),
        opacity=lambda value, i: (value, math.inf, -math.inf)[i % 3],
        scale_0=lambda value, i: -math.inf if i % 2 else value,
        scale_1=lambda value, i: -math.inf if i % 5 == 0 else value,
        scale_2=lambda value, i: -math.inf if i % 4 == 0 else value,
    )
    loaded = Gaussians.load(write(tmp_path / "a.ply", rows=rows)).validate()
    assert read_scene(tmp_path / "a.ply").notes == []
    assert (loaded.opacities[1::3] == 1).all() and (loaded.opacities[2::3] < 1e-37).all()
    assert (loaded.scales[1::2, 0] < 1e-37).all() and (loaded.scales[::2, 0] > 0.01).all()
    rig = Rig.frame(loaded, PANEL)
    at = tuple(index.ravel() for index in np.indices((PANEL.height_px, PANEL.width_px, 3)))
    right, margin = subpixel_colours(loaded.to(torch.float64), PANEL, rig, *at, return_margin=True)
    drawn = encode(loaded, PANEL, rig, output="float32").numpy().ravel()
    assert np.abs(drawn - right)[margin > 1e-4].max() < 1e-4
    shown = torch.arange(loaded.count) % 3 != 2
    visible = Gaussians(*(field[shown] for field in loaded.fields().values()))
    assert torch.equal(encode(visible, PANEL, rig), encode(loaded, PANEL, rig))


def test_a_scene_of_points_is_not_doubted(tmp_path):
    rows = stored_rows(scene(), **{f"scale_{i}": lambda value, i: -math.inf for i in range(3)})
    for kind in ("float", "double"):
        file = read_scene(write(tmp_path / "a.ply", rows=rows, kind=kind))
        assert file.notes == [] and file.gaussians.origin == (0, 0, 0)


MEANINGLESS = {"x": math.nan, "f_dc_1": -math.inf, "rot_0": math.inf, "opacity": math.nan, "scale_1": 200.0}


def test_what_has_no_meaning_is_counted_and_left_out_on_request(tmp_path):
    rows = [VALUES] + [{**VALUES, "x": 2.0, name: value} for name, value in MEANINGLESS.items()]
    rows += [{**VALUES, **dict.fromkeys(NAMES[-4:], 0.0), "x": math.nan}, {**VALUES, **dict.fromkeys(NAMES[-4:], 0.0)}]
    path = write(tmp_path / "a.ply", rows=rows)
    with pytest.raises(InputError, match="x of Gaussian 1 is nan; 7 of 8 .*skip_invalid=True"):
        Gaussians.load(path)
    file = read_scene(path, skip_invalid=True)
    assert file.gaussians.count == 1 and file.gaussians.means.tolist() == [[1.5, -2.0, 3.25]]
    (note,) = file.notes
    for words in (
        "7 of 8",
        "2 with a centre",
        "1 with a rotation that",
        "1 with a rotation of zeros",
        "1 with a scale",
        "1 with an opacity",
        "1 with a colour",
    ):
        assert words in note
    with pytest.warns(UserWarning, match="7 of 8"):
        Gaussians.load(path, skip_invalid=True)
    with pytest.raises(InputError, match="nothing is left"):
        Gaussians.load(write(tmp_path / "b.ply", rows=rows[1:]), skip_invalid=True)


def test_commands_skip_on_request(folder, capsys):
    (folder / "photo.png").touch()
    write(folder / "bad.ply", rows=stored_rows(scene(), rot_3=lambda value, i: math.nan if i == 7 else value))
    for command in ("info bad.ply", "encode bad.ply -o o.png --panel p.yaml", "prune bad.ply -o o.ply --panel p.yaml"):
        assert "rot_3 of Gaussian 7 is nan; 1 of 60 Gaussians" in complaint(capsys, command)
        assert cli.main([*command.split(), "--skip-invalid"]) == 0
        output = capsys.readouterr()
        assert output.err.startswith("note: bad.ply: 1 of 60") and output.err.count("\n") == 1 and "59" in output.out
    assert "--skip-invalid is for files of Gaussians" in complaint(
        capsys, "encode photo.png -o o.png --panel p.yaml --skip-invalid"
    )


# Coordinates far from zero


def far_rows(gaussians: Gaussians) -> list[dict[str, float]]:
    return stored_rows(gaussians, **{name: lambda value, i, far=far: value + far for name, far in zip("xyz", FAR)})


def test_double_coordinates_keep_their_precision(tmp_path):
    given = scene()
    with pytest.warns(UserWarning, match=r"origin \(500123.0, 5412345.0, -420.0\)"):
        loaded = Gaussians.load(write(tmp_path / "a.ply", rows=far_rows(given), kind="double"))
    assert loaded.origin == FAR and (loaded.means - given.means).abs().max() < 1e-7
    assert loaded.to(torch.float64).detach().origin == FAR
    loaded.save(tmp_path / "b.ply")
    for name in "xyz":
        one, other = (vertices(tmp_path / file)[name] for file in ("a.ply", "b.ply"))
        assert other.dtype == np.float64 and np.abs(one - other).max() < 1e-7
    assert torch.equal(Gaussians.load(tmp_path / "b.ply").means, loaded.means)
    near = Gaussians.load(write(tmp_path / "c.ply", rows=stored_rows(given), kind="double"))
    assert near.origin == (0, 0, 0) and torch.equal(near.means, given.means)
    near.save(tmp_path / "d.ply")
    assert vertices(tmp_path / "d.ply").dtype["x"] == np.float32
    with pytest.raises(InputError, match="origin"):
        Gaussians(*given.fields().values(), (0, math.nan, 0)).validate()


def test_rigs_are_in_the_coordinates_of_the_file(folder, capsys):
    """A scene far away gives the picture of the same scene at zero; its rig, written and read, is where the file is."""
    write(folder / "far.ply", rows=far_rows(scene()), kind="double")
    write(folder / "near.ply", rows=stored_rows(scene()))
    for name in ("far", "near"):
        run(
            capsys,
            f"encode {name}.ply -o {name}.exr --panel p.yaml --save-rig {name}.yaml --save-gaussians {name}-2.ply",
        )
    near, far = Rig.from_yaml("near.yaml"), Rig.from_yaml("far.yaml")
    assert far.world_to_camera[:3, 3] + FAR == pytest.approx(near.world_to_camera[:3, 3], abs=1e-5)
    near.relative_to([-part for part in FAR]).to_yaml("moved.yaml")
    cameras = {
        name: getattr(Rig.from_yaml("moved.yaml").cameras(PANEL), name).tolist()
        for name in ("world_to_camera", "focal_px", "principal_point_px")
    }
    (folder / "c.json").write_text(str(cameras).replace("'", '"'))
    pictures = [
        run(capsys, f"encode {options} -o o.exr --panel p.yaml") and pixels()
        for options in (
            "near.ply --rig near.yaml",
            "far.ply --rig moved.yaml",
            "far-2.ply --rig moved.yaml",
            "far.ply --method sorted --cameras c.json",
        )
    ]
    assert "origin 500123, 5412345, -420" in run(capsys, "encode far.ply -o o.exr --panel p.yaml")
    assert max(np.abs(picture - pictures[0]).max() for picture in pictures) < 1e-3
    assert "500123, 5412345, -420" in run(capsys, "info far.ply")
    assert "origin" in run(capsys, "prune far.ply -o pruned.ply --panel p.yaml --rig far.yaml --save-rig again.yaml")
    assert Rig.from_yaml("again.yaml").world_to_camera == pytest.approx(far.world_to_camera, abs=1e-9)
    assert np.abs(vertices(folder / "pruned.ply")["y"] - FAR[1]).max() < 1


def pixels() -> np.ndarray:
    from lightfield_gs.io.images import read_image

    return read_image("o.exr")


def test_steps_larger_than_the_gaussians_are_noted(tmp_path):
    (note,) = read_scene(write(tmp_path / "a.ply", rows=far_rows(scene()))).notes
    assert "steps of 0.5" in note and "5412345" in note and "double" in note
    rows = stored_rows(
        scene(),
        **{f"scale_{i}": lambda value, i: value + 7 for i in range(3)},
        **{name: lambda value, i, far=far: value + far for name, far in zip("xyz", FAR)},
    )
    assert read_scene(write(tmp_path / "b.ply", rows=rows)).notes == []  # a thousand times as large


# Other encodings of the same numbers


def as_text(rows, first="ply\nformat ascii 1.0\n", before="", middle="", tail="") -> bytes:
    header = first + f"{before}element vertex {len(rows)}\n" + "".join(f"property float {name}\n" for name in NAMES)
    lines = [" ".join(repr(row[name]) for name in NAMES) for row in rows]
    return (header + "end_header\n" + middle + "\n".join(lines) + tail).encode()


def as_big_endian(rows) -> bytes:
    header = f"ply\nformat binary_big_endian 1.0\nelement size 1\nproperty ushort px\nelement vertex {len(rows)}\n"
    header += "".join(f"property float {name}\n" for name in NAMES) + "end_header\n"
    return (
        header.encode()
        + struct.pack(">H", 640)
        + b"".join(struct.pack(">14f", *(row[name] for name in NAMES)) for row in rows)
    )


def test_text_and_big_endian_hold_the_same(tmp_path):
    rows = stored_rows(random_gaussians(degree=0))
    right = Gaussians.load(write(tmp_path / "a.ply", rows=rows))
    face = "element face 2\nproperty list uchar int v\nelement size 1\nproperty ushort px\n"
    contents = {
        "text": as_text(rows),
        "lists": as_text(rows, before=face, middle="3 0 1 2\n0\n640\n", tail="\n\n"),
        "carriage returns": as_text(rows).replace(b"\n", b"\r"),
        "dos": as_text(rows).replace(b"\n", b"\r\n"),
        "big-endian": as_big_endian(rows),
    }
    for name, content in contents.items():
        (tmp_path / "b.ply").write_bytes(content)
        file = read_scene(tmp_path / "b.ply")
        assert all(map(torch.equal, file.gaussians.fields().values(), right.fields().values())), name
        if name in ("lists", "big-endian"):
            assert file.elements["size"]["px"].tolist() == [640]


def test_digits_of_text_count(tmp_path):
    (tmp_path / "a.ply").write_bytes(as_text(far_rows(scene())))
    loaded = Gaussians.load(tmp_path / "a.ply")
    assert loaded.origin == FAR and (loaded.means - scene().means).abs().max() < 1e-7


@pytest.mark.parametrize(
    "content, words",
    [
        (as_text([VALUES] * 3).replace(b"vertex 3", b"vertex 1099511627776"), "1099511627776 rows .* cut"),
        (as_text([VALUES] * 3).replace(b"vertex 3", b"vertex 4"), "the file has 3; it is cut"),
        (as_text([VALUES] * 3).replace(b"vertex 3", b"vertex 2"), "lines are left"),
        (as_text([VALUES] * 3)[:-4], "cannot read the rows of 'vertex' from row 0 on, expected 14"),
        (as_text([VALUES] * 3)[:-3] + b"one", "could not convert string 'one'"),
        (as_text([VALUES] * 3, tail=" 1"), "cannot read the rows"),
        (
            as_text([VALUES], before="element face 99999999\nproperty list uchar int v\n"),
            "99999999 rows of 'face'.* cut",
        ),
        (
            as_text([VALUES], before="element face 9\nproperty list uchar int v\n"),
            "9 rows of 'face', but the file has 1",
        ),
        (as_text([VALUES], before="element a 1\nproperty uchar v\n", middle="256\n"), "cannot read the rows of 'a'"),
    ],
)
def test_hostile_text(tmp_path, content, words):
    (tmp_path / "a.ply").write_bytes(content)
    with pytest.raises(InputError, match=words) as caught:
        Gaussians.load(tmp_path / "a.ply")
    assert "\n" not in str(caught.value) and len(str(caught.value)) < 500


@pytest.mark.parametrize(
    "kind, code, full",
    [("uchar", "B", 255), ("int", "i", 255), ("ushort", "H", 65535), ("float", "f", 1.0), ("float", "f", 255.0)],
)
def test_colours_in_place_of_harmonics(tmp_path, kind, code, full):
    names = [name for name in NAMES if not name.startswith("f_dc")]
    rows = stored_rows(scene())
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(rows)}\n"
    header += "".join(f"property float {name}\n" for name in names)
    header += "".join(f"property {kind} {name}\n" for name in ("red", "green", "blue")) + "end_header\n"
    colour = [full, 0, full // 5 if full > 1 else 0.2]
    (tmp_path / "a.ply").write_bytes(
        header.encode() + b"".join(struct.pack(f"<11f3{code}", *(row[name] for name in names), *colour) for row in rows)
    )
    file = read_scene(tmp_path / "a.ply")
    assert (0.5 + 0.28209479177387814 * file.gaussians.sh[7, 0]).tolist() == pytest.approx([1, 0, 0.2], abs=1e-6)
    assert file.notes == (
        [] if (kind, full) != ("float", 255) else ["red, green and blue have numbers above 1 and are taken for 0..255"]
    )


# What looks wrong


def test_linear_values_are_noted(tmp_path):
    given = scene()
    linear = {f"scale_{i}": lambda value, i: math.exp(value) for i in range(3)}
    logistic = {"opacity": lambda value, i: 1 / (1 + math.exp(-value))}
    for changes, words in (
        (linear, ["no scale is below 0"]),
        (logistic, ["all opacities are within"]),
        ({**linear, **logistic}, ["no scale", "all opacities"]),
        ({}, []),
    ):
        notes = read_scene(write(tmp_path / "a.ply", rows=stored_rows(given, **changes))).notes
        assert len(notes) == len(words) and all(word in note for note, word in zip(notes, words))
    with pytest.warns(UserWarning, match="a.ply: no scale is below 0"):
        Gaussians.load(write(tmp_path / "a.ply", rows=stored_rows(given, **linear)))


@pytest.mark.parametrize("grow", [1, 1000])
def test_scenes_as_they_should_be_are_not_doubted(tmp_path, grow):
    """Metres and millimetres: all Gaussians of the latter are larger than one unit."""
    rows = stored_rows(
        scene(),
        **{f"scale_{i}": lambda value, i: value + math.log(grow) for i in range(3)},
        **{name: lambda value, i: value * grow for name in "xyz"},
    )
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        Gaussians.load(write(tmp_path / "a.ply", rows=rows))


@pytest.mark.parametrize(
    "names, kind, words",
    [
        (NAMES, "ushort", "half floats that were written as integers"),
        (["x", "y", "z", "red", "green", "blue"], "float", "missing opacity.*point cloud, the start of a fit"),
        (["x", "y", "z"], "float", "missing f_dc_0.*point cloud"),
    ],
)
def test_files_that_hold_something_else_say_what(tmp_path, names, kind, words):
    header = "ply\nformat binary_little_endian 1.0\nelement vertex 1\n"
    header += "".join(f"property {kind} {name}\n" for name in names) + "end_header\n"
    (tmp_path / "a.ply").write_bytes(header.encode() + bytes(len(names) * (2 if kind == "ushort" else 4)))
    with pytest.raises(InputError, match=words):
        Gaussians.load(tmp_path / "a.ply")


POINTER = b"version https://git-lfs.github.com/spec/v1\noid sha256:4d7a214614ab2935\nsize 12345\n"
PAGE = b"\xef\xbb\xbf\n<!-- mirror --><!DOCTYPE html>\n<html><head><title>Not found</title></head></html>\n"


@pytest.mark.parametrize("name", ["s.ply", "s.png", "s.json", "s.yaml", "s.npy", "s.safetensors"])
@pytest.mark.parametrize("content, words", [(POINTER, "Git LFS pointer.*git lfs pull"), (PAGE, "web page")])
def test_what_a_download_left_is_named(folder, capsys, name, content, words):
    (folder / name).write_bytes(content)
    with pytest.raises(InputError, match=words):
        if name == "s.npy":
            open_array(name)
        elif name == "s.safetensors":
            SplatterNet.from_pretrained(name)
        else:
            describe(folder / name)


def test_quilts_are_told_from_photos(folder, capsys):
    (folder / "views_qs8x6a0.75.png").write_bytes(b"no picture")
    assert cli.main("encode views_qs8x6a0.75.png -o o.png --panel p.yaml".split()) == 2
    note, error = capsys.readouterr().err.splitlines()
    assert "quilt of 8 x 6 views" in note and "views_qs8x6a0.75.png" in error
