"""Photos as people have them: the object is cut out and dust is not, maps are read as stored."""

import numpy as np
import pytest
import torch
from command_line import complaint, run
from icc_profile import SRGB_BLUE, SRGB_GREEN, SRGB_RED, matrix_profile
from photo_cases import tiny_net
from PIL import Image
from plain_photos import COLUMNS, HEIGHT, ROWS, THING, WIDTH, photo, picture, round_thing, save

from lightfield_gs import cli
from lightfield_gs.base.errors import InputError
from lightfield_gs.io.images import write_image
from lightfield_gs.models.crop import Square, object_square
from lightfield_gs.photo import load as photos
from lightfield_gs.photo.cut_out import NoCutOut
from lightfield_gs.photo.load import load_photo
from lightfield_gs.photo.plain import Components
from lightfield_gs.show.preview import to_integers


def square_of(path) -> Square:
    return object_square(torch.from_numpy(load_photo(path)[..., 3]))


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
    assert found.messages == [
        f"cut out by its alpha, fills {mask.mean():.1%} of the picture, 225 x 79 pixels, in 8 pieces "
        "(specks beside it left out: 1)"
    ]


@pytest.mark.parametrize("diagonal", [False, True])
def test_components_are_connected_pixels(diagonal):
    """Compare with components grown from their first pixels."""
    random = np.random.default_rng(0)
    for share in (0, 0.3, 0.5, 0.7, 1):
        flags, values = random.random((13, 17)) < share, random.random((13, 17))
        components, left, count = Components(flags, diagonal), flags.copy(), 0
        masks = [components.mask(np.arange(components.count) == index) for index in range(components.count)]
        while left.any():
            grown = np.zeros_like(flags)
            grown[tuple(np.argwhere(left)[0])] = True
            for _ in range(flags.size):
                padded = np.pad(grown, 1)
                near = [
                    padded[1 + y : 14 + y, 1 + x : 18 + x]
                    for y in (-1, 0, 1)
                    for x in (-1, 0, 1)
                    if diagonal or y == 0 or x == 0
                ]
                grown = np.any(near, 0) & flags
            index = next(i for i, mask in enumerate(masks) if np.array_equal(mask, grown))
            assert components.sums(values)[index] == pytest.approx(values[grown].sum())
            rows, columns = grown.nonzero()
            assert components.boxes()[index].tolist() == [rows.min(), columns.min(), rows.max() + 1, columns.max() + 1]
            left &= ~grown
            count += 1
        assert count == components.count


def test_alpha_that_covers_nearly_everything_cuts_nothing_out(tmp_path):
    corners = np.ones((HEIGHT, WIDTH))
    for rows, columns in ((np.s_[:4], np.s_[:4]), (np.s_[-4:], np.s_[-4:])):
        corners[rows, columns] = 0
    found = photo(save(tmp_path / "plain.png", np.dstack([picture() * corners[..., None], corners])))
    assert np.abs(found.pixels[..., 3] / 255 - THING).mean() < 0.001 and "its alpha covers 100.0%" in found.messages[0]
    noise = np.random.default_rng(0).random((HEIGHT, WIDTH, 3))
    found = photo(save(tmp_path / "busy.png", np.dstack([noise, corners])))
    assert np.array_equal(found.pixels[..., 3], 255 * corners) and "all of it is taken as one object" in found.notes[0]


def pale_thing(what: str) -> np.ndarray:
    """A mug with a band and shaded sides, of which outline and band would stay; a shirt, of which next to nothing."""
    inside = (ROWS > 60) & (ROWS < 190) & (abs(COLUMNS - 150) < 60)
    if what == "shirt":
        return np.where(inside, 0.95 - 0.05 * np.sin(COLUMNS / 15) * np.cos(ROWS / 20), 1.0)[..., None].repeat(3, 2)
    mug = np.where(inside, 1 - 0.2 * (np.abs(COLUMNS - 150) / 60) ** 4, 1.0)[..., None].repeat(3, 2)
    mug[110:125][inside[110:125]] = 0.1, 0.2, 0.7
    return mug


@pytest.mark.parametrize("what", ["mug", "shirt"])
@pytest.mark.parametrize("suffix", ["png", "jpg"])
def test_white_before_white_is_refused(tmp_path, what, suffix):
    with pytest.raises(InputError, match=r": the object is hardly different .* \d\d% .*mask=.*remove_background=True"):
        load_photo(save(tmp_path / f"a.{suffix}", pale_thing(what)))


@pytest.mark.parametrize("what", ["screen", "page"])
def test_a_page_is_no_object(tmp_path, what):
    """Messages on a white screen, and lines of text on a sheet of paper; two things are objects."""
    page = np.ones((260, 340, 3))
    for number in range(9):
        left = 20 + 150 * (number % 2)
        if what == "screen":
            page[12 + 27 * number : 30 + 27 * number, left : left + 130] = (
                (0.1, 0.5, 1) if number % 2 else (0.8, 0.8, 0.8)
            )
        else:
            for word in range(12):
                page[12 + 27 * number : 20 + 27 * number, 20 + 25 * word : 38 + 25 * word] = 0.2
    with pytest.raises(NoCutOut, match="many things on a plain background"):
        load_photo(save(tmp_path / "page.png", page))
    page[27 * 2 :] = 1
    page[100:200, 60:140] = page[100:200, 200:260] = 0.2, 0.6, 0.1
    assert load_photo(save(tmp_path / "things.png", page))[150, 100, 3] == 1
    for offset in np.ndindex(2, 2):
        page[10 + offset[0] :: 20, 10 + offset[1] :: 15] = 0  # letters beside a picture
    with pytest.raises(NoCutOut, match="many things on a plain background"):
        load_photo(save(tmp_path / "letters.png", page))


def test_a_window_with_its_shadow_is_a_page(tmp_path):
    window = np.zeros((300, 400, 4))
    window[20:270, 20:380] = 1
    window[270:280, 20:380, 3] = 0.3
    for row, column in np.ndindex(10, 8):
        window[40 + 22 * row : 48 + 22 * row, 40 + 42 * column : 70 + 42 * column, :3] = 0.2
    with pytest.raises(NoCutOut, match="many things on a plain background"):
        load_photo(save(tmp_path / "window.png", window))
    window[..., :3] *= window[..., 3:] > 0.5
    with pytest.raises(NoCutOut, match="many things on a plain background"):
        load_photo(save(tmp_path / "before-black.png", window[..., :3]))
    window[30:260, 30:370, :3] = 0.9, 0.2, 0.1  # a box
    assert load_photo(save(tmp_path / "box.png", window))[150, 200, 3] == 1


def test_soft_shadows_are_no_part_of_the_object(tmp_path):
    values = picture() - 0.25 * np.exp(-(((ROWS - 190) / 15) ** 2) - ((COLUMNS - 210) / 60) ** 2)[..., None]
    alpha = load_photo(save(tmp_path / "a.png", values.clip(0, 1)))[..., 3]
    assert alpha[THING].min() == 1 and alpha[:150][~THING[:150]].max() == 0


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
    with pytest.raises(InputError, match=r"m.png: .*orientation.* map_orientation=: stored .* upright"):
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
    with pytest.raises(InputError, match="m.png: expected a mask of 0 and 255, or .* its brightest pixel has 2, as"):
        load_photo(photo_path, tmp_path / "m.png")


# The command


def test_encode_says_what_it_took_the_photo_for(folder, capsys):
    tiny_net().save("n.safetensors")
    turned_photo(folder / "a.jpg")
    Image.fromarray((np.arange(60 * 80).reshape(60, 80) % 80 > 40).astype(np.uint8)).save("m.png")
    out = run(capsys, "encode a.jpg --mask m.png -o o.png --panel p.yaml --checkpoint n.safetensors").splitlines()
    assert out[0] == (
        "a.jpg: 60 x 80, turned by its Exif orientation 6, m.png turned with it, a mask of 0 and 1, cut "
        "out by m.png, fills 48.8% of the picture, 60 x 39 pixels, detail 2: the object's square at 64 x 64 px"
    )


def test_a_page_is_flat_without_any_network(folder, capsys):
    page = np.ones((60, 80, 3))
    for row, column in np.random.default_rng(0).permutation(list(np.ndindex(11, 15)))[:90]:
        page[5 * row + 3 : 5 * row + 5, 5 * column + 3 : 5 * column + 6] = 0.1
    save(folder / "page.png", page)
    assert cli.main("encode page.png -o own.png --panel p.yaml".split()) == 0
    output = capsys.readouterr()
    assert "flat, in the panel's plane" in output.out and "for estimated depth give --depth auto" in output.err
    run(capsys, "encode page.png -o given.png --panel p.yaml --depth flat")
    own, given = (np.asarray(Image.open(name)) for name in ("own.png", "given.png"))
    assert np.array_equal(own, given)
    assert "--depth flat has none" in complaint(capsys, "encode page.png -o o.png --depth flat --depth-scale 2")


# Large photos


def test_strips_change_nothing(tmp_path, monkeypatch):
    """Strips keep photos of 50 megapixels small; the result is that of the whole."""
    from lightfield_gs.models import crop
    from lightfield_gs.photo import colour, plain

    path = save(tmp_path / "a.png", spoiled("noise 7"), icc_profile=matrix_profile(SRGB_GREEN, SRGB_RED, SRGB_BLUE))
    whole = photo(path).pixels
    for module in (colour, photos, plain, crop):
        monkeypatch.setattr(module, "_STRIP_PIXELS", 7 * WIDTH)
    assert np.array_equal(photo(path).pixels, whole)
    for square in (Square(-40, -20, 400), Square(100, 60, 150), Square(250, 100, 120)):
        image = torch.from_numpy(whole)
        expected = crop.crop_resize(crop.premultiplied(image), square, 32)
        assert torch.equal(crop.crop_resize_premultiplied(image, square, 32), expected)


def test_large_photos_are_cut_out_by_blocks_in_bytes(tmp_path, monkeypatch):
    from lightfield_gs.photo import colour, plain

    path = save(tmp_path / "a.png", picture()[:-1, :-1])
    whole = photo(path)
    for module in (plain, colour):
        monkeypatch.setattr(module, "_MOST_PIXELS", HEIGHT * WIDTH // 4)
    write_image(tmp_path / "b.png", to_integers(picture()[:-1, :-1], 16))
    assert "taken in 8 bits for its size" in photo(tmp_path / "b.png").messages
    found = photo(path)
    assert np.abs(found.pixels[..., 3] / 255 - whole.pixels[..., 3] / 255).mean() < 0.004
    assert found.pixels.shape == whole.pixels.shape
    solid = (found.pixels[..., 3] == 255) & (whole.pixels[..., 3] == 255)
    assert solid.any() and np.array_equal(found.pixels[solid], whole.pixels[solid])
