"""Depth maps beside or inside their photo, of other sizes, by the files' names; and stereo pairs."""

import base64
import io
import struct
from pathlib import Path

import numpy as np
import pytest
import torch
from command_line import complaint, run
from PIL import Image
from rgbd_scene import view

import lightfield_gs as lf
from lightfield_gs import cli
from lightfield_gs.io.depth_names import depth_maps_beside, is_sidecar_name
from lightfield_gs.io.images import read_picture, write_image
from lightfield_gs.io.pillow_images import count_pictures
from lightfield_gs.io.xmp import jpeg_xmp
from lightfield_gs.photo.embedded_depth import embedded_facts, embedded_notes, find_embedded_depth
from lightfield_gs.photo.joint_upsampling import resize_to_photo
from lightfield_gs.photo.load import cut_out_photo
from lightfield_gs.photo.side_by_side import depth_side, is_rgbd_name, read_depth_half, stereo_layout
from lightfield_gs.photo.stereo_pair import find_pair
from lightfield_gs.show.preview import to_integers

REST = "-o o.png --panel p.yaml"


def photo_and_map(width: int = 96, height: int = 64) -> tuple[np.ndarray, np.ndarray]:
    """uint8 [H, W, 3] each, of the known scene; of the map bright is near."""
    colours, depth, _ = view(width, height, 0.9 * width)
    return to_integers(colours, 8), to_integers(np.repeat(((1 / depth - 1 / 6) / (1 - 1 / 6))[..., None], 3, 2), 8)


def joined(parts: tuple[np.ndarray, np.ndarray], side: str) -> np.ndarray:
    return np.concatenate(parts if side in ("right", "bottom") else parts[::-1], int(side in ("right", "left")))


def said(capsys, line: str) -> tuple[str, str]:
    """stdout and stderr of a command that succeeds."""
    assert cli.main(line.split()) == 0
    output = capsys.readouterr()
    return output.out, output.err


# Beside the photo


@pytest.mark.parametrize("side", ["right", "left", "top", "bottom"])
@pytest.mark.parametrize("width, quality", [(96, 90), (104, 75), (92, 50)])
def test_a_jpeg_of_photo_and_map_is_taken_as_everyone_saves_it(tmp_path, side, width, quality):
    """With colours at half the size, which run over at the seam: only there, and not into the depths."""
    photo, grey = photo_and_map(width)
    photo[:] = np.maximum(photo, [230, 0, 0]).astype(np.uint8)  # colourful up to the seam
    Image.fromarray(joined((photo, grey), side)).save(tmp_path / "a.jpg", quality=quality, subsampling=2)
    pixels = read_picture(tmp_path / "a.jpg").pixels
    assert depth_side(pixels, is_named=True) == side
    values = read_depth_half("a.jpg", pixels, side).values
    assert values.dtype == np.uint8 and np.abs(values.astype(int) - grey[..., 0]).mean() < 6


@pytest.mark.parametrize("colour", [1.0, 0.2, 0.08])
def test_a_pale_photo_is_told_from_its_map_where_the_name_says_that_there_is_one(colour):
    photo, grey = photo_and_map()
    pale = (photo.mean(2, keepdims=True) * (1 - colour) + photo * colour).astype(np.uint8)
    assert depth_side(joined((pale, grey), "left"), is_named=True) == "left"


def test_where_both_halves_are_grey_or_neither_is_nothing_is_guessed(folder, capsys):
    photo, grey = photo_and_map()
    bare = photo.mean(2, keepdims=True).astype(np.uint8).repeat(3, 2)
    for name, parts in (("grey", (bare, grey)), ("colour", (photo, photo))):
        write_image(f"{name}_rgbd.png", joined(parts, "right"))
        assert "none of its halves is grey beside one in colour" in complaint(capsys, f"encode {name}_rgbd.png {REST}")


def test_halves_that_are_squeezed_are_seen_in_their_shape(folder, capsys):
    """The same scene, as it was before it was squeezed, by its own camera."""
    photo, grey = photo_and_map(128)
    for name, step in (("whole", 1), ("half", 2)):
        write_image(f"{name}.png", joined((photo[:, ::step], grey[:, ::step]), "right"))
    run(capsys, f"encode whole.png --rgbd right {REST} --save-gaussians whole.ply --save-rig whole.yaml")
    out = run(
        capsys, f"encode half.png --rgbd right --pixel-aspect 2 {REST} --save-gaussians half.ply --save-rig half.yaml"
    )
    assert "its pixels 2 times as wide as high" in out
    tops = [lf.Gaussians.load(f"{name}.ply").means[:64] for name in ("whole", "half")]
    assert torch.allclose(tops[0][::2, 2][:30], tops[1][:30, 2], rtol=0.05)
    spans = [float((top[:, 0] / top[:, 2]).min()) for top in tops]
    assert spans[0] == pytest.approx(spans[1], rel=0.02)
    focals = [lf.Rig.from_yaml(f"{name}.yaml").focal_px for name in ("whole", "half")]
    assert np.allclose(*focals, rtol=0.02)
    assert "--pixel-aspect" in complaint(
        capsys, f"encode half.png --rgbd right --pixel-aspect 2 --intrinsics 1,1,1,1 {REST}"
    )


def test_near_and_far_are_said_where_they_are_assumed(folder, capsys):
    photo, grey = photo_and_map()
    write_image("photo.png", photo)
    write_image("map.png", grey)
    np.save("z.npy", 1 + np.ones((64, 96)))
    write_image("both_rgbd.png", joined((photo, grey), "right"))
    for options, words in (
        ("photo.png --depth map.png --depth-range 1,1.6", "dark is near (assumed; --depth-kind), "),
        ("photo.png --depth map.png --depth-range 1.6,1", ", bright is near, "),
        ("photo.png --depth z.npy", "small numbers are near (assumed; --depth-kind), "),
        ("both_rgbd.png", "bright is near (assumed; --depth-kind, --depth-range, --rgbd), "),
        ("both_rgbd.png --depth-range 1.6,1", "distance as z"),
    ):
        assert words in run(capsys, f"encode {options} {REST}"), options
    assert "is near" not in run(
        capsys, f"encode photo.png --depth map.png --depth-kind distance --depth-range 1,2 {REST}"
    )


# Of another size


@pytest.mark.parametrize("turned", [False, True])
def test_a_smaller_map_gets_the_edges_of_the_photo(turned):
    """A square of another colour, 1 before 2, at a third of the size, off its grid; and holes stay holes."""
    photo, true = np.full((60, 90, 3), 0.2, np.float32), np.full((60, 90), 2.0, np.float32)
    photo[19:41, 31:59], true[19:41, 31:59] = (0.9, 0.3, 0.1), 1
    small = true[1::3, 1::3].copy()
    small[:, :3] = np.nan
    if turned:
        photo, true, small = photo.transpose(1, 0, 2).copy(), true.T, small.T.copy()
    z = resize_to_photo(small, photo)
    assert z.shape == true.shape
    off = np.abs(z - true) > 0.02
    hole = np.isnan(z)
    assert (off & ~hole).sum() <= 0.005 * true.size and 0.08 * true.size <= hole.sum() <= 0.12 * true.size


def test_a_map_of_another_size_and_the_same_shape_is_fitted_and_said(folder, capsys):
    photo, grey = photo_and_map()
    write_image("photo.png", photo)
    for name, depth in (
        ("small", grey[::4, ::4]),
        ("odd", grey[::4, :-1:4]),
        ("large", grey.repeat(2, 0).repeat(2, 1)),
    ):
        write_image(f"{name}.png", depth.copy())
        out = run(capsys, f"encode photo.png --depth {name}.png --depth-kind disparity --depth-range 1,2 {REST}")
        assert f"of {depth.shape[1]} x {depth.shape[0]}, fitted to the photo" in out
    write_image("other.png", grey[:, :48].copy())
    assert "or of its shape, got 48 x 64" in complaint(
        capsys, f"encode photo.png --depth other.png --depth-range 1,2 {REST}"
    )


def test_a_small_map_of_the_stored_pixels_is_turned_with_the_photo(folder, capsys):
    photo, grey = photo_and_map()
    exif = Image.Exif()
    exif[0x0112] = 6
    Image.fromarray(photo).save("turned.png", exif=exif)
    write_image("small.png", grey[::4, ::4].copy())
    line = f"encode turned.png --depth small.png --depth-kind disparity --depth-range 1,2 {REST}"
    assert "turned with the photo, of 16 x 24, fitted" in run(capsys, line)


def test_a_photo_that_is_too_large_is_refused_before_its_depth_is_read(folder, capsys, monkeypatch):
    monkeypatch.setattr("lightfield_gs.photo.rgbd.MAX_PIXELS", 1000)
    write_image("photo.png", photo_and_map()[0])
    Path("map.npy").write_bytes(b"never read")
    words = complaint(capsys, f"encode photo.png --depth map.npy {REST}")
    assert "photo.png: 96 x 64 pixels, each a Gaussian; expected at most 1000" in words


# Inside the photo's file


def segment(data: bytes) -> bytes:
    return b"\xff\xe1" + struct.pack(">H", len(data) + 2) + data


def jpeg_with(xmp: str, photo: np.ndarray, extended: str = "", behind: bytes = b"") -> bytes:
    """A JPEG with this XMP, its extension in parts of 1000 bytes, and other bytes behind it."""
    stored = io.BytesIO()
    Image.fromarray(photo).save(stored, "JPEG", quality=95)
    parts = [b"http://ns.adobe.com/xap/1.0/\0" + xmp.encode()]
    long = extended.encode()
    for start in range(0, len(long), 1000):
        place = struct.pack(">32sII", b"A" * 32, len(long), start)
        parts.insert(1, b"http://ns.adobe.com/xmp/extension/\0" + place + long[start : start + 1000])
    return stored.getvalue()[:2] + b"".join(map(segment, parts)) + stored.getvalue()[2:] + behind


def stored_map(values: np.ndarray, kind: str) -> bytes:
    data = io.BytesIO()
    Image.fromarray(values).save(data, kind)
    return data.getvalue()


GDEPTH = 'xmlns:GDepth="http://ns.google.com/photos/1.0/depthmap/"'


def gdepth(kind: str, data: bytes, more: str = "", near: float = 1, far: float = 4) -> str:
    return (
        f'<rdf:Description {GDEPTH} GDepth:Format="{kind}" GDepth:Near="{near}" GDepth:Far="{far}" {more} '
        f'GDepth:Mime="image/png" GDepth:Data="{base64.b64encode(data).decode()}"/>'
    )


@pytest.mark.parametrize("is_extended", [False, True])
@pytest.mark.parametrize("kind", ["RangeLinear", "RangeInverse"])
def test_the_depth_map_in_a_photos_xmp_is_read_by_its_formula(folder, capsys, kind, is_extended):
    """Of 16 bits, at half the size, in one segment or in many; 0 is near, and everything is shown."""
    photo, _ = photo_and_map()
    share = np.linspace(0, 1, 48)[None].repeat(32, 0)
    data = stored_map(np.round(share * 65535).astype(np.uint16), "PNG")
    xmp = gdepth(kind, data)
    Path("a.jpg").write_bytes(jpeg_with("", photo, xmp) if is_extended else jpeg_with(xmp, photo))
    out, err = said(capsys, f"encode a.jpg {REST} --save-gaussians g.ply")
    assert f"depth inside it (GDepth {kind}): " in out and "dark is near by its format" in out and err == ""
    z = lf.Gaussians.load("g.ply").means[: 96 * 64, 2].reshape(64, 96)[30].numpy()
    at = (np.arange(96) + 0.5) / 96
    expected = 1 + 3 * at if kind == "RangeLinear" else 4 / (4 - 3 * at)
    assert np.allclose(z[4:-4], expected[4:-4], rtol=0.08)
    out, _ = said(capsys, f"encode a.jpg {REST} --depth-range 2,1")
    assert "bright is near" in out and "by its format" not in out
    out, _ = said(capsys, "info a.jpg")
    assert f"depth inside: 48 x 32, GDepth {kind}, near 1.0, far 4.0" in out


def test_xmp_as_other_programs_write_it_is_read(tmp_path):
    """In single quotes, as attributes or as elements (exiftool), and with line ends as entities."""
    photo, grey = photo_and_map()
    data = base64.b64encode(stored_map(grey[..., 0], "PNG")).decode()
    space = GDEPTH.replace('"', "'")
    facts = {"Format": "RangeInverse", "Near": "1", "Far": "4", "Data": f"{data[:70]}&#xA;{data[70:]}"}
    elements = "".join(f"<GDepth:{name}>{value}</GDepth:{name}>" for name, value in facts.items())
    attributes = " ".join(f"GDepth:{name}='{value}'" for name, value in facts.items())
    for name, more in (("a", f">{elements}</rdf:Description>"), ("b", f" {attributes}/>")):
        path = tmp_path / f"{name}.jpg"
        path.write_bytes(jpeg_with(f"<rdf:Description {space}{more}", photo))
        inside = find_embedded_depth(path)
        assert inside is not None and (inside.is_inverse, inside.near, inside.far) == (True, 1, 4)
        assert np.array_equal(inside.numbers(path).values, grey[..., 0])


def test_a_second_copy_of_a_download_is_known_by_its_name():
    assert all(is_rgbd_name(Path(name)) for name in ("a_rgbd.png", "a_rgbd (1).png", "a_RGBD(2).jpg"))
    assert not any(is_rgbd_name(Path(name)) for name in ("a_rgb (1).png", "argbd.png", "a_rgbd (copy).png"))


def test_a_depth_map_inside_is_left_out_where_others_are_asked_for_and_that_is_said(folder, capsys):
    photo, grey = photo_and_map()
    Path("a.jpg").write_bytes(jpeg_with(gdepth("RangeInverse", stored_map(grey[..., 0], "JPEG")), photo))
    mask = np.zeros((64, 96, 1), np.uint8)
    mask[20:40, 30:60] = 255
    write_image("mask.png", mask)
    out, err = said(capsys, f"encode a.jpg --mask mask.png {REST}")
    assert "depth" not in out and "a.jpg: a depth map is in it (GDepth RangeInverse) and is not used" in err
    np.save("z.npy", np.full((64, 96), 2.0))
    assert "depth by z.npy" in run(capsys, f"encode a.jpg --depth z.npy {REST}")


def test_limits_that_are_none_and_maps_that_are_damaged(folder, capsys):
    photo, grey = photo_and_map()
    data = stored_map(grey[..., 0], "PNG")
    Path("a.jpg").write_bytes(jpeg_with(gdepth("RangeLinear", data, near=0, far=1), photo))
    assert "z 1.0" in (out := run(capsys, f"encode a.jpg {REST}")) and "near and far assumed (--depth-range)" in out
    for bad in (data[:40], b"no picture"):
        Path("b.jpg").write_bytes(jpeg_with(gdepth("RangeLinear", bad), photo))
        assert "b.jpg: the depth map inside it" in complaint(capsys, f"encode b.jpg {REST}")


def test_the_depth_map_behind_the_picture_is_read(folder, capsys):
    """Dynamic Depth: the items of a container lie behind each other."""
    photo, grey = photo_and_map()
    data, other = stored_map(grey[..., 0], "JPEG"), b"something else" * 9
    space = "http://ns.google.com/photos/dd/1.0/"
    items = f'<Container:Item Item:Mime="image/jpeg" Item:Length="0"/><Container:Item Item:Length="{len(data)}" '
    items += f'Item:DataURI="android/depthmap"/><Container:Item Item:Length="{len(other)}" Item:Semantic="GainMap"/>'
    xmp = (
        f'<x xmlns:DepthMap="{space}depthmap/" DepthMap:Format="RangeInverse" DepthMap:Near="1" DepthMap:Far="4" '
        f'DepthMap:DepthURI="android/depthmap">{items}</x>'
    )
    Path("a.jpg").write_bytes(jpeg_with(xmp, photo, behind=data + other))
    inside = find_embedded_depth("a.jpg")
    assert inside is not None and inside.data == data and (inside.near, inside.far) == (1, 4)
    assert "depth inside it (Dynamic Depth RangeInverse)" in run(capsys, f"encode a.jpg {REST}")
    Path("a.jpg").write_bytes(jpeg_with(xmp, photo))
    assert "a depth map should be in it (Dynamic Depth)" in complaint(capsys, f"encode a.jpg {REST}")


@pytest.mark.parametrize("padding, trailer", [(0, b""), (512, b""), (0, b"SEFH" * 20)])
def test_items_as_elements_with_padding_and_trailers_are_found(tmp_path, padding, trailer):
    """As telephones write Dynamic Depth: also with a trailer of the maker behind all items."""
    photo, grey = photo_and_map()
    data, other = stored_map(grey[..., 0], "JPEG"), b"something else" * 9
    space = "http://ns.google.com/photos/dd/1.0/"
    items = ""
    for semantic, length, more in (("Primary", 0, padding), ("Depth", len(data), 0), ("Confidence", len(other), 0)):
        parts = {"Mime": "image/jpeg", "Semantic": semantic, "Length": length, "Padding": more}
        items += "<Container:Item>" + "".join(f"<Item:{name}>{value}</Item:{name}>" for name, value in parts.items())
        items += "</Container:Item>"
    xmp = f'<x xmlns:DepthMap="{space}depthmap/" DepthMap:Format="RangeInverse" DepthMap:Near="1" DepthMap:Far="4">'
    path = tmp_path / "a.jpg"
    path.write_bytes(jpeg_with(f"{xmp}{items}</x>", photo, behind=bytes(padding) + data + other + trailer))
    inside = find_embedded_depth(path)
    assert inside is not None and inside.data == data


def test_the_picture_before_its_blur_is_no_second_eye(tmp_path):
    """Beside GDepth, GImage holds the photo itself: both in XMP, as Google's camera wrote it."""
    photo, grey = photo_and_map()
    depth = gdepth("RangeInverse", stored_map(grey[..., 0], "JPEG"))
    same = base64.b64encode(stored_map(photo, "JPEG")).decode()
    space = "http://ns.google.com/photos/1.0/image/"
    path = tmp_path / "a.jpg"
    path.write_bytes(jpeg_with(f'{depth}<y xmlns:GImage="{space}" GImage:Data="{same}"/>', photo))
    assert find_pair(path) is None and find_embedded_depth(path).name == "GDepth RangeInverse"


def test_an_extension_of_an_earlier_version_is_left_out(tmp_path):
    photo, _ = photo_and_map()
    guids = ["A" * 32, "B" * 32]
    segments = [b"http://ns.adobe.com/xap/1.0/\0" + f'<x xmpNote:HasExtendedXMP="{guids[0]}"/>'.encode()]
    for guid, words in zip(guids, (b"the present one", b"an older, longer one")):
        head = guid.encode() + len(words).to_bytes(4, "big") + bytes(4)
        segments.append(b"http://ns.adobe.com/xmp/extension/\0" + head + words)
    data = stored_map(photo, "JPEG")
    added = b"".join(b"\xff\xe1" + (2 + len(one)).to_bytes(2, "big") + one for one in segments)
    (tmp_path / "a.jpg").write_bytes(data[:2] + added + data[2:])
    assert jpeg_xmp(tmp_path / "a.jpg").endswith("the present one")


@pytest.mark.parametrize(
    "behind, words",
    [
        (b'<x apdi:AuxiliaryImageType="disparity"/>', "Apple's auxiliary picture"),
        (b"<apdi:AuxiliaryImageType>depth</apdi:AuxiliaryImageType>", "Apple's auxiliary picture"),
        (b"\0DualShot_DepthMap_1\0SEFT", "Samsung's"),
        (b'<x hdrgm:Version="1.0"/>', None),
    ],
)
def test_depth_maps_that_are_not_read_are_said(tmp_path, behind, words):
    path = tmp_path / "a.jpg"
    path.write_bytes(jpeg_with("", photo_and_map()[0], behind=behind))
    notes = embedded_notes(path, is_depth_used=False)
    assert len(notes) == (words is not None)
    assert words is None or f"a depth map is in it ({words}), and is not read" in notes[0]
    assert dict(embedded_facts(path)).keys() == ({"depth inside"} if words else set())


# Pictures in a row, and stereo


def test_of_several_pictures_the_first_is_taken_and_that_is_said(tmp_path):
    frames = [Image.fromarray(np.full((32, 48, 3), level, np.uint8)) for level in (10, 90, 170)]
    for name, count in (
        ("a.gif", 3),
        ("a.webp", 3),
        ("a.png", 3),
        ("a.tif", 3),
        ("b.gif", 1),
        ("b.png", 1),
        ("b.tif", 1),
    ):
        frames[0].save(tmp_path / name, save_all=count > 1, append_images=frames[1:count])
        notes = embedded_notes(tmp_path / name, is_depth_used=False)
        assert len(notes) == (count > 1) and all(f"holds {count} pictures" in words for words in notes)
    frames[0].save(tmp_path / "c.tif", save_all=True, append_images=[frames[1].resize((12, 8))])
    assert not embedded_notes(tmp_path / "c.tif", is_depth_used=False)  # a small copy beside it


def test_the_second_eye_of_a_stereo_photo_is_said(tmp_path):
    """By the ending that such cameras give, of pictures alike; a telephone's .jpg has previews and gain maps too."""
    left, right = (Image.fromarray(photo_and_map()[0][:, start : start + 80]) for start in (0, 8))
    for name, second, expected in (
        ("a.mpo", right, (2, True)),
        ("b.jpg", right, (1, False)),
        ("c.mpo", right.resize((20, 16)), (1, False)),
    ):
        left.save(tmp_path / name, "MPO", save_all=True, append_images=[second])
        assert count_pictures(tmp_path / name) == expected
    assert "stereo photo" in embedded_notes(tmp_path / "a.mpo", is_depth_used=False)[0]


@pytest.mark.parametrize("axis, words", [(1, "side by side"), (0, "one above the other")])
def test_a_stereo_pair_in_one_picture_is_said(folder, capsys, axis, words):
    eyes = [to_integers(view(120, 90, 100.0, offset)[0], 8) for offset in (-0.05, 0.05)]
    pair = np.concatenate(eyes, axis)
    assert stereo_layout(pair) == words
    write_image("pair.png", pair)
    mask = np.full((*pair.shape[:2], 1), 0, np.uint8)
    mask[20:60, 20:60] = 255
    write_image("mask.png", mask)
    _, err = said(capsys, f"encode pair.png --mask mask.png {REST}")
    assert f"pair.png: it looks like a stereo pair, two eyes' pictures {words}, and is taken for one photo" in err


def test_ordinary_pictures_are_no_stereo_pairs():
    """A scene, noise, a wall of bricks, a mirror image, a plain picture, the same twice, and a photo with its map."""
    photo, grey = photo_and_map(128, 96)
    r = np.random.default_rng(0)
    rows, columns = np.mgrid[:96, :192]
    joints = (rows % 12 < 2) | ((columns + 12 * (rows // 12 % 2)) % 24 < 2)
    bricks = np.where(joints, 200, 90) + r.integers(0, 9, (96, 192))
    slope = np.linspace(0, 255, 192)[None].repeat(96, 0)
    for pixels in (
        photo,
        r.integers(0, 256, (96, 128, 3)),
        bricks[..., None].repeat(3, 2),
        np.concatenate([photo, photo[:, ::-1]], 1),
        np.full((96, 128, 3), 200),
        np.concatenate([photo, photo], 1),
        np.concatenate([photo, grey], 1),
        slope[..., None].repeat(3, 2),
    ):
        assert stereo_layout(pixels.astype(np.uint8)) is None


# Masks, and names


def test_a_mask_that_is_inverted_is_noted(tmp_path):
    """All of the rim and a hole; not a mask that touches the rim, covers everything, or has a hole within an object."""
    write_image(tmp_path / "a.png", photo_and_map()[0])
    picture = read_picture(tmp_path / "a.png")
    masks = {name: np.zeros((64, 96, 1), np.uint8) for name in ("object", "touching", "ring", "all")}
    masks["object"][20:40, 30:60], masks["touching"][20:, 10:60], masks["all"][:] = 255, 255, 255
    masks["ring"][10:50, 20:70], masks["ring"][20:30, 30:40] = 255, 0
    masks["inverted"] = 255 - masks["object"]
    for name, mask in masks.items():
        write_image(tmp_path / f"{name}.png", mask)
        notes = cut_out_photo(tmp_path / "a.png", picture, tmp_path / f"{name}.png").notes
        assert [("is it inverted?" in words) for words in notes] == [True] * (name == "inverted")
    rgba = np.concatenate([picture.pixels, masks["inverted"]], 2)
    write_image(tmp_path / "b.png", rgba)
    assert "is it inverted?" in cut_out_photo(tmp_path / "b.png", read_picture(tmp_path / "b.png")).notes[0]


def test_names_of_depth_maps_beside_photos():
    pairs = {
        "0.png": "0_depth.png",
        "a.jpg": "a.depth.exr",
        "rgb_01.png": "depth_01.png",
        "frame-7-color.png": "frame-7-depth.png",
        "b.jpg": "B_DepthMap.PNG",
        "c.jpg": "c-disparity.npy",
    }
    others = ["in-depth-look.jpg", "depths_of_the_sea.jpg", "depth_99.png", "0_mask.png"]
    names = [*pairs, *pairs.values(), *others]
    assert depth_maps_beside(names) == {photo: [depth] for photo, depth in pairs.items()}
    assert all(is_sidecar_name(name) for name in (*pairs.values(), "1_mask.png", "normal01.exr", "depths1.png"))
    assert not any(map(is_sidecar_name, (*pairs, "unmasked.png", "alphabet_1.png")))
    assert depth_maps_beside(["1.png", "1_depth.png", "1_depth.npy"]) == {"1.png": ["1_depth.npy", "1_depth.png"]}


def test_photos_with_their_maps_in_one_folder_are_pairs(folder, capsys):
    """In a video, in a batch, and hinted at for a photo alone."""
    photo, grey = photo_and_map()
    Path("pairs").mkdir()
    for number in (0, 1):
        write_image(f"pairs/{number}.png", photo)
        write_image(f"pairs/{number}_depth.png", grey)
    options = "--panel p.yaml --depth-kind disparity --depth-range 1,1.6 --fit cover"  # about the middle, as in a video
    out = run(capsys, f"video pairs -o v {options}")
    assert "2 pictures, each with the depth map beside it (0.png with 0_depth.png)" in out
    assert sorted(path.name for path in Path("v").glob("*.png")) == ["frame-000000.png", "frame-000001.png"]
    run(capsys, f"encode pairs/0.png --depth pairs/0_depth.png -o 0.png {options}")
    assert Path("0.png").stat().st_size and "--depth takes it" in complaint(capsys, f"encode pairs/0.png {REST}")
    out, err = said(capsys, f"batch pairs -o b --devices cpu {options}")
    assert "2 of 2 items are done" in out and "2 photos or videos are taken with the depth maps beside them" in err
    pictures = [read_picture(path).pixels for path in ("0.png", "b/0.png", "b/1.png", "v/frame-000000.png")]
    assert all(np.array_equal(pictures[0], other) for other in pictures[1:])
    write_image("pairs/2.png", photo)
    assert "2 of its pictures have a depth map beside them" in complaint(capsys, f"video pairs -o w {options}")
