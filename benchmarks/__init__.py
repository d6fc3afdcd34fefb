"""Benchmarks beside other programs and of whole fits, which `lightfield-gs bench` runs in a checkout."""
