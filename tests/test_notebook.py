"""The notebook runs from its first cell to its last."""

import json
from pathlib import Path

import pytest

NOTEBOOK = Path(__file__).resolve().parents[1] / "notebooks" / "quickstart.ipynb"


def test_quickstart_runs(capsys):
    import matplotlib

    from lightfield_gs.models.splatter_net import PRETRAINED

    if not PRETRAINED.is_file():
        pytest.skip(f"no checkpoint at {PRETRAINED}")
    matplotlib.use("Agg")
    cells = json.loads(NOTEBOOK.read_text(encoding="utf-8"))["cells"]
    names: dict[str, object] = {}
    for cell in cells:
        if cell["cell_type"] == "code":
            assert cell["outputs"] == []
            exec(compile("".join(cell["source"]), cell["id"], "exec"), names)
    matplotlib.pyplot.close("all")
    shown = capsys.readouterr().out
    assert "largest difference: 0 of 255" in shown or "largest difference: 1 of 255" in shown
    assert float(shown.split("largest error: ")[1].split()[0]) < 1
