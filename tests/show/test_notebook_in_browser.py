"""A notebook that a kernel has run, in Chromium: scenes, panels, rigs and images show themselves, and turn."""

import os
from pathlib import Path

import numpy as np
import pytest
from chromium import Browser, find

from lightfield_gs.models.splatter_net import PRETRAINED

pytestmark = [
    pytest.mark.not_sanitized,
    pytest.mark.slow,
    pytest.mark.long_file,
]  # a sanitizer that is loaded before a browser stops it
ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    """A Chromium that shows quickstart.ipynb, run anew, as nbconvert exports it."""
    find()
    pytest.importorskip("ipykernel")
    nbformat, nbconvert = pytest.importorskip("nbformat"), pytest.importorskip("nbconvert")
    if not PRETRAINED.is_file():
        pytest.skip("this checkout has no trained checkpoint")
    folder = tmp_path_factory.mktemp("notebook")
    notebook = nbformat.read(ROOT / "notebooks/quickstart.ipynb", as_version=4)
    for cell in notebook.cells:
        if cell.cell_type == "code":
            cell.outputs = []
    path = os.pathsep.join([str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])])
    with pytest.MonkeyPatch.context() as patched:
        patched.setenv("PYTHONPATH", path)  # for the kernel
        run = nbconvert.preprocessors.ExecutePreprocessor(timeout=300, kernel_name="python3")
        run.preprocess(notebook, {"metadata": {"path": str(folder)}})
    body, _ = nbconvert.HTMLExporter(template_name="basic").from_notebook_node(notebook)
    (folder / "page.html").write_text(f"<!doctype html><meta charset=utf-8><body>{body}", encoding="utf-8")
    browser = Browser(folder, 900, 900)
    try:
        browser.open((folder / "page.html").as_uri())
        browser.wait("document.readyState === 'complete' && document.querySelectorAll('figure').length")
        yield browser
    finally:
        browser.close()


FIGURES = "[...document.querySelectorAll('figure')]"


def test_everything_shows_itself_with_its_facts(page):
    facts = page.run(f"{FIGURES}.map((f) => f.querySelector('figcaption').textContent)")
    begins = ["toy-8v: 480 x 240 px", "Gaussians(", "Rig: centre camera", "8 images, 480 x 240 px", "Gaussians("]
    assert len(facts) == len(begins) and all(map(str.startswith, facts, begins)), facts
    assert page.run(f"{FIGURES}.every((f) => f.querySelector('img').naturalWidth >= 400)")
    sizes = page.run(f"{FIGURES}.map((f) => f.outerHTML.length)")
    assert max(sizes) <= 300_000, sizes


def test_pictures_turn_with_the_slider_and_the_mouse(page):
    inside = f"{FIGURES}[1].querySelector('iframe').contentDocument"
    page.run(f"{FIGURES}[1].scrollIntoView()")
    page.wait(f"{inside}.querySelector('canvas')?.dataset.view")
    count = page.run(f"JSON.parse({inside}.querySelector('#views').textContent).frames.length")
    assert page.run(f"{inside}.querySelector('canvas').dataset.view") == str(count // 2)  # rests in front
    left, top, width, height = page.run(
        f"(() => {{ const b = {FIGURES}[1].querySelector('iframe').getBoundingClientRect();"
        " return [b.left, b.top, b.width, b.height]; })()"
    )
    seen = []
    for share in (0.02, 0.3):
        page.mouse("mouseMoved", left + share * width, top + height / 3)
        page.wait(f"{inside}.querySelector('canvas').dataset.view == {round(share * (count - 1))}")
        seen.append(page.screenshot()[round(top) : round(top + height / 2), round(left) : round(left + width)])
    assert np.abs(seen[0].astype(int) - seen[1]).max(-1).mean() > 2
    page.run(
        f"(() => {{ const s = {inside}.querySelector('input'); s.value = 1; s.dispatchEvent(new Event('input')); }})()"
    )
    assert page.run(f"{inside}.querySelector('canvas').dataset.view") == str(count - 1)
