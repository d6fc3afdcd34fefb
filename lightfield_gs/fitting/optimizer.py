"""The parameters of a scene under optimisation, and Adam's step over all of them in one pass (csrc/math/fit/update.h).

The pass has the chain rule through exp and sigmoid, the regularisers and noise of MCMC (Kheradmand et al., NeurIPS
2024), and Adam (Kingma & Ba, ICLR 2015).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from types import ModuleType
from typing import Any, NamedTuple

import torch
from torch import Tensor

from lightfield_gs import _core
from lightfield_gs.base.arrays import check_tensor
from lightfield_gs.base.checks import expect, real_number, whole_number
from lightfield_gs.base.errors import InputError
from lightfield_gs.base.harmonics import SH_COEFFICIENTS
from lightfield_gs.base.stages import optional_address, run_stage, select_stages
from lightfield_gs.scene.gaussians import Gaussians

MOST_LOG_SCALE = _core.MOST_LOG_SCALE  # the update keeps log_scales within -20..20: 2e-9 .. 5e8 scene units
MOST_LOGIT = _core.MOST_LOGIT  # and logits within -15..15, so that opacities stay below 1 in float32 as well
BETAS, EPSILON = (0.9, 0.999), 1e-15  # Kerbl et al. 2023
_GROUPS = ("values", "first", "second")
_COLUMNS = "means_lr scales_lr quats_lr opacities_lr sh0_lr shN_lr noise_lr opacity_reg scale_reg".split()


class RawParameters(NamedTuple):
    """The optimised parameters, or their first or second moments: N Gaussians with K harmonics (1, 4, 9 or 16)."""

    means: Tensor  # [N,3] scene units
    log_scales: Tensor  # [N,3], of scales in scene units
    quaternions: Tensor  # [N,4] wxyz, of any length but zero
    logits: Tensor  # [N], of opacities
    sh: Tensor  # [N,K,3]

    def zeros_like(self, on_host: bool = False) -> RawParameters:
        """Return zeros: the moments of a run that begins. on_host: in the host's memory, see GaussianState."""
        if on_host and self.means.is_cuda:
            return RawParameters(*(torch.zeros(t.shape, dtype=t.dtype, pin_memory=True) for t in self))
        return RawParameters(*(torch.zeros_like(tensor) for tensor in self))


class Gradients(NamedTuple):
    """Gradients of the loss by the Gaussians that are drawn, as the backward pass of a render gives them."""

    means: Tensor  # [N,3]
    quaternions: Tensor  # [N,4], as they are: of any length
    scales: Tensor  # [N,3]
    opacities: Tensor  # [N]
    sh: Tensor  # [N,K,3]


@dataclass
class GaussianState:
    """N Gaussians under optimisation; all tensors are contiguous and of one dtype.

    Attributes:
        values: the parameters, with the K harmonics of the degree in use.
        first, second: the moments of Adam. They are on the device of the values, or in pinned memory of the host: an
            update reads and writes each once, and a GPU reaches them there by itself.
        scales: [N,3], exp of log_scales; every update renews it.
        opacities: [N], sigmoid of logits; every update renews it.
    """

    values: RawParameters
    first: RawParameters
    second: RawParameters
    scales: Tensor
    opacities: Tensor

    @classmethod
    def start(cls, gaussians: Gaussians, moments_on_host: bool = False) -> GaussianState:
        """Return the state of a scene [N, ...] with moments of zero."""
        tensors = (
            gaussians.means,
            gaussians.scales.log(),
            gaussians.quaternions,
            torch.logit(gaussians.opacities).clamp(-MOST_LOGIT, MOST_LOGIT),
            gaussians.sh,
        )
        values = RawParameters(*(tensor.detach().contiguous().clone() for tensor in tensors))
        first, second = (values.zeros_like(moments_on_host) for _ in range(2))
        return cls(values, first, second, *activate(values))

    @property
    def count(self) -> int:
        """N."""
        return self.values.means.shape[0]

    @property
    def degree(self) -> int:
        """The degree of the harmonics in use."""
        return SH_COEFFICIENTS.index(self.values.sh.shape[1])

    def gaussians(self) -> Gaussians:
        """Return the scene for drawing; it shares the memory of the state."""
        return Gaussians(self.values.means, self.values.quaternions, self.scales, self.opacities, self.values.sh)

    def tensors(self) -> dict[str, Tensor]:
        """Return all tensors by name, for a checkpoint."""
        named = {f"{group}.{name}": t for group in _GROUPS for name, t in getattr(self, group)._asdict().items()}
        return {**named, "scales": self.scales, "opacities": self.opacities}

    def restored(self, tensors: dict[str, Tensor]) -> GaussianState:
        """Return the state whose `tensors` these are, on the host, with all where this state has its own."""

        def group(name: str) -> RawParameters:
            own: RawParameters = getattr(self, name)
            return RawParameters(*(_placed(tensors[f"{name}.{part}"], t) for part, t in own._asdict().items()))

        scales, opacities = (tensors[name].to(self.scales.device) for name in ("scales", "opacities"))
        return GaussianState(group("values"), group("first"), group("second"), scales, opacities)

    def select(self, rows: Tensor) -> GaussianState:
        """Return the Gaussians `rows` [M], with their moments: others, or another order."""
        return self._map(lambda tensor: tensor[rows.to(tensor.device)])

    def append(self, sources: Tensor) -> GaussianState:
        """Return the Gaussians with copies of `sources` [M] behind them, whose moments are zero."""
        extended = self._map(lambda tensor: torch.cat([tensor, tensor[sources.to(tensor.device)]]))
        extended.zero_moments(torch.arange(self.count, extended.count, device=self.scales.device))
        return extended

    def zero_moments(self, rows: Tensor) -> None:
        """Set the moments of Gaussians `rows` [M] to zero."""
        for moment in (*self.first, *self.second):
            moment[rows.to(moment.device)] = 0

    def _map(self, change: Callable[[Tensor], Tensor]) -> GaussianState:
        """Return a state with `change` of every tensor, each where it is."""
        groups = ((self.scales, self.opacities), self.values, self.first, self.second)
        (scales, opacities), *raw = ([_placed(change(t).contiguous(), t) for t in group] for group in groups)
        values, first, second = (RawParameters(*tensors) for tensors in raw)
        return GaussianState(values, first, second, scales, opacities)

    def refresh(self) -> None:
        """Compute scales and opacities again, after log_scales or logits were set."""
        for drawn, fresh in zip((self.scales, self.opacities), activate(self.values)):
            drawn.copy_(fresh)

    def raise_degree(self, degree: int) -> None:
        """Extend the harmonics to `degree` with coefficients of zero."""

        def extend(raw: RawParameters) -> RawParameters:
            sh = raw.sh.new_zeros(self.count, SH_COEFFICIENTS[degree], 3)
            sh[:, : raw.sh.shape[1]] = raw.sh
            return raw._replace(sh=_placed(sh, raw.sh))

        self.values, self.first, self.second = map(extend, (self.values, self.first, self.second))


def _placed(tensor: Tensor, like: Tensor) -> Tensor:
    """Return a tensor where another one is, also in pinned memory."""
    return tensor.pin_memory() if like.is_pinned() else tensor.to(like.device)


def activate(values: RawParameters) -> tuple[Tensor, Tensor]:
    """Return scales [N,3] and opacities [N] of parameters, within the limits that the update keeps."""
    limits = MOST_LOG_SCALE, MOST_LOGIT
    log_scales, logits = (raw.clamp(-most, most) for raw, most in zip((values.log_scales, values.logits), limits))
    return log_scales.exp(), logits.sigmoid()


def bias_corrections(steps: int, betas: tuple[float, float] = BETAS) -> list[list[float]]:
    """Return Adam's 1 - beta1^t and 1 - beta2^t, each a list over t = 1..steps."""
    return [[1 - beta**t for t in range(1, steps + 1)] for beta in betas]


def update_table(
    steps: int,
    *,
    means_lr: float | Sequence[float] | Tensor,
    scales_lr: float | Sequence[float] | Tensor,
    quats_lr: float | Sequence[float] | Tensor,
    opacities_lr: float | Sequence[float] | Tensor,
    sh0_lr: float | Sequence[float] | Tensor,
    shN_lr: float | Sequence[float] | Tensor,
    noise_lr: float | Sequence[float] | Tensor = 0.0,
    opacity_reg: float | Sequence[float] | Tensor = 0.0,
    scale_reg: float | Sequence[float] | Tensor = 0.0,
    betas: tuple[float, float] = BETAS,
    dtype: torch.dtype = torch.float32,
    device: torch.device | str = "cpu",
) -> Tensor:
    """Return the numbers of all steps of a run, [steps, 11], computed in float64.

    A row is StepNumbers of csrc/math/fit/update.h. It has the six learning rates in the order of the arguments, then
    1 - beta1^t and 1 - beta2^t with t = row + 1, then noise_lr, opacity_reg and scale_reg. Each argument is one number
    for all steps, or one for each; none is negative.

    Args:
        steps: 1..2^31.
        means_lr: learning rate of means, scene units.
        scales_lr: of log_scales.
        quats_lr: of quaternions.
        opacities_lr: of logits.
        sh0_lr: of the first harmonic.
        shN_lr: of the other harmonics.
        noise_lr: scale of the noise of positions, a factor of means_lr.
        opacity_reg: weight in the loss of the mean opacity.
        scale_reg: weight in the loss of the mean scale.
        betas: of Adam.
        dtype: of the table.
        device: of the table.

    Raises:
        InputError: a number is negative or not finite, or a row has another length.
    """
    steps = whole_number("steps", steps, 1, 2**31)
    values = (means_lr, scales_lr, quats_lr, opacities_lr, sh0_lr, shN_lr, noise_lr, opacity_reg, scale_reg)
    corrections = torch.tensor(bias_corrections(steps, _check_betas(betas)), dtype=torch.float64)
    columns = [_column(name, value, steps) for name, value in zip(_COLUMNS, values)]
    return torch.stack([*columns[:6], *corrections, *columns[6:]], 1).to(device=device, dtype=dtype).contiguous()


def update(
    values: RawParameters,
    first: RawParameters,
    second: RawParameters,
    gradients: Gradients,
    scales: Tensor,
    opacities: Tensor,
    *,
    table: Tensor,
    step: Tensor,
    skipped: Tensor,
    seed: int,
    seen: Tensor | None = None,
    betas: tuple[float, float] = BETAS,
    epsilon: float = EPSILON,
) -> None:
    """Update all parameters by one step of Adam in place, and renew `scales` and `opacities`.

    All tensors are contiguous, on one device, and float32, on the CPU also float64. The moments of parameters on a GPU
    may be in pinned memory of the host, which the work then reads and writes. On CUDA all work is in torch's
    current stream, and a step outside the table skips all Gaussians.

    Args:
        values: the parameters.
        first: their first moments.
        second: their second moments.
        gradients: of the loss, at `scales` and `opacities` as they are.
        scales: [N,3], see activate.
        opacities: [N], see activate.
        table: [steps, 11], see update_table, with the same betas.
        step: one int64, the row to use. It stays on the device, so that a CUDA graph can repeat the call for all steps;
            the caller counts it up.
        skipped: one int64, a sum of numbers of Gaussians that keep their values, because their gradient exceeds 1e18 or
            is NaN.
        seed: 0..2^64-1, of the noise.
        seen: [N] uint8, zero for Gaussians without regularisers; None: all have them.
        betas: of Adam.
        epsilon: of Adam.

    Raises:
        InputError: another shape, dtype or device, a parameter that is not contiguous, or on the CPU a step outside the
            table.
    """
    stages, buffers, _held = _native_buffers(values, first, second, gradients, scales, opacities)
    like, device = values.means, values.means.device
    rows = table.shape[0] if isinstance(table, Tensor) and table.dim() == 2 else 0
    table = check_tensor("table", table, (rows, _core.STEP_COLUMNS), like.dtype, device)
    for name, counter in (("step", step), ("skipped", skipped)):
        expect(name, counter, Tensor)
        check_tensor(name, counter.reshape(-1), (1,), torch.int64, device)
    if not like.is_cuda and not 0 <= int(step) < rows:
        raise InputError(f"step must be a row of the table, 0..{rows - 1}, got {int(step)}")
    if seen is not None:
        seen = check_tensor("seen", seen, (len(like),), torch.uint8, device)
    beta1, beta2 = _check_betas(betas)
    native = stages.Update(
        **buffers,
        seen=optional_address(seen),
        table=table.data_ptr(),
        rows=rows,
        step=step.data_ptr(),
        skipped=skipped.data_ptr(),
        beta1=beta1,
        beta2=beta2,
        epsilon=real_number("epsilon", epsilon, 1e-30, 1),
        seed=whole_number("seed", seed, 0, 2**64 - 1),
    )
    run_stage("update", stages, device, native)


def _native_buffers(
    values: RawParameters, first: RawParameters, second: RawParameters, gradients: Gradients, *drawn: Tensor
) -> tuple[ModuleType, dict[str, Any], list[Tensor]]:
    """Check the tensors of N Gaussians; return the native stages, the buffers, and gradients that must outlive them."""
    means, sh = values.means, values.sh
    expect("means", means, Tensor)
    expect("sh", sh, Tensor)
    if means.dim() != 2 or means.shape[1] != 3:
        raise InputError(f"means must be [N,3], got {list(means.shape)}")
    if sh.dim() != 3 or sh.shape[1] not in SH_COEFFICIENTS:
        raise InputError(f"sh must be [N, 1 | 4 | 9 | 16, 3], got {list(sh.shape)}")
    stages, n, like = select_stages("means", means), len(means), (means.dtype, means.device)
    widths = {"means": (3,), "log_scales": (3,), "scales": (3,), "quaternions": (4,), "sh": (sh.shape[1], 3)}
    groups = ("", values), ("first moments of ", first), ("second moments of ", second)
    named = [(what + name, name, t) for what, group in groups for name, t in zip(RawParameters._fields, group)]
    for what, name, tensor in [*named, *((name, name, t) for name, t in zip(("scales", "opacities"), drawn))]:
        where = tensor.device if what != name and _is_reached(tensor, means.device) else means.device
        check_tensor(what, tensor, (n, *widths.get(name, ())), means.dtype, where, writes=True)
    held = [
        check_tensor(f"gradient of {name}", tensor, (n, *widths.get(name, ())), *like)
        for name, tensor in zip(Gradients._fields, gradients)
    ]
    buffers = {
        name: stages.Parameters(*(t.data_ptr() for t in tensors))
        for name, tensors in (("parameters", values), ("first", first), ("second", second))
    }
    buffers |= {name: t.data_ptr() for name, t in zip(("scales", "opacities"), drawn)}
    degree = SH_COEFFICIENTS.index(sh.shape[1])
    return stages, {**buffers, "gradients": stages.Gaussians(n, degree, *(t.data_ptr() for t in held))}, held


def _is_reached(moment: object, device: torch.device) -> bool:
    """Return whether a GPU reaches a tensor of the host by itself. A capture follows a step that found out."""
    if device.type != "cuda" or not isinstance(moment, Tensor) or moment.device.type != "cpu":
        return False
    return torch.cuda.is_current_stream_capturing() or moment.is_pinned()


def _check_betas(betas: tuple[float, float]) -> tuple[float, float]:
    first, second = betas
    return real_number("beta1", first, 0, 0.9999999), real_number("beta2", second, 0, 0.9999999)


def _column(name: str, value: float | Sequence[float] | Tensor, steps: int) -> Tensor:
    """Return [steps], `value` of each step, float64 on the CPU."""
    column = torch.as_tensor(value, dtype=torch.float64).cpu()
    if column.dim() > 1 or column.dim() == 1 and len(column) != steps:
        raise InputError(f"{name} must be one number or one for each of {steps} steps, got {list(column.shape)}")
    if not bool((column.isfinite() & (column >= 0)).all()):
        raise InputError(f"{name} must be finite and not negative")
    return column.expand(steps)
