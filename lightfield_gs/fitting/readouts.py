"""Poses of photographs by rolling shutters: as captures have them, and as the rasterizer takes them."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from lightfield_gs.fitting.image_optimizers import rotation_matrices


def readout_poses(world_to_camera: Tensor, readouts: Tensor, heights_px: Sequence[int], height_px: int) -> Tensor:
    """Return poses with their motion, [C,6,4], of images drawn with `height_px` rows; see Cameras.poses.

    Args:
        world_to_camera: [C,4,4], the poses at the middle of the readout.
        readouts: [C,2,3], turn and way during the readout; see Capture.
        heights_px: C, of the photographs. The first row of h is read after 1 / (2 h) of the readout, and each row takes
            1 / h.
        height_px: of the images, at least those; rows further down would be read later.
    """
    heights = torch.tensor(list(heights_px)).to(readouts).unsqueeze(-1)
    turn, way = readouts.unbind(1)
    to_first, whole = (1 / heights - 1) / 2, (height_px - 1) / heights
    ahead = rotation_matrices(to_first * turn)
    way = way.unsqueeze(-1)
    # The centre c moves by to_first R^T way, so that R (m - c) becomes R m + t - to_first way before the turn
    top = ahead @ torch.cat([world_to_camera[:, :3, :3], world_to_camera[:, :3, 3:] - to_first.unsqueeze(-1) * way], -1)
    motion = torch.stack([whole * turn, whole * (ahead @ way).squeeze(-1)], 1)
    return torch.cat([top, world_to_camera[:, 3:], torch.nn.functional.pad(motion, (0, 1))], 1)


def last_poses(poses: Tensor) -> Tensor:
    """Return the poses [...,4,4] when the last row is read, of poses with their motion [...,6,4]."""
    first, motion = poses[..., :4, :], poses[..., 4:, :3]
    moved = torch.cat([first[..., :3, :3], first[..., :3, 3:] - motion[..., 1, :, None]], -1)
    return torch.cat([rotation_matrices(motion[..., 0, :]) @ moved, first[..., 3:, :]], -2)


def of_fewer_rows(poses: Tensor, height_px: int, drawn_px: int) -> Tensor:
    """Return poses [...,6,4] of images with height_px rows for images of their first drawn_px rows."""
    if poses.shape[-2] == 4 or drawn_px == height_px:
        return poses
    share = (drawn_px - 1) / max(height_px - 1, 1)
    return torch.cat([poses[..., :4, :], share * poses[..., 4:, :]], -2)
