"""Train the network: `python -m training.train --config configs/training/cpu.yaml [--seed 1 ...]`.

Every field of TrainingConfig is an option that overrides the file. Running the same command again resumes the run.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import sys
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from lightfield_gs.base.errors import InputError
from lightfield_gs.base.torchrun import see_own_gpu
from training.command import with_line_errors
from training.config import TrainingConfig
from training.loop import train

if TYPE_CHECKING:
    from jsonargparse import ArgumentParser, Namespace


def read_config(arguments: list[str] | None = None) -> TrainingConfig:
    """The configuration that command-line arguments describe. Raises InputError when they describe none."""
    from jsonargparse import ArgumentParser

    parser = ArgumentParser(prog="python -m training.train", description=__doc__, exit_on_error=False)
    return parse(parser, arguments)[0]


def parse(parser: ArgumentParser, arguments: list[str] | None) -> tuple[TrainingConfig, Namespace]:
    """Return the configuration that command-line arguments describe, and the values of the parser's own options.

    Args:
        parser: Gets --config and an option for every field of TrainingConfig.

    Raises:
        InputError: an argument is bad.
    """
    parser.add_argument("--config", action="config", help="YAML file with options")
    options = _instantiated(parser, lambda: parser.parse_args(arguments))
    return _config(options), options


def overlaid(config: TrainingConfig, changes: dict[str, Any]) -> TrainingConfig:
    """Return a configuration with other values of some fields; of a nested group of fields only those named change.

    Raises:
        InputError: there is no such field, or it cannot have the value.
    """
    from jsonargparse import ArgumentParser

    parser = ArgumentParser(exit_on_error=False)
    values = _merged(json.loads(json.dumps(dataclasses.asdict(config))), changes)
    return _config(_instantiated(parser, lambda: parser.parse_object(values)))


def _merged(values: dict[str, Any], changes: dict[str, Any]) -> dict[str, Any]:
    """Return values with changes, also in dictionaries inside."""
    inside = {
        name: _merged(values[name], value)
        for name, value in changes.items()
        if isinstance(value, dict) and isinstance(values.get(name), dict)
    }
    return values | changes | inside


def _instantiated(parser: ArgumentParser, parsed: Callable[[], Namespace]) -> Namespace:
    """Add the fields of TrainingConfig to a parser, let it parse, and build the parts of the configuration."""
    parser.add_class_arguments(TrainingConfig)
    instantiate = getattr(parser, "instantiate", None) or parser.instantiate_classes  # renamed in jsonargparse 4.49
    try:
        return instantiate(parsed())
    except argparse.ArgumentError as error:
        message = " ".join(str(error).split())
        if "arms." in message:
            message += ": a configuration of several arms is for python -m training.compare"
        raise InputError(message) from None


def _config(options: Namespace) -> TrainingConfig:
    return TrainingConfig(**{field.name: options[field.name] for field in dataclasses.fields(TrainingConfig)})


@with_line_errors("training.train")
def main(arguments: list[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    see_own_gpu()
    weights = train(read_config(arguments))
    if weights is not None:
        print(f"weights: {weights}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
