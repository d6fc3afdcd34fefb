"""What a training batch is to show, in numbers: which views, cropped where, seen by which cameras, varied how.

A plan is made on the host and takes kilobytes; the images follow from it on the device (training/data/batches.py).
"""
from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from lightfield_gs.models.crop import Square
from training.data.resident import ResidentViews
from training.data.sampler import ViewSampler


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


@dataclass(frozen=True)
class BatchPlan:
    """B examples of I = 1 + V images: the input picture, then the V target views, the first of which is the source too.

    rectangles: int64 [B,I,5], as ResidentViews takes them; all fit windows of window_px (height, width).
    origins: [B,I,2], x and y of a window's first pixel in its frame; directions: [B], -1 where columns run to the left
    (mirrored frames), else 1. crops: [B,I,3], left, top and side of the squares cut out of the frames.
    recoloured: bool [B]; permutations: int64 [B,3]; gains: [B,3]; gammas: [B]: see training/data/batches.py.
    intrinsics: [B,I,4], (fx, fy, cx, cy) in pixels of the images. world_to_camera: [B,V,4,4], the world being the
    source camera's axes. backgrounds: [B,V,3]. source_px, target_px: side of the input pictures and of the targets.
    taps: pixels of a frame that one pixel of an image is made of along an axis, at most. Tensors are float32 unless
    said.
    """
    rectangles: Tensor
    origins: Tensor
    directions: Tensor
    crops: Tensor
    recoloured: Tensor
    permutations: Tensor
    gains: Tensor
    gammas: Tensor
    intrinsics: Tensor
    world_to_camera: Tensor
    backgrounds: Tensor
    window_px: tuple[int, int]
    source_px: int
    target_px: int
    taps: int

    def to(self, device: torch.device) -> "BatchPlan":
        """The plan on a device; the host does not wait for the copies."""
        if device.type == "cpu":
            return self
        moved = {field.name: value.pin_memory().to(device, non_blocking=True) for field in dataclasses.fields(self)
                 if isinstance(value := getattr(self, field.name), Tensor)}
        return dataclasses.replace(self, **moved)


def relative_cameras(camera_to_world: np.ndarray, source_to_world: np.ndarray) -> np.ndarray:
    """World-to-camera matrices [...,4,4] when the world is the source camera's axes."""
    return np.linalg.inv(camera_to_world) @ source_to_world


def mirrored(world_to_camera: np.ndarray) -> np.ndarray:
    """The cameras [...,4,4] after a left-right flip of every image and of the world."""
    flip = np.diag([-1.0, 1.0, 1.0, 1.0])
    return flip @ world_to_camera @ flip


class BatchPlanner:
    """Turns (step, number of objects, image size) into a BatchPlan; depends on these and the sampler's seed alone.

    views: whose first objects are the sampler's. partners: for each of those the number of the object whose views its
    targets are; None: its own.
    """

    def __init__(self, views: ResidentViews, sampler: ViewSampler, augmentation: Augmentation,
                 partners: np.ndarray | None = None) -> None:
        self.views, self.sampler, self.augmentation = views, sampler, augmentation
        self._first_target = views.first_view if partners is None else views.first_view[partners]

    def plan(self, step: int, start: int, count: int, source_px: int, target_px: int = 0,
             share: slice = slice(None)) -> BatchPlan:
        """The plan of a step. start: examples before it, count: examples in it.

        source_px, target_px: side of the input pictures and of the targets (0: the same).
        share: the examples that are wanted; whatever it is, example i of the step is the same.
        """
        target_px = target_px or source_px
        choices = self.sampler.draw(step, start, count)[share]
        drawn = self._draw(step, count, share)
        objects = np.array([choice.object_index for choice in choices])
        sources = self.views.first_view[objects] + [choice.source for choice in choices]
        targets = self._first_target[objects][:, None] + np.array([choice.targets for choice in choices])
        rows, images = (np.concatenate([sources[:, None]] * times + [targets], 1) for times in (1, 2))
        mirror, width = drawn["mirror"] < self.augmentation.mirror, self.views.widths_px[images]
        left, top, side = np.moveaxis(self.views.squares[rows].astype(np.float64), -1, 0)
        crops = self._crops(Square(np.where(mirror, width[:, 1:] - left - side, left), top, side), drawn)
        fx, fy, cx, cy = np.moveaxis(self.views.intrinsics[images], -1, 0)
        sizes = np.array([source_px] + [target_px] * (images.shape[1] - 1))
        intrinsics = crops.intrinsics((fx, fy), (np.where(mirror, width - cx, cx), cy), sizes)
        poses = self.views.camera_to_world[rows]
        cameras = relative_cameras(poses, poses[:, :1])
        rectangles = self.views.rectangles[images]
        left = np.where(mirror, width - 1 - rectangles[..., 1], rectangles[..., 1])
        white = drawn["white"][..., None] < 0.5
        background = drawn["background"].reshape(*white.shape[:2], 3)
        return BatchPlan(
            rectangles=torch.from_numpy(rectangles), origins=_floats(np.stack([left, rectangles[..., 2]], -1)),
            directions=_floats(np.where(mirror, -1, 1)[:, 0]),
            crops=_floats(np.stack([crops.left, crops.top, crops.side], -1)), **self._colours(drawn),
            intrinsics=_floats(np.stack(intrinsics, -1)),
            world_to_camera=_floats(np.where(mirror[..., None, None], mirrored(cameras), cameras)),
            backgrounds=_floats(np.where(white, 1.0, background)),
            window_px=(int(rectangles[..., 4].max()), int(rectangles[..., 3].max())),
            source_px=source_px, target_px=target_px,
            taps=2 * math.ceil(max(1.0, (crops.side / sizes).max())) + 2)

    def _draw(self, step: int, count: int, share: slice) -> dict[str, np.ndarray]:
        """Uniform numbers in [0, 1) for each purpose, [B, ...]: a row per example of the step, then those wanted."""
        views = 1 + self.sampler.targets
        widths = {"mirror": 1, "jitter": 3, "zoom": views, "place": 2 * views, "white": views, "background": 3 * views,
                  "recolour": 1, "permutation": 3, "gain": 3, "gamma": 1}
        rows = self.sampler.rng(step, 1).random((count, sum(widths.values())))[share]
        return dict(zip(widths, np.split(rows, np.cumsum(list(widths.values()))[:-1], axis=1)))

    def _crops(self, squares: Square, drawn: dict[str, np.ndarray]) -> Square:
        """The squares [B,1+V] of all images, from those round the object in each view [B,V].

        The input is cropped as a photo would be, moved and resized a little; targets to a larger square about the
        object, or to a smaller one somewhere inside its square.
        """
        side, first = squares.side, slice(0, 1)
        grow, right, down = (2 * drawn["jitter"].T - 1) * self.augmentation.source_jitter * side[:, 0]
        low, high = self.augmentation.target_zoom
        sides = (low + (high - low) * drawn["zoom"]) * side
        room = (2 * drawn["place"].reshape(*side.shape, 2) - 1) * (np.abs(sides - side) / 2)[..., None]
        pairs = ((grow[:, None] + side[:, first], sides), (right[:, None], room[..., 0]), (down[:, None], room[..., 1]))
        around = (np.concatenate([field[:, first], field], 1) for field in (squares.left, squares.top, side))
        return _moved(Square(*around), *(np.concatenate(pair, 1) for pair in pairs))

    def _colours(self, drawn: dict[str, np.ndarray]) -> dict[str, Tensor]:
        """recoloured, permutations, gains and gammas of a BatchPlan."""
        return {"recoloured": torch.from_numpy(drawn["recolour"][:, 0] < self.augmentation.colour),
                "permutations": torch.from_numpy(np.argsort(drawn["permutation"], axis=1)),
                "gains": _floats(0.7 + 0.4 * drawn["gain"]),
                "gammas": _floats(np.exp(0.6 * drawn["gamma"][:, 0] - 0.3))}


def _floats(values: np.ndarray) -> Tensor:
    return torch.from_numpy(np.ascontiguousarray(values, np.float32))


def _moved(square: Square, side: np.ndarray, right: np.ndarray, down: np.ndarray) -> Square:
    """Squares of other sides whose centres lie right and down of the given ones', on whole pixels."""
    whole = np.maximum(2, np.rint(side))
    inset = (square.side - whole) / 2
    return Square(np.rint(square.left + inset + right), np.rint(square.top + inset + down), whole)
