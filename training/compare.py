"""Constrained field of view against full sphere: `python -m training.compare --config configs/training/compare.yaml`.

It repeats Table 2 and Figure 7 of Shi et al., "Single-View Encoding of 3D Light Field Based on Editable Field of View
Gaussian Splatting", Photonics 2025, 12(3), 279. One network is trained with targets inside the panel's
cone or from all round the object, and scored inside the cone.

The arms of a comparison are runs that differ in their targets only: network, steps, samples, objects, source pictures
and their augmentation are the same. A set whose views lie in a cone has no targets all round, and one with views all
round gives a cone too few. So sources are always views of `data`. An arm may take its targets from other folders with
the same objects in the same world (`target_data`). A view of `data` is a source only if another one looks within
`neighbour_deg`. That angle must fit into the cone of every arm, so that each source has a target in all of them.

Each arm is an ordinary run in <output_dir>/<arm>, and the same command resumes it. Arms run one after the other; --arm
trains only one, so that each GPU of a machine can have its own (CUDA_VISIBLE_DEVICES). At the end, or at once with
--report-only, finished arms are scored, and <output_dir> gets:

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

import torch

from lightfield_gs.base.errors import InputError, named
from training.command import with_line_errors
from training.compare_report import is_finished, write_report
from training.config import TrainingConfig
from training.loop import train
from training.train import parse


@dataclass(frozen=True)
class Arm:
    """The targets of an arm: fields of TrainingConfig; None stands for the value of all arms.

    Args:
        cone_deg: full cone of its targets, degrees.
        cone_margin: its targets lie within this times half the cone in azimuth of the source view.
        elevation_deg: its targets lie within this elevation of the source view, degrees to either side.
        target_data: for each folder of data one that its targets are drawn from.
    """

    cone_deg: float | None = None
    cone_margin: float | None = None
    elevation_deg: float | None = None
    target_data: list[str] | None = None


@dataclass(frozen=True)
class Experiment:
    """Runs to train and score.

    Attributes:
        runs: The configuration of each arm's run.
        scored: Folders on which all runs are scored in the end, by their names in the report.
    """

    output_dir: Path
    runs: dict[str, TrainingConfig]
    scored: dict[str, Path]


def _arm_config(common: TrainingConfig, name: str, arm: Arm, data_root: Path) -> TrainingConfig:
    """The run of an arm. Raises InputError for fields out of range and cones that may leave sources without target."""
    changes = {field: value for field, value in dataclasses.asdict(arm).items() if value is not None}
    with named(f"arms: {name}"):
        run = dataclasses.replace(common, output_dir=str(Path(common.output_dir) / name), **changes)
    reach = min(run.azimuth_deg, run.elevation_deg)
    if run.neighbour_deg > reach:
        raise InputError(
            f"arms: {name}: its targets lie within {reach:g} degrees, so some sources of the other arms "
            f"might have none: expected neighbour_deg of at most {reach:g}, got {run.neighbour_deg:g}"
        )
    return dataclasses.replace(
        run,
        data=[str(data_root / folder) for folder in run.data],
        target_data=[str(data_root / folder) for folder in run.target_data],
        validation=str(data_root / run.validation) if run.validation else "",
        photographs=str(data_root / run.photographs) if run.photographs else "",
    )


def read_experiment(arguments: list[str] | None = None) -> tuple[Experiment, argparse.Namespace]:
    """The experiment that command-line arguments describe, and the options arm (None: all) and report_only.

    Raises InputError when they describe none.
    """
    from jsonargparse import ArgumentParser, DefaultHelpFormatter

    class Help(argparse.RawDescriptionHelpFormatter, DefaultHelpFormatter):
        """Paragraphs as they are written here, and defaults."""

    parser = ArgumentParser(
        prog="python -m training.compare", description=__doc__, exit_on_error=False, formatter_class=Help
    )
    parser.add_argument("--arms", type=dict[str, Arm], required=True, help="the targets of each arm")
    parser.add_argument("--scored", type=dict[str, str], required=True, help="folders to score on in the end")
    parser.add_argument("--data_root", type=str, default=".", help="folder that paths of images are relative to")
    parser.add_argument("--arm", type=str, help="train this arm only")
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
    scored = {name: root / folder for name, folder in options.scored.items()}
    return Experiment(Path(common.output_dir), runs, scored), options


@with_line_errors("training.compare")
def main(arguments: list[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    experiment, options = read_experiment(arguments)
    if int(os.environ.get("WORLD_SIZE", 1)) > 1:
        raise InputError(
            "a comparison runs in one process: start one for each arm (--arm), each with a GPU "
            "(CUDA_VISIBLE_DEVICES), instead of torchrun"
        )
    for name in [] if options.report_only else [options.arm] if options.arm else experiment.runs:
        if is_finished(experiment.runs[name]):
            continue
        print(f"arm {name}", flush=True)
        if train(experiment.runs[name]) is None:
            return 0
        torch.compiler.reset()  # the next arm cannot use the compiled network of this one
    print(write_report(experiment.output_dir, experiment.runs, experiment.scored))
    return 0


if __name__ == "__main__":
    sys.exit(main())
