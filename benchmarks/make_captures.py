"""Render captures with known faults: `python -m benchmarks.make_captures FOLDER`.

For each seed there are two captures with COLMAP's text model: over an arc as wide as a panel's cone, and all round.
They show superellipsoids in a room, which need no data; or objects of mesh packs in it; or a scene of Gaussians. Their
photographs have noise, exposures and white balances of their own. Their poses are a little off, and their points are
few, at edges, and a little off, as structure from motion finds them.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from PIL import Image

from benchmarks.capture_stages import GaussianStage, Room, Stage
from lightfield_gs.base.checks import whole_number
from lightfield_gs.base.options import DEFAULT_PANEL
from lightfield_gs.fitting.image_optimizers import apply_twists
from lightfield_gs.io.atomic import atomic_folder, check_new_folder, make_folder
from lightfield_gs.panels.panel import Panel
from training.command import with_line_errors
from training.data.procedural_plan import DISTANCE, orbit
from training.data.text_model import joined_numbers, write_text_model

_FOCAL = 0.85  # of the width: 61 degrees
_RINGS_DEG = (0.0, 22.0)  # elevations all round, by turns, over that of the camera in the middle
_JITTER_DEG, _JITTER = 1.5, 0.03  # of directions, and of distances as their fraction: a hand's
_EXPOSURE, _BALANCE = 0.08, 0.02  # standard deviations of the logarithm of the gain, and of each channel's
_NOISE, _SHOT = 1.5 / 255, 0.02  # standard deviations of noise: everywhere, and by the root of the brightness
_TURN_DEG, _MOVE = 0.03, 0.001  # of poses, and of centres as a fraction of the distance
_POINTS, _OFF = 4000, 0.002  # of the model, and how far off, as a fraction of the depth
_GAMMA = 2.2
QUALITY = 95  # of JPEG
WAYS = ("arc", "round")


@dataclass(frozen=True)
class Shape:
    """Photographs of a capture: their number and their size."""

    photographs: int
    size_px: tuple[int, int]


def directions(way: str, count: int, cone_deg: float, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Return azimuths and elevations [count] in degrees from the camera in the middle.

    Args:
        way: "arc", evenly over the cone, or "round", evenly all round.
        count: of the photographs.
        cone_deg: full angle of the cone.
        rng: of the hand's jitter.
    """
    if way == "arc":
        azimuths, elevations = np.linspace(-cone_deg / 2, cone_deg / 2, count), np.zeros(count)
    else:
        azimuths, elevations = 360 * np.arange(count) / count, np.resize(_RINGS_DEG, count)
    return azimuths + _JITTER_DEG * rng.normal(size=count), elevations + _JITTER_DEG * rng.normal(size=count)


def write_capture(folder: Path, stage: Stage, way: str, shape: Shape, seed: int) -> None:
    """Write a capture of a stage; the folder is complete or absent.

    Args:
        folder: of the capture.
        stage: what it shows.
        way: see directions.
        shape: of its photographs.
        seed: of all its faults.

    Raises:
        InputError: the folder exists and is not empty, or cannot be written.
    """
    rng = np.random.default_rng([seed, len(way)])
    width, height = shape.size_px
    focal = _FOCAL * width
    photographs: list[tuple[str, np.ndarray, int]] = []
    points: list[np.ndarray] = []
    colours: list[np.ndarray] = []
    with atomic_folder(folder) as temporary:
        images, model = (make_folder(temporary / name) for name in ("images", "sparse/0"))
        for number, pose in enumerate(_poses(stage, way, shape.photographs, rng)):
            image, depth = stage.photograph(pose, focal, shape.size_px)
            photo = _photographed(image, rng)
            name = f"{number:03d}.jpg"
            Image.fromarray(photo).save(images / name, quality=QUALITY)
            seen, colour = _edge_points(photo, depth, pose, focal, -(-_POINTS // shape.photographs), rng)
            points, colours = [*points, seen], [*colours, colour]
            photographs.append((name, _misplaced(pose, stage.distance, rng), 1))
        camera = f"1 PINHOLE {width} {height} {joined_numbers((focal, focal, width / 2, height / 2), 10)}"
        write_text_model(model, [camera], photographs, np.concatenate(points), np.concatenate(colours))


def _poses(stage: Stage, way: str, count: int, rng: np.random.Generator) -> np.ndarray:
    """Return world_to_camera [count,4,4]."""
    cone_deg = Panel.load(DEFAULT_PANEL).cone_deg
    azimuths, elevations = np.radians(directions(way, count, cone_deg, rng))
    turned = orbit(azimuths, elevations, np.radians(stage.tilt_deg), np.zeros(count))
    turned[:, :3, 3] *= stage.distance / DISTANCE
    turned[:, 2, 3] += stage.distance * _JITTER * rng.normal(size=count)
    return turned @ stage.centre


def _photographed(image: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return the image [H,W,3] in 0..1 as a camera records it: uint8, with its exposure, white balance and noise."""
    gain = np.exp(rng.normal(0, _EXPOSURE) + rng.normal(0, _BALANCE, 3))
    exposed = (gain * image**_GAMMA).clip(0, 1) ** (1 / _GAMMA)
    noise = np.hypot(_NOISE, _SHOT * np.sqrt(exposed)) * rng.normal(size=exposed.shape)
    return np.rint(255 * (exposed + noise).clip(0, 1)).astype(np.uint8)


def _edge_points(
    photo: np.ndarray, depth: np.ndarray, pose: np.ndarray, focal: float, count: int, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Return points [P,3] of the scene and colours [P,3], where a photograph changes and a surface is."""
    grey = photo.mean(-1)
    change = np.hypot(*np.gradient(grey)) * (depth > 0)
    if not change.any():
        return np.zeros((0, 3)), np.zeros((0, 3), np.uint8)
    count = min(count, int((change > 0).sum()))
    y, x = np.unravel_index(
        rng.choice(change.size, count, replace=False, p=change.ravel() / change.sum()), change.shape
    )
    z = depth[y, x]
    height, width = depth.shape
    places = np.stack([(x + 0.5 - width / 2) / focal * z, (y + 0.5 - height / 2) / focal * z, z], 1)
    places += _OFF * z[:, None] * rng.normal(size=places.shape)
    return (places - pose[:3, 3]) @ pose[:3, :3], photo[y, x]


def _misplaced(pose: np.ndarray, distance: float, rng: np.random.Generator) -> np.ndarray:
    """Return the pose [4,4] as structure from motion would find it."""
    twist = np.concatenate([_MOVE * distance * rng.normal(size=3), np.radians(_TURN_DEG) * rng.normal(size=3)])
    return apply_twists(torch.from_numpy(pose)[None], torch.from_numpy(twist)[None])[0].numpy()


def _stage(scene: Path | None, meshes: Path | None) -> tuple[str, Callable[[int], Stage]]:
    """Return the name of the captures, and the stage of a seed. Raises InputError."""
    if scene is not None:
        stage = GaussianStage.read(scene)
        return scene.stem, lambda seed: stage
    return ("solids" if meshes is None else "meshes"), lambda seed: Room(seed, meshes)


@with_line_errors("benchmarks.make_captures")
def main(arguments: list[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.make_captures",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("folder", type=Path, help="folder for the captures: solids-arc-1, solids-round-1, ...")
    shown = parser.add_mutually_exclusive_group()
    shown.add_argument("--scene", type=Path, help="show the Gaussians in this file")
    shown.add_argument("--meshes", type=Path, metavar="FOLDER", help="show objects of these mesh packs in the room")
    parser.add_argument("--captures", type=int, default=2, help="how many of each kind, seeds 1, 2, ... (default: 2)")
    parser.add_argument("--photographs", type=int, default=32, help="of each capture (default: 32)")
    parser.add_argument(
        "--width", type=int, default=640, help="of a photograph, pixels; the height is 3/4 (default: 640)"
    )
    given = parser.parse_args(arguments)
    width = whole_number("--width", given.width, 32, 4096)
    shape = Shape(whole_number("--photographs", given.photographs, 3, 1000), (width, 3 * width // 4))
    name, stage_of = _stage(given.scene, given.meshes)
    seeds = range(1, whole_number("--captures", given.captures, 1, 1000) + 1)
    folders = {(way, seed): check_new_folder(given.folder / f"{name}-{way}-{seed}") for seed in seeds for way in WAYS}
    for (way, seed), folder in folders.items():
        write_capture(folder, stage_of(seed), way, shape, seed)
        print(f"{folder}: {shape.photographs} photographs of {shape.size_px[0]} x {shape.size_px[1]} px")
    return 0


if __name__ == "__main__":
    sys.exit(main())
