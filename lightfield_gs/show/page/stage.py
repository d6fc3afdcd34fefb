"""A scene on a panel, drawn for the page: coarse while something moves, in full when it rests."""

from __future__ import annotations

import math
import re
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from typing import Any, cast

import numpy as np
import torch

from lightfield_gs.base.arrays import to_bytes
from lightfield_gs.base.errors import InputError
from lightfield_gs.base.options import QUALITY_NAMES, QualityName
from lightfield_gs.encoding.classic import render_views
from lightfield_gs.encoding.encode import encode
from lightfield_gs.encoding.encoder import Encoder
from lightfield_gs.panels.cells import PERIOD
from lightfield_gs.panels.comfort import DepthReport, depth_report
from lightfield_gs.panels.look import CONES_DEG, MOST_AMOUNT, MOST_PAN, ZOOMS, Look, orbited
from lightfield_gs.panels.panel import Panel
from lightfield_gs.panels.rig import Rig
from lightfield_gs.panels.simulate import missing_geometry, simulate
from lightfield_gs.scene.gaussians import Gaussians
from lightfield_gs.show.page.server import number
from lightfield_gs.show.preview import SHEET_VIEWS, SHEET_WIDTH_PX, contact_sheet, to_integers

# Each number that the page may set, with its range
RANGES = {
    "yaw_deg": (-180.0, 180.0),
    "pitch_deg": (-89.0, 89.0),
    "focus": (1e-6, 1e12),
    "depth_amount": (0.0, MOST_AMOUNT),
    "cone_deg": CONES_DEG,
    "zoom": ZOOMS,
    "pan_x": (-MOST_PAN, MOST_PAN),
    "pan_y": (-MOST_PAN, MOST_PAN),
    "eye": (-0.5, 0.5),
    "frame": (0.0, 1e6),
}


@dataclass(frozen=True)
class Controls:
    """The state of the page.

    Attributes:
        yaw_deg, pitch_deg: Angles that the camera has gone to the right and up around the middle of the scene, degrees.
        focus, depth_amount, cone_deg, zoom, pan_x, pan_y: See Look; focus is a depth here. None: as in the rig.
        eye: Position of the eye across the viewing zone, -0.5 (left border) .. 0.5 (right border).
        frame: Number of the scene, of scenes in a row; from their end on, the last one.
        quality: Largest error allowed for less time.
        background: A colour, #rrggbb; "": the scene's own.
    """

    yaw_deg: float = 0.0
    pitch_deg: float = 0.0
    focus: float | None = None
    depth_amount: float = 1.0
    cone_deg: float | None = None
    zoom: float = 1.0
    pan_x: float = 0.0
    pan_y: float = 0.0
    eye: float = 0.0
    frame: int = 0
    quality: QualityName = "exact"
    background: str = ""

    @staticmethod
    def of(query: Mapping[str, str]) -> Controls:
        """Return the controls of a query; missing words have their defaults, unknown words are ignored.

        Raises InputError on a value that is no number, or out of its range.
        """
        values: dict[str, Any] = {name: number(query, name, *RANGES[name]) for name in RANGES if name in query}
        if "frame" in values:
            values["frame"] = int(values["frame"])
        if "quality" in query:
            if query["quality"] not in QUALITY_NAMES:
                raise InputError(f"quality must be {', '.join(QUALITY_NAMES)}, got {query['quality'][:40]!r}")
            values["quality"] = query["quality"]
        if colour := query.get("background"):
            if not re.fullmatch("#[0-9a-fA-F]{6}", colour):
                raise InputError(f"background must be a colour #rrggbb, got {colour[:40]!r}")
            values["background"] = colour.lower()
        return Controls(**values)

    def picture(self) -> Controls:
        """Return the controls of the native picture: all but the position of the eye."""
        return replace(self, eye=0.0)

    def look(self) -> Look:
        """Return the changes of a rig by these controls, without the turn."""
        return Look(self.focus, self.depth_amount, self.cone_deg, self.zoom, (self.pan_x, self.pan_y))

    def colour(self, own: tuple[float, float, float]) -> tuple[float, float, float]:
        """Return the background, where `own` is the scene's: red, green and blue, 0..1."""
        if not self.background:
            return own
        red, green, blue = bytes.fromhex(self.background[1:])
        return red / 255, green / 255, blue / 255

    def rig(self, base: Rig, panel: Panel) -> Rig:
        """Return the scene's rig as these controls change it."""
        return self.look().applied(orbited(base, self.yaw_deg, self.pitch_deg), panel)


STILL_WIDTH_PX = 1920  # of one view, on panels before which no eye can be placed


@dataclass(frozen=True)
class Film:
    """Scenes in a row that the page plays.

    Attributes:
        count: Of scenes.
        fps: Scenes a second.
        at: Returns a scene by its number, on the device that draws; raises InputError.
    """

    count: int
    fps: float
    at: Callable[[int], Gaussians]


@dataclass(frozen=True)
class StagedScene:
    """A scene that the page shows, or scenes in a row.

    Attributes:
        gaussians: One scene, on the device that draws; of several, the first.
        rig: Cameras that frame the scene.
        name: Name of the input, for the title and for metadata.
        background: Three numbers in 0..1.
        antialiased: See `encode`.
        view_filter: Likewise.
        film: Scenes in a row, all with the same cameras.
    """

    gaussians: Gaussians
    rig: Rig
    name: str = "scene"
    background: tuple[float, float, float] = (1.0, 1.0, 1.0)
    antialiased: bool = False
    view_filter: float = 0.0
    film: Film | None = None


@dataclass
class Picture:
    """A picture of the page.

    Attributes:
        pixels: uint8 [h, w, 3].
        description: Words on the pixels.
        stages_ms: Times of the stages, in order.
    """

    pixels: np.ndarray
    description: str
    stages_ms: dict[str, float] = field(default_factory=dict)


class Stage:
    """Draws the pictures of the page. One thread at a time may draw moving pictures, and one pictures at rest.

    Args:
        scene: The scene to begin with.
        panel: The panel of all scenes.
        device: See `encode`.
    """

    fills_screen = False  # whether the panel's page shows the picture as large as the screen, not pixel for pixel
    is_tracked = False  # whether the picture follows the viewer's eyes
    follow_ms: int | None = None  # time between two looks at a picture that changes by itself; None: it does not
    has_quality = True  # whether less time for more error can be chosen
    is_for_browsers = True  # whether a browser may draw the scene by itself

    def __init__(self, scene: StagedScene, panel: Panel, device: str | None = None):
        self.scene, self.panel, self._device = scene, panel, device
        self.is_on_gpu = scene.gaussians.device.type == "cuda"
        self.version, self.number = 0, 0  # count the resting states of the page, and its scenes
        self._settled, self._changed = Controls(), threading.Condition()
        self._native: tuple[object, np.ndarray] | None = None
        self._moving: tuple[tuple[str, str], Encoder] | None = None

    def place(self, scene: StagedScene) -> None:
        """Show another scene, as it opens. Only the thread of pictures at rest may call this."""
        with self._changed:
            self.scene, self._native, self._moving = scene, None, None
            self._settled = Controls()
            self.number += 1
            self.version += 1
            self._changed.notify_all()

    @property
    def gaussians(self) -> Gaussians:
        """The scene's Gaussians; of scenes in a row, those of the first."""
        return self.scene.gaussians

    def shown(self, controls: Controls) -> Gaussians:
        """Return the Gaussians that the controls show. Raises InputError where a scene in a row cannot be read."""
        film = self.scene.film
        return self.scene.gaussians if film is None else film.at(min(controls.frame, film.count - 1))

    @property
    def base(self) -> Rig:
        """The scene's rig, before the controls."""
        return self.scene.rig

    @property
    def name(self) -> str:
        """The scene's name."""
        return self.scene.name

    def drawn_as(self, controls: Controls) -> dict[str, Any]:
        """Return the arguments of `encode` by which the scene is drawn, but for its cameras and its quality."""
        scene = self.scene
        return dict(
            background=controls.colour(scene.background),
            antialiased=scene.antialiased,
            view_filter=scene.view_filter,
            device=self._device,
        )

    # What is shown

    def eye(self, controls: Controls, width_px: int, still: bool) -> Picture:
        """Draw the picture that an eye at controls.eye sees, at the viewing distance.

        Args:
            still: Draw the native picture through the lenses, one sample a lens, if the panel knows where its eyes are.
                Else draw the one view that such an eye would see through perfect lenses, width_px wide.
        """
        if still and not missing_geometry(self.panel):
            native, stages = self.native(controls)
            with timed(stages, "simulate"):
                seen = to_integers(simulate(native, self.panel, self.eye_mm(controls)), 8)
            return Picture(seen, f"through the lenses, {seen.shape[1]} x {seen.shape[0]} samples", stages)
        if still:
            width_px = STILL_WIDTH_PX
        stages = {} if still or not self.is_on_gpu else self._native_on_gpu(controls)
        with timed(stages, "view"):
            view = self._views(controls, [controls.eye], width_px)[0]
        return Picture(view, f"one view, {view.shape[1]} x {view.shape[0]}", stages)

    def sheet(self, controls: Controls, still: bool) -> Picture:
        """Return twelve views side by side, the left-most camera's first, at a smaller size unless still."""
        upright = self.panel.height_px > self.panel.width_px
        width_px = SHEET_WIDTH_PX // (6 if upright else 4) // (1 if still or self.is_on_gpu else 2)
        stages: dict[str, float] = {}
        with timed(stages, "views"):
            inner = 0.5 - 0.5 / self.panel.views  # the outermost integer views
            views = self._views(controls, np.linspace(-inner, inner, SHEET_VIEWS).tolist(), width_px)
        return Picture(contact_sheet(views), f"{SHEET_VIEWS} views from left to right", stages)

    def crop(self, controls: Controls, centre: tuple[float, float], size_px: tuple[int, int], still: bool) -> Picture:
        """Draw native pixels one to one, around a point of the panel.

        Args:
            centre: The point in fractions of the panel.
            size_px: Width and height.
            still: Cut the pixels out of the native picture. Else draw these pixels alone, as a panel of their own.
        """
        left, top, width, height = self._box(centre, size_px)
        description = f"native pixels {left}..{left + width - 1} x {top}..{top + height - 1}"
        if still:
            native, stages = self.native(controls)
            return Picture(native[top : top + height, left : left + width], description, stages)
        stages = {}
        with timed(stages, "pixels"):
            pixels = self._encoded(*cut_out(self.panel, self._rig(controls), left, top, width, height), controls)
        return Picture(pixels, description, stages)

    def native(self, controls: Controls) -> tuple[np.ndarray, dict[str, float]]:
        """Return the native picture, uint8 [H, W, 3] (to be read only), and the times of its stages in ms.

        The times are {} for the same picture as before.
        """
        state = self._state(controls)
        if self._native is not None and self._native[0] == state:
            return self._native[1], {}
        stats: dict = {}
        image = self._encoded(self.panel, self._rig(controls), controls, stats)
        self._native = state, image
        return image, dict(stats["stages_ms"])

    def settle(self, controls: Controls) -> None:
        """Set the page's resting state, which the panel shows."""
        with self._changed:
            if controls.picture() != self._settled:
                self._settled = controls.picture()
                self.version += 1
                self._changed.notify_all()

    def resting(self) -> Controls:
        """Return the page's resting state."""
        with self._changed:
            return self._settled

    def settled(self) -> tuple[int, np.ndarray]:
        """Return the version of the page's resting state, and its native picture."""
        with self._changed:
            version, controls = self.version, self._settled
        return version, self.native(controls)[0]

    def wait_for(self, after: int, timeout_s: float) -> int:
        """Return the version of the panel's picture as soon as it differs from `after`, or at the timeout."""
        with self._changed:
            self._changed.wait_for(lambda: self.version != after, timeout_s)
            return self.version

    def depth_at(self, controls: Controls, point: tuple[float, float]) -> float:
        """Return the depth of the surface at a point of the picture, 0..1 of its width and height.

        The depth becomes the focus. Raises InputError.
        """
        look = replace(controls.look(), focus=point)
        turned = orbited(self.base, controls.yaw_deg, controls.pitch_deg)
        return look.applied(turned, self.panel, self.shown(controls)).zero_depth

    def depth(self, controls: Controls) -> DepthReport:
        """Return how deep the scene is on the panel. Raises InputError where the centre camera sees nothing."""
        return depth_report(self.shown(controls), self.panel, self._rig(controls))

    def eye_mm(self, controls: Controls) -> tuple[float, float, float]:
        """Return the position of the eye before the panel, mm. Raises InputError if the panel lacks measures."""
        if missing := missing_geometry(self.panel):
            raise InputError(f"panel {self.panel.name} lacks {' and '.join(missing)}; an eye cannot be placed without")
        distance = cast(float, self.panel.viewing_distance_mm)
        return controls.eye * 2 * distance * math.tan(math.radians(self.panel.cone_deg) / 2), 0.0, distance

    def rig_of_file(self, controls: Controls) -> Rig:
        """Return the rig in the coordinates of the scene's file."""
        return self._rig(controls).relative_to([-part for part in self.gaussians.origin])

    # How it is drawn

    def _state(self, controls: Controls) -> object:
        """Return what the native picture depends on."""
        return controls.picture()

    def _rig(self, controls: Controls) -> Rig:
        return controls.rig(self.base, self.panel)

    def _encoded(self, panel: Panel, rig: Rig, controls: Controls, stats: dict | None = None) -> np.ndarray:
        with torch.no_grad():
            scene = self.shown(controls)
            image = encode(scene, panel, rig, quality=controls.quality, stats=stats, **self.drawn_as(controls))
        return image.cpu().numpy()

    def _native_on_gpu(self, controls: Controls) -> dict[str, float]:
        """Draw the native picture on the GPU, where it stays; return the time."""
        rig, stages = self._rig(controls), dict[str, float]()
        if self.scene.film is not None:  # an Encoder keeps what does not change
            with timed(stages, "native"):
                self._encoded(self.panel, rig, controls)
            return stages
        kind = controls.quality, controls.background
        if self._moving is None or self._moving[0] != kind:
            encoder = Encoder(self.panel, rig, quality=controls.quality, versioned=True, **self.drawn_as(controls))
            self._moving = kind, encoder
        encoder = self._moving[1]
        encoder.rig = rig
        with timed(stages, "native"):
            encoder(self.gaussians)
            torch.cuda.synchronize(self.gaussians.device)
        return stages

    def _views(self, controls: Controls, eyes: list[float], width_px: int) -> list[np.ndarray]:
        """Return the pictures [h, w, 3], uint8, of eyes at these positions across the viewing zone.

        The lenses are perfect.
        """
        panel, rig = self._rig(controls).reduced(self.panel, width_px)
        side = -1 if panel.invert_views else 1
        positions = [panel.views * (0.5 - side * eye) for eye in eyes]
        views = render_views(self.shown(controls), panel, rig, positions, **self.drawn_as(controls))
        return list(to_bytes(views).cpu().numpy())

    def _box(self, centre: tuple[float, float], size_px: tuple[int, int]) -> tuple[int, int, int, int]:
        """Return left, top, width and height of a crop within the panel; the kinds of pixels repeat at its borders."""
        width, height = min(size_px[0], self.panel.width_px), min(size_px[1], self.panel.height_px)
        height -= (height - self.panel.height_px) % PERIOD
        left = round(centre[0] * self.panel.width_px - width / 2)
        top = round(centre[1] * self.panel.height_px - height / 2)
        left, top = min(max(0, left), self.panel.width_px - width), min(max(0, top), self.panel.height_px - height)
        return left - left % PERIOD, top - top % PERIOD, width, height


def cut_out(panel: Panel, rig: Rig, left: int, top: int, width: int, height: int) -> tuple[Panel, Rig]:
    """Return a part of a panel as a panel of its own: its sub-pixels show the same views as on the whole panel.

    On panels with cells the kinds of pixels repeat: left, top and the rows left below are multiples of PERIOD.
    """
    cx, cy = rig.principal_point_px
    phase = panel.phase + 3 * left + 3 * top * panel.slant_tan
    part = replace(panel, width_px=width, height_px=height, phase=phase)
    return part, replace(rig, principal_point_px=(cx - left, cy - top))


@contextmanager
def timed(stages_ms: dict[str, float], name: str) -> Iterator[None]:
    """Store the time of the block in ms under its name."""
    began = time.perf_counter()
    yield
    stages_ms[name] = 1000 * (time.perf_counter() - began)
