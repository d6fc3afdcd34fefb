"""Operations in a row made one kernel, where a run asks for it."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import TypeVar, cast

import torch

Function = TypeVar("Function", bound=Callable)


def fused(function: Function, wanted: bool, dynamic: bool = False) -> Function:
    """A function of the module's own, if wanted as torch.compile makes it.

    Args:
        dynamic: Make it once for all shapes, not for each set of shapes that it meets.
    """
    return cast(Function, _compiled(function, dynamic)) if wanted else function


@cache
def _compiled(function: Callable, dynamic: bool) -> Callable:
    return torch.compile(function, dynamic=dynamic)
