"""Benchmarks by name: those of the package, and those that a checkout alone has."""

import pytest
from command_line import complaint

from lightfield_gs import cli
from lightfield_gs.base.errors import InputError
from lightfield_gs.bench import benchmarks


@pytest.mark.parametrize("name", benchmarks.BENCHMARKS)
def test_every_benchmark_is_in_a_checkout(name):
    module = benchmarks.load(name)
    assert callable(module.add_arguments) and callable(module.run)


def test_without_a_checkout_a_line_says_where_a_benchmark_is(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(benchmarks, "_CHECKOUT", tmp_path)
    for words in ("paper", "paper --scene sheet:8 --json rows.json", "fit photographs --steps 10"):
        assert "clone the repository" in complaint(capsys, f"bench {words}")
    assert cli.main("bench dense --gaussians 50 --size 16x16 --repeats 1".split()) == 0
    assert "16 x 16 px" in capsys.readouterr().out
    with pytest.raises(InputError, match="clone the repository"):
        benchmarks.load_from_checkout("peers")
