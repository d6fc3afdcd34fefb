"""Cutting an object out of a busy photo, by the optional package rembg."""

from __future__ import annotations

import numpy as np

from lightfield_gs.base.errors import InputError

_INSTALL = "pip install 'lightfield-gs[rembg]'"
# The model is named here, for rembg's own choice has changed between versions, once to weights that may not be used
# commercially.
# U^2-Net: Qin et al., "U^2-Net: Going deeper with nested U-structure for salient object detection", 2020; Apache-2.0.
_MODEL = "u2net"


def background_removed(rgb: np.ndarray) -> np.ndarray:
    """Alpha [H, W], float32 in 0..1, of the object that stands out in a photo, rgb [H, W, 3] in 0..1.

    The weights (176 MB) are downloaded by rembg at first use. Raises InputError without the package or its weights.
    """
    try:
        import rembg
    except (ImportError, SystemExit) as error:  # without onnxruntime it exits
        raise InputError(
            f"rembg, which removes backgrounds, could not be imported ({error}): {_INSTALL}; or give a "
            "cut-out with --mask FILE"
        ) from None
    try:
        session = rembg.new_session(_MODEL)
        mask = rembg.remove(np.round(rgb * 255).astype(np.uint8), session=session, only_mask=True)
    except Exception as error:  # of the download, its file, or the inference: it may be anything
        raise InputError(
            f"rembg could not remove the background: {' '.join(str(error).split())[:200]}; its model "
            f"{_MODEL} is downloaded at first use; or give a cut-out with --mask FILE"
        ) from None
    return mask.astype(np.float32) / 255
