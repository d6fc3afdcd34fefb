"""Tiny networks for depths of three families, with made-up weights under the names of the real ones."""

import json
import zlib
from pathlib import Path

import torch
from safetensors.torch import save_file
from torch import Tensor

CHANNELS, BLOCKS, SIDE = 64, 4, 4  # of the transformer; SIDE: patches of a side in its training
FEATURES, LEVELS = 32, (32, 32, 64, 64)  # of the head of Depth Anything
STACK = (32, 16, 16, 16, 16)  # of MoGe's
# As configs/train/v2.json of github.com/microsoft/MoGe has them, with fewer channels
MOGE = {
    "encoder": {"backbone": "dinov2_vitl14", "intermediate_layers": [1, 3], "dim_out": STACK[0]},
    "neck": {"dim_in": [STACK[0] + 2, 2, 2, 2, 2], "dim_out": None, "num_res_blocks": [0, 1, 1, 1, 0]},
    "points_head": {"dim_in": list(STACK), "dim_out": [None] * 4 + [3], "num_res_blocks": [0, 1, 0, 1, 0]},
    "mask_head": {"dim_in": list(STACK), "dim_out": [None] * 4 + [1], "num_res_blocks": [0, 0, 1, 0, 0]},
    "scale_head": {"dims": [CHANNELS, 16, 1]},
    "remap_output": "exp",
    "num_tokens_range": [6, 24],
}
for part in ("neck", "points_head", "mask_head"):
    MOGE[part] |= {
        "dim_res_blocks": list(STACK),
        "res_block_in_norm": "none",
        "res_block_hidden_norm": "none",
        "resamplers": ["conv_transpose"] * 3 + ["bilinear"],
    }


def filled(shapes: dict[str, tuple[int, ...]]) -> dict[str, Tensor]:
    """Tensors of these names and shapes, which depend on nothing else."""
    tensors = {}
    for name, shape in shapes.items():
        generator = torch.Generator().manual_seed(zlib.crc32(name.encode()))
        fan = max(1, torch.Size(shape[1:]).numel())
        values = torch.randn(shape, generator=generator) * (fan**-0.5 if len(shape) > 1 else 0.3)
        is_scale = name.endswith(("norm1.weight", "norm2.weight", "norm.weight", "gamma")) or ".norms." in name
        tensors[name] = values + 1 if is_scale and len(shape) == 1 else values
    return tensors


def layer(name: str, *shape: int, bias: bool = True) -> dict[str, tuple[int, ...]]:
    return {f"{name}.weight": shape} | ({f"{name}.bias": shape[:1]} if bias else {})


def transformer(prefix: str) -> dict[str, tuple[int, ...]]:
    c = CHANNELS
    shapes = {"cls_token": (1, 1, c), "pos_embed": (1, 1 + SIDE**2, c), **layer("patch_embed.proj", c, 3, 14, 14)}
    for block in range(BLOCKS):
        own = layer("norm1", c) | layer("attn.qkv", 3 * c, c) | layer("attn.proj", c, c) | {"ls1.gamma": (c,)}
        own |= layer("norm2", c) | layer("mlp.fc1", 4 * c, c) | layer("mlp.fc2", c, 4 * c) | {"ls2.gamma": (c,)}
        shapes |= {f"blocks.{block}.{name}": shape for name, shape in own.items()}
    return {prefix + name: shape for name, shape in (shapes | layer("norm", c)).items()}


def head(prefix: str, outputs: list[str]) -> dict[str, tuple[int, ...]]:
    f, shapes = FEATURES, {}
    for number, channels in enumerate(LEVELS):
        shapes |= layer(f"projects.{number}", channels, CHANNELS, 1, 1)
        shapes |= layer(f"scratch.layer{number + 1}_rn", f, channels, 3, 3, bias=False)
        part = f"scratch.refinenet{number + 1}"
        for unit in ("resConfUnit1", "resConfUnit2"):
            shapes |= layer(f"{part}.{unit}.conv1", f, f, 3, 3) | layer(f"{part}.{unit}.conv2", f, f, 3, 3)
        shapes |= layer(f"{part}.out_conv", f, f, 1, 1)
    for number, side in ((0, 4), (1, 2), (3, 3)):
        shapes |= layer(f"resize_layers.{number}", LEVELS[number], LEVELS[number], side, side)
    shapes |= layer("scratch.output_conv1", f // 2, f, 3, 3)
    for name in outputs:
        shapes |= layer(f"scratch.{name}.0", 32, f // 2, 3, 3) | layer(f"scratch.{name}.2", 1, 32, 1, 1)
    return {prefix + name: shape for name, shape in shapes.items()}


def in_time(prefix: str) -> dict[str, tuple[int, ...]]:
    shapes = {}
    for number, c in enumerate((LEVELS[2], LEVELS[3], FEATURES, FEATURES)):
        own = layer("norm", c) | layer("proj_in", c, c) | layer("proj_out", c, c)
        block = "transformer_blocks.0"
        for part in range(2):
            attention = f"{block}.attention_blocks.{part}"
            for name in ("to_q", "to_k", "to_v"):
                own |= layer(f"{attention}.{name}", c, c, bias=False)
            own |= layer(f"{attention}.to_out.0", c, c) | {f"{attention}.pos_encoder.pe": (1, 32, c)}
            own |= layer(f"{block}.norms.{part}", c)
        own |= layer(f"{block}.ff.net.0.proj", 8 * c, c) | layer(f"{block}.ff.net.2", c, 4 * c)
        own |= layer(f"{block}.ff_norm", c)
        shapes |= {f"{prefix}{number}.temporal_transformer.{name}": shape for name, shape in own.items()}
    return shapes


def stack(name: str) -> dict[str, tuple[int, ...]]:
    config, shapes = MOGE[name], {}
    for number, channels in enumerate(STACK):
        shapes |= layer(f"{name}.input_blocks.{number}", channels, config["dim_in"][number], 1, 1)
        for block in range(config["num_res_blocks"][number]):
            for place in (2, 5):
                shapes |= layer(f"{name}.res_blocks.{number}.{block}.layers.{place}", channels, channels, 3, 3)
        if config["dim_out"] is not None and config["dim_out"][number] is not None:
            shapes |= layer(f"{name}.output_blocks.{number}", config["dim_out"][number], channels, 1, 1)
        if number < 4:
            above = STACK[number + 1]
            if number < 3:
                weight = {f"{name}.resamplers.{number}.0.weight": (channels, above, 2, 2)}
                shapes |= weight | {f"{name}.resamplers.{number}.0.bias": (above,)}
            shapes |= layer(f"{name}.resamplers.{number}.1", above, channels if number == 3 else above, 3, 3)
    return shapes


def depth_anything_3(folder: Path) -> Path:
    """Save a Depth Anything 3 for single pictures; return its folder."""
    folder.mkdir()
    names = ["output_conv2", "sky_output_conv2"]
    shapes = transformer("model.backbone.pretrained.") | head("model.head.", names)
    save_file(filled(shapes), folder / "model.safetensors")
    config = {"model_name": "da3mono-large", "config": {"net": {"out_layers": [0, 1, 2, 3]}}}
    (folder / "config.json").write_text(json.dumps(config))
    return folder


def video_depth_anything(folder: Path) -> Path:
    """Save a Video Depth Anything; return its folder."""
    folder.mkdir()
    shapes = transformer("pretrained.") | head("head.", ["output_conv2"]) | in_time("head.motion_modules.")
    torch.save(filled(shapes), folder / "video_depth_anything_vits.pth")
    return folder


def moge_2(folder: Path) -> Path:
    """Save a MoGe-2; return its folder."""
    folder.mkdir()
    shapes = transformer("encoder.backbone.") | stack("neck") | stack("points_head") | stack("mask_head")
    for number in range(2):
        shapes |= layer(f"encoder.output_projections.{number}", STACK[0], CHANNELS, 1, 1)
    shapes |= layer("scale_head.0", 16, CHANNELS) | layer("scale_head.2", 1, 16)
    tensors = filled(shapes)
    tensors["mask_head.output_blocks.4.weight"] *= 0.05
    tensors["mask_head.output_blocks.4.bias"] += 1  # most is known
    # x and y mostly as of a plane before a camera: what the finest level gets of the pixels' places
    own, neck = (tensors[f"{part}.input_blocks.4.weight"][..., 0, 0] for part in ("points_head", "neck"))
    tensors["points_head.output_blocks.4.weight"] *= torch.tensor([0.02, 0.02, 0.3])[:, None, None, None]
    tensors["points_head.output_blocks.4.weight"][:2, :, 0, 0] += 0.5 * torch.linalg.pinv(own @ neck)
    torch.save({"model_config": MOGE, "model": tensors}, folder / "model.pt")
    return folder
