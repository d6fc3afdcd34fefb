"""The sheet of lightfield_gs/models/detail.py for inference: all texels by one native stage, on the CPU or on CUDA.

What is done on the network's grid is the same; a million texels, made elementwise by PyTorch, would take longer than
the network.
"""

from __future__ import annotations

import torch
from torch import Tensor

from lightfield_gs import _core
from lightfield_gs.models.detail import SheetSurface, sheet_look, sheet_surface
from lightfield_gs.models.detail_level import DetailLevel
from lightfield_gs.models.initializer import Pixels
from lightfield_gs.scene.gaussians import Gaussians, of_tensors

_SCRATCH = 6  # numbers that the stage keeps of each texel


def is_native(photo: Tensor) -> bool:
    """Whether the native stage can lay this photo over a prediction: it has no gradients, and is of float32."""
    if torch.compiler.is_compiling() or torch.is_grad_enabled() or photo.dtype != torch.float32:
        return False
    return photo.device.type == "cpu" or (photo.is_cuda and hasattr(_core, "cuda"))


def lay_sheet(
    cloud: Gaussians,
    pixels: Pixels,
    fine: Tensor,
    intrinsics: Tensor,
    layers: int,
    level: DetailLevel,
    correction: Tensor | None = None,
) -> Gaussians:
    """What with_detail returns, but that texels beside the object, of opacity 0, are not turned along the surface.

    cloud, pixels, layers, correction: those of with_detail. fine: the photo at level.factor times the size of pixels,
    [B,4,H',W'], premultiplied. intrinsics: [B,4], (fx, fy, cx, cy) in pixels of the network's input. Everything is
    float32 on one device, for which is_native must hold; nothing waits for it.
    """
    surface, faded = sheet_surface(cloud, pixels, layers, correction)
    texels = fine.shape[2] * fine.shape[3]
    fields = []
    for field in faded.fields().values():
        both = field.new_empty(len(fine), texels + field.shape[1], *field.shape[2:])
        both[:, texels:] = field
        fields.append(both)
    gaussians = of_tensors(fields)
    lay_texels(surface, fine, intrinsics, level, gaussians)
    return gaussians


def lay_texels(
    surface: SheetSurface, fine: Tensor, intrinsics: Tensor, level: DetailLevel, gaussians: Gaussians
) -> None:
    """Writes the texels over a surface to the first H' * W' Gaussians, contiguous [B,N,...]; the rest see lay_sheet."""
    texels, look = fine.shape[2] * fine.shape[3], sheet_look(level.texel_px)
    surface = SheetSurface(*(channels.contiguous() for channels in surface))
    scratch = fine.new_empty(_SCRATCH * texels)
    each = zip(fine.contiguous(), intrinsics.contiguous(), *surface, *gaussians.fields().values())
    for photo, camera, disparity, trust, harmonics, *fields in each:
        job = _core.Sheet(
            height=disparity.shape[1],
            width=disparity.shape[2],
            factor=level.factor,
            disparity=disparity.data_ptr(),
            trust=trust.data_ptr(),
            harmonics=harmonics.data_ptr(),
            photo=photo.data_ptr(),
            intrinsics=camera.data_ptr(),
            look=look,
            soft=scratch.data_ptr(),
            surface=scratch[4 * texels :].data_ptr(),
            out=_core.float32.Gaussians(texels, gaussians.sh_degree, *(field.data_ptr() for field in fields)),
        )
        _run(job, fine)


def _run(job: _core.Sheet, photo: Tensor) -> None:
    if not photo.is_cuda:
        return _core.sheet(job, torch.get_num_threads())
    with torch.cuda.device_of(photo):
        return _core.cuda.sheet(job, torch.cuda.current_stream().cuda_stream)
