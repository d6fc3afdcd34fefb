"""Configuration of the network: read from configs/models/*.yaml, and stored in every checkpoint."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lightfield_gs.base.errors import InputError
from lightfield_gs.io.text_files import check_keys, config_path, read_mapping
from lightfield_gs.models.unet import UNetConfig, check_field_types, check_ranges

INPUT_CHANNELS = {"rgb": 3, "rgb_mask_ray": 6}
COMPOSERS = ("delta", "absolute")


@dataclass(frozen=True)
class ModelConfig:
    """All choices that determine a network.

    Attributes:
        input: "rgb_mask_ray" (colour, mask, ray direction: 6 channels) or "rgb" (colour on white).
        image_size_px: side of the square input, and of the grid of Gaussians.
        patch_px: side of the pixel blocks that are folded into channels before the U-Net and unfolded after it. 2
            computes features at half the resolution, for four Gaussians a feature.
        features: channels between U-Net and heads; 0: as many as the heads predict, as in the original.
        composer: "delta" (base Gaussians + predicted change) or "absolute" (the original's activations).
        layers: Gaussians per pixel, each layer behind its predecessor; 1 for "absolute".
        sh_degree: degree of the spherical harmonics, 0..3.
        near, far: depth range in scene units (the camera is about 1.3 before the object's centre).
        base_depth: depth of the untrained first layer ("delta" only).
        photo_focal: focal length assumed for photos, in units of the side of the square round the object.
        symmetric: average the predictions of the picture and of its mirror image, for twice the work of the U-Net. A
            mirrored picture then gives mirrored Gaussians.
        unet: the backbone.
    """

    input: str = "rgb_mask_ray"
    image_size_px: int = 128
    patch_px: int = 1
    features: int = 64
    composer: str = "delta"
    layers: int = 2
    sh_degree: int = 0
    near: float = 0.75
    far: float = 1.85
    base_depth: float = 1.1
    photo_focal: float = 1.4
    symmetric: bool = False
    unet: UNetConfig = UNetConfig()

    def __post_init__(self) -> None:
        """Check the values of all fields. Raises InputError."""
        check_field_types(self, "")
        step = max(self.size_step, 1)
        checks = (
            (self.input in INPUT_CHANNELS, "input", f"one of {', '.join(INPUT_CHANNELS)}"),
            (self.composer in COMPOSERS, "composer", f"one of {', '.join(COMPOSERS)}"),
            (self.patch_px >= 1, "patch_px", "at least 1"),
            (self.image_size_px > 0 and self.image_size_px % step == 0, "image_size_px", f"a multiple of {step}"),
            (self.features >= 0, "features", "at least 0"),
            (self.layers >= 1 if self.composer == "delta" else self.layers == 1, "layers", "at least 1 (absolute: 1)"),
            (0 <= self.sh_degree <= 3, "sh_degree", "0 to 3"),
            (0 < self.near < self.base_depth < self.far, "base_depth", "0 < near < base_depth < far"),
            (self.photo_focal > 0, "photo_focal", "positive"),
        )
        check_ranges(self, "", checks)

    @property
    def size_step(self) -> int:
        """Divisor of heights and widths of pictures, patch_px * 2^(levels - 1), since the U-Net halves them."""
        return self.patch_px << (len(self.unet.multipliers) - 1)

    def check_size(self, what: str, size_px: int) -> None:
        """Raise InputError, beginning with `what`, unless a picture may have this height or width."""
        if size_px % self.size_step:
            raise InputError(f"{what}: expected a multiple of {self.size_step} pixels for this network, got {size_px}")

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> ModelConfig:
        """Build from a dictionary, as in YAML or in a checkpoint. Raises InputError for unknown fields."""
        unet = values.get("unet", {}) if isinstance(values, dict) else None
        if not isinstance(unet, dict):
            raise InputError("model configuration: expected fields with values, and the same for unet")
        values = {name: value for name, value in values.items() if name != "unet"}
        for owner, given in ((cls, values), (UNetConfig, unet)):
            check_keys(given, (), [field.name for field in dataclasses.fields(owner)], "model configuration")
        unet = {name: tuple(value) if isinstance(value, list) else value for name, value in unet.items()}
        return cls(**values, unet=UNetConfig(**unet))

    @classmethod
    def from_yaml(cls, name: str | Path) -> ModelConfig:
        """Read a file, or a named configuration of configs/models ("default", "original"). Raises InputError."""
        path = Path(name) if Path(name).suffix else config_path("models", str(name))
        return cls.from_dict(read_mapping(path, (), [field.name for field in dataclasses.fields(cls)]))

    def to_dict(self) -> dict[str, Any]:
        """Return a dictionary for from_dict."""
        return dataclasses.asdict(self)
