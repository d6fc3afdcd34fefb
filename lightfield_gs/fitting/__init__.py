"""Fitting: a scene of Gaussians optimised from photographs with known cameras (Kerbl et al. 2023).

DefaultStrategy and MCMCStrategy control the density in a training loop of one's own, see strategies.py; set_rows and
take_rows are what other strategies are made of. SelectiveAdam moves the rows that a step has seen.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from lightfield_gs.fitting.parameter_rows import set_rows, take_rows
    from lightfield_gs.fitting.selective_adam import SelectiveAdam
    from lightfield_gs.fitting.strategies import DefaultStrategy, MCMCStrategy

__all__ = ["DefaultStrategy", "MCMCStrategy", "SelectiveAdam", "set_rows", "take_rows"]


if not TYPE_CHECKING:

    def __getattr__(name: str) -> Any:
        if name not in __all__:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        from lightfield_gs.fitting import parameter_rows, selective_adam, strategies

        homes = parameter_rows, selective_adam, strategies
        return next(vars(home)[name] for home in homes if name in vars(home))
