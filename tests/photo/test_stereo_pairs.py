"""Stereo pairs as photos: the depth of a pair that was drawn, which eye is which, and what files say of themselves."""

import base64
import io
import json
import struct
import zlib
from pathlib import Path

import numpy as np
import pytest
import torch
from heic_maker import heic
from PIL import Image
from rgbd_scene import TEXTURED, camera, textured

import lightfield_gs as lf
from lightfield_gs.app.options import PhotoOptions
from lightfield_gs.app.photo import read_photo
from lightfield_gs.app.photo_pair import pair_of
from lightfield_gs.base.errors import InputError
from lightfield_gs.encoding.stereo import join_eyes, render_eyes
from lightfield_gs.io.images import write_image
from lightfield_gs.io.jpeg_pairs import write_jpeg, write_mpo
from lightfield_gs.io.stereo_names import layout_in_name
from lightfield_gs.panels.rig import Rig
from lightfield_gs.panels.simulate import simulate
from lightfield_gs.panels.stereo_screen import LEFT_RIGHT, StereoScreen, eye_geometry
from lightfield_gs.photo.rgbd import from_depth
from lightfield_gs.photo.stereo_pair import find_pair, read_pair

WIDTH, HEIGHT, FOCAL = TEXTURED


@pytest.fixture(scope="module")
def drawn():
    """The pictures of two eyes, the left one's true depths, and how they hang together."""
    image, depth = textured()
    gaussians = from_depth(image, depth, (FOCAL, FOCAL))
    panel = StereoScreen(WIDTH, HEIGHT).panel()
    rig = Rig(np.eye(4), (FOCAL, FOCAL), (WIDTH / 2, HEIGHT / 2), 1.6)
    truth = lf.render(gaussians, rig.cameras_at(panel, LEFT_RIGHT[:1]), depth=True).depth[0].numpy()
    return (
        render_eyes(gaussians, panel, rig),
        truth,
        {"stereo": json.dumps({"layout": "mpo"} | eye_geometry(panel, rig))},
    )


def error_of(z: np.ndarray, truth: np.ndarray) -> float:
    """Mean relative difference of distances, off the border that one eye alone sees."""
    inner = (slice(8, -8), slice(WIDTH // 8, -WIDTH // 8))
    return float(np.abs(z[inner] / truth[inner] - 1).mean())


def test_a_pair_that_was_drawn_gives_its_depth_back(tmp_path, drawn):
    pytest.importorskip("cv2", reason="OpenCV is not installed")
    eyes, truth, record = drawn
    write_mpo(tmp_path / "a.mpo", [eye.numpy() for eye in eyes], record)
    read = read_photo(tmp_path / "a.mpo", PhotoOptions())
    assert "its two pictures, two pictures, the first picture is the left eye's" in read.depth.description
    assert error_of(read.depth.z, truth) < 0.02
    assert read.is_whole and read.options.intrinsics[:2] == (FOCAL, FOCAL) and read.options.intrinsics[2] < WIDTH / 2


@pytest.mark.parametrize(
    "layout, name", [("sbs", "a_2x1.png"), ("half-sbs", "a_half_2x1.png"), ("tab", "a_TAB.png"), ("jps", "a.jps")]
)
def test_near_is_near_whatever_the_file(tmp_path, drawn, layout, name):
    """Distances of unknown cameras lie between assumed ends; the left eye's picture is the left one."""
    pytest.importorskip("cv2", reason="OpenCV is not installed")
    eyes, truth, _ = drawn
    path = tmp_path / name
    if layout == "jps":
        write_jpeg(path, join_eyes(eyes, "sbs").numpy(), {})
    else:
        write_image(path, join_eyes(eyes, layout).numpy())
    read = read_photo(path, PhotoOptions())
    z = read.depth.z
    assert z.shape == (HEIGHT, WIDTH) and "put at z 1.6 and 1 (assumed; depth_range=)" in read.depth.description
    inner = (slice(8, -8), slice(WIDTH // 8, -WIDTH // 8))
    assert np.corrcoef(1 / z[inner].ravel(), 1 / truth[inner].ravel())[0, 1] > 0.95
    swapped = read_photo(path, PhotoOptions(swap_eyes=True)).depth.z
    assert np.corrcoef(1 / swapped[inner].ravel(), 1 / truth[inner].ravel())[0, 1] < -0.5


def stored(folder: Path, name: str, eyes: tuple[np.ndarray, np.ndarray]) -> Path:
    """The eyes' pictures, the left one's first, in a file as its name says."""
    path, (left, right) = folder / name, eyes
    crossed, joined = np.concatenate([right, left], 1), torch.from_numpy(np.stack(eyes))
    if path.suffix == ".mpo":
        write_mpo(path, eyes, {})
    elif path.suffix == ".heic":
        pytest.importorskip("pi_heif", reason="pi-heif is not installed")
        path.write_bytes(heic(left, right=right))
    elif name == "left_first.jps":
        write_jpeg(path, join_eyes(joined, "sbs").numpy(), {})
    elif name == "gimage.jpg":
        packet = f'<x xmlns:GImage="{GIMAGE}" GImage:Data="{base64.b64encode(jpeg(right)).decode()}"/>'
        segment = b"http://ns.adobe.com/xap/1.0/\0" + packet.encode()
        data = jpeg(left)
        path.write_bytes(data[:20] + b"\xff\xe1" + struct.pack(">H", 2 + len(segment)) + segment + data[20:])
    elif name == "ster.png":
        file = io.BytesIO()
        Image.fromarray(crossed).save(file, "PNG")
        chunk = struct.pack(">4sB", b"sTER", 0)
        whole = struct.pack(">I", 1) + chunk + struct.pack(">I", zlib.crc32(chunk))
        path.write_bytes(file.getvalue()[:33] + whole + file.getvalue()[33:])
    elif path.suffix == ".jps" or "crosseyed" in name:
        path.write_bytes(jpeg(crossed))
    else:
        write_image(path, join_eyes(joined, layout_in_name(path).kind.replace("half-tab", "tab")).numpy())
    return path


GIMAGE = "http://ns.google.com/photos/1.0/image/"
INPUTS = ("a.mpo", "a.heic", "left_first.jps", "bare.jps", "gimage.jpg", "ster.png")
INPUTS += ("a_LRF_Full_SBS.png", "a_half_2x1.png", "a_TAB.png", "a_crosseyed.jpg")


@pytest.mark.parametrize("name", INPUTS)
def test_right_eyes_before_the_panel_see_the_right_picture(tmp_path, name):
    """Of a scene made of a pair, by `simulate`: what is near is to the right for the left eye, as in the pair."""
    pytest.importorskip("cv2", reason="OpenCV is not installed")
    eyes = tuple(np.rint(255 * textured(offset)[0]).astype(np.uint8) for offset in (0, 0.12))
    read = read_photo(stored(tmp_path, name, eyes), PhotoOptions())
    z = read.depth.z
    gaussians = from_depth(read.photo.floats(), z, (FOCAL, FOCAL))
    panel = lf.Panel(2 * WIDTH, 2 * HEIGHT, 16, 6.0, 0.0, cone_deg=20, viewing_distance_mm=600, pixel_pitch_mm=0.2)
    ball, centre = slice(100, 170), (HEIGHT // 2, 135)
    plane = (float(z[centre]) + float(np.median(z))) / 2  # between the ball and the wall
    rig = Rig(np.eye(4), (2 * FOCAL, 2 * FOCAL), (WIDTH, HEIGHT), plane)
    image = lf.encode(gaussians, panel, rig).numpy()
    left, right = (simulate(image, panel, (x, 0, 600)).mean(2)[60:130] for x in (-31.5, 31.5))
    shifts = range(-12, 13)
    apart = [np.abs(left[:, ball] - np.roll(right, shift, 1)[:, ball]).mean() for shift in shifts]
    assert shifts[int(np.argmin(apart))] > 0


def test_pictures_that_do_not_match_are_refused_with_a_way_out(tmp_path):
    pytest.importorskip("cv2", reason="OpenCV is not installed")
    noise = np.random.default_rng(0).integers(0, 255, (96, 256, 3), np.uint8)
    write_image(tmp_path / "a_sbs.png", noise)
    with pytest.raises(InputError, match="do not match .* give depth=FILE, or stereo_in=none"):
        read_photo(tmp_path / "a_sbs.png", PhotoOptions())


def test_eyes_at_other_heights_are_made_level(drawn):
    cv2 = pytest.importorskip("cv2", reason="OpenCV is not installed")
    from lightfield_gs.photo.stereo_matching import match_eyes

    left, right = (eye.numpy() for eye in drawn[0])
    turn = cv2.getRotationMatrix2D((WIDTH / 2, HEIGHT / 2), 1.0, 1.0) + np.array([[0, 0, 0], [0, 0, 4.0]])
    moved = cv2.warpAffine(right, turn, (WIDTH, HEIGHT), borderMode=cv2.BORDER_REPLICATE)
    inner = (slice(16, -16), slice(WIDTH // 8, -WIDTH // 8))
    plain, found = match_eyes("a", left, right), match_eyes("a", left, moved)
    assert plain.raised_px == 0 and 4 < found.raised_px < 8
    assert np.abs(found.shifts - plain.shifts)[inner].mean() < 1


def test_files_say_where_the_eyes_are(tmp_path, drawn):
    """A chunk sTER of either order, a segment of JPS, names; an ordinary photo says nothing."""
    pair = join_eyes(drawn[0], "sbs").numpy()
    file = io.BytesIO()
    Image.fromarray(pair).save(file, "PNG")
    data = file.getvalue()
    for order in (0, 1):
        chunk = struct.pack(">I4sB", 1, b"sTER", order)
        crc = zlib.crc32(chunk[4:])
        (tmp_path / "b.png").write_bytes(data[:33] + chunk + struct.pack(">I", crc) + data[33:])
        found = find_pair(tmp_path / "b.png")
        assert (found.kind, found.is_swapped, found.source) == ("sbs", order == 0, "its chunk sTER")
        (tmp_path / "b.png").unlink()
    write_jpeg(tmp_path / "a.jps", pair, {})
    assert find_pair(tmp_path / "a.jps").is_swapped is False
    write_jpeg(tmp_path / "plain.jpg", pair, {})
    (tmp_path / "plain.jpg").rename(tmp_path / "c.jps")
    assert find_pair(tmp_path / "c.jps").is_swapped is True
    write_image(tmp_path / "photo.png", pair)
    assert find_pair(tmp_path / "photo.png") is None
    assert pair_of(tmp_path / "photo.png", PhotoOptions(stereo_in="tab")).kind == "tab"
    assert pair_of(Path("a_2x1.png"), PhotoOptions(stereo_in="none")) is None


def jpeg(pixels: np.ndarray) -> bytes:
    file = io.BytesIO()
    Image.fromarray(pixels).save(file, "JPEG", quality=95)
    return file.getvalue()


def mpo(parts: list[bytes], kinds: list[int], order: str = "<", off: int = 0) -> bytes:
    """JPEGs one after the other, the first with a list of all of these kinds (CIPA DC-007).

    Args:
        parts: The JPEGs.
        kinds: The attribute of each.
        order: Of the bytes.
        off: What the offsets are wrong by.
    """
    at = 4 + int.from_bytes(parts[0][4:6], "big")
    count = len(parts)
    head = struct.pack(f"{order}2sHIH", b"II" if order == "<" else b"MM", 42, 8, 3)
    head += struct.pack(f"{order}HHI4s", 0xB000, 7, 4, b"0100") + struct.pack(f"{order}HHII", 0xB001, 4, 1, count)
    head += struct.pack(f"{order}HHIII", 0xB002, 7, 16 * count, 50, 0)
    added = 8 + len(head) + 16 * count
    starts = np.cumsum([0, *(len(part) for part in parts)]) + added - (at + 8)
    rows = b"".join(
        struct.pack(f"{order}IIIHH", kind, len(part), starts[index] + off if index else 0, 0, 0)
        for index, (part, kind) in enumerate(zip(parts, kinds))
    )
    listed = b"\xff\xe2" + struct.pack(">H", added - 2) + b"MPF\0" + head + rows
    return parts[0][:at] + listed + b"".join([parts[0][at:], *parts[1:]])


DISPARITY, FLAGS, VGA, PRIMARY = 0x020002, 1 << 29 | 1 << 31, 0x010001, 0x030000


@pytest.mark.parametrize(
    "between, kinds, order, off",
    [
        (0, (DISPARITY | FLAGS, DISPARITY), "<", 0),
        (0, (DISPARITY | FLAGS, DISPARITY), ">", 0),
        (1, (DISPARITY | FLAGS, VGA, DISPARITY), "<", 0),  # a camera's preview before the right eye's picture
        (0, (PRIMARY | FLAGS, 0), "<", 0),
        (1, (0, 0, 0), "<", 0),
        (0, (DISPARITY, DISPARITY), "<", 7),
        (0, None, "<", 0),  # joined by hand, without a list
    ],
)
def test_the_right_eyes_picture_of_an_mpo_is_found(tmp_path, drawn, between, kinds, order, off):
    left, right = (eye.numpy() for eye in drawn[0])
    parts = [jpeg(left), *[jpeg(left[::2, ::2])] * between, jpeg(right)]
    (tmp_path / "a.mpo").write_bytes(b"".join(parts) if kinds is None else mpo(parts, kinds, order, off))
    layout = find_pair(tmp_path / "a.mpo")
    assert layout.kind == "two" and not layout.is_swapped
    pair = read_pair(tmp_path / "a.mpo", layout)
    for eye, own in ((pair.left, left), (pair.right, right)):
        assert np.abs(eye.pixels.astype(int) - own).mean() < 3


def test_previews_of_phones_are_no_second_eye(tmp_path, drawn):
    left = drawn[0][0].numpy()
    (tmp_path / "a.jpg").write_bytes(mpo([jpeg(left), jpeg(left[::2, ::2])], [PRIMARY | FLAGS, VGA]))
    assert find_pair(tmp_path / "a.jpg") is None


def test_segments_of_jps_in_either_order_of_bytes(tmp_path, drawn):
    """Separation, flags, layout and kind from high to low, or the other way round; others than pairs are told."""
    left = jpeg(join_eyes(drawn[0], "sbs").numpy())
    for words, found in (
        ((0, 4, 2, 1), ("sbs", False)),
        ((1, 2, 4, 0), ("sbs", False)),
        ((0, 0, 2, 1), ("sbs", True)),
        ((0, 4 | 2, 2, 1), ("half-sbs", False)),
        ((0, 4 | 1, 3, 1), ("half-tab", False)),
        ((0, 0, 0, 0), None),
        ((0, 4, 4, 1), "an anaglyph"),
    ):
        segment = b"_JPSJPS_" + struct.pack(">H4BH", 4, *words, 0)
        data = left[:20] + b"\xff\xe3" + struct.pack(">H", 2 + len(segment)) + segment + left[20:]
        (tmp_path / f"{words}.jps").write_bytes(data)
        if isinstance(found, str):
            with pytest.raises(InputError, match=f"states {found}; .* stereo_in=none"):
                find_pair(tmp_path / f"{words}.jps")
            continue
        layout = find_pair(tmp_path / f"{words}.jps")
        assert (layout and (layout.kind, layout.is_swapped)) == found


def test_what_the_right_eye_sees_behind_edges_is_taken_from_it():
    """Against the scene as a camera at the right eye's place sees it, where the left eye does not."""
    from lightfield_gs.photo.second_eye import second_eye

    offset = 0.12
    (left, z), (right, other_z) = textured(), textured(offset)
    bytes_of = [np.rint(255 * eye).astype(np.uint8) for eye in (left, right)]
    shifts, others = FOCAL * offset / z, FOCAL * offset / other_z
    second = second_eye(*bytes_of, z, shifts, others)
    assert second.per_inverse == pytest.approx(FOCAL * offset, rel=0.01) and abs(second.offset) < 0.05
    # Pixels of the right picture whose surface is covered in the left one
    rows, columns = np.mgrid[:HEIGHT, :WIDTH]
    there = np.rint(columns + others).astype(int)
    hidden = (there < WIDTH) & (z[rows, there.clip(0, WIDTH - 1)] < 0.9 * other_z)
    assert hidden.sum() > 500
    errors = []
    for eye in (None, second):
        gaussians = from_depth(left, z, (FOCAL, FOCAL), second=eye)
        picture = lf.render(gaussians, camera(WIDTH, HEIGHT, FOCAL, offset)).image[0].numpy()
        errors.append(float(np.abs(picture - right)[hidden].mean()))
    assert errors[1] < 0.65 * errors[0], errors


def test_spatial_photos_have_the_distances_of_their_cameras(tmp_path):
    """A HEIC with a group of two eyes: parallel cameras, the baseline in metres."""
    pytest.importorskip("cv2", reason="OpenCV is not installed")
    pytest.importorskip("pi_heif", reason="pi-heif is not installed")
    offset = 0.12
    (left, z), (right, _) = textured(), textured(offset)
    left, right = (np.rint(255 * eye).astype(np.uint8) for eye in (left, right))
    focal = FOCAL / WIDTH / 0.8  # of the file's cameras, by the true one: distances grow alike
    (tmp_path / "a.heic").write_bytes(heic(left, right=right, baseline_m=offset * focal))
    read = read_photo(tmp_path / "a.heic", PhotoOptions())
    assert "its group of two eyes" in read.depth.description and "in metres" in read.depth.description
    assert error_of(read.depth.z, z) < 0.03
    assert read.options.intrinsics == pytest.approx((0.8 * WIDTH, 0.8 * WIDTH, WIDTH / 2, HEIGHT / 2), rel=1e-5)
    (tmp_path / "b.heic").write_bytes(heic(left))
    assert find_pair(tmp_path / "b.heic") is None
