"""The sheet of models/detail.py for inference: its surface and its texels by two native stages, on the CPU or on CUDA.

With PyTorch's elementwise operations a million texels would take longer than the network.
"""

from __future__ import annotations

import torch
from torch import Tensor

from lightfield_gs import _core
from lightfield_gs.base.harmonics import SH_COEFFICIENTS
from lightfield_gs.base.stages import run_stage
from lightfield_gs.models.detail import DetailLevel, SheetSurface, sheet_look, surface_look
from lightfield_gs.models.initializer import Pixels
from lightfield_gs.models.ramps import ramp_look
from lightfield_gs.scene.gaussians import Gaussians

_SCRATCH = 8  # scratch numbers of the stage for each texel


def is_native(photo: Tensor) -> bool:
    """Return whether the native stages can lay the sheet for this photo: float32, without gradients."""
    if torch.compiler.is_compiling() or torch.is_grad_enabled() or photo.dtype != torch.float32:
        return False
    return photo.device.type == "cpu" or (photo.is_cuda and hasattr(_core, "cuda"))


def lay_sheet(
    cloud: Gaussians, pixels: Pixels, fine: Tensor, intrinsics: Tensor, layers: int, level: DetailLevel
) -> Gaussians:
    """Return the Gaussians of with_detail.

    But texels beside the object, of opacity 0, are not turned along the surface.

    All tensors are float32 on one device, for which is_native must hold; nothing waits for the device.

    Args:
        cloud, pixels, layers: see with_detail.
        fine: the photo at level.factor times the size of pixels, [B,4,H',W'], premultiplied.
        intrinsics: [B,4], (fx, fy, cx, cy) in pixels of the network's input.
        level: of detail.
    """
    texels = fine.shape[2] * fine.shape[3]

    def extended(field: Tensor) -> Tensor:
        both = field.new_empty(len(fine), texels + field.shape[1], *field.shape[2:])
        both[:, texels:] = field
        return both

    gaussians = cloud.mapped(extended)
    under = gaussians[texels:]
    surface = find_surface(under, pixels.mask, intrinsics, layers)
    lay_texels(surface, pixels.mask, fine, intrinsics, level, gaussians)
    return gaussians


def find_surface(cloud: Gaussians, mask: Tensor, intrinsics: Tensor, layers: int) -> SheetSurface:
    """Return the surface of sheet_surface, and change the cloud in place as it does.

    Args:
        cloud: each of its B sets is contiguous.
        mask: [B,1,H,W].
        intrinsics: [B,4].
        layers: of the cloud.
    """
    batch, _, height, width = mask.shape
    rest, look = 3 * (cloud.sh.shape[2] - 1), surface_look()
    planes = mask.new_empty(3, max(3 * layers, 2 + rest), height, width)
    surface = SheetSurface(*(mask.new_empty(batch, channels, height, width) for channels in (1, rest)))
    each = zip(mask.contiguous(), intrinsics.contiguous(), *surface, *cloud.fields().values())
    for mask_row, camera, disparity, harmonics, *fields in each:
        job = _core.Surface(
            height=height,
            width=width,
            layers=layers,
            cloud=_native(fields),
            mask=mask_row.data_ptr(),
            intrinsics=camera.data_ptr(),
            look=look,
            planes=planes.data_ptr(),
            disparity=disparity.data_ptr(),
            harmonics=harmonics.data_ptr(),
        )
        run_stage("surface", _core, mask.device, job)
    return surface


def lay_texels(
    surface: SheetSurface, mask: Tensor, fine: Tensor, intrinsics: Tensor, level: DetailLevel, gaussians: Gaussians
) -> None:
    """Write the texels over a surface to the first H' * W' Gaussians; see lay_sheet.

    Args:
        surface: of find_surface.
        mask: [B,1,H,W].
        fine: [B,4,H',W'], premultiplied.
        intrinsics: [B,4].
        level: of detail.
        gaussians: [B,N,...], contiguous.
    """
    texels, look = fine.shape[2] * fine.shape[3], sheet_look(level.texel_px)
    surface = SheetSurface(*(channels.contiguous() for channels in surface))
    scratch = fine.new_empty(_SCRATCH * texels)
    ramps = ramp_look(level.factor)
    each = zip(fine.contiguous(), mask.contiguous(), intrinsics.contiguous(), *surface, *gaussians.fields().values())
    for photo, cover, camera, disparity, harmonics, *fields in each:
        job = _core.Sheet(
            height=disparity.shape[1],
            width=disparity.shape[2],
            factor=level.factor,
            disparity=disparity.data_ptr(),
            harmonics=harmonics.data_ptr(),
            mask=cover.data_ptr(),
            photo=photo.data_ptr(),
            intrinsics=camera.data_ptr(),
            look=look,
            ramps=ramps,
            soft=scratch.data_ptr(),
            surface=scratch[5 * texels :].data_ptr(),
            other=scratch[6 * texels :].data_ptr(),
            marks=scratch[7 * texels :].data_ptr(),
            out=_native(fields),
        )
        run_stage("sheet", _core, fine.device, job)


def _native(fields: list[Tensor]) -> _core.float32.Gaussians:
    """Return Gaussians [N,...] in the native module's form."""
    degree = SH_COEFFICIENTS.index(fields[4].shape[1])
    return _core.float32.Gaussians(len(fields[0]), degree, *(field.data_ptr() for field in fields))
