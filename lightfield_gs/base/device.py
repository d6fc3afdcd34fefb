"""The device of a command; free memory, graphs of launches, and copies from CUDA to the host."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from functools import lru_cache
from queue import SimpleQueue
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor

from lightfield_gs import _core
from lightfield_gs.base.errors import InputError
from lightfield_gs.base.options import Device

_WARM_UP = 2  # calls before a capture
_ALIGNMENT = 256  # bytes, of each tensor within a buffer
_BUFFER_BYTES = 1 << 25  # the sizes of buffers are multiples, so that buffers seldom have to grow


def choose_device(name: Device) -> Literal["cpu", "cuda"]:
    """Return cpu or cuda for cpu, cuda or auto; raise InputError where cuda is asked for and absent."""
    if name == "cpu":
        return "cpu"
    missing = missing_for_cuda()
    if name == "cuda" and missing is not None:
        raise InputError(f"device='cuda': {missing}, or use device='cpu'")
    return "cpu" if missing else "cuda"


def missing_for_cuda() -> str | None:
    """Return what CUDA lacks, the build, the torch or the GPU, and what to do; None where nothing is missing."""
    if not hasattr(_core, "cuda"):
        return "this build has no CUDA stages; install it with nvcc on the PATH and -C cmake.define.LFGS_CUDA=ON"
    if torch.version.cuda is None:
        return f"this torch, {torch.__version__}, is a CPU build; install a CUDA build of torch"
    if not torch.cuda.is_available():
        return f"torch {torch.__version__} finds no GPU that it can use; see whether nvidia-smi lists one"
    return None


def device_guard(device: torch.device) -> AbstractContextManager:
    """Make `device` the current device inside the block, so that work goes to its stream; a CPU changes nothing."""
    if device.type != "cuda" or device.index == torch.cuda.current_device():
        return nullcontext()
    return torch.cuda.device(device)


def free_memory(device: torch.device) -> int:
    """Return the free bytes of a CUDA device, including bytes that torch reserves without use."""
    unused = torch.cuda.memory_reserved(device) - torch.cuda.memory_allocated(device)
    return torch.cuda.mem_get_info(device)[0] + unused


def capture_graph(call: Callable[[], Any], *, warm_up: bool = False) -> tuple[torch.cuda.CUDAGraph, Any]:
    """Capture the launches of a call as a CUDA graph; a capture computes nothing.

    Other threads may use the device meanwhile. The graph has the priority of the current stream.

    Args:
        call: its launches are captured.
        warm_up: for calls into libraries, which load and choose their algorithms in the first calls. It runs before the
            capture, and the graph is replayed once after it: later captures read the result while they warm up.

    Returns:
        The graph, and the result of the call, which each replay overwrites.
    """
    # an own pool: torch's pool belongs to the device that captured first
    stream = torch.cuda.Stream(priority=torch.cuda.current_stream().priority)
    if warm_up:
        stream.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(stream):
            for _ in range(_WARM_UP):
                call()
        torch.cuda.current_stream().wait_stream(stream)
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph, stream=stream, capture_error_mode="thread_local"):  # others may use the device
        result = call()
    if warm_up:
        graph.replay()
    return graph, result


def to_numpy(image: Tensor) -> np.ndarray:
    """Return a finished picture as an array; page-locked memory takes a third of the time of a plain copy from CUDA."""
    if not image.is_cuda:
        return image.numpy()
    host = torch.empty(image.shape, dtype=image.dtype, pin_memory=True)
    return host.copy_(image).numpy()


def finished(image: Tensor) -> Tensor:
    """Return an image once its device has drawn it."""
    if image.is_cuda:
        torch.cuda.current_stream(image.device).synchronize()
    return image


def finished_to_numpy(image: Tensor) -> np.ndarray:
    """Return a picture that its device has finished as an array; work that is queued meanwhile goes on.

    The page-locked memory of pictures that nobody holds any longer is used again.
    """
    if not image.is_cuda:
        return image.numpy()
    with torch.cuda.stream(_copy_stream(image.device)):
        host = torch.empty(image.shape, dtype=image.dtype, pin_memory=True)
        host.copy_(image, non_blocking=True)
        _copy_stream(image.device).synchronize()
    return host.numpy()


@lru_cache
def _copy_stream(device: torch.device) -> torch.cuda.Stream:
    return torch.cuda.Stream(device)


class HostCopies:
    """Copies tensors to page-locked buffers of the host while the device goes on computing.

    Locking memory takes longer than copying, so buffers are used again. Copies run on a stream of their own, behind the
    work that is queued.
    """

    def __init__(self, count: int) -> None:
        self._buffers: SimpleQueue[Tensor] = SimpleQueue()
        for _ in range(count):
            self._buffers.put(torch.empty(0, dtype=torch.uint8))
        self._stream: torch.cuda.Stream | None = None

    def begin(self, tensors: Sequence[Tensor]) -> HostCopy:
        """Begin to copy tensors of one device; wait for a buffer if all are in use."""
        starts = [0]
        for tensor in tensors:
            size = tensor.numel() * tensor.element_size()
            starts.append(starts[-1] + (size + _ALIGNMENT - 1) // _ALIGNMENT * _ALIGNMENT)
        buffer = self._buffers.get()
        try:
            if buffer.numel() < starts[-1]:
                with torch.inference_mode(False):
                    size = -(-starts[-1] // _BUFFER_BYTES) * _BUFFER_BYTES
                    buffer = torch.empty(size, dtype=torch.uint8, pin_memory=True)
            return self._copy(tensors, starts, buffer)
        except BaseException:
            self._buffers.put(buffer)
            raise

    def _copy(self, tensors: Sequence[Tensor], starts: list[int], buffer: Tensor) -> HostCopy:
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
                reached = torch.cuda.Event(blocking=True)  # a thread that waits leaves its core to others
                reached.record()
        return HostCopy(list(tensors), copies, reached, buffer, self._buffers)


class HostCopy:
    """Copies under way: `wait` for them, then `release` their buffer."""

    def __init__(
        self,
        sources: list[Tensor],
        copies: list[Tensor],
        reached: torch.cuda.Event,
        buffer: Tensor,
        buffers: SimpleQueue[Tensor],
    ) -> None:
        self._sources = sources  # keeps their memory from being used for anything else meanwhile
        self._copies, self._reached, self._buffer, self._buffers = copies, reached, buffer, buffers

    def wait(self) -> list[Tensor]:
        """Wait for the copies and return them; they are valid until `release`."""
        self._reached.synchronize()
        self._sources = []
        return self._copies

    def release(self) -> None:
        """Give the buffer to later copies; call this once."""
        self._reached.synchronize()
        self._sources, self._copies = [], []
        self._buffers.put(self._buffer)
