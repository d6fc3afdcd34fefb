"""The network: one picture of an object in, 3D Gaussians out.

Source: Szymanowicz et al., "Splatter Image", CVPR 2024: an image-to-image network whose output pixels are Gaussians.
Three stages: the initializer describes each pixel, the decoder (U-Net and heads) predicts raw channels, the composer
turns them into Gaussians.

A checkpoint holds float16 weights as safetensors, with the configuration as JSON in the metadata.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import cast

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from lightfield_gs import _core
from lightfield_gs.base.arrays import to_tensor
from lightfield_gs.base.checks import expect
from lightfield_gs.base.device import capture_graph
from lightfield_gs.base.errors import InputError
from lightfield_gs.io.atomic import atomic_path, checked_path
from lightfield_gs.io.file_kinds import refuse_stand_in
from lightfield_gs.io.text_files import parse_json
from lightfield_gs.models import crop
from lightfield_gs.models.composer import AbsoluteComposer, DeltaComposer, mirrored, parameter_groups
from lightfield_gs.models.config import INPUT_CHANNELS, ModelConfig
from lightfield_gs.models.crop import crop_on_device
from lightfield_gs.models.detail import DetailLevel, with_detail
from lightfield_gs.models.initializer import Pixels, describe_pixels, mirror_image, network_input
from lightfield_gs.models.sheet import is_native, lay_sheet
from lightfield_gs.models.unet import UNet
from lightfield_gs.rasterizer.quality import OPACITY_CUT
from lightfield_gs.scene.gaussians import Gaussians, from_tensors

PRETRAINED = Path(__file__).parent / "checkpoints" / "splatter_net.safetensors"
_CONFIG_KEY = "lightfield_gs.model_config"
_MOST_GRAPHS = 4  # of a ReplayedNet; each keeps its memory


class SplatterNet(nn.Module):
    """Predict `layers` Gaussians for every pixel of a square picture of an object.

    See ModelConfig for the choices.
    """

    def __init__(self, config: ModelConfig = ModelConfig()) -> None:
        super().__init__()
        expect("config", config, ModelConfig)
        self.config = config
        predicted = config.layers * sum(parameter_groups(config.sh_degree).values())
        features = config.features or predicted
        block = config.patch_px**2
        size = config.image_size_px // config.patch_px
        self.unet = UNet(INPUT_CHANNELS[config.input] * block, features, size, config.unet)
        self.head = nn.Conv2d(features, predicted * block, 1)
        if config.composer == "delta":
            self.composer: DeltaComposer | AbsoluteComposer = DeltaComposer(config)
            nn.init.zeros_(self.head.weight)
            nn.init.zeros_(cast(Tensor, self.head.bias))
        else:
            self.composer = AbsoluteComposer(config)
            self.composer.initialise(self.head, block)

    def forward(
        self, images: Tensor, intrinsics: Tensor, fine: Tensor | None = None, level: DetailLevel | None = None
    ) -> Gaussians:
        """Predict the Gaussians of B pictures in the axes of their own cameras (OpenCV). Differentiable.

        The U-Net obeys autocast and may run in lower precision; heads, composer and sheet are always float32.

        Args:
            images: [B,4,H,W], RGB premultiplied by alpha and alpha, 0..1.
            intrinsics: [B,4], (fx, fy, cx, cy) in pixels of those pictures.
            fine: the same pictures at level.factor times their size, [B,4,H',W'], for a sheet (models/detail.py).
            level: of the sheet.

        Returns:
            Gaussians with leading B, float32: the H' * W' of the sheet, then layers * H * W.

        Raises:
            InputError: H or W is no multiple of config.size_step.
        """
        for name, size in zip(("height", "width"), images.shape[-2:]):
            self.config.check_size(f"{name} of the images", size)
        pixels = describe_pixels(images, intrinsics)
        raw = self._predicted(images, intrinsics, pixels)
        with torch.autocast(images.device.type, enabled=False):
            cloud = self.composer(raw, pixels)
            return cloud if fine is None or level is None else self.composed(cloud, images, intrinsics, fine, level)

    def composed(
        self, cloud: Gaussians, images: Tensor, intrinsics: Tensor, fine: Tensor, level: DetailLevel
    ) -> Gaussians:
        """Lay the sheet over the network's own Gaussians; see forward. Differentiable, in float32.

        Args:
            cloud: [B,N,...] that forward gives without a level.
            images: of forward.
            intrinsics: of forward.
            fine: of forward.
            level: of forward.
        """
        pixels = describe_pixels(images, intrinsics)
        if is_native(fine):
            return lay_sheet(cloud, pixels, fine, intrinsics, self.config.layers, level)
        texels = describe_pixels(fine, level.factor * intrinsics)
        return with_detail(cloud, pixels, texels, self.config.layers, level.factor, level.texel_px)

    def _predicted(self, images: Tensor, intrinsics: Tensor, pixels: Pixels) -> Tensor:
        """Return the composer's raw channels [B,C,H,W], float32."""
        inputs = network_input(images, pixels, self.config.input)
        if not self.config.symmetric:
            return self._raw(inputs)
        mirror = mirror_image(images, intrinsics)
        there = network_input(mirror[0], describe_pixels(*mirror), self.config.input)
        own, other = self._raw(torch.cat([inputs, there])).chunk(2)
        return (own + mirrored(other, self.config.layers, self.config.sh_degree)) / 2

    def _raw(self, inputs: Tensor) -> Tensor:
        """Run U-Net and heads on network_input: [B,C,H,W] float32."""
        folded = F.pixel_unshuffle(inputs, self.config.patch_px)
        folded = folded.to(self.unet.stem.weight.dtype, memory_format=torch.channels_last)
        features = self.unet(folded)
        with torch.autocast(inputs.device.type, enabled=False):
            return F.pixel_shuffle(self.head(features.to(self.head.weight.dtype)), self.config.patch_px)

    @torch.no_grad()
    def predict(self, rgba: np.ndarray | Tensor, level: DetailLevel | None = None) -> Gaussians:
        """Predict the Gaussians of the object in a photo. PhotoEncoder goes on to the image of a panel, faster on CUDA.

        The photo is cropped to the object as in training. Its camera looks at the middle of that crop with the focal
        length config.photo_focal. Gaussians too faint to be seen are left out.

        Args:
            rgba: [H,W,4] float in 0..1 or uint8, colours not premultiplied, any size and aspect.
            level: lays the photo over the Gaussians at a multiple of the network's resolution; photo.detail_level
                chooses it for a panel and a budget. None: the network's own Gaussians alone.

        Returns:
            Gaussians in the axes of the photo's camera (at the origin, z forward; the object is near z = 1.3).

        Raises:
            InputError: shape, type or values of `rgba` are invalid, or its mask is empty.
        """
        photo = checked_photo(rgba)
        expect("level", level, DetailLevel, type(None))
        return self.visible_gaussians(*self.crops(photo, level), level)

    def crops(self, photo: Tensor, level: DetailLevel | None) -> tuple[Tensor, Tensor | None]:
        """Crop a photo for the network, and for the sheet.

        Args:
            photo: of checked_photo.
            level: of detail, or None.

        Returns:
            The crop [4,S,S], premultiplied, on the network's device. The same at level.factor times the size; None
            without a level.

        Raises:
            InputError: for values outside 0..1 or an empty mask.
        """
        photo, size = photo.to(self.device), self.config.image_size_px
        if photo.is_cuda and hasattr(_core, "cuda"):
            sizes = [size] if level is None else [size, level.factor * size]
            checks, (cropped, *finer) = crop_on_device(photo.contiguous(), sizes)
            values_in_range, has_object = checks.tolist()
            check_values(values_in_range)
            crop.check_object(has_object)
            return cropped, finer[0] if finer else None
        check_values(in_range(photo))
        square = crop.object_square(photo[..., 3])
        fine = None if level is None else crop.crop_resize_premultiplied(photo, square, level.factor * size)
        return crop.crop_resize_premultiplied(photo, square, size), fine

    def visible_gaussians(
        self, cropped: Tensor, fine: Tensor | None = None, level: DetailLevel | None = None
    ) -> Gaussians:
        """Return the Gaussians of a cropped photo that are bright enough to be drawn. Wait for the device."""
        return visible(self.all_gaussians(cropped, self.photo_intrinsics(), fine, level))

    @property
    def device(self) -> torch.device:
        """The device of the weights."""
        return self.head.weight.device

    def photo_intrinsics(self) -> Tensor:
        """Return the assumed (fx, fy, cx, cy) of a cropped photo, [1,4] in pixels of the crop."""
        size = self.config.image_size_px
        return torch.tensor([[self.config.photo_focal * size] * 2 + [size / 2] * 2], device=self.device)

    @torch.no_grad()
    def all_gaussians(
        self, cropped: Tensor, intrinsics: Tensor, fine: Tensor | None = None, level: DetailLevel | None = None
    ) -> Gaussians:
        """Return all layers * H * W Gaussians of one cropped picture, including invisible Gaussians.

        Args:
            cropped: [4,H,W], premultiplied.
            intrinsics: [1,4], see forward.
            fine: the same picture at level.factor times the size; the Gaussians of its pixels come first.
            level: of detail.
        """
        was_training = self.training
        self.eval()
        try:
            batch = self(cropped[None], intrinsics, None if fine is None else fine[None], level)
        finally:
            self.train(was_training)
        own = batch.quaternions[:, -self.config.layers * cropped.shape[1] * cropped.shape[2] :]
        own.copy_(F.normalize(own, dim=-1))  # the texels' have length 1
        return from_tensors(field[0].contiguous() for field in batch.fields().values())

    def save(self, path: str | Path, notes: dict[str, str] | None = None) -> None:
        """Write the weights as float16 safetensors, with configuration and notes in the metadata."""
        from safetensors.torch import save

        path, metadata = checked_path(path), {**(notes or {}), _CONFIG_KEY: json.dumps(self.config.to_dict())}
        weights = {name: t.detach().to("cpu", torch.float16).contiguous() for name, t in self.state_dict().items()}
        with atomic_path(path) as temporary:
            temporary.write_bytes(save(weights, metadata))

    @classmethod
    def from_pretrained(cls, path: str | Path | None = None) -> SplatterNet:
        """Load a checkpoint of save(), in eval mode, float32. None: the package's own checkpoint. Raises InputError."""
        config, weights = read_weights(checked_path(path) if path is not None else PRETRAINED)
        with torch.device("meta"):  # no time for initial values, and no memory for a damaged configuration
            net = cls(config)
        wanted = net.state_dict()
        if {name: tensor.shape for name, tensor in weights.items()} != {name: t.shape for name, t in wanted.items()}:
            raise InputError(f"{path}: damaged checkpoint: the weights do not fit the configuration beside them")
        net.load_state_dict(weights, assign=True)
        return net.eval()


class ReplayedNet:
    """SplatterNet.predict for photo after photo; on CUDA as a graph, since launches take longer than the device.

    The kernels and their precision are the same, and so are the results. A level of detail gets its graph the second
    time that it is met. The network must not change.
    """

    def __init__(self, net: SplatterNet) -> None:
        self.net, self.config = net, net.config
        self._met: set[DetailLevel | None] = set()
        self._graphs: dict[DetailLevel | None, _Graph] = {}

    @torch.no_grad()
    def predict(self, rgba: np.ndarray | Tensor, level: DetailLevel | None = None) -> Gaussians:
        """Return the Gaussians of SplatterNet.predict. Raises InputError as it does."""
        photo = checked_photo(rgba)
        cropped, fine = self.net.crops(photo, level)
        if not cropped.is_cuda or not self._is_repeated(level):
            return self.net.visible_gaussians(cropped, fine, level)
        with torch.cuda.device(cropped.device):
            if level not in self._graphs:
                self._graphs[level] = _Graph(self.net, cropped, fine, level)
            return visible(self._graphs[level].replay(cropped, fine))

    def _is_repeated(self, level: DetailLevel | None) -> bool:
        if level in self._graphs:
            return True
        if level in self._met:
            return len(self._graphs) < _MOST_GRAPHS
        self._met.add(level)
        return False


class _Graph:
    """SplatterNet.all_gaussians as a CUDA graph, for photos of one level of detail."""

    def __init__(self, net: SplatterNet, cropped: Tensor, fine: Tensor | None, level: DetailLevel | None) -> None:
        with torch.inference_mode(False), torch.no_grad():  # tensors that are writable in any mode
            self._cropped, self._fine = cropped.clone(), None if fine is None else fine.clone()
            self._intrinsics = net.photo_intrinsics()
            self._graph, self._gaussians = capture_graph(
                lambda: net.all_gaussians(self._cropped, self._intrinsics, self._fine, level), warm_up=True
            )

    def replay(self, cropped: Tensor, fine: Tensor | None) -> Gaussians:
        """Return the Gaussians, which the next call writes over."""
        self._cropped.copy_(cropped)
        if self._fine is not None and fine is not None:
            self._fine.copy_(fine)
        self._graph.replay()
        return self._gaussians


def visible(gaussians: Gaussians) -> Gaussians:
    """Drop Gaussians too faint to be drawn. Waits for the device, once."""
    which = (gaussians.opacities >= OPACITY_CUT).nonzero().squeeze(1)
    return from_tensors(field.index_select(0, which) for field in gaussians.fields().values())


def checked_photo(rgba: np.ndarray | Tensor) -> Tensor:
    """Return the photo as a tensor [H,W,4], uint8 or float32, on its device.

    Raises InputError for other shapes and types.
    """
    photo = to_tensor("photo", rgba)
    if photo.ndim != 3 or photo.shape[2] != 4 or 0 in photo.shape:
        raise InputError(f"photo: expected an array [H,W,4] (RGB and alpha), got {list(photo.shape)}")
    if photo.dtype == torch.uint8:
        return photo
    if not photo.is_floating_point():
        raise InputError(
            f"photo: expected uint8 or floating point values in 0..1, got {photo.dtype}; divide by its "
            "largest value (65535 of 16 bits)"
        )
    return photo.to(torch.float32)


def in_range(photo: Tensor) -> Tensor:
    """Return whether all values of a photo of checked_photo are in 0..1, bool []. uint8 always are."""
    if photo.dtype == torch.uint8:
        return torch.ones((), dtype=torch.bool, device=photo.device)
    return ((photo >= 0) & (photo <= 1)).all()


def check_values(values_in_range: float | Tensor) -> None:
    """Raise InputError unless the values of a photo are in range; see in_range."""
    if not values_in_range:
        raise InputError("photo: expected values in 0..1, got values outside or not finite")


def read_weights(path: Path) -> tuple[ModelConfig, dict[str, Tensor]]:
    """Read configuration and float32 weights of a checkpoint. Raises InputError for a file that is none."""
    from safetensors import SafetensorError, safe_open
    from safetensors.torch import load

    try:
        with safe_open(path, framework="pt") as file:
            metadata = file.metadata() or {}
        # Read at once: one by one, safetensors 0.8 leaks 64 bytes for each
        weights = {name: tensor.float() for name, tensor in load(path.read_bytes()).items()}
        config = parse_json(metadata[_CONFIG_KEY])
    except FileNotFoundError:
        raise InputError(f"{path}: found no such checkpoint") from None
    except (SafetensorError, OSError, KeyError, ValueError) as error:
        refuse_stand_in(path)
        raise InputError(
            f"{path}: expected a SplatterNet checkpoint (safetensors with its configuration), "
            f"but {' '.join(str(error).split())[:200]}"
        ) from None
    return ModelConfig.from_dict(config), weights
