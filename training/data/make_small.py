"""Make a small set to try training with: `python -m training.data.make_small --output data/small`.

The objects are random ones of training/data/procedural.py, drawn by the project's own rasterizer in SRN layout. The
configurations cpu.yaml and compare-small.yaml take them:

- train_cone: 12 views within 30 degrees of azimuth and 10 of elevation about the first;
- train_sphere: 12 views of the same objects in the same worlds, from all round;
- val: other objects, from the angles of the scores.

On one machine the set is the same every time. It takes less than 2 MB and less than a minute.
"""

from __future__ import annotations

import argparse
import dataclasses
import sys
from pathlib import Path

import numpy as np
import torch
from tqdm import tqdm

from lightfield_gs.base.checks import whole_number
from lightfield_gs.io.atomic import atomic_folder, make_folder
from lightfield_gs.io.images import write_image
from training.command import with_line_errors
from training.data.procedural import draw_frames
from training.data.procedural_plan import DISTANCE, NUMBERS, draw_objects, orbit

SIZE_PX, FOCAL_PX = 128, 148.0  # a ball of diameter 1 at DISTANCE fits
TRAIN, VIEWS = 9, 12
_SEED = 34
_VAL_AZIMUTHS = (0, -20, -15, -10, -5, 5, 10, 15, 20)


def train_angles(rng: np.random.Generator, azimuth_deg: float, elevation_deg: float) -> np.ndarray:
    """Azimuths and elevations [VIEWS,2], degrees: the middle, then one in each of equal ranges of azimuth."""
    azimuths = azimuth_deg * (2 * (np.arange(VIEWS - 1) + rng.random(VIEWS - 1)) / (VIEWS - 1) - 1)
    elevations = elevation_deg * rng.uniform(-1, 1, VIEWS - 1)
    return np.concatenate([np.zeros((1, 2)), np.stack([azimuths, elevations], -1)])


def make_small(output: Path, train: int = TRAIN, val: int = TRAIN // 3) -> None:
    """Makes the folder `output` with so many objects to train on and to score; complete or not at all.

    Raises InputError where it exists and is not empty, or cannot be written.
    """
    with atomic_folder(output) as temporary:
        for number in tqdm(range(train + val), desc=f"drawing {output}", unit="object"):
            rng = np.random.default_rng((_SEED, number))
            angles = (
                {"val": np.array([(azimuth, 0) for azimuth in _VAL_AZIMUTHS])}
                if number >= train
                else {"train_cone": train_angles(rng, 30, 10), "train_sphere": train_angles(rng, 180, 60)}
            )
            _write_object(temporary, f"object-{number:02d}", rng.random((1, NUMBERS)), angles)


def _write_object(root: Path, name: str, numbers: np.ndarray, angles: dict[str, np.ndarray]) -> None:
    """An object from uniform numbers [1,NUMBERS], in each of the folders of `angles` [V,2] (degrees) by its cameras."""
    cameras = np.concatenate([orbit(*np.radians(views.T), np.zeros(1), np.zeros(1)) for views in angles.values()])
    count = len(cameras)
    framing = np.ones((1, 1 + count)), np.zeros((1, 1 + count, 2))
    plan = draw_objects(numbers, (0.0, 0.0), (SIZE_PX, SIZE_PX), framing, np.ones((1, count, 3)))
    plan = dataclasses.replace(plan, world_to_camera=torch.from_numpy(cameras[None]).float())
    frames = draw_frames(plan, torch.tensor([FOCAL_PX, FOCAL_PX, SIZE_PX / 2, SIZE_PX / 2]))[0]
    pictures, poses = stored_views(frames, cameras)
    first = 0
    for folder, views in angles.items():
        _write_views(root / folder / name, pictures[first : first + len(views)], poses[first : first + len(views)])
        first += len(views)


def stored_views(frames: torch.Tensor, world_to_camera: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Convert views of `orbit` to the contents of files.

    Args:
        frames: [...,4,S,S], premultiplied.
        cameras: [...,4,4].

    Returns:
        Pictures uint8 [...,S,S,4] with straight alpha, and camera-to-world matrices [...,4,4]. The origin of the world
        is the middle of the object.
    """
    frames = frames.movedim(-3, -1)
    straight = torch.cat([frames[..., :3] / frames[..., 3:].clamp_min(1e-6), frames[..., 3:]], -1).clamp(0, 1)
    pictures = (255 * straight * (frames[..., 3:] >= 0.5 / 255)).round().to(torch.uint8).cpu().numpy()
    poses = np.linalg.inv(world_to_camera)
    poses[..., 2, 3] -= DISTANCE
    return pictures, poses


def _write_views(folder: Path, pictures: np.ndarray, poses: np.ndarray) -> None:
    """Pictures [V,S,S,4] and camera-to-world matrices [V,4,4] in SRN layout."""
    write_cameras(folder, poses, FOCAL_PX, SIZE_PX)
    make_folder(folder / "rgb")
    for index, picture in enumerate(pictures):
        write_image(folder / f"rgb/{index:06d}.png", picture, compression="small")


def write_cameras(folder: Path, poses: np.ndarray, focal_px: float, size_px: int) -> None:
    """The cameras of an object in SRN layout: camera-to-world matrices [V,4,4], square frames about their middle."""
    make_folder(folder / "pose")
    for index, pose in enumerate(poses):
        np.savetxt(folder / f"pose/{index:06d}.txt", pose.reshape(1, 16), fmt="%.9g")
    middle = size_px / 2
    (folder / "intrinsics.txt").write_text(f"{focal_px} {middle} {middle} 0.\n0. 0. 0.\n1.\n{size_px} {size_px}\n")


@with_line_errors("training.data.make_small")
def main(arguments: list[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    parser = argparse.ArgumentParser(
        prog="python -m training.data.make_small",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--output", type=Path, required=True, help="folder for the set; data/small in configs/training")
    parser.add_argument(
        "--objects",
        type=int,
        default=TRAIN,
        help=f"how many to train on; a third as many more to score (default: {TRAIN})",
    )
    options = parser.parse_args(arguments)
    train = whole_number("--objects", options.objects, 1, 10_000)
    make_small(options.output, train, max(1, train // 3))
    size = sum(path.stat().st_size for path in options.output.rglob("*") if path.is_file())
    print(f"{options.output}: {train} objects to train on, {max(1, train // 3)} to score, {size / 1e6:.2f} MB")
    return 0


if __name__ == "__main__":
    sys.exit(main())
