"""What a light-field image did not have to draw, counted."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from lightfield_gs import _core

if TYPE_CHECKING:
    from lightfield_gs.scene.gaussians import Gaussians


def culled(gaussians: Gaussians, world_to_camera: np.ndarray, drawn: int, pruned: int) -> dict[str, int]:
    """Gaussians that are not drawn, by the first reason that holds: behind (or nearer than the near plane), faint
    (opacity below 1/255), outside the panel from every camera of the rig (or of no shape: a quaternion of zeros; or
    nowhere above a raised opacity cut, or for anti-aliasing above 1/255), pruned (Quality.contribution_cut)."""
    pose = torch.as_tensor(world_to_camera, dtype=torch.float64, device=gaussians.means.device)
    behind = gaussians.means.double() @ pose[2, :3] + pose[2, 3] < _core.NEAR_DEPTH
    faint = ~behind & (gaussians.opacities.double() * 255 < 1)
    counts = {"behind": int(behind.sum()), "faint": int(faint.sum()), "pruned": pruned}
    return {**counts, "outside": gaussians.count - drawn - sum(counts.values())}


def of_lens(counters: _core.Counters, orders: Tensor, splats: Tensor, most: int) -> dict[str, Any]:
    """Tiles, lattices and samples of a composite; splats [1, N, ...] by the polynomial orders [1, N] of their colours,
    0..most, or -1 where no polynomial is good enough."""
    drawn = orders[splats[..., _core.SPLAT_REACH_INDEX] >= 0]  # what is not drawn has a negative reach
    return {
        "colour_orders": torch.bincount(drawn[drawn >= 0], minlength=most + 1).tolist(),
        "colours_exact": int((drawn < 0).sum()),
        "tiles": {"empty": counters.empty_tiles, "lattice": counters.lattice_tiles, "drawn": counters.tiles},
        "lattices": {"fit": counters.lattices, "split": counters.split_lattices, "refused": counters.refused_lattices},
        "samples_stopped": counters.stopped_samples,
    }


def of_frame(state: dict[str, Any]) -> dict[str, Any]:
    """Tiles of a frame on CUDA that were drawn from a lattice and by the frame's kernel, those of hardly any Gaussian
    among the latter, and how many lattices were tried; {} for a frame without lattices, which counts none."""
    lattice, drawn = state["lattice_tiles"], state["refused_tiles"]
    if not lattice + drawn:
        return {}
    return {"tiles": {"lattice": lattice, "drawn": drawn}, "lattices": {"tried": state["tried_tiles"]}}


def lines(skipped: dict[str, Any], gaussians: int) -> list[str]:
    """What `encode` puts in stats["skipped"], and an Encoder in its stats, a line each."""
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
