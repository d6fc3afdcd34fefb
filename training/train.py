"""Train the network: `python -m training.train --config configs/training/first.yaml [--seed 1 ...]`.

Every field of TrainingConfig is an option that overrides the file. Running the same command again resumes the run.
"""
from __future__ import annotations

import dataclasses
import sys

from lightfield_gs.errors import InputError
from training.config import TrainingConfig
from training.loop import train


def main(arguments: list[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    from jsonargparse import ArgumentParser
    parser = ArgumentParser(prog="python -m training.train", description=__doc__)
    parser.add_argument("--config", action="config", help="YAML file with the fields of TrainingConfig")
    parser.add_class_arguments(TrainingConfig)
    options = parser.instantiate_classes(parser.parse_args(arguments))
    config = TrainingConfig(**{field.name: options[field.name] for field in dataclasses.fields(TrainingConfig)})
    try:
        weights = train(config)
    except InputError as error:
        print(f"training.train: error: {error}", file=sys.stderr)
        return 2
    if weights is not None:
        print(f"weights: {weights}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
