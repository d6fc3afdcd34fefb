"""Names and numbers that options and measurements of benchmarks share."""

from __future__ import annotations

from lightfield_gs.base.options import METHODS

NAMED_CONES = ("narrow", "wide")
ORACLE_SAMPLES = 20_000
GSPLAT = "gsplat-classic"  # a peer, by benchmarks/peers.py
BENCH_METHODS = (*METHODS, GSPLAT)
LIGHT_FIELD_SCENES, LIGHT_FIELD_METHODS = ("sheet:128",), ("direct",)
