"""Networks for depths in the package transformers."""

from __future__ import annotations

import contextlib
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image

from lightfield_gs.base.errors import InputError
from lightfield_gs.base.options import DepthKind
from lightfield_gs.photo.depth_models.folder import not_installed, short_message
from lightfield_gs.photo.depth_models.model import Prediction, resized

_USUAL_SIDE_PX = 518  # of the network's input, where its processor does not state it
# Numbers of model families whose configuration does not state their kind
_KINDS: dict[str, DepthKind] = {
    "depth_pro": "distance",
    "dpt": "disparity",
    "glpn": "distance",
    "tipsv2_dpt": "distance",
    "zoedepth": "distance",
}


class Pipeline:
    """The network in a folder with config.json, preprocessor_config.json and *.safetensors.

    Raises:
        InputError: transformers is missing, or does not read it.
    """

    at_once = 1

    def __init__(self, folder: Path, device: str) -> None:
        try:
            with _quiet(), warnings.catch_warnings():
                warnings.simplefilter("ignore")
                import transformers

                # Never inside inference_mode, in which its weights could not be used outside
                with torch.inference_mode(False):
                    self._run = transformers.pipeline(
                        "depth-estimation", model=str(folder), device=device, model_kwargs=dict(use_safetensors=True)
                    )
        except ImportError as error:
            raise not_installed(error) from None
        except Exception as error:  # of its files: it may be anything
            raise InputError(
                "depth_model=: expected a depth-estimation model of transformers with weights in .safetensors, got "
                f"{folder}: {short_message(error)}"
            ) from None
        config = self._run.model.config
        self.family, self.kind = config.model_type, numbers_kind(config)

    def shrink(self, pixels: np.ndarray) -> np.ndarray:
        """Return a picture no larger than the network sees it."""
        factor = _side_px(self._run.image_processor) / min(pixels.shape[:2])
        if factor >= 1:
            return pixels
        height, width = (max(1, round(factor * side)) for side in pixels.shape[:2])
        return resized(pixels, height, width)

    def predict(self, pictures: list[np.ndarray]) -> list[Prediction]:
        """Return the numbers of pictures."""
        # Its grey picture, which is not used, divides by zero where all is equally far
        with _quiet(), np.errstate(all="ignore"), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            maps = [self._run(Image.fromarray(picture))["predicted_depth"].float() for picture in pictures]
        return [Prediction(values.reshape(values.shape[-2:])) for values in maps]


def numbers_kind(config: Any) -> DepthKind | None:
    """Return the kind of a model's numbers; None where its configuration does not tell."""
    declared = getattr(config, "depth_estimation_type", None)
    if declared in ("metric", "relative"):
        return "distance" if declared == "metric" else "disparity"
    return _KINDS.get(config.model_type)


def _side_px(processor: Any) -> int:
    """Return the shorter side of the photo as the network sees it."""
    size = dict(processor.size or {})
    sides = [size[name] for name in ("height", "width", "shortest_edge") if size.get(name)]
    return min(sides, default=_USUAL_SIDE_PX)


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Silence the messages of transformers on loading and running."""
    try:
        from transformers.utils import logging
    except ImportError:  # the caller says so
        yield
        return
    level, bars = logging.get_verbosity(), logging.is_progress_bar_enabled()
    logging.set_verbosity(logging.CRITICAL)
    logging.disable_progress_bar()
    try:
        yield
    finally:
        logging.set_verbosity(level)
        if bars:
            logging.enable_progress_bar()
