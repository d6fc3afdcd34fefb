"""Compare the lenses of simulated panels before and after `calibrate fit --refine`, by photographs with noise.

`python -m benchmarks.calibration` prints a row for each panel. A lens that stands in a simple ratio to the sub-pixels
is the hard case: slants of 1/3, 1/4 and 0.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from lightfield_gs.base.arrays import decode_srgb, encode_srgb
from lightfield_gs.bench.report import aligned
from lightfield_gs.panels.calibration_fit import fit_lens
from lightfield_gs.panels.calibration_photos import Viewpoint, bilinear, homography
from lightfield_gs.panels.calibration_refine import refine_lens
from lightfield_gs.panels.lens_change import phase_in_middle, replace_lens
from lightfield_gs.panels.panel import Panel
from lightfield_gs.panels.patterns import bars
from lightfield_gs.panels.simulate import simulate

LENSES = ((9.848, 1 / 6), (9.0, 1 / 3), (16.013, -0.18), (5.33, 0.25), (6.0, 0.0))  # line number, slant_tan
BASE = Panel(960, 540, 48, 9.848, 1 / 6, phase=-310.4, viewing_distance_mm=600, pixel_pitch_mm=0.2, name="simulated")
CORNERS = np.array([[92.3, 61.8], [694.1, 90.2], [668.7, 452.9], [121.4, 428.6]])
SIZE_PX = (520, 780)
EYES = ((0.0, 0.0, 600.0), (70.0, 20.0, 560.0))
NOISE = 0.01  # standard deviation of sRGB codes in 0..1


def photograph(
    image: np.ndarray,
    true: Panel,
    eye: Sequence[float],
    corners: np.ndarray = CORNERS,
    size: tuple[int, int] = SIZE_PX,
    noise: float = NOISE,
    seed: int = 0,
) -> np.ndarray:
    """8-bit codes of what a camera at the eye takes of the panel in a dark room: in perspective, blurred, noisy."""
    seen = simulate(decode_srgb(image / 255), true, eye)
    y, x = np.mgrid[0 : size[0], 0 : size[1]] + 0.5
    back = np.stack([x, y, np.ones_like(x)], -1) @ np.linalg.inv(homography(corners)).T
    uv = back[..., :2] / back[..., 2:]
    inside = ((uv > 0) & (uv < 1)).all(-1)
    places = np.clip(uv * seen.shape[1::-1], 0.5, np.array(seen.shape[1::-1]) - 0.5)
    light = np.where(inside[..., None], bilinear(seen, places), 0.004)
    for axis in (0, 1):
        light = (np.roll(light, 1, axis) + 2 * light + np.roll(light, -1, axis)) / 4
    code = encode_srgb(np.clip(light, 0, 1)) + noise * np.random.default_rng(seed).standard_normal(light.shape)
    return np.rint(255 * np.clip(code, 0, 1)).astype(np.uint8)


def perturbed(panel: Panel, random: np.random.Generator) -> Panel:
    """The panel with up to 0.1 % more or less of its line number, 0.5 % of its slant, and 0.3 lens widths of phase."""
    line, slant, turns = random.uniform(-1, 1, 3) * (1e-3, 5e-3, 0.3)
    return replace_lens(
        panel, panel.line_number * (1 + line), panel.slant_tan * (1 + slant), phase_in_middle(panel) + turns
    )


def errors(found: Panel, true: Panel) -> dict[str, float]:
    """Errors of a lens: of line_number (relative), of slant_tan, of the middle's phase in views, and of the view of the
    worst corner."""
    turns = phase_in_middle(found) - phase_in_middle(true)
    corners = []
    for i in (0, true.height_px):
        for j in (0, true.width_px):
            there = [(3 * j + 3 * i * p.slant_tan + p.phase) / p.line_number for p in (found, true)]
            corners.append((there[0] - there[1] + 0.5) % 1 - 0.5)
    return {
        "line_number": abs(found.line_number / true.line_number - 1),
        "slant_tan": abs(found.slant_tan - true.slant_tan),
        "phase_views": abs((turns + 0.5) % 1 - 0.5) * true.views,
        "worst_views": max(map(abs, corners)) * true.views,
    }


def rows(
    noise: float = NOISE, lenses: Sequence[tuple[float, float]] = LENSES, base: Panel = BASE
) -> Iterator[dict[str, Any]]:
    """A row for each lens: its errors before and after, and seconds of both fits."""
    random = np.random.default_rng(0)
    for line_number, slant in lenses:
        start = replace(base, line_number=line_number, slant_tan=slant)
        true = perturbed(start, random)
        sights = [
            Viewpoint(
                eye,
                tuple(photograph(bars(start, s), true, eye, noise=noise, seed=s) for s in range(3)),
                CORNERS.tolist(),
            )
            for eye in EYES
        ]
        begun = time.perf_counter()
        fit = fit_lens(sights, start)
        between = time.perf_counter()
        refined = refine_lens(sights, start, fit)
        yield {
            "line_number": line_number,
            "slant_tan": slant,
            "before": errors(fit.panel, true),
            "after": errors(refined.panel, true),
            "fit_s": between - begun,
            "refine_s": time.perf_counter() - between,
        }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--noise", type=float, default=NOISE, help="standard deviation of sRGB codes in 0..1")
    head = ("line number", "slant", *("line number, relative", "slant", "phase, views", "worst corner, views"), "s")
    lines = []
    for row in rows(parser.parse_args().noise):
        change = [f"{row['before'][key]:.2g} -> {row['after'][key]:.2g}" for key in row["before"]]
        times = f"{row['fit_s']:.1f} + {row['refine_s']:.1f}"
        lines.append((f"{row['line_number']:g}", f"{row['slant_tan']:.3f}", *change, times))
    print(*aligned([head, *lines]), sep="\n")


if __name__ == "__main__":
    main()
