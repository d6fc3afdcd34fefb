"""Depth of a photo without a depth map, estimated by a network of the optional package transformers."""

from __future__ import annotations

import contextlib
import functools
import importlib.util
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from lightfield_gs.base.arrays import to_tensor
from lightfield_gs.base.checks import expect, is_row, real_number, shown
from lightfield_gs.base.device import choose_device
from lightfield_gs.base.errors import InputError
from lightfield_gs.base.options import DEPTH_MODEL, DEVICES, DepthKind, Device
from lightfield_gs.photo.depth import DepthMap
from lightfield_gs.photo.joint_upsampling import disparities_to_z, distances_to_z, upsample
from lightfield_gs.photo.steady_depth import PictureEstimate

_ABOUT = {DEPTH_MODEL: "99 MB, Apache-2.0"}
_INSTALL = "pip install 'lightfield-gs[photo]'"
_OTHER_WAY = "or give a depth map with depth=FILE"
_FILES = ("*.json", "*.safetensors")  # of a model; weights in other formats could run code when they are read
_USUAL_SIDE_PX = 518  # of the network's input, where its processor does not state it
# Families that users may name and transformers does not read, by a part of their names on huggingface.co
_UNREAD = {
    "video-depth-anything": "Video Depth Anything",
    "depth-anything-3": "Depth Anything 3",
    "/da3": "Depth Anything 3",
    "/moge": "MoGe",
}
_ESTIMATED_KINDS: tuple[DepthKind, ...] = ("distance", "disparity")
# Numbers of model families whose configuration does not state their kind
_KINDS: dict[str, DepthKind] = {
    "depth_pro": "distance",
    "dpt": "disparity",
    "glpn": "distance",
    "tipsv2_dpt": "distance",
    "zoedepth": "distance",
}


def depth_from_network(
    image: np.ndarray | Tensor,
    model: str | Path = DEPTH_MODEL,
    device: Device = "auto",
    *,
    kind: DepthKind | None = None,
    limits: tuple[float, float] | None = None,
) -> np.ndarray:
    """Estimate view-space z [H, W] of each pixel of a photo, float32: a depth for `from_depth`.

    The network sees the photo reduced to the size of its training. Joint bilateral upsampling (Kopf et al. 2007, by
    weighted medians) enlarges its map along the photo's edges. The same photo gives the same bits on the same machine
    with the same number of threads. All arithmetic is float32; the last model stays in memory.

    Args:
        image: [H, W, 3], or [H, W, 4] whose alpha is ignored; uint8, or floating point in 0..1.
        model: The name of a depth-estimation model on huggingface.co, or a folder with one (config.json,
            preprocessor_config.json, *.safetensors). The default, Depth Anything V2 Small (Apache-2.0), is 99 MB. The
            package huggingface_hub fetches it at first use and caches it; later uses need no connection.
        device: "cpu", "cuda" or "auto".
        kind: The meaning of the model's numbers, "distance" (z) or "disparity" (a + b / z, a and b unknown). None: by
            its configuration.
        limits: (near, far) of disparities, scene units; None: (1, 1.6). 1/z runs linearly from 1/far at the 1st
            percentile of the numbers to 1/near at the 99th. Farther ones are put at far; nearer ones extend by a
            quarter of the range at most. Distances are used as they are: scene units are the model's, metres as a rule.

    Raises:
        InputError: The package or the weights are missing, the model estimates no depth, or the image is invalid.
    """
    return estimated_depth(image, model, device, kind=kind, limits=limits).z


def estimated_depth(
    image: np.ndarray | Tensor,
    model: str | Path = DEPTH_MODEL,
    device: Device = "auto",
    *,
    kind: str | None = None,
    limits: tuple[float, float] | None = None,
    say: Callable[[str], None] | None = None,
) -> DepthMap:
    """Return the depth map of depth_from_network, with its description.

    Args:
        image: See depth_from_network.
        model: See depth_from_network.
        device: See depth_from_network.
        kind: See depth_from_network.
        limits: See depth_from_network.
        say: Called with a message before a download.

    Raises:
        InputError: As depth_from_network.
    """
    limits = _checked_options(kind, device, model, limits)
    network, kind = _open(model, device, kind, limits, say)
    return _as_depth_map(image, model, kind, _predict(str(model), network, _to_pixels(image)), limits, None)


def estimate_picture(image: np.ndarray, model: str | Path, device: Device, *, kind: str | None) -> PictureEstimate:
    """Return the network's numbers for a picture, for `steadied`; the arguments as of depth_from_network."""
    network, kind = _open(model, device, kind, None, None)
    values = _predict(str(model), network, _to_pixels(image))
    return PictureEstimate.of(values if kind == "disparity" else distances_to_z(values).disparities, image)


def is_metric(model: str | Path, device: Device, kind: str | None) -> bool:
    """Return whether the network's numbers are distances."""
    return _open(model, device, kind, None, None)[1] == "distance"


def depth_of_estimate(
    image: np.ndarray,
    estimate: PictureEstimate,
    model: str | Path,
    device: Device,
    *,
    kind: str | None,
    limits: tuple[float, float] | None,
) -> DepthMap:
    """Return the depth map of numbers that were estimated before; the other arguments as of depth_from_network."""
    limits = _checked_options(kind, device, model, limits)
    _, kind = _open(model, device, kind, limits, None)
    values = estimate.disparities if kind == "disparity" else 1 / estimate.disparities
    return _as_depth_map(image, model, kind, values, limits, estimate.limits)


def _checked_options(
    kind: str | None, device: str, model: str | Path, limits: tuple[float, float] | None
) -> tuple[float, float] | None:
    """Return the limits; raise InputError for invalid options."""
    expect("model", model, str, Path)
    for what, given, choices in (("depth kind", kind, (None, *_ESTIMATED_KINDS)), ("device", device, DEVICES)):
        if given not in choices:
            raise InputError(f"{what}: expected one of {', '.join(str(one) for one in choices)}, got {given!r}")
    return None if limits is None else _checked_limits(limits)


def _open(
    model: str | Path,
    device: Device,
    kind: str | None,
    limits: tuple[float, float] | None,
    say: Callable[[str], None] | None,
) -> tuple[Any, str]:
    """Return a network, and the kind of its numbers; raise InputError."""
    on = choose_device(device)
    network = _network(_folder(str(model), say), on)
    kind = kind or _model_kind(str(model), network.model.config)
    if kind == "distance" and limits is not None:
        raise InputError(f"{model} estimates distances, and depth_range= is for disparities; leave it out")
    return network, kind


def _as_depth_map(
    image: np.ndarray | Tensor,
    model: str | Path,
    kind: str,
    values: Tensor,
    limits: tuple[float, float] | None,
    ends: tuple[float, float] | None,
) -> DepthMap:
    found = distances_to_z(values) if kind == "distance" else disparities_to_z(values, limits, ends)
    photo = torch.from_numpy(_to_pixels(image)).to(values.device).float() / 255
    z = found.z(upsample(found.disparities, photo, found.value_range)).cpu().numpy()
    name = Path(model).name if Path(model).is_dir() else model
    description = f"depth estimated by {name}: {found.description}"
    return DepthMap(z, None, description, [f"{model}: {words}" for words in found.notes])


def is_installed() -> bool:
    """Return whether the package transformers is installed."""
    try:
        return importlib.util.find_spec("transformers") is not None
    except ValueError:  # of a stand-in without a specification
        return False


def _to_pixels(image: np.ndarray | Tensor) -> np.ndarray:
    """Return the colours of a photo as uint8 [H, W, 3]; raise InputError."""
    pixels = to_tensor("photo", image).detach().cpu()
    if pixels.ndim != 3 or pixels.shape[2] not in (3, 4) or 0 in pixels.shape:
        raise InputError(f"photo: expected [H, W, 3] or [H, W, 4], got {list(pixels.shape)}")
    pixels = pixels[..., :3]
    if pixels.is_floating_point():
        if not bool(torch.isfinite(pixels).all()) or float(pixels.min()) < 0 or float(pixels.max()) > 1:
            raise InputError("photo: expected values in 0..1, got values outside or not finite")
        pixels = (255 * pixels).round().to(torch.uint8)
    elif pixels.dtype != torch.uint8:
        raise InputError(f"photo: expected uint8 or floating point values in 0..1, got {pixels.dtype}")
    return pixels.contiguous().numpy()


def _checked_limits(limits: tuple[float, float]) -> tuple[float, float]:
    if not is_row(limits, 2):
        raise InputError(f"depth range: expected two numbers, near and far, got {shown(limits)}")
    near, far = (real_number(f"depth range: {name}", part, 1e-6, 1e6) for name, part in zip(("near", "far"), limits))
    if near >= far:
        raise InputError(f"depth range: expected near < far, got {near:g},{far:g}")
    return near, far


def _folder(model: str, say: Callable[[str], None] | None) -> str:
    """Return the folder with the model's files, fetched where missing; raise InputError."""
    if Path(model).is_dir():
        return str(Path(model).resolve())
    try:
        from huggingface_hub import snapshot_download
        from huggingface_hub.errors import HFValidationError
    except ImportError as error:
        raise _not_installed(error) from None
    try:
        folder = snapshot_download(model, allow_patterns=list(_FILES), local_files_only=True)
        if all(any(Path(folder).glob(pattern)) for pattern in ("config.json", "preprocessor_config.json", _FILES[1])):
            return folder
    except HFValidationError:
        raise InputError(
            f"depth_model=: expected a name of huggingface.co, such as {DEPTH_MODEL}, or a folder; there is no "
            f"folder {model}"
        ) from None
    except OSError:
        pass  # it was never fetched
    for part, family in _UNREAD.items():
        if part in model.lower():
            raise InputError(
                f"depth_model={model}: transformers has no {family}, whose weights are for a program of its own; give "
                f"a model of transformers, such as {DEPTH_MODEL}, {_OTHER_WAY}"
            )
    about = _ABOUT.get(model, f"its licence: huggingface.co/{model}")
    if say is not None:
        say(f"fetching the depth network {model} from huggingface.co, once ({about})")
    try:
        return snapshot_download(model, allow_patterns=list(_FILES))
    except Exception as error:  # of the connection, the server or the disk: it may be anything
        raise InputError(
            f"the depth network {model} ({about}) is not on this machine and could not be fetched: with a connection, "
            f"run `hf download {model}` once; or copy its folder here for depth_model=FOLDER, {_OTHER_WAY}. It failed "
            f"with: {_short_message(error.__cause__ or error)}"
        ) from None


@functools.lru_cache(maxsize=1)
def _network(folder: str, device: str) -> Any:
    """Return the pipeline of transformers for the model in a folder; raise InputError."""
    try:
        with _quiet(), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            import transformers

            # Never inside inference_mode, in which its weights could not be used outside
            with torch.inference_mode(False):
                return transformers.pipeline(
                    "depth-estimation", model=folder, device=device, model_kwargs=dict(use_safetensors=True)
                )
    except ImportError as error:
        raise _not_installed(error) from None
    except Exception as error:  # of its files: it may be anything
        raise InputError(
            "depth_model=: expected a depth-estimation model of transformers with weights in .safetensors, got "
            f"{folder}: {_short_message(error)}"
        ) from None


def _not_installed(error: ImportError) -> InputError:
    return InputError(
        f"transformers, which has depth networks, could not be imported ({error}): {_INSTALL}; {_OTHER_WAY}"
    )


def _model_kind(model: str, config: Any) -> str:
    """Return the meaning of a model's numbers."""
    declared = getattr(config, "depth_estimation_type", None)
    if declared in ("metric", "relative"):
        return "distance" if declared == "metric" else "disparity"
    if config.model_type not in _KINDS:
        raise InputError(f"{model} ({config.model_type}) does not say what its numbers are: give depth_kind=")
    return _KINDS[config.model_type]


@torch.no_grad()
def _predict(model: str, network: Any, pixels: np.ndarray) -> Tensor:
    """Return the network's map [h, w] of a photo, about as large as its input, float32."""
    from PIL import Image

    photo = Image.fromarray(pixels)
    side = _side_px(network.image_processor)
    shrink = side / min(photo.size)
    if shrink < 1:
        photo = photo.resize([max(1, round(shrink * part)) for part in photo.size], Image.Resampling.BICUBIC)
    exact = torch.backends.cudnn.flags(enabled=True, benchmark=False, deterministic=True, allow_tf32=False)
    try:
        # Its grey picture, which is not used, divides by zero where all is equally far
        with exact, _quiet(), np.errstate(all="ignore"), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            values = network(photo)["predicted_depth"].float()
    except RuntimeError as error:
        raise InputError(f"{model} could not estimate the depth of this photo: {_short_message(error)}") from None
    values = values.reshape(values.shape[-2:])
    if not bool(torch.isfinite(values).all()):
        raise InputError(f"{model}: its depths are not finite; give another with depth_model=, {_OTHER_WAY}")
    return values


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


def _short_message(error: BaseException) -> str:
    return " ".join(str(error).split())[:200] or type(error).__name__
