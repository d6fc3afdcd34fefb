"""Draw the sheet of docs/capturing.md: three eyes' views of fits to good photographs, to few, and to blurred ones.

`python benchmarks/capture_pictures.py` fits the photographs of lightfield_gs/data/banana three times, some minutes on
two cores. All fits start with the same poses and points, so that only the photographs differ.
"""

from __future__ import annotations

import argparse
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image, ImageDraw, ImageFont
from scipy import ndimage

import lightfield_gs as lf
from benchmarks.pictures import ROOT, save, stack
from lightfield_gs.encoding.classic import render_views
from lightfield_gs.io.captures.capture import Capture, read_capture
from lightfield_gs.panels.rig import Rig
from lightfield_gs.video.camera_path import orbit

PANEL = "65in-8k-96v"
NARROW = ("DSC_0423", "DSC_0424", "DSC_0425", "DSC_0426", "DSC_0438")  # from -13 to 10 degrees
EYES_DEG = (-18.0, 0.0, 18.0)
LONGEST_PX, SHAKEN_PX = 376, 14
FIT: dict[str, Any] = {
    "steps": 1200,
    "cap_max": 15_000,
    "sh_degree": 2,
    "device": "cpu",
    "test_every": None,
    "background": (1.0,) * 3,
}
WIDTH_PX, LABEL_PX = 420, 40


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--pages", type=Path, default=ROOT / "docs/pictures", help="folder of the sheet")
    given = parser.parse_args()
    capture = read_capture(ROOT / "lightfield_gs/data/banana", longest_px=LONGEST_PX)
    few = [index for index, name in enumerate(capture.names) if name.startswith(NARROW)]
    rig = Rig.from_yaml(ROOT / "lightfield_gs/data/banana/fitted.rig.yaml", lf.Panel.load(PANEL))
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        for words, photographs in (
            ("14 sharp photographs over 60 degrees", capture),
            (f"{len(few)} photographs over 22 degrees", selected(capture, few)),
            ("the 14 photographs, blurred by a hand's motion", shaken(capture, Path(folder))),
        ):
            rows.append(labelled(three_eyes(lf.fit(photographs, **FIT).gaussians, rig), words))
    save(stack(rows, 0), given.pages / "capturing-fits.webp")


def selected(capture: Capture, indices: list[int]) -> Capture:
    """Return a capture with these of its photographs."""
    return replace(
        capture,
        names=[capture.names[index] for index in indices],
        photographs=[capture.photographs[index] for index in indices],
        world_to_camera=capture.world_to_camera[indices],
        intrinsics=capture.intrinsics[indices],
        sizes_px=capture.sizes_px[indices],
    )


def shaken(capture: Capture, folder: Path) -> Capture:
    """Return a capture whose photographs are blurred along lines in directions of their own, as by a hand."""
    random, photographs = np.random.default_rng(0), []
    for index, photograph in enumerate(capture.photographs):
        pixels = np.asarray(Image.open(photograph.path).convert("RGB"))
        length = SHAKEN_PX * max(photograph.stored_px) / LONGEST_PX
        angle = random.uniform(0, np.pi)
        ends = length / 2 * np.array([np.sin(angle), np.cos(angle)])
        moved = [ndimage.shift(pixels, (*(t * ends), 0), order=1, mode="nearest") for t in np.linspace(-1, 1, 15)]
        path = folder / f"{index}.png"
        Image.fromarray(np.mean(moved, 0).round().astype(np.uint8)).save(path)
        photographs.append(replace(photograph, path=path))
    return replace(capture, photographs=photographs)


def three_eyes(scene: lf.Gaussians, rig: Rig) -> np.ndarray:
    """Return what eyes at EYES_DEG see of a scene, uint8 [H, W, 3], side by side."""
    panel, rig = rig.reduced(lf.Panel.load(PANEL), WIDTH_PX)
    middle, colour = [panel.views / 2], FIT["background"]
    views = [render_views(scene, panel, orbit(rig, panel, angle), middle, background=colour) for angle in EYES_DEG]
    images = torch.cat(views)
    return stack(list((images.clamp(0, 1) * 255).round().byte().numpy()), 1)


def labelled(picture: np.ndarray, words: str) -> np.ndarray:
    """Return a picture below a line of words."""
    line = Image.new("RGB", (picture.shape[1], LABEL_PX), "white")
    ImageDraw.Draw(line).text((10, LABEL_PX // 2), words, fill="black", anchor="lm", font=ImageFont.load_default(20))
    return np.concatenate([np.asarray(line), picture], 0)


if __name__ == "__main__":
    main()
