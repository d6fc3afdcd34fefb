"""gsplat's interface over this rasterizer: change one import of a program that uses gsplat 1.5.

`rasterization` has gsplat's arguments, shapes and names. Images, alphas and gradients are those of `render`. Arguments
that change a result and have no counterpart here are refused by name; docs/gsplat.md has the table.

Source of the interface: Ye et al., "gsplat: An Open-Source Library for Gaussian Splatting", JMLR 2025; version 1.5.3.
"""

from lightfield_gs.fitting.selective_adam import SelectiveAdam
from lightfield_gs.fitting.strategies import DefaultStrategy, MCMCStrategy
from lightfield_gs.gsplat.interface import rasterization

__all__ = ["DefaultStrategy", "MCMCStrategy", "SelectiveAdam", "rasterization"]
