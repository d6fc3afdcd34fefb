"""lightfield_gs: one photo, or any 3D Gaussian scene, to the sub-pixel-encoded image of a slanted-lenticular 3D panel."""

from lightfield_gs.cameras import Cameras
from lightfield_gs.errors import InputError
from lightfield_gs.gaussians import Gaussians
from lightfield_gs.panel import Panel
from lightfield_gs.render import encode, interlace, render
from lightfield_gs.rig import Rig

__all__ = ["Cameras", "Gaussians", "InputError", "Panel", "Rig", "build_info", "encode", "interlace", "render"]
__version__ = "0.1.0"


def build_info() -> dict[str, object]:
    """What this build has: version, the vector instruction sets that this processor can choose from, devices."""
    from lightfield_gs import _core

    return {"version": _core.version, "simd_targets": _core.simd_targets(), "devices": ["cpu"]}
