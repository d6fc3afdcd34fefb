"""A buffer of OpenGL that CUDA writes into, so that a picture does not pass through the host.

Source: CUDA Driver API, "OpenGL Interoperability" and "Graphics Interoperability".
"""

from __future__ import annotations

import ctypes
import sys
from ctypes import byref, c_size_t, c_uint, c_uint64, c_void_p
from typing import Any

_WRITE_DISCARD = 2  # CU_GRAPHICS_REGISTER_FLAGS_WRITE_DISCARD: CUDA reads nothing of what is in it


class NoInterop(Exception):
    """CUDA does not reach this OpenGL: the message is the reason."""


def cuda_driver() -> Any:
    """Return the CUDA driver's library. Raises NoInterop."""
    try:
        return ctypes.CDLL("nvcuda.dll" if sys.platform == "win32" else "libcuda.so.1")
    except OSError as error:
        raise NoInterop(f"the CUDA driver's library cannot be loaded: {error}") from None


class CudaBuffer:
    """A buffer of the current OpenGL context, registered with CUDA. CUDA's context must be current in each call.

    Args:
        number: OpenGL's name of the buffer.
        driver: See cuda_driver.

    Raises:
        NoInterop: The driver refuses, as where another GPU draws the window.
    """

    def __init__(self, number: int, driver: Any):
        self._driver, self._resource = driver, c_void_p()
        self._call("cuGraphicsGLRegisterBuffer", byref(self._resource), c_uint(number), c_uint(_WRITE_DISCARD))

    def write(self, address: int, count: int, stream: int) -> None:
        """Copy bytes of the device into the buffer. Raises NoInterop.

        Args:
            address: Of the bytes on the device.
            count: Of the bytes, as many as the buffer has or fewer.
            stream: Of CUDA, on which they are written.
        """
        self._call("cuGraphicsMapResources", c_uint(1), byref(self._resource), c_void_p(stream))
        try:
            mapped, size = c_uint64(), c_size_t()
            self._call("cuGraphicsResourceGetMappedPointer_v2", byref(mapped), byref(size), self._resource)
            self._call("cuMemcpyDtoDAsync_v2", mapped, c_uint64(address), c_size_t(count), c_void_p(stream))
        finally:
            self._call("cuGraphicsUnmapResources", c_uint(1), byref(self._resource), c_void_p(stream))

    def release(self) -> None:
        """Let OpenGL have the buffer alone."""
        self._driver.cuGraphicsUnregisterResource(self._resource)

    def _call(self, name: str, *values: Any) -> None:
        if (code := getattr(self._driver, name)(*values)) != 0:
            words = ctypes.c_char_p()
            self._driver.cuGetErrorName(code, byref(words))
            raise NoInterop(f"{name}: {(words.value or b'error').decode()} ({code})")
