"""The scenes that publications report fits of: mip-NeRF 360, Tanks and Temples, Deep Blending.

Splits and sizes are those of Kerbl et al., "3D Gaussian Splatting" (2023): every eighth photograph from the first on is
held out; outdoor scenes of mip-NeRF 360 are read from images_4, indoor ones from images_2, the others as they come.
"""

from __future__ import annotations

import statistics
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchmarks import fit_report
from benchmarks.fit_runs import Source
from lightfield_gs.base.errors import InputError
from lightfield_gs.bench import options
from lightfield_gs.bench.report import aligned, or_dash
from lightfield_gs.io.captures.colmap import model_folder

STEPS, GAUSSIANS = 30_000, 1_000_000
_OUTDOOR = ("bicycle", "flowers", "garden", "stump", "treehill")
_INDOOR = ("room", "counter", "kitchen", "bonsai")
_MIP_NERF, _SEVEN, _TANKS, _BLENDING = "mip-NeRF 360", "mip-NeRF 360, 7 scenes", "Tanks and Temples", "Deep Blending"
# The scenes of each mean. gsplat and others leave out flowers and treehill, which adds 1.5 dB
SETS = {
    _MIP_NERF: (*_OUTDOOR, *_INDOOR),
    _SEVEN: ("bicycle", "garden", "stump", *_INDOOR),
    _TANKS: ("train", "truck"),
    _BLENDING: ("drjohnson", "playroom"),
}
IMAGES = {**dict.fromkeys(_OUTDOOR, "images_4"), **dict.fromkeys(_INDOOR, "images_2")}
SCENES = tuple(dict.fromkeys(scene for scenes in SETS.values() for scene in scenes))
_LAYOUTS = (
    "",
    "*/",
    "*/*/",
)  # a scene itself, in its archive (360_v2, tandt, db), in an archive of archives (tandt_db)


@dataclass(frozen=True)
class Published:
    """A published mean over the scenes of a set.

    Attributes:
        of: name of the set.
        program: its name.
        psnr_db, ssim, lpips: None: not published, or by another network.
        gaussians: in millions; None: not published.
        seconds: of a fit; None: not published.
        source: the card, and the publication.
    """

    of: str
    program: str
    psnr_db: float
    ssim: float | None
    lpips: float | None
    gaussians: float | None
    seconds: float | None
    source: str


_PAPER = "A6000; Kerbl et al. 2023, table 1"
_DASH = "RTX 4090; DashGaussian's README"
_FASTGS = "RTX 4090; FastGS, table 1"
_LITEGS = "RTX 4090; LiteGS' README"
_GSPLAT = "A100; gsplat's docs/source/tests/eval.rst"
PUBLISHED = (
    Published(_MIP_NERF, "3DGS", 27.21, 0.815, 0.214, None, 2493, _PAPER),
    Published(_MIP_NERF, "3DGS, later code", 27.51, 0.816, 0.215, 2.73, 762, _DASH),
    Published(_MIP_NERF, "DashGaussian", 27.70, 0.820, 0.214, 2.42, 372, _DASH),
    Published(_MIP_NERF, "Taming 3DGS", 27.48, 0.794, 0.261, 0.68, 324, _FASTGS),
    Published(_MIP_NERF, "FastGS", 27.56, 0.797, 0.261, 0.40, 116, _FASTGS),
    Published(_MIP_NERF, "FastGS-Big", 27.93, 0.820, 0.216, 1.15, 216, _FASTGS),
    Published(_MIP_NERF, "LiteGS", 27.59, 0.813, 0.230, 1.0, 40, _LITEGS),
    Published(_SEVEN, "gsplat, default", 29.00, 0.87, None, 3.24, 1164, _GSPLAT),
    Published(_SEVEN, "gsplat, MCMC", 29.18, None, None, 1.0, 924, _GSPLAT),
    Published(_SEVEN, "LichtFeld Studio, MCMC", 29.28, 0.879, 0.228, 1.0, None, "LichtFeld-Studio, pull request 245"),
    Published(_TANKS, "3DGS", 23.14, 0.841, 0.183, None, 1614, _PAPER),
    Published(_TANKS, "3DGS, later code", 23.73, 0.853, 0.169, 1.57, 480, _DASH),
    Published(_TANKS, "DashGaussian", 24.01, 0.851, 0.179, 1.20, 234, _DASH),
    Published(_TANKS, "Taming 3DGS", 23.89, 0.833, 0.214, 0.32, 162, _FASTGS),
    Published(_TANKS, "FastGS", 24.15, 0.839, 0.210, 0.24, 79, _FASTGS),
    Published(_TANKS, "FastGS-Big", 24.39, 0.855, 0.175, None, 120, _FASTGS),
    Published(_TANKS, "LiteGS", 23.64, 0.839, 0.184, 1.0, 45, _LITEGS),
    Published(_BLENDING, "3DGS", 29.41, 0.903, 0.243, None, 2162, _PAPER),
    Published(_BLENDING, "3DGS, later code", 29.83, 0.907, 0.238, 2.48, 642, _DASH),
    Published(_BLENDING, "DashGaussian", 29.87, 0.906, 0.246, 1.94, 228, _DASH),
    Published(_BLENDING, "Taming 3DGS", 29.50, 0.894, 0.278, 0.29, 186, _FASTGS),
    Published(_BLENDING, "FastGS", 30.03, 0.901, 0.270, 0.22, 77, _FASTGS),
    Published(_BLENDING, "FastGS-Big", 30.12, 0.907, 0.243, None, 120, _FASTGS),
    Published(_BLENDING, "LiteGS", 30.19, 0.909, 0.252, 1.0, 29, _LITEGS),
)


def find_scenes(folder: Path) -> list[Source]:
    """Find the scenes in a folder of the published archives, and print those found and those missing.

    Args:
        folder: has scenes (garden), archives of scenes (360_v2/garden, tandt/train, db/playroom), or one folder more.

    Raises:
        InputError: there is no scene, or one is there twice.
    """
    found: dict[str, Path] = {}
    for scene in SCENES:
        paths = [path for layout in _LAYOUTS for path in sorted(folder.glob(f"{layout}{scene}")) if model_folder(path)]
        if len(paths) > 1:
            raise InputError(
                f"standard=: expected the scene {scene} once, got {paths[0]} and {paths[1]}: move one away"
            )
        if paths:
            found[scene] = paths[0]
    missing = ", ".join(scene for scene in SCENES if scene not in found)
    if not found:
        raise InputError(
            f"standard=: expected a folder with scenes of {_MIP_NERF}, {_TANKS} or {_BLENDING}, unpacked as published "
            f"(360_v2/garden, tandt/train, db/playroom), found none in {folder}"
        )
    words = f"{folder}: {len(found)} of {len(SCENES)} scenes: {', '.join(found)}"
    options.progress(f"{words}; missing: {missing}" if missing else words)
    return [Source(scene, path, IMAGES.get(scene), from_first=True) for scene, path in found.items()]


def means(found: list[dict[str, Any]], steps: int) -> list[dict[str, Any]]:
    """Return means over scenes of the medians over seeds: a row for each set and arm that has a scene.

    Args:
        found: of fit_report.summary.
        steps: of the fits.

    Returns:
        Rows of set, arm, scenes (how many), missing (names), and the means of psnr_db, ssim, lpips, gaussians, seconds.
    """
    ends = {(row["capture"], row["arm"]): row for row in found if row["step"] == steps}
    rows = []
    for name, scenes in SETS.items():
        for arm in dict.fromkeys(arm for _, arm in ends):
            if some := [ends[scene, arm] for scene in scenes if (scene, arm) in ends]:
                row = {"set": name, "arm": arm, "scenes": len(some)}
                row["missing"] = [scene for scene in scenes if (scene, arm) not in ends]
                for number in ("psnr_db", "ssim", "lpips", "gaussians", "seconds"):
                    row[number] = _mean([fit_report.median(scene, number) for scene in some])
                rows.append(row)
    return rows


def _mean(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return statistics.fmean(known) if len(known) == len(values) else None


def table(result: dict[str, Any]) -> str:
    """Return the means of our arms beside the published ones; a set without a fit is left out."""
    protocol, machine = result["protocol"], result["machine"]
    rows = means(fit_report.summary(result["rows"]), protocol["steps"])
    here = f"{machine.get('gpu', machine['processor'])}; measured here"
    head = ("program", "scenes", "PSNR dB", "SSIM", "LPIPS", "million Gaussians", "seconds", "card; source")
    parts = []
    for name, scenes in SETS.items():
        own = [row for row in rows if row["set"] == name]
        if not own:
            continue
        lines = [
            (
                row["arm"],
                f"{row['scenes']} of {len(scenes)}",
                *_numbers(row["psnr_db"], row["ssim"], row["lpips"], row["gaussians"] / 1e6, row["seconds"]),
                here,
            )
            for row in own
        ]
        lines += [
            (
                row.program,
                f"{len(scenes)} of {len(scenes)}",
                *_numbers(row.psnr_db, row.ssim, row.lpips, row.gaussians, row.seconds),
                row.source,
            )
            for row in PUBLISHED
            if row.of == name
        ]
        parts += [f"{name}, means over scenes:", *aligned([head, *lines]), *_caveats(own)]
    if (protocol["steps"], protocol["gaussians"], protocol["longest_px"]) != (STEPS, GAUSSIANS, None):
        size = "" if protocol["longest_px"] is None else f", photographs of at most {protocol['longest_px']} px"
        parts.append(
            f"not as published: {protocol['steps']} steps, {protocol['gaussians']} Gaussians{size}; expected {STEPS} "
            f"steps, {GAUSSIANS} Gaussians and whole photographs"
        )
    return "\n".join(parts)


def _numbers(
    psnr_db: float | None, ssim: float | None, lpips: float | None, millions: float | None, seconds: float | None
) -> tuple[str, ...]:
    forms = ((psnr_db, ".2f"), (ssim, ".3f"), (lpips, ".3f"), (millions, ".2f"), (seconds, ".0f"))
    return tuple(or_dash(value, form) for value, form in forms)


def _caveats(own: list[dict[str, Any]]) -> list[str]:
    """Say which scenes a mean lacks: it compares with no published one."""
    lacking = sorted({scene for row in own for scene in row["missing"]})
    return [f"without {', '.join(lacking)}, ours compare with no published mean", ""] if lacking else [""]
