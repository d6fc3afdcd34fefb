"""Fitting: a scene of Gaussians optimised from photographs with known cameras (Kerbl et al. 2023).

DefaultStrategy and MCMCStrategy control the density in a training loop of one's own, see strategies.py; set_rows and
take_rows are what other strategies are made of.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from lightfield_gs.fitting.parameter_rows import set_rows, take_rows
    from lightfield_gs.fitting.strategies import DefaultStrategy, MCMCStrategy

__all__ = ["DefaultStrategy", "MCMCStrategy", "set_rows", "take_rows"]


if not TYPE_CHECKING:

    def __getattr__(name: str) -> Any:
        if name not in __all__:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        from lightfield_gs.fitting import parameter_rows, strategies

        return getattr(strategies if name.endswith("Strategy") else parameter_rows, name)
