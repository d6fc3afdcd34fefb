"""gsplat's interface with sparse gradients, and with Gaussians that two processes hold a part of each."""

from pathlib import Path

import pytest
import torch
from test_gsplat import SIZE, parts
from two_processes import printed_by_two

from lightfield_gs.fitting import SelectiveAdam
from lightfield_gs.gsplat import DefaultStrategy, rasterization

FIELDS = ("means", "quats", "scales", "opacities", "colors")
TESTS = Path(__file__).resolve().parents[1]


def scattered(count: int = 200) -> dict[str, torch.Tensor]:
    """Gaussians of which each camera sees some: many lie beside the images or behind the cameras."""
    given = parts(count)
    given["means"] = given["means"] * torch.tensor([3, 3, 4.0]).double()
    given["viewmats"][1, :3, 3] = torch.tensor([4.0, 1, 6])
    return given


def leaves(given: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    return {name: tensor.detach().clone().requires_grad_() for name, tensor in given.items()}


def loss_of(image: torch.Tensor, alpha: torch.Tensor) -> torch.Tensor:
    return (image.square() * torch.linspace(0.5, 2, image.shape[2]).to(image)[:, None]).sum() + alpha.sum()


CASES = {
    "harmonics": {"sh_degree": 0, "absgrad": True, "rasterize_mode": "antialiased", "radius_clip": 1.0},
    "colours": {"render_mode": "RGB+ED", "far_plane": 5.0},
    "features": {"colors": torch.rand(200, 5).double(), "backgrounds": torch.rand(2, 5).double()},
    "of each camera": {"colors": torch.rand(2, 200, 3).double()},
    "covariances": {"eps2d": 0.1},
    "none seen": {"near_plane": 900.0},
}


@pytest.mark.parametrize("case", CASES)
def test_sparse_gradients_are_those_of_the_rows_that_are_drawn(case):
    given, options = scattered(), dict(CASES[case])
    if case not in ("harmonics", "features", "of each camera"):
        given["colors"] = given["colors"][:, 0]
    given["colors"] = options.pop("colors", given["colors"])
    if case == "covariances":
        root = torch.randn(200, 3, 3, generator=torch.Generator().manual_seed(1)).double() / 5
        given |= {"covars": root @ root.mT}
    dense, sparse = leaves(given), leaves(given)
    found = []
    for fields, kind in ((dense, False), (sparse, True)):
        image, alpha, meta = rasterization(**fields, width=SIZE[0], height=SIZE[1], sparse_grad=kind, **options)
        if image.requires_grad:
            loss_of(image, alpha).backward()
        found.append((image, alpha, meta))
    (image, alpha, meta), (again, other, info) = found
    assert torch.equal(image, again) and torch.equal(alpha, other) and meta.keys() == info.keys()
    for name, value in meta.items():
        assert torch.equal(value, info[name]) if isinstance(value, torch.Tensor) else value == info[name], name
    if meta["means2d"].grad is not None:
        torch.testing.assert_close(meta["means2d"].grad, info["means2d"].grad, atol=1e-12, rtol=1e-10)
    if case == "harmonics":
        torch.testing.assert_close(meta["means2d"].absgrad, info["means2d"].absgrad, atol=1e-12, rtol=1e-10)
    rows = meta["gaussian_ids"].unique()
    assert len(rows) < 150 and (len(rows) > 20) != (case == "none seen")
    for name in ("viewmats", "Ks"):
        torch.testing.assert_close(sparse[name].grad, dense[name].grad, atol=1e-12, rtol=1e-10)
    for name in FIELDS if case != "covariances" else ("means", "covars", "opacities", "colors"):
        mine, whole = sparse[name].grad, dense[name].grad
        assert mine.is_sparse == (case != "of each camera" or name != "colors")
        if mine.is_sparse:
            assert torch.equal(mine._indices()[0], rows)
            mine = mine.to_dense()
        torch.testing.assert_close(mine, whole, atol=1e-12, rtol=1e-10)


def test_a_loop_with_sparse_gradients_fits_and_moves_only_what_is_seen():
    """As gsplat's trainer has it: logarithms and logits, and a strategy; what is dense gets a mask of the rows."""
    torch.manual_seed(0)
    given, target = scattered(), scattered() | {"colors": parts(200, seed=5)["colors"]}
    with torch.no_grad():
        photos = rasterization(**target, width=SIZE[0], height=SIZE[1], sh_degree=1)[0]
    values = {name: given[name] for name in ("means", "quats", "colors")}
    values |= {"scales": given["scales"].log(), "opacities": given["opacities"].clamp(0.1, 0.9).logit()}
    params = {name: torch.nn.Parameter(value.clone()) for name, value in values.items()}
    optimizers = {name: SelectiveAdam([{"params": value, "lr": 0.01}]) for name, value in params.items()}
    strategy = DefaultStrategy(refine_start_iter=5, refine_every=10, grow_grad2d=4e-4, grow_scale3d=0.08)
    state, losses = strategy.initialize_state(), []
    for step in range(40):
        fields = {**params, "scales": params["scales"].exp(), "opacities": params["opacities"].sigmoid()}
        cameras = {name: given[name] for name in ("viewmats", "Ks")}
        size = {"width": SIZE[0], "height": SIZE[1]}
        image, _, info = rasterization(**fields, **cameras, **size, sh_degree=1, sparse_grad=True)
        loss = (image - photos).abs().mean()
        strategy.step_pre_backward(params, optimizers, state, step, info)
        loss.backward()
        before = {name: value.detach().clone() for name, value in params.items()}
        seen = torch.zeros(len(params["means"]), dtype=torch.bool).index_fill(0, info["gaussian_ids"], True)
        for name, optimizer in optimizers.items():
            assert params[name].grad.is_sparse == (name != "opacities")
            optimizer.step(None if params[name].grad.is_sparse else seen)
            optimizer.zero_grad(set_to_none=True)
            assert torch.equal(params[name][~seen], before[name][~seen])
        assert 20 < int(seen.sum()) < 0.9 * len(seen)
        strategy.step_post_backward(params, optimizers, state, step, info, packed=True)
        losses.append(float(loss.detach()))
    assert losses[-1] < 0.6 * losses[0] and len(params["means"]) > 200


# --- Two processes

PROGRAM = f"""
import sys, torch
sys.path[:0] = {[str(TESTS), str(TESTS / "fitting")]!r}
from test_gsplat_parts import drawn_in_parts
from lightfield_gs.base.torchrun import join_processes
from datetime import timedelta
torch.set_num_threads(1)
with join_processes(sys.argv[2], timedelta(seconds=60)) as (rank, size, device):
    torch.save(drawn_in_parts(rank, device), f"{{sys.argv[1]}}-{{rank}}.pt")
"""
UNEQUAL, ONE_HAS_NONE = (slice(0, 70), slice(70, 200)), (slice(0, 200), slice(200, 200))
SHARES = {"harmonics": UNEQUAL, "sparse": UNEQUAL, "features": ONE_HAS_NONE}
WAYS = {
    "harmonics": {"sh_degree": 1, "absgrad": True},
    "sparse": {"sh_degree": 1, "sparse_grad": True},
    "features": {"packed": False, "render_mode": "RGB+D"},
}


def whole(way: str, device: torch.device | str) -> dict[str, torch.Tensor]:
    """All Gaussians and cameras: two for each process, of which the last two see what the first two do, from aside."""
    given = scattered()
    if way == "features":
        given["colors"] = given["colors"][:, :, 0]
    given["viewmats"] = given["viewmats"].repeat(2, 1, 1)
    given["viewmats"][2:, 0, 3] -= 2
    given["Ks"] = given["Ks"].repeat(2, 1, 1)
    dtype = torch.float64 if torch.device(device).type == "cpu" else torch.float32
    return leaves({name: tensor.to(device, dtype) for name, tensor in given.items()})


def drawn_in_parts(rank: int, device: torch.device) -> dict[str, dict[str, object]]:
    """Draw and differentiate the cameras of one process, which holds its share of the Gaussians."""
    results, cameras = {}, slice(2 * rank, 2 * rank + 2)
    for way, options in WAYS.items():
        given = whole(way, device)
        own = leaves({name: given[name][SHARES[way][rank] if name in FIELDS else cameras] for name in given})
        image, alpha, meta = rasterization(**own, width=SIZE[0], height=SIZE[1], distributed=True, **options)
        (loss_of(image.double(), alpha.double()) * (1 + rank)).backward()
        gradients = {name: tensor.grad.to_dense().cpu() for name, tensor in own.items()}
        shown = {name: value.detach().cpu() for name, value in meta.items() if isinstance(value, torch.Tensor)}
        shown["gradient"] = meta["means2d"].grad.cpu()
        layouts = [own[name].grad.is_sparse for name in FIELDS]
        results[way] = {"image": image.detach().cpu(), "gradients": gradients, "meta": shown, "sparse": layouts}
    return results


@pytest.mark.not_sanitized
@pytest.mark.long_file
@pytest.mark.parametrize(
    "device",
    ["cpu", pytest.param("cuda", marks=pytest.mark.skipif(torch.cuda.device_count() < 2, reason="needs two GPUs"))],
)
def test_two_processes_with_a_part_each_draw_as_one_with_all(tmp_path, device):
    program = tmp_path / "drawing.py"
    program.write_text(PROGRAM)
    codes, printed = zip(*printed_by_two(program, str(tmp_path / "part"), device))
    assert codes == (0, 0), printed
    halves = [torch.load(tmp_path / f"part-{rank}.pt") for rank in range(2)]
    close = {"atol": 1e-6, "rtol": 1e-6} if device == "cpu" else {"atol": 1e-4, "rtol": 1e-3}
    for way, options in WAYS.items():
        given = whole(way, device)
        image, alpha, meta = rasterization(**given, width=SIZE[0], height=SIZE[1], **options)
        weights = torch.tensor([1.0, 1, 2, 2], device=device).double()[:, None, None, None]
        loss_of(image.double() * weights.sqrt(), alpha.double() * weights).backward()
        each = [half[way] for half in halves]
        torch.testing.assert_close(torch.cat([half["image"] for half in each]), image.detach().cpu(), **close)
        for name in given:
            joined = torch.cat([half["gradients"][name] for half in each])
            torch.testing.assert_close(joined, given[name].grad.to_dense().cpu(), **close)
        assert {sparse for half in each for sparse in half["sparse"]} == {way == "sparse"}
        # meta is about a process's own Gaussians before all cameras
        for share, half in zip(SHARES[way], each):
            mine = half["meta"]
            expected = {"means2d": meta["means2d"].detach(), "gradient": meta["means2d"].grad, "radii": meta["radii"]}
            if meta["gaussian_ids"] is not None:
                here = (meta["gaussian_ids"] >= share.start) & (meta["gaussian_ids"] < share.stop)
                assert torch.equal(mine["gaussian_ids"], meta["gaussian_ids"][here].cpu() - share.start)
                assert torch.equal(mine["camera_ids"], meta["camera_ids"][here].cpu())
                expected = {name: value[here] for name, value in expected.items()}
            else:
                expected = {name: value[:, share] for name, value in expected.items()}
            for name, value in expected.items():
                torch.testing.assert_close(mine[name], value.cpu(), **close)
