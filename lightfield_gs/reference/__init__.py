"""The float64 oracle: the colour of any chosen sample by brute force, which every fast path is judged by."""

from lightfield_gs.reference.light_field import (
    CLAMP_MARGIN,
    dense_torch,
    frustum_limits,
    lens_offsets,
    lens_torch,
    lens_views,
    pixel_colours,
    rig_eye,
    subpixel_colours,
)

__all__ = [
    "CLAMP_MARGIN",
    "dense_torch",
    "frustum_limits",
    "lens_offsets",
    "lens_torch",
    "lens_views",
    "pixel_colours",
    "rig_eye",
    "subpixel_colours",
]
