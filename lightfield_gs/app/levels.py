"""A scene in levels of detail: framed by its coarsest level, then read as finely as the panel shows it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from lightfield_gs.base.cli_messages import note
from lightfield_gs.base.system import free_host_memory
from lightfield_gs.io.scenes.files import SceneFile
from lightfield_gs.io.scenes.streamed_sog import GAUSSIAN_BYTES, StreamedSog, is_streamed
from lightfield_gs.scene.gaussians import Gaussians, from_arrays

if TYPE_CHECKING:
    from lightfield_gs.panels.panel import Panel
    from lightfield_gs.panels.rig import Rig

_TURNS = 8  # of cameras that may go round the scene


@dataclass(kw_only=True)
class LevelledFile(SceneFile):
    """The coarsest level of a streamed SOG, whose other levels are read once the cameras are known.

    Attributes:
        streamed: its index.
        leaf_of: [N] int64, the leaf of each Gaussian.
        skip_invalid: see read_scene.
    """

    streamed: StreamedSog
    leaf_of: np.ndarray
    skip_invalid: bool = False
    path: Path = field(default_factory=Path)

    def choose(self, panel: Panel, rigs: Sequence[Rig]) -> tuple[Gaussians, str]:
        """Return the Gaussians, on the CPU, that a panel needs for these rigs, and a line on them.

        Raises:
            InputError: a file cannot be read.
        """
        from lightfield_gs.simplification.level_choice import PSNR_DB, choose_levels

        streamed, free = self.streamed, free_host_memory()
        most = None if free is None else free // 2 // GAUSSIAN_BYTES
        levels = choose_levels(streamed.leaves, self.gaussians, self.leaf_of, panel, rigs, most)
        stored = streamed.read(levels, self.skip_invalid)
        for words in stored.notes:
            note(f"{self.path}: {words}")
        gaussians = from_arrays(stored.fields, stored.origin)
        seen = sum(level is not None for level in levels)
        words = (
            f"{gaussians.count} of {streamed.count(streamed.levels[0])} Gaussians, in {seen} of {len(levels)} chunks"
        )
        aim = "as many as the memory holds" if gaussians.count == most else f"within {PSNR_DB:g} dB of all"
        return gaussians, f"levels of detail: {words}, {aim} (all of the finest: --lod 0)"


def read_levelled(path: Path, skip_invalid: bool) -> LevelledFile | None:
    """Read the coarsest level of a file whose levels can be chosen chunk by chunk; None for other files.

    Raises:
        InputError: the file cannot be read.
    """
    if not is_streamed(path):
        return None
    streamed = StreamedSog(path)
    if not streamed.has_errors or len(streamed.levels) < 2:
        return None
    stored, leaf_of = streamed.read_leaves(streamed.levels[-1])
    gaussians = from_arrays(stored.fields, stored.origin)
    return LevelledFile(
        gaussians,
        stored.comments,
        kind=stored.kind,
        streamed=streamed,
        leaf_of=leaf_of,
        skip_invalid=skip_invalid,
        path=path,
    )


def turned_round(rig: Rig) -> list[Rig]:
    """Return the rig and others that see the same from all sides."""
    from lightfield_gs.panels.look import orbited

    return [orbited(rig, 360 * turn / _TURNS, 0.0) for turn in range(_TURNS)]
