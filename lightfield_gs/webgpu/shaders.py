"""The stages in WGSL: the files of csrc/webgpu, joined and fitted to a kind of frame."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

from lightfield_gs.base.errors import InputError

_PACKAGE = Path(__file__).resolve().parents[1]
_TILE_SAMPLES = 6  # of a thread, in tiles of pixels: two pixels
# The numbers of bindings, and of what type they are. Entries are the names in the sources.
BINDINGS = {
    "P": (0, "uniform"),
    "part": (1, "uniform"),
    "gaussians": (2, "read-only-storage"),
    "harmonics": (3, "read-only-storage"),
    "splat_a": (4, "storage"),
    "splat_b": (5, "storage"),
    "splat_c": (6, "storage"),
    "colours": (7, "storage"),
    "counters": (8, "storage"),
    "depths": (9, "storage"),
    "bins": (10, "storage"),
    "pairs": (11, "storage"),
    "large": (12, "storage"),
    "chunks": (13, "storage"),
    "merged": (14, "storage"),
    "image": (15, "storage"),
    "packed": (16, "storage"),
    "eye": (17, "uniform"),
    "borders": (18, "read-only-storage"),
    "turns": (19, "read-only-storage"),
    "lit": (20, "storage"),
    "seen": (21, "storage"),
}


@dataclass(frozen=True)
class Stage:
    """An entry point of the sources.

    Attributes:
        files: What is joined for it, without .wgsl.
        bindings: Names of the buffers that it uses: at most eight of storage, the least that WebGPU guarantees.
    """

    files: tuple[str, ...]
    bindings: tuple[str, ...]


_SPLATS = ("splat_a", "splat_b", "splat_c")
_LISTS, _SORT = ("frame", "footprint", "lists"), ("frame", "footprint", "sort")
STAGES = {
    "project": Stage(
        ("frame", "footprint", "lens", "means", "colours", "project"),
        ("P", "part", "gaussians", "harmonics", *_SPLATS, "colours", "counters", "depths"),
    ),
    "count": Stage(_LISTS, ("P", *_SPLATS, "counters", "bins", "pairs", "large")),
    "count_large": Stage(_LISTS, ("P", *_SPLATS, "counters", "bins", "pairs", "large")),
    "allocate": Stage(_LISTS, ("P", "counters", "bins", "chunks")),
    "scatter": Stage(_LISTS, ("P", *_SPLATS, "bins", "pairs")),
    "scatter_large": Stage(_LISTS, ("P", *_SPLATS, "counters", "bins", "pairs", "large")),
    "sort_short": Stage(_SORT, ("P", "depths", "bins", "pairs")),
    "sort_chunk": Stage(_SORT, ("P", "counters", "depths", "bins", "pairs", "chunks")),
    "merge_runs": Stage(_SORT, ("P", "part", "counters", "depths", "bins", "pairs", "chunks", "merged")),
    "composite": Stage(
        ("frame", "footprint", "lens", "composite"), ("P", "part", *_SPLATS, "colours", "bins", "pairs", "image")
    ),
    "pack": Stage(("pack",), ("image", "packed")),
    "pattern": Stage(("frame", "lens", "pattern"), ("P", "part", "image")),
    "see": Stage(("frame", "seen"), ("part", "image", "eye", "borders", "turns", "lit")),
    "join_seen": Stage(("frame", "seen"), ("eye", "lit", "seen")),
}


@dataclass(frozen=True)
class Variant:
    """A kind of frame, by which the sources are fitted; csrc/webgpu/frame.wgsl has the meanings.

    Attributes:
        ordinals: Sub-pixels of a lens in a box of lenses; 0: tiles of pixels.
        cells: Whether the panel has sub-pixel cells.
        bgr: Whether blue is the left-most stripe.
        harmonics: Whether colours vary over the rig.
        compensated: Whether opacities are lowered where footprints are widened.
        floats: Whether the image has floats.
        ends_early: Whether the last splat of a sample takes the light that is left.
    """

    ordinals: int = 0
    cells: bool = False
    bgr: bool = False
    harmonics: bool = False
    compensated: bool = False
    floats: bool = False
    ends_early: bool = False

    @property
    def samples(self) -> int:
        """Samples of a thread."""
        return self.ordinals or _TILE_SAMPLES

    def of_stage(self, name: str) -> Variant:
        """Return the variant without what a stage does not depend on, so that more frames share its pipeline."""
        if name == "project":
            return replace(self, ordinals=0, cells=False, bgr=False, floats=False, ends_early=False)
        if name == "composite":
            return self
        return Variant(0 if name == "pack" else self.ordinals)

    def constants(self) -> str:
        """Return the declarations before the sources."""
        words = {
            "BY_LENS": self.ordinals > 0,
            "CELLS": self.cells,
            "BGR": self.bgr,
            "HARMONICS": self.harmonics,
            "COMPENSATED": self.compensated,
            "FLOATS": self.floats,
            "ENDS_EARLY": self.ends_early,
        }
        lines = [f"const {name} = {str(value).lower()};" for name, value in words.items()]
        return "\n".join([*lines, f"const ORDINALS = {max(self.ordinals, 1)};", ""])


def source(stage: str, variant: Variant) -> str:
    """Return the WGSL of a stage for a kind of frame."""
    text = variant.constants() + "\n".join(wgsl(name) for name in STAGES[stage].files)
    for name, kept in (("floats", variant.floats), ("bytes", not variant.floats), ("pixels", not variant.ordinals)):
        text = re.sub(rf"[ ]*//\{{{name}\n(.*?)[ ]*//{name}\}}\n", r"\1" if kept else "", text, flags=re.DOTALL)
    return re.sub(
        r"[ ]*//\{q\n(.*?)[ ]*//q\}\n", lambda m: _repeated(m.group(1), variant.samples), text, flags=re.DOTALL
    )


def _repeated(lines: str, count: int) -> str:
    """Return lines once for each sample: q becomes its number, and x[q] a variable of its own."""
    copies = []
    for q in range(count):
        named = re.sub(r"\b([A-Za-z]\w*)\[q\]", rf"\g<1>_{q}", lines)
        copies.append(re.sub(r"\bq\b", str(q), named))
    return "".join(copies)


@lru_cache
def wgsl(name: str) -> str:
    """Return a file of the sources as it is. Raises InputError where it is missing."""
    for folder in (_PACKAGE / "wgsl", _PACKAGE.parent / "csrc" / "webgpu"):
        if (folder / f"{name}.wgsl").is_file():
            return (folder / f"{name}.wgsl").read_text(encoding="utf-8")
    raise InputError(f"no {name}.wgsl in {_PACKAGE / 'wgsl'} or csrc/webgpu beside it; reinstall lightfield-gs")
