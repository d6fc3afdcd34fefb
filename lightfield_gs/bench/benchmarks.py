"""The benchmarks of `lightfield-gs bench`, by name: some come with the package, others are in a checkout alone."""

from __future__ import annotations

import importlib
import sys
from pathlib import Path
from typing import Any

from lightfield_gs.base.errors import InputError

DEFAULT = "light-field"
BENCHMARKS = {
    DEFAULT: "a light-field image: run time, stages, memory and error against the oracle (when none is named)",
    "paper": "the tables of Shi et al.: ten scenes, times and memory of three methods",
    "training-step": "forward and backward of the rasterizer in a training step",
    "photo": "a photo through the network to the image",
    "pareto": "run time against error over the settings of quality",
    "skips": "the time that each skip of unneeded work saves",
    "video": "frames a second of a turntable, with and without writing them",
    "live": "frames a second, latency and stages of `live`, of a made clip",
    "dense": "forward and backward of one camera before many Gaussians",
    "webgpu": "frames by WebGPU, tiling by tiling and stage by stage, beside CUDA or the CPU",
    "eyes": "the error of eyes across the cone, with and without --view-filter",
    "fit": "fits to photographs of captures, or of published scenes, beside gsplat's",
}
_IN_PACKAGE = {DEFAULT, "photo", "pareto", "skips", "dense", "webgpu"}
_CHECKOUT = Path(__file__).resolve().parents[2]


def load(name: str) -> Any:
    """Return the module of a benchmark, with `add_arguments(parser)`, the dataclass `Options` and `run(options)`.

    Raises:
        InputError: the benchmark is in a checkout of the sources alone, and this package is not in one.
    """
    module = name.replace("-", "_")
    return importlib.import_module(f"{__package__}.{module}") if name in _IN_PACKAGE else load_from_checkout(module)


def load_from_checkout(module: str) -> Any:
    """Return a module of the folder benchmarks, which lies beside the package in a checkout.

    Raises:
        InputError: there is no such folder.
    """
    if not (_CHECKOUT / "benchmarks" / f"{module}.py").is_file():
        raise InputError(
            f"benchmarks/{module}.py is in the sources of lightfield-gs and not in the installed package; clone the "
            "repository, run `pip install -e .` in it, and then `lightfield-gs bench`"
        )
    if str(_CHECKOUT) not in sys.path:
        sys.path.append(str(_CHECKOUT))
    return importlib.import_module(f"benchmarks.{module}")
