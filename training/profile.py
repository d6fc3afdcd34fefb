"""Where the time of a training step goes: `python -m training.profile --config configs/training/release.yaml`.

The program takes steps as training.train would and saves nothing. It prints the median time of each part of a step, on
the host and on the device. Under torchrun the first process prints its own.
"""

from __future__ import annotations

import sys
from itertools import islice

from lightfield_gs.base.errors import InputError
from training.command import with_line_errors
from training.config import TrainingConfig
from training.data.batches import make_batch
from training.distributed import Team, join_team
from training.loop import make_planner, plans
from training.marks import PartTime, StepMarks
from training.ranges import MOST
from training.train import parse
from training.trainer import Trainer

RASTERIZER = ("rasterizer", "rasterizer backward")


def _profile(config: TrainingConfig, steps: int, warm_up: int, team: Team) -> list[PartTime] | None:
    """Do the work of profile() as one of a team."""
    trainer, planner, behind = Trainer(config, team), make_planner(config, team), None
    for plan, stage, _ in islice(plans(planner, trainer), warm_up + steps):
        if trainer.step == warm_up:
            trainer.marks = StepMarks(team.device)
            trainer.marks.mark("start")
        ahead = trainer.advance(make_batch(plan, planner.views, config.compile), stage)
        if behind is not None:
            behind.read()
        behind = ahead
    return trainer.marks.medians() if team.leads else None


def profile(config: TrainingConfig, steps: int, warm_up: int) -> list[PartTime] | None:
    """Medians over `steps` steps after `warm_up` others; None on all processes but the first."""
    with join_team(config.device) as team:
        return _profile(config, steps, warm_up, team)


def table(parts: list[PartTime]) -> str:
    """Return a line for each part, their sum, and the rasterizer's fraction of the sum (on a device, of its time)."""
    cuda = parts[0].device_ms is not None

    def line(name: str, chosen: list[PartTime]) -> str:
        device = f"{sum(part.device_ms for part in chosen):10.2f}" if cuda else f"{'-':>10}"
        return f"{name:<20}{device}{sum(part.host_ms for part in chosen):10.2f}"

    drawn = [part for part in parts if part.part in RASTERIZER]
    rasterizer, whole = (sum(part.device_ms if cuda else part.host_ms for part in some) for some in (drawn, parts))
    return "\n".join(
        [
            f"{'ms of a step':<20}{'device':>10}{'host':>10}",
            *(line(part.part, [part]) for part in parts),
            line("all", parts),
            f"rasterizer: {rasterizer:.2f} of {whole:.2f} ms, {100 * rasterizer / whole:.0f} %",
        ]
    )


@with_line_errors("training.profile")
def main(arguments: list[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    from jsonargparse import ArgumentParser

    parser = ArgumentParser(prog="python -m training.profile", description=__doc__, exit_on_error=False)
    parser.add_argument("--steps", type=int, default=100, help="steps to measure")
    parser.add_argument("--warm-up", type=int, default=30, help="steps before these")
    config, options = parse(parser, arguments)
    most = MOST if config.by_time else config.total_steps
    if options.steps < 2 or options.warm_up < 0 or options.steps + options.warm_up > most:
        raise InputError(
            f"--steps and --warm-up: expected at least 2 and 0, not more together than the {most} steps of the run, "
            f"got {options.steps} and {options.warm_up}"
        )
    found = profile(config, options.steps, options.warm_up)
    if found is not None:
        print(table(found))
    return 0


if __name__ == "__main__":
    sys.exit(main())
