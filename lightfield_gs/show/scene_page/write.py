"""The page of a scene as one file: its Gaussians, the panel, the stages in WGSL, and what drives them."""

from __future__ import annotations

import base64
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lightfield_gs.io.atomic import atomic_path
from lightfield_gs.panels.panel import Panel
from lightfield_gs.panels.rig import Rig
from lightfield_gs.scene.gaussians import Gaussians, from_arrays
from lightfield_gs.show.browser_data import host_tables, rig_numbers
from lightfield_gs.show.preview import look_around, strip
from lightfield_gs.show.scene_page.packing import PackedGaussians, pack, unpack
from lightfield_gs.show.scripts import filled, joined, json_in_page

_FILES = Path(__file__).parent / "files"
# Views for browsers without WebGPU: few and small, for most readers do without them
_STRIP_FRAMES, _STRIP_PIXELS, _STRIP_QUALITY = 15, 720 * 360, 60
UPRIGHT_PX = 1080, 1920  # of a screen that is higher than wide


@dataclass(frozen=True)
class DrawnAs:
    """How a scene is drawn, see `encode`."""

    background: tuple[float, float, float] = (1.0, 1.0, 1.0)
    antialiased: bool = False
    view_filter: float = 0.0


@dataclass(frozen=True)
class ScenePage:
    """A page that was written.

    Attributes:
        packed: Its Gaussians.
        shown: The same as it draws them.
        size: Bytes of the file.
    """

    packed: PackedGaussians
    shown: Gaussians
    size: int


def write_scene_page(
    path: str | Path,
    title: str,
    gaussians: Gaussians,
    panel: Panel,
    rig: Rig,
    drawn_as: DrawnAs,
    is_photo: bool,
    is_for_panel: bool,
    upright_rig: Rig | None = None,
) -> ScenePage:
    """Write a page that draws a scene in the browser; it is one file and loads nothing.

    Args:
        path: The file.
        title: Of the page.
        gaussians: One scene, on the CPU or on CUDA.
        panel: The panel that the rig is for.
        rig: Its cameras, in the coordinates of the Gaussians.
        drawn_as: How the scene is drawn.
        is_photo: Whether the scene is seen from in front alone.
        is_for_panel: Whether the page draws for this panel; else for the one of a visual.json that is dropped on it.

        upright_rig: Cameras for ordinary screens that are higher than wide, of UPRIGHT_PX. None: those of the panel.

    Raises:
        InputError: The file cannot be written.
    """
    packed = pack({name: value.detach().cpu().double().numpy() for name, value in gaussians.fields().items()})
    cone_deg = panel.cone_deg if rig.cone_deg is None else rig.cone_deg
    shown = from_arrays(unpack(packed), gaussians.origin).to(gaussians.device)
    red, green, blue = (round(255 * part) for part in drawn_as.background)
    page = {
        "title": title,
        "gaussians": packed.header(),
        "panel": panel.to_dict() if is_for_panel else None,
        "rig": rig_numbers(rig, (panel.width_px, panel.height_px)),
        "upright_rig": None if upright_rig is None else rig_numbers(upright_rig, UPRIGHT_PX),
        "cone_deg": cone_deg,
        "reach_deg": cone_deg / 2 if is_photo else None,
        "background": drawn_as.background,
        "antialiased": drawn_as.antialiased,
        "view_filter": drawn_as.view_filter,
        "ground": f"rgb({red} {green} {blue})",
        "strip": {**_strip(shown, panel, rig, drawn_as), "reach_deg": cone_deg / 2},
        "host": host_tables(),
    }
    text = filled(
        _FILES / "scene.html",
        {
            "style": (_FILES / "scene.css").read_text(encoding="utf-8"),
            "scene": json_in_page(page),
            "gaussians": base64.b64encode(packed.data).decode(),
            "script": joined(_FILES / "main.js"),
        },
    )
    data = text.encode()
    with atomic_path(path) as temporary:
        temporary.write_bytes(data)
    return ScenePage(packed, shown, len(data))


def _strip(gaussians: Gaussians, panel: Panel, rig: Rig, drawn_as: DrawnAs) -> dict[str, Any]:
    """Return views for browsers that cannot draw the scene."""
    options = drawn_as.background, drawn_as.antialiased, drawn_as.view_filter
    return strip(look_around(gaussians, panel, rig, *options, _STRIP_FRAMES, _STRIP_PIXELS), _STRIP_QUALITY)
