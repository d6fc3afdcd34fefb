"""The cases that tests/compare_installs.py runs with two installs of lightfield_gs.

They import what any version has: the public names, torch.ops.lightfield_gs and the command lines; never a module of the
package by its path, nor a helper of the tests, which does.
"""
