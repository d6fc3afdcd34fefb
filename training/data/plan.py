"""The plan of a training batch, in numbers: its views, their crops, cameras and variations.

A plan is made on the host and takes kilobytes; the images follow from it on the device (training/data/batches.py).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from lightfield_gs.base.checks import real_number
from lightfield_gs.base.errors import InputError
from lightfield_gs.models.crop import Square
from training.data.photographs import PhotoPlan, draw_faults
from training.data.procedural import ProceduralBlock, ProceduralExamples, steps_of_block
from training.data.procedural_plan import NUMBERS, draw_objects, rotation
from training.data.resident import ResidentViews
from training.data.sampler import Choice, ViewSampler
from training.data.textures import Photographs
from training.meshes.scenes import Framing, MeshPlan, MeshScenes
from training.ranges import check_ranges


@dataclass(frozen=True)
class Augmentation:
    """How examples are varied.

    The last three are faults that photos and automatic cut-outs have. Each leaves half of the input pictures as they
    are.

    Args:
        mirror: probability of a left-right flip, 0..1.
        colour: probability of a change of colours, 0..1.
        source_jitter: largest change of the source crop's side and centre, as a fraction of its side, 0..0.5.
        target_zoom: range of the target crops' sides, in units of the square round the object. Below 1 the view is
            magnified, which shows gaps between Gaussians. Above 1 it shows more background.
        pose_error_deg: largest turn of the target cameras of stored views about each of their axes, degrees.
        blur_px: largest standard deviation of a blur, pixels of the input picture.
        noise: largest standard deviation of noise, of 1.
        outline_px: largest shift and softness of the outline, pixels of the input picture.
    """

    mirror: float = 0.5
    colour: float = 0.5
    source_jitter: float = 0.06
    target_zoom: tuple[float, float] = (0.6, 1.3)
    pose_error_deg: float = 0.0
    blur_px: float = 0.0
    noise: float = 0.0
    outline_px: float = 0.0

    def __post_init__(self) -> None:
        check_ranges(
            self,
            "augmentation.",
            mirror=(0.0, 1.0),
            colour=(0.0, 1.0),
            source_jitter=(0.0, 0.5),
            pose_error_deg=(0.0, 180.0),
            blur_px=(0.0, 100.0),
            noise=(0.0, 1.0),
            outline_px=(0.0, 100.0),
        )
        check_zoom(self.target_zoom, "augmentation.")


def check_zoom(zoom: tuple[float, float], where: str) -> None:
    """Raise InputError unless `target_zoom` is a range of positive sides; where: text before the field's name."""
    low, high = (real_number(f"{where}target_zoom", side, 0.01, 100.0) for side in zoom)
    if not low <= high:
        raise InputError(f"{where}target_zoom: expected the smaller number first, got {low:g}, {high:g}")


@dataclass(frozen=True)
class BatchPlan:
    """B examples of I = 1 + V images: the input picture, then V target views, the first of which is the source too.

    Tensors are float32 by default. All views of a run fit windows of one size, so all steps of a stage have the same
    shapes.

    Attributes:
        rectangles: int64 [B,I,5], as ResidentViews takes them. window_px: height and width of all windows. origins:
        [B,I,2], x and y of a window's first pixel in its frame. directions: [B], -1 where columns run to the left
        (mirrored frames), else 1. crops: [B,I,3], left, top and side of the squares cut out of the frames. recoloured,
        permutations, gains, gammas: bool [B], int64 [B,3], [B,3] and [B]: see training/data/batches.py. intrinsics:
        [B,I,4], (fx, fy, cx, cy) in pixels of the images. world_to_camera: [B,V,4,4]; the world is the source camera's
        axes. backgrounds: [B,V,3]. source_px, target_px: sides of the input pictures and of the targets. taps: the most
        pixels of a frame along an axis that one pixel of an image is made of, in any step of these sizes. procedural:
        the examples after these, if any. meshes: the examples after those, if any. photo: the faults of all input
        pictures, if any.
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

    procedural: ProceduralExamples | None
    meshes: MeshPlan | None
    photo: PhotoPlan | None


class Sizes(NamedTuple):
    """How large the pictures of a step are.

    Attributes:
        source_px: Side of the input pictures as they are made.
        target_px: Side of the targets.
        zoom: Range of the target crops' sides, see Augmentation.
        finer: How many times larger the input pictures are than what the network sees. Faults are as many times larger.
    """

    source_px: int
    target_px: int
    zoom: tuple[float, float]
    finer: int


def relative_cameras(camera_to_world: np.ndarray, source_to_world: np.ndarray) -> np.ndarray:
    """World-to-camera matrices [...,4,4] when the world is the source camera's axes."""
    return np.linalg.inv(camera_to_world) @ source_to_world


def mirrored(world_to_camera: np.ndarray) -> np.ndarray:
    """The cameras [...,4,4] after a left-right flip of every image and of the world."""
    flip = np.diag([-1.0, 1.0, 1.0, 1.0])
    return flip @ world_to_camera @ flip


def made_up(count: int, fraction: float) -> np.ndarray:
    """Which of a step's examples show procedural objects, bool [count]: `fraction` of them, evenly spread."""
    return np.diff(np.floor(np.arange(count + 1) * fraction + 1e-9)) > 0


class BatchPlanner:
    """Turns (step, number of objects, image size) into a BatchPlan; depends on these and the sampler's seed alone.

    Args:
        views: Stored views, whose first objects are the sampler's.
        partners: For each of these objects the number of the object whose views are its targets; None: its own.
        procedural: Fraction of the examples, 0..1, that show procedural objects in place of the sampler's.
        photographs: Skins of the procedural objects.
        meshes: Scenes of the examples that show meshes; None: no example does.
    """

    def __init__(
        self,
        views: ResidentViews,
        sampler: ViewSampler,
        augmentation: Augmentation,
        partners: np.ndarray | None = None,
        procedural: float = 0.0,
        photographs: Photographs | None = None,
        meshes: MeshScenes | None = None,
    ) -> None:
        self.views, self.sampler, self.augmentation, self.procedural = views, sampler, augmentation, procedural
        self._meshes = meshes
        self._photographs = photographs
        self._first_target = views.first_view if partners is None else views.first_view[partners]
        self._window_px = tuple(int(views.rectangles[:, side].max(initial=1)) for side in (4, 3))
        self._block = lru_cache(maxsize=1)(self._new_block)
        self._largest = views.squares[:, 2].max(initial=1)

    def plan(
        self,
        step: int,
        start: int,
        count: int,
        source_px: int,
        target_px: int = 0,
        part: slice = slice(None),
        finer: int = 1,
        zoom: tuple[float, float] | None = None,
    ) -> BatchPlan:
        """Return the plan of a step.

        Args:
            start: Number of examples before the step.
            count: Number of examples in the step.
            source_px, target_px: Side of the pictures that the network sees, and of the targets (0: the same).
            part: The examples to plan; example i of the step is the same in every part.
            finer: The input pictures are made so many times larger.
            zoom: Range of the target crops' sides; None: that of the augmentation.
        """
        sizes = Sizes(finer * source_px, target_px or source_px, zoom or self.augmentation.target_zoom, finer)
        made = made_up(count, self.procedural)
        meshes = made_up(count, self._meshes.options.fraction if self._meshes else 0)
        kinds = (made & ~meshes, meshes, ~made & ~meshes)
        new, rendered, old = (np.arange(count)[part][chosen[part]] for chosen in kinds)
        drawn = self._draw(step, count, old)
        return self._plan_views(
            self.sampler.draw(step, start, count, old),
            drawn,
            sizes,
            procedural=self._made(step, count, new, sizes),
            meshes=self._rendered(step, count, rendered, sizes),
            photo=self._faults(step, count, np.concatenate([old, new, rendered]), finer),
        )

    def _rendered(self, step: int, count: int, wanted: np.ndarray, sizes: Sizes) -> MeshPlan | None:
        """The examples `wanted` of a step's `count`, rendered from meshes."""
        if self._meshes is None or not len(wanted):
            return None
        drawn = self._draw(step, count, wanted)
        mirror = drawn["mirror"][:, 0] < self.augmentation.mirror
        framing = Framing(*self._framing(drawn, sizes), self._backgrounds(drawn), mirror, self.augmentation.colour)
        return self._meshes.plan(self.sampler.rng(step, 5), wanted, count, sizes[:2], framing)

    def _made(self, step: int, count: int, wanted: np.ndarray, sizes: Sizes) -> ProceduralExamples | None:
        """The examples `wanted` of a step's `count`, of the block that they are drawn with."""
        if not len(wanted):
            return None
        steps = steps_of_block(len(wanted))
        first = step % steps * len(wanted)
        return ProceduralExamples(
            self._block(step - step % steps, steps, count, tuple(wanted), sizes), slice(first, first + len(wanted))
        )

    def _new_block(self, first: int, steps: int, count: int, wanted: tuple[int, ...], sizes: Sizes) -> ProceduralBlock:
        """The examples `wanted` of each of some steps, whichever of them is asked for."""
        made, wanted, numbers = made_up(count, self.procedural), np.array(wanted), range(first, first + steps)
        rows = np.searchsorted(np.flatnonzero(made), wanted)
        seeds = np.concatenate([self.sampler.rng(step, 3).random((made.sum(), NUMBERS))[rows] for step in numbers])
        steps_drawn = [self._draw(step, count, wanted) for step in numbers]
        drawn = {name: np.concatenate([one[name] for one in steps_drawn]) for name in steps_drawn[0]}
        framing, backgrounds = self._framing(drawn, sizes), self._backgrounds(drawn)
        return ProceduralBlock(
            draw_objects(seeds, self.sampler.cone_deg, sizes[:2], framing, backgrounds, self._photographs)
        )

    def _plan_views(
        self, choices: list[Choice], drawn: dict[str, np.ndarray], sizes: Sizes, **others: Any
    ) -> BatchPlan:
        """The plan of the examples with stored views; there may be none. others: the plan's remaining fields."""
        indices = np.array([choice.object_index for choice in choices], int)
        seen = np.array([choice.targets for choice in choices], int).reshape(-1, self.sampler.targets)
        sources = self.views.first_view[indices] + np.array([choice.source for choice in choices], int)
        targets = self._first_target[indices][:, None] + seen
        rows, images = (np.concatenate([sources[:, None]] * times + [targets], 1) for times in (1, 2))
        mirror, width = drawn["mirror"] < self.augmentation.mirror, self.views.widths_px[images]
        left, top, side = np.moveaxis(self.views.squares[images].astype(np.float64), -1, 0)
        crops = _framed(Square(np.where(mirror, width - left - side, left), top, side), *self._framing(drawn, sizes))
        fx, fy, cx, cy = np.moveaxis(self.views.intrinsics[images], -1, 0)
        sides = np.array([sizes.source_px] + [sizes.target_px] * (images.shape[1] - 1))
        intrinsics = crops.intrinsics((fx, fy), (np.where(mirror, width - cx, cx), cy), sides)
        poses = self.views.camera_to_world[rows]
        cameras = self._turned(relative_cameras(poses, poses[:, :1]), drawn["turn"])
        rectangles = self.views.rectangles[images]
        left = np.where(mirror, width - 1 - rectangles[..., 1], rectangles[..., 1])
        return BatchPlan(
            rectangles=torch.from_numpy(rectangles),
            origins=_floats(np.stack([left, rectangles[..., 2]], -1)),
            directions=_floats(np.where(mirror, -1, 1)[:, 0]),
            crops=_floats(np.stack([crops.left, crops.top, crops.side], -1)),
            **self._colours(drawn),
            intrinsics=_floats(np.stack(intrinsics, -1)),
            world_to_camera=_floats(np.where(mirror[..., None, None], mirrored(cameras), cameras)),
            backgrounds=_floats(self._backgrounds(drawn)),
            window_px=self._window_px,
            source_px=sizes.source_px,
            target_px=sizes.target_px,
            taps=self._taps(sizes),
            **others,
        )

    def _taps(self, sizes: Sizes) -> int:
        """Of a BatchPlan: a filter's two sides are as wide as a pixel of the image that shrinks most."""
        zooms = (1 + self.augmentation.source_jitter, max(sizes.zoom))
        shrunk = [max(2, np.rint(self._largest * zoom)) / size for zoom, size in zip(zooms, sizes)]
        return 2 * math.ceil(max(1, *shrunk)) + 2

    def _draw(self, step: int, count: int, wanted: np.ndarray) -> dict[str, np.ndarray]:
        """Uniform numbers in [0, 1) for each purpose, [B,...], of the examples `wanted` of a step's `count`."""
        views = 1 + self.sampler.targets
        widths = {
            "mirror": 1,
            "jitter": 3,
            "zoom": views,
            "place": 2 * views,
            "white": views,
            "background": 3 * views,
            "recolour": 1,
            "permutation": 3,
            "gain": 3,
            "gamma": 1,
            "turn": 3 * self.sampler.targets,
        }
        rows = self.sampler.rng(step, 1).random((count, sum(widths.values())))[wanted]
        return dict(zip(widths, np.split(rows, np.cumsum(list(widths.values()))[:-1], axis=1)))

    def _turned(self, cameras: np.ndarray, drawn: np.ndarray) -> np.ndarray:
        """Cameras [B,V,4,4] with errors of all but the first, which shows the source view; drawn: [B,3(V-1)]."""
        drawn = drawn.reshape(*cameras[:, 1:].shape[:2], 3)
        angles = np.radians(self.augmentation.pose_error_deg) * (2 * drawn - 1)
        turns = rotation(0, angles[..., 0]) @ rotation(1, angles[..., 1]) @ rotation(2, angles[..., 2])
        cameras[:, 1:, :3] = turns @ cameras[:, 1:, :3]
        return cameras

    def _faults(self, step: int, count: int, order: np.ndarray, finer: int) -> PhotoPlan | None:
        """Return the faults of the examples `order` of a step, in that order; finer: see Sizes."""
        limits = (self.augmentation.blur_px, self.augmentation.noise, self.augmentation.outline_px)
        if not any(limits):
            return None
        blur_px, noise, outline_px = limits
        faults = draw_faults(self.sampler.rng(step, 4), count, finer * blur_px, noise, finer * outline_px)
        return PhotoPlan(*(values[order] for values in vars(faults).values()))

    def _framing(self, drawn: dict[str, np.ndarray], sizes: Sizes) -> tuple[np.ndarray, np.ndarray]:
        """Return sides [B,I] of the crops of all images, and shifts [B,I,2] of their centres right and down.

        Both are in units of the square round the object. The input is cropped as a photo would be, moved and resized a
        little. Targets are cropped to a larger square about the object, or to a smaller one somewhere inside its
        square.
        """
        jitter = (2 * drawn["jitter"] - 1) * self.augmentation.source_jitter
        low, high = sizes.zoom
        sides = low + (high - low) * drawn["zoom"]
        room = (2 * drawn["place"].reshape(*sides.shape, 2) - 1) * (np.abs(sides - 1) / 2)[..., None]
        return (np.concatenate([1 + jitter[:, :1], sides], 1), np.concatenate([jitter[:, None, 1:], room], 1))

    def _backgrounds(self, drawn: dict[str, np.ndarray]) -> np.ndarray:
        """[B,V,3], half of them white."""
        colours = drawn["background"].reshape(*drawn["white"].shape, 3)
        return np.where(drawn["white"][..., None] < 0.5, 1.0, colours)

    def _colours(self, drawn: dict[str, np.ndarray]) -> dict[str, Tensor]:
        """recoloured, permutations, gains and gammas of a BatchPlan."""
        return {
            "recoloured": torch.from_numpy(drawn["recolour"][:, 0] < self.augmentation.colour),
            "permutations": torch.from_numpy(np.argsort(drawn["permutation"], axis=1)),
            "gains": _floats(0.7 + 0.4 * drawn["gain"]),
            "gammas": _floats(np.exp(0.6 * drawn["gamma"][:, 0] - 0.3)),
        }


def _floats(values: np.ndarray) -> Tensor:
    return torch.from_numpy(np.ascontiguousarray(values, np.float32))


def _framed(square: Square, sides: np.ndarray, shifts: np.ndarray) -> Square:
    """Squares [B,I] on whole pixels of other sides [B,I] and centres [B,I,2], in units of the given ones' sides."""
    whole = np.maximum(2, np.rint(sides * square.side))
    right, down = np.moveaxis(shifts * square.side[..., None], -1, 0)
    inset = (square.side - whole) / 2
    return Square(np.rint(square.left + inset + right), np.rint(square.top + inset + down), whole)
