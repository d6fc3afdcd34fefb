"""Quality of the pictures that eyes see of a panel across its viewing cone, against exact cameras at these eyes."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch

from lightfield_gs.base.checks import expect, real_number, whole_number
from lightfield_gs.panels.panel import Panel
from lightfield_gs.panels.rig import Rig
from lightfield_gs.panels.simulate import Psf, eye_row, simulate, zone_width_mm
from lightfield_gs.rasterizer.images import render
from lightfield_gs.reference.metrics import psnr_db, ssim
from lightfield_gs.scene.gaussians import Gaussians

MOST_EYES = 1000


@dataclass(frozen=True)
class EyeScore:
    """The score of one eye at the viewing distance, against the picture of the exact camera.

    Attributes:
        right_mm: Position to the right.
        view: The view coordinate x that it sees.
        psnr_db: PSNR.
        ssim: SSIM.
    """

    right_mm: float
    view: float
    psnr_db: float
    ssim: float


def eyes_across(panel: Panel, count: int, fraction: float = 0.75) -> np.ndarray:
    """Return eyes [count, 3] in mm, spread evenly from left to right over the middle of the panel's viewing zone.

    At the ends of the zone an eye sees the first and the last view at once.

    Args:
        panel: The panel.
        count: Number of eyes.
        fraction: Of the zone, 0..1.

    Raises:
        InputError: An argument is invalid.
    """
    count, fraction = whole_number("count", count, 1, MOST_EYES), real_number("fraction", fraction, 0.0, 1.0)
    half = fraction * zone_width_mm(panel) / 2
    return eye_row(panel, -half, half, count)


def view_coordinates(panel: Panel, eyes_mm: np.ndarray) -> np.ndarray:
    """Return the view coordinates x [K] that eyes [K, 3] at the viewing distance see; raise InputError."""
    aside = (eyes_mm[:, 0] - eyes_mm[:, 1] * panel.slant_tan) * (-1 if panel.invert_views else 1)
    return panel.views * (0.5 - aside / zone_width_mm(panel))


class EyeReference:
    """The pictures that eyes at the viewing distance would see of a scene if every view were exact.

    A camera at the eye renders every sub-pixel of the panel; the lenses are those of the judged picture. Spatial
    sampling is then the same in both pictures, and only the panel's mixing of views differs. The cameras are ordinary
    pinholes, whatever filter the judged image has.
    """

    @torch.no_grad()
    def __init__(
        self,
        gaussians: Gaussians,
        panel: Panel,
        rig: Rig,
        eyes_mm: np.ndarray,
        *,
        background: tuple[float, float, float] = (1.0, 1.0, 1.0),
        antialiased: bool = False,
        spread_subpixels: float = 1.0,
        psf: Psf | None = None,
    ):
        """Render K cameras at the panel's resolution, one at a time.

        Args:
            gaussians: One set.
            panel: The panel.
            rig: Its rig.
            eyes_mm: [K, 3] at the viewing distance, as eyes_across makes them.
            background: See encode.
            antialiased: See encode.
            spread_subpixels: See simulate.
            psf: See simulate.

        Raises:
            InputError: An argument is invalid.
        """
        expect("panel", panel, Panel)
        self.panel, self.eyes_mm, self.views = panel, np.asarray(eyes_mm, np.float64), view_coordinates(panel, eyes_mm)
        self.spread, self.psf = spread_subpixels, psf
        pictures = []
        for x, eye in zip(self.views, self.eyes_mm):
            camera = rig.cameras_at(panel, np.array([x]))
            exact = render(gaussians, camera, background=background, antialiased=antialiased).image[0].clamp(0, 1)
            pictures.append(self._seen(exact.cpu().numpy(), eye))
        self.pictures = np.stack(pictures)

    def _seen(self, image: np.ndarray, eye_mm: np.ndarray) -> np.ndarray:
        return simulate(image, self.panel, eye_mm.tolist(), self.spread, psf=self.psf)

    def scores(self, image: np.ndarray) -> Iterator[EyeScore]:
        """Yield the scores of a light-field image [H, W, 3] of the panel, eye by eye; raise InputError."""
        for eye, x, expected in zip(self.eyes_mm, self.views, self.pictures):
            seen, exact = (
                torch.from_numpy(picture).permute(2, 0, 1).double() for picture in (self._seen(image, eye), expected)
            )
            yield EyeScore(float(eye[0]), float(x), float(psnr_db(seen, exact)), float(ssim(seen, exact)))
