"""How the words of a command line are parsed, wherever they come from."""

from __future__ import annotations

import argparse
from collections.abc import Iterable
from typing import NoReturn

from lightfield_gs.base.errors import InputError

# Options whose values may begin with a minus sign
_VECTOR_OPTIONS: tuple[str, ...] = ("--eye", "--eyes", "--background", "--depth-range", "--intrinsics", "--up", "--pan")
_VECTOR_OPTIONS += ("--shift", "--corners")
_VECTOR_OPTIONS += tuple(f"--{what}-by" for what in ("pitch", "slope", "centre", "line-number", "slant", "phase"))


class Parser(argparse.ArgumentParser):
    """Complains in one line."""

    def error(self, message: str) -> NoReturn:
        raise InputError(f"{message}; see {self.prog} --help")


def joined(arguments: Iterable[str]) -> list[str]:
    """`--eye -5,0,600` as `--eye=-5,0,600`: argparse takes the value for an option otherwise."""
    out: list[str] = []
    for argument in arguments:
        if out and out[-1] in _VECTOR_OPTIONS:
            out[-1] += f"={argument}"
        else:
            out.append(argument)
    return out
