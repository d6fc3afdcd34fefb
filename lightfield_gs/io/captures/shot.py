"""What every layout of posed photographs says of each: the common ground of their readers."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lightfield_gs.io.captures.camera_models import Lens


@dataclass(frozen=True)
class Shot:
    """A photograph and its camera, as a layout has them; nothing is decoded yet.

    name: relative to the folder of images, with / between folders. world_to_camera: [4,4] float64, OpenCV axes.
    intrinsics: [4] float64, (fx, fy, cx, cy) in pixels of a picture of camera_px (width, height), from the outer
    corner of the first; the file at `path` may be another size. lens: None for a pinhole. mask: where the layout names
    one.
    """

    name: str
    path: Path
    world_to_camera: np.ndarray
    intrinsics: np.ndarray
    camera_px: tuple[int, int]
    lens: Lens | None = None
    mask: Path | None = None


@dataclass(frozen=True)
class Shots:
    """A capture as its layout has it. source: the file or folder that says so, for messages. images: the folder that
    names are relative to. points: [P,3] float64; colours: [P,3] uint8. held_out: names of the photographs that it keeps
    for tests itself; held_by: what says so."""

    source: Path
    images: Path
    shots: list[Shot]
    points: np.ndarray
    colours: np.ndarray
    held_out: tuple[str, ...] = ()
    held_by: str = ""
