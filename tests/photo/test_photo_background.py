"""The background of an object is light or dark, whichever its outline stands out from; users write colours."""

import json

import numpy as np
import pytest
import torch
from command_line import complaint, run

from lightfield_gs.commands.options.parser import background, background_or_auto
from lightfield_gs.io.images import read_info, write_image
from lightfield_gs.photo.background import DARK, LIGHT, choose_background


def disc(inside: float, rim: float, size: int = 64) -> np.ndarray:
    """A disc of one grey with a rim of another, on transparent red."""
    rows, columns = np.mgrid[:size, :size] + 0.5 - size / 2
    radius = np.hypot(rows, columns)
    grey = np.where(radius > size * 0.3, rim, inside)[..., None].repeat(3, 2)
    alpha = (size * 0.4 - radius + 0.5).clip(0, 1)
    colour = np.where(alpha[..., None] > 0, grey, [1.0, 0.0, 0.0])
    return np.dstack([colour, alpha]).astype(np.float32)


@pytest.mark.parametrize("inside, rim, chosen", [(0.1, 1, DARK), (1, 0.1, LIGHT), (0.5, 0.5, LIGHT), (0, 0.95, DARK)])
def test_the_rim_of_an_object_decides(inside, rim, chosen):
    photo = disc(inside, rim)
    found, alike = choose_background(photo)
    assert found == chosen and alike[chosen] == min(alike.values())
    assert choose_background(np.round(photo * 255).astype(np.uint8))[0] == chosen
    assert choose_background(photo.repeat(30, 0).repeat(30, 1))[0] == chosen  # larger than it is measured


def test_a_whole_picture_has_no_rim():
    assert choose_background(np.ones((8, 8, 4), np.float32)) is None
    assert choose_background(np.zeros((8, 8, 4), np.float32)) is None


@pytest.mark.parametrize(
    "text, colour",
    [
        ("0,0.5,1", (0, 0.5, 1)),
        ("white", (1, 1, 1)),
        ("Black", (0, 0, 0)),
        ("#ff8000", (1, 128 / 255, 0)),
        ("#F80", (1, 136 / 255, 0)),
        ("rebeccapurple", (102 / 255, 51 / 255, 153 / 255)),
    ],
)
def test_colours_have_numbers_names_and_hex_digits(text, colour):
    assert background(text) == background_or_auto(text) == pytest.approx(colour)
    assert background_or_auto("auto") is None


def test_a_white_object_is_drawn_before_a_dark_background(tmp_path, monkeypatch, capsys):
    from lightfield_gs.models import SplatterNet

    monkeypatch.chdir(tmp_path)
    torch.manual_seed(0)
    SplatterNet().save("n.safetensors")
    write_image("photo.png", np.round(disc(1, 1) * 255).astype(np.uint8))
    line = "encode photo.png -o o.png --panel toy-8v --checkpoint n.safetensors"
    out = run(capsys, line)
    assert "background: dark, 0.12,0.12,0.12; 100% of its outline is like 1,1,1, 0% of" in " ".join(out.split())
    assert json.loads(read_info("o.png").metadata["encoding"])["background"] == pytest.approx(DARK)
    assert "background:" not in run(capsys, f"{line} --background #102030")
    assert "a name or #rrggbb" in complaint(capsys, f"{line} --background #10203040")
