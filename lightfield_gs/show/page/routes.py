"""The routes of the two pages: one steers a scene, the other is the panel's own."""

from __future__ import annotations

import itertools
import json
import secrets
import threading
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from lightfield_gs.base.errors import InputError
from lightfield_gs.base.options import QUALITY_NAMES
from lightfield_gs.encoding.quilt import quilt
from lightfield_gs.io.atomic import scratch_folder
from lightfield_gs.io.images import write_image
from lightfield_gs.io.stereo_names import stereo_paths
from lightfield_gs.panels.panel import Panel
from lightfield_gs.panels.quilt import QuiltLayout, panel_quilt
from lightfield_gs.panels.simulate import missing_geometry
from lightfield_gs.panels.stereo_screen import eye_geometry
from lightfield_gs.show.page.drawing import drawing_routes
from lightfield_gs.show.page.server import (
    Answer,
    Query,
    Reservation,
    Route,
    Superseded,
    as_json,
    number,
    page_file,
    text,
)
from lightfield_gs.show.page.stage import Controls, Picture, Stage
from lightfield_gs.show.page.stereo_stage import StereoStage
from lightfield_gs.show.preview import image_bytes

_JPEG_QUALITY = 85
_WAIT_S = 10.0  # for another picture of the panel, before the page asks again
_SIZES_PX = (16, 4096)  # of what the page may ask for
T = TypeVar("T")


def steering_routes(stage: Stage, exports: Mapping[str, Callable[[Controls, Path], None]]) -> dict[str, Route]:
    """Return all addresses of `lightfield-gs view`.

    Only /rest changes the picture on the panel, and only the program's own page has its token.

    Args:
        exports: Functions that write a file, by its name.
    """
    token = secrets.token_urlsafe()
    steering = _Steering(stage, exports)
    return {
        "/": page_file("view.html"),
        **{f"/{name}": page_file(name) for name in ("view.css", "view.js", "controls.js", "pictures.js")},
        "/scene.json": Route(lambda query: as_json({**_scene(stage, list(exports)), "token": token})),
        "/frame": Route(steering.frame, place=lambda query: Reservation(_is_still(query))),
        "/rest": Route(steering.rest, token),
        "/focus.json": Route(steering.focus),
        "/depth.json": Route(steering.depth),
        **{
            f"/export/{name}": Route(partial(steering.export, name), place=lambda query: Reservation(True))
            for name in exports
        },
        **drawing_routes(stage),
        **panel_routes(
            stage.panel,
            steering.native,
            lambda after: stage.wait_for(after, _WAIT_S),
            fills=isinstance(stage, StereoStage),
            controls=lambda: asdict(stage.resting()),
        ),
    }


def _is_still(query: Query) -> bool:
    return query.get("still") == "1"


class _Steering:
    """What the page asks for, by the thread that draws it."""

    def __init__(self, stage: Stage, exports: Mapping[str, Callable[[Controls, Path], None]]):
        self._stage, self._exports, self._lines = stage, exports, _Lines(stage.is_live)

    def frame(self, query: Query) -> Answer:
        controls, still = Controls.of(query), _is_still(query)
        picture = self._lines.draw(still, partial(_picture, self._stage, query, controls, still))
        return encoded(picture, lossless=still)

    def rest(self, query: Query) -> Answer:
        """Show the page's resting state on the panel."""
        self._stage.settle(Controls.of(query))
        return text("", 204)

    def focus(self, query: Query) -> Answer:
        """Return the depth of the surface at a point."""
        point = number(query, "x", 0, 1), number(query, "y", 0, 1)
        work = partial(self._stage.depth_at, Controls.of(query), point)
        return as_json({"focus": self._lines.draw(False, work)})

    def depth(self, query: Query) -> Answer:
        lines, warnings = self._lines.draw(True, partial(self._stage.depth, Controls.of(query)))
        return as_json({"lines": lines, "warnings": warnings})

    def export(self, name: str, query: Query) -> Answer:
        controls = Controls.of(query)
        with scratch_folder() as folder:
            path = folder / name
            self._lines.last(partial(self._exports[name], controls, path))
            kept = {"Content-Disposition": f'attachment; filename="{name}"'}
            return Answer(path.read_bytes(), "application/octet-stream", headers=kept)

    def native(self) -> tuple[int, np.ndarray]:
        """Return the picture for the panel, and its version."""
        return self._lines.last(self._stage.settled)


def panel_routes(
    panel: Panel,
    native: Callable[[], tuple[int, np.ndarray]],
    version: Callable[[int], int],
    fills: bool = False,
    controls: Callable[[], dict[str, object]] | None = None,
) -> dict[str, Route]:
    """Return the addresses of the panel's own page.

    Args:
        native: Returns the current picture, uint8 [H, W, 3], and its version.
        version: Returns the picture's version once it differs from the given number, or after a while.
        fills: Whether the picture fills the screen, as of two eyes, instead of being shown pixel for pixel.
        controls: Returns those of the picture, for browsers that draw it themselves. None: they cannot.
    """

    def drawn_by() -> dict[str, object]:
        return {} if controls is None else {"controls": controls()}

    def state(query: Query) -> Answer:
        after = int(number(query, "after", -1, 1 << 53))
        size = {"width_px": panel.width_px, "height_px": panel.height_px}
        return as_json({"name": panel.name, **size, "version": version(after), "fills": fills, **drawn_by()})

    packed = _Packed(native)
    return {
        "/panel": page_file("panel.html"),
        "/panel.css": page_file("panel.css"),
        "/panel.js": page_file("panel.js"),
        "/display.js": page_file("display.js"),
        "/pixel_word.js": page_file("pixel_word.js"),
        "/panel.json": Route(state),
        "/panel.png": Route(
            lambda query: packed.answer(version(-1)), place=lambda query: Reservation(True, version(-1))
        ),
        "/favicon.ico": Route(lambda query: text("", 204)),
    }


class _Packed:
    """The panel's picture as a PNG, packed once for all who read it.

    Args:
        native: See panel_routes.
    """

    def __init__(self, native: Callable[[], tuple[int, np.ndarray]]):
        self._native, self._turn = native, threading.Lock()
        self._version, self._answer = -1, text("")

    def answer(self, version: int) -> Answer:
        """Return the picture of this version, or of a later one."""
        with self._turn:
            if self._version != version:
                self._version, pixels = self._native()
                self._answer = Answer(image_bytes(pixels, "PNG", compress_level=0), "image/png")
            return self._answer


def shown_routes(panel: Panel, pixels: np.ndarray, fills: bool = False) -> dict[str, Route]:
    """Return the routes of `lightfield-gs show`: the panel's page for one picture, uint8 [H, W, 3].

    Args:
        fills: See panel_routes.
    """
    never = threading.Event()

    def version(after: int) -> int:
        if after == 1:
            never.wait(_WAIT_S)
        return 1

    routes = panel_routes(panel, lambda: (1, pixels), version, fills)
    return {**routes, "/": routes["/panel"]}


def encoded(picture: Picture, lossless: bool) -> Answer:
    """Return a PNG or JPEG, with its kind and its times in the headers."""
    headers = {
        "X-Picture": picture.description,
        "Server-Timing": ", ".join(f"{name};dur={value:.2f}" for name, value in picture.stages_ms.items()),
    }
    if lossless:
        return Answer(image_bytes(picture.pixels, "PNG", compress_level=1), "image/png", headers=headers)
    return Answer(image_bytes(picture.pixels, "JPEG", quality=_JPEG_QUALITY), "image/jpeg", headers=headers)


def _picture(stage: Stage, query: Query, controls: Controls, still: bool) -> Picture:
    kind = query.get("show", "eye")
    if kind == "eye":
        return stage.eye(controls, round(number(query, "width", *_SIZES_PX)), still)
    if kind == "sheet":
        return stage.sheet(controls, still)
    if kind == "native":
        size = round(number(query, "width", *_SIZES_PX)), round(number(query, "height", *_SIZES_PX))
        return stage.crop(controls, (number(query, "x", 0, 1), number(query, "y", 0, 1)), size, still)
    raise InputError(f"show must be eye, sheet or native, got {kind[:40]!r}")


def _scene(stage: Stage, exports: list[str]) -> dict[str, object]:
    """Return the page's data on the scene and the panel."""
    panel = stage.panel
    distance = panel.viewing_distance_mm
    return {
        "name": stage.name,
        "gaussians": stage.gaussians.count,
        "device": stage.gaussians.device.type,
        "live": stage.is_live,
        "panel": {**panel.to_dict(), "pitch_mm": panel.pixel_pitch_mm, "distance_mm": distance},
        "zone_mm": None if missing_geometry(panel) else 2 * stage.eye_mm(Controls(eye=0.5))[0],
        "rig": {"zero_depth": stage.base.zero_depth, "cone_deg": stage.base.cone_deg or panel.cone_deg},
        "defaults": asdict(Controls()),
        "qualities": QUALITY_NAMES,
        "exports": exports,
    }


class _Lines:
    """The drawing threads: one for moving pictures and one for pictures at rest, which may take seconds.

    On a GPU one thread draws both. A thread for each connection would have a pool of torch's own.
    """

    def __init__(self, is_live: bool):
        self._still = ThreadPoolExecutor(1, "still")
        self._moving = self._still if is_live else ThreadPoolExecutor(1, "moving")
        self._tickets = itertools.count(1)
        self._newest = 0

    def draw(self, still: bool, work: Callable[[], T]) -> T:
        """Run work in its turn. Raises Superseded if another picture at rest is requested before."""
        if not still:
            return self._moving.submit(work).result()
        ticket = self._newest = next(self._tickets)

        def in_turn() -> T:
            if ticket != self._newest:
                raise Superseded
            return work()

        return self._still.submit(in_turn).result()

    def last(self, work: Callable[[], T]) -> T:
        """Run work after the pictures at rest that were requested before."""
        return self._still.submit(work).result()


def exports(stage: Stage) -> dict[str, Callable[[Controls, Path], None]]:
    """Return functions that write a file to a path, by the file's name."""
    if isinstance(stage, StereoStage):
        pictures = {stereo_paths(Path("eyes.png"), stage.layout)[0].name: partial(_eyes, stage)}
    else:
        layout = panel_quilt(stage.panel)
        pictures = {"native.png": partial(_native, stage), f"quilt{layout.suffix}.png": partial(_quilt, stage, layout)}
    return {
        **pictures,
        "rig.yaml": lambda controls, path: stage.rig_of_file(controls).to_yaml(
            path, stage.panel
        ),  # in the axes of the scene's file
    }


def _native(stage: Stage, controls: Controls, path: Path) -> None:
    """Write the native picture with the panel and the rig, as `encode` does: `simulate` and `show` read it."""
    image, _ = stage.native(controls)
    drawn = stage.drawn_as
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
    image = quilt(stage.gaussians, layout, rig, panel, **stage.drawn_as)
    write_image(path, image.cpu().numpy(), _origin(stage))


def _origin(stage: Stage) -> dict[str, str]:
    return {"software": f"lightfield-gs {version('lightfield-gs')}", "input": stage.name}
