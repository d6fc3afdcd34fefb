"""Tears, fog, holes and ghosts: of discs and gaps that are known, and as commands print them."""

import json

import numpy as np
import pytest
import torch
from photo_cases import TINY, photo
from PIL import Image
from srn_scene import write_object

from lightfield_gs.models import ModelConfig, SplatterNet
from training import evaluate_photos
from training.coverage import holes_and_ghosts, tears_and_fog
from training.evaluation import score_folder


def block(width: int = 1400, height: int = 700) -> torch.Tensor:
    """Return opacities [1,H,W] of a block of 400 x 600 pixels, in a frame of 1400 x 700."""
    alpha = torch.zeros(1, height, width)
    alpha[:, 50:650, 300:700] = 1
    return alpha


@pytest.mark.parametrize("gap_px, torn", [(4, True), (10, True), (12, False)])
def test_gaps_up_to_ten_pixels_are_tears(gap_px, torn):
    alpha = block()
    alpha[:, 50:650, 500 : 500 + gap_px] = 0.79
    tears, fog = tears_and_fog(alpha)
    assert tears.item() == pytest.approx(gap_px / 400 if torn else 0, abs=1e-3) and fog == 0


def test_fog_is_between_surface_and_background():
    alpha = block()
    alpha[:, 50:650, 700:740] = torch.tensor([0.04, 0.06, 0.59, 0.61]).repeat_interleave(10)
    tears, fog = tears_and_fog(alpha)
    assert tears == 0 and fog.item() == pytest.approx(20 / 400)


@pytest.mark.parametrize("size", [256, 512])
def test_holes_are_inside_the_outline_and_ghosts_beside_it(size):
    unit = size // 256
    truth, alpha = torch.zeros(2, size, size), torch.zeros(2, size, size)
    truth[:, 50 * unit : 150 * unit, 50 * unit : 150 * unit] = 1
    alpha[0, 50 * unit : 150 * unit, 60 * unit : 160 * unit] = 0.9
    alpha[1] = 0.79 * truth[1]
    holes, ghosts = holes_and_ghosts(alpha, truth)
    assert holes[0].item() == pytest.approx(9 * 98 / 98**2, rel=1e-3)  # a pixel from the outline is no hole
    assert ghosts[0].item() == pytest.approx(8 * 100 / 100**2)  # two pixels from the outline are no ghost
    assert holes[1] == 1 and ghosts[1] == 0


def test_scores_have_holes_and_ghosts(tmp_path):
    write_object(tmp_path / "a", angles=((0, 0), (-10, 0), (10, 0)))
    report = score_folder(SplatterNet(ModelConfig.from_dict(TINY)).eval(), tmp_path)
    for row in (report, report["source"], *report["bins"]):
        assert 0 <= row["holes"] <= 1 and row["ghosts"] >= 0


def test_photos_are_measured_by_a_command(tmp_path, capsys):
    SplatterNet(ModelConfig.from_dict(TINY)).save(tmp_path / "net.safetensors")
    pixels = (255 * photo(40, 48)).round().astype(np.uint8)
    for name in ("a.png", "b.png"):
        Image.fromarray(pixels).save(tmp_path / name)
    arguments = [str(tmp_path / "a.png"), str(tmp_path / "b.png"), "--checkpoint", str(tmp_path / "net.safetensors")]
    assert evaluate_photos.main([*arguments, "--detail", "none", "1", "--json", str(tmp_path / "s.json")]) == 0
    scores = json.loads((tmp_path / "s.json").read_text())
    assert list(scores) == ["none", "1"] and list(scores["1"]) == ["a.png", "b.png"]
    assert scores["1"]["a.png"] == scores["1"]["b.png"] and scores["1"]["a.png"]["gaussians"] > 0
    printed = capsys.readouterr().out.splitlines()
    assert printed[0].startswith("detail none") and len([line for line in printed if line.startswith("mean")]) == 2
    assert evaluate_photos.main([str(tmp_path / "missing.png")]) == 2
    assert "missing.png" in capsys.readouterr().err
