"""Buffers of a WebGPU device by name: made when first needed, enlarged when too small, never beyond the limits."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, NamedTuple

from lightfield_gs.base.errors import InputError

if TYPE_CHECKING:
    import wgpu

_LEAST_BYTES = 256
_SLACK = 1.25  # a buffer is made larger than needed, so that it seldom has to grow


class Limits(NamedTuple):
    """The limits of an adapter that a frame meets.

    Attributes:
        binding_bytes: Of a storage buffer that a stage sees.
        buffer_bytes: Of a buffer.
    """

    binding_bytes: int
    buffer_bytes: int

    @property
    def most_bytes(self) -> int:
        """The largest buffer that a stage can see whole."""
        return min(self.binding_bytes, self.buffer_bytes) // _LEAST_BYTES * _LEAST_BYTES


class Buffers:
    """The buffers of the frames of one device.

    Attributes:
        uploaded_bytes: What the host wrote so far.
        version: Changes with every buffer that is made.
    """

    def __init__(self, device: wgpu.GPUDevice, limits: Limits) -> None:
        self.device, self.limits = device, limits
        self.uploaded_bytes = self.version = 0
        self._buffers: dict[str, wgpu.GPUBuffer] = {}
        self._parameters: dict[str, bytes] = {}  # what the buffers for parameters hold

    def __getitem__(self, name: str) -> wgpu.GPUBuffer:
        return self._buffers[name]

    def storage(self, name: str, size: int, what: str) -> int:
        """Make sure that a storage buffer has room; return its bytes. Its contents are lost where it grows.

        Args:
            name: Of the binding.
            size: Bytes that are needed.
            what: What asks for it, and the way out, for the message.

        Raises:
            InputError: The adapter allows no such buffer.
        """
        size = max(size, _LEAST_BYTES)
        if size > self.limits.most_bytes:
            raise InputError(
                f"webgpu: {what}: needs a buffer of {size} bytes, and this adapter allows {self.limits.most_bytes}: "
                "use device cpu, or leave out Gaussians (lightfield-gs prune)"
            )
        old = self._buffers.get(name)
        if old is not None and old.size >= size:
            return old.size
        if old is not None:
            size = min(int(size * _SLACK), self.limits.most_bytes)
        return self._make(name, -(-size // 4) * 4)

    def exactly(self, name: str, size: int) -> None:
        """Make sure that a storage buffer has just this many bytes, a multiple of 4 within the limits."""
        old = self._buffers.get(name)
        if old is None or old.size != size:
            self._make(name, size)

    def results(self, name: str, size: int) -> None:
        """Make sure that a buffer that the host reads has room for this many bytes, a multiple of 4."""
        import wgpu

        old = self._buffers.get(name)
        if old is None or old.size < size:
            self._make(name, size, wgpu.BufferUsage.MAP_READ | wgpu.BufferUsage.COPY_DST)

    def write(self, name: str, data: bytes | memoryview) -> None:
        """Write the beginning of a storage buffer, which must be large enough."""
        self.uploaded_bytes += len(data)
        self.device.queue.write_buffer(self._buffers[name], 0, data)

    def parameters(self, name: str, data: bytes) -> None:
        """Write a buffer for parameters, of always the same size, unless it holds these bytes."""
        import wgpu

        if self._parameters.get(name) == data:
            return
        if name not in self._buffers:
            self._make(name, len(data), wgpu.BufferUsage.UNIFORM | wgpu.BufferUsage.COPY_DST)
        self._parameters[name] = data
        self.write(name, data)

    @contextmanager
    def mapped(self, name: str, size: int) -> Iterator[memoryview]:
        """Wait for the work before, and give the first bytes of a buffer of `results`; they go at the end."""
        buffer = self._buffers[name]
        buffer.map_sync("READ", 0, size)
        try:
            yield memoryview(buffer.read_mapped(0, size, copy=False))
        finally:
            buffer.unmap()

    def bytes(self) -> int:
        """Return the bytes of all buffers."""
        return sum(buffer.size for buffer in self._buffers.values())

    def release(self) -> None:
        """Free all buffers."""
        for buffer in self._buffers.values():
            buffer.destroy()
        self._buffers.clear()
        self._parameters.clear()

    def _make(self, name: str, size: int, usage: int | None = None) -> int:
        import wgpu

        if (old := self._buffers.pop(name, None)) is not None:
            old.destroy()
        storage = wgpu.BufferUsage.STORAGE | wgpu.BufferUsage.COPY_SRC | wgpu.BufferUsage.COPY_DST
        self._buffers[name] = self.device.create_buffer(size=size, usage=storage if usage is None else usage)
        self.version += 1
        return size
