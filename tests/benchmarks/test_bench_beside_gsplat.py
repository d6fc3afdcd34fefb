"""bench dense and bench fit. Without a GPU our own renderer stands in for gsplat, and its strategies do little: what is
tested is all round them."""

import json
import types

import numpy as np
import pytest
import torch
from bench_cases import arguments
from fit_capture import write_capture

from benchmarks import fit_arms, fit_report, fit_runs, peers
from benchmarks.fit_photographs import Photographs, hold_out
from benchmarks.fit_scores import scores
from benchmarks.gsplat_fit import RATES
from lightfield_gs.base.errors import InputError
from lightfield_gs.base.harmonics import SH_CONSTANT
from lightfield_gs.bench import dense, timing
from lightfield_gs.commands import bench as command
from lightfield_gs.fitting.evaluate import evaluate
from lightfield_gs.fitting.schedule import Schedule
from lightfield_gs.fitting.settings import FitSettings
from lightfield_gs.io.captures.capture import read_capture
from lightfield_gs.rasterizer.images import render
from lightfield_gs.scene.cameras import Cameras
from lightfield_gs.scene.gaussians import Gaussians

pytest.importorskip("scipy")


class Strategy:
    """The calls that gsplat's strategies are given; this one adds a Gaussian at every round."""

    made: list["Strategy"] = []

    def __init__(self, **options):
        self.options, self.calls = options, []
        Strategy.made.append(self)

    def check_sanity(self, params, optimizers):
        assert set(params) == set(optimizers) == set(RATES)

    def initialize_state(self):
        return {"state": 1}

    def step_pre_backward(self, params, optimizers, state, step, info):
        if "means2d" in info:
            info["means2d"].retain_grad()

    def step_post_backward(self, params, optimizers, state, step, info, **more):
        assert state == {"state": 1} and all(p.grad is None for p in params.values())
        if "means2d" in info:
            assert bool(info["means2d"].grad.isfinite().all())
        self.calls.append((step, more))


def stand_in(means, quats, scales, opacities, colors, viewmats, Ks, width, height, *, sh_degree, absgrad=False, **more):
    """gsplat.rasterization as its documentation describes it, drawn by ours."""
    assert more.pop("packed") is False and set(more) <= {"near_plane", "rasterize_mode", "eps2d", "radius_clip"} | {
        "backgrounds"
    }
    cameras = Cameras(viewmats, Ks, width_px=width, height_px=height)
    flat = 0 * means[None, :, :2]
    if sh_degree is None:
        black = torch.full_like(colors[:, None, :1].expand(-1, 1, 3), -0.5 / SH_CONSTANT)
        drawn = render(Gaussians(means, quats, scales, opacities, black), cameras, features=colors, alpha=True)
        return drawn.features, drawn.alpha[..., None], {"means2d": flat}
    scene = Gaussians(means, quats, scales, opacities, colors[:, : (sh_degree + 1) ** 2].contiguous())
    image, alpha, *_ = render(scene, cameras, background=(0.0, 0.0, 0.0), alpha=True)
    return image + flat.sum(), alpha[..., None], {"means2d": flat}


@pytest.fixture
def gsplat(monkeypatch):
    Strategy.made = []
    module = types.SimpleNamespace(
        rasterization=stand_in, DefaultStrategy=Strategy, MCMCStrategy=Strategy, __version__="0"
    )
    monkeypatch.setattr(peers, "gsplat", lambda: module)


@pytest.fixture
def photographs(tmp_path):
    capture = read_capture(write_capture(tmp_path / "capture"))
    return Photographs.load(capture, hold_out(capture, 8), "cpu", 40.0, "capture")


def test_the_dense_scene_is_as_described():
    scene = dense.frustum(40_000, 400, 266)
    assert all(
        torch.equal(a, b) for a, b in zip(scene.fields().values(), dense.frustum(40_000, 400, 266).fields().values())
    )
    x, y, z = scene.means.double().unbind(1)
    assert 2 <= float(z.min()) and float(z.max()) <= 10 and float(z.median()) == pytest.approx(np.sqrt(20), rel=0.03)
    across, down = 300 * x / z + 200, 300 * y / z + 133
    assert float(across.min()) == pytest.approx(-40, abs=1) and float(down.max()) == pytest.approx(1.1 * 266, abs=1)
    sigmas = scene.scales.double() / z[:, None] * 300
    expected = 1.2 * np.sqrt(1e6 / 40_000 * 400 * 266 / (1600 * 1066))
    assert float(sigmas.median()) == pytest.approx(expected, rel=0.02)
    assert float(sigmas.log().std()) == pytest.approx(0.6, rel=0.02) and scene.sh_degree == 3
    assert float(scene.opacities.min()) == pytest.approx(0.01) and float(scene.opacities.median()) == pytest.approx(
        0.5, abs=0.02
    )


def test_programs_run_by_turns():
    order = []
    calls = [[lambda name=name, part=part: order.append(name + part) for part in "12"] for name in "ab"]
    times = timing.timed_by_turns(calls, False, 2)
    assert order == ["a1", "a2", "b1", "b2"] * 2 and [len(taken) for taken in times] == [2, 2]
    assert timing.ms_in_a_row(lambda: order.clear(), False, 3) > 0 and not order


def test_dense_rows_and_table(tmp_path, capsys):
    path = tmp_path / "dense.json"
    words = f"dense --gaussians 300,600 --size 60x40 --repeats 2 --json {path}"
    assert command.run(arguments(*words.split())) == 0
    rows = json.loads(path.read_text())["rows"]
    assert [row["gaussians"] for row in rows] == [300, 600] and rows[0]["differences"] == {}
    for row in rows:
        assert row["runs"] == 2 and row["width_px"] == 60 and row["sh_degree"] == 3
        assert 0 < row["ms_forward"] < row["ms_total"] and row["ms_in_a_row"] > 0
    assert "60 x 40 px, SH 3" in capsys.readouterr().out


def test_dense_compares_images_and_gradients(gsplat):
    programs = {dense.OURS: dense._ours, "gsplat 0": dense._gsplats}
    rows = dense._scene_rows(dense.frustum(200, 60, 40), dense.camera(60, 40, "cpu"), programs, 1)
    assert [row["program"] for row in rows] == list(programs)
    names = {"image", "image_largest", "means", "quaternions", "scales", "opacities", "sh"}
    assert set(rows[1]["differences"]) == names and max(rows[1]["differences"].values()) < 1e-5
    rows[0]["peak_bytes"], rows[1]["peak_bytes"] = 3_000_000, 2_000_000
    rows[0]["ms_total"], rows[1]["ms_total"] = 2.0, 5.0
    assert "ours is 2.50 times as fast as gsplat 0" in dense.table(rows) and "1.50 times its memory" in dense.table(
        rows
    )


def test_dense_compares_features_and_their_gradients(gsplat):
    programs = {dense.OURS: dense._ours, "gsplat 0": dense._gsplats}
    rows = dense._scene_rows(dense.frustum(200, 60, 40), dense.camera(60, 40, "cpu"), programs, 1, 5)
    names = {"image", "image_largest", "means", "quaternions", "scales", "opacities", "features"}
    assert set(rows[1]["differences"]) == names and max(rows[1]["differences"].values()) < 1e-5
    assert "200 Gaussians of 5 channels: ours is" in dense.table(rows)


def test_a_fit_is_scored_and_its_rows_are_kept(tmp_path, capsys):
    pytest.importorskip("matplotlib")
    path, picture = tmp_path / "fit.json", tmp_path / "fit.png"
    capture = write_capture(tmp_path / "capture")
    words = f"fit {capture} --steps 40 --gaussians 200 --seeds 2 --json {path} --plot {picture} --threads 1"
    assert command.run(arguments(*words.split())) == 0
    result = json.loads(path.read_text())
    (described,) = result["captures"]
    assert described["held_out"] == described["in_cone"] == ["04.png"] and described["photographs"] == 7
    assert [(row["arm"], row["seed"], row["step"]) for row in result["rows"]] == [("ours", 0, 40), ("ours", 1, 40)]
    for row in result["rows"]:
        assert row["gaussians"] <= 200 and row["seconds"] > 0 and row["peak_bytes"] is None
        assert row["psnr_db"] == row["psnr_db_by_ours"] > 8 and 0 < row["ssim"] < 1
    (summed,) = result["summary"]
    assert summed["seeds"] == 2 and summed["psnr_db"][1] <= summed["psnr_db"][0] <= summed["psnr_db"][2]
    assert picture.stat().st_size > 1000 and "7 photographs of 48 x 32 px, 1 held out" in capsys.readouterr().out


def test_marks_are_those_within_the_fit_and_its_end():
    assert (
        fit_runs.marks(7000) == [1000, 2000, 4000, 7000]
        and fit_runs.marks(30) == [30]
        and fit_runs.marks(1500) == [1000, 1500]
    )


def test_scores_are_those_of_a_fit(photographs):
    ours = fit_arms.ARMS["ours"](photographs, FitSettings(steps=10, cap_max=200))
    ours.advance(10)
    expected = evaluate(ours.gaussians(), photographs.test, (0.0, 0.0, 0.0))
    found = scores(ours, photographs)
    assert found["psnr_db"] == pytest.approx(expected.mean_psnr_db, abs=1e-4)
    assert found["ssim"] == pytest.approx(expected.mean_ssim, abs=1e-6)


@pytest.mark.not_sanitized  # most of it is torch
@pytest.mark.parametrize("arm", list(fit_arms.PEER_ARMS))
def test_a_fit_in_the_peers_loop_learns(arm, photographs, gsplat):
    settings = FitSettings(steps=60, cap_max=200)
    rows = list(fit_runs.rows(photographs, arm, settings))
    peer = fit_arms.ARMS[arm](photographs, settings)
    assert rows[-1]["psnr_db"] > scores(peer, photographs)["psnr_db"] + 1
    strategy = Strategy.made[0]
    assert [step for step, _ in strategy.calls] == list(range(60)) and strategy.options["refine_start_iter"] == 1
    if "mcmc" in arm:
        assert strategy.options["cap_max"] == 200 and strategy.options["refine_stop_iter"] == 50
        assert strategy.calls[-1][1] == {"lr": pytest.approx(1.6e-6, rel=1e-9)}
    else:
        assert strategy.options["reset_every"] == 6 and strategy.calls[0][1] == {"packed": False}
        assert strategy.options.get("grow_grad2d") == (6e-4 if "absgrad" in arm else None)


def test_the_peers_loss_is_ours(photographs, gsplat):
    settings = FitSettings(steps=8, cap_max=200)
    for masked in (False, True):
        if masked:
            photographs.train.weights = torch.zeros(photographs.train.photos.shape[:3], dtype=torch.uint8)
            photographs.train.weights[:, :, :30] = 255
        losses = []
        for arm in ("gsplat-default", "gsplat-default-our-loss"):
            peer = fit_arms.ARMS[arm](photographs, settings)
            losses.append(float(peer._loss(peer.draw(peer._cameras[0]), 0).detach()))
        # Where weights are, the SSIM of pixels without any counts for the one and not for the other: they see the edge
        assert losses[0] == pytest.approx(losses[1], rel=2e-2 if masked else 1e-5)


def test_peers_take_the_photographs_in_the_order_of_ours(photographs, gsplat):
    settings = FitSettings(steps=20, cap_max=200, seed=3)
    peer = fit_arms.ARMS["gsplat-mcmc"](photographs, settings)
    assert peer._order == Schedule.make(settings, photographs.train.count, "cpu").order[:, 0].tolist()


def test_ours_is_compared_with_every_other_arm():
    def row(arm, step, psnr_db, seconds, seed=0):
        common = dict.fromkeys(fit_report._NUMBERS) | {"psnr_db_by_ours": psnr_db, "cc_ssim": 0.9, "gaussians": 10}
        what = {"arm": arm, "seed": seed, "step": step, "cc_psnr_db": psnr_db, "seconds": seconds, "peak_bytes": 10}
        return {"capture": "c", **common, "ms_step": 1.0, "ms_step_lately": 1.0, **what}

    rows = [row("ours", 1000, 27.0, 2.0), row("ours", 2000, 29.0, 4.0), row("other", 1000, 25.0, 9.0)]
    rows += [row("other", 2000, 26.5, 16.0), row("other", 2000, 27.0, 18.0, 1), row("other", 2000, 26.0, 12.0, 2)]
    capture = {"capture": "c", "photographs": 7, "width_px": 4, "height_px": 3, "held_out": ["a"], "points": 5}
    protocol = {"steps": 2000, "gaussians": 10, "cone_deg": 40.0, "scores": "means"}
    captures = [capture | {"centre": None, "in_cone": []}]
    shown = fit_report.table({"rows": rows, "captures": captures, "protocol": protocol})
    assert "26.00..27.00" in shown
    assert "ours against other: +2.50 dB in 0.25 times its seconds; as good as its end after 1000 steps, 2.0 s" in shown


@pytest.mark.parametrize(
    "words",
    [
        "fit",
        "fit no-such-folder",
        "fit CAPTURE --arms theirs",
        "fit CAPTURE --arms ours,gsplat-mcmc",
        "fit CAPTURE --gaussians 100,200",
        "fit CAPTURE --test-every 16",
        "fit CAPTURE --plot rows.txt",
        "fit CAPTURE CAPTURE",
        "fit CAPTURE --resume",
        "fit CAPTURE --cone round",
        "fit CAPTURE --size 4x4",
        "fit CAPTURE --repeats 2",
        "fit CAPTURE --steps 0",
        "fit CAPTURE --threads 1,2",
        "fit CAPTURE --json CAPTURE/transforms.json/x.json",
        "dense CAPTURE",
        "dense --size 400",
        "dense --gaussians 10,x",
        "dense --steps 7",
        "dense --arms ours",
        "light-field --seeds 2",
    ],
)
def test_bad_arguments_are_refused_before_any_work(words, tmp_path, monkeypatch):
    monkeypatch.setattr(fit_runs, "rows", None)
    monkeypatch.setattr(dense, "rows", None)
    if torch.cuda.is_available() and "gsplat" in words:
        pytest.skip("gsplat may be here")
    capture = write_capture(tmp_path / "capture", count=4) if "CAPTURE" in words else tmp_path
    with pytest.raises(InputError) as error:
        command.run(arguments(*words.replace("CAPTURE", str(capture)).split()))
    assert "\n" not in str(error.value)
