"""A light field on an ordinary screen: contact sheet of views, look-around animation, what the two eyes see."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import cast

import numpy as np

from lightfield_gs.io.atomic import atomic_path, make_folder, remove_file
from lightfield_gs.io.images import write_image
from lightfield_gs.panels.panel import Panel
from lightfield_gs.panels.rig import Rig, reduced
from lightfield_gs.panels.simulate import simulate, unknown_of
from lightfield_gs.scene.gaussians import Gaussians

EYE_SEPARATION_MM = 63.0
_EYES = {"left-eye.png": -0.5, "right-eye.png": 0.5}  # place to the right of the middle, in eye separations
FILES = ("views.png", "look-around.webp", *_EYES)
_SHEET_COLUMNS, _SHEET_ROWS = 4, 3
_SHEET_VIEW_WIDTH_PX, _ANIMATION_WIDTH_PX = 480, 960
_FRAMES, _FRAME_MS, _WEBP_QUALITY = 24, 60, 85


def write_preview(
    folder: str | Path,
    image: np.ndarray,
    gaussians: Gaussians,
    panel: Panel,
    rig: Rig,
    background: tuple[float, float, float] = (1.0, 1.0, 1.0),
    antialiased: bool = False,
) -> list[Path]:
    """Writes previews of an encoded light field into `folder` (made if absent) and returns their paths.

    views.png: views from the left-most to the right-most camera, row by row.
    look-around.webp: a camera that goes from left to right and back.
    left-eye.png, right-eye.png: `image` [H, W, 3] through the lenses, the eyes 63 mm apart at the viewing distance;
    only where the panel knows its viewing distance and pixel pitch. Elsewhere those of an earlier preview are removed.
    Views are rendered at a reduced size; antialiased: see `render`. Raises InputError.
    """
    folder = make_folder(folder)
    paths = [folder / name for name in FILES[:2]]
    frames = _views(gaussians, panel, rig, background, _FRAMES, _ANIMATION_WIDTH_PX, antialiased)
    with ThreadPoolExecutor(1) as beside:  # the animation keeps one core busy for as long as all else takes
        animation = beside.submit(_write_webp, paths[1], frames)
        write_image(paths[0], contact_sheet(gaussians, panel, rig, background, antialiased), compression="small")
        paths += _write_eyes(folder, image, panel)
        animation.result()
    return paths


def _write_eyes(folder: Path, image: np.ndarray, panel: Panel) -> list[Path]:
    """The pictures of the two eyes; none, and none left over either, where the panel does not say where they are."""
    paths = [folder / name for name in _EYES]
    if unknown_of(panel):
        for path in paths:
            remove_file(path)
        return []
    for path, side in zip(paths, _EYES.values()):
        eye = (side * EYE_SEPARATION_MM, 0.0, cast(float, panel.viewing_distance_mm))
        write_image(path, to_integers(simulate(image, panel, eye), 8), compression="small")
    return paths


def contact_sheet(
    gaussians: Gaussians,
    panel: Panel,
    rig: Rig,
    background: tuple[float, float, float] = (1.0, 1.0, 1.0),
    antialiased: bool = False,
) -> np.ndarray:
    """Twelve views of the light field, left-most camera first, in rows of four: uint8 [H, W, 3]."""
    views = _views(gaussians, panel, rig, background, _SHEET_COLUMNS * _SHEET_ROWS, _SHEET_VIEW_WIDTH_PX, antialiased)
    rows = [np.concatenate(views[i : i + _SHEET_COLUMNS], 1) for i in range(0, len(views), _SHEET_COLUMNS)]
    return np.concatenate(rows)


def to_integers(image: np.ndarray, bits: int) -> np.ndarray:
    """round((2^bits - 1) clamp(c, 0, 1)) of a float image; bits 8 or 16. NaN becomes 0."""
    top = (1 << bits) - 1
    out = np.empty(image.shape, np.uint8 if bits == 8 else np.uint16)
    for first in range(0, len(image), 256):  # in strips: an 8K frame in float64 would be 700 MB
        strip = np.nan_to_num(image[first : first + 256].astype(np.float64))
        out[first : first + 256] = np.floor(np.clip(strip, 0, 1) * top + 0.5)
    return out


def _views(
    gaussians: Gaussians,
    panel: Panel,
    rig: Rig,
    background: tuple[float, float, float],
    count: int,
    width_px: int,
    antialiased: bool,
) -> list[np.ndarray]:
    """`count` views spread over the fan, left-most camera first, each uint8 [h, w, 3]."""
    from lightfield_gs.rasterizer.images import render

    small_panel, small_rig = reduced(panel, rig, width_px)
    positions = np.linspace(panel.views - 0.5, 0.5, count)
    if panel.invert_views:
        positions = positions[::-1]
    views = []
    for position in positions:
        cameras = small_rig.cameras_at(small_panel, [position])
        view = render(gaussians, cameras, background=background, antialiased=antialiased)[0]
        views.append(to_integers(view.cpu().numpy(), 8))
    return views


def _write_webp(path: Path, frames: list[np.ndarray]) -> None:
    """A loop of the frames, there and back."""
    from PIL import Image

    images = [Image.fromarray(frame) for frame in [*frames, *frames[-2:0:-1]]]
    with atomic_path(path) as temporary:
        images[0].save(
            temporary,
            save_all=True,
            append_images=images[1:],
            duration=_FRAME_MS,
            loop=0,
            quality=_WEBP_QUALITY,
            method=2,
        )
