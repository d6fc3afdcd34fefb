"""Cases of the stages of fitting, on which a device is compared with the CPU.

The device is a GPU, or the CUDA stages compiled for the CPU.
"""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

from lightfield_gs.fitting.optimizer import Gradients, RawParameters, activate, update, update_table
from lightfield_gs.fitting.photo_loss import photo_loss_and_gradient
from lightfield_gs.fitting.random import dropout, normals, uniforms

# Images, height, width, lambda of SSIM, photos of bytes, weights; more and less than a strip of the kernels
LOSSES = [
    (1, 1, 1, 0.2, False, False),
    (2, 45, 67, 0.2, True, True),
    (1, 33, 32, 1.0, False, False),
    (1, 70, 5, 0.2, False, True),
]
# Harmonics, Gaussians, what is special
UPDATES = [(1, 64, ""), (4, 3, "seen"), (9, 131, ""), (9, 70, "unaligned"), (16, 130, "no numbers")]
RATES = dict(means_lr=2e-3, scales_lr=5e-3, quats_lr=1e-3, opacities_lr=0.05, sh0_lr=2.5e-3, shN_lr=1.25e-4)


def loss_case(
    views: int,
    height: int,
    width: int,
    ssim_lambda: float,
    photo_bytes: bool,
    weighted: bool,
    dtype: torch.dtype,
    device: str,
) -> dict[str, Tensor]:
    random = torch.Generator().manual_seed(height)
    photo = torch.randint(0, 256, (views, height, width, 3), generator=random, dtype=torch.uint8)
    image = photo / 255 + 0.2 * torch.randn(photo.shape, generator=random)
    weights = torch.rand(photo.shape[:3], generator=random)
    weights[:, : height // 3] = 0
    given = photo if photo_bytes else photo.to(dtype) / 255
    shown = weights.to(device) if weighted else None
    loss, gradient = photo_loss_and_gradient(image.to(device, dtype), given.to(device), shown, ssim_lambda)
    return {"loss": loss.cpu(), "gradient": gradient.cpu()}


def _unaligned(tensor: Tensor) -> Tensor:
    """A contiguous copy that begins four bytes after a place that vectors may have."""
    return torch.cat([tensor.new_zeros(1), tensor.flatten()])[1:].view(tensor.shape)


def update_case(harmonics: int, count: int, special: str, dtype: torch.dtype, device: str) -> dict[str, Any]:
    """Three steps: fields, moments, what is drawn, and how many were skipped."""
    random = torch.Generator().manual_seed(count)

    def draw(*shape: int) -> Tensor:
        drawn = torch.randn(shape, generator=random).to(device, dtype)
        return _unaligned(drawn) if special == "unaligned" else drawn

    fields = RawParameters(
        draw(count, 3), draw(count, 3) - 2, draw(count, 4), draw(count) - 4, draw(count, harmonics, 3)
    )
    first, second = fields.zeros_like(), fields.zeros_like()
    scales, opacities = activate(fields)
    weights = dict(noise_lr=300.0, opacity_reg=0.5, scale_reg=0.5)
    table = update_table(3, **RATES, **weights, dtype=dtype, device=device)
    step, skipped = (torch.zeros((), dtype=torch.int64, device=device) for _ in range(2))
    seen = (torch.arange(count) % 2).to(device, torch.uint8) if special == "seen" else None
    for _ in range(3):
        gradients = Gradients(
            *(draw(*t.shape) for t in (fields.means, fields.quaternions, scales, opacities, fields.sh))
        )
        if special == "no numbers":
            gradients.sh[5, -1, 2], gradients.means[66, 1], gradients.opacities[129] = math.nan, math.inf, 1e30
        update(
            fields, first, second, gradients, scales, opacities,
            table=table, step=step, skipped=skipped, seed=2**40 + 3, seen=seen,
        )  # fmt: skip
        step += 1
    drawn = {"scales": scales, "opacities": opacities, "skipped": skipped}
    moments = {
        f"{name} {what}": t for what, m in (("first", first), ("second", second)) for name, t in m._asdict().items()
    }
    return {name: tensor.cpu() for name, tensor in {**fields._asdict(), **moments, **drawn}.items()}


def numbers(dtype: torch.dtype, device: str) -> dict[str, Tensor]:
    stream = dict(seed=2**40 + 3, step=7, purpose=2, device=device)
    return {
        "uniforms": uniforms(**stream, count=1501).cpu(),
        "normals": normals(**stream, count=2051, dtype=dtype).cpu(),
        "dropout": dropout(
            torch.tensor([0.5, 0.2], device=device), torch.tensor(1, device=device), 2**40 + 3, 1030
        ).cpu(),
    }


def fitted(dtype: torch.dtype, device: str = "cpu") -> dict[str, list[dict[str, Any]]]:
    return {
        "losses": [loss_case(*case, dtype, device) for case in LOSSES],
        "updates": [update_case(*case, dtype, device) for case in UPDATES],
        "numbers": [numbers(dtype, device)],
    }


def compare(found: dict[str, list[dict[str, Any]]]) -> None:
    """Asserts that what a device gave in float32 is what the CPU gives in float64, as far as float32 can."""
    expected = fitted(torch.float64)
    for what, cases in expected.items():
        for k, (case, of_device) in enumerate(zip(cases, found[what], strict=True)):
            for name, right in case.items():
                error, size = (of_device[name].double() - right.double()).abs().max(), right.double().abs().max()
                assert error <= 3e-6 * size + 1e-12, (what, k, name, float(error), float(size))
    assert torch.equal(found["numbers"][0]["uniforms"], expected["numbers"][0]["uniforms"])
    assert found["updates"][-1]["skipped"] == 9
