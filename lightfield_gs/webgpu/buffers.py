"""Buffers of a WebGPU device by name: made when first needed, enlarged when too small, never beyond the limits."""

from __future__ import annotations

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
    """The buffers of the frames of one device."""

    def __init__(self, device: wgpu.GPUDevice, limits: Limits) -> None:
        self.device, self.limits = device, limits
        self._buffers: dict[str, wgpu.GPUBuffer] = {}

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

    def write(self, name: str, data: bytes | memoryview, uniform: bool = False) -> None:
        """Write the beginning of a buffer, which must be large enough; one for parameters is made here."""
        import wgpu

        if uniform and name not in self._buffers:
            usage = wgpu.BufferUsage.UNIFORM | wgpu.BufferUsage.COPY_DST
            self._buffers[name] = self.device.create_buffer(size=len(data), usage=usage)
        self.device.queue.write_buffer(self._buffers[name], 0, data)

    def read(self, name: str, size: int) -> memoryview:
        """Return the first bytes of a buffer, once all work before has ended."""
        return self.device.queue.read_buffer(self._buffers[name], 0, size)

    def bytes(self) -> int:
        """Return the bytes of all buffers."""
        return sum(buffer.size for buffer in self._buffers.values())

    def release(self) -> None:
        """Free all buffers."""
        for buffer in self._buffers.values():
            buffer.destroy()
        self._buffers.clear()

    def _make(self, name: str, size: int) -> int:
        import wgpu

        if (old := self._buffers.pop(name, None)) is not None:
            old.destroy()
        usage = wgpu.BufferUsage.STORAGE | wgpu.BufferUsage.COPY_SRC | wgpu.BufferUsage.COPY_DST
        self._buffers[name] = self.device.create_buffer(size=size, usage=usage)
        return size
