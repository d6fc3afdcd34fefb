"""Constrained field of view against full sphere: `python -m training.compare --config configs/training/compare.yaml`.

It repeats Table 2 and Figure 7 of Shi et al., "Single-View Encoding of 3D Light Field Based on Editable Field of View
Gaussian Splatting", Photonics 2025, 12(3), 279. One network is trained with targets inside the panel's
cone or from all round the object, and scored inside the cone.

Each arm changes some fields of the common configuration. Arms of a comparison of targets differ in these only: network,
steps, samples, objects, source pictures and their augmentation are the same. A set whose views lie in a cone has no
targets all round, and one with views all round gives a cone too few. So sources are always views of `data`. An arm may
take its targets from other folders with the same objects in the same world (`target_data`). A view of `data` is a
source only if another one looks within `neighbour_deg`. That angle must fit into the cone of every arm, so that each
source has a target in all of them. Meshes have every view: `data: []`.

Each arm is an ordinary run in <output_dir>/<arm>, and the same command resumes it. Arms run one after the other, or
with --devices side by side, each on a GPU of its own. --arm trains and scores only one, for arms on several machines.
At the end, or at once with --report-only, finished arms are scored, and <output_dir> gets:

- report.json;
- report.md: PSNR and SSIM per angle beside two floors, and the lead of the first arm over the others;
- angles.png, and curves.png with the scores during training.

Every field of TrainingConfig is an option, for all arms; paths of images are relative to --data_root.
"""

from __future__ import annotations

import argparse
import dataclasses
import os
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from lightfield_gs.base.checks import whole_number
from lightfield_gs.base.errors import InputError, named
from training.command import with_line_errors
from training.compare_report import Scored, is_finished, write_report
from training.config import TrainingConfig
from training.loop import train
from training.ranges import MOST
from training.side_by_side import run_side_by_side
from training.train import overlaid, parse


@dataclass(frozen=True)
class Experiment:
    """Runs to train and score.

    Attributes:
        runs: The configuration of each arm's run.
        scored: Folders on which all runs are scored in the end, by their names in the report.
    """

    output_dir: Path
    runs: dict[str, TrainingConfig]
    scored: dict[str, Scored]


def _arm_config(common: TrainingConfig, name: str, changes: dict[str, Any], data_root: Path) -> TrainingConfig:
    """The run of an arm. Raises InputError for fields out of range and cones that may leave sources without target."""
    with named(f"arms: {name}"):
        run = overlaid(common, changes | {"output_dir": str(Path(common.output_dir) / name)})
    reach = min(run.azimuth_deg, run.elevation_deg)
    if run.data and run.neighbour_deg > reach:
        raise InputError(
            f"arms: {name}: its targets lie within {reach:g} degrees, so some sources of the other arms "
            f"might have none: expected neighbour_deg of at most {reach:g}, got {run.neighbour_deg:g}"
        )

    def placed(folder: str) -> str:
        return str(data_root / folder) if folder else ""

    return dataclasses.replace(
        run,
        data=[placed(folder) for folder in run.data],
        target_data=[placed(folder) for folder in run.target_data],
        validation=placed(run.validation),
        photographs=placed(run.photographs),
        meshes=dataclasses.replace(run.meshes, folder=placed(run.meshes.folder)),
    )


def read_experiment(arguments: list[str] | None = None) -> tuple[Experiment, argparse.Namespace]:
    """The experiment that command-line arguments describe, and the options arm (None: all), report_only and devices.

    Raises InputError when they describe none.
    """
    from jsonargparse import ArgumentParser, DefaultHelpFormatter

    class Help(argparse.RawDescriptionHelpFormatter, DefaultHelpFormatter):
        """Paragraphs as they are written here, and defaults."""

    parser = ArgumentParser(
        prog="python -m training.compare", description=__doc__, exit_on_error=False, formatter_class=Help
    )
    parser.add_argument("--arms", type=dict[str, dict[str, Any]], required=True, help="the other fields of each arm")
    parser.add_argument(
        "--scored",
        type=dict[str, str | Scored],
        required=True,
        help="folders to score on in the end, or each with folder, size_px (128) and detail (0) of training.evaluate",
    )
    parser.add_argument("--data_root", type=str, default=".", help="folder that paths of images are relative to")
    parser.add_argument("--arm", type=str, help="train and score this arm only")
    parser.add_argument("--devices", type=int, default=1, help="arms that run side by side, each on a GPU")
    parser.add_argument("--report-only", action="store_true", help="train nothing, report on what is there")
    common, options = parse(parser, arguments)
    root = Path(options.data_root)
    runs = {name: _arm_config(common, name, arm, root) for name, arm in options.arms.items()}
    if not runs or not options.scored:
        raise InputError("arms, scored: expected at least one of each")
    for name in runs:
        if not name.replace("_", "").replace("-", "").isalnum():
            raise InputError(f"arms: expected names of letters, digits, - and _, got {name!r}")
    if options.arm is not None and options.arm not in runs:
        raise InputError(f"--arm {options.arm}: expected one of {', '.join(runs)}")
    whole_number("--devices", options.devices, 1, MOST)
    scored = {name: one if isinstance(one, Scored) else Scored(one) for name, one in options.scored.items()}
    scored = {name: dataclasses.replace(one, folder=str(root / one.folder)) for name, one in scored.items()}
    return Experiment(Path(common.output_dir), runs, scored), options


@with_line_errors("training.compare")
def main(arguments: list[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    arguments = sys.argv[1:] if arguments is None else arguments
    experiment, options = read_experiment(arguments)
    if int(os.environ.get("WORLD_SIZE", 1)) > 1:
        raise InputError(
            "a comparison runs in one process for each arm: take --devices, or start one for each arm (--arm) with a "
            "GPU (CUDA_VISIBLE_DEVICES), instead of torchrun"
        )
    todo = [options.arm] if options.arm else list(experiment.runs)
    todo = [] if options.report_only else [name for name in todo if not is_finished(experiment.runs[name])]
    if options.devices > 1 and not options.arm:
        logs = {name: Path(experiment.runs[name].output_dir) / "output.txt" for name in todo}
        if not run_side_by_side({name: [*arguments, "--arm", name] for name in todo}, logs, options.devices):
            return 0
        todo = []
    for name in todo:
        print(f"arm {name}", flush=True)
        if train(experiment.runs[name]) is None:
            return 0
        torch.compiler.reset()  # the next arm cannot use the compiled network of this one
    scoring = [options.arm] if options.arm else list(experiment.runs)
    print(write_report(experiment.output_dir, experiment.runs, experiment.scored, scoring))
    return 0


if __name__ == "__main__":
    sys.exit(main())
