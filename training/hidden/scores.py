"""PSNR of filled holes on held-out compositions: of the membrane, of the exemplar, and of the network."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from lightfield_gs.photo.hidden import fill_hidden, find_hidden
from training.hidden.compositions import Composition, CompositionOptions, Compositions
from training.hidden.examples import Example, make_examples
from training.hidden.network import HiddenNet
from training.hidden.pictures import read_pieces
from training.meshes.pack import ResidentMeshes, read_meshes

_SEED = 10_007  # of the held-out compositions, whatever the run's
_AT_ONCE = 4
_FEWEST = 200  # known pixels of a hole that is scored


class HeldOut:
    """Compositions of meshes of the split "val" before photographs that training never sees.

    Args:
        count: How many.
    """

    def __init__(
        self,
        meshes: Path,
        photographs: Path,
        held_out: list[str],
        options: CompositionOptions,
        count: int,
        device: torch.device,
    ) -> None:
        pictures = read_pieces(photographs, held_out, held_out=True).to(device)
        source = Compositions(ResidentMeshes(read_meshes(meshes, "val"), device), pictures, options)
        self._examples = list(_examples(source, count))
        self.exemplars = [_exemplar(example) for example in self._examples]

    @torch.no_grad()
    def fillings(self, net: HiddenNet | None) -> Iterator[tuple[Example, dict[str, Tensor]]]:
        """Yield each example, of one picture, and its fillings [3,S,S] by their names."""
        for example, exemplar in zip(self._examples, self.exemplars):
            found = {"membrane": example.guess[0], "exemplar": exemplar}
            if net is not None:
                found["network"] = net(example.seen())[0][0].clamp(0, 1)
            yield example, found

    @torch.no_grad()
    def scores(self, net: HiddenNet | None) -> dict[str, float]:
        """Return the mean PSNR of each filling in the known pixels, dB, and mean errors of log disparity."""
        psnr: dict[str, list[float]] = {}
        depth: dict[str, list[float]] = {"membrane_depth": []}
        for example, found in self.fillings(net):
            known = example.known[0]
            for name, colours in found.items():
                error = (colours - example.truth[0])[:, known].square().mean()
                psnr.setdefault(f"{name}_db", []).append(float(-10 * error.log10()))
            guesses = {"membrane_depth": example.guess_disparity.log()}
            if net is not None:
                guesses["network_depth"] = net(example.seen())[1]
            for name, values in guesses.items():
                depth.setdefault(name, []).append(float((values - example.log_disparity)[example.known].abs().mean()))
        return {name: float(np.mean(values)) for name, values in (psnr | depth).items()}


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
    """Return today's filling [3,S,S], by patches of the picture itself."""
    depth = example.depth[0]
    found = find_hidden(example.image[0].movedim(0, 2), depth, (example.focal_px,) * 2)
    return fill_hidden(found, depth).movedim(2, 0)
