"""PSNR of filled holes on compositions: of the membrane and of the exemplar."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from lightfield_gs.photo.hidden import fill_hidden, find_hidden
from training.hidden.compositions import Composition, CompositionOptions, Compositions
from training.hidden.examples import Example, make_examples
from training.hidden.pictures import read_pieces
from training.meshes.pack import ResidentMeshes, read_meshes

_SEED = 10_007
_AT_ONCE = 4
_FEWEST = 200  # known pixels of a hole that is scored


class ScoredCompositions:
    """Compositions of meshes of the split "val" before photographs, and their fillings.

    Args:
        names: File name patterns of the photographs.
        count: How many compositions.

    Attributes:
        filled: Examples, each of one picture, and their fillings [3,S,S] by name.
    """

    def __init__(
        self, meshes: Path, photographs: Path, names: list[str], options: CompositionOptions, count: int
    ) -> None:
        packs = ResidentMeshes(read_meshes(meshes, "val"), torch.device("cpu"))
        source = Compositions(packs, read_pieces(photographs, names), options)
        self.filled = [
            (example, {"membrane": example.guess[0], "exemplar": _exemplar(example)})
            for example in _examples(source, count)
        ]

    def scores(self) -> dict[str, float]:
        """Return the mean PSNR of each filling in the known pixels, dB."""
        psnr: dict[str, list[float]] = {}
        for example, fillings in self.filled:
            known = example.known[0]
            for name, colours in fillings.items():
                error = (colours - example.truth[0])[:, known].square().mean()
                psnr.setdefault(name, []).append(float(-10 * error.log10()))
        return {name: float(np.mean(values)) for name, values in psnr.items()}

    def disparity_error(self) -> float:
        """Return the mean absolute error of the log disparity that find_hidden gives to the known pixels."""
        errors = (
            (example.guess_disparity.log() - example.log_disparity)[example.known].abs().mean()
            for example, _ in self.filled
        )
        return float(np.mean([float(error) for error in errors]))


def _examples(source: Compositions, count: int) -> Iterator[Example]:
    """Yield so many examples, each of one picture with a hole that is known."""
    rng, found = np.random.default_rng(_SEED), 0
    while found < count:
        composition: Composition = source.make(rng, _AT_ONCE)
        examples = make_examples(composition, rng)
        for number in range(_AT_ONCE):
            if found < count and int(examples.known[number].sum()) >= _FEWEST:
                found += 1
                yield examples.part(slice(number, number + 1))


def _exemplar(example: Example) -> Tensor:
    """Return the filling [3,S,S] by patches of the picture itself."""
    depth = example.depth[0]
    found = find_hidden(example.image[0].movedim(0, 2), depth, (example.focal_px,) * 2)
    return fill_hidden(found, depth).movedim(2, 0)
