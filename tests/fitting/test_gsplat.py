"""gsplat's interface: images, gradients and meta; and its strategies in a loop like its trainer's."""

import copy
import gc
import math
import pickle
import weakref

import pytest
import torch

from lightfield_gs import Cameras, Gaussians, InputError, render
from lightfield_gs.fitting.strategies import DefaultStrategy, MCMCStrategy
from lightfield_gs.gsplat import rasterization
from lightfield_gs.gsplat.meta import Description

SIZE = (40, 30)


def parts(count: int = 60, seed: int = 0, dtype: torch.dtype = torch.float64) -> dict[str, torch.Tensor]:
    """The Gaussians and two cameras, under gsplat's names."""
    draw = torch.Generator().manual_seed(seed)
    poses = torch.eye(4, dtype=dtype).repeat(2, 1, 1)
    poses[1, 0, 3] = 0.2
    poses[:, 2, 3] = 4
    matrix = torch.tensor([[35.0, 0, 20], [0, 36, 15], [0, 0, 1]], dtype=dtype)
    return {
        "means": torch.randn(count, 3, generator=draw, dtype=dtype),
        "quats": torch.randn(count, 4, generator=draw, dtype=dtype),
        "scales": torch.rand(count, 3, generator=draw, dtype=dtype) * 0.2 + 0.02,
        "opacities": torch.rand(count, generator=draw, dtype=dtype),
        "colors": torch.randn(count, 4, 3, generator=draw, dtype=dtype) / 3,
        "viewmats": poses,
        "Ks": matrix.expand(2, 3, 3),
    }


def drawn(given: dict[str, torch.Tensor], **others):
    return rasterization(**given, width=SIZE[0], height=SIZE[1], **others)


def ours(given: dict[str, torch.Tensor]) -> tuple[Gaussians, Cameras]:
    scene = Gaussians(*(given[name] for name in ("means", "quats", "scales", "opacities", "colors")))
    return scene, Cameras.from_K(given["Ks"], given["viewmats"], *SIZE)


def test_harmonics_are_drawn_as_by_render_with_everything_that_gsplat_says():
    given = parts()
    image, alpha, meta = drawn(
        given, sh_degree=1, packed=False, backgrounds=torch.tensor([[0.1, 0.2, 0.3]] * 2).double()
    )
    scene, cameras = ours(given)
    colour = torch.tensor([0.1, 0.2, 0.3])
    expected = render(scene, cameras, background=colour, alpha=True, radii=True, means2d=True, conics=True)
    assert torch.equal(image, expected.image) and torch.equal(alpha[..., 0], expected.alpha)
    assert torch.equal(meta["means2d"], expected.means2d) and torch.equal(meta["conics"], expected.conics)
    assert torch.equal(meta["radii"][..., 0], expected.radii.ceil().int()) and meta["radii"].shape == (2, 60, 2)
    places = scene.means @ given["viewmats"][:, :3, :3].mT + given["viewmats"][:, :3, 3][:, None]
    torch.testing.assert_close(meta["depths"], places[..., 2])
    assert (meta["n_cameras"], meta["width"], meta["tile_width"]) == (2, 40, 3)
    low, _, _ = drawn(given, sh_degree=0)
    assert torch.equal(low, drawn({**given, "colors": given["colors"][:, :1]}, sh_degree=0)[0])


def test_meta_is_copied_joined_and_pickled_as_a_dict():
    given = parts()
    given["means"].requires_grad_()
    meta = drawn(given, sh_degree=1, packed=False)[2]
    twin, joined = copy.copy(meta), meta | {"radii": 1}
    meta |= {"depths": 2}
    assert joined["radii"] == 1 and meta["depths"] == 2 and twin["radii"].shape == (2, 60, 2)
    assert joined["means2d"] is meta["means2d"] is twin["means2d"]  # to which gradients come
    again = pickle.loads(pickle.dumps(meta))
    assert again.keys() == meta.keys() and torch.equal(again["conics"], meta["conics"])


@pytest.mark.parametrize("channels", [1, 3, 5])
def test_colours_of_any_number_of_channels_lie_over_the_background(channels):
    given = parts() | {"colors": torch.rand(60, channels, dtype=torch.float64)}
    behind = torch.rand(2, channels, dtype=torch.float64)
    image, alpha, _ = drawn(given, backgrounds=behind)
    bare, _, _ = drawn(given)
    torch.testing.assert_close(image, bare + (1 - alpha) * behind[:, None, None])
    # Three channels at a time are colours
    padded = torch.cat([given["colors"], torch.zeros(60, -channels % 3, dtype=torch.float64)], 1).split(3, 1)
    each = [drawn({**given, "colors": three.contiguous()})[0] for three in padded]
    torch.testing.assert_close(bare, torch.cat(each, -1)[..., :channels])
    both, _, _ = drawn(given, render_mode="RGB+ED")
    depth, _, _ = drawn(given, render_mode="ED")
    assert torch.equal(both, torch.cat([bare, depth], -1))


def test_batches_are_drawn_one_by_one():
    sets = [parts(seed=seed) for seed in range(4)]
    together = {name: torch.stack([one[name] for one in sets]).unflatten(0, (2, 2)) for name in sets[0]}
    image, alpha, meta = drawn(together, sh_degree=1)
    assert image.shape == (2, 2, 2, 30, 40, 3) and meta["n_batches"] == 4 and alpha.shape == (2, 2, 2, 30, 40, 1)
    torch.testing.assert_close(image[1, 0], drawn(sets[2], sh_degree=1)[0])
    flat, _, dense = drawn(together, sh_degree=1, packed=False)
    assert torch.equal(flat, image)
    rows = meta["batch_ids"] * 120 + meta["camera_ids"] * 60 + meta["gaussian_ids"]
    assert torch.equal(dense["means2d"].reshape(-1, 2)[rows], meta["means2d"])
    assert int((dense["radii"][..., 0] > 0).sum()) == len(rows)


def test_a_drawing_is_freed_with_its_meta():
    given = parts()
    given["means"].requires_grad_()
    gc.collect()
    gc.disable()  # what holds itself would stay until the collector runs
    try:
        image, _, meta = drawn(given, sh_degree=1)
        image.sum().backward()
        drawings = [weakref.ref(entry) for entry in gc.get_objects() if isinstance(entry, Description)]
        del image, meta
        assert drawings and not any(drawing() for drawing in drawings)
    finally:
        gc.enable()


@pytest.mark.parametrize("packed", [False, True])
def test_gradients_of_projected_means_arrive_as_gsplat_delivers_them(packed):
    given = parts()
    given["means"].requires_grad_()
    image, _, meta = drawn(given, sh_degree=1, packed=packed, absgrad=True)
    meta["means2d"].retain_grad()
    image.square().sum().backward()
    scene, cameras = ours(given)
    screen = torch.zeros(2, 60, 4, dtype=torch.float64, requires_grad=True)
    render(scene, cameras, background=(0, 0, 0), screen=screen).image.square().sum().backward()
    expected = screen.grad[meta["camera_ids"], meta["gaussian_ids"]] if packed else screen.grad
    torch.testing.assert_close(meta["means2d"].grad, expected[..., :2])
    torch.testing.assert_close(meta["means2d"].absgrad, expected[..., 2:])


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"sparse_grad": True, "packed": False}, "sparse_grad: expected packed=True"),
        ({"distributed": True}, "distributed: expected a group of processes, got none"),
        ({"tile_size": 8}, "tile_size: expected 16"),
        ({"with_ut": True}, "with_ut"),
        ({"camera_model": "ftheta"}, "camera_model: expected one of pinhole, ortho, fisheye"),
        ({"radial_coeffs": torch.zeros(2, 4)}, "radial_coeffs"),
        ({"sh_degree": None}, "colors: expected"),
        ({"near_plane": 0.001}, "near_plane"),
        ({"Ks": torch.eye(3)}, "Ks: expected"),
    ],
)
def test_what_is_not_honoured_is_refused_by_name(change, words):
    given = {**parts(), "sh_degree": 1} | change
    with pytest.raises(InputError, match=words):
        drawn(given)


# --- Strategies


def loop(strategy, steps: int, count: int = 60) -> tuple[float, float, int]:
    """Fit to images of other Gaussians as gsplat's trainer does; return losses, before and after, and the count."""
    torch.manual_seed(0)
    given, target = parts(count, seed=1), parts(150, seed=2)
    with torch.no_grad():
        photos = drawn(target, sh_degree=1)[0]
    values = {"means": given["means"], "quats": given["quats"], "colors": given["colors"]}
    values |= {"scales": given["scales"].log(), "opacities": given["opacities"].clamp(0.1, 0.9).logit()}
    params = {name: torch.nn.Parameter(value.clone()) for name, value in values.items()}
    rates = {"means": 0.005, "quats": 0.005, "colors": 0.02, "scales": 0.02, "opacities": 0.05}
    optimizers = {name: torch.optim.Adam([params[name]], lr=rate, eps=1e-15) for name, rate in rates.items()}
    strategy.check_sanity(params, optimizers)
    state, losses = strategy.initialize_state(), []
    for step in range(steps):
        image, _, info = rasterization(
            params["means"], params["quats"], params["scales"].exp(), params["opacities"].sigmoid(), params["colors"],
            given["viewmats"], given["Ks"], *SIZE, sh_degree=1, packed=False,
            absgrad=getattr(strategy, "absgrad", False),
        )  # fmt: skip
        loss = (image - photos).abs().mean()
        strategy.step_pre_backward(params, optimizers, state, step, info)
        loss.backward()
        for optimizer in optimizers.values():
            optimizer.step()
            optimizer.zero_grad(set_to_none=True)
        more = {"lr": 0.0005} if isinstance(strategy, MCMCStrategy) else {}
        strategy.step_post_backward(params, optimizers, state, step, info, **more)
        losses.append(float(loss.detach()))
    for name, optimizer in optimizers.items():
        (own,) = optimizer.param_groups[0]["params"]
        assert own is params[name] and len(own) == len(params["means"])
        assert optimizer.state[own]["exp_avg"].shape == own.shape
    return losses[0], losses[-1], len(params["means"])


@pytest.mark.parametrize("absgrad", [False, True])
def test_a_loop_with_the_default_strategy_clones_splits_and_fits(absgrad):
    strategy = DefaultStrategy(
        refine_start_iter=5, refine_every=10, grow_grad2d=4e-4, grow_scale3d=0.08, absgrad=absgrad, reset_every=10**9
    )
    first, last, count = loop(strategy, 60)
    assert last < 0.4 * first and count > 90


def test_a_loop_with_mcmc_reaches_its_number_and_fits():
    strategy = MCMCStrategy(cap_max=120, noise_lr=1e3, refine_start_iter=0, refine_every=3)
    first, last, count = loop(strategy, 60)
    assert last < 0.4 * first and count == 120


def test_copies_of_mcmc_draw_what_their_source_drew():
    given = parts(20)
    values = {name: given[name] for name in ("means", "quats", "colors")}
    values |= {"scales": given["scales"].log(), "opacities": given["opacities"].clamp(0.2, 0.8).logit()}
    params = {name: torch.nn.Parameter(value.clone()) for name, value in values.items()}
    optimizers = {name: torch.optim.SGD([params[name]], lr=0.1) for name in params}

    def image() -> torch.Tensor:
        fields = {name: params[name] for name in ("means", "quats", "colors")}
        fields |= {"scales": params["scales"].exp(), "opacities": params["opacities"].sigmoid()}
        return drawn(given | fields, sh_degree=1)[0]

    before = image()
    strategy = MCMCStrategy(cap_max=25, noise_lr=0.0, refine_start_iter=0, refine_every=1)
    for step in range(1, 8):
        strategy.step_post_backward(params, optimizers, {}, step, {}, lr=0.0)
    assert len(params["means"]) == 25
    assert (image() - before).square().mean() < 0.02 * before.square().mean()


def test_resets_lower_opacities_and_their_moments():
    params = {name: torch.nn.Parameter(value) for name, value in parts(8).items() if name not in ("viewmats", "Ks")}
    optimizers = {name: torch.optim.Adam([params[name]]) for name in params}
    sum(value.sum() for value in params.values()).backward()
    for optimizer in optimizers.values():
        optimizer.step()
    info = {"means2d": torch.zeros(1, 8, 2, requires_grad=True), "radii": torch.ones(1, 8, 2), "width": 9, "height": 9}
    info["means2d"].grad = torch.zeros(1, 8, 2)
    strategy, state = DefaultStrategy(reset_every=4), DefaultStrategy().initialize_state()
    strategy.step_post_backward(params, optimizers, state, 4, info | {"n_cameras": 1})
    assert float(params["opacities"].detach().max()) == pytest.approx(math.log(0.01 / 0.99))
    assert float(optimizers["opacities"].state[params["opacities"]]["exp_avg"].abs().max()) == 0
    assert float(optimizers["means"].state[params["means"]]["exp_avg"].abs().min()) > 0


def test_parameters_without_an_optimizer_are_named():
    params = {name: torch.nn.Parameter(value) for name, value in parts(8).items() if name not in ("viewmats", "Ks")}
    with pytest.raises(InputError, match=r"expected one for each parameter .* got means"):
        MCMCStrategy().check_sanity(params, {"means": torch.optim.SGD([params["means"]], lr=1)})
    with pytest.raises(InputError, match="got no opacities"):
        DefaultStrategy().check_sanity({name: params[name] for name in ("means", "quats", "scales")}, {})
