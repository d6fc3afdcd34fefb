"""docs/examples: each runs, does what docs/examples.md says of it, and draws the picture that is stored."""

import re
import runpy

import numpy as np
import pytest
import torch
from documents import ROOT, blocks, links
from PIL import Image

pytestmark = [pytest.mark.slow, pytest.mark.not_sanitized]  # what they call is tested where it belongs
FOLDER, PAGE = ROOT / "docs/examples", ROOT / "docs/examples.md"
STEPS_DB = r"(-?[\d.]+) dB"
# Name -> pattern of the numbers that it prints, and what must hold for them
CLAIMS = {
    "fit_light_field": (STEPS_DB, lambda steps: 12 < steps[0] < 14 and steps[-1] > 28),
    "calibrate_by_gradient": (
        r"off by (\S+) before, by (\S+) after",
        lambda lens: len(lens) == 3 and all(after < before / 200 for before, after in lens),
    ),
    "distil_features": (r"union ([\d.]+)", lambda found: found[0] > 0.85),
    "own_density": (STEPS_DB, lambda fits: fits[0] > 32 and fits[1] > fits[0] + 4),
}


def stored_picture(name: str) -> str:
    return f"pictures/example-{name.replace('_', '-')}.webp"


@pytest.mark.parametrize("name", CLAIMS)
def test_example_does_what_the_page_says(name, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    random = torch.get_rng_state()
    runpy.run_path(str(FOLDER / f"{name}.py"))
    torch.set_rng_state(random)
    pattern, holds = CLAIMS[name]
    said = capsys.readouterr().out
    numbers = [[float(number) for number in np.atleast_1d(found)] for found in re.findall(pattern, said)]
    assert holds([one[0] if len(one) == 1 else one for one in numbers]), said
    drawn, stored = (Image.open(path) for path in (f"{name}.webp", ROOT / "docs" / stored_picture(name)))
    assert drawn.size == stored.size
    difference = np.asarray(drawn.convert("RGB"), float) - np.asarray(stored.convert("RGB"))
    assert np.abs(difference).mean() < 4, "docs/pictures has another picture"


def test_every_example_is_on_the_page_with_its_picture():
    files = {path.relative_to(ROOT).as_posix() for path in FOLDER.glob("*.py")}
    assert files == {block.included for block in blocks(PAGE)} == {f"docs/examples/{name}.py" for name in CLAIMS}
    assert {stored_picture(name) for name in CLAIMS} <= set(links(PAGE))
