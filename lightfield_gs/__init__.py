"""One photo, or any 3D Gaussian scene, to the sub-pixel-encoded image of a slanted-lenticular 3D panel."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from lightfield_gs.base.registration import register_with_torch

if TYPE_CHECKING:
    from lightfield_gs.base.errors import InputError
    from lightfield_gs.encoding.classic import interlace
    from lightfield_gs.encoding.encode import encode
    from lightfield_gs.encoding.encoder import Encoder
    from lightfield_gs.encoding.eyes import encode_eyes, weave_eyes
    from lightfield_gs.encoding.quilt import quilt
    from lightfield_gs.encoding.sorted_plan import SortedPlan
    from lightfield_gs.encoding.weave import weave
    from lightfield_gs.fitting.fit import FitResult, fit
    from lightfield_gs.io.scenes.files import read_scene, write_scene
    from lightfield_gs.models import SplatterNet
    from lightfield_gs.panels.comfort import DepthReport, depth_report
    from lightfield_gs.panels.look import Look
    from lightfield_gs.panels.optics import Optics
    from lightfield_gs.panels.panel import Panel
    from lightfield_gs.panels.quilt import QuiltLayout
    from lightfield_gs.panels.rig import Rig
    from lightfield_gs.panels.simulate_tensors import simulate_with_gradients
    from lightfield_gs.photo.depth_network import depth_from_network
    from lightfield_gs.photo.encoder import PhotoEncoder
    from lightfield_gs.photo.load import load_photo
    from lightfield_gs.photo.rgbd import from_depth
    from lightfield_gs.rasterizer.images import RenderedImages, render
    from lightfield_gs.rasterizer.quality import Quality
    from lightfield_gs.scene.cameras import Cameras
    from lightfield_gs.scene.gaussians import Gaussians
    from lightfield_gs.show.notebook import NotebookPicture
    from lightfield_gs.simplification.pruning import prune
    from lightfield_gs.simplification.simplify import simplify

# Public name -> its module, imported when first asked for: the command line shows its help without waiting for torch.
_HOMES = {
    "Cameras": "scene.cameras",
    "DepthReport": "panels.comfort",
    "Encoder": "encoding.encoder",
    "FitResult": "fitting.fit",
    "Gaussians": "scene.gaussians",
    "InputError": "base.errors",
    "Look": "panels.look",
    "NotebookPicture": "show.notebook",
    "Optics": "panels.optics",
    "Panel": "panels.panel",
    "PhotoEncoder": "photo.encoder",
    "Quality": "rasterizer.quality",
    "RenderedImages": "rasterizer.images",
    "QuiltLayout": "panels.quilt",
    "Rig": "panels.rig",
    "SortedPlan": "encoding.sorted_plan",
    "SplatterNet": "models",
    "depth_from_network": "photo.depth_network",
    "depth_report": "panels.comfort",
    "encode": "encoding.encode",
    "encode_eyes": "encoding.eyes",
    "fit": "fitting.fit",
    "from_depth": "photo.rgbd",
    "interlace": "encoding.classic",
    "load_photo": "photo.load",
    "prune": "simplification.pruning",
    "quilt": "encoding.quilt",
    "read_scene": "io.scenes.files",
    "render": "rasterizer.images",
    "simplify": "simplification.simplify",
    "simulate_with_gradients": "panels.simulate_tensors",
    "weave": "encoding.weave",
    "weave_eyes": "encoding.eyes",
    "write_scene": "io.scenes.files",
}
# Spelled out for type checkers: they take no other name as public, and would not run a line that makes it from _HOMES
__all__ = [
    "Cameras",
    "DepthReport",
    "Encoder",
    "FitResult",
    "Gaussians",
    "InputError",
    "Look",
    "NotebookPicture",
    "Optics",
    "Panel",
    "PhotoEncoder",
    "Quality",
    "QuiltLayout",
    "RenderedImages",
    "Rig",
    "SortedPlan",
    "SplatterNet",
    "build_info",
    "depth_from_network",
    "depth_report",
    "encode",
    "encode_eyes",
    "fit",
    "from_depth",
    "interlace",
    "load_photo",
    "prune",
    "quilt",
    "read_scene",
    "render",
    "simplify",
    "simulate_with_gradients",
    "weave",
    "weave_eyes",
    "write_scene",
]
__version__ = "0.1.0"


if not TYPE_CHECKING:  # to a checker, every name would be there

    def __getattr__(name: str) -> Any:
        if name not in _HOMES:
            raise AttributeError(f"module 'lightfield_gs' has no attribute {name!r}")
        value = globals()[name] = getattr(import_module(f"lightfield_gs.{_HOMES[name]}"), name)
        return value


register_with_torch()


def __dir__() -> list[str]:
    return list(__all__)


def build_info() -> dict[str, object]:
    """Return the features of this build.

    Keys: "version", "simd_targets" (the vector instruction sets that this processor has), "devices", and
    "cuda_architectures" ([75, 90]; not in builds for the CPU only).
    """
    from lightfield_gs import _core

    info: dict[str, object] = {"version": _core.version, "simd_targets": _core.simd_targets(), "devices": ["cpu"]}
    if hasattr(_core, "cuda"):
        info["devices"] = ["cpu", "cuda"]
        info["cuda_architectures"] = _core.cuda.architectures
    return info
