"""Networks for depths in the package transformers."""

from __future__ import annotations

import contextlib
import warnings
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from lightfield_gs.base.errors import InputError
from lightfield_gs.base.options import DepthKind
from lightfield_gs.photo.depth_models.folder import not_installed, short_message
from lightfield_gs.photo.depth_models.model import Pixels, Prediction, normalized, resized

_USUAL_SIDE_PX = 518  # of the network's input, where its processor does not state it
# Numbers of model families whose configuration does not state their kind
_KINDS: dict[str, DepthKind] = {
    "depth_pro": "distance",
    "dpt": "disparity",
    "glpn": "distance",
    "tipsv2_dpt": "distance",
    "zoedepth": "distance",
}
_NEVER_WAIT = ("depth_anything",)  # families whose launches a graph held on an H200


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
        self._is_plain = _is_plain(self._run.image_processor)
        self.never_waits = self._is_plain and config.model_type in _NEVER_WAIT
        self._seen: dict[tuple[int, int], tuple[int, int]] = {}  # sizes that the network sees, by pictures' own

    def shrink(self, pixels: Pixels, shorter_px: int | None = None) -> Pixels:
        """See DepthModel."""
        height, width = pixels.shape[:2]
        if self._is_plain:
            rows, columns = self._seen_size(height, width)
            if shorter_px is not None and shorter_px < min(rows, columns):
                step, factor = self._run.image_processor.ensure_multiple_of, shorter_px / min(rows, columns)
                rows, columns = (step * max(1, round(factor * side / step)) for side in (rows, columns))
            return pixels if (rows, columns) == (height, width) else resized(pixels, rows, columns)
        factor = _side_px(self._run.image_processor) / min(height, width)
        if factor >= 1:
            return pixels
        return resized(pixels, max(1, round(factor * height)), max(1, round(factor * width)))

    def predict(self, pictures: Sequence[Pixels]) -> list[Prediction]:
        """See DepthModel."""
        with _quiet(), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            maps = [self._plainly(part) if self._is_plain else self._by_pipeline(part) for part in pictures]
        return [Prediction(values.reshape(values.shape[-2:])) for values in maps]

    def _by_pipeline(self, picture: Pixels) -> Tensor:
        picture = picture if isinstance(picture, np.ndarray) else picture.cpu().numpy()
        with np.errstate(all="ignore"):  # its grey picture, which is not used, divides by zero where all is equally far
            return self._run(Image.fromarray(picture))["predicted_depth"].float()

    def _plainly(self, picture: Pixels) -> Tensor:
        """Return the pipeline's numbers. It normalizes on the host, and makes a grey picture: 10 to 30 ms a picture."""
        processor, model = self._run.image_processor, self._run.model
        images = normalized([picture], model.device, processor.image_mean, processor.image_std)
        return model(pixel_values=images.to(model.dtype)).predicted_depth.float()

    def _seen_size(self, height: int, width: int) -> tuple[int, int]:
        """Return the size at which the network sees a picture: its processor decides, for one of each size."""
        if (height, width) not in self._seen:
            empty = Image.fromarray(np.zeros((height, width, 3), np.uint8))
            found = self._run.image_processor(images=empty, return_tensors="pt")["pixel_values"].shape
            self._seen[height, width] = found[-2], found[-1]
        return self._seen[height, width]


def _is_plain(processor: Any) -> bool:
    """Return whether a processor only resizes a picture by cubic interpolation, and normalizes it."""
    return (
        type(processor).__name__.startswith("DPTImageProcessor")
        and processor.do_resize
        and processor.do_rescale
        and processor.do_normalize
        and not getattr(processor, "do_pad", False)
        and int(processor.resample) == Image.Resampling.BICUBIC
        and abs(255 * processor.rescale_factor - 1) < 1e-6
    )


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
