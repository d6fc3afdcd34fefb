"""Light-field images on the CPU, frame after frame: a stage whose input is what it was is not repeated.

What a frame was made of is copied, and the next frame's input compared with the copy bit by bit: a few per cent of the
time of a frame, and no change is missed, whatever made it.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from lightfield_gs import _core, ops, rendering
from lightfield_gs.arrays import Colour
from lightfield_gs.gaussians import Gaussians
from lightfield_gs.quality import Quality
from lightfield_gs.workspace import Stats, Workspace

STAGES = ("project", "order", "bin", "composite")
_GEOMETRY = {"means", "quaternions", "scales", "opacities"}
_BITS = {torch.float32: torch.int32, torch.float64: torch.int64}


@dataclass
class _Frame:
    """What a frame leaves to the next: copies of its input, splats and bins, their order, and, from the second of
    frames that are the same, a copy of the image."""

    inputs: dict[str, Tensor]
    work: Workspace
    order: tuple[Tensor, Tensor]
    image: Tensor | None


class CpuFrames:
    """Frames of one lens and quality. precision: of the arithmetic; as_bytes: images are uint8; antialiased: see
    rendering.encode."""

    def __init__(self, precision: torch.dtype, as_bytes: bool, quality: Quality, antialiased: bool):
        self.precision, self.as_bytes, self.quality, self.antialiased = precision, as_bytes, quality, antialiased
        self.last: _Frame | None = None

    def draw(
        self, gaussians: Gaussians, background: Colour, arguments: tuple[list[float], list[int], list[float]]
    ) -> tuple[Tensor, set[str]]:
        """The image, which belongs to the caller, and the stages that were not repeated.

        arguments: as rendering.lens_arguments makes them. Raises InputError.
        """
        like = torch.empty(0, dtype=self.precision)
        background = rendering.background_tensor(background, like).reshape(-1)
        last, fields = self.last, gaussians.fields()
        rig, _, shape = arguments
        numbers = {"pose": rig[:16], "rig": [*rig[16:], *shape]}
        inputs = {
            **fields,
            "background": background,
            **{name: torch.tensor(values, dtype=torch.float64) for name, values in numbers.items()},
        }
        before = last.inputs if last else {}
        changed = {name for name, value in inputs.items() if name not in before or not _same(before[name], value)}
        if changed & fields.keys():
            gaussians.validate()
        if last and last.image is not None and not changed:
            return last.image.clone(), set(STAGES)

        self.last = None  # what fails below leaves nothing half done
        job = ops.LensArguments(
            *gaussians.to(dtype=self.precision).fields().values(), background, *arguments, self.antialiased
        )
        work, order, kept = self._prepared(job, last, changed)
        image = job.image(self.as_bytes)
        work.composite_lens(job.lens, self.quality, job.background, image)
        copies = {name: value.detach().clone() if name in changed else before[name] for name, value in inputs.items()}
        self.last = _Frame(copies, work, order, None if changed else image.clone())
        return image, kept

    def _prepared(
        self, job: ops.LensArguments, last: _Frame | None, changed: set[str]
    ) -> tuple[Workspace, tuple[Tensor, Tensor], set[str]]:
        """The stages up to the composite, where what they read has changed; and which were not repeated."""
        if last and changed <= {"background"}:
            return last.work, last.order, {"project", "order", "bin"}
        work = ops.projected_lens(job, Stats(), torch.get_num_threads(), self.quality)
        if last and not changed & {*_GEOMETRY, "pose", "rig"}:
            work.bin_as(last.work)
            return work, last.order, {"order", "bin"}
        in_order = last and not changed & {"means", "pose"} and _has_places(work, *last.order)
        order = last.order if in_order else work.order()
        work.bin(*order)
        return work, order, {"order"} if in_order else set()


def _same(a: Tensor, b: Tensor) -> bool:
    """Bit by bit."""
    return (
        a.shape == b.shape
        and a.dtype == b.dtype
        and torch.equal(a.view(_BITS[a.dtype]), b.detach().view(_BITS[b.dtype]))
    )


def _has_places(work: Workspace, order: Tensor, drawn: Tensor) -> bool:
    """Whether every splat that is drawn has a place in the order. One there that is not drawn any more does no harm: it
    touches no band."""
    places = torch.zeros(work.scene.count, dtype=torch.bool)
    places[order[0, : int(drawn)].long()] = True
    return not bool(((work.splats[0, :, _core.SPLAT_REACH_INDEX] >= 0) & ~places).any())
