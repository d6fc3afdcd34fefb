"""bench fit: its scores, several captures in one call, and runs that go on after an interruption."""

import json
import sys
import types

import pytest
import torch
from bench_cases import arguments
from fit_capture import write_capture

from benchmarks import fit_arms, fit_report, fit_runs
from benchmarks.fit_photographs import Photographs
from benchmarks.fit_scores import load_lpips, scores
from lightfield_gs.base.errors import InputError
from lightfield_gs.commands import bench as command
from lightfield_gs.fitting.settings import FitSettings
from lightfield_gs.io.captures.capture import read_capture
from lightfield_gs.reference.metrics import gradient_psnr_db


def bench(*words):
    """Run bench fit with these words, with a short fit's."""
    few = ("--steps", "4", "--gaussians", "160", "--threads", "1")
    assert command.run(arguments("fit", *map(str, words), *few)) == 0


def fitted(capture, held_out, cone_deg):
    photographs = Photographs.load(capture, held_out, "cpu", cone_deg, "capture")
    fit = fit_arms.ARMS["ours"](photographs, FitSettings(steps=4, cap_max=160))
    fit.advance(4)
    return fit, photographs


def test_scores_in_the_cone_are_those_of_its_photographs_alone(tmp_path):
    capture = read_capture(write_capture(tmp_path / "capture", count=9))
    # The cameras are on an arc of 45.8 degrees, 5.7 apart, 5.7 up and down by turns, about the middle of the scene
    fit, photographs = fitted(capture, [0, 3, 5, 8], cone_deg=30.0)
    assert photographs.cone.name == "04.png" and photographs.inside == [False, True, True, False]
    found = scores(fit, photographs)
    inside, outside = (
        scores(fit, Photographs.load(capture, held_out, "cpu", 30.0, "c")) for held_out in ([3, 5], [0, 8])
    )
    for name in ("psnr_db", "cc_psnr_db", "ssim", "cc_ssim", "gradient_psnr_db"):
        assert found[f"cone_{name}"] == pytest.approx(inside[name], rel=1e-6)
        assert found[name] == pytest.approx((inside[name] + outside[name]) / 2, rel=1e-6)
    assert outside["cone_psnr_db"] is None and found["lpips"] is found["cone_lpips"] is None
    image = fit.draw(photographs.test.cameras(1)).clamp(0, 1).permute(0, 3, 1, 2)
    photo = photographs.test.photos[1:2].permute(0, 3, 1, 2) / 255
    one = scores(fit, Photographs.load(capture, [3], "cpu", 30.0, "c"))
    assert one["gradient_psnr_db"] == pytest.approx(float(gradient_psnr_db(image, photo)), rel=1e-6)


def test_lpips_is_there_with_its_package_and_weights(tmp_path, monkeypatch, capsys):
    """A stand-in for the package, by its documentation; it sees what range images are given in."""

    class Network(torch.nn.Module):
        def __init__(self, net, verbose):
            super().__init__()
            assert net == "vgg"

        def forward(self, one, other, normalize=False):
            assert one.shape == other.shape == (1, 3, 32, 48) and 0 <= float(one.min()) <= float(one.max()) <= 1
            return (one - other).abs().mean().view(1, 1, 1, 1) * (2 if normalize else 1)

    monkeypatch.setattr(torch.hub, "get_dir", lambda: str(tmp_path))
    monkeypatch.setitem(sys.modules, "lpips", None)
    assert load_lpips("cpu") == (None, "no LPIPS") and "pip install lpips" in capsys.readouterr().err
    monkeypatch.setitem(sys.modules, "lpips", types.SimpleNamespace(LPIPS=Network))
    assert load_lpips("cpu") == (None, "no LPIPS") and "vgg16" in capsys.readouterr().err
    (tmp_path / "checkpoints").mkdir()
    (tmp_path / "checkpoints/vgg16-397923af.pth").touch()
    fit, photographs = fitted(read_capture(write_capture(tmp_path / "capture")), [4], 40.0)
    difference = float((fit.draw(photographs.test.cameras(0)).clamp(0, 1) - photographs.test.photos / 255).abs().mean())
    for from_zero, expected in ((False, 2 * difference), (True, difference)):
        lpips, words = load_lpips("cpu", from_zero)
        assert scores(fit, photographs, lpips)["lpips"] == pytest.approx(expected, rel=1e-5)
        assert "VGG-16" in words and ("0..1" in words) == from_zero


def test_captures_share_a_file_and_a_table(tmp_path, capsys):
    captures = [write_capture(tmp_path / name) for name in ("one", "two")]
    bench(*captures, "--arms", "ours,ours-adaptive", "--json", tmp_path / "rows.json", "--cone", "30")
    result = json.loads((tmp_path / "rows.json").read_text())
    fits = [(row["capture"], row["arm"]) for row in result["rows"]]
    assert fits == [(name, arm) for name in ("one", "two") for arm in ("ours", "ours-adaptive")]
    assert [capture["capture"] for capture in result["captures"]] == ["one", "two"]
    assert result["protocol"]["cone_deg"] == 30
    shown = capsys.readouterr().out
    assert "over captures, after 4 steps" in shown and "in the cone of 30 degrees round 0" in shown


def test_ours_is_compared_with_the_best_strategy_of_each_capture():
    def row(capture, arm, seed, psnr_db, seconds):
        what = {"capture": capture, "arm": arm, "seed": seed, "step": 9, "cc_psnr_db": psnr_db, "seconds": seconds}
        return dict.fromkeys(fit_report._NUMBERS) | {"cc_ssim": psnr_db / 100, "gaussians": 10} | what

    rows = [row("a", "ours", seed, psnr_db, 2.0) for seed, psnr_db in enumerate((27.0, 29.0, 28.0))]
    rows += [row("a", "gsplat-mcmc", 0, 27.5, 10.0), row("a", "gsplat-default", 0, 27.0, 5.0)]
    rows += [row("a", "gsplat-mcmc-our-loss", 0, 40.0, 5.0)]  # not gsplat's own
    rows += [row("b", "ours", 0, 20.0, 3.0), row("b", "gsplat-mcmc", 0, 20.5, 10.0)]
    rows += [row("b", "gsplat-default", 0, 21.0, 4.0), row("c", "ours", 0, 25.0, 1.0)]
    first, second, third = fit_report.differences(fit_report.summary(rows))
    assert first["best"] == "gsplat-mcmc" and first["cc_psnr_db"] == pytest.approx(0.5) and first["seconds"] == 0.2
    assert (
        second["best"] == "gsplat-default" and second["cc_ssim"] == pytest.approx(-0.01) and second["seconds"] == 0.75
    )
    assert third["best"] is None and third["cc_psnr_db"] is None and third["ours_db"] == 25


def test_finished_fits_are_not_run_again(tmp_path, monkeypatch, capsys):
    capture, path = write_capture(tmp_path / "capture"), tmp_path / "rows.json"
    bench(capture, "--json", path)
    result = json.loads(path.read_text())
    cut = result | {"rows": [*result["rows"], result["rows"][0] | {"seed": 1, "step": 2}]}  # interrupted after 2 steps
    path.write_text(json.dumps(cut))
    begun = []
    rows = fit_runs.rows
    monkeypatch.setattr(fit_runs, "rows", lambda *given: begun.append(given[2].seed) or rows(*given))
    bench(capture, "--json", path, "--resume", "--seeds", "2")
    assert begun == [1] and "1 fit finished earlier" in capsys.readouterr().err
    again = json.loads(path.read_text())["rows"]
    assert again[0] == result["rows"][0] and [(row["seed"], row["step"]) for row in again] == [(0, 4), (1, 4)]
    with pytest.raises(InputError, match="cone_deg: 40.0, now 30.0"):
        bench(capture, "--json", path, "--resume", "--cone", "30")
    with pytest.raises(InputError, match="photographs: 5, now 7"):
        changed = result | {"captures": [result["captures"][0] | {"photographs": 5}], "rows": []}
        path.write_text(json.dumps(changed | {"protocol": result["protocol"]}))
        bench(capture, "--json", path, "--resume")
