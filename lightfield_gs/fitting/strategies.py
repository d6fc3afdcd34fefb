"""Density control for a training loop of one's own, with the interface of gsplat 1.5's strategies.

A loop keeps its Gaussians in parameters by name: means [N, 3], scales [N, 3] (logarithms), quats [N, 4], opacities [N]
(logits) and any others [N, ...]. Each has an optimizer of its own. In a step the loop draws, calls `step_pre_backward`,
runs backward and the optimizers, and calls `step_post_backward`, which may replace the parameters.

Sources: Kerbl et al. 2023, section 5, for DefaultStrategy; Kheradmand et al., "3D Gaussian Splatting as Markov Chain
Monte Carlo", 2024, for MCMCStrategy; Ye et al., "gsplat", JMLR 2025, for names, defaults and the order of calls.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from lightfield_gs.base.harmonics import rotations
from lightfield_gs.fitting.density import compute_relocation, sample_indices
from lightfield_gs.fitting.parameter_rows import Optimizers, Parameters, check_parameters, set_rows, take_rows

_NEEDED = ("means", "scales", "quats", "opacities")
_SHRINK = 1.6  # a split Gaussian becomes two, with scales divided by this
_GROWTH = 1.05  # of the number of Gaussians, each time
_STEEP, _FAINT = 100.0, 0.995  # noise: a Gaussian moves if its opacity is below 1 - _FAINT, and how sharp this is
_MOST_OPACITY = 1 - 1e-7


class _Strategy:
    """The part of gsplat's interface that all strategies share."""

    def check_sanity(self, params: Parameters, optimizers: Optimizers) -> None:
        """Raise InputError for missing parameters, or parameters without an optimizer of their own."""
        check_parameters(params, optimizers, _NEEDED)


@dataclass
class DefaultStrategy(_Strategy):
    """Clone, split and prune (Kerbl et al. 2023). Fields have gsplat's names, meanings and defaults.

    Opacities are lowered every `reset_every` steps, as the paper has it. In gsplat 1.5.3 this condition is never true:
    reset_every=10**9 gives its results.

    Attributes:
        prune_opa: fainter Gaussians are removed.
        grow_grad2d: mean gradient of the projected mean, in halves of the image, from which on Gaussians grow.
        grow_scale3d: in scene_scale; smaller Gaussians are cloned, larger ones are split.
        grow_scale2d: radius as a fraction of the image, from which on Gaussians are split before
            refine_scale2d_stop_iter.
        prune_scale3d: in scene_scale; larger ones are removed after the first reset.
        prune_scale2d: radius as a fraction of the image; larger ones are removed before refine_scale2d_stop_iter.
        refine_scale2d_stop_iter: the step up to which radii on the screen count.
        refine_start_iter, refine_stop_iter, refine_every: the steps after which the density changes.
        reset_every: steps between resets of opacities.
        pause_refine_after_reset: steps without a change after a reset.
        absgrad: absolute gradients, see rasterization(absgrad=True); grow_grad2d is then higher, 8e-4 or so.
        revised_opacity: halves of a split Gaussian have together the opacity of the whole (Rota Bulo et al. 2024).
        verbose: print the numbers of Gaussians that came and went.
        key_for_gradient: the name of the projected means in `info`.
    """

    prune_opa: float = 0.005
    grow_grad2d: float = 0.0002
    grow_scale3d: float = 0.01
    grow_scale2d: float = 0.05
    prune_scale3d: float = 0.1
    prune_scale2d: float = 0.15
    refine_scale2d_stop_iter: int = 0
    refine_start_iter: int = 500
    refine_stop_iter: int = 15_000
    reset_every: int = 3000
    refine_every: int = 100
    pause_refine_after_reset: int = 0
    absgrad: bool = False
    revised_opacity: bool = False
    verbose: bool = False
    key_for_gradient: str = "means2d"

    def initialize_state(self, scene_scale: float = 1.0) -> dict[str, Any]:
        """Return the state of a fit; scene_scale: the unit of sizes, such as the extent of the cameras."""
        return {"grad2d": None, "count": None, "radii": None, "scene_scale": scene_scale}

    def step_pre_backward(
        self, params: Parameters, optimizers: Optimizers, state: dict[str, Any], step: int, info: dict[str, Any]
    ) -> None:
        """Prepare for the gradients of the projected means; before loss.backward()."""
        info[self.key_for_gradient].retain_grad()

    @torch.no_grad()
    def step_post_backward(
        self,
        params: Parameters,
        optimizers: Optimizers,
        state: dict[str, Any],
        step: int,
        info: dict[str, Any],
        packed: bool = False,
    ) -> None:
        """Gather the gradients of a step, and change the density where due; after loss.backward().

        Args:
            params: replaced where the density changes.
            optimizers: their states follow.
            state: of initialize_state.
            step: counted from 0.
            info: of rasterization.
            packed: as rasterization had it.
        """
        if step >= self.refine_stop_iter:
            return
        self._gather(params, state, info, packed)
        rests = step % self.reset_every < self.pause_refine_after_reset
        if step > self.refine_start_iter and step % self.refine_every == 0 and not rests:
            self._refine(params, optimizers, state, step)
        if step > 0 and step % self.reset_every == 0:
            most = math.log(2 * self.prune_opa / (1 - 2 * self.prune_opa))
            logits = params["opacities"].detach().clamp(max=most)
            set_rows(params, optimizers, {"opacities": logits}, torch.ones_like(logits, dtype=torch.bool).flatten())

    def _gather(self, params: Parameters, state: dict[str, Any], info: dict[str, Any], packed: bool) -> None:
        """Add the norms of this step's gradients, in halves of the image, and count the images of each Gaussian."""
        projected = info[self.key_for_gradient]
        gradients = (projected.absgrad if self.absgrad else projected.grad).detach()
        halves = gradients.new_tensor([info["width"], info["height"]]) / 2 * info["n_cameras"]
        norms, radii = (gradients * halves).norm(dim=-1), info["radii"]
        if packed:
            rows, largest = info["gaussian_ids"], radii.amax(-1)
        else:
            seen = (radii > 0).all(-1)
            rows, norms, largest = seen.nonzero()[:, -1], norms[seen], radii[seen].amax(-1)
        count = len(params["means"])
        for name in ("grad2d", "count", "radii"):
            if state[name] is None:
                state[name] = torch.zeros(count, device=norms.device)
        state["grad2d"].index_add_(0, rows, norms.to(state["grad2d"]))
        state["count"].index_add_(0, rows, torch.ones_like(norms, dtype=state["count"].dtype))
        sizes = largest.to(state["radii"]) / max(info["width"], info["height"])
        state["radii"].scatter_reduce_(0, rows, sizes, "amax")

    def _refine(self, params: Parameters, optimizers: Optimizers, state: dict[str, Any], step: int) -> None:
        """Clone, split and prune. Rows: those that stay, clones, first halves, second halves."""
        unit, by_screen = state["scene_scale"], step < self.refine_scale2d_stop_iter
        wanting = state["grad2d"] / state["count"].clamp_min(1) > self.grow_grad2d
        small = params["scales"].exp().amax(-1) <= self.grow_scale3d * unit
        split = wanting & ~small
        if by_screen:
            split |= state["radii"] > self.grow_scale2d
        clones, whole, halves = ((wanting & small).nonzero()[:, 0], (~split).nonzero()[:, 0], split.nonzero()[:, 0])
        rows = torch.cat([whole, clones, halves, halves])
        fresh = torch.arange(len(rows), device=rows.device) >= len(whole)
        offsets = _own_offsets(params, torch.cat([halves, halves]))
        parts = slice(len(rows) - len(offsets), None)

        def change(name: str, taken: Tensor) -> Tensor:
            if name == "means":
                taken[parts] += offsets
            elif name == "scales":
                taken[parts] -= math.log(_SHRINK)
            elif name == "opacities" and self.revised_opacity:
                taken[parts] = (1 - (1 - taken[parts].sigmoid()).sqrt()).logit()
            return taken

        take_rows(params, optimizers, rows, fresh, change)
        radii = state["radii"][rows]
        gone = params["opacities"].flatten().sigmoid() < self.prune_opa
        if step > self.reset_every:
            gone |= params["scales"].exp().amax(-1) > self.prune_scale3d * unit
            if by_screen:
                gone |= radii > self.prune_scale2d
        kept = (~gone).nonzero()[:, 0]
        take_rows(params, optimizers, kept, torch.zeros_like(kept, dtype=torch.bool))
        state.update(grad2d=None, count=None, radii=None)
        if self.verbose:
            print(
                f"step {step}: {len(clones)} Gaussians cloned, {len(halves)} split, {len(rows) - len(kept)} pruned; "
                f"{len(kept)} now"
            )


@dataclass
class MCMCStrategy(_Strategy):
    """Move dead Gaussians to live ones and add new ones (Kheradmand et al. 2024). Fields as in gsplat.

    Attributes:
        cap_max: the number of Gaussians at the end.
        noise_lr: noise of the means, in learning rates of the means.
        refine_start_iter, refine_stop_iter, refine_every: the steps after which Gaussians move and come.
        min_opacity: fainter Gaussians are dead.
        verbose: print the numbers of Gaussians that moved and came.
    """

    cap_max: int = 1_000_000
    noise_lr: float = 5e5
    refine_start_iter: int = 500
    refine_stop_iter: int = 25_000
    refine_every: int = 100
    min_opacity: float = 0.005
    verbose: bool = False

    def initialize_state(self) -> dict[str, Any]:
        """Return the state of a fit: none is needed."""
        return {}

    def step_pre_backward(
        self, params: Parameters, optimizers: Optimizers, state: dict[str, Any], step: int, info: dict[str, Any]
    ) -> None:
        """Do nothing: MCMC needs no gradients of its own."""

    @torch.no_grad()
    def step_post_backward(
        self,
        params: Parameters,
        optimizers: Optimizers,
        state: dict[str, Any],
        step: int,
        info: dict[str, Any],
        lr: float,
    ) -> None:
        """Move and add Gaussians where due, and add noise to the means; after loss.backward() and the optimizers.

        Args:
            params: replaced where Gaussians move or come.
            optimizers: their states follow.
            state: of initialize_state.
            step: counted from 0.
            info: of rasterization; not read.
            lr: learning rate of the means.
        """
        if self.refine_start_iter < step < self.refine_stop_iter and step % self.refine_every == 0:
            moved, came = self._move(params, optimizers), self._grow(params, optimizers)
            if self.verbose:
                print(f"step {step}: {moved} Gaussians moved, {came} came; {len(params['means'])} now")
        opacities = params["opacities"].flatten().sigmoid()
        share = torch.sigmoid(-_STEEP * (opacities - (1 - _FAINT)))
        axes = rotations(params["quats"]) * params["scales"].exp()[:, None]
        noise = torch.randn_like(params["means"]) * (share * self.noise_lr * lr)[:, None]
        params["means"].add_((axes @ axes.mT @ noise[:, :, None])[:, :, 0])

    def _move(self, params: Parameters, optimizers: Optimizers) -> int:
        """Replace dead Gaussians by copies of live ones; return how many."""
        opacities = params["opacities"].flatten().sigmoid()
        dead = (opacities <= self.min_opacity).nonzero()[:, 0]
        if not 0 < len(dead) < len(opacities):
            return 0
        alive = torch.where(opacities > self.min_opacity, opacities, 0)
        sources = sample_indices(alive, len(dead), _draw_seed(), 0)
        values, shared = self._shared(params, sources)
        like = torch.arange(len(opacities), device=sources.device)
        like[dead] = sources
        values = {name: value[like] for name, value in values.items()}
        set_rows(params, optimizers, values, shared.index_fill(0, dead, True), like)
        return len(dead)

    def _grow(self, params: Parameters, optimizers: Optimizers) -> int:
        """Append copies of Gaussians; return how many."""
        count = len(params["means"])
        wanted = min(self.cap_max, int(_GROWTH * count)) - count
        if wanted <= 0:
            return 0
        sources = sample_indices(params["opacities"].flatten().sigmoid(), wanted, _draw_seed(), 1)
        values, shared = self._shared(params, sources)
        set_rows(params, optimizers, values, shared)
        rows = torch.cat([torch.arange(count, device=sources.device), sources])
        take_rows(params, optimizers, rows, torch.arange(len(rows), device=rows.device) >= count)
        return wanted

    def _shared(self, params: Parameters, sources: Tensor) -> tuple[dict[str, Tensor], Tensor]:
        """Return opacities and scales [N, ...] once each source and its copies share its light, and who shares [N]."""
        logits, log_scales = params["opacities"].detach(), params["scales"].detach()
        ratios = torch.bincount(sources, minlength=len(logits)) + 1
        rows = (ratios > 1).nonzero()[:, 0]
        opacities, scales = compute_relocation(
            logits.flatten()[rows].double().sigmoid(), log_scales[rows].double().exp(), ratios[rows]
        )
        new = opacities.clamp(self.min_opacity, _MOST_OPACITY).logit().to(logits)
        shared = {
            "opacities": logits.index_copy(0, rows, new.view(-1, *logits.shape[1:])),
            "scales": log_scales.index_copy(0, rows, scales.log().to(log_scales)),
        }
        return shared, ratios > 1


def _own_offsets(params: Parameters, rows: Tensor) -> Tensor:
    """Draw an offset [M, 3] from each of some Gaussians' own distributions."""
    along = params["scales"].detach()[rows].exp() * torch.randn(len(rows), 3).to(params["scales"])
    return (rotations(params["quats"].detach()[rows]) @ along[:, :, None])[:, :, 0]


def _draw_seed() -> int:
    """Draw a seed from torch's generator, so that torch.manual_seed decides all."""
    return int(torch.randint(1 << 62, ()))
