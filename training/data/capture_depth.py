"""The depth map of a photograph of a capture, from a scene that was fitted to the capture:
`python -m training.data.capture_depth --capture FOLDER --scene SCENE --name PHOTOGRAPH --output FILE.npz`.

What `make demo` takes for a photograph with depth is made so: see lightfield_gs/data/banana/README.txt.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np
import torch

from lightfield_gs.base.errors import InputError
from lightfield_gs.io.atomic import atomic_path, check_output_path
from lightfield_gs.io.captures.capture import Capture, read_capture
from lightfield_gs.io.scenes.files import read_scene
from lightfield_gs.rasterizer.images import render
from lightfield_gs.scene.cameras import Cameras
from lightfield_gs.scene.gaussians import Gaussians
from training.command import with_line_errors

_COVERED = 0.1  # alpha from which on a pixel has a depth: what is dark in a photograph may be hardly covered by a fit
_WINDOW_PX = 7  # side of the windows whose medians the depths are, so that specks and small gaps are gone


def write_capture_depth(capture: Path, scene: Path, name: str, output: Path) -> tuple[float, float]:
    """Write an .npz with the depth of a photograph, and return the smallest and the largest z.

    The file holds `depth`, float16 [H, W], and `focallength_px`. Depth is the view-space z in scene units, a median of
    7 x 7 pixels, and NaN where the scene shows nothing. The photograph's lens distortion is left out.

    Raises:
        InputError: a file cannot be read or written, the capture lacks the name, or the scene shows nothing there.
    """
    if check_output_path(output).suffix.lower() != ".npz":
        raise InputError(f"{output}: expected a name that ends in .npz")
    photographs = read_capture(capture)
    if name not in photographs.names:
        raise InputError(f"{capture}: expected one of its photographs, {', '.join(photographs.names)}, got {name!r}")
    cameras = photograph_camera(photographs, name, gaussians := read_scene(scene).gaussians)
    z = photograph_depth(gaussians, cameras).numpy()
    if np.isnan(z).all():
        raise InputError(f"{scene}: shows nothing where {name} was taken; is it fitted to {capture}?")
    with atomic_path(output) as temporary, open(temporary, "wb") as file:
        np.savez_compressed(file, depth=z.astype(np.float16), focallength_px=np.float32(cameras.focal_px[0, 0]))
    return float(np.nanmin(z)), float(np.nanmax(z))


def photograph_camera(photographs: Capture, name: str, gaussians: Gaussians) -> Cameras:
    """Return the camera of a photograph in the axes of a scene that was fitted to the capture."""
    index = photographs.names.index(name)
    fx, fy, cx, cy = photographs.intrinsics[index]
    pose = photographs.world_to_camera[index].copy()
    pose[:3, 3] += pose[:3, :3] @ np.asarray(gaussians.origin)
    return Cameras(
        torch.from_numpy(pose[None]).float(),
        torch.tensor([[fx, fy]]).float(),
        torch.tensor([[cx, cy]]).float(),
        *photographs.sizes_px[index].tolist(),
    )


@torch.no_grad()
def photograph_depth(gaussians: Gaussians, cameras: Cameras) -> torch.Tensor:
    """Return the depths [H, W] of a scene in its only camera's view, medians of 7 x 7 pixels, NaN where nothing is."""
    _, alpha, depth, _ = render(gaussians, cameras, alpha=True, depth=True)
    return _medians(torch.where(alpha[0] >= _COVERED, depth[0], torch.nan))


def _medians(z: torch.Tensor) -> torch.Tensor:
    """Return the median of the numbers around each pixel [H, W]; NaN where half of the window is NaN."""
    reach = _WINDOW_PX // 2
    windows = torch.nn.functional.pad(z[None, None], [reach] * 4, mode="replicate")[0, 0]
    windows = windows.unfold(0, _WINDOW_PX, 1).unfold(1, _WINDOW_PX, 1).flatten(2)
    is_seen = windows.isfinite().double().mean(2) > 0.5
    return torch.where(is_seen, windows.nanmedian(2).values, torch.nan)


@with_line_errors("training.data.capture_depth")
def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m training.data.capture_depth", description=__doc__)
    parser.add_argument("--capture", type=Path, required=True, help="a folder with photographs and their cameras")
    parser.add_argument("--scene", type=Path, required=True, help="Gaussians that were fitted to it")
    parser.add_argument("--name", required=True, help="of the photograph, as the capture has it")
    parser.add_argument("--output", type=Path, required=True, help="the depth map, .npz")
    args = parser.parse_args(arguments)
    near, far = write_capture_depth(args.capture, args.scene, args.name, args.output)
    print(f"{args.output}: depths {near:.4g} to {far:.4g}; `encode {args.name} --depth {args.output}` takes it")
    return 0


if __name__ == "__main__":
    sys.exit(main())
