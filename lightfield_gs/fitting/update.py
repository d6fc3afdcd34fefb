"""A step of the optimiser over all fields of a scene in one pass (csrc/math/fit/update.h).

Chain rule through exp and sigmoid, regularisers and noise of MCMC (Kheradmand et al., NeurIPS 2024), Adam (Kingma & Ba,
ICLR 2015).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from lightfield_gs import _core
from lightfield_gs.base.checks import expect, real_number, whole_number
from lightfield_gs.base.cuda import device_guard
from lightfield_gs.base.errors import InputError
from lightfield_gs.fitting.native import check_tensor, core_of, optional_address, stream_of

MOST_LOG_SCALE = _core.MOST_LOG_SCALE  # the update keeps log_scales within -20..20: 2e-9 .. 5e8 scene units
MOST_LOGIT = _core.MOST_LOGIT  # and logits within -15..15, so that opacities stay below 1 in float32 as well
BETAS, EPSILON = (0.9, 0.999), 1e-15  # Kerbl et al. 2023


class RawFields(NamedTuple):
    """What is optimised, or its first or second moments: N Gaussians with K harmonics (1, 4, 9 or 16)."""

    means: Tensor  # [N,3] scene units
    log_scales: Tensor  # [N,3], of scales in scene units
    quaternions: Tensor  # [N,4] wxyz, of any length but zero
    logits: Tensor  # [N], of opacities
    sh: Tensor  # [N,K,3]

    def zeros_like(self) -> RawFields:
        """Moments of a run that begins."""
        return RawFields(*(torch.zeros_like(field) for field in self))


class Gradients(NamedTuple):
    """Of the loss with respect to what is drawn, as the reverse of a render gives them."""

    means: Tensor  # [N,3]
    quaternions: Tensor  # [N,4], as they are: of any length
    scales: Tensor  # [N,3]
    opacities: Tensor  # [N]
    sh: Tensor  # [N,K,3]


def activated(fields: RawFields) -> tuple[Tensor, Tensor]:
    """Scales [N,3] and opacities [N] of fields, within the limits that the update keeps."""
    limits = MOST_LOG_SCALE, MOST_LOGIT
    log_scales, logits = (field.clamp(-most, most) for field, most in zip((fields.log_scales, fields.logits), limits))
    return log_scales.exp(), logits.sigmoid()


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
    """The numbers of every step of a run, [steps, 11]: a row is StepNumbers of csrc/math/fit/update.h, in the order

    rates of means, log_scales, quaternions, logits, sh_dc, sh_rest; 1 - beta1^t and 1 - beta2^t with t = row + 1; the
    rate of the noise of positions, which is multiplied by that of the means; and the shares in the loss of the mean
    opacity and of the mean scale.

    Each is one number for all steps, or one a step; not negative. Computed in float64. Raises InputError for numbers
    that are negative or not finite, and rows of another length.
    """
    steps = whole_number("steps", steps, 1, 2**31)
    t = torch.arange(1, steps + 1, dtype=torch.float64)
    corrections = [-torch.expm1(t * torch.tensor(beta, dtype=torch.float64).log()) for beta in _checked_betas(betas)]
    rates = {
        "means_lr": means_lr,
        "scales_lr": scales_lr,
        "quats_lr": quats_lr,
        "opacities_lr": opacities_lr,
        "sh0_lr": sh0_lr,
        "shN_lr": shN_lr,
    }
    others = {"noise_lr": noise_lr, "opacity_reg": opacity_reg, "scale_reg": scale_reg}
    columns = [_column(name, value, steps) for name, value in rates.items()]
    columns += [*corrections, *(_column(name, value, steps) for name, value in others.items())]
    return torch.stack(columns, 1).to(device=device, dtype=dtype).contiguous()


def update(
    fields: RawFields,
    first: RawFields,
    second: RawFields,
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
    """Moves all fields by one step, in place, and writes `scales` [N,3] and `opacities` [N] anew.

    fields, first, second: the fields and their moments; gradients: with respect to what was drawn, at `scales` and
    `opacities` as they are given (see activated). All float32, on the CPU also float64, on one device.
    table [steps, 11]: see update_table, of the same betas. step: a tensor with one int64, the row to use, which the
    caller counts up; it stays on the device, so that a CUDA graph can repeat the call for all steps. skipped: one
    int64, to which the number of Gaussians is added that had a gradient beyond 1e18 or that is no number; of those
    nothing changes. On CUDA a step outside the table skips all Gaussians. seed: 0..2^64-1, of the noise. seen [N]
    uint8: the regularisers are for Gaussians where it is not zero; None: for all.

    On CUDA all work is on torch's current stream. Raises InputError for other shapes, dtypes or devices, for fields
    that are not contiguous, and on the CPU for a step outside the table.
    """
    job = _Job(fields, first, second, gradients, scales, opacities)
    like, device = fields.means, fields.means.device
    rows = table.shape[0] if isinstance(table, Tensor) and table.dim() == 2 else 0
    table = check_tensor("table", table, (rows, _core.STEP_COLUMNS), like.dtype, device)
    for name, counter in (("step", step), ("skipped", skipped)):
        expect(name, counter, Tensor)
        check_tensor(name, counter.reshape(-1), (1,), torch.int64, device)
    if not like.is_cuda and not 0 <= int(step) < rows:
        raise InputError(f"step must be a row of the table, 0..{rows - 1}, got {int(step)}")
    if seen is not None:
        seen = check_tensor("seen", seen, (job.count,), torch.uint8, device)
    beta1, beta2 = _checked_betas(betas)
    native = job.core.Update(
        **job.buffers(),
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
    with device_guard(device):
        if like.is_cuda:
            _core.cuda.update(native, stream_of(device))
        else:
            job.core.update(native, torch.get_num_threads())


class _Job:
    """The checked tensors of N Gaussians."""

    def __init__(
        self,
        fields: RawFields,
        first: RawFields,
        second: RawFields,
        gradients: Gradients,
        scales: Tensor,
        opacities: Tensor,
    ):
        means, sh = fields.means, fields.sh
        expect("means", means, Tensor)
        expect("sh", sh, Tensor)
        if means.dim() != 2 or means.shape[1] != 3:
            raise InputError(f"means must be [N,3], got {list(means.shape)}")
        if sh.dim() != 3 or sh.shape[1] not in (1, 4, 9, 16):
            raise InputError(f"sh must be [N, 1 | 4 | 9 | 16, 3], got {list(sh.shape)}")
        self.core, self.count, harmonics = core_of("means", means), means.shape[0], sh.shape[1]
        self.degree = {1: 0, 4: 1, 9: 2, 16: 3}[harmonics]
        n, like = self.count, (means.dtype, means.device)
        raw = {"means": (n, 3), "log_scales": (n, 3), "quaternions": (n, 4), "logits": (n,), "sh": (n, harmonics, 3)}
        drawn = {"scales": (n, 3), "opacities": (n,)}
        shapes = {**raw, **drawn}
        for what, tensors in (("", fields), ("first moments of ", first), ("second moments of ", second)):
            for name, tensor in zip(RawFields._fields, tensors):
                check_tensor(what + name, tensor, shapes[name], *like, writes=True)
        for name, tensor in (("scales", scales), ("opacities", opacities)):
            check_tensor(name, tensor, shapes[name], *like, writes=True)
        self.raw, self.drawn = (fields, first, second), (scales, opacities)
        self.gradients = [
            check_tensor(f"gradient of {name}", tensor, shapes[name], *like)
            for name, tensor in zip(Gradients._fields, gradients)
        ]

    def buffers(self) -> dict:
        """Their addresses, which hold as long as this job does."""
        fields, first, second = (self.core.Parameters(*(t.data_ptr() for t in tensors)) for tensors in self.raw)
        gradients = self.core.Gaussians(self.count, self.degree, *(g.data_ptr() for g in self.gradients))
        scales, opacities = (t.data_ptr() for t in self.drawn)
        return dict(
            gradients=gradients, parameters=fields, first=first, second=second, scales=scales, opacities=opacities
        )


def _checked_betas(betas: tuple[float, float]) -> tuple[float, float]:
    first, second = betas
    return real_number("beta1", first, 0, 0.9999999), real_number("beta2", second, 0, 0.9999999)


def _column(name: str, value: float | Sequence[float] | Tensor, steps: int) -> Tensor:
    """`value` for each step, float64 on the CPU."""
    column = torch.as_tensor(value, dtype=torch.float64).cpu()
    if column.dim() > 1 or column.dim() == 1 and len(column) != steps:
        raise InputError(f"{name} must be one number or one for each of {steps} steps, got {list(column.shape)}")
    if not bool((column.isfinite() & (column >= 0)).all()):
        raise InputError(f"{name} must be finite and not negative")
    return column.expand(steps)
