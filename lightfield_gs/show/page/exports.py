"""What the page saves: each function writes one file of the scene as it is steered."""

from __future__ import annotations

import json
from collections.abc import Callable
from functools import partial
from importlib.metadata import version
from pathlib import Path

from lightfield_gs.encoding.quilt import quilt
from lightfield_gs.io.images import write_image
from lightfield_gs.panels.quilt import QuiltLayout, panel_quilt
from lightfield_gs.show.page.controls import Controls
from lightfield_gs.show.page.stage import Stage


def exports(stage: Stage) -> dict[str, Callable[[Controls, Path], None]]:
    """By the name of the file, what writes it to a path."""
    layout = panel_quilt(stage.panel)
    return {
        "native.png": partial(_native, stage),
        f"quilt{layout.suffix}.png": partial(_quilt, stage, layout),
        "rig.yaml": partial(_rig, stage),
    }


def _native(stage: Stage, controls: Controls, path: Path) -> None:
    """The native picture, with the panel and the rig in it, as `encode` writes them: `simulate` and `show` read it."""
    image, _ = stage.native(controls)
    encoding = {
        "method": "direct",
        "views": "integer",
        "background": list(stage.background),
        "quality": controls.quality,
        **({"antialiased": True} if stage.antialiased else {}),
        **({"view_filter": stage.view_filter} if stage.view_filter else {}),
    }
    made_by = {"panel": stage.panel.to_dict(), "rig": stage.rig_of_file(controls).to_dict(), "encoding": encoding}
    write_image(path, image, {**_origin(stage), **{name: json.dumps(value) for name, value in made_by.items()}})


def _quilt(stage: Stage, layout: QuiltLayout, controls: Controls, path: Path) -> None:
    """All views of the panel as a quilt, for `weave` and for Looking Glass's own programs."""
    panel, rig = layout.fitted(stage.panel, controls.rig(stage.base, stage.panel))
    image = quilt(
        stage.gaussians,
        layout,
        rig,
        panel,
        background=stage.background,
        antialiased=stage.antialiased,
        view_filter=stage.view_filter,
    )
    write_image(path, image.cpu().numpy(), _origin(stage))


def _origin(stage: Stage) -> dict[str, str]:
    return {"software": f"lightfield-gs {version('lightfield-gs')}", "input": stage.name}


def _rig(stage: Stage, controls: Controls, path: Path) -> None:
    """The cameras, for `--rig`, in the axes of the scene's file."""
    stage.rig_of_file(controls).to_yaml(path)
