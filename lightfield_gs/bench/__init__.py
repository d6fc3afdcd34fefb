"""Benchmarks: scenes, methods and peers, timing, tables; `lightfield-gs bench` runs them."""
