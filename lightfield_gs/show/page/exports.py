"""The files that the page of a scene saves."""

from __future__ import annotations

import json
from collections.abc import Callable
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any
from urllib.parse import quote

from lightfield_gs.encoding.quilt import quilt
from lightfield_gs.io.atomic import scratch_folder
from lightfield_gs.io.images import write_image
from lightfield_gs.io.stereo_names import stereo_paths
from lightfield_gs.panels.quilt import QuiltLayout, panel_quilt
from lightfield_gs.panels.stereo_screen import eye_geometry
from lightfield_gs.show.page.lines import Lines
from lightfield_gs.show.page.server import Answer, Query, Reservation, Route
from lightfield_gs.show.page.stage import Controls, Stage
from lightfield_gs.show.page.stereo_stage import StereoStage

Exports = dict[str, Callable[[Controls, Path], None]]


def exports(stage: Stage) -> Exports:
    """Return functions that write a file to a path, by the file's name."""
    pictures: Exports
    if isinstance(stage, StereoStage):
        pictures = {stereo_paths(Path("eyes.png"), stage.layout)[0].name: partial(_eyes, stage)}
    elif stage.is_tracked:
        pictures = {}  # for eyes that are elsewhere by then
    else:
        layout = panel_quilt(stage.panel)
        pictures = {"native.png": partial(_native, stage), f"quilt{layout.suffix}.png": partial(_quilt, stage, layout)}
    return {
        **pictures,
        # In the axes of the scene's file
        "rig.yaml": lambda controls, path: stage.rig_of_file(controls).to_yaml(path, stage.panel),
    }


def export_routes(stage: Stage, exports: Exports, lines: Lines) -> dict[str, Route]:
    """Return the addresses from which a browser saves these files."""

    def saved(name: str, query: Query) -> Answer:
        controls = Controls.of(query)
        with scratch_folder() as folder:
            path = folder / name
            lines.last(partial(exports[name], controls, path))
            own = quote(saved_name(stage.name, name))
            kept = {"Content-Disposition": f"attachment; filename*=UTF-8''{own}"}
            return Answer(path.read_bytes(), "application/octet-stream", headers=kept)

    return {f"/export/{name}": Route(partial(saved, name), place=lambda query: Reservation(True)) for name in exports}


def saved_name(scene: str, name: str) -> str:
    """Return the name of a file of a scene: cat-3d.png, cat_qs8x6a0.75.png and cat.rig.yaml of cat.jpg."""
    stem = Path(scene).stem
    if name == "native.png":
        return f"{stem}-3d.png"
    own = name.removeprefix("quilt").removeprefix("eyes")
    return f"{stem}{own}" if own != name else f"{stem}.{name}"


def _native(stage: Stage, controls: Controls, path: Path) -> None:
    """Write the native picture with the panel and the rig, as `encode` does: `simulate` and `show` read it."""
    image, _ = stage.native(controls)
    drawn = stage.drawn_as(controls)
    encoding: dict[str, Any] = {"method": "direct", "views": "integer", "background": list(drawn["background"])}
    encoding |= {"quality": controls.quality, **({"antialiased": True} if drawn["antialiased"] else {})}
    encoding |= {"view_filter": drawn["view_filter"]} if drawn["view_filter"] else {}
    made_by = {"panel": stage.panel.to_dict(), "rig": stage.rig_of_file(controls).to_dict(), "encoding": encoding}
    write_image(path, image, {**_origin(stage), **{name: json.dumps(value) for name, value in made_by.items()}})


def _eyes(stage: StereoStage, controls: Controls, path: Path) -> None:
    """Write the picture of both eyes, as `encode --stereo` does."""
    stereo = {"layout": stage.layout, **eye_geometry(stage.panel, stage.rig_of_file(controls))}
    write_image(path, stage.native(controls)[0], {**_origin(stage), "stereo": json.dumps(stereo)})


def _quilt(stage: Stage, layout: QuiltLayout, controls: Controls, path: Path) -> None:
    """Write all views of the panel as a quilt, for `weave` and for Looking Glass's own programs."""
    panel, rig = layout.fitted(stage.panel, controls.rig(stage.base, stage.panel))
    image = quilt(stage.shown(controls), layout, rig, panel, **stage.drawn_as(controls))
    write_image(path, image.cpu().numpy(), _origin(stage))


def _origin(stage: Stage) -> dict[str, str]:
    return {"software": f"lightfield-gs {version('lightfield-gs')}", "input": stage.name}
