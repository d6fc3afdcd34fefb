"""Refinement of the cameras' poses, which structure from motion knows to a pixel or so, along with the scene.

A pose P = world_to_camera moves by six numbers in the axes of its own camera, a translation v and a rotation w:
x_camera becomes exp(w) R x_world + exp(w) t + v, so that a camera turns about its own centre. At v = w = 0 that is
exp of the twist (v, w) times P to first order, which is all that a gradient knows.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from lightfield_gs.fitting.photograph_adam import PhotographAdam

_DECAY = 0.01  # of the rate over the fit
_PULL = 1e-6  # half the weight in the loss of the squared motion: a camera that sees nothing stays where it was


def moved(world_to_camera: Tensor, twists: Tensor) -> Tensor:
    """Poses [...,4,4] after motions [...,6], (v, w) in units of the scene and radians."""
    shift, turn = twists.split(3, -1)
    rotation = rotations_about(turn)
    top = rotation @ world_to_camera[..., :3, :]
    top = torch.cat([top[..., :3], top[..., 3:] + shift[..., None]], -1)
    return torch.cat([top, world_to_camera[..., 3:, :]], -2)


def rotations_about(turns: Tensor) -> Tensor:
    """Rotation matrices [...,3,3] about the axes w [...,3] by their lengths, radians (Rodrigues)."""
    x, y, z = turns.unbind(-1)
    zero = torch.zeros_like(x)
    cross = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).unflatten(-1, (3, 3))
    angle = turns.square().sum(-1).sqrt()[..., None, None]
    # torch.sinc(x) is sin(pi x) / (pi x), and (1 - cos a) / a^2 half the square of that of a / 2
    sine, versine = torch.sinc(angle / math.pi), torch.sinc(angle / (2 * math.pi)).square() / 2
    return torch.eye(3, dtype=turns.dtype, device=turns.device) + sine * cross + versine * (cross @ cross)


def twist_gradients(world_to_camera: Tensor, gradients: Tensor) -> Tensor:
    """Gradients [...,6] with respect to the motion, at none, of those [...,4,4] with respect to poses [...,4,4].

    d P = [w]x P[:3] + (0 0 0 v): so that of v is the gradient's last column, and that of w the sum over the columns p
    of P[:3], with g of the gradient, of p x g.
    """
    columns, found = (matrices[..., :3, :].transpose(-1, -2) for matrices in (world_to_camera, gradients))
    turn = torch.linalg.cross(columns, found, dim=-1).sum(-2)
    return torch.cat([found[..., 3, :], turn], -1)


def without_common(world_to_camera: Tensor, twists: Tensor) -> Tensor:
    """Motions [C,6] of poses [C,4,4] less the motion of the world that they have in common.

    That one is the mean of the twists in the world's axes about its origin: w' = R^T w, v' = R^T (v + w x t). To first
    order P moved by (R v' - (R w') x t, R w') draws the world as if it had moved instead, which no photograph can tell.
    """
    rotation, place = world_to_camera[:, :3, :3], world_to_camera[:, :3, 3]
    shift, turn = twists.split(3, -1)

    def to_world(vectors: Tensor) -> Tensor:
        return torch.einsum("crk,cr->ck", rotation, vectors)

    mean_shift = to_world(shift + torch.linalg.cross(turn, place, dim=-1)).mean(0)
    mean_turn = to_world(turn).mean(0)
    common_turn = rotation @ mean_turn
    common_shift = rotation @ mean_shift - torch.linalg.cross(common_turn, place, dim=-1)
    return twists - torch.cat([common_shift, common_turn], -1)


class Poses:
    """world_to_camera [C,4,4] float32, as they are now, in coordinates of the fit.

    Adam moves all of them at every step (see PhotographAdam), a little towards where they began too. Their mean motion
    is removed, so that held-out cameras, and those of the display, keep their places in the scene; its scale is not
    held. Sums are float64: tens of thousands of small rotations have to stay a rotation.
    """

    def __init__(self, world_to_camera: Tensor, steps: int, rate: float, *, keeps_mean: bool = True):
        """rate: of Adam at the start, extents and radians a step; it falls to a hundredth. keeps_mean: False where
        each camera is by itself, before a scene that stands still."""
        self.world_to_camera = world_to_camera.clone()
        self._exact = world_to_camera.to(torch.float64, copy=True)
        self._twists = torch.zeros(len(world_to_camera), 6, dtype=torch.float64, device=world_to_camera.device)
        shape = (len(world_to_camera), 6)
        self._adam = PhotographAdam(shape, steps, rate, _DECAY, torch.float64, world_to_camera.device)
        self._keeps_mean = keeps_mean

    def gathered(self, gradients: Tensor, chosen: Tensor) -> Tensor:
        """The gradient of the motions [C,6] float64, of those of the poses [V,4,4] of the photographs `chosen` [V]."""
        poses = self._exact.index_select(0, chosen)
        return self._adam.gathered(chosen, twist_gradients(poses, gradients.double()))

    def update(self, gradient: Tensor, step: Tensor, kept: Tensor) -> None:
        """Moves the poses by the gradient [C,6] of their motions; step, kept: see PhotographAdam.moves."""
        moves = self._adam.moves(gradient.double() + _PULL * self._twists, step, kept)
        if self._keeps_mean:
            moves = without_common(self._exact, moves)
        self._twists += moves  # to first order the logarithm of the whole motion, which is small
        self._exact.copy_(torch.where(kept > 0, moved(self._exact, moves), self._exact))
        self.world_to_camera.copy_(self._exact)

    def tensors(self) -> dict[str, Tensor]:
        """All of it by name, for a checkpoint, which writes to them as well."""
        own = {"world_to_camera": self.world_to_camera, "exact": self._exact, "twists": self._twists}
        return own | self._adam.tensors()
