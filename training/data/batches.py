"""Training batches: views cropped to the object, cameras relative to the source, augmentation."""
from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from lightfield_gs.models.crop import MARGIN, Square, crop_resize, object_square
from training.data.cache import CachedSet
from training.data.sampler import Choice, ViewSampler


@dataclass(frozen=True)
class Augmentation:
    """How examples are varied.

    mirror: probability of a left-right flip. colour: probability of a change of colours.
    source_jitter: largest change of the source crop's side and centre, as a share of its side.
    target_zoom: range of the target crops' sides, in units of the square round the object: below 1 the view is
        magnified, which shows gaps between Gaussians, above 1 it shows more background.
    """
    mirror: float = 0.5
    colour: float = 0.5
    source_jitter: float = 0.06
    target_zoom: tuple[float, float] = (0.6, 1.3)


@dataclass
class Batch:
    """B examples of V views each; view 0 is the source view itself.

    source: [B,4,S,S] premultiplied RGBA, 0..1. source_intrinsics: [B,4] (fx, fy, cx, cy) in pixels.
    targets: [B,V,4,S,S]. intrinsics: [B,V,4]. world_to_camera: [B,V,4,4], the world being the source camera's axes.
    backgrounds: [B,V,3], plain colours 0..1.
    """
    source: Tensor
    source_intrinsics: Tensor
    targets: Tensor
    intrinsics: Tensor
    world_to_camera: Tensor
    backgrounds: Tensor


def relative_cameras(camera_to_world: np.ndarray, source: int, views: list[int]) -> np.ndarray:
    """World-to-camera matrices [V,4,4] when the world is the source camera's axes."""
    return np.linalg.inv(camera_to_world[views]) @ camera_to_world[source]


def mirrored(world_to_camera: np.ndarray) -> np.ndarray:
    """The cameras [...,4,4] after a left-right flip of every image and of the world."""
    flip = np.diag([-1.0, 1.0, 1.0, 1.0])
    return flip @ world_to_camera @ flip


def _vary_colours(view: Tensor, permutation: list[int], gain: Tensor, gamma: float) -> Tensor:
    """Permute the colour channels and bend them by gain * colour^gamma; view: [4,S,S] premultiplied."""
    alpha = view[3:]
    colour = (view[:3] / alpha.clamp_min(1e-3)).clamp(0, 1)[permutation]
    return torch.cat([(gain[:, None, None] * colour.pow(gamma)).clamp(0, 1) * alpha, alpha])


class BatchMaker:
    """Turns (step, number of objects, image size) into a Batch; depends on these and the sampler's seed alone."""

    def __init__(self, sets: list[CachedSet], sampler: ViewSampler, augmentation: Augmentation) -> None:
        self.sampler, self.augmentation = sampler, augmentation
        self.objects = [(source, index) for source in sets for index in range(len(source.objects))]

    def make(self, step: int, start: int, count: int, size_px: int) -> Batch:
        """The batch of a step. start: examples before it, count: examples in it, size_px: side of all its images."""
        rng = self.sampler.rng(step, 1)
        examples = [self._example(choice, size_px, rng) for choice in self.sampler.draw(step, start, count)]
        return Batch(*(torch.stack(parts) for parts in zip(*examples)))

    def _example(self, choice: Choice, size_px: int, rng: np.random.Generator) -> tuple[Tensor, ...]:
        """The six tensors of one example."""
        cached, index = self.objects[choice.object_index]
        views = [choice.source, *choice.targets]
        intrinsics = cached.objects[index].intrinsics[[choice.source, *views]]
        cameras = relative_cameras(cached.objects[index].camera_to_world, choice.source, views)
        frames = [torch.from_numpy(cached.view(index, view)).permute(2, 0, 1) for view in views]
        if rng.random() < self.augmentation.mirror:
            frames, cameras = [frame.flip(-1) for frame in frames], mirrored(cameras)
            intrinsics[:, 2] = frames[0].shape[2] - intrinsics[:, 2]
        squares = [self._source_square(frames[0], rng)] + [self._target_square(frame, rng) for frame in frames]
        images = torch.stack([crop_resize(frame, square, size_px)
                              for frame, square in zip([frames[0], *frames], squares)]).div_(255).clamp_(0, 1)
        if rng.random() < self.augmentation.colour:
            permutation = rng.permutation(3).tolist()
            gain, gamma = torch.from_numpy(rng.uniform(0.7, 1.1, 3)).float(), float(np.exp(rng.uniform(-0.3, 0.3)))
            images = torch.stack([_vary_colours(image, permutation, gain, gamma) for image in images])
        intrinsics = torch.tensor([square.intrinsics((fx, fy), (cx, cy), size_px)
                                   for square, (fx, fy, cx, cy) in zip(squares, intrinsics.tolist())])
        white = rng.random((len(views), 1)) < 0.5
        backgrounds = torch.from_numpy(np.where(white, 1.0, rng.random((len(views), 3)))).float()
        return images[0], intrinsics[0], images[1:], intrinsics[1:], torch.from_numpy(cameras).float(), backgrounds

    def _source_square(self, frame: Tensor, rng: np.random.Generator) -> Square:
        """The square that a photo would be cropped to, moved and resized a little."""
        square = object_square(frame[3] / 255, MARGIN)
        side, left, top = rng.uniform(-1, 1, 3) * self.augmentation.source_jitter * square.side
        return _moved(square, square.side + side, left, top)

    def _target_square(self, frame: Tensor, rng: np.random.Generator) -> Square:
        """A larger square about the object, or a smaller one somewhere inside its square."""
        square = object_square(frame[3] / 255, MARGIN)
        side = rng.uniform(*self.augmentation.target_zoom) * square.side
        room = abs(side - square.side) / 2
        left, top = rng.uniform(-room, room, 2)
        return _moved(square, side, left, top)


def _moved(square: Square, side: float, right: float, down: float) -> Square:
    """A square of another side whose centre lies right and down of the given one's."""
    whole = max(2, round(side))
    inset = (square.side - whole) / 2
    return Square(round(square.left + inset + right), round(square.top + inset + down), whole)
