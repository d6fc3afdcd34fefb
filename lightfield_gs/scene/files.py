"""Files of Gaussians: the scene, and what else such a file says."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from lightfield_gs.io.scenes.stored import read_stored
from lightfield_gs.scene.gaussians import Gaussians, of_arrays


@dataclass
class SceneFile:
    """What a file of Gaussians holds.

    gaussians: float32 on the CPU, N >= 1, SH degree 0-3.
    comments: text of the header's comment and obj_info lines, in file order.
    elements: every element of at most 64 KiB beside the vertices, without lists, by name: structured arrays.
    notes: what looks wrong, one line each, without the file's name.
    kind: the format of the file and its version, in words.
    """

    gaussians: Gaussians
    comments: tuple[str, ...] = ()
    elements: dict[str, np.ndarray] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    kind: str = ""


def read_scene(path: str | Path, *, skip_invalid: bool = False, time: float | None = None) -> SceneFile:
    """Reads a file of Gaussians: a 3DGS .ply, a compressed .ply (SuperSplat), .spz (versions 1 to 4), .sog (versions 1
    and 2; a ZIP, a folder or its meta.json), .splat or .ksplat, told by its content, then by its name.

    All come in the axes of a .ply: those of an .spz (right, up, back) are turned to right, down, forward.
    A .ply: text or binary of either byte order, properties in any order and number type; properties that no Gaussian
    has are ignored. Coordinates that are stored as double, far from zero, are given from an origin of whole numbers
    near them, which the Gaussians remember. skip_invalid: leave out Gaussians with values that have no meaning (a note
    counts them): not finite, a rotation of zeros, a scale that overflows. Infinite logits and a log scale of -inf have
    one.
    Args:
        time: at which Gaussians that move are read (those of Spacetime Gaussians), in the units of their file, mostly
            0..1 of its film; None: at the median of the times at which they are most opaque, which a note says.
    Raises InputError when the file is of no such format, is cut, has wrong counts, lacks a property (it is named) or,
    without skip_invalid, holds a value that has no meaning (property, index and count are named).
    """
    stored = read_stored(path, skip_invalid=skip_invalid, time=time)
    gaussians = of_arrays(stored.fields, stored.origin)
    return SceneFile(gaussians, stored.comments, stored.elements, stored.notes, stored.kind)
