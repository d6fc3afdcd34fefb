"""The notebooks run from first cell to last, show what they promise, and keep to names that are public."""

import ast
import json
import math
import re
from pathlib import Path
from typing import Any

import pytest

import lightfield_gs
from lightfield_gs.models.splatter_net import PRETRAINED

# What notebooks call is tested where it belongs, and under the sanitizers there
pytestmark = pytest.mark.not_sanitized


FOLDER = next(folder for folder in Path(__file__).resolve().parents if (folder / "notebooks").is_dir()) / "notebooks"
NOTEBOOKS = ("quickstart", "research", "calibration")
MOST_BYTES = 1_500_000  # with the pictures that are stored


def code_cells(name: str) -> list[dict[str, Any]]:
    cells = json.loads((FOLDER / f"{name}.ipynb").read_text(encoding="utf-8"))["cells"]
    return [cell for cell in cells if cell["cell_type"] == "code"]


def run(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    matplotlib = pytest.importorskip("matplotlib")
    monkeypatch.chdir(FOLDER)
    matplotlib.use("Agg")
    names: dict[str, object] = {}
    for cell in code_cells(name):
        exec(compile("".join(cell["source"]), cell["id"], "exec"), names)
    matplotlib.pyplot.close("all")


def numbers(pattern: str, shown: str) -> list[float]:
    """Return the groups of all matches of the pattern."""
    found = re.findall(pattern, shown)
    return [float(value) for groups in found for value in ([groups] if isinstance(groups, str) else groups)]


@pytest.mark.skipif(not PRETRAINED.is_file(), reason="this checkout has no trained checkpoint")
def test_quickstart_runs(capsys, monkeypatch):
    run("quickstart", monkeypatch)
    shown = capsys.readouterr().out
    assert max(numbers(r"largest difference: (\d+) of 255", shown)) <= 1
    assert max(numbers(r"largest error: (\S+) of 255", shown)) < 1


def test_research_runs(capsys, monkeypatch):
    run("research", monkeypatch)
    shown = capsys.readouterr().out
    differences = numbers(r"by hand by (\S+) of 255", shown)
    assert len(differences) == 3 and max(differences) < 0.1
    assert max(numbers(r"float64  largest error (\S+) of 255", shown)) < 1e-9
    assert max(numbers(r"exact    largest error ([\d.]+)", shown)) < 0.01
    gradients = numbers(r"relative difference (\S+)", shown)
    assert len(gradients) == 5 and max(gradients) < 1e-10
    angle, wanted, before, after = numbers(r"angle (\S+) wanted (\S+); loss (\S+) -> (\S+)", shown)
    assert math.isclose(angle, wanted, abs_tol=0.02) and after < 1e-3 * before
    first, last = numbers(r"PSNR of the light-field image: (\S+) -> (\S+) dB", shown)
    assert last > first + 15
    assert max(numbers(r"lightfield_gs  largest error (\S+) of 255", shown)) < 0.01


def test_calibration_runs(capsys, monkeypatch):
    run("calibration", monkeypatch)
    shown = capsys.readouterr().out
    before, after = numbers(r"worst corner: (\S+) views -> (\S+)", shown)
    assert before > 5 and after < 0.05
    rows = numbers(r"(\S+) v +\S+ +\S+ +(\S+) v", shown)
    assert len(rows) == 10 and all(after < 0.1 * before for before, after in zip(rows[::2], rows[1::2]))
    before, after = numbers(r"through encode: (\S+) views -> (\S+)", shown)
    assert before > 1 and after < 0.05


@pytest.mark.parametrize("name", NOTEBOOKS)
def test_outputs_are_stored_as_of_one_run(name):
    assert (FOLDER / f"{name}.ipynb").stat().st_size < MOST_BYTES
    cells = code_cells(name)
    assert [cell["execution_count"] for cell in cells] == list(range(1, len(cells) + 1))
    kinds = {output["output_type"] for cell in cells for output in cell["outputs"]}
    assert {"stream", "display_data"} <= kinds <= {"stream", "display_data", "execute_result"}
    assert not any(output.get("name") == "stderr" for cell in cells for output in cell["outputs"])


@pytest.mark.parametrize("name", NOTEBOOKS)
def test_only_public_names_are_used(name):
    tree = ast.parse("\n".join("".join(cell["source"]).rstrip(";") for cell in code_cells(name)))
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and node.module.startswith("lightfield_gs"):
            taken = {alias.name for alias in node.names}
            assert node.module == "lightfield_gs.reference" or node.module == "lightfield_gs" and taken == {"reference"}
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id == "lf":
            assert node.attr in (*lightfield_gs.__all__, "__file__")
