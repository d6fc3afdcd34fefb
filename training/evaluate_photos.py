"""Measure how photos hold together from the side: `python -m training.evaluate_photos PHOTO ... [--detail auto none]`.

Photos have no truth, but their renders show tears and fog. Each photo with a cut-out becomes Gaussians as by
`lightfield-gs encode`, and is drawn as eyes of a panel see it, 10, 15 and 20 degrees to both sides. Tears are narrow
gaps in the object; fog is neither object nor background. The tears of the photo's own direction are gaps that the photo
has, such as between fingers: only more than these come from the side. training/coverage.py defines both measures.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from training.command import with_line_errors

if TYPE_CHECKING:
    from torch import Tensor

    from lightfield_gs import Cameras, Gaussians, Panel, SplatterNet
    from lightfield_gs.base.options import Detail

_ANGLES_DEG = (-20, -15, -10, 10, 15, 20)
_WIDTH_PX = 1400
_DETAILS = ("auto", "none", "1", "2", "4")


def _options(arguments: list[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog="python -m training.evaluate_photos",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("photos", type=Path, nargs="+", help="pictures of one object each, with a cut-out")
    parser.add_argument("--checkpoint", type=Path, help="safetensors file; default: the one in the package")
    parser.add_argument("--panel", default="65in-8k-96v", help="a panel's name or file (default: 65in-8k-96v)")
    parser.add_argument("--detail", nargs="+", choices=_DETAILS, default=["auto"], help="levels (default: auto)")
    parser.add_argument("--device", default="auto", choices=("auto", "cpu", "cuda"), help="default: a GPU if any")
    parser.add_argument("--json", type=Path, help="file for the results")
    return parser.parse_args(arguments)


def _cameras(gaussians: Gaussians, panel: Panel, angles_deg: tuple[float, ...]) -> Cameras:
    """Return cameras beside the rig's, whose zero plane stays in place, in frames _WIDTH_PX wide."""
    import torch

    from lightfield_gs import Cameras, Rig

    rig = Rig.frame(gaussians, panel)
    height, scale = _WIDTH_PX * panel.height_px // panel.width_px, _WIDTH_PX / panel.width_px
    matrices = np.repeat(np.array(rig.world_to_camera, float)[None], len(angles_deg), 0)
    tangents = np.tan(np.radians(angles_deg))
    matrices[:, 0, 3] -= rig.zero_depth * tangents
    focal = np.repeat(scale * np.array(rig.focal_px)[None], len(angles_deg), 0)
    centre = np.repeat(scale * np.array(rig.principal_point_px)[None], len(angles_deg), 0)
    centre[:, 0] += focal[:, 0] * tangents
    device = gaussians.means.device
    to_camera, focal_px, centre_px = (
        torch.tensor(values, dtype=torch.float32, device=device) for values in (matrices, focal, centre)
    )
    return Cameras(to_camera, focal_px, centre_px, _WIDTH_PX, height)


def _opacities(gaussians: Gaussians, cameras: Cameras) -> Tensor:
    """Return the opacities of all views, [V,H,W]."""
    from lightfield_gs import render

    alpha = render(gaussians, cameras, alpha=True).alpha
    assert alpha is not None
    return alpha


def score_photo(net: SplatterNet, path: Path, detail: str, panel: Panel) -> dict[str, Any]:
    """Return tears and fog of a photo: means over the angles, and of the photo's own direction.

    Args:
        net: the network.
        path: of the photo.
        detail: a level of _DETAILS.
        panel: shows the photo.

    Raises:
        InputError: the photo cannot be read or has no cut-out.
    """
    from lightfield_gs import load_photo
    from lightfield_gs.photo.detail_level import detail_level
    from training.coverage import tears_and_fog

    pixels = load_photo(path)
    wanted = cast("Detail | None", None if detail == "none" else detail if detail == "auto" else int(detail))
    gaussians = net.predict(pixels, detail_level(wanted, net.config, max(pixels.shape[:2]), panel))
    tears, fog = tears_and_fog(_opacities(gaussians, _cameras(gaussians, panel, (0, *_ANGLES_DEG))))
    return {
        "tears": float(tears[1:].mean()),
        "fog": float(fog[1:].mean()),
        "own_tears": float(tears[0]),
        "own_fog": float(fog[0]),
        "gaussians": gaussians.count,
    }


def _row(name: str, row: dict[str, Any]) -> str:
    numbers = "   ".join(f"{100 * row[key]:8.2f}" for key in ("tears", "own_tears", "fog", "own_fog"))
    return f"{name:<32} {numbers}"


@with_line_errors("training.evaluate_photos")
def main(arguments: list[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    options = _options(arguments)
    import torch

    from lightfield_gs import Panel, SplatterNet
    from lightfield_gs.base.device import choose_device
    from lightfield_gs.io.atomic import atomic_path, check_output_path

    if options.json is not None:
        check_output_path(options.json)
    panel = Panel.load(options.panel)
    net = SplatterNet.from_pretrained(options.checkpoint).to(choose_device(options.device))
    reports: dict[str, dict[str, dict[str, Any]]] = {}
    for detail in options.detail:
        print(f"{'detail ' + detail:<32}  tears %   at 0 deg     fog %   at 0 deg")
        rows = reports[detail] = {}
        with torch.no_grad():
            for path in options.photos:
                rows[path.name] = score_photo(net, path, detail, panel)
                print(_row(path.name, rows[path.name]), flush=True)
        mean = {key: float(np.mean([row[key] for row in rows.values()])) for key in next(iter(rows.values()))}
        print(_row("mean", mean))
    if options.json is not None:
        with atomic_path(options.json) as temporary:
            temporary.write_text(json.dumps(reports, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
