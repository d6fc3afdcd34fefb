"""Photographs of a panel that shows the bars of panels.patterns: their files, and the phase of the bars in them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from lightfield_gs.base.arrays import decode_srgb
from lightfield_gs.base.checks import expect, is_row, real_number, shown
from lightfield_gs.base.errors import InputError, named
from lightfield_gs.io.images import as_floats, read_image
from lightfield_gs.io.text_files import check_keys, read_mapping


@dataclass(frozen=True)
class CalibrationPhotoConstants:
    """Thresholds of the measurement.

    All are chosen by hand and not tuned on photographs; tests/panels/test_calibration_fit.py has simulated photographs
    that they must accept or refuse.
    """

    most_cells: int = 256  # cells along the longer side of the panel, at most: bars are far wider
    most_points: int = 6  # samples of a cell each way, at most
    clipped: float = 0.99  # sRGB code from which on a pixel counts as clipped
    dark: float = 0.1  # light, by the 95th percentile, up to which a cell is too dark
    least_contrast: float = 0.1  # amplitude of the bars by their mean, at least
    least_unclipped: float = 0.999  # unclipped fraction of a cell, at least
    least_area: float = 0.2  # fraction of the cells that show bars, at least
    least_extent: float = 0.5  # extent of these cells by the width and by the height of the panel, at least
    edge_points: int = 200  # points along an edge
    edge_reach: float = 0.06  # distance from an edge that is searched, in lengths of the edge
    edge_margin: float = 0.08  # fraction of an edge at either end without points
    outliers: float = 2.5  # median distances from its line beyond which a point is left out, as on a stand before it
    least_panel: float = 0.02  # fraction of the photograph that is bright, at least
    area_tolerance: float = 0.1  # relative difference of the bright area from its quadrilateral, at most
    exposure_ratio: float = 1.02  # ratio of exposures in the Exif of photographs of one place, at most
    least_side_px: int = 32  # length of a side of the panel in the photographs, at least
    rim_px: float = 1.0  # distance from the rim of the photographs at which a corner is where the panel is cut off


CONSTANTS = CalibrationPhotoConstants()
_EXIF, _EXPOSURE_TAGS = 0x8769, (0x829A, 0x829D, 0x8827)  # time, f-number, ISO


@dataclass(frozen=True)
class Viewpoint:
    """Photographs from one viewpoint, all with the same exposure.

    Attributes:
        eye_mm: Position of the camera, (x, y, z) from the panel's middle: right, up, towards the viewer.
        photos: [H, W, 3], sRGB codes, uint8, uint16 or float32 in 0..1. Three photographs show the grey bars with the
            shifts 0, 1, 2 in this order; or one shows the bars in red, green and blue.
        corners_px: Corners of the panel's picture area: upper left, upper right, lower right, lower left. x is right
            and y down from the photograph's upper left corner. None: find them, which needs dark surroundings.
        name: For messages.
    """

    eye_mm: tuple[float, float, float]
    photos: tuple[np.ndarray, ...]
    corners_px: Sequence[Sequence[float]] | None = None
    name: str = "photographs"

    def __post_init__(self) -> None:
        if not is_row(self.eye_mm, 3):
            raise InputError(f"{self.name}: the eye must be x, y, z in mm, got {shown(self.eye_mm)}")
        for value in self.eye_mm:
            real_number(f"{self.name}: eye", value, -1e7, 1e7)
        if self.eye_mm[2] <= 0:
            raise InputError(f"{self.name}: z of the eye, its distance before the panel, must be above 0")
        if len(self.photos) not in (1, 3):
            raise InputError(
                f"{self.name}: expected three photographs, of the shifts 0, 1 and 2, or one of the bars in red, green "
                f"and blue, got {len(self.photos)}; fewer shifts leave the phase ambiguous"
            )
        for photo in self.photos:
            expect(f"{self.name}: photo", photo, np.ndarray)
            if photo.dtype.name not in ("uint8", "uint16", "float32"):
                raise InputError(f"{self.name}: expected photographs of uint8, uint16 or float32, got {photo.dtype}")
            if photo.ndim != 3 or photo.shape[2] < 3 or photo.shape[:2] != self.photos[0].shape[:2]:
                raise InputError(f"{self.name}: expected photographs of one size [H, W, 3], got {list(photo.shape)}")

    def light(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the light of the three shifts, float32 [H, W, 3], and a mask of unclipped pixels, bool [H, W]."""
        codes = [as_floats(photo[..., :3]) for photo in self.photos]
        free = np.all([code.max(2) < CONSTANTS.clipped for code in codes], 0)
        light = [decode_srgb(code) for code in codes]
        return (light[0] if len(light) == 1 else np.stack([one.mean(2) for one in light], 2)), free


@dataclass(frozen=True)
class Fringes:
    """The bars over the panel, in cells.

    Attributes:
        wave: Complex [rows, columns], e^(2 pi i phase) where the bars are visible, else 0. The phase is x/N of the view
            in the cell's middle.
        corners_px: [4, 2], given or found.
    """

    wave: np.ndarray
    corners_px: np.ndarray


def measure_fringes(viewpoint: Viewpoint, columns: int, rows: int) -> Fringes:
    """Measure the bars in the photographs of a viewpoint, in cells [rows, columns] of the panel.

    Raises:
        InputError: The panel or its bars cannot be seen.
    """
    wave, corners = measure_waves(viewpoint, columns, rows)
    return Fringes(np.where(wave != 0, wave / np.maximum(np.abs(wave), 1e-30), 0), corners)


def wave_of(shifts: np.ndarray) -> np.ndarray:
    """Return the complex amplitude of bars [...] from their light at the shifts 0, 1 and 2, [..., 3]."""
    # The sum of cos(a - 2 pi s/3) e^(2 pi i s/3) over s = 0, 1, 2 is 3/2 e^(i a)
    return shifts @ np.exp(2j * np.pi * np.arange(3) / 3) * (2 / 3)


def measure_waves(viewpoint: Viewpoint, columns: int, rows: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the bars as measure_fringes does, but with their amplitude in light, and the corners [4, 2]."""
    light, free = viewpoint.light()
    corners = _panel_corners(viewpoint, light)
    middle = _cell_means(np.concatenate([light, free[..., None]], 2), corners, columns, rows)
    shifts, mean = middle[..., :3], middle[..., :3].mean(2)
    wave = wave_of(shifts)
    visible = (
        (middle[..., 3] > CONSTANTS.least_unclipped)
        & (mean > CONSTANTS.dark * np.percentile(mean, 95))
        & (np.abs(wave) > CONSTANTS.least_contrast * mean)
    )
    _check_visible(viewpoint, visible)
    return np.where(visible, wave, 0), corners


def _check_visible(viewpoint: Viewpoint, visible: np.ndarray) -> None:
    """Raise InputError where too little of the panel shows bars to tell how they run."""
    spread = [
        np.ptp(np.flatnonzero(visible.any(axis))) / visible.shape[1 - axis] if visible.any() else 0 for axis in (0, 1)
    ]
    if visible.mean() < CONSTANTS.least_area or min(spread) < CONSTANTS.least_extent:
        raise InputError(
            f"{viewpoint.name}: the bars can be seen on {100 * visible.mean():.0f} % of the panel, "
            f"{100 * spread[0]:.0f} % of its width and {100 * spread[1]:.0f} % of its height; expected 20, 50 and 50 % "
            "at least. Show the shifts 0, 1 and 2, keep the exposure, clip nothing, darken the room, or check the "
            "corners"
        )


def _panel_corners(viewpoint: Viewpoint, light: np.ndarray) -> np.ndarray:
    """Return the panel's corners [4, 2], clockwise from the upper left; raise InputError for no such shape."""
    if viewpoint.corners_px is None:
        corners = find_corners(light.mean(2), viewpoint.name)
    else:
        given = [list(corner) if is_row(corner, 2) else [] for corner in viewpoint.corners_px]
        if [len(pair) for pair in given] != [2, 2, 2, 2]:
            raise InputError(
                f"{viewpoint.name}: corners must be four pairs x, y in pixels, got {shown(viewpoint.corners_px)}"
            )
        corners = np.array([[real_number(f"{viewpoint.name}: corner", v, -1e5, 1e5) for v in pair] for pair in given])
    sides = np.roll(corners, -1, 0) - corners
    turns = sides[:, 0] * np.roll(sides[:, 1], -1) - sides[:, 1] * np.roll(sides[:, 0], -1)
    if not (turns > 0).all() or np.hypot(*sides.T).min() < CONSTANTS.least_side_px:
        raise InputError(
            f"{viewpoint.name}: expected the corners upper left, upper right, lower right, lower left, with sides of "
            f"{CONSTANTS.least_side_px} px at least, got {shown(corners.round(1).tolist())}"
        )
    return corners


def find_corners(light: np.ndarray, name: str = "photographs") -> np.ndarray:
    """Find the corners of a bright panel in a dark room.

    Args:
        light: [H, W], the mean over the shifts, in which the bars vanish.
        name: For messages.

    Returns:
        [4, 2] in pixels, clockwise from the upper left.

    Raises:
        InputError: There is no such bright quadrilateral.
    """
    from scipy.ndimage import uniform_filter

    level = 0.5 * np.median(light[light > 0.5 * np.percentile(light, 99)])
    bright = uniform_filter(light, 5, mode="nearest") > level  # so that noise has no corners
    y, x = np.nonzero(bright)
    if len(x) < CONSTANTS.least_panel * light.size:
        raise InputError(f"{name}: no bright panel was found; give its corners")
    approximate = [np.argmin(x + y), np.argmin(y - x), np.argmax(x + y), np.argmax(y - x)]
    corners = np.stack([x[approximate], y[approximate]], 1) + 0.5
    lines = [_edge(light, level, a, b) for a, b in zip(corners, np.roll(corners, -1, 0))]
    if any(line is None for line in lines):
        raise InputError(f"{name}: the edges of the panel were not found; give its corners")
    refined = np.stack([np.cross(a, b) for a, b in zip(np.roll(np.array(lines), 1, 0), np.array(lines))])
    refined = refined[:, :2] / refined[:, 2:]
    following = np.roll(refined, -1, 0)
    area = 0.5 * abs(np.sum(refined[:, 0] * following[:, 1] - refined[:, 1] * following[:, 0]))
    if not 1 - CONSTANTS.area_tolerance < bright.sum() / area < 1 + CONSTANTS.area_tolerance:
        raise InputError(f"{name}: what is bright is no quadrilateral; darken the room, or give the corners")
    if (refined < CONSTANTS.rim_px).any() or (refined > np.array(light.shape[::-1]) - CONSTANTS.rim_px).any():
        raise InputError(
            f"{name}: expected the whole panel with darkness around it, got one that the photographs cut off at their "
            "rim; take it whole, or give its corners"
        )
    return refined


def _edge(light: np.ndarray, level: float, start: np.ndarray, end: np.ndarray) -> np.ndarray | None:
    """Return the line (a, b, c), a x + b y + c = 0, where the light rises through the level near start..end."""
    along = end - start
    length = math.hypot(*along)
    if length < CONSTANTS.least_side_px:
        return None
    outwards = np.array([along[1], -along[0]]) / length
    reach = max(4.0, CONSTANTS.edge_reach * length)
    steps = np.linspace(reach, -reach, int(4 * reach) + 1)  # from outside to inside
    feet = start + np.linspace(CONSTANTS.edge_margin, 1 - CONSTANTS.edge_margin, CONSTANTS.edge_points)[:, None] * along
    profile = bilinear(light[..., None], feet[:, None] + steps[:, None] * outwards)[..., 0]
    inside = profile > level
    first = inside.argmax(1)
    good = (first > 0) & inside[:, -1]
    if good.sum() < CONSTANTS.edge_points // 4:
        return None
    row, k = np.flatnonzero(good), first[good]
    before, after = profile[row, k - 1], profile[row, k]
    place = steps[k - 1] + (steps[k] - steps[k - 1]) * (level - before) / (after - before)
    points = feet[good] + place[:, None] * outwards
    for _ in range(3):  # without points off the line, as of a stand before the edge
        middle = points.mean(0)
        normal = np.linalg.svd(points - middle)[2][1]
        away = np.abs((points - middle) @ normal)
        points = points[away <= max(0.5, CONSTANTS.outliers * float(np.median(away)))]
    return np.array([*normal, -normal @ middle])


def _cell_means(values: np.ndarray, corners: np.ndarray, columns: int, rows: int) -> np.ndarray:
    """Return means of an image [H, W, C] over the cells of the panel, [rows, columns, C], by a homography."""
    sides = np.roll(corners, -1, 0) - corners
    cell_px = max(np.hypot(*sides[::2].T).max() / columns, np.hypot(*sides[1::2].T).max() / rows)
    points = min(CONSTANTS.most_points, max(1, math.ceil(cell_px)))
    matrix = homography(corners)
    total = np.zeros((rows, columns, values.shape[2]))
    for down in range(points):
        for across in range(points):
            u = (np.arange(columns) + (across + 0.5) / points) / columns
            v = (np.arange(rows) + (down + 0.5) / points) / rows
            positions = np.stack([*np.meshgrid(u, v), np.ones((rows, columns))], -1) @ matrix.T
            total += bilinear(values, positions[..., :2] / positions[..., 2:])
    return total / points**2


def homography(corners: np.ndarray) -> np.ndarray:
    """Return the matrix [3, 3] from the panel to the photo.

    It takes (u, v, 1), u right and v down over the panel in 0..1, to homogeneous pixels; corners: [4, 2].
    """
    rows, right = [], []
    for (u, v), (x, y) in zip(((0, 0), (1, 0), (1, 1), (0, 1)), corners):
        rows += [[u, v, 1, 0, 0, 0, -u * x, -v * x], [0, 0, 0, u, v, 1, -u * y, -v * y]]
        right += [x, y]
    return np.append(np.linalg.solve(np.array(rows, float), np.array(right, float)), 1).reshape(3, 3)


def bilinear(values: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return values [H, W, C] interpolated at points [..., 2] (x, y), pixel centres at i + 0.5; 0 outside."""
    height, width = values.shape[:2]
    x, y = points[..., 0] - 0.5, points[..., 1] - 0.5
    left, top = np.floor(x).astype(int), np.floor(y).astype(int)
    out = np.zeros((*x.shape, values.shape[2]))
    for j, across in ((left, left + 1 - x), (left + 1, x - left)):
        for i, down in ((top, top + 1 - y), (top + 1, y - top)):
            inside = (i >= 0) & (i < height) & (j >= 0) & (j < width)
            weight = np.where(inside, across * down, 0)[..., None]
            out += weight * values[np.clip(i, 0, height - 1), np.clip(j, 0, width - 1)]
    return out


Corners = Sequence[Sequence[float]]


def read_viewpoints(path: str | Path) -> list[Viewpoint]:
    """Read the viewpoints of a YAML file (at most 64 KiB), with their photographs, whose names are relative to it.

        places:
          - eye_mm: [0, 0, 600]
            photos: [left-0.jpg, left-1.jpg, left-2.jpg]
            corners_px: [[92, 61], [694, 90], [668, 452], [121, 428]]    # may be left out

    Raises:
        InputError: The file or a photograph cannot be read; the message names the file.
    """
    path = Path(path)
    listed = read_mapping(path, ("places",), ())["places"]
    if not is_row(listed):
        raise InputError(f"{path}: places must be a list, got {shown(listed)}")
    return [_viewpoint(path, number, entry) for number, entry in enumerate(listed)]


def _viewpoint(path: Path, number: int, entry: object) -> Viewpoint:
    where = f"{path}: places[{number}]"
    if not isinstance(entry, dict):
        raise InputError(f"{where}: expected eye_mm, photos and perhaps corners_px, got {shown(entry)}")
    check_keys(entry, ("eye_mm", "photos"), ("corners_px",), where)
    eye, photos, corners = entry["eye_mm"], entry["photos"], entry.get("corners_px")
    if not is_row(photos) or not all(isinstance(photo, str) for photo in photos):
        raise InputError(f"{where}: photos must be a list of file names, got {shown(photos)}")
    if not is_row(eye, 3):
        raise InputError(f"{where}: eye_mm must be x, y, z, got {shown(eye)}")
    if corners is not None and not is_row(corners, 4):
        raise InputError(f"{where}: corners_px must be four pairs x, y, got {shown(corners)}")
    with named(where):
        return load_viewpoint([path.parent / photo for photo in photos], tuple(eye), corners)


def load_viewpoint(
    photos: Sequence[str | Path], eye_mm: tuple[float, float, float], corners_px: Corners | None = None
) -> Viewpoint:
    """Return a viewpoint by the files of its photographs, which are turned upright and taken for sRGB.

    Args:
        photos: Their paths, see Viewpoint.
        eye_mm: See Viewpoint.
        corners_px: See Viewpoint.

    Raises:
        InputError: A photograph cannot be read, or an argument is invalid.
    """
    expect("eye_mm", eye_mm, tuple)
    _check_exposures(photos)
    pictures = tuple(_rgb(read_image(photo, as_stored=True)) for photo in photos)
    names = " ".join(Path(photo).name for photo in photos)
    return Viewpoint(eye_mm, pictures, corners_px, name=names[:80])


def _check_exposures(photos: Sequence[str | Path]) -> None:
    """Raise InputError where cameras noted that photographs of one place got unlike exposures."""
    noted = {Path(photo).name: exposure for photo in photos if (exposure := read_exposure(Path(photo))) is not None}
    if noted and max(noted.values()) > CONSTANTS.exposure_ratio * min(noted.values()):
        told = ", ".join(f"{name} {exposure / min(noted.values()):.3g}" for name, exposure in noted.items())
        raise InputError(
            f"expected photographs of one exposure from each place, got unlike ones by their Exif (relative: {told}): "
            "lock the exposure and the white balance, and take them again"
        )


def read_exposure(path: Path) -> float | None:
    """Return what the camera noted of the light that a photograph got, in s ISO / (f-number)^2; None without a note."""
    from PIL import Image

    try:
        with Image.open(path) as image:
            noted = image.getexif().get_ifd(_EXIF)
    except (OSError, SyntaxError, ValueError):  # its reader says what is wrong with the file
        return None
    values: list[Any] = [noted.get(tag) for tag in _EXPOSURE_TAGS]
    time, aperture, speed = values
    speed = speed[0] if isinstance(speed, tuple) and speed else speed
    try:
        exposure = float(time) * float(speed) / float(aperture) ** 2
    except (TypeError, ValueError, ZeroDivisionError):
        return None
    return exposure if math.isfinite(exposure) and exposure > 0 else None


def _rgb(pixels: np.ndarray) -> np.ndarray:
    """Return [H, W, 3] of an image of any channels."""
    return pixels[..., :3] if pixels.shape[2] >= 3 else np.repeat(pixels[..., :1], 3, 2)
