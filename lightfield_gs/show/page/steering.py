"""The addresses of the page that steers a scene."""

from __future__ import annotations

import secrets
from collections.abc import Callable, Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path

import numpy as np

from lightfield_gs.base.errors import InputError
from lightfield_gs.base.options import QUALITY_NAMES
from lightfield_gs.base.system import quoted
from lightfield_gs.panels.simulate import missing_geometry
from lightfield_gs.show.page.drawing import drawing_routes
from lightfield_gs.show.page.exports import Exports, export_routes
from lightfield_gs.show.page.gallery import Gallery
from lightfield_gs.show.page.lines import Lines
from lightfield_gs.show.page.looks import LookStore, look_routes
from lightfield_gs.show.page.routes import WAIT_S, panel_routes
from lightfield_gs.show.page.server import Answer, Query, Reservation, Route, as_json, number, page_file, text
from lightfield_gs.show.page.stage import RANGES, Controls, Picture, Stage
from lightfield_gs.show.preview import image_bytes

_JPEG_QUALITY = 85
_SIZES_PX = (16, 4096)  # of what the page may ask for
_FOLDER = Path(__file__).parent / "files" / "view"


def steering_routes(
    stage: Stage,
    exports: Exports,
    gallery: Gallery | None = None,
    looks: LookStore | None = None,
    command: Callable[[Controls], Sequence[str]] | None = None,
    display: Callable[[], None] | None = None,
) -> dict[str, Route]:
    """Return all addresses of `lightfield-gs view`.

    Only the program's own page has the token of the addresses that change anything.

    Args:
        exports: Functions that write a file, by its name.
        gallery: The pictures that the page may open. None: the stage's scene alone.
        looks: Looks that are kept. None: the page keeps none.
        command: Returns the command line that makes the picture of controls. None: the page shows none.
        display: Opens the panel's page on the display. None: the page has a link to it.
    """
    token, lines = secrets.token_urlsafe(), Lines(stage.is_on_gpu)
    steering = _Steering(stage, lines)
    can = {"opens": gallery is not None, "keeps": looks is not None, "commands": command is not None}
    can["displays"] = display is not None
    facts = {"exports": list(exports), "token": token, **can}
    routes = {
        "/": page_file("view/view.html"),
        **{f"/{path.name}": page_file(f"view/{path.name}") for path in _FOLDER.iterdir() if path.suffix != ".html"},
        "/scene.json": Route(lambda query: as_json({**_facts(stage), **facts})),
        "/frame": Route(steering.of_now(steering.frame), place=lambda query: Reservation(_is_still(query))),
        "/rest": Route(steering.of_now(steering.rest), token),
        "/focus.json": Route(steering.of_now(steering.focus)),
        "/depth.json": Route(steering.of_now(steering.depth)),
        **export_routes(stage, exports, lines),
        **drawing_routes(stage),
        **panel_routes(
            stage.panel,
            steering.native,
            lambda after: stage.wait_for(after, WAIT_S),
            fills=stage.fills_screen,
            controls=lambda: {**asdict(stage.resting()), "scene": stage.number},
        ),
    }
    if gallery is not None:
        routes |= gallery.routes(stage, lines, token)
    if looks is not None:
        routes |= look_routes(looks, token)
    if command is not None:
        routes["/command.json"] = Route(lambda query: as_json({"words": quoted(*command(Controls.of(query)))}))
    if display is not None:
        routes["/display"] = Route(partial(_on_display, display), token)
    return routes


def _on_display(display: Callable[[], None], query: Query) -> Answer:
    display()
    return text("", 204)


def _is_still(query: Query) -> bool:
    return query.get("still") == "1"


class _Steering:
    """What the page asks for, by the thread that draws it."""

    def __init__(self, stage: Stage, lines: Lines):
        self._stage, self._lines = stage, lines

    def of_now(self, make: Callable[[Query], Answer]) -> Callable[[Query], Answer]:
        """Return what makes answers, with refusals of questions about a scene before the present one."""

        def answer(query: Query) -> Answer:
            is_old = query.get("scene", str(self._stage.number)) != str(self._stage.number)
            return text("another picture is shown by now", 410) if is_old else make(query)

        return answer

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
        """Return DepthReport.to_dict."""
        report = self._lines.draw(True, partial(self._stage.depth, Controls.of(query)))
        return as_json(report.to_dict())

    def native(self) -> tuple[int, np.ndarray]:
        """Return the picture for the panel, and its version."""
        return self._lines.last(self._stage.settled)


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


def _facts(stage: Stage) -> dict[str, object]:
    """Return the page's data on the scene and the panel."""
    panel = stage.panel
    distance, film = panel.viewing_distance_mm, stage.scene.film
    return {
        "number": stage.number,
        "name": stage.name,
        "gaussians": stage.gaussians.count,
        "device": stage.gaussians.device.type,
        "on_gpu": stage.is_on_gpu,
        "tracked": stage.is_tracked,
        "follow_ms": stage.follow_ms,
        "film": None if film is None else {"count": film.count, "fps": film.fps},
        "panel": {**panel.to_dict(), "pitch_mm": panel.pixel_pitch_mm, "distance_mm": distance},
        "zone_mm": None if missing_geometry(panel) else 2 * stage.eye_mm(Controls(eye=0.5))[0],
        "rig": {"zero_depth": stage.base.zero_depth, "cone_deg": stage.base.cone_deg or panel.cone_deg},
        "background": "#" + "".join(f"{round(255 * part):02x}" for part in stage.scene.background),
        "defaults": asdict(Controls()),
        "ranges": RANGES,
        "qualities": QUALITY_NAMES if stage.has_quality else (),
    }
