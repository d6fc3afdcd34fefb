"""How scenes, panels, rigs, cameras and images show themselves in a notebook: HTML, without a kernel behind it."""

from __future__ import annotations

import base64
import html
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import ClassVar

import numpy as np
import torch

from lightfield_gs.base.checks import counted
from lightfield_gs.base.errors import InputError
from lightfield_gs.panels.content import thinned
from lightfield_gs.panels.panel import Panel
from lightfield_gs.panels.rig import Rig
from lightfield_gs.panels.visibility import check_single
from lightfield_gs.rasterizer.images import RenderedImages
from lightfield_gs.scene.axes import DEFAULT_UP
from lightfield_gs.scene.cameras import Cameras
from lightfield_gs.scene.gaussians import Gaussians
from lightfield_gs.show import orbit
from lightfield_gs.show.preview import (
    image_bytes,
    in_rows,
    look_around,
    look_around_page,
    to_integers,
    write_look_around_page,
)

_MOST_BYTES = 300_000  # of a cell, as text
_QUALITIES = 80, 60, 40, 20  # of WebP
_FRAME_PIXELS = 400 * 300
_LEAST_PX = 320  # width that a figure has at least where there is room: smaller pictures are enlarged
_FRAME_PX = 480  # width of frames of images
_ROW_PX, _COLUMNS, _MOST_IMAGES = 800, 4, 8  # of images beside each other
_BAR_PX = 44  # height of the bar below the pictures, as in look_around.html
_CELL_PX, _CROP_PX = 9, (24, 48)  # of a panel's picture: sides of a pixel, rows and columns
_STAND_IN_VIEWS = 5  # cameras that are drawn for a rig


@dataclass(frozen=True, eq=False)
class NotebookPicture:
    """A picture with a line of facts, which shows itself in a notebook: one frame, or several that a pointer turns.

    The HTML has at most 300 kB, and loads nothing. Where scripts are forbidden, the frame in the middle is seen.

    Attributes:
        frames: uint8 [h, w, 3] each, all of one size, the left-most first; none where there is nothing to see.
        facts: what they show, and what is left out.
        is_drawing: whether the frames have few colours; the one that is seen without scripts has no loss then.
    """

    frames: Sequence[np.ndarray]
    facts: str
    is_drawing: bool = False

    FRAMES: ClassVar[int] = 24  # of a picture that turns

    def _repr_html_(self) -> str:
        frames = list(self.frames)
        while True:
            for quality in _QUALITIES:
                text = self._html(frames, quality)
                if len(text) <= _MOST_BYTES or len(frames) < 3 and quality == _QUALITIES[-1]:
                    return text
            frames = frames[::2]

    def _html(self, frames: list[np.ndarray], quality: int) -> str:
        """Return the HTML of some frames, as WebP of a quality."""
        facts = html.escape(self.facts)
        caption = f'<figcaption style="padding:.3rem 0;font-size:.9em">{facts}</figcaption>'
        if not frames:
            return f'<figure style="margin:0">{caption}</figure>'
        still = frames[len(frames) // 2]
        height, width = still.shape[:2]
        kind, options = ("PNG", {}) if self.is_drawing else ("WEBP", {"quality": quality})
        data = base64.b64encode(image_bytes(still, kind, **options)).decode()
        picture = (
            f'<img src="data:image/{kind.lower()};base64,{data}" width="{width}" height="{height}" '
            f'alt="{facts}" style="display:block;width:100%;height:auto">'
        )
        if len(frames) > 1:
            page = html.escape(look_around_page(frames, self.facts, quality, is_within=True))
            picture = (
                f'<div style="position:relative;padding-bottom:{_BAR_PX}px">{picture}'
                f'<iframe srcdoc="{page}" title="{facts}" allowfullscreen '
                'style="position:absolute;inset:0;width:100%;height:100%;border:0"></iframe></div>'
            )
        return f'<figure style="margin:0;max-width:{max(width, _LEAST_PX)}px">{picture}{caption}</figure>'

    def save(self, path: str | Path) -> None:
        """Write the frames as a page of its own, which follows the mouse, a finger or a tilted device.

        Raises:
            InputError: there are no frames, or the file cannot be written.
        """
        if not self.frames:
            raise InputError(f"there is no picture to write: {self.facts}")
        write_look_around_page(path, list(self.frames), self.facts)

    # What shows itself

    @classmethod
    def of_gaussians(cls, gaussians: Gaussians, frames: int = 1, up: str = DEFAULT_UP) -> NotebookPicture:
        """Return a scene from in front, or from all around; of a batch the first set.

        Args:
            gaussians: More than 60,000 are thinned, and the facts say so.
            frames: 1, or the number of pictures of a whole turn.
            up: As for Rig.frame.
        """
        try:
            gaussians.validate()
            if gaussians.count == 0 or not len(gaussians.means):
                return cls((), f"{gaussians!r}: nothing to see")
            first = gaussians.mapped(lambda tensor: tensor[0]) if gaussians.is_batched else gaussians
            drawn = orbit.scene_orbit(first.to(torch.float32), _turns(frames), up)
        except InputError as error:
            return cls((), f"{gaussians!r}: {error}")
        notes = ["the first set is drawn"] * gaussians.is_batched + drawn.notes
        return cls(drawn.frames, "; ".join([repr(gaussians), *notes]))

    @classmethod
    def of_views(
        cls,
        gaussians: Gaussians,
        panel: Panel,
        rig: Rig,
        frames: int = 24,
        *,
        background: tuple[float, float, float] = (1.0, 1.0, 1.0),
        antialiased: bool = False,
        name: str | None = None,
    ) -> NotebookPicture:
        """Return what a panel shows of a scene, from the left-most view to the right-most; one frame: the middle view.

        Args:
            gaussians: One set.
            panel: The panel.
            rig: Its cameras.
            frames: Number of views, spread over the cone.
            background: As in encode.
            antialiased: As in encode.
            name: Of what shows the views, for the facts; None: the panel's.

        Raises:
            InputError: as in encode.
        """
        check_single(gaussians)
        some = thinned(gaussians.detach(), orbit.MOST_GAUSSIANS)
        one = replace(rig, cone_deg=0.0) if frames == 1 else rig
        views = look_around(some, panel, one, background, antialiased, frames=frames, frame_pixels=_FRAME_PIXELS)
        cone_deg = panel.cone_deg if rig.cone_deg is None else rig.cone_deg
        notes = orbit.thinning_notes(gaussians, some)
        shown_on = f"on panel {panel.name}, whose {panel.views} views span" if name is None else f"in {name}, over"
        facts = f"{gaussians!r} {shown_on} {cone_deg:.4g} degrees"
        return cls(views, "; ".join([facts, *notes]))

    @classmethod
    def of_cameras(cls, cameras: Cameras, frames: int = 1) -> NotebookPicture:
        """Return cameras as pyramids; of a batch those of the first set, and of many a hundred of them."""
        one = cameras.mapped(lambda tensor: tensor[0]) if cameras.world_to_camera.ndim == 4 else cameras
        facts = [f"{counted(len(one), 'camera')}, {cameras.model}, {cameras.width_px} x {cameras.height_px} px"]
        if one is not cameras:
            facts.append(f"the first of {len(cameras.world_to_camera)} sets is drawn")
        if len(one) == 0:
            return cls((), facts[0])
        if not bool(torch.isfinite(one.world_to_camera).all()):
            return cls((), f"{facts[0]}: world_to_camera has numbers that are not finite")
        if len(one) > orbit.MOST_CAMERAS:
            one = one[np.linspace(0, len(one) - 1, orbit.MOST_CAMERAS).round().astype(int)]
            facts.append(f"{orbit.MOST_CAMERAS} of them are drawn")
        if len(one) > 1:
            facts.append("blue is the first, orange the last")
        return cls(orbit.camera_orbit(one, _turns(frames)), "; ".join(facts), is_drawing=True)

    @classmethod
    def of_panel(cls, panel: Panel) -> NotebookPicture:
        """Return the first pixels of a panel, whose sub-pixels have the colours of their views."""
        rows, columns = min(_CROP_PX[0], panel.height_px), min(_CROP_PX[1], panel.width_px)
        _, phases = next(panel.phase_rows(rows))
        views = panel.view_index(phases[:rows, :columns])
        if panel.subpixel_order == "BGR":
            views = views[..., ::-1]
        picture = orbit.gradient(panel.views)[views.reshape(rows, -1)]
        picture = picture.repeat(_CELL_PX, 0).repeat(_CELL_PX // 3, 1)
        slant_deg = math.degrees(math.atan(panel.slant_tan))
        cells = ", with cells that are drawn as stripes" if panel.subpixel_cells else ""
        facts = (
            f"{panel.name}: {panel.width_px} x {panel.height_px} px, {panel.views} views over {panel.cone_deg:.4g} "
            f"degrees, lenses {panel.line_number:.6g} sub-pixels wide and slanted by {slant_deg:.4g} degrees{cells}; "
            f"drawn are {columns} x {rows} px, a sub-pixel of view 0 in blue, of view {panel.views - 1} in orange"
        )
        return cls([picture], facts, is_drawing=True)

    @classmethod
    def of_rig(cls, rig: Rig, panel: Panel | None = None, frames: int = 1) -> NotebookPicture:
        """Return the cameras of a rig before its zero plane.

        Args:
            rig: The rig.
            panel: The panel that it is for; None: one whose middle is the rig's principal point.
            frames: As in of_gaussians.
        """
        (fx, fy), (cx, cy) = rig.focal_px, rig.principal_point_px
        stand_in = panel or Panel(max(1, round(2 * cx)), max(1, round(2 * cy)), _STAND_IN_VIEWS, 3.0, 0.0)
        cone = f"cone {stand_in.cone_deg if rig.cone_deg is None else rig.cone_deg:.4g} degrees"
        if rig.cone_deg is None:
            cone += f" of panel {panel.name}" if panel else " (the usual one: the panel says its own)"
        width, height = stand_in.width_px, stand_in.height_px
        corners = np.array([[0, 0], [width, 0], [width, height], [0, height]])
        slopes = (corners - (cx, cy)) / (fx, fy)
        rotation, move = rig.world_to_camera[:3, :3], rig.world_to_camera[:3, 3]
        plane = (np.concatenate([slopes, np.ones((4, 1))], 1) * rig.zero_depth - move) @ rotation
        views = np.linspace(0.5, stand_in.views - 0.5, min(_STAND_IN_VIEWS, stand_in.views))
        drawn = orbit.camera_orbit(rig.cameras_at(stand_in, views), _turns(frames), plane)
        place = ", ".join(f"{value:.4g}" for value in -move @ rotation)
        facts = (
            f"Rig: centre camera at ({place}), zero plane {rig.zero_depth:.4g} before it, focal length {fx:.5g} x "
            f"{fy:.5g} px, {cone}; {counted(len(views), 'camera')} drawn, "
            "blue for view 0"
        )
        return cls(drawn, facts, is_drawing=True)

    @classmethod
    def of_images(cls, images: RenderedImages, beside: bool = True) -> NotebookPicture:
        """Return rendered images, beside each other or as frames; values outside 0..1 are cut off, and depths are grey.

        Args:
            images: Of render.
            beside: Whether they are beside each other, at most 8.
        """
        stack = images.image.detach()
        count, (height, width, channels) = math.prod(stack.shape[:-3]), stack.shape[-3:]
        others = [name for name, value in images.named().items() if value is not None and name != "image"]
        facts = [f"{counted(count, 'image')}, {width} x {height} px" + (f", and {', '.join(others)}" if others else "")]
        if not stack.numel():
            return cls((), facts[0])
        shown = stack.reshape(-1, height, width, channels)
        if beside and count > _MOST_IMAGES:
            shown = shown[torch.linspace(0, count - 1, _MOST_IMAGES).round().long().to(shown.device)]
            facts.append(f"{_MOST_IMAGES} of them are drawn")
        shown = shown.float().cpu()
        if channels == 1:
            low, high = (float(value) for value in shown.aminmax())
            shown = ((shown - low) / max(high - low, 1e-12)).expand(-1, -1, -1, 3)
            facts.append(f"depths from {low:.4g} (black) to {high:.4g} (white)")
        width = _ROW_PX // min(len(shown), _COLUMNS) if beside else _FRAME_PX
        pictures = [_at_most(to_integers(one.numpy(), 8), width) for one in shown[..., :3]]
        return cls([in_rows(pictures)] if beside else pictures, "; ".join(facts))


def _turns(frames: int) -> list[float]:
    """Return the angles of so many pictures of a whole turn, with the front in the middle."""
    return [0.0] if frames == 1 else [360 * (number / frames - 0.5) for number in range(frames)] + [180.0]


def _at_most(picture: np.ndarray, width_px: int) -> np.ndarray:
    """Return a picture, uint8 [h, w, 3], or a smaller one of this width."""
    from PIL import Image

    height, width = picture.shape[:2]
    if width <= width_px:
        return picture
    size = width_px, max(1, round(height * width_px / width))
    return np.asarray(Image.fromarray(picture).resize(size, Image.Resampling.BOX))
