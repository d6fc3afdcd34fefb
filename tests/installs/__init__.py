"""The cases that tests/compare_installs.py runs with two installs of lightfield_gs.

They use what every version has: the public names, torch.ops.lightfield_gs and the command lines. They import no module
of the package by its path, and no helper of the tests, since helpers do.
"""
