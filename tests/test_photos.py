"""What is taken of photos as people have them: the object and not the dust, colours in sRGB, maps as they lie."""

import struct
import sys
import zlib

import numpy as np
import OpenImageIO as oiio
import pytest
import torch
from icc_profile import SRGB_BLUE, SRGB_GREEN, SRGB_RED, matrix_profile
from PIL import Image, ImageCms, features

from lightfield_gs.errors import InputError
from lightfield_gs.io import photo as photos
from lightfield_gs.io.images import read_image, read_picture, write_image
from lightfield_gs.io.photo import load_photo, photo_of
from lightfield_gs.io.pieces import Pieces
from lightfield_gs.models.crop import Square, object_square
from lightfield_gs.preview import to_integers

HEIGHT, WIDTH, GREY = 240, 320, 0.92
ROWS, COLUMNS = np.mgrid[:HEIGHT, :WIDTH]


def round_thing(row=130, column=170, radius=50) -> np.ndarray:
    return np.hypot(ROWS - row, COLUMNS - column) < radius


THING = round_thing() | (abs(COLUMNS - 170) < 2) & (ROWS > 40) & (ROWS < 130)  # with a thin rod


def picture(mask=THING, colour=(0.8, 0.1, 0.1), background=GREY) -> np.ndarray:
    return np.where(mask[..., None], colour, background).astype(np.float64)


def save(path, values, **options):
    if path.suffix == ".jpg":
        options = {"quality": 95, "subsampling": 0, **options}
    Image.fromarray(to_integers(values, 8)).save(path, **options)
    return path


def square_of(path) -> Square:
    return object_square(torch.from_numpy(load_photo(path)[..., 3]))


def photo(path, *mask, **options):
    return photo_of(path, read_picture(path), *mask, **options)


# The object, and what lies beside it

def spoiled(what: str) -> np.ndarray:
    values = picture()
    if what == "speck":
        values[8:12, 6:9] = 0.2
    elif what == "hot pixels":
        values[[20, 230, 3], [300, 15, 160]] = 1, 0, 0
    else:
        values += np.random.default_rng(1).normal(0, float(what.split()[1]) / 255, values.shape)
    return values.clip(0, 1)


@pytest.mark.parametrize("what", ["speck", "hot pixels", "noise 4", "noise 7", "noise 10"])
@pytest.mark.parametrize("suffix", ["png", "jpg"])
def test_what_is_beside_the_object_does_not_move_the_crop(tmp_path, what, suffix):
    clean = square_of(save(tmp_path / f"clean.{suffix}", picture()))
    found = square_of(save(tmp_path / f"a.{suffix}", spoiled(what)))
    moved = max(abs(getattr(found, field) - getattr(clean, field)) for field in ("left", "top", "side"))
    assert moved <= 0.02 * clean.side


def test_pieces_of_the_object_stay(tmp_path):
    """Two shoes, and small beads in a row from one of them; what is smaller still lies far off."""
    mask = round_thing(150, 80, 40) | round_thing(150, 230, 36)
    for column in range(128, 190, 12):
        mask |= round_thing(150, column, 3)
    cut_out = np.dstack([picture(mask), mask])
    assert np.array_equal(load_photo(save(tmp_path / "a.png", cut_out))[..., 3], mask)
    cut_out[10:13, 300:303, 3] = 1
    found = photo(save(tmp_path / "b.png", cut_out))
    assert np.array_equal(found.pixels[..., 3] > 0, mask)
    assert found.said == [f"cut out by its alpha, fills {mask.mean():.1%} of the picture, 225 x 79 pixels, in 8 pieces "
                          "(specks beside it left out: 1)"]


@pytest.mark.parametrize("diagonal", [False, True])
def test_pieces_are_connected_pixels(diagonal):
    """Against growing each from its first pixel."""
    random = np.random.default_rng(0)
    for share in (0, 0.3, 0.5, 0.7, 1):
        flags, values = random.random((13, 17)) < share, random.random((13, 17))
        pieces, left, count = Pieces.of(flags, diagonal), flags.copy(), 0
        masks = [pieces.mask(np.arange(pieces.count) == index) for index in range(pieces.count)]
        while left.any():
            grown = np.zeros_like(flags)
            grown[tuple(np.argwhere(left)[0])] = True
            for _ in range(flags.size):
                padded = np.pad(grown, 1)
                near = [padded[1 + y:14 + y, 1 + x:18 + x] for y in (-1, 0, 1) for x in (-1, 0, 1)
                        if diagonal or y == 0 or x == 0]
                grown = np.any(near, 0) & flags
            index = next(i for i, mask in enumerate(masks) if np.array_equal(mask, grown))
            assert pieces.masses(values)[index] == pytest.approx(values[grown].sum())
            rows, columns = grown.nonzero()
            assert pieces.boxes()[index].tolist() == [rows.min(), columns.min(), rows.max() + 1, columns.max() + 1]
            left &= ~grown
            count += 1
        assert count == pieces.count


def test_alpha_that_covers_nearly_everything_cuts_nothing_out(tmp_path):
    corners = np.ones((HEIGHT, WIDTH))
    for rows, columns in ((np.s_[:4], np.s_[:4]), (np.s_[-4:], np.s_[-4:])):
        corners[rows, columns] = 0
    found = photo(save(tmp_path / "plain.png", np.dstack([picture() * corners[..., None], corners])))
    assert np.abs(found.pixels[..., 3] / 255 - THING).mean() < 0.001 and "its alpha covers 100.0%" in found.said[0]
    noise = np.random.default_rng(0).random((HEIGHT, WIDTH, 3))
    found = photo(save(tmp_path / "busy.png", np.dstack([noise, corners])))
    assert np.array_equal(found.pixels[..., 3], 255 * corners) and "all of it is taken as one object" in found.notes[0]


def test_white_before_white_is_refused(tmp_path):
    """A mug whose sides are shaded: the outline and a band would stay of it."""
    inside = (ROWS > 60) & (ROWS < 190) & (abs(COLUMNS - 150) < 60)
    shade = 1 - 0.2 * (np.abs(COLUMNS - 150) / 60) ** 4
    mug = np.where(inside, shade, 1.0)[..., None].repeat(3, 2)
    mug[110:125][inside[110:125]] = 0.1, 0.2, 0.7
    with pytest.raises(InputError, match=r"a.png: the object is hardly different .* \d\d% .*--mask.*--remove-background"):
        load_photo(save(tmp_path / "a.png", mug))


# Colours

SWAPPED = matrix_profile(SRGB_GREEN, SRGB_RED, SRGB_BLUE, name="swapped")


@pytest.mark.parametrize("suffix, options", [("png", {}), ("jpg", {}), ("tif", {}),
                                             ("webp", {"lossless": True})])
def test_an_embedded_profile_is_honoured(tmp_path, suffix, options):
    found = photo(save(tmp_path / f"a.{suffix}", picture(colour=(0.8, 0.3, 0.1)), icc_profile=SWAPPED, **options))
    assert np.abs(found.pixels[130, 170, :3] / 255 - [0.3, 0.8, 0.1])[:2].max() < 0.02
    assert found.said[1] == "profile 'swapped' converted to sRGB" and found.notes == []


def test_profiles_that_say_srgb_or_nothing(tmp_path):
    srgb = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
    values = to_integers(picture(), 8)
    for profile, word in ((srgb, ""), (SWAPPED[:200], "cannot be read"), (b"no profile", "cannot be read")):
        for suffix in ("png", "tif"):
            found = photo(save(tmp_path / f"a.{suffix}", picture(), icc_profile=profile))
            assert np.array_equal(found.pixels[..., :3], values) and len(found.said) == 1
            assert [word in note for note in found.notes] == ([True] if word else [])


def chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def test_a_png_without_a_profile_has_its_gamma_or_a_note(tmp_path):
    stored = save(tmp_path / "a.png", picture(colour=(0.5, 0.1, 0.1))).read_bytes()
    for extra, word in ((chunk(b"gAMA", struct.pack(">I", 100000)), ""), (chunk(b"cICP", bytes([9, 16, 0, 1])), "CICP 9/16"),
                        (chunk(b"cHRM", struct.pack(">8I", 31270, 32900, 68000, 32000, 26500, 69000, 15000, 6000)),
                         "other primary colours")):
        (tmp_path / "a.png").write_bytes(stored[:33] + extra + stored[33:])
        found = photo(tmp_path / "a.png")
        assert [word in note for note in found.notes] == ([True] if word else [])
        assert found.floats()[130, 170, 0] == pytest.approx(0.502 if word else 0.7366, abs=1e-3)
        assert ("linear, encoded as sRGB" in found.said) == (word == "")


def test_sixteen_bits_with_a_profile_are_converted_in_eight(tmp_path):
    spec = oiio.ImageSpec(WIDTH, HEIGHT, 3, "uint16")
    spec.attribute("ICCProfile", oiio.TypeDesc(f"uint8[{len(SWAPPED)}]"), np.frombuffer(SWAPPED, np.uint8))
    out = oiio.ImageOutput.create(str(tmp_path / "a.png"))
    assert out.open(str(tmp_path / "a.png"), spec)
    assert out.write_image(to_integers(picture(colour=(0.8, 0.3, 0.1)), 16)) and out.close()
    found = photo(tmp_path / "a.png")
    assert np.abs(found.pixels[130, 170, :3] / 255 - [0.3, 0.8, 0.1])[:2].max() < 0.02 and "in 8 bits" in found.said[1]


@pytest.mark.parametrize("suffix, dtype", [("tif", "uint8"), ("tif", "uint16"), ("exr", "float32")])
def test_associated_alpha_is_undone(tmp_path, suffix, dtype):
    """Of a file that holds colours times alpha, 128 of 255."""
    most = 1 if dtype == "float32" else np.iinfo(dtype).max
    half = 0.5 if most == 1 else 2 * round(most * 64 / 255)
    stored = np.array([[[half, half / 2, 0, half], [0, 0, 0, 0]]], dtype)
    path = str(tmp_path / f"a.{suffix}")
    out = oiio.ImageOutput.create(path)
    assert out.open(path, oiio.ImageSpec(2, 1, 4, dtype)) and out.write_image(stored) and out.close()
    assert np.allclose(read_image(path), [[[1, 0.5, 0, half / most], [0, 0, 0, 0]]], atol=0.003)


def test_linear_files_are_encoded_as_a_photo_is(tmp_path):
    linear = np.where(THING[..., None], [0.5, 0.001, 2.0], 0.8).astype(np.float32)
    write_image(tmp_path / "a.exr", linear)
    found = photo(tmp_path / "a.exr")
    assert np.allclose(found.pixels[130, 170, :3], [0.735357, 0.01292, 1], atol=1e-5)  # IEC 61966-2-1
    assert "linear, encoded as sRGB" in found.said and "brighter than white" in found.notes[0]


# Masks, and how they lie

def turned_photo(path, orientation=6, shape=(60, 80)) -> np.ndarray:
    """A photo whose stored pixels [H, W] are turned; where it shows what, as stored."""
    mask = np.zeros(shape)
    mask[5:20, 8:50] = 1
    exif = Image.Exif()
    exif[0x0112] = orientation
    Image.fromarray(to_integers(np.random.default_rng(0).random((*shape, 3)), 8)).save(path, exif=exif)
    return mask


def test_a_mask_of_the_stored_pixels_is_turned_with_the_photo(tmp_path):
    mask = turned_photo(tmp_path / "a.jpg")
    upright = np.rot90(mask, -1)
    for name, values in (("stored.png", mask), ("upright.png", upright)):
        found = load_photo(tmp_path / "a.jpg", save(tmp_path / name, values))
        assert np.array_equal(found[..., 3], upright)


@pytest.mark.parametrize("orientation, shape", [(6, (60, 60)), (3, (60, 80))])
def test_a_mask_that_may_lie_either_way_is_refused_until_it_is_said(tmp_path, orientation, shape):
    mask = turned_photo(tmp_path / "a.jpg", orientation, shape)
    path = save(tmp_path / "m.png", mask)
    with pytest.raises(InputError, match=r"m.png: .*orientation.* --map-orientation: stored .* upright"):
        load_photo(tmp_path / "a.jpg", path)
    turned = np.rot90(mask, -1 if orientation == 6 else 2)
    for choice, expected in (("stored", turned), ("upright", mask)):
        found = load_photo(tmp_path / "a.jpg", path, map_orientation=choice)
        assert np.array_equal(found[..., 3], expected)


def test_masks_of_few_levels(tmp_path):
    photo_path = save(tmp_path / "a.png", np.random.default_rng(0).random((HEIGHT, WIDTH, 3)))
    Image.fromarray(THING.astype(np.uint8)).save(tmp_path / "m.png")
    assert np.array_equal(load_photo(photo_path, tmp_path / "m.png")[..., 3], THING)
    Image.fromarray(THING.astype(np.uint8) + round_thing()).save(tmp_path / "m.png")
    with pytest.raises(InputError, match="m.png: expected a mask of 0 and 255, or of 0 and 1; its brightest pixel has 2"):
        load_photo(photo_path, tmp_path / "m.png")


# AVIF and HEIC

@pytest.mark.skipif(not features.check("avif"), reason="this Pillow reads no AVIF")
def test_avif_is_read_upright(tmp_path):
    exif = Image.Exif()
    exif[0x0112] = 6
    save(tmp_path / "a.avif", picture(), quality=95, exif=exif)
    found = load_photo(tmp_path / "a.avif")
    assert found.shape == (WIDTH, HEIGHT, 4) and np.abs(found[..., 3] - np.rot90(THING, -1)).mean() < 0.02


def test_heic_takes_a_package(tmp_path, monkeypatch):
    for name in ("pi_heif", "pillow_heif"):
        monkeypatch.setitem(sys.modules, name, None)
    (tmp_path / "a.jpg").write_bytes(b"\0\0\0\x18ftypheic\0\0\0\0mif1heic" + bytes(64))
    with pytest.raises(InputError, match=r"a.jpg is a HEIC image.* pip install 'lightfield-gs\[heif\]'.*PNG or JPEG"):
        load_photo(tmp_path / "a.jpg")


def test_heic_is_read():
    pytest.importorskip("pi_heif")
    from fuzzing.readers import CORPUS

    pixels = read_image(CORPUS / "heif" / "small.heic")
    ramp = np.linspace(0, 1, 12 * 16 * 3).reshape(12, 16, 3)
    assert np.abs(pixels - ramp).max() < 0.05


# Large photos

def test_strips_change_nothing(tmp_path, monkeypatch):
    """What keeps 50 megapixels small: the same, a few rows at a time."""
    from lightfield_gs.io import colour, plain
    from lightfield_gs.models import crop

    path = save(tmp_path / "a.png", spoiled("noise 7"), icc_profile=SWAPPED)
    whole = photo(path).pixels
    for module in (colour, photos, plain, crop):
        monkeypatch.setattr(module, "_STRIP_PIXELS", 7 * WIDTH)
    assert np.array_equal(photo(path).pixels, whole)
    for square in (Square(-40, -20, 400), Square(100, 60, 150), Square(250, 100, 120)):
        image = torch.from_numpy(whole)
        expected = crop.crop_resize(crop.premultiplied(image), square, 32)
        assert torch.equal(crop.crop_resize_premultiplied(image, square, 32), expected)
