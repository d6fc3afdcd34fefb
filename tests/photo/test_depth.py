"""Depth maps from files, and the command line that shows a photo with one."""

import json
import re

import numpy as np
import pytest
import torch
from command_line import PANEL, complaint, run
from PIL import Image
from rgbd_scene import view

import lightfield_gs as lf
from lightfield_gs import cli
from lightfield_gs.io.images import read_image, read_info, write_image
from lightfield_gs.panels.framing import focus_on_subject
from lightfield_gs.photo.depth import depth_map, ray_lengths, read_depth, read_numbers
from lightfield_gs.photo.margin import fit_to_panel
from lightfield_gs.show.preview import to_integers

Z = np.array([[0.5, 1.0, 2.0], [4.0, 1.5, 0.8]])


# Numbers and what they mean


def test_millimetres(tmp_path):
    stored = np.round(Z * 1000).astype(np.uint16)
    stored[0, 0] = 0
    write_image(tmp_path / "a.png", stored[..., None])
    np.save(tmp_path / "a.npy", stored)
    for name in ("a.png", "a.npy"):
        depth = read_depth(tmp_path / name, scale=0.001)
        assert depth.dtype == np.float32 and np.isnan(depth[0, 0])
        assert np.allclose(depth.ravel()[1:], Z.ravel()[1:], rtol=1e-6)


@pytest.mark.parametrize("dtype", ["uint8", "uint16", "float32"])
def test_near_and_far(tmp_path, dtype):
    """The ends of the file's full scale; between them z is linear, or its inverse is."""
    top = np.iinfo(dtype).max if dtype != "float32" else 1
    share = np.array([[0, 1], [51 / 255, 204 / 255]])
    path = tmp_path / ("a.exr" if dtype == "float32" else "a.png")
    write_image(path, np.repeat((share * top).astype(dtype)[..., None], 3, 2))
    assert np.allclose(read_depth(path, limits=(2, 6)), 2 + 4 * share, rtol=1e-4)
    assert np.allclose(read_depth(path, "disparity", limits=(2, 6)), 1 / (1 / 6 + share / 3), rtol=1e-4)
    assert read_depth(path, "disparity", limits=(2, 6))[0].tolist() == [6, 2]


def test_floats_are_distances_or_their_inverse(tmp_path):
    write_image(tmp_path / "z.exr", Z.astype(np.float32)[..., None])
    np.save(tmp_path / "d.npy", 50 / Z)
    np.save(tmp_path / "h.npy", Z.astype(np.float16))
    assert np.array_equal(read_depth(tmp_path / "z.exr"), Z.astype(np.float32))
    assert np.allclose(read_depth(tmp_path / "d.npy", "disparity", scale=50), Z, rtol=1e-6)
    assert np.allclose(read_depth(tmp_path / "h.npy"), Z, rtol=1e-3)


def test_what_is_infinitely_far_is_far_or_left_out_as_asked(tmp_path):
    """Infinite distances and the disparity 0, behind all else; what is no distance at all is a hole."""
    path = tmp_path / "i.npy"
    np.save(path, np.array([[1, np.inf, -np.inf, np.nan, 0, -1, 2]]))
    for kind, far, last in (("distance", 1, 2), ("disparity", 4, 0.5)):
        expected = np.array([1, *[np.nan] * 5, last])
        assert np.array_equal(read_depth(path, kind, invalid="hole"), expected[None], equal_nan=True)
        expected[far] = 2 * np.nanmax(expected)
        assert np.array_equal(read_depth(path, kind), expected[None], equal_nan=True)
    np.save(path, np.array([[0, 51, 255]], np.uint8))
    assert np.isnan(read_depth(path, "disparity", limits=(2, 6), invalid="hole")).tolist() == [[True, False, False]]


@pytest.mark.parametrize(
    "array, options, words",
    [
        (np.ones((2, 3), np.uint16), {}, "whole numbers.*depth_range="),
        (np.ones((2, 3, 2)), {}, r"expected numbers \[H, W\]"),
        (np.ones((2, 3), bool), {}, "bool"),
        (np.ones((2, 3), complex), {}, "complex"),
        (np.ones((0, 3)), {}, "0, 3"),
        (np.zeros((2, 3)), {}, "there is none"),
        (np.full((2, 3), np.nan), {"limits": (1, 2)}, "there is none"),
        (np.ones((2, 3)), {"limits": (2, 2)}, "near < far"),
        (np.ones((2, 3)), {"limits": (0, 1)}, "> 0"),
        (np.ones((2, 3)), {"limits": (1, np.inf)}, "> 0"),
        (np.ones((2, 3)), {"scale": 0}, "> 0"),
        (np.ones((2, 3)), {"scale": float("nan")}, "> 0"),
        (np.full((2, 3), 1.5), {"limits": (1, 2)}, "0..1, got 1.5..1.5"),
        (np.ones((2, 3), np.int32), {"limits": (1, 2)}, "uint8, uint16"),
        (np.ones((2, 3)), {"limits": (1, 2), "scale": 1}, "not both"),
        (np.ones((2, 3)), {"kind": "height"}, "disparity"),
        (np.ones((2, 3)), {"kind": "ray"}, "ray needs the camera"),
    ],
)
def test_numbers_that_make_no_depth(tmp_path, array, options, words):
    np.save(tmp_path / "a.npy", array)
    with pytest.raises(lf.InputError, match=words) as caught:
        read_depth(tmp_path / "a.npy", **options)
    assert "\n" not in str(caught.value)


def test_a_range_the_other_way_round_is_that_of_a_map_the_other_way_round(tmp_path):
    """Far first: distances of which bright is near, in 8 and 16 bits and floats; and inverted disparities."""
    share = np.array([[0, 51 / 255, 1]])
    for name, stored in (
        ("a.npy", (share * 255).astype(np.uint8)),
        ("b.npy", (share * 65535).round().astype(np.uint16)),
    ):
        np.save(tmp_path / name, stored)
        assert np.allclose(read_depth(tmp_path / name, limits=(6, 2)), [[6, 5.2, 2]], rtol=1e-4)
        assert np.allclose(read_depth(tmp_path / name, "disparity", limits=(6, 2)), [[2, 1 / (1 / 6 + 0.8 / 3), 6]])
    np.save(tmp_path / "c.npy", share)
    assert np.allclose(read_depth(tmp_path / "c.npy", limits=(6, 2)), [[6, 5.2, 2]])
    hole = read_depth(tmp_path / "a.npy", "disparity", limits=(6, 2), invalid="hole")
    assert np.isnan(hole).tolist() == [[False, False, True]]


@pytest.mark.parametrize(
    "sky, dtype, scale",
    [
        (1e10, np.float32, None),
        (65504, np.float16, None),
        (65504, np.float32, None),
        (3.4e38, np.float32, None),
        (65.535, np.float32, None),
        (1e5, np.float64, None),
        (65535, np.uint16, 0.001),
        (65535, np.int32, 0.001),
        (2**31 - 1, np.int32, 0.001),
    ],
)
def test_numbers_that_stand_for_the_sky_are_far(tmp_path, sky, dtype, scale):
    """Infinite distances lie at twice the farthest measured one, or are holes; a message says so."""
    values = np.array([[1, 1.5, 2, 40, 0]]) * (1 if scale is None else 1000)
    np.save(tmp_path / "s.npy", np.concatenate([values, np.full((1, 5), sky)]).astype(dtype))
    z = read_depth(tmp_path / "s.npy", scale=scale)
    assert np.allclose(z[1], 80) and np.allclose(z[0, :4], [1, 1.5, 2, 40]) and np.isnan(z[0, 4])
    assert np.isnan(read_depth(tmp_path / "s.npy", scale=scale, invalid="hole")[1]).all()
    assert "50.0% sky (" in depth_map("s.npy", read_numbers(tmp_path / "s.npy"), scale=scale).description


@pytest.mark.parametrize(
    "values, scale",
    [
        (np.linspace(1, 65535, 12).reshape(3, 4).astype(np.uint16), 1e-4),  # a map that fills its range
        (np.array([[1000, 60000, 65535]], np.uint16), 0.001),  # woods and hills at 60 m
        (np.array([[51, 102, 255]], np.uint8), 0.01),
        (np.array([[65504.0, 65535.0]]), None),
        (np.array([[1e10, 2e10]]), None),
    ],
)
def test_distances_that_may_be_meant_are_no_sky(tmp_path, values, scale):
    np.save(tmp_path / "s.npy", values)
    assert np.allclose(read_depth(tmp_path / "s.npy", scale=scale), values * (scale or 1), rtol=1e-6)


def test_marks_of_what_was_not_measured_are_holes_beside_shares(tmp_path):
    np.save(tmp_path / "s.npy", np.array([[0.0, 0.5, 1.0, -9999.0, np.nan]]))
    assert np.array_equal(read_depth(tmp_path / "s.npy", limits=(1, 2)), [[1, 1.5, 2, np.nan, np.nan]], equal_nan=True)


def test_distances_along_the_rays_are_those_of_a_flat_wall(tmp_path):
    """A wall at 2 across the axis, by the camera of the photo; also in a map of half its size."""
    focal, centre, size = (50.0, 40.0), (30.0, 22.0), (40, 60)
    for shape in (size, (20, 30)):
        np.save(tmp_path / "r.npy", 2 * ray_lengths(shape, size, focal, centre))
        z = read_depth(tmp_path / "r.npy", "ray", rays=lambda shape: ray_lengths(shape, size, focal, centre))
        assert z.shape == shape and np.allclose(z, 2)
    corner = ray_lengths(size, size, focal, centre)[0, 0]
    assert corner == pytest.approx(np.sqrt(1 + (29.5 / 50) ** 2 + (21.5 / 40) ** 2))


# The command


def write_scene() -> np.ndarray:
    """photo.png and depth.exr of the known scene; the photo."""
    colours, depth, _ = view(60, 40, 50.0)
    write_image("photo.png", to_integers(colours, 8))
    write_image("depth.exr", depth.astype(np.float32)[..., None])
    return read_image("photo.png")


def test_a_photo_is_as_deep_as_the_eyes_take_and_its_subject_lies_in_the_panel(folder, capsys):
    write_scene()
    line = "encode photo.png --depth depth.exr -o o.exr --panel p.yaml --device cpu --save-rig r.yaml"
    out = run(capsys, f"{line} --viewing-distance 200")
    amount = re.search(r"depth: (0\.\d+) of what it is, .* \(all of it: --depth-amount 1\)\n", out)
    assert amount is not None and "focus: the subject, at depth" in out and "--focus)" in out
    cone = lf.Rig.from_yaml("r.yaml").cone_deg
    assert cli.main(f"{line} --viewing-distance 200 --depth-amount {amount[1]} --focus 0.5,0.5".split()) == 0
    out = capsys.readouterr().out
    assert "of what it is" not in out and "focus: the subject" not in out
    assert lf.Rig.from_yaml("r.yaml").cone_deg == pytest.approx(cone) and cone < PANEL.cone_deg
    # A rig keeps its depth
    lf.Rig.from_yaml("r.yaml").to_yaml("own.yaml")
    assert "of what it is" not in run(
        capsys, f"{line} --viewing-distance 100 --rig own.yaml".replace("r.yaml", "q.yaml", 1)
    )


def test_encode_of_a_photo_with_depth_is_the_library_call(folder, capsys):
    photo = write_scene()
    depth = read_image("depth.exr")[..., 0]
    out = run(
        capsys,
        "encode photo.png --depth depth.exr --intrinsics 50,50,30,20 -o o.exr --panel p.yaml "
        "--device cpu --save-rig r.yaml --save-gaussians g.ply",
    )
    placed = fit_to_panel(torch.from_numpy(depth), (50, 50), (30, 20), PANEL, "auto", on_near=True)
    margin = "blur" if placed.fit == "contain" else "texture"
    gaussians = lf.from_depth(photo, depth, (50, 50), (30, 20), margin_px=placed.margin_px, margin=margin)
    rig = focus_on_subject(placed.rig, gaussians, PANEL)
    expected = lf.encode(gaussians, PANEL, rig, output="float32").numpy()
    assert np.array_equal(read_image("o.exr"), expected) and "depth" in out and "network" not in out
    assert lf.Rig.from_yaml("r.yaml").to_dict() == rig.to_dict()
    assert torch.allclose(lf.Gaussians.load("g.ply").means, gaussians.means)
    assert json.loads(read_info("o.exr").metadata["encoding"])["depth"]["file"] == "depth.exr"


def test_the_plane_is_in_a_thin_subject_before_a_near_wall():
    depth = np.full((60, 120), 1.6, np.float32)
    depth[:, 54:66] = 1.25
    placed = fit_to_panel(torch.from_numpy(depth), (100, 100), (60, 30), PANEL, on_near=True)
    gaussians = lf.from_depth(np.full((60, 120, 3), 0.5, np.float32), depth, (100, 100), (60, 30))
    assert focus_on_subject(placed.rig, gaussians, PANEL).zero_depth == pytest.approx(1.25, rel=0.02)


def test_every_way_to_say_the_depth(folder, capsys):
    write_scene()
    depth = read_image("depth.exr")[..., 0].astype(np.float64)
    write_image("mm.png", np.round(depth * 1000).astype(np.uint16)[..., None])
    write_image("near.png", np.round((1 / depth - 1 / 6) / (1 - 1 / 6) * 65535).astype(np.uint16)[..., None])
    for number, options in enumerate(
        ("depth.exr", "mm.png --depth-scale 0.001", "near.png --depth-kind disparity --depth-range 1,6")
    ):
        run(
            capsys,
            f"encode photo.png -o {number}.png --panel p.yaml --fov 70 --save-gaussians {number}.ply --depth "
            + options,
        )
    scenes = [lf.Gaussians.load(f"{number}.ply") for number in range(3)]
    for other in scenes[1:]:
        assert torch.allclose(scenes[0].means[:2400], other.means[:2400], atol=2e-3)
    half = scenes[0].means[:60, 0] / scenes[0].means[:60, 2]
    assert float(half[-1]) == pytest.approx(np.tan(np.radians(35)) * 59 / 60, rel=1e-4)


def test_a_mask_cuts_the_scene(folder, capsys):
    write_scene()
    mask = np.zeros((40, 60, 1), np.uint8)
    mask[10:30, 20:40] = 255
    write_image("mask.png", mask)
    run(capsys, "encode photo.png --depth depth.exr --mask mask.png -o o.png --panel p.yaml --save-gaussians g.ply")
    means = lf.Gaussians.load("g.ply").means[:400]
    assert means[:, 0].div(means[:, 2]).abs().max() < 10 / 52  # the middle 20 of 60 columns, 60 degrees wide


@pytest.mark.parametrize(
    "line, words",
    [
        ("encode photo.png --depth mm.png", "whole numbers"),
        ("encode photo.png --depth small.npy", "size 60 x 40, or of its shape, got 7 x 5"),
        ("encode s.ply --depth depth.exr", "--depth is for photos"),
        ("encode s.ply --remove-background", "--remove-background is for photos"),
        ("encode photo.png --depth-range 1,2", "no --depth"),
        ("encode photo.png --fov 50", "no --depth"),
        ("encode photo.png --depth depth.exr --checkpoint c.safetensors", "does without"),
        ("encode photo.png --depth depth.exr --fov 0", "between 0 and 180"),
        ("encode photo.png --depth depth.exr --fov 50 --intrinsics 1,1,1,1", "place of --fov"),
        ("encode photo.png --depth depth.exr --intrinsics -1,1,1,1", "--intrinsics: .* > 0 px"),
        ("encode photo.png --depth mm.png --depth-scale 1 --depth-range 1,2", "place of --depth-range"),
        ("encode photo.png --depth mm.png --depth-range 2,2", "near < far"),
        ("encode photo.png --depth mm.png --depth-range 2", "2 numbers"),
        ("encode photo.png --depth photo.png", "in colour"),
        ("encode photo.png --depth depth.exr --intrinsics 50,50,100,20", "principal point 100,20 is outside"),
        ("encode photo.png --depth depth.exr --intrinsics 0.8,0.8,0.5,0.5", "--intrinsics: .* 176.9 degrees .* --fov"),
        ("encode photo.png --depth depth.exr --rgbd left", "--rgbd takes the place of --depth"),
        ("encode photo.png --map-orientation stored", "file of its own, and there is none"),
        ("encode photo.png --depth-invalid far", "no --depth"),
        ("encode photo.png --rgbd right", "photo.png: its right half is in colour"),
        ("encode odd.png --rgbd top", "odd.png: expected two halves of one size, its height is 5"),
        ("encode photo.png --depth depth.exr --depth-kind height", "invalid choice"),
        ("encode photo.png --mask mm.png --remove-background", "leave out one"),
    ],
)
def test_complaints(folder, capsys, line, words):
    write_scene()
    write_image("mm.png", np.full((40, 60, 1), 1000, np.uint16))
    np.save("small.npy", np.ones((5, 7)))
    write_image("odd.png", np.zeros((5, 7, 3), np.uint8))
    assert re.search(words, complaint(capsys, f"{line} -o o.png --panel p.yaml"))
    assert not (folder / "o.png").exists()


def test_a_command_says_what_it_took_the_photo_for(folder, capsys):
    write_scene()
    depth = read_image("depth.exr")[..., 0].copy()
    depth[0, :30], depth[1, :12] = np.inf, np.nan
    np.savez("d.npz", depth=depth, focallength_px=np.float32(50))
    out = run(capsys, "encode photo.png --depth d.npz -o o.png --panel p.yaml --save-gaussians g.ply").splitlines()[0]
    near, far = np.nanmin(depth), depth[np.isfinite(depth)].max()
    assert (
        out
        == (
            f"photo.png: 60 x 40, whole picture, depth by d.npz: distance as z {near:.4g}..{far:.4g}, 1.2% "
            f"infinitely far (put at {2 * far:.4g}), 0.5% not measured, focal length 50 px, of d.npz, "
        )
        + out[out.index("fit ") :]
    )
    assert out.endswith("(assumed; --fit cover, --fit contain)")
    means = lf.Gaussians.load("g.ply").means
    assert float(means[0, 2]) == pytest.approx(2 * far, rel=1e-5)
    assert float(means[0, 0] / means[0, 2]) == pytest.approx(-29.5 / 50, rel=1e-5)


def test_intrinsics_of_another_photo_are_noted(folder, capsys):
    write_scene()
    for intrinsics, words in (("50,50,20,20", "far off its middle"), ("400,400,30,20", "8.578 degrees")):
        line = f"encode photo.png --depth depth.exr --intrinsics {intrinsics} -o o.png --panel p.yaml"
        assert cli.main(line.split()) == 0
        assert words in capsys.readouterr().err


@pytest.mark.parametrize("side", ["right", "left", "top", "bottom"])
def test_a_photo_with_its_depth_map_beside_it(folder, capsys, side):
    """By option, by its name, and hinted at where neither says it."""
    colours, depth, _ = view(60, 40, 50.0)
    near = (1 / depth - 1 / 6) / (1 - 1 / 6)
    parts = [to_integers(colours, 8), to_integers(near[..., None].repeat(3, 2).clip(0, 1), 8)]
    write_image("photo.png", parts[0])
    write_image("near.png", parts[1])
    both = np.concatenate(parts if side in ("right", "bottom") else parts[::-1], 1 if side in ("right", "left") else 0)
    write_image("both.png", both)
    write_image("both_rgbd.png", both)
    rest = "-o o.png --panel p.yaml --save-gaussians"
    run(capsys, f"encode photo.png --depth near.png --depth-kind disparity --depth-range 1,1.6 {rest} a.ply")
    out = run(capsys, f"encode both.png --rgbd {side} {rest} b.ply")
    assert f"depth by its {side} half: disparity" in out and "assumed; --depth-kind, --depth-range)" in out
    run(capsys, f"encode both_rgbd.png {rest} c.ply")
    scenes = [lf.Gaussians.load(f"{name}.ply") for name in "abc"]
    assert torch.equal(scenes[0].means, scenes[1].means) and torch.equal(scenes[0].means, scenes[2].means)
    assert f"--rgbd {side}" in complaint(capsys, "encode both.png -o no.png --panel p.yaml")


def test_a_depth_map_is_turned_with_the_photo(folder, capsys):
    write_scene()
    exif = Image.Exif()
    exif[0x0112] = 8
    Image.open("photo.png").save("turned.png", exif=exif)
    depth = read_image("depth.exr")[..., 0]
    np.save("stored.npy", depth)
    np.save("upright.npy", np.rot90(depth))
    for name in ("stored", "upright"):
        run(capsys, f"encode turned.png --depth {name}.npy -o o.png --panel p.yaml --save-gaussians {name}.ply")
    assert torch.equal(*(lf.Gaussians.load(f"{name}.ply").means for name in ("stored", "upright")))
    np.save("square.npy", depth[:, :40])
    Image.open("photo.png").crop((0, 0, 40, 40)).save("square.png", exif=exif)
    line = "encode square.png --depth square.npy -o o.png --panel p.yaml"
    assert "--map-orientation" in complaint(capsys, line)
    run(capsys, f"{line} --map-orientation stored")
