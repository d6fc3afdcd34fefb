"""Parameters of each photograph, its camera's pose and its exposure, and their Adam.

A pose P = world_to_camera moves by six numbers in the axes of its own camera, a translation v and a rotation w.
x_camera becomes exp(w) R x_world + exp(w) t + v, so that a camera turns about its own centre. To first order at
v = w = 0, and so for gradients, that is exp of the twist (v, w) times P.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from lightfield_gs.fitting.optimizer import BETAS, EPSILON, bias_corrections
from lightfield_gs.fitting.settings import FitSettings, decay_rate

_POSE_DECAY, _EXPOSURE_DECAY = 0.01, 0.1  # of the learning rates over the fit; the latter as Kerbl et al. have it
_POSE_REG = 1e-6  # half the weight in the loss of the squared motion: a camera without gradients keeps its place


class ImageAdam:
    """Adam for K numbers of each of C photographs, in torch's own operations.

    As in the program of Kerbl et al. 2023 all photographs move at every step: a gradient acts over some ten steps,
    whether or not its photograph is drawn in them. So the motion of one falls only with the root of C; it would fall
    with C if only drawn photographs moved. Void steps and gradients that are not numbers change nothing.
    """

    def __init__(
        self, shape: tuple[int, int], steps: int, rate: float, decay: float, dtype: torch.dtype, device: torch.device
    ):
        """Start with moments of zero; the learning rate falls exponentially from `rate` to decay * rate."""
        self.first, self.second = (torch.zeros(shape, dtype=dtype, device=device) for _ in range(2))
        rates = [decay_rate(rate, decay, step, steps) for step in range(steps)]
        # [steps,3]: rate, 1 - beta1^t, 1 - beta2^t
        self._table = torch.tensor([*zip(rates, *bias_corrections(steps))], dtype=dtype, device=device)

    def sum_by_image(self, chosen: Tensor, values: Tensor) -> Tensor:
        """Return [C,K], sums of values [V,K] over the photographs `chosen` [V], which may repeat."""
        own = chosen[:, None] == torch.arange(len(self.first), device=chosen.device)
        return torch.where(own[..., None], values[:, None].to(self.first.dtype), 0).sum(0)

    def step(self, gradient: Tensor, step: Tensor, kept: Tensor) -> Tensor:
        """Update the moments, and return the change of the numbers.

        Args:
            gradient: [C,K].
            step: [1], counted from 0.
            kept: [1], 1, or 0 where the step is void and nothing moves.

        Returns:
            [C,K].
        """
        gradient = torch.where(gradient.isfinite(), gradient, 0)
        first, second = (
            beta * moment + (1 - beta) * value
            for beta, moment, value in zip(BETAS, (self.first, self.second), (gradient, gradient.square()))
        )
        for moment, new in ((self.first, first), (self.second, second)):
            moment.copy_(torch.where(kept > 0, new, moment))
        rate, first_correction, second_correction = self._table.index_select(0, step)[0].unbind()
        move = -rate * (first / first_correction) / ((second / second_correction).sqrt() + EPSILON)
        return torch.where(kept > 0, move, 0)

    def tensors(self) -> dict[str, Tensor]:
        """Return the moments by name, for a checkpoint."""
        return {"first": self.first, "second": self.second}


# --- Exposure


class ExposureOptimizer:
    """An affine change of colours for each photograph, between the render and the loss (Kerbl et al. 2023).

    Cameras that choose the exposure by themselves show one surface in other colours each time. Changes that all
    photographs share belong to the scene, so the mean of the values is kept at [I|0]. Otherwise the scene could turn
    blue and its photographs yellow. Held-out photographs are compared without exposure.

    Attributes:
        values: [C,3,4], of each photograph [A|b], colours A c + b of the render's colours c; [I|0] at the start.
    """

    def __init__(self, count: int, settings: FitSettings, device: torch.device):
        self.values = torch.eye(3, 4, device=device).repeat(count, 1, 1)
        steps, rate = settings.steps, settings.exposure_lr
        self._adam = ImageAdam((count, 12), steps, rate, _EXPOSURE_DECAY, self.values.dtype, device)

    def apply(self, colours: Tensor, chosen: Tensor) -> Tensor:
        """Return colours [V,...,3] as the photographs `chosen` [V] show them."""
        affine = self._affine(colours, chosen)
        changed = affine[..., 3].expand_as(colours).clone()
        for channel in range(3):
            changed += colours[..., channel, None] * affine[..., channel]
        return changed

    def backward(self, colours: Tensor, gradient: Tensor, chosen: Tensor) -> tuple[Tensor, Tensor]:
        """Return the gradients of the colours [V,H,W,3] and of the values [C,12].

        Args:
            colours: [V,H,W,3], the argument of `apply`.
            gradient: [V,H,W,3], of its result.
            chosen: [V], the photographs.
        """
        affine = self._affine(colours, chosen)
        g_colours = torch.stack([(gradient * affine[..., channel]).sum(-1) for channel in range(3)], -1)
        columns = [(gradient * colours[..., channel, None]).sum((1, 2)) for channel in range(3)]
        g_affine = torch.stack([*columns, gradient.sum((1, 2))], -1)
        return g_colours, self._adam.sum_by_image(chosen, g_affine.flatten(1))

    def update(self, gradient: Tensor, step: Tensor, kept: Tensor) -> None:
        """Move the values by their gradient [C,12], and their mean back; see ImageAdam.step."""
        moved = self.values + self._adam.step(gradient, step, kept).view_as(self.values)
        excess = moved.mean(0) - torch.eye(3, 4, dtype=moved.dtype, device=moved.device)
        self.values.copy_(torch.where(kept > 0, moved - excess, self.values))

    def tensors(self) -> dict[str, Tensor]:
        """Return all tensors by name, for a checkpoint, which also writes to them."""
        return {"values": self.values, **self._adam.tensors()}

    def _affine(self, colours: Tensor, chosen: Tensor) -> Tensor:
        """Return the values of `chosen`, [V,1...,3,4], in the dtype and with the dimensions of colours [V,...,3]."""
        affine = self.values.index_select(0, chosen).to(colours.dtype)
        return affine.view(len(chosen), *[1] * (colours.dim() - 2), 3, 4)


# --- Poses


class PoseOptimizer:
    """Refine the cameras' poses, which structure from motion knows to a pixel or so.

    A small regulariser pulls each camera to its first pose. The mean motion of all cameras is removed, so that held-out
    cameras and the display keep their places in the scene. A common change of scale is not removed. Sums are float64:
    tens of thousands of small rotations have to stay a rotation.

    Attributes:
        world_to_camera: [C,4,4] float32, the present poses in normalised coordinates.
    """

    def __init__(self, world_to_camera: Tensor, steps: int, rate: float, *, keeps_mean: bool = True):
        """Start at the given poses.

        Args:
            world_to_camera: [C,4,4].
            steps: of the fit.
            rate: the learning rate at the start, extents and radians; it falls to a hundredth.
            keeps_mean: remove the mean motion; False if each camera moves alone before a fixed scene.
        """
        self.world_to_camera = world_to_camera.clone()
        self._exact = world_to_camera.to(torch.float64, copy=True)
        shape, device = (len(world_to_camera), 6), world_to_camera.device
        self._twists = torch.zeros(shape, dtype=torch.float64, device=device)
        self._adam = ImageAdam(shape, steps, rate, _POSE_DECAY, torch.float64, device)
        self._keeps_mean = keeps_mean

    def sum_gradients(self, gradients: Tensor, chosen: Tensor) -> Tensor:
        """Return gradients [C,6] float64 by the motions, from gradients [V,4,4] by the poses of `chosen` [V]."""
        poses = self._exact.index_select(0, chosen)
        return self._adam.sum_by_image(chosen, twist_gradients(poses, gradients.double()))

    def update(self, gradient: Tensor, step: Tensor, kept: Tensor) -> None:
        """Move the poses by the gradient [C,6] of their motions; see ImageAdam.step."""
        moves = self._adam.step(gradient.double() + _POSE_REG * self._twists, step, kept)
        if self._keeps_mean:
            moves = remove_common_motion(self._exact, moves)
        self._twists += moves  # to first order the logarithm of the whole motion, which is small
        self._exact.copy_(torch.where(kept > 0, apply_twists(self._exact, moves), self._exact))
        self.world_to_camera.copy_(self._exact)

    def tensors(self) -> dict[str, Tensor]:
        """Return all tensors by name, for a checkpoint, which also writes to them."""
        own = {"world_to_camera": self.world_to_camera, "exact": self._exact, "twists": self._twists}
        return own | self._adam.tensors()


def apply_twists(world_to_camera: Tensor, twists: Tensor) -> Tensor:
    """Return poses [...,4,4] after motions [...,6], (v, w) in scene units and radians."""
    shift, turn = twists.split(3, -1)
    rotation = rotation_matrices(turn)
    top = rotation @ world_to_camera[..., :3, :]
    top = torch.cat([top[..., :3], top[..., 3:] + shift[..., None]], -1)
    return torch.cat([top, world_to_camera[..., 3:, :]], -2)


def rotation_matrices(turns: Tensor) -> Tensor:
    """Return rotations [...,3,3] about the axes w [...,3] by their lengths, radians (Rodrigues)."""
    x, y, z = turns.unbind(-1)
    zero = torch.zeros_like(x)
    cross = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).unflatten(-1, (3, 3))
    angle = turns.square().sum(-1).sqrt()[..., None, None]
    # torch.sinc(x) is sin(pi x) / (pi x), and (1 - cos a) / a^2 is half the square of sinc at a / 2
    sine, versine = torch.sinc(angle / math.pi), torch.sinc(angle / (2 * math.pi)).square() / 2
    return torch.eye(3, dtype=turns.dtype, device=turns.device) + sine * cross + versine * (cross @ cross)


def twist_gradients(world_to_camera: Tensor, gradients: Tensor) -> Tensor:
    """Return gradients [...,6] by the motion at zero, from gradients [...,4,4] by the poses [...,4,4].

    d P = [w]x P[:3] + (0 0 0 v). So the gradient by v is the last column. The gradient by w is the sum of p x g over
    the columns p of P[:3] and g of the gradient.
    """
    columns, found = (matrices[..., :3, :].transpose(-1, -2) for matrices in (world_to_camera, gradients))
    turn = torch.linalg.cross(columns, found, dim=-1).sum(-2)
    return torch.cat([found[..., 3, :], turn], -1)


def remove_common_motion(world_to_camera: Tensor, twists: Tensor) -> Tensor:
    """Return motions [C,6] of poses [C,4,4] less the motion of the world that they have in common.

    The common motion is the mean of the twists in the world's axes about its origin: w' = R^T w, v' = R^T (v + w x t).
    To first order, P moved by (R v' - (R w') x t, R w') draws the scene as if the scene had moved. No photograph can
    tell the difference.
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
