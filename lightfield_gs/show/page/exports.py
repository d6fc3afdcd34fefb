"""What the page saves: each function writes one file of the scene as it is steered."""

from __future__ import annotations

import json
from collections.abc import Callable
from functools import partial
from importlib.metadata import version
from pathlib import Path

from lightfield_gs.io.images import write_image
from lightfield_gs.show.page.controls import Controls
from lightfield_gs.show.page.stage import Stage


def exports(stage: Stage) -> dict[str, Callable[[Controls, Path], None]]:
    """By the name of the file, what writes it to a path."""
    return {"native.png": partial(_native, stage), "rig.yaml": partial(_rig, stage)}


def _native(stage: Stage, controls: Controls, path: Path) -> None:
    """The native picture, with the panel and the rig in it, as `encode` writes them: `simulate` and `show` read it."""
    image, _ = stage.native(controls)
    encoding = {
        "method": "direct",
        "views": "integer",
        "background": list(stage.background),
        "quality": controls.quality,
        **({"antialiased": True} if stage.antialiased else {}),
    }
    metadata = {
        "software": f"lightfield-gs {version('lightfield-gs')}",
        "input": stage.name,
        "panel": json.dumps(stage.panel.to_dict()),
        "rig": json.dumps(stage.rig_of_file(controls).to_dict()),
        "encoding": json.dumps(encoding),
    }
    write_image(path, image, metadata)


def _rig(stage: Stage, controls: Controls, path: Path) -> None:
    """The cameras, for `--rig`, in the axes of the scene's file."""
    stage.rig_of_file(controls).to_yaml(path)
