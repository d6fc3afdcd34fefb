"""Scores of fits by held-out photographs: errors, structure, LPIPS and sharpness, also of those in the panel's cone."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from benchmarks.fit_arms import Fit
from benchmarks.fit_photographs import Photographs
from benchmarks.gsplat_fit import BLACK
from lightfield_gs.bench import options
from lightfield_gs.fitting import vgg16
from lightfield_gs.fitting.evaluate import match_colours, render_and_photo, weighted_psnr_db, weighted_ssim
from lightfield_gs.reference.metrics import gradient_psnr_db

Lpips = Callable[[Tensor, Tensor], float]
SCORES = ("psnr_db", "ssim", "cc_psnr_db", "cc_ssim", "lpips", "gradient_psnr_db")
CONE_SCORES = tuple(f"cone_{name}" for name in SCORES)
_LPIPS = "LPIPS by VGG-16 (package lpips, Zhang et al. 2018)"
PROTOCOL = (
    "means over held-out photographs, at their own size: PSNR and SSIM as `fit` has them; colours matched: both after "
    "the affine change of colours that suits each photograph best; sharpness: PSNR of the differences of neighbouring "
    "pixels"
)


@torch.no_grad()
def scores(fit: Fit, photographs: Photographs, lpips: Lpips | None = None) -> dict[str, float | None]:
    """Return means over the held-out photographs: SCORES, CONE_SCORES, and psnr_db_by_ours.

    The fit's own rasterizer draws them, but for the last, which ours draws. PSNR and SSIM go by the protocol of
    fitting/evaluate.py. Scores without a photograph, or without LPIPS, are None.
    """
    scene, images, found = fit.gaussians(), photographs.test, []
    for place, (width, height) in enumerate(images.sizes):
        by_ours, photo, weights = render_and_photo(scene, images, place, BLACK)
        image = fit.draw(images.cameras(place))[0, :height, :width].clamp(0, 1)
        planes = image.permute(2, 0, 1), photo.permute(2, 0, 1)
        counts = (weights > 0).to(image)
        matched = match_colours(image, photo, weights)
        found.append(
            {
                "psnr_db": weighted_psnr_db(image, photo, weights),
                "ssim": weighted_ssim(image, photo, weights),
                "cc_psnr_db": weighted_psnr_db(matched, photo, weights),
                "cc_ssim": weighted_ssim(matched, photo, weights),
                "lpips": None if lpips is None else lpips(*(plane * counts for plane in planes)),
                "gradient_psnr_db": float(gradient_psnr_db(*planes, weights)),
                "psnr_db_by_ours": weighted_psnr_db(by_ours, photo, weights),
            }
        )
    inside = _means([row for row, is_inside in zip(found, photographs.inside) if is_inside])
    return _means(found) | {f"cone_{name}": inside[name] for name in SCORES}


def _means(rows: list[dict[str, float | None]]) -> dict[str, float | None]:
    names = (*SCORES, "psnr_db_by_ours")
    values = {name: [value for row in rows if (value := row[name]) is not None] for name in names}
    return {name: float(np.mean(some)) if some else None for name, some in values.items()}


def load_lpips(device: str, from_zero: bool = False) -> tuple[Lpips | None, str]:
    """Return LPIPS by VGG-16, and words on it. The package and the network's weights have to be there already.

    Args:
        device: of the network.
        from_zero: give the network images in 0..1, as the published tables of scenes do, and not the -1..1 that it
            expects. Their figures are comparable with no others.

    Returns:
        A function of [3,H,W] in 0..1 twice, 0 for equal images; None where it is not there, with a line printed.
    """
    weights = vgg16.WEIGHTS.path
    try:
        import lpips
    except (ImportError, RuntimeError, OSError) as error:
        options.progress(f"no LPIPS ({error}): pip install lpips, and save {vgg16.WEIGHTS.url} as {weights}")
        return None, "no LPIPS"
    if not weights.is_file():
        options.progress(f"no LPIPS: the weights of VGG-16 are missing: save {vgg16.WEIGHTS.url} as {weights}")
        return None, "no LPIPS"
    network = lpips.LPIPS(net="vgg", verbose=False).to(device).eval()

    def score(image: Tensor, photo: Tensor) -> float:
        return float(network(image[None], photo[None], normalize=not from_zero))

    return score, f"{_LPIPS} of images in {'0..1, as in published tables' if from_zero else '-1..1'}"
