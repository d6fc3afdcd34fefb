"""The guided page of a calibration in a headless Chromium: its pattern, its keys, and the profile that it saves."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from chromium import Browser
from command_line import PANEL, run
from test_page import serving

from lightfield_gs.commands.calibrate_page import PageOptions, lens_guide
from lightfield_gs.commands.options.serving import ServingOptions
from lightfield_gs.panels.lens_change import LensChange, changed
from lightfield_gs.panels.panel import Panel
from lightfield_gs.panels.patterns import sweep

pytestmark = pytest.mark.not_sanitized
WIDE = replace(PANEL, width_px=480, height_px=300, views=48)
CELLS = (((-0.2, 0.1), (0.1, 0.2), (0.3, -0.2)), ((0.2, -0.1), (0.0, 0.2), (-0.3, -0.1)))


def press(page: Browser, *keys: str) -> None:
    for key in keys:
        for kind in ("rawKeyDown", "keyUp"):
            page.call("Input.dispatchKeyEvent", type=kind, key=key)


def drawn(page: Browser) -> np.ndarray:
    """The pattern, uint8 [H, W, 3]."""
    got = page.run("""(() => {
      const canvas = document.querySelector("canvas"), { width, height } = canvas;
      return { width, data: [...canvas.getContext("2d").getImageData(0, 0, width, height).data] };
    })()""")
    return np.array(got["data"], np.uint8).reshape(-1, got["width"], 4)[..., :3]


@pytest.mark.parametrize(
    "panel", [WIDE, replace(WIDE, subpixel_order="BGR"), replace(WIDE, subpixel_cells=CELLS, cell_pattern=1)]
)
def test_keys_move_the_lens_and_what_is_saved_has_a_way_back(tmp_path, capsys, panel):
    profile, path = tmp_path / "p.yaml", tmp_path / "new.yaml"
    panel.to_yaml(profile)
    panel = Panel.load(profile)
    guide = lens_guide(PageOptions(str(profile), path, ServingOptions()), panel, Path(path))
    page = Browser(tmp_path, 1000, 800)
    try:
        with serving(guide.routes()) as server:
            page.open(server.url)
            page.wait("document.querySelector('canvas')?.dataset.drawn")
            assert "One colour from left to right" in page.run("document.body.innerText")
            assert page.run("document.querySelector('#save').disabled")
            press(
                page,
                "ArrowRight",
                "ArrowRight",
                "ArrowLeft",
                "ArrowUp",
                "ArrowRight",
                "2",
                "ArrowLeft",
                "u",
                "ArrowRight",
            )
            page.wait("document.querySelector('canvas').dataset.drawn.startsWith('{\"pitch\":0.4,\"slope\":1,')")
            moved = changed(panel, LensChange(pitch_percent=0.4, slope_percent=1))
            off = np.abs(drawn(page).astype(int) - sweep(moved))
            assert (off > 8).mean() < 0.05  # a table of colours has 1024 entries
            assert np.abs(drawn(page).astype(int) - sweep(panel)).mean() > 5 * off.mean()
            press(page, "s")
            page.wait("document.querySelector('#saved').textContent.includes('calibrate undo')")
            assert Panel.load(path).line_number == pytest.approx(moved.line_number, rel=1e-12)
            press(page, "1", "ArrowUp", "ArrowRight", "ArrowRight")
            page.wait("document.querySelector('#warning').textContent.includes('pitch changes by')", 10)
    finally:
        page.close()
    assert "pitch by +0.4 %, slope by +1 %" in run(capsys, f"calibrate history {path}")
