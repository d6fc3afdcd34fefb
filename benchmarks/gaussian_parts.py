"""Time a training step of a scene all round, of which each process holds a part: forward, backward and update.

`python -m benchmarks.gaussian_parts` is one process with dense and with sparse gradients; `torchrun --nproc-per-node N
-m benchmarks.gaussian_parts` is N processes, which draw N images a step of the same scene. A camera sees a fifth of it.
`--gsplat` measures gsplat by the same calls.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable
from datetime import timedelta
from typing import Any, Literal, cast

import torch
import torch.distributed as dist
from torch import Tensor

from benchmarks import peers
from lightfield_gs import gsplat
from lightfield_gs.base.torchrun import join_processes
from lightfield_gs.bench.dense import camera, frustum
from lightfield_gs.bench.report import aligned
from lightfield_gs.bench.timing import ms_in_a_row
from lightfield_gs.scene.rotation import rotated_quaternions

SECTORS = 5  # of the circle; each is as wide as a camera's image, and a little more
WAIT = timedelta(minutes=5)
NAMES = ("means", "quats", "scales", "opacities", "colors")
RATE = 1e-6


def turn(sector: int) -> Tensor:
    """Return the rotation [3, 3] about y from the first sector to another."""
    angle = 2 * math.pi * sector / SECTORS
    cosine, sine = math.cos(angle), math.sin(angle)
    return torch.tensor([[cosine, 0, sine], [0, 1, 0], [-sine, 0, cosine]])


def part(count: int, size_px: tuple[int, int], rank: int) -> dict[str, Tensor]:
    """Return `count` Gaussians of all sectors, under gsplat's names."""
    scene = frustum(count, *size_px, seed=rank)
    means, quaternions, *others = scene.fields().values()
    for sector in range(SECTORS):
        rows = slice(sector, None, SECTORS)
        means[rows] = means[rows] @ turn(sector).T
        quaternions[rows] = rotated_quaternions(turn(sector), quaternions[rows])
    return dict(zip(NAMES, (means, quaternions, *others)))


def step_of(
    module: Any, fields: dict[str, Tensor], sector: int, size_px: tuple[int, int], options: dict[str, Any]
) -> Callable[[], dict[str, Any]]:
    """Return a training step of a camera that looks at a sector; it returns meta."""
    device = fields["means"].device
    leaves = {name: field.clone().requires_grad_() for name, field in fields.items()}
    optimizers = [
        module.SelectiveAdam([{"params": [leaf], "lr": RATE}], 1e-15, (0.9, 0.999)) for leaf in leaves.values()
    ]
    pose = torch.eye(4)
    pose[:3, :3] = turn(sector).T
    matrices = peers.intrinsic_matrices(camera(*size_px, str(device)))
    size = {"width": size_px[0], "height": size_px[1], "sh_degree": 3, "packed": True}

    def step() -> dict[str, Any]:
        image, _, meta = module.rasterization(**leaves, viewmats=pose[None].to(device), Ks=matrices, **size, **options)
        image.square().mean().backward()
        seen = torch.zeros(len(leaves["means"]), dtype=torch.bool, device=device)
        seen[meta["gaussian_ids"]] = True
        for leaf, optimizer in zip(leaves.values(), optimizers):
            gradient = cast(Tensor, leaf.grad)
            if gradient.is_sparse and module is gsplat:
                optimizer.step()
            else:
                leaf.grad = gradient.to_dense()
                optimizer.step(seen)
            leaf.grad = None
        return meta

    return step


def rows(
    count: int, size_px: tuple[int, int], kind: Literal["cpu", "cuda"], runs: int, module: Any = gsplat
) -> list[tuple[str, int, float, float]]:
    """Return for each way its name, the images a step, the ms of a step and the peak MB; of the slowest process."""
    found = []
    with join_processes(kind, WAIT) as (rank, size, device):
        fields = {name: field.to(device) for name, field in part(count // size, size_px, rank).items()}
        ways = {"parts": {"distributed": True}, "parts, sparse": {"distributed": True, "sparse_grad": True}}
        if size == 1:
            ways = {"dense": {}, "sparse": {"sparse_grad": True}}
        for way, options in ways.items():
            step, cuda = step_of(module, fields, rank % SECTORS, size_px, options), kind == "cuda"
            ms_in_a_row(step, cuda, 3)
            if cuda:
                torch.cuda.reset_peak_memory_stats()
            result = [ms_in_a_row(step, cuda, runs), torch.cuda.max_memory_allocated() / 1e6 if cuda else math.nan]
            worst = torch.tensor(result, device=device)
            if size > 1:
                dist.all_reduce(worst, dist.ReduceOp.MAX)
            if rank == 0:
                found.append((way, size, *worst.tolist()))
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--gaussians", type=int, default=3_000_000, help="of all processes together")
    parser.add_argument("--size", type=int, nargs=2, default=(1600, 1066), help="of images, pixels")
    parser.add_argument("--device", choices=("cpu", "cuda"), default="cuda")
    parser.add_argument("--runs", type=int, default=30)
    parser.add_argument("--gsplat", action="store_true", help="measure gsplat, which must be installed")
    given = parser.parse_args()
    module = peers.gsplat() if given.gsplat else gsplat
    found = rows(given.gaussians, tuple(given.size), given.device, given.runs, module)
    lines = [
        (way, str(images), f"{ms:.2f}", f"{1e3 * images / ms:.1f}", "-" if math.isnan(peak) else f"{peak:.0f}")
        for way, images, ms, peak in found
    ]
    if lines:
        print(*aligned([("way", "images a step", "ms", "images a second", "peak MB"), *lines]), sep="\n")


if __name__ == "__main__":
    main()
