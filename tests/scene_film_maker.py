"""Numbered scenes: an object at rest, and one that goes across."""

from dataclasses import replace
from pathlib import Path

import torch
from command_line import scene

from lightfield_gs import Gaussians


def dance(number: int, steps: int = 5, origin=(0.0, 0.0, 0.0)) -> Gaussians:
    """The scene of a number: forty Gaussians at rest, then twenty that go 3 units to the right."""
    rest, goes = scene(40, seed=1), scene(20, seed=2)
    goes.means[:, 0] += 3 * number / (steps - 1)
    fields = {name: torch.cat([rest.fields()[name], goes.fields()[name]]) for name in rest.fields()}
    return replace(Gaussians(**fields), origin=origin)


def write_dance(folder: Path, steps: int = 5, suffix: str = ".ply", first: int = 8) -> list[Path]:
    folder.mkdir(exist_ok=True)
    paths = [folder / f"frame_{first + number}{suffix}" for number in range(steps)]
    for number, path in enumerate(paths):
        dance(number, steps).save(path)
    return paths
