"""Fit as gsplat's own trainer does: torch's Adam, its strategies for density, its rasterizer or ours.

gsplat comes from PyPI (Ye et al., "gsplat: An Open-Source Library for Gaussian Splatting", JMLR 2025). Rates, initial
Gaussians and regularisers are as in its example simple_trainer.py (presets default and mcmc), which its package lacks.
As with its --steps_scaler all schedules are scaled to the number of steps. Its strategies are unchanged: the default
strategy of 1.5.3 never resets opacities, as `step % reset_every == 0 & step > 0` is never true.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Literal, cast

import torch
from torch import Tensor

from benchmarks import peers
from lightfield_gs.base.errors import InputError
from lightfield_gs.fitting.photo_loss import photo_loss
from lightfield_gs.fitting.posed_images import PosedImages
from lightfield_gs.fitting.schedule import Schedule
from lightfield_gs.fitting.settings import RECIPE_STEPS, FitSettings
from lightfield_gs.rasterizer.images import render
from lightfield_gs.reference.metrics import ssim
from lightfield_gs.scene.cameras import Cameras
from lightfield_gs.scene.gaussians import Gaussians

BLACK = (0.0, 0.0, 0.0)
SH_DEGREE, SH_DEGREE_INTERVAL, SSIM_LAMBDA = 3, 1000, 0.2
MEANS_LR, MEANS_LR_DECAY = 1.6e-4, 0.01  # of the extent, which is 1; the latter over the whole fit
RATES = {"means": MEANS_LR, "scales": 5e-3, "quats": 1e-3, "opacities": 5e-2, "sh0": 2.5e-3, "shN": 2.5e-3 / 20}
OPACITY_REG, SCALE_REG = 0.01, 0.01  # in the loss, of mcmc
ABSGRAD_GROW = 6e-4  # as in gsplat's documentation
OPTIONS = {"packed": False, "near_plane": 0.01, "rasterize_mode": "classic"}


@dataclass(frozen=True)
class Recipe:
    """Parts of an arm. Our rasterizer does not go with absgrad, whose gradients lie in an attribute of gsplat's own
    tensor.

    Attributes:
        our_loss: Our fits' loss in one pass, in place of torch's operations.
    """

    rasterizer: Literal["gsplat", "ours"]
    strategy: Literal["mcmc", "default", "absgrad"]
    our_loss: bool = False

    def initial(self, settings: FitSettings, points: int) -> FitSettings:
        """Return the settings of initialize_gaussians for the recipe's start from so many points."""
        if self.strategy == "mcmc":
            return replace(settings, init_opa=0.5, init_scale=0.1)
        return replace(settings, init_opa=0.1, init_scale=1.0, cap_max=max(settings.cap_max, points))


def _parameters(start: Gaussians) -> torch.nn.ParameterDict:
    """Return the parameters under the names of the strategies; harmonics are of SH_DEGREE."""
    sh = start.sh.new_zeros(start.count, (SH_DEGREE + 1) ** 2, 3)
    sh[:, : start.sh.shape[1]] = start.sh
    tensors = {
        "means": start.means,
        "scales": start.scales.log(),
        "quats": start.quaternions,
        "opacities": start.opacities.logit(),
        "sh0": sh[:, :1],
        "shN": sh[:, 1:],
    }
    copies = {name: torch.nn.Parameter(tensor.detach().clone().contiguous()) for name, tensor in tensors.items()}
    return torch.nn.ParameterDict(copies)


class PeerFit:
    """A fit by a recipe. It draws random numbers from torch's generators, and seeds them."""

    def __init__(self, recipe: Recipe, start: Gaussians, images: PosedImages, settings: FitSettings) -> None:
        if images.model != "pinhole":
            raise InputError(
                f"gsplat's arms fit photographs by pinholes, and these are {images.model}: give --arms ours"
            )
        torch.manual_seed(settings.seed)
        self._recipe, self._images, self._settings = recipe, images, settings
        self._rasterization = peers.gsplat().rasterization
        self._order = Schedule.make(settings, images.count, "cpu").order[:, 0].tolist()
        self._cameras = [images.cameras(place) for place in range(images.count)]
        self._matrices = [peers.intrinsic_matrices(cameras) for cameras in self._cameras]
        self._done = 0
        self.params = _parameters(start)
        self._optimizers = {name: self._optimizer(name) for name in RATES}
        decay = MEANS_LR_DECAY ** (1 / settings.steps)
        self._rate_of_means = torch.optim.lr_scheduler.ExponentialLR(self._optimizers["means"], decay)
        self._strategy = self._made_strategy()
        self._strategy.check_sanity(self.params, self._optimizers)
        # The extent of the cameras, by which the default strategy measures sizes, is 1
        self._state = self._strategy.initialize_state()

    def _optimizer(self, name: str) -> torch.optim.Adam:
        group = {"params": [self.params[name]], "lr": RATES[name], "name": name}
        return torch.optim.Adam([group], eps=1e-15, betas=(0.9, 0.999), fused=self.params[name].is_cuda)

    def _made_strategy(self) -> Any:
        module = peers.gsplat()
        if self._recipe.strategy == "mcmc":
            times = {"refine_start_iter": 500, "refine_stop_iter": 25_000, "refine_every": 100}
            return module.MCMCStrategy(cap_max=self._settings.cap_max, **self._scaled(times))
        times = {"refine_start_iter": 500, "refine_stop_iter": 15_000, "reset_every": 3000, "refine_every": 100}
        absolute = {"absgrad": True, "grow_grad2d": ABSGRAD_GROW} if self._recipe.strategy == "absgrad" else {}
        return module.DefaultStrategy(**self._scaled(times), **absolute)

    def _scaled(self, times: dict[str, int]) -> dict[str, int]:
        """Scale steps of the recipe to a fit of this length."""
        return {name: max(1, int(step * self._settings.steps / RECIPE_STEPS)) for name, step in times.items()}

    def advance(self, until: int) -> None:
        """Does the steps up to `until`."""
        for step in range(self._done, until):
            self._step(step)
        self._done = until

    def _step(self, step: int) -> None:
        """One step: the optimizers come before the strategy, as in gsplat's trainer."""
        place = self._order[step]
        image, info = self._drawn(self._cameras[place], self._matrices[place], self._degree(step))
        state = (self.params, self._optimizers, self._state, step, info)
        self._strategy.step_pre_backward(*state)
        self._loss(image, place).backward()
        for optimizer in self._optimizers.values():
            optimizer.step()
            optimizer.zero_grad(set_to_none=True)
        self._rate_of_means.step()
        if self._recipe.strategy == "mcmc":
            self._strategy.step_post_backward(*state, lr=self._rate_of_means.get_last_lr()[0])
        else:
            self._strategy.step_post_backward(*state, packed=False)

    def _degree(self, step: int) -> int:
        (every,) = self._scaled({"sh_degree_interval": SH_DEGREE_INTERVAL}).values()
        return min(step // every, SH_DEGREE)

    def _drawn(self, cameras: Cameras, matrices: Tensor, degree: int) -> tuple[Tensor, dict[str, Any]]:
        """Return the image [1, H, W, 3] before black, and gsplat's information on it."""
        params = self.params
        sh = torch.cat([params["sh0"], params["shN"]], 1)
        scales, opacities = params["scales"].exp(), params["opacities"].sigmoid()
        if self._recipe.rasterizer == "ours":
            used = sh[:, : (degree + 1) ** 2].contiguous()
            scene = Gaussians(params["means"], params["quats"], scales, opacities, used)
            return self._drawn_by_ours(scene, cameras)
        image, _, info = self._rasterization(
            params["means"],
            params["quats"],
            scales,
            opacities,
            sh,
            cameras.world_to_camera,
            matrices,
            cameras.width_px,
            cameras.height_px,
            sh_degree=degree,
            absgrad=self._recipe.strategy == "absgrad",
            **OPTIONS,
        )
        return image, info

    def _drawn_by_ours(self, scene: Gaussians, cameras: Cameras) -> tuple[Tensor, dict[str, Any]]:
        """Return our image, and the information that the strategies expect from gsplat."""
        if self._recipe.strategy == "mcmc" or not torch.is_grad_enabled():
            return render(scene, cameras, background=BLACK).image, {}
        screen = scene.means.new_zeros(1, scene.count, 2, requires_grad=True)
        images = render(scene, cameras, background=BLACK, screen=screen, radii=True)
        radii = cast(Tensor, images.radii)
        info = {"means2d": screen, "radii": radii[..., None].expand(-1, -1, 2), "gaussian_ids": None, "n_cameras": 1}
        return images.image, {**info, "width": cameras.width_px, "height": cameras.height_px}

    def _loss(self, image: Tensor, place: int) -> Tensor:
        """Return the loss of Kerbl et al. 2023, with regularisers of mcmc; masked pixels look as in the photograph."""
        photo, weights = self._images.photos[place][None], None
        if self._images.weights is not None:
            weights = self._images.weights[place][None] / 255
        if self._recipe.our_loss:
            loss = photo_loss(image, photo, weights, SSIM_LAMBDA)
        else:
            photo = photo / 255
            if weights is not None:
                image = weights[..., None] * image + (1 - weights[..., None]) * photo
            structure = ssim(image.movedim(-1, 1), photo.movedim(-1, 1)).mean()
            loss = (1 - SSIM_LAMBDA) * (image - photo).abs().mean() + SSIM_LAMBDA * (1 - structure)
        if self._recipe.strategy == "mcmc":
            loss = loss + OPACITY_REG * self.params["opacities"].sigmoid().mean()
            loss = loss + SCALE_REG * self.params["scales"].exp().mean()
        return loss

    @torch.no_grad()
    def draw(self, cameras: Cameras) -> Tensor:
        """The scene before a camera, [1, H, W, 3], by the rasterizer of the recipe."""
        return self._drawn(cameras, peers.intrinsic_matrices(cameras), self._degree(max(0, self._done - 1)))[0]

    @torch.no_grad()
    def gaussians(self) -> Gaussians:
        """The scene as it is now."""
        params = self.params
        count = (self._degree(max(0, self._done - 1)) + 1) ** 2
        sh = torch.cat([params["sh0"], params["shN"]], 1)[:, :count].contiguous()
        scales, opacities = params["scales"].exp(), params["opacities"].sigmoid()
        return Gaussians(params["means"].detach(), params["quats"].detach(), scales, opacities, sh)
