"""Operations in a row made one kernel, where a run asks for it."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import TypeVar

import torch

Function = TypeVar("Function", bound=Callable)


def fused(function: Function, wanted: bool) -> Function:
    """A function of the module's own, if wanted as torch.compile makes it for each set of shapes that it meets."""
    return _compiled(function) if wanted else function


@cache
def _compiled(function: Function) -> Function:
    return torch.compile(function, dynamic=False)
