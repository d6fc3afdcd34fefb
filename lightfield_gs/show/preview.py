"""A light field on an ordinary screen: contact sheet of views, look-around animation, pictures of two eyes."""

from __future__ import annotations

import base64
import io
import math
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, cast

import numpy as np

from lightfield_gs.encoding.classic import render_views
from lightfield_gs.io.atomic import atomic_path, make_folder, remove_file
from lightfield_gs.io.images import write_image
from lightfield_gs.panels.comfort import EYE_SEPARATION_MM
from lightfield_gs.panels.panel import Panel
from lightfield_gs.panels.rig import Rig
from lightfield_gs.panels.simulate import missing_geometry, simulate
from lightfield_gs.scene.gaussians import Gaussians
from lightfield_gs.show.scripts import filled, joined, json_in_page

_EYES = {"left-eye.png": -0.5, "right-eye.png": 0.5}  # place to the right of the middle, in eye separations
FILES = ("views.png", "look-around.webp", "look-around.html", *_EYES)
_FRAMES, _LOOP_MS, _WEBP_QUALITY = 24, 60 * 46, 85
_FRAME_PIXELS = 960 * 480  # of a frame of any shape, so that upright panels take no longer
# From this number of Gaussians on, views dominate the time on a CPU, and only every second view is rendered.
_MANY_GAUSSIANS = 200_000
_MOST_SPLATS = 1_000_000  # that the views have which are rendered at a time, so that threads wait less for each other
SHEET_VIEWS, SHEET_WIDTH_PX = 12, 1920
_EYE_PX, _EYE_IN_ROW_PX = 1280, 640  # longer side at least of what an eye sees, alone and beside others


def write_preview(
    folder: str | Path, image: np.ndarray, gaussians: Gaussians, panel: Panel, rig: Rig, *drawn_as: Any
) -> list[Path]:
    """Write previews of an encoded light field into `folder`, made if absent, and return their paths.

    views.png: twelve views from the left-most to the right-most camera, row by row; upright panels get two rows, so
    that the sheet fills a screen.
    look-around.webp: a camera that goes from left to right and back.
    look-around.html: the same views in a page of its own, which follow the mouse, a finger or a tilted device.
    left-eye.png, right-eye.png: `image` [H, W, 3] through the lenses, enlarged, for eyes 63 mm apart at the viewing
    distance. If the panel has no viewing distance or pixel pitch, the files of an earlier preview are removed.
    Views are rendered at a reduced size. drawn_as: background, antialiased and view_filter, as in look_around. Raises
    InputError.
    """
    folder = make_folder(folder)
    paths = [folder / name for name in FILES[:3]]
    frames = look_around(gaussians, panel, rig, *drawn_as)
    with ThreadPoolExecutor(1) as beside:  # the animation keeps one core busy for as long as all else takes
        animation = beside.submit(_write_webp, paths[1], frames)
        write_image(paths[0], contact_sheet(frames))
        write_look_around_page(paths[2], frames, f"On panel {panel.name}")
        paths += _write_eyes(folder, image, panel)
        animation.result()
    return paths


def _write_eyes(folder: Path, image: np.ndarray, panel: Panel) -> list[Path]:
    """Write the pictures of the two eyes; remove old pictures if the panel does not state the eyes' positions."""
    paths = [folder / name for name in _EYES]
    if missing_geometry(panel):
        for path in paths:
            remove_file(path)
        return []
    for path, side in zip(paths, _EYES.values()):
        eye = (side * EYE_SEPARATION_MM, 0.0, cast(float, panel.viewing_distance_mm))
        write_image(path, enlarged([simulate(image, panel, eye)])[0])
    return paths


def enlarged(pictures: Sequence[np.ndarray]) -> list[np.ndarray]:
    """Return what eyes see, each float [h, w, 3] with one sample a lens, as uint8 pictures that fill a screen.

    Each is a whole number of times as large, smooth between the samples.
    """
    from PIL import Image

    least = _EYE_PX if len(pictures) == 1 else _EYE_IN_ROW_PX
    height, width = pictures[0].shape[:2]
    times = math.ceil(least / max(height, width))
    small = [Image.fromarray(to_integers(picture, 8)) for picture in pictures]
    return [np.asarray(one.resize((times * width, times * height), Image.Resampling.BICUBIC)) for one in small]


def look_around(
    gaussians: Gaussians,
    panel: Panel,
    rig: Rig,
    background: tuple[float, float, float] = (1.0, 1.0, 1.0),
    antialiased: bool = False,
    view_filter: float = 0.0,
    frames: int = _FRAMES,
    frame_pixels: int = _FRAME_PIXELS,
) -> list[np.ndarray]:
    """Return views spread over the fan, left-most first, each uint8 [h, w, 3]; half of them of a large scene on a CPU.

    Args:
        gaussians: One scene.
        panel: Its views are taken.
        rig: Its cameras.
        background: See `encode`, as the next two.
        antialiased: See there.
        view_filter: See there.
        frames: Number of the views.
        frame_pixels: Pixels of a view, about.
    """
    small_panel, small_rig = rig.reduced(panel, math.isqrt(frame_pixels * panel.width_px // panel.height_px))
    is_slow = gaussians.count > _MANY_GAUSSIANS and gaussians.device.type == "cpu"
    positions = np.linspace(panel.views - 0.5, 0.5, frames // 2 if is_slow else frames)
    if panel.invert_views:
        positions = positions[::-1]
    views: list[np.ndarray] = []
    each = max(1, min(8, _MOST_SPLATS // max(1, gaussians.count)))
    for first in range(0, len(positions), each):
        rendered = render_views(
            gaussians,
            small_panel,
            small_rig,
            positions[first : first + each],
            background=background,
            antialiased=antialiased,
            view_filter=view_filter,
        )
        views += (to_integers(view.cpu().numpy(), 8) for view in rendered)
    return views


def contact_sheet(frames: list[np.ndarray]) -> np.ndarray:
    """Return twelve of the frames in rows of four, or of six if upright: uint8 [H, W, 3]."""
    from PIL import Image

    height, width = frames[0].shape[:2]
    columns = 4 if width >= height else 6
    scale = min(1.0, SHEET_WIDTH_PX / columns / width)
    size = max(1, round(scale * width)), max(1, round(scale * height))
    chosen = np.linspace(0, len(frames) - 1, SHEET_VIEWS).round().astype(int)
    return in_rows([np.asarray(Image.fromarray(frames[i]).resize(size, Image.Resampling.BOX)) for i in chosen], columns)


def to_integers(image: np.ndarray, bits: int) -> np.ndarray:
    """Return round((2^bits - 1) clamp(c, 0, 1)) of a float image; bits is 8 or 16. NaN becomes 0."""
    top = (1 << bits) - 1
    out = np.empty(image.shape, np.uint8 if bits == 8 else np.uint16)
    for first in range(0, len(image), 16):  # in strips that stay in the cache
        strip = image[first : first + 16].astype(np.float64)
        np.fmax(strip, 0, out=strip)  # turns NaN into 0
        np.fmin(strip, 1, out=strip)
        strip *= top
        strip += 0.5
        out[first : first + 16] = strip  # the conversion cuts off the fraction
    return out


def _write_webp(path: Path, frames: list[np.ndarray]) -> None:
    """Write a loop of the frames, there and back."""
    from PIL import Image

    images = [Image.fromarray(frame) for frame in [*frames, *frames[-2:0:-1]]]
    loop: dict[str, Any] = dict(save_all=True, append_images=images[1:], duration=round(_LOOP_MS / len(images)), loop=0)
    with atomic_path(path) as temporary:
        images[0].save(temporary, quality=_WEBP_QUALITY, method=2, **loop)


_PAGES = Path(__file__).parent / "page" / "files"


def write_look_around_page(path: str | Path, frames: list[np.ndarray], title: str) -> None:
    """Write look_around_page of these frames, atomically; raise InputError where it cannot be written."""
    with atomic_path(path) as temporary:
        temporary.write_text(look_around_page(frames, title), encoding="utf-8")


def look_around_page(
    frames: list[np.ndarray], title: str, quality: int = _WEBP_QUALITY, is_within: bool = False
) -> str:
    """Return a page that shows one frame at a time, and has the frames in it as WebP.

    Args:
        frames: The left-most camera's first, each uint8 [h, w, 3].
        title: A line below them.
        quality: Of the WebP, 1..100.
        is_within: Whether the page is within another, which has the title: it then moves only with the pointer.
    """
    data = json_in_page({"title": title, "is_within": is_within, **strip(frames, quality)})
    return filled(_PAGES / "look_around.html", {"views": data, "script": joined(_PAGES / "look_around.js")})


def strip(frames: Sequence[np.ndarray], quality: int = _WEBP_QUALITY) -> dict[str, Any]:
    """Return frames, each uint8 [h, w, 3], as a page has them: their size, and addresses that hold their WebP."""
    height, width = frames[0].shape[:2]
    return {"width": width, "height": height, "frames": [_data_url(frame, quality) for frame in frames]}


def _data_url(frame: np.ndarray, quality: int) -> str:
    data = image_bytes(frame, "WEBP", quality=quality, method=2)
    return f"data:image/webp;base64,{base64.b64encode(data).decode()}"


def image_bytes(pixels: np.ndarray, kind: str, **options: int) -> bytes:
    """Return a file of uint8 [H, W, 3] in memory, by Pillow.

    It has no colour profile: browsers show its bytes unchanged.
    """
    from PIL import Image

    file = io.BytesIO()
    Image.fromarray(pixels).save(file, kind, **options)
    return file.getvalue()


def in_rows(pictures: Sequence[np.ndarray], columns: int = 4) -> np.ndarray:
    """Return one or more pictures [h, w, 3] in rows of `columns`, from the left and from the top.

    The rest of the last row is black. A single picture stays as it is.
    """
    columns = min(columns, len(pictures))
    missing = -len(pictures) % columns
    every = [*pictures, *[np.zeros_like(pictures[0])] * missing]
    return np.concatenate([np.concatenate(every[i : i + columns], 1) for i in range(0, len(every), columns)])
