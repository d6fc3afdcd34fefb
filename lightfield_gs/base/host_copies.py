"""Copies from a CUDA device to the host that go on while the device computes what comes next."""

from __future__ import annotations

from collections.abc import Sequence
from queue import SimpleQueue

import torch
from torch import Tensor

_ALIGNMENT = 256  # bytes, of each tensor within its buffer
_GRAIN = 1 << 25  # bytes that buffers are multiples of, so that they seldom have to grow


class HostCopies:
    """Makes copies of tensors in page-locked buffers, of which there are `count` and which are used again and again:
    to lock memory takes longer than to copy. A copy is made on a stream of its own, behind the work that is queued."""

    def __init__(self, count: int) -> None:
        self._buffers: SimpleQueue[Tensor] = SimpleQueue()
        for _ in range(count):
            self._buffers.put(torch.empty(0, dtype=torch.uint8))
        self._stream: torch.cuda.Stream | None = None

    def begin(self, tensors: Sequence[Tensor]) -> HostCopy:
        """Begins to copy tensors of one device; waits for a buffer where all are in use."""
        starts = [0]
        for tensor in tensors:
            size = tensor.numel() * tensor.element_size()
            starts.append(starts[-1] + (size + _ALIGNMENT - 1) // _ALIGNMENT * _ALIGNMENT)
        buffer = self._buffers.get()
        try:
            if buffer.numel() < starts[-1]:
                with torch.inference_mode(False):
                    buffer = torch.empty(-(-starts[-1] // _GRAIN) * _GRAIN, dtype=torch.uint8, pin_memory=True)
            return self._copied(tensors, starts, buffer)
        except BaseException:
            self._buffers.put(buffer)
            raise

    def _copied(self, tensors: Sequence[Tensor], starts: list[int], buffer: Tensor) -> HostCopy:
        with torch.cuda.device(tensors[0].device):
            if self._stream is None:
                self._stream = torch.cuda.Stream()
            self._stream.wait_stream(torch.cuda.current_stream())
            copies = []
            with torch.cuda.stream(self._stream):
                for tensor, start in zip(tensors, starts):
                    size = tensor.numel() * tensor.element_size()
                    copy = buffer[start : start + size].view(tensor.dtype).view(tensor.shape)
                    copies.append(copy.copy_(tensor, non_blocking=True))
                reached = torch.cuda.Event(blocking=True)  # whoever waits leaves its core to others
                reached.record()
        return HostCopy(list(tensors), copies, reached, buffer, self._buffers)


class HostCopy:
    """Copies under way: `wait` for them, and `release` their buffer."""

    def __init__(
        self,
        sources: list[Tensor],
        copies: list[Tensor],
        reached: torch.cuda.Event,
        buffer: Tensor,
        buffers: SimpleQueue[Tensor],
    ) -> None:
        self._sources = sources  # whose memory must not be used for anything else meanwhile
        self._copies, self._reached, self._buffer, self._buffers = copies, reached, buffer, buffers

    def wait(self) -> list[Tensor]:
        """The copies, which hold until `release`."""
        self._reached.synchronize()
        self._sources = []
        return self._copies

    def release(self) -> None:
        """Gives the buffer to the copies that come next. It is to be called once."""
        self._reached.synchronize()
        self._sources, self._copies = [], []
        self._buffers.put(self._buffer)
