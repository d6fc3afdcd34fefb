"""Depth of a photo without a depth map, estimated by a network."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from lightfield_gs.base.arrays import to_tensor
from lightfield_gs.base.checks import expect, is_row, real_number, shown
from lightfield_gs.base.device import choose_device
from lightfield_gs.base.errors import InputError
from lightfield_gs.base.options import DEPTH_MODEL, DEVICES, DepthKind, Device
from lightfield_gs.photo.depth import DepthMap
from lightfield_gs.photo.depth_models.folder import OTHER_WAY, model_folder, short_message
from lightfield_gs.photo.depth_models.model import DepthModel, Pixels, Prediction, ReplayedModel
from lightfield_gs.photo.depth_models.open import open_model
from lightfield_gs.photo.depth_models.weights import WrongWeights
from lightfield_gs.photo.depth_windows import in_windows
from lightfield_gs.photo.joint_upsampling import Estimate, at_middles, disparities_to_z, distances_to_z, upsample
from lightfield_gs.photo.steady_depth import PictureEstimate

_ESTIMATED_KINDS: tuple[DepthKind, ...] = ("distance", "disparity")


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
        model: The name of a depth-estimation model on huggingface.co, or a folder with its files: one of transformers,
            Depth Anything 3 for single pictures, MoGe-2 or Video Depth Anything. The default, Depth Anything V2 Small
            (Apache-2.0), is 99 MB. huggingface_hub fetches it at first use and caches it.
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
    pixels = _to_pixels(image)
    (found,) = _predict(model, network.family, network.predict, [network.shrink(pixels)])
    depth = _as_depth_map(pixels, model, kind, found.values, limits, None)
    if found.focal is not None:
        depth.focal_px = found.focal * pixels.shape[1]
    if found.sky:
        depth.description += f", {found.sky:.1%} of them sky, put behind the rest"
    return depth


def estimate_pictures(
    images: Iterable[tuple[int, np.ndarray]], model: str | Path, device: Device, *, kind: str | None
) -> Iterator[tuple[int, PictureEstimate]]:
    """Yield the network's numbers for pictures in a row, for `steadied`.

    Args:
        images: Numbers and pictures, as of depth_from_network.
        model: See depth_from_network.
        device: See depth_from_network.
        kind: See depth_from_network.

    Raises:
        InputError: As depth_from_network.
    """
    shrunk = ((number, shrink_picture(image, model, device, kind)) for number, image in images)
    return estimate_shrunk(shrunk, model, device, kind=kind)


def shrink_picture(
    image: np.ndarray | Tensor, model: str | Path, device: Device, kind: str | None, shorter_px: int | None = None
) -> Pixels:
    """Return a picture at the size that the network sees, uint8 [h, w, 3].

    Args:
        image: As of depth_from_network. A tensor on CUDA, uint8 [H, W, 3], stays there.
        model: See depth_from_network.
        device: See depth_from_network.
        kind: See depth_from_network.
        shorter_px: See DepthModel.shrink.
    """
    network, _ = _open(model, device, kind, None, None)
    pixels = image if isinstance(image, Tensor) and image.is_cuda else _to_pixels(image)
    return network.shrink(pixels, shorter_px)


def estimate_shrunk(
    pictures: Iterable[tuple[int, Pixels]], model: str | Path, device: Device, *, kind: str | None
) -> Iterator[tuple[int, PictureEstimate]]:
    """Yield the network's numbers for pictures of `shrink_picture`; the rest as of estimate_pictures."""
    network, kind = _open(model, device, kind, None, None)
    replayed = ReplayedModel(network)

    def disparities(pictures: list[Pixels]) -> list[Tensor]:
        values = [found.values for found in _predict(model, network.family, replayed.predict, pictures)]
        return values if kind == "disparity" else [distances_to_z(part).disparities for part in values]

    if network.at_once > 1:
        yield from in_windows(pictures, disparities, network.at_once, kind == "distance")
        return
    for number, picture in pictures:
        (values,) = disparities([picture])
        yield number, PictureEstimate.of(values, picture)


def is_metric(model: str | Path, device: Device, kind: str | None) -> bool:
    """Return whether the network's numbers are distances."""
    return _open(model, device, kind, None, None)[1] == "distance"


def refuse_windows(model: str | Path, device: Device, kind: str | None) -> None:
    """Raise InputError for a network that takes many pictures at once: each would wait for those after it."""
    network, _ = _open(model, device, kind, None, None)
    if network.at_once > 1:
        raise InputError(
            f"{model} ({network.family}) takes {network.at_once} pictures at once, and a live picture would wait for "
            "them; give depth_model= with a network of single pictures, or make a film with `video`"
        )


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
    return _as_depth_map(_to_pixels(image), model, kind, values, limits, estimate.limits)


def z_of_estimate(
    estimate: PictureEstimate, is_distance: bool, limits: tuple[float, float] | None, photo: Tensor
) -> Tensor:
    """Return z [H, W] of numbers that were estimated before.

    Args:
        estimate: The numbers.
        is_distance: Whether they are of distances.
        limits: See depth_from_network.
        photo: [H, W, 3], floats in 0..1, on the device of the numbers.
    """
    if is_distance:
        found = distances_to_z(1 / estimate.disparities)
    else:
        found = disparities_to_z(estimate.disparities, limits, estimate.limits)
    return _at_photo(found, photo)


def _at_photo(found: Estimate, photo: Tensor) -> Tensor:
    """Return z at the size of the photo [H, W, 3]."""
    if found.disparities.numel() >= photo.shape[0] * photo.shape[1]:
        return found.z(at_middles(found.disparities, photo))
    return found.z(upsample(found.disparities, photo, found.value_range))


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
) -> tuple[DepthModel, str]:
    """Return a network, and the kind of its numbers; raise InputError."""
    network = open_model(model_folder(str(model), say), choose_device(device))
    kind = kind or network.kind
    if kind is None:
        raise InputError(f"{model} ({network.family}) does not say what its numbers are: give depth_kind=")
    if kind == "distance" and limits is not None:
        raise InputError(f"{model} estimates distances, and depth_range= is for disparities; leave it out")
    return network, kind


@torch.no_grad()
def _predict(
    model: str | Path, family: str, predict: Callable[[list[Pixels]], list[Prediction]], pictures: list[Pixels]
) -> list[Prediction]:
    """Return a network's numbers for pictures in a row, float32; raise InputError."""
    exact = torch.backends.cudnn.flags(enabled=True, benchmark=False, deterministic=True, allow_tf32=False)
    try:
        with exact:
            found = predict(pictures)
    except WrongWeights as error:
        raise InputError(f"depth_model=: expected the weights of {family}, got {model}: {error}") from None
    except RuntimeError as error:
        raise InputError(f"{model} could not estimate the depth of this photo: {short_message(error)}") from None
    if not all(bool(torch.isfinite(part.values).all()) for part in found):
        raise InputError(f"{model}: its depths are not finite; give another with depth_model=, {OTHER_WAY}")
    return found


def _as_depth_map(
    pixels: np.ndarray,
    model: str | Path,
    kind: str,
    values: Tensor,
    limits: tuple[float, float] | None,
    ends: tuple[float, float] | None,
) -> DepthMap:
    found = distances_to_z(values) if kind == "distance" else disparities_to_z(values, limits, ends)
    photo = torch.from_numpy(pixels).to(values.device).float() / 255
    z = _at_photo(found, photo).cpu().numpy()
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
