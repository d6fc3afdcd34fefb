"""Times and counts of a render."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from lightfield_gs import _core

if TYPE_CHECKING:
    from lightfield_gs.scene.gaussians import Gaussians


@dataclass
class Stats:
    """Record of a render: milliseconds per stage, counts, bytes of work memory.

    Attributes:
        device: Device of the work. At both ends of a stage the host waits for a CUDA device: else the work of one stage
            would be timed in another. None: nothing waits, and times of a device's stages mean nothing.
    """

    device: torch.device | None = None
    stages_ms: dict[str, float] = field(default_factory=dict)
    intersections: int = 0
    evaluations: int = 0
    work_bytes: int = 0
    memory_bytes: dict[str, int] = field(default_factory=dict)  # of method sorted, see encode_sorted
    memory_bytes_unchunked: dict[str, int] = field(default_factory=dict)
    images: int = 0
    gaussians_drawn: int = 0  # in all images
    pruned: int = 0  # of a light field, see Quality
    colour_error: float = 0.0
    kernel: str | None = None  # that drew a light field on CUDA or by WebGPU
    skipped: dict[str, Any] = field(default_factory=dict)  # of a light field, see skipped_lines

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Add the time inside the block to the stage of this name."""
        self._wait()
        start = time.perf_counter()
        yield
        self._wait()
        self.stages_ms[name] = self.stages_ms.get(name, 0.0) + 1e3 * (time.perf_counter() - start)

    def _wait(self) -> None:
        if self.device is not None and self.device.type == "cuda":
            torch.cuda.synchronize(self.device)

    def add_render(self, other: Stats) -> None:
        """Add a render to the sum of a sequence: work adds up, memory is reused."""
        for name, ms in other.stages_ms.items():
            self.stages_ms[name] = self.stages_ms.get(name, 0.0) + ms
        self.intersections += other.intersections
        self.evaluations += other.evaluations
        self.images += other.images
        self.gaussians_drawn += other.gaussians_drawn
        self.work_bytes = max(self.work_bytes, other.work_bytes)

    def add_buffers(self, *buffers: Tensor) -> None:
        """Add the sizes of buffers to the work memory."""
        self.work_bytes += sum(t.numel() * t.element_size() for t in buffers)

    def count_frame(self, state: dict[str, Any], work: Tensor) -> None:
        """Add a light-field frame on CUDA by its state and its work buffer."""
        self.intersections += state["intersections"]
        self.images += 1
        self.gaussians_drawn += state["drawn"]
        self.colour_error, self.kernel, self.pruned = state["colour_error"], state["kernel"], state["pruned"]
        self.skipped = frame_counts(state)
        self.add_buffers(work)

    def count(self, counters: _core.Counters) -> None:
        """Add the core's counts of a composite."""
        self.intersections += counters.intersections
        self.evaluations += counters.evaluations
        self.work_bytes += counters.scratch_bytes

    def report(self, gaussians: int, subpixels: int) -> dict[str, Any]:
        """Return the stats of `encode`; evaluations are not counted on a GPU.

        Args:
            gaussians: Number of Gaussians in the scene.
            subpixels: Number of sub-pixels of the panel.
        """
        on_gpu = self.kernel is not None or self.device is not None and self.device.type == "cuda"
        found: dict[str, Any] = {
            "stages_ms": dict(self.stages_ms),
            "pairs": self.intersections,
            "evaluations": None if on_gpu else self.evaluations,
            "evaluations_per_subpixel": None if on_gpu else self.evaluations / subpixels,
            "work_bytes": self.work_bytes,
            "gaussians_culled": gaussians - self.gaussians_drawn // max(self.images, 1),
            "colour_error": self.colour_error,
        }
        if self.kernel is not None:
            found["kernel"] = self.kernel
        if self.memory_bytes:
            found |= {"memory_bytes": self.memory_bytes, "memory_bytes_unchunked": self.memory_bytes_unchunked}
        return found


def count_culled(gaussians: Gaussians, world_to_camera: np.ndarray, drawn: int, pruned: int) -> dict[str, int]:
    """Count the Gaussians that are not drawn, by the first reason that holds.

    behind: nearer than the near plane. faint: opacity below 1/255. pruned: by Quality.contribution_cut. outside: no
    camera of the rig sees it on the panel, its quaternion is zero, or its alpha is nowhere above the opacity cut.
    """
    pose = torch.as_tensor(world_to_camera, dtype=torch.float64, device=gaussians.means.device)
    behind = gaussians.means.double() @ pose[2, :3] + pose[2, 3] < _core.NEAR_DEPTH
    faint = ~behind & (gaussians.opacities.double() * 255 < 1)
    counts = {"behind": int(behind.sum()), "faint": int(faint.sum()), "pruned": pruned}
    return {**counts, "outside": len(behind) - drawn - sum(counts.values())}


def direct_counts(counters: _core.Counters, orders: Tensor, splats: Tensor, most: int) -> dict[str, Any]:
    """Return counts of tiles, lattices and samples of a composite, and of splats by the orders of their colours.

    Args:
        counters: the core's.
        orders: [1, N], orders of the polynomials of colours, 0..most, or -1 where no polynomial is good enough.
        splats: [1, N, SPLAT_FIELDS].
        most: the highest order.
    """
    drawn = orders[splats[..., _core.SPLAT_REACH_INDEX] >= 0]  # Gaussians that are not drawn have a negative reach
    return {
        "colour_orders": torch.bincount(drawn[drawn >= 0], minlength=most + 1).tolist(),
        "colours_exact": int((drawn < 0).sum()),
        "tiles": {"empty": counters.empty_tiles, "lattice": counters.lattice_tiles, "drawn": counters.tiles},
        "lattices": {"fit": counters.lattices, "split": counters.split_lattices, "refused": counters.refused_lattices},
        "samples_stopped": counters.stopped_samples,
    }


def frame_counts(state: dict[str, Any]) -> dict[str, Any]:
    """Return counts of a frame's tiles on CUDA: drawn from a lattice, drawn by the kernel, and lattices tried.

    Tiles of hardly any Gaussian count as drawn by the kernel. {}: a frame without lattices counts none.
    """
    lattice, drawn = state["lattice_tiles"], state["refused_tiles"]
    if not lattice + drawn:
        return {}
    return {"tiles": {"lattice": lattice, "drawn": drawn}, "lattices": {"tried": state["tried_tiles"]}}


def skipped_lines(skipped: dict[str, Any], gaussians: int) -> list[str]:
    """Return lines of text for stats["skipped"] of `encode`, or for the stats of an Encoder."""
    out = []
    if reasons := skipped.get("gaussians"):
        out.append(f"of {gaussians} Gaussians not drawn: " + ", ".join(f"{n} {why}" for why, n in reasons.items()))
    if orders := skipped.get("colour_orders"):
        out.append(
            "colours by polynomial order over the views: "
            + ", ".join(f"{order}: {n}" for order, n in enumerate(orders) if n)
            + (f", near the cameras exact: {exact}" if (exact := skipped["colours_exact"]) else "")
        )
    if tiles := skipped.get("tiles"):
        how = {"empty": "empty", "lattice": "from lattices", "drawn": "drawn"}
        out.append("tiles: " + ", ".join(f"{count} {how[kind]}" for kind, count in tiles.items()))
    if lattices := skipped.get("lattices"):
        how = {"fit": "good enough", "split": "split", "refused": "refused", "tried": "tried"}
        out.append("lattices: " + ", ".join(f"{count} {how[kind]}" for kind, count in lattices.items()))
    if "samples_stopped" in skipped:
        out.append(f"sub-pixels that ended early: {skipped['samples_stopped']}")
    if reused := skipped.get("reused"):
        out.append(
            f"of {skipped['frames']} frames drawn without a stage anew: "
            + ", ".join(f"{stage} {n}" for stage, n in reused.items())
        )
    return out
