"""Make a set of random objects to train on: `python -m training.data.make_objects --output data/objects/made`.

The objects are random ones of training/data/procedural.py, framed as in the project's other sets. Each has 12 cameras
within 30 degrees of azimuth and 10 of elevation about the first, in SRN layout with WebP pictures. With --photographs
their skins are pieces of photographs and their shapes less regular. Training draws such objects itself, new ones in
every step (`procedural` in the configuration). A set is for looking at them, and for other programs.

Objects are drawn on the GPU where there is one, else by all cores. On one machine a seed gives the same set every time.
"""

from __future__ import annotations

import argparse
import dataclasses
import os
import sys
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import torch
from PIL import Image
from tqdm import tqdm

from lightfield_gs.base.checks import whole_number
from lightfield_gs.base.device import choose_device
from lightfield_gs.io.atomic import atomic_folder, check_new_folder, make_folder
from training.command import with_line_errors
from training.data.make_small import stored_views, train_angles, write_cameras
from training.data.procedural import draw_frames
from training.data.procedural_plan import NUMBERS, draw_objects, orbit
from training.data.textures import Photographs, read_photographs
from training.data.transfer import on_device

SIZE_PX, FOCAL_PX = 256, 262.5
AZIMUTH_DEG, ELEVATION_DEG = 30.0, 10.0
_ON_GPU, _QUALITY = 16, 92
_photographs: Photographs | None = None  # of a process that draws


def make_objects(
    output: Path, count: int, photographs: Path | None = None, seed: int = 0, device: str = "auto"
) -> None:
    """Make the folder `output` with so many objects; it is complete or absent.

    Args:
        photographs: Folder of the photographs for skins; None: they are as in make_small.

    Raises:
        InputError: the folder exists and is not empty, or cannot be written, or the photographs cannot be used.
    """
    output = check_new_folder(output)
    on_gpu = choose_device(device) == "cuda"
    _begin(photographs)  # says what is wrong with them before any process starts
    with atomic_folder(output) as temporary:
        with ProcessPoolExecutor(
            os.cpu_count(), get_context("spawn"), initializer=_begin, initargs=(None if on_gpu else photographs,)
        ) as pool:
            done = _drawn_here(pool, temporary, count, seed) if on_gpu else _drawn_there(pool, temporary, count, seed)
            for _ in tqdm(done, total=count, desc=f"drawing {output}", unit="object"):
                pass


def _begin(photographs: Path | None) -> None:
    """Readies a process."""
    global _photographs
    _photographs = None if photographs is None else read_photographs(photographs)


def _drawn_here(pool: ProcessPoolExecutor, root: Path, count: int, seed: int) -> Iterator[None]:
    """Draw on the GPU, a few objects at once, while other processes write earlier pictures."""
    written = []
    for first in range(0, count, _ON_GPU):
        numbers = list(range(first, min(count, first + _ON_GPU)))
        pictures, poses = draw_numbered(numbers, seed, torch.device("cuda"))
        written += [pool.submit(_write, root, *one) for one in zip(numbers, pictures, poses)]
    for one in written:
        yield one.result()


def _drawn_there(pool: ProcessPoolExecutor, root: Path, count: int, seed: int) -> Iterator[None]:
    yield from pool.map(partial(_draw_and_write, root, seed), range(count))


def _draw_and_write(root: Path, seed: int, number: int) -> None:
    torch.set_num_threads(1)  # each core has a process of its own
    pictures, poses = draw_numbered([number], seed, torch.device("cpu"))
    _write(root, number, pictures[0], poses[0])


def draw_numbered(numbers: list[int], seed: int, device: torch.device) -> tuple[np.ndarray, np.ndarray]:
    """Pictures uint8 [B,V,S,S,4] with straight alpha, and camera-to-world matrices [B,V,4,4], of objects by number."""
    streams = [np.random.default_rng((seed, number)) for number in numbers]
    angles = np.radians(np.stack([train_angles(rng, AZIMUTH_DEG, ELEVATION_DEG) for rng in streams]))
    cameras = orbit(angles[..., 0], angles[..., 1], np.zeros((len(numbers), 1)), np.zeros((len(numbers), 1)))
    count, views = cameras.shape[:2]
    framing = np.ones((count, 1 + views)), np.zeros((count, 1 + views, 2))
    rows = np.concatenate([rng.random((1, NUMBERS)) for rng in streams])
    plan = draw_objects(rows, (0.0, 0.0), (SIZE_PX, SIZE_PX), framing, np.ones((count, views, 3)), _photographs)
    plan = on_device(dataclasses.replace(plan, world_to_camera=torch.from_numpy(cameras).float()), device)
    intrinsics = torch.tensor([FOCAL_PX, FOCAL_PX, SIZE_PX / 2, SIZE_PX / 2], device=device)
    return stored_views(draw_frames(plan, intrinsics), cameras)


def _write(root: Path, number: int, pictures: np.ndarray, poses: np.ndarray) -> None:
    """An object in SRN layout."""
    folder = root / f"made-{number:05d}"
    write_cameras(folder, poses, FOCAL_PX, SIZE_PX)
    make_folder(folder / "rgb")
    for index, picture in enumerate(pictures):
        Image.fromarray(picture).save(folder / f"rgb/{index:06d}.webp", quality=_QUALITY, method=2)


@with_line_errors("training.data.make_objects")
def main(arguments: list[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    parser = argparse.ArgumentParser(
        prog="python -m training.data.make_objects",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--output", type=Path, required=True, help="folder for the set")
    parser.add_argument("--objects", type=int, default=1000, help="how many (default: 1000)")
    parser.add_argument("--photographs", type=Path, help="folder of photographs to clothe them in; default: plain ones")
    parser.add_argument("--seed", type=int, default=0, help="others give other objects (default: 0)")
    parser.add_argument(
        "--device", default="auto", choices=("auto", "cpu", "cuda"), help="default: a GPU if there is one"
    )
    options = parser.parse_args(arguments)
    count, seed = whole_number("--objects", options.objects, 1, 100_000), whole_number("--seed", options.seed, 0, 2**31)
    make_objects(options.output, count, options.photographs, seed, options.device)
    size = sum(path.stat().st_size for path in options.output.rglob("*") if path.is_file())
    print(f"{options.output}: {count} objects, {size / 1e6:.2f} MB")
    return 0


if __name__ == "__main__":
    sys.exit(main())
