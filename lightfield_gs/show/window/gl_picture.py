"""A picture of bytes, drawn by OpenGL 3.3 with one pixel of the framebuffer for each of its pixels."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from lightfield_gs.base.device import device_guard, to_numpy
from lightfield_gs.show.window.cuda_buffer import CudaBuffer, NoInterop, cuda_driver

_DITHER = 0x0BD0  # GL_DITHER, which is on where nobody turns it off
_VERTICES = """
#version 330 core
void main() { gl_Position = vec4(gl_VertexID == 1 ? 3 : -1, gl_VertexID == 2 ? 3 : -1, 0, 1); }
"""
# Row 0 is the top one of a picture, and the bottom one of a framebuffer
_PIXELS = """
#version 330 core
uniform sampler2D picture;
uniform int height;
out vec4 colour;
void main() {
    ivec2 at = ivec2(int(gl_FragCoord.x), height - 1 - int(gl_FragCoord.y)), size = textureSize(picture, 0);
    colour = at.x < size.x && at.y < size.y ? vec4(texelFetch(picture, at, 0).rgb, 1) : vec4(0, 0, 0, 1);
}
"""


class GlPicture:
    """Takes pictures uint8 [H, W, 3] of one size through a pixel buffer, and draws them into the window.

    Args:
        context: ModernGL's, current in this thread.
        size_px: Width and height of the pictures.
        device: Theirs.
        say: Called with a line where they pass through the host though they come from CUDA.
    """

    def __init__(self, context: Any, size_px: tuple[int, int], device: torch.device, say: Callable[[str], None]):
        self._context, self._device, self._say, (width, height) = context, device, say, size_px
        # GPUs copy pixels of four bytes as they are, and rearrange those of three
        self._channels = 4 if device.type == "cuda" else 3
        self._texture = context.texture(size_px, self._channels, alignment=1)
        self._buffer = context.buffer(reserve=width * height * self._channels)
        self._program = context.program(_VERTICES, _PIXELS)
        self._corners = context.vertex_array(self._program, [])
        context.disable_direct(_DITHER)
        self._on_cuda: CudaBuffer | None = None
        if device.type == "cuda":
            try:
                driver = cuda_driver()
                with device_guard(device):
                    torch.cuda.synchronize(device)  # makes CUDA's context current in this thread
                    self._on_cuda = CudaBuffer(self._buffer.glo, driver)
            except NoInterop as error:
                self._go_through_host(error)

    def take(self, image: Tensor) -> None:
        """Take a picture of the device."""
        if self._channels == 4:
            image = torch.nn.functional.pad(image, (0, 1))
        image = image.contiguous()
        if self._on_cuda is not None:
            try:
                with device_guard(self._device):
                    stream = torch.cuda.current_stream(self._device).cuda_stream
                    self._on_cuda.write(image.data_ptr(), image.nbytes, stream)
            except NoInterop as error:
                self.release()
                self._go_through_host(error)
        if self._on_cuda is None:
            self._buffer.orphan()  # the picture before may still be read
            self._buffer.write(to_numpy(image))
        self._texture.write(self._buffer, alignment=1)

    def draw(self, height: int) -> None:
        """Draw the picture from the upper left corner of the framebuffer on, which has this many rows."""
        self._program["height"] = height
        self._texture.use(0)
        self._corners.render(vertices=3)

    def release(self) -> None:
        """Give the buffer back to OpenGL alone, while its context is there."""
        if self._on_cuda is not None:
            with device_guard(self._device):
                self._on_cuda.release()
            self._on_cuda = None

    def _go_through_host(self, error: NoInterop) -> None:
        self._say(f"window: pictures pass through the host, for CUDA does not reach the window's OpenGL ({error})")
