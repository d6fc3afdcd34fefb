"""Examples for the scores: holes as find_hidden finds them in the first surface alone, and what is true in them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from lightfield_gs.photo.depth_edges import snap_mixed
from lightfield_gs.photo.hidden import find_hidden
from lightfield_gs.photo.image_filters import max_filter
from lightfield_gs.photo.inpainting import solve_membrane
from training.hidden.compositions import Composition
from training.hidden.faults import draw_softness, estimated, photographed, soften

_BETWEEN = 16  # rows without depths between pictures that are searched as one: more than any window of the search
_FRINGE_PX = 3
_SAME_SURFACE = 0.25  # difference of log disparity up to which the second surface is the one that the search means


class Example(NamedTuple):
    """B examples; S: side.

    Attributes:
        image: [B,3,S,S], the photograph, 0..1.
        depth: [B,S,S], its depths, sharp at their edges.
        focal_px: Of all.
        hole, fringe: bool [B,S,S], as find_hidden finds them.
        guess: [B,3,S,S], its first colours, smooth in the hole.
        guess_disparity: [B,S,S], its disparity.
        truth: [B,3,S,S], colours of the hidden surface in the hole, the photograph's elsewhere.
        log_disparity: [B,S,S], of the hidden surface in the hole.
        known: bool [B,S,S], the pixels of the hole whose truth is the surface that the hole is meant for.
    """

    image: Tensor
    depth: Tensor
    focal_px: float
    hole: Tensor
    fringe: Tensor
    guess: Tensor
    guess_disparity: Tensor
    truth: Tensor
    log_disparity: Tensor
    known: Tensor

    def part(self, chosen: slice) -> Example:
        """Return some of the examples."""
        return Example(*(value[chosen] if isinstance(value, Tensor) else value for value in self))


@torch.no_grad()
def make_examples(composition: Composition, rng: np.random.Generator) -> Example:
    """Return examples of compositions, with the faults of photographs and of estimated depths."""
    count, focal = len(composition.first), (composition.focal_px,) * 2
    softness = draw_softness(rng, count).to(composition.first)
    image = photographed(soften(composition.first, softness), rng)
    # One search for all: the pictures below each other
    stacked = snap_mixed(_below_each_other(estimated(composition.first_depth, rng), torch.nan), focal)
    found = find_hidden(_below_each_other(image.movedim(1, -1), 0.5), stacked, focal)
    membrane = solve_membrane(found.image, found.hole, found.linked)
    cover = max_filter((1 / stacked).nan_to_num(0), _FRINGE_PX)
    middle = (cover.clamp_min(1e-12).log() + found.disparity.nan_to_num(1).log()) / 2
    depth, hole, fringe, disparity, guess, middle = (
        _apart(part, count) for part in (stacked, found.hole, found.fringe, found.disparity, membrane, middle)
    )
    is_first = -composition.first_depth.log() < middle
    z = torch.where(is_first, composition.first_depth, composition.second_depth)
    truth = torch.where(is_first[:, None], composition.first, composition.second)
    truth = torch.where(hole[:, None], soften(truth, softness), image)
    log_disparity = -z.log()
    known = hole & ((log_disparity - disparity.log()).abs() < _SAME_SURFACE)
    log_disparity = torch.where(known, log_disparity, disparity.log())
    guess = guess.movedim(-1, 1)
    return Example(image, depth, composition.focal_px, hole, fringe, guess, disparity, truth, log_disparity, known)


def _below_each_other(maps: Tensor, between: float) -> Tensor:
    """Return maps [B,S,S] or [B,S,S,C] as one of B (S + _BETWEEN) rows."""
    padding = (0, 0) * (maps.ndim - 2) + (0, _BETWEEN)
    return F.pad(maps, padding, value=between).flatten(0, 1)


def _apart(maps: Tensor, count: int) -> Tensor:
    """Return the maps again."""
    return maps.unflatten(0, (count, -1))[:, :-_BETWEEN]
