"""Captures that COLMAP posed, from files to photographs of pinhole cameras."""

import warnings

import numpy as np
import pytest
from capture_scene import (
    CENTRE,
    DOTS,
    FOCAL,
    HEIGHT,
    MODELS,
    WIDTH,
    centre_of_dot,
    dots,
    in_pixels,
    parameters,
    ring,
    seen,
    write_capture,
    write_model,
)
from PIL import Image

from lightfield_gs.base.assumptions import Assumption
from lightfield_gs.base.errors import InputError
from lightfield_gs.io.captures.camera_models import COLMAP_MODELS, lens_distortion
from lightfield_gs.io.captures.capture import read_capture, scene_extent
from lightfield_gs.io.captures.colmap import read_model
from lightfield_gs.io.captures.undistortion import reduced


def said(*arguments, **options) -> tuple:
    """A capture, and what was assumed of it, as one text."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        capture = read_capture(*arguments, **options)
    assert all(issubclass(warning.category, Assumption) for warning in caught)
    return capture, "\n".join(str(warning.message) for warning in caught)


@pytest.mark.parametrize("model", MODELS)
def test_lenses_are_their_formulas(model):
    assert set(MODELS) == set(COLMAP_MODELS) and COLMAP_MODELS[model].number == MODELS[model][0]
    lens = lens_distortion(model, MODELS[model][2])
    points = np.array([*DOTS, (0.9, -0.7)])
    found = points if lens is None else lens.distort(points)
    np.testing.assert_allclose(found, [seen(model, *point) for point in points], rtol=1e-12, atol=1e-15)


@pytest.mark.parametrize("form", ["bin", "txt"])
@pytest.mark.parametrize("model", MODELS)
def test_photographs_are_those_of_lenses_without_distortion(tmp_path, model, form):
    """Dots that the lens shows where its formula says are, in what is read, where a pinhole shows them, or for fisheyes
    an equidistant fisheye."""
    write_capture(tmp_path, model, form)
    capture, assumed = said(tmp_path)
    assert capture.model == ("fisheye" if "FISHEYE" in model else "pinhole") and "as a pinhole" not in assumed
    focal = FOCAL[MODELS[model][1]]
    np.testing.assert_array_equal(capture.intrinsics, np.tile([focal[0], focal[-1], *CENTRE], (3, 1)))
    np.testing.assert_array_equal(capture.sizes_px, [(WIDTH, HEIGHT)] * 3)
    picture = capture.image(1)
    for dot in DOTS:
        place = in_pixels(model, seen("FISHEYE", *dot) if capture.model == "fisheye" else dot)
        # A dot is spread by the lens's second derivative: its centre of light is off by some hundredths of a pixel
        assert np.abs(centre_of_dot(picture, place) - place).max() < 0.25, (dot, place)
    if not any(MODELS[model][2]):
        np.testing.assert_array_equal(picture, np.asarray(Image.open(tmp_path / "images/001.png")))
        assert capture.mask(1) is None


@pytest.mark.parametrize("form", ["bin", "txt"])
def test_poses_and_points_are_read(tmp_path, form):
    """Quaternions as COLMAP defines them, against the axis and angle; any length; names with folders and spaces."""
    names = ["b c/2.png", "a/1.png", "a/3.png"]
    quaternion = 3 * np.array([np.cos(0.4), 0, 0, np.sin(0.4)])  # 0.8 about z
    images = [(name, 7, quaternion, (1, 2, 3 + index)) for index, name in enumerate(names)]
    write_capture(tmp_path, form=form, names=names, images=images)
    (tmp_path / "sparse/0/rigs.bin").write_bytes(b"of newer versions")
    capture, assumed = said(tmp_path)
    assert capture.names == ["a/1.png", "a/3.png", "b c/2.png"] and assumed == ""
    turn = np.array([[np.cos(0.8), -np.sin(0.8), 0], [np.sin(0.8), np.cos(0.8), 0], [0, 0, 1]])
    np.testing.assert_allclose(capture.world_to_camera[:, :3, :3], [turn] * 3, atol=1e-15)
    np.testing.assert_array_equal(capture.world_to_camera[:, :3, 3], [(1, 2, 4), (1, 2, 5), (1, 2, 3)])
    np.testing.assert_allclose(capture.centres[2], -turn.T @ (1, 2, 3))
    np.testing.assert_array_equal(capture.points, [(0.1, 0.2, 0.3), (-0.1, 0.2, 0.1), (0.3, 0, 0)])
    np.testing.assert_array_equal(capture.colours, [(255, 0, 7), (1, 2, 3), (4, 5, 6)])


@pytest.mark.parametrize("model", ["FULL_OPENCV", "OPENCV", "RADIAL", "FOV", "EUCM", "DIVISION"])
def test_a_lens_of_zeros_is_none(tmp_path, model):
    """Photographs come byte for byte as they are stored."""
    _, focal_lengths, coefficients = MODELS[model]
    numbers = [*FOCAL[focal_lengths], *CENTRE, *[0.0] * len(coefficients)]
    write_capture(tmp_path, "PINHOLE", cameras=[(7, model, WIDTH, HEIGHT, numbers)])
    capture, _ = said(tmp_path)
    np.testing.assert_array_equal(capture.image(0), np.asarray(Image.open(tmp_path / "images/000.png")))
    assert capture.mask(0) is None


def test_what_no_lens_showed_is_masked(tmp_path):
    """A pincushion's corners: where the formula leads out of the frame, and nowhere else."""
    write_capture(tmp_path, "RADIAL")
    mask = said(tmp_path)[0].mask(0)
    for row in range(0, HEIGHT, 5):
        for column in range(0, WIDTH, 5):
            u, v = (column + 0.5 - CENTRE[0]) / 70, (row + 0.5 - CENTRE[1]) / 70
            x, y = in_pixels("RADIAL", seen("RADIAL", u, v))
            assert mask[row, column] == (255 if 0 <= x <= WIDTH and 0 <= y <= HEIGHT else 0)
    assert 0 < (mask == 0).mean() < 0.5


def test_what_is_transparent_is_told_from_what_no_lens_showed(tmp_path):
    alpha = np.full((HEIGHT, WIDTH), 255, np.uint8)
    alpha[:, 60:] = 0
    write_capture(tmp_path, "RADIAL", picture=np.dstack([dots([(20, 20)]), alpha]))
    capture = said(tmp_path)[0]
    frame, opacity = capture.valid_area(0), capture.opacity(0)
    np.testing.assert_array_equal(capture.mask(0), np.minimum(frame, opacity))
    assert frame[0, 0] == 0 and frame[HEIGHT // 2, 70] == 255  # no lens showed the corner; column 70 is seen, and is
    assert opacity[HEIGHT // 2, 70] == 0 and opacity[HEIGHT // 2, 30] == 255  # transparent


def test_a_lens_that_folds_most_of_the_picture_is_refused(tmp_path):
    write_capture(tmp_path, "SIMPLE_RADIAL", cameras=[(7, "SIMPLE_RADIAL", WIDTH, HEIGHT, [70, *CENTRE, -5.0])])
    with pytest.raises(InputError, match="the lens SIMPLE_RADIAL k -5 folds .*% of the picture"):
        read_capture(tmp_path)


@pytest.mark.parametrize("model", ["PINHOLE", "SIMPLE_RADIAL"])
def test_intrinsics_follow_the_files(tmp_path, model):
    """Dots of images that were reduced to 32 x 23 of 96 x 72, rounded, and further in memory, fit the intrinsics."""
    ratio = np.array([49 / WIDTH, 36 / HEIGHT])
    places = [np.array(in_pixels(model, seen(model, *dot))) * ratio for dot in DOTS]
    write_capture(tmp_path, model)
    for index in range(3):
        (tmp_path / "images_2").mkdir(exist_ok=True)
        Image.fromarray(dots(places, 49, 36, 1.5)).save(tmp_path / f"images_2/{index:03d}.JPG", quality=98)
    capture, assumed = said(tmp_path, images="images_2")
    assert "000.JPG is 49 x 36, its camera 96 x 72" in assumed
    focal = FOCAL[MODELS[model][1]]
    expected = np.array([focal[0], focal[-1], *CENTRE]) * np.tile(ratio, 2)
    np.testing.assert_allclose(capture.intrinsics[0], expected, rtol=1e-15)
    small, _ = said(tmp_path, images=tmp_path / "images_2", longest_px=33)
    np.testing.assert_array_equal(small.sizes_px[0], (33, 24))
    np.testing.assert_allclose(small.intrinsics[0], expected * np.tile([33 / 49, 24 / 36], 2), rtol=1e-15)
    for one, reach in ((capture, 4), (small, 3)):
        picture = one.image(0)
        assert picture.shape == (*one.sizes_px[0, ::-1], 3)
        for dot in DOTS:
            place = dot * one.intrinsics[0, :2] + one.intrinsics[0, 2:]
            assert np.abs(centre_of_dot(picture, place, reach) - place).max() < 0.25


def test_scale_takes_means_of_areas():
    image = np.random.default_rng(1).integers(0, 256, (7, 10, 2), np.uint8)
    fine = np.repeat(np.repeat(image.astype(float), 3, 0), 4, 1)  # 21 x 40, whose stretches of 7 x 10 are whole
    np.testing.assert_array_equal(reduced(image, 4, 3), np.rint(fine.reshape(3, 7, 4, 10, 2).mean((1, 3))))
    np.testing.assert_array_equal(reduced(image[..., 0], 10, 7), image[..., 0])


@pytest.mark.parametrize("name", ["{}.png", "{}.png.png", "{}.JPG", "{}.png.mask.png", "{}_mask.png"])
def test_masks(tmp_path, name):
    """As COLMAP and nerfstudio name them; one that is missing counts as a whole; reduced with the photographs."""
    write_capture(tmp_path, names=["a/0.png", "a/1.png", "2.png"])
    mask = np.zeros((HEIGHT, WIDTH), np.uint8)
    mask[:40, :50] = 255
    for stem in ("a/0", "2"):
        path = tmp_path / "masks" / name.format(stem)
        path.parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(mask).save(path, quality=100)
    capture, assumed = said(tmp_path)
    assert "masks counts" in assumed and "1 without one count as a whole: a/1.png" in assumed
    np.testing.assert_allclose(capture.mask(0), mask, atol=4)
    np.testing.assert_allclose(capture.mask(1), mask, atol=4)
    assert capture.mask(2) is None
    half = said(tmp_path, scale=0.5)[0].mask(0)
    np.testing.assert_allclose(half, mask[::2, ::2], atol=4)
    with pytest.raises(InputError, match="none: missing masks: expected 2.png.png or 2.png"):
        (tmp_path / "none").mkdir()
        read_capture(tmp_path, masks=tmp_path / "none")


@pytest.mark.parametrize(
    "name", ["mask/{}.png", "Masks/{}.png", "images/mask/{}_mask.png", "images/{}.png.mask.png", "images/{}_mask.png"]
)
def test_masks_are_no_photographs_wherever_they_lie(tmp_path, name):
    """In the folders that programs write them to, and beside the photographs."""
    write_capture(tmp_path)
    for stem in ("000", "001", "002"):
        path = tmp_path / name.format(stem)
        path.parent.mkdir(exist_ok=True)
        Image.fromarray(np.eye(HEIGHT, WIDTH, dtype=np.uint8) * 255).save(path)
    capture, assumed = said(tmp_path)
    assert len(capture.names) == 3 and (capture.mask(1) == np.eye(HEIGHT, WIDTH) * 255).all()
    assert "counts" in assumed and "left out" not in assumed and "belong" not in assumed


def test_masks_of_no_photograph_are_said(tmp_path):
    write_capture(tmp_path, names=["a.png", "b.png", "c.png"])
    Image.fromarray(dots([(9, 9)])).save(tmp_path / "images/unposed.png")
    (tmp_path / "masks").mkdir()
    for number in range(4):
        Image.fromarray(dots([(20, 20)])).save(tmp_path / f"masks/{number}.png")
    capture, assumed = said(tmp_path)
    assert f"{tmp_path}/masks holds 4 pictures, none of which belongs to a photograph: 0.png, 1.png" in assumed
    assert "a.png.png, a.png, or one with .mask.png" in assumed and capture.mask(0) is None
    for number, name in enumerate(("a", "b", "unposed")):
        (tmp_path / f"masks/{number}.png").rename(tmp_path / f"masks/{name}_mask.png")
    assumed = said(tmp_path)[1]
    assert "masks holds 4 pictures, 1 of which belongs to no photograph: 3.png" in assumed


def test_hidden_files_are_no_photographs(tmp_path):
    """As macOS leaves them beside each file on a disk of another system."""
    write_capture(tmp_path)
    (tmp_path / "masks").mkdir()
    for name in ("images/._000.png", "images/.trash/3.png", "masks/._000.png", "masks/.000.png.mask.png"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_bytes(b"\0\5\x16\7")
    capture, assumed = said(tmp_path)
    assert len(capture.names) == 3 and not assumed


def test_alpha_is_a_mask_too(tmp_path):
    alpha = np.full((HEIGHT, WIDTH), 255, np.uint8)
    alpha[:, 60:] = 0
    write_capture(tmp_path, picture=np.dstack([dots([(20, 20)]), alpha]))
    mask = np.zeros((HEIGHT, WIDTH), np.uint8)
    mask[:30] = 255
    (tmp_path / "masks").mkdir()
    Image.fromarray(mask[::2, ::2]).save(tmp_path / "masks/000.png")  # of another size
    capture, assumed = said(tmp_path)
    assert "what is opaque counts in 3 of 3 photographs" in assumed
    np.testing.assert_array_equal(capture.mask(0), np.minimum(mask, alpha))
    np.testing.assert_array_equal(capture.mask(1), alpha)
    np.testing.assert_array_equal(capture.image(0), dots([(20, 20)]))


@pytest.mark.parametrize("model, scale", [("PINHOLE", 0.3), ("RADIAL", 1.0), ("RADIAL", 0.5)])
def test_colours_of_transparent_pixels_bleed_into_no_edge(tmp_path, model, scale):
    """A red disc over transparent green, with soft edges: wherever it is not all transparent, it is red."""
    rows, columns = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    alpha = np.clip(20.5 - np.hypot(columns - WIDTH / 2, rows - HEIGHT / 2), 0, 1)
    picture = np.zeros((HEIGHT, WIDTH, 4), np.uint8)
    picture[..., 0], picture[..., 1], picture[..., 3] = 200 * (alpha > 0), 255 * (alpha == 0), np.rint(255 * alpha)
    write_capture(tmp_path, model, picture=picture)
    capture = said(tmp_path, scale=scale)[0]
    image, opacity = capture.image(0).astype(int), capture.opacity(0)
    edge = (opacity > 0) & (opacity < 255)
    assert edge.sum() > 20 and (abs(image[opacity > 0] - (200, 0, 0)) <= 1).all()


def test_what_is_missing_is_named_at_once(tmp_path):
    write_capture(tmp_path, count=6)
    for index in (0, 2, 3, 5):
        (tmp_path / f"images/{index:03d}.png").unlink()
    with pytest.raises(InputError, match=r"images: missing 4 of 6 photographs: 000.png, 002.png, 003.png, \.\.\.: put"):
        read_capture(tmp_path)
    with pytest.raises(InputError, match="images: expected a folder, got images_8"):
        read_capture(tmp_path, images="images_8")
    for part in ("images", "sparse"):
        with pytest.raises(InputError, match=f"{part}: is one folder of a capture: give the folder above, {tmp_path}$"):
            read_capture(tmp_path / part)
    (tmp_path / "sparse/0/cameras.bin").unlink()
    with pytest.raises(InputError, match="0: missing cameras.bin or cameras.txt"):
        read_capture(tmp_path)


@pytest.mark.parametrize("file", ["cameras.bin", "images.bin", "points3D.bin"])
def test_cut_models_are_refused(tmp_path, file):
    write_capture(tmp_path)
    path = tmp_path / "sparse/0" / file
    data = path.read_bytes()
    for length in range(len(data)):
        path.write_bytes(data[:length])
        with pytest.raises(InputError, match=file):
            read_model(path.parent)


def test_models_that_make_no_sense(tmp_path):
    pose = ring(1)[0]
    camera = (7, "PINHOLE", WIDTH, HEIGHT, parameters("PINHOLE"))
    for images, words in (
        ([("a.png", 7, *pose), ("a.png", 7, *pose)], "each photograph once, got 'a.png' twice"),
        ([("a.png", 8, *pose)], "'a.png': expected a camera of the file cameras, got number 8"),
        ([], "expected photographs with poses, got none"),
    ):
        write_model(tmp_path, "txt", [camera], images)
        with pytest.raises(InputError, match=words):
            read_model(tmp_path)
    write_model(tmp_path, "txt", [(*camera[:4], parameters("PINHOLE")[:-1])], [("a.png", 7, *pose)])
    with pytest.raises(InputError, match="cameras.txt: camera of PINHOLE: expected 4 parameters, got 3"):
        read_model(tmp_path)


def test_what_has_no_pose_is_left_out_and_said(tmp_path):
    poses = [*ring(2), ((0, 0, 0, 0), (0, 0, 0))]
    images = [(f"{index:03d}.png", 7, *pose) for index, pose in enumerate(poses)]
    write_capture(tmp_path, count=4, images=images)
    capture, assumed = said(tmp_path)
    assert capture.names == ["000.png", "001.png"]
    assert "1 photograph has no pose there and is left out: 002.png" in assumed
    assert "1 photograph is not in the model" in assumed and "left out: 003.png" in assumed


@pytest.mark.parametrize("place", ["colmap/sparse", "colmap", "colmap/0", "distorted/sparse"])
def test_models_that_other_programs_keep_elsewhere(tmp_path, place):
    write_capture(tmp_path)
    (tmp_path / "sparse").rename(tmp_path / "kept")
    (tmp_path / place).parent.mkdir(exist_ok=True)
    (tmp_path / "kept/0").rename(tmp_path / place)
    assert len(read_capture(tmp_path).names) == 3


@pytest.mark.parametrize("place", ["dense", "dense/0", "bicycle"])
def test_the_capture_in_a_folder_is_named(tmp_path, place):
    write_capture(tmp_path / place)
    with pytest.raises(InputError, match=f"is no capture: give the one that it holds, {tmp_path / place}$"):
        read_capture(tmp_path)


def test_photographs_from_one_place_are_said(tmp_path):
    turned = [(quaternion, (0, 0, 0)) for quaternion, _ in ring(3)]
    write_capture(tmp_path, images=[(f"{index:03d}.png", 7, *pose) for index, pose in enumerate(turned)])
    assert "all 3 photographs are from one place: nothing says how far" in said(tmp_path)[1]


def test_photographs_of_another_shape_are_refused(tmp_path):
    write_capture(tmp_path)
    Image.new("RGB", (HEIGHT, WIDTH)).save(tmp_path / "images/001.png")
    with pytest.raises(InputError, match="001.png: expected the shape of its camera's pictures, 96 x 72, got 72 x 96"):
        read_capture(tmp_path)


def test_points_that_mean_nothing_are_left_out(tmp_path):
    places = [(0.1, 0, 0), (0, 0.2, 0), (np.nan, 0, 0), (0, 0, 0.1), (1e7, 0, 0), (0, np.inf, 0)]
    write_capture(tmp_path, points=[(place, (index, 0, 0)) for index, place in enumerate(places)])
    capture, assumed = said(tmp_path)
    assert capture.colours[:, 0].tolist() == [0, 1, 3] and "3 of 6 points are not finite or absurdly far" in assumed


def test_extent_is_that_of_kerbl_but_for_outliers(tmp_path):
    write_capture(tmp_path, count=12)
    capture, _ = said(tmp_path)
    assert capture.extent == pytest.approx(1.1 * 2)
    centres = np.concatenate([capture.centres, [(300.0, 0, 0)]])
    assert scene_extent(centres, capture.points) == pytest.approx(1.1 * 2)
    uneven = np.random.default_rng(0).normal(size=(40, 3)) * (1, 0.2, 1)
    assert scene_extent(uneven, capture.points) == 1.1 * np.linalg.norm(uneven - uneven.mean(0), axis=1).max()
    assert scene_extent(np.zeros((3, 3)), np.array([(0, 0, 5.0)])) == 5
    assert scene_extent(np.zeros((1, 3)), np.zeros((0, 3))) == 1


def test_split_holds_out_the_middle_of_every_few(tmp_path):
    write_capture(tmp_path, count=11, names=[f"f/{index:03d}.png" for index in range(11)])
    capture, _ = said(tmp_path)
    train, test = capture.split(4)
    assert test == [2, 6, 10] and train == [0, 1, 3, 4, 5, 7, 8, 9]
    assert capture.split(None) == (list(range(11)), [])
    assert capture.split(8, ["004.png", "f/001.png"])[1] == [1, 4]
    with pytest.raises(InputError, match="test photograph 9.png: expected the name of one of the 11"):
        capture.split(None, ["9.png"])
    with pytest.raises(InputError, match="all 11 are held out"):
        capture.split(None, capture.names)


def test_real_tracks_are_where_the_lens_shows_them(shared_dir):
    """COLMAP's own observations of its points, in its pixels: our poses and lens project to them."""
    import struct

    folder = shared_dir / "data/scenes/banana"
    if not folder.is_dir():
        pytest.skip(f"no {folder}")
    capture, _ = said(folder)
    points, observations = {}, []
    data, place = (folder / "sparse/0/points3D.bin").read_bytes(), 8
    for _ in range(struct.unpack_from("<Q", data)[0]):
        number, *values, length = struct.unpack_from("<Q3d3BdQ", data, place)
        points[number] = values[:3]
        place += 51 + 8 * length
    data, place = (folder / "sparse/0/images.bin").read_bytes(), 8
    for _ in range(struct.unpack_from("<Q", data)[0]):
        end = data.index(b"\0", place + 64)
        name, (count,) = data[place + 64 : end].decode(), struct.unpack_from("<Q", data, end + 1)
        rows = struct.iter_unpack("<ddq", data[end + 9 : end + 9 + 24 * count])
        observations += [(capture.names.index(name), x, y, points[point]) for x, y, point in rows if point >= 0]
        place = end + 9 + 24 * count
    indices, seen_at, world = (
        np.array([row[0] for row in observations]),
        *(np.array([row[part] for row in observations]) for part in (slice(1, 3), 3)),
    )
    pose = capture.world_to_camera[indices]
    local = (pose[:, :3, :3] @ world[..., None])[..., 0] + pose[:, :3, 3]
    lens = capture.photographs[0].distortion
    places = lens.distort(local[:, :2] / local[:, 2:]) * capture.intrinsics[0, :2] + capture.intrinsics[0, 2:]
    errors = np.linalg.norm(places - seen_at, axis=1)
    assert len(errors) > 10_000 and np.median(errors) < 0.35 and errors.mean() < 0.45
