"""Images and photos: what is written comes back, what is no image is refused in one line."""

import json
import os
import struct
import zlib

import numpy as np
import pytest
import torch
from PIL import Image, features
from rasterizer_cases import random_scene

from lightfield_gs import Panel, encode
from lightfield_gs.base.errors import InputError
from lightfield_gs.io import images
from lightfield_gs.io.images import read_image, read_info, write_image
from lightfield_gs.panels.rig import Rig
from lightfield_gs.photo.load import load_photo
from lightfield_gs.photo.plain import plain_background_mask
from lightfield_gs.show.preview import to_integers

RNG = np.random.default_rng(3)


def pattern(dtype: str, channels: int = 3) -> np.ndarray:
    values = RNG.random((23, 37, channels))
    return values.astype(np.float32) if dtype == "float32" else (values * np.iinfo(dtype).max).astype(dtype)


# Writing and reading


@pytest.mark.parametrize(
    "suffix, dtype",
    [
        (".png", "uint8"),
        (".png", "uint16"),
        (".tif", "uint8"),
        (".tiff", "uint16"),
        (".tif", "float32"),
        (".exr", "float32"),
    ],
)
@pytest.mark.parametrize("channels", [1, 3, 4])
@pytest.mark.parametrize("compression", ["fast", "small"])
def test_round_trip_is_exact(tmp_path, suffix, dtype, channels, compression):
    path = tmp_path / f"a{suffix}"
    array = pattern(dtype, channels)
    if suffix == ".exr" and channels == 4:
        array[..., 3] = 1  # EXR holds colours premultiplied with alpha
    metadata = {"software": "lightfield-gs 1", "panel": json.dumps({"name": "ü"}), "rig": "{}"}
    write_image(path, array, metadata, compression)
    again = read_image(path, as_stored=True)
    assert again.dtype == array.dtype and np.array_equal(again, array)
    info = read_info(path)
    assert (info.width_px, info.height_px, info.channels) == (37, 23, channels)
    assert info.metadata == metadata
    assert [p.name for p in tmp_path.iterdir()] == [path.name]


def test_a_link_stays_and_its_file_is_written(tmp_path):
    (tmp_path / "deep").mkdir()
    for name in ("there.png", "new.png"):
        (tmp_path / "a.png").symlink_to(f"deep/{name}")
        (tmp_path / "deep/there.png").write_text("old")
        write_image(tmp_path / "a.png", pattern("uint8"))
        assert (tmp_path / "a.png").is_symlink() and read_info(tmp_path / "deep" / name).width_px == 37
        (tmp_path / "a.png").unlink()
    assert len(list(tmp_path.rglob("*.png"))) == 2


def test_pipes_and_devices_stay(tmp_path):
    os.mkfifo(tmp_path / "a.png")
    (tmp_path / "b.png").symlink_to("/dev/null")
    for name in ("a.png", "b.png"):
        with pytest.raises(InputError, match="is a device or a pipe; give a file name"):
            write_image(tmp_path / name, pattern("uint8"))
    assert (tmp_path / "a.png").is_fifo() and (tmp_path / "b.png").is_char_device()


def test_a_description_of_another_kind_is_no_metadata(tmp_path):
    for text in ("[" * 6000, "a photo", "[1]", "\\ud800"):
        exif = Image.Exif()
        exif[270] = text  # ImageDescription
        Image.fromarray(pattern("uint8")).save(tmp_path / "a.tif", exif=exif)
        assert read_info(tmp_path / "a.tif").metadata == {}


def test_png_of_a_light_field_is_small_unless_told_otherwise(tmp_path):
    """Here of many small Gaussians that differ from view to view; of plain objects on 8K panels a seventh is left."""
    panel = Panel(width_px=600, height_px=300, views=24, line_number=9.85, slant_tan=1 / 6, cone_deg=30)
    image = encode(scene := random_scene(300, dtype=torch.float32), panel, Rig.frame(scene, panel)).numpy()
    sizes = []
    for compression in ("fast", "small"):
        write_image(tmp_path / "a.png", image, compression=compression)
        sizes.append((tmp_path / "a.png").stat().st_size)
    assert sizes[1] <= sizes[0] < 0.4 * image.size


def test_another_reader_agrees(tmp_path):
    for array in (pattern("uint8"), pattern("uint8", 4)):
        write_image(tmp_path / "a.png", array, {"k": "v"})
        assert np.array_equal(np.asarray(Image.open(tmp_path / "a.png")), array)


def test_another_writer_is_read(tmp_path):
    array = pattern("uint8", 4)
    Image.fromarray(array).save(tmp_path / "a.png")
    assert np.array_equal(read_image(tmp_path / "a.png"), (array / 255).astype(np.float32))
    Image.fromarray(array).save(tmp_path / "a.webp", lossless=True, exact=True)
    assert np.array_equal(read_image(tmp_path / "a.webp", as_stored=True), array)


def test_exif_orientation(tmp_path):
    array = np.zeros((32, 64, 3), np.uint8)
    array[:8, :8] = 255
    for orientation, corner in ((1, (0, 0)), (3, (-1, -1)), (6, (0, -1)), (8, (-1, 0))):
        exif = Image.Exif()
        exif[0x0112] = orientation
        Image.fromarray(array).save(tmp_path / "a.jpg", quality=95, exif=exif)
        pixels = read_image(tmp_path / "a.jpg")
        assert pixels.shape[:2] == ((32, 64) if orientation < 5 else (64, 32))
        assert pixels[corner].min() > 0.9 and pixels.mean() < 0.1
        if features.check("avif"):
            Image.fromarray(array).save(tmp_path / "a.avif", exif=exif)
            assert read_info(tmp_path / "a.avif").orientation == orientation


@pytest.mark.parametrize(
    "path, array, words",
    [
        ("a.jpg", pattern("uint8"), "extension"),
        ("a", pattern("uint8"), "extension"),
        ("none/a.png", pattern("uint8"), "no folder"),
        (".", pattern("uint8"), "folder"),
        ("a.png", pattern("float32"), "takes uint8"),
        ("a.exr", pattern("uint8"), "takes float32"),
        ("a.png", pattern("uint8", 2), "H, W"),
        ("a.png", pattern("uint8")[0], "H, W"),
        ("a.png", pattern("uint8")[:0], "H, W"),
        ("a.png", np.zeros((1, 70000, 1), np.uint8), "H, W"),
    ],
)
def test_writing_is_refused_and_leaves_nothing(tmp_path, path, array, words):
    with pytest.raises(InputError, match=words):
        write_image(tmp_path / path, array)
    assert list(tmp_path.iterdir()) == []


def test_failure_keeps_the_old_file(tmp_path, monkeypatch):
    (tmp_path / "a.png").write_bytes(b"old")
    monkeypatch.setattr(images.np, "ascontiguousarray", lambda *_: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        write_image(tmp_path / "a.png", pattern("uint8"))
    assert [(p.name, p.read_bytes()) for p in tmp_path.iterdir()] == [("a.png", b"old")]


def huge_png(width: int, height: int) -> bytes:
    """A PNG of a few bytes whose header promises any size."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    header = struct.pack(">IIBBBBB", width, height, 8, 6, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(b"")) + chunk(b"IEND", b"")


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"not an image",
        b"\x89PNG\r\n\x1a\n",
        huge_png(60000, 60000),
        huge_png(0, 5),
        huge_png(10**6, 1),
        huge_png(8, 8),
        b"\xff\xd8\xff\xe0\0\0",
    ],
)
@pytest.mark.parametrize("suffix", [".png", ".jpg", ".exr"])
def test_what_is_no_image(tmp_path, data, suffix, capfd):
    path = tmp_path / f"a{suffix}"
    path.write_bytes(data)
    with pytest.raises(InputError) as caught:
        read_image(path)
    assert "\n" not in str(caught.value) and str(path) in str(caught.value)
    assert capfd.readouterr().err == ""


def test_cut_and_damaged_images(tmp_path, capfd):
    noise = Image.fromarray(RNG.integers(0, 255, (64, 64, 3), np.uint8))
    for name in ("a.png", "a.jpg", "a.webp", "a.tif"):
        path = tmp_path / name
        noise.save(path)
        path.write_bytes(path.read_bytes()[: -len(path.read_bytes()) // 2])
        with pytest.raises(InputError):
            read_image(path)
    assert capfd.readouterr().err == ""
    for path in (tmp_path / "absent.png", tmp_path):
        with pytest.raises(InputError):
            read_image(path)


def test_to_integers():
    values = np.array([[[-1.0, 0, 0.5, 1, 2, np.nan, 127.4 / 255, 127.6 / 255]]])
    assert to_integers(values, 8).tolist() == [[[0, 0, 128, 255, 255, 0, 127, 128]]]
    assert to_integers(values, 16)[0, 0, :5].tolist() == [0, 0, 32768, 65535, 65535]
    every = np.arange(65536) / 65535
    assert np.array_equal(to_integers(every.astype(np.float32)[:, None, None], 16).ravel(), np.arange(65536))


# Photos


def disc(height=120, width=160, ring=False) -> tuple[np.ndarray, np.ndarray]:
    """A red disc or ring on a noisy grey background, and its true mask."""
    rows, columns = np.mgrid[:height, :width]
    radius = np.hypot(rows - height / 2, columns - width / 2)
    mask = (radius < 45) & ((radius > 20) if ring else True)
    rgb = np.where(mask[..., None], [0.8, 0.1, 0.1], [0.6, 0.6, 0.62]) + RNG.normal(0, 0.003, (height, width, 3))
    return rgb.clip(0, 1), mask


def save(path, array) -> None:
    write_image(path, to_integers(array, 8))


@pytest.mark.parametrize("ring", [False, True])
def test_plain_background_is_found(tmp_path, ring):
    rgb, mask = disc(ring=ring)
    save(tmp_path / "a.png", rgb)
    photo = load_photo(tmp_path / "a.png")
    assert photo.dtype == np.float32 and photo.shape == (120, 160, 4)
    assert np.abs(photo[..., 3] - mask).mean() < 0.002
    assert np.allclose(photo[..., :3], rgb, atol=0.003)


def test_spots_of_the_background_colour_stay_opaque():
    rgb, _ = disc()
    rgb[60:62, 80:82] = 0.6, 0.6, 0.62
    assert plain_background_mask(rgb)[58:64, 78:84].min() == 1


def test_busy_background_names_the_ways_out(tmp_path):
    save(tmp_path / "a.png", RNG.random((50, 50, 3)))
    with pytest.raises(InputError, match="mask="):
        load_photo(tmp_path / "a.png")


def test_why_nothing_is_cut_out(tmp_path):
    grey, opaque, clear = np.full((50, 50, 3), 0.5), np.ones((50, 50, 1)), np.zeros((50, 50, 1))
    for name, pixels, words in (
        ("grey", grey, "plain and nothing stands out from it; give RGBA"),
        ("full", np.concatenate([grey, opaque], 2), "plain and nothing stands out"),
        ("clear", np.concatenate([grey, clear], 2), "its alpha is .nearly. empty"),
    ):
        save(tmp_path / f"{name}.png", pixels)
        with pytest.raises(InputError, match=f"{name}.png: .*{words}"):
            load_photo(tmp_path / f"{name}.png")


def test_mask_file(tmp_path):
    rgb, mask = disc()
    save(tmp_path / "a.png", RNG.random((120, 160, 3)))
    save(tmp_path / "grey.png", mask[..., None].astype(float))
    save(tmp_path / "cutout.png", np.concatenate([rgb, mask[..., None]], 2))
    save(tmp_path / "small.png", mask[1:, :, None].astype(float))
    for name in ("grey.png", "cutout.png"):
        assert np.array_equal(load_photo(tmp_path / "a.png", tmp_path / name)[..., 3], mask)
    with pytest.raises(InputError, match="160 x 120, got 160 x 119"):
        load_photo(tmp_path / "a.png", tmp_path / "small.png")
    save(tmp_path / "black.png", np.zeros((120, 160, 3)))
    with pytest.raises(InputError, match="black.png: nothing is cut out"):
        load_photo(tmp_path / "a.png", tmp_path / "black.png")


@pytest.mark.parametrize("mode", ["L", "LA", "RGB", "RGBA", "P", "1", "I;16", "CMYK"])
def test_channels_of_all_sorts(tmp_path, mode):
    rgb, mask = disc()
    rgba = Image.fromarray(to_integers(np.concatenate([rgb, mask[..., None]], 2), 8))
    if mode == "I;16":
        picture = Image.fromarray((rgb[..., 0] * 65535).astype(np.uint16))
    elif mode == "1":
        picture = rgba.getchannel("A").convert("1")
    else:
        picture = rgba if mode in ("LA", "RGBA") else rgba.convert("RGB")
        picture = picture.quantize(16, dither=0) if mode == "P" else picture.convert(mode)
    path = tmp_path / ("a.tif" if mode == "CMYK" else "a.png")
    picture.save(path)
    photo = load_photo(path)
    assert photo.shape == (120, 160, 4) and np.abs(photo[..., 3] - mask).mean() < 0.01


def test_photos_of_the_data_set(shared_dir):
    folder = shared_dir / "data/photos"
    teapot = load_photo(folder / "teapot.png")  # RGB on plain grey
    assert 0.2 < (teapot[..., 3] > 0.5).mean() < 0.3 and teapot[440, 710, 3] == 0  # seen through the handle
    assert load_photo(folder / "bird_rgba.png").shape == (256, 256, 4)
    with pytest.raises(InputError, match="mask="):
        load_photo(folder / "animal-1.jpg")
    assert 0.2 < load_photo(folder / "animal-1.jpg", folder / "animal-1.out.png")[..., 3].mean() < 0.3


@pytest.mark.parametrize(
    "start, end",
    [
        (b"\0\0\0\x20ftypisom", "mp4"),
        (b"\0\0\0\x14ftypqt  ", "mov"),
        (b"\x1a\x45\xdf\xa3\x93\x42\x82\x88matroska", "mkv"),
        (b"\x1a\x45\xdf\xa3\x9f\x42\x82\x84webm", "webm"),
        (b"RIFF\0\x10\0\0AVI LIST", "avi"),
        (b"G@\0\x10" + bytes(184) + b"G@\0\x10" + bytes(184) + b"G@", "ts"),
        (b"\0\0\x01\xba\x44\0", "mpg"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_a_video_named_otherwise_is_named_with_the_way_out(tmp_path, start, end):
    for name in ("shot", "shot.png", "shot.gif", "shot.jpg"):
        (tmp_path / name).write_bytes(start + bytes(600))
        with pytest.raises(InputError, match=rf"is a video by its content.* rename it to shot\.{end},"):
            read_image(tmp_path / name)
    (tmp_path / f"shot.{end}").write_bytes(start + bytes(600))
    with pytest.raises(InputError, match="is a video, and an image was expected"):
        read_image(tmp_path / f"shot.{end}")
