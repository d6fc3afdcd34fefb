"""Fitting: a scene of Gaussians optimised from photographs with known cameras (Kerbl et al. 2023).

`lightfield_gs.fit` is also the public function of that name, fit.fit: once any file of this room is imported, Python
lets the name stand for the room. So the room can be called.
"""

from __future__ import annotations

import sys
from types import ModuleType
from typing import Any


class _Room(ModuleType):
    def __call__(self, *args: Any, **options: Any) -> Any:
        from lightfield_gs.fit.fit import fit

        return fit(*args, **options)


sys.modules[__name__].__class__ = _Room
