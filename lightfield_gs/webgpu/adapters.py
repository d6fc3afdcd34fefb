"""The GPUs that WebGPU finds on this machine, and devices on them."""

from __future__ import annotations

import importlib.util
import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

from lightfield_gs.base.errors import InputError
from lightfield_gs.webgpu.buffers import Limits

if TYPE_CHECKING:
    import wgpu

ALLOW_CPU = "LFGS_WEBGPU_ALLOW_CPU"  # 1: adapters that are programs of the CPU are taken as well, for tests
_BACKENDS = ("Vulkan", "Metal", "D3D12")  # the order in which several ways to one GPU are preferred
_INSTALL = "pip install 'lightfield-gs[webgpu]'"


@dataclass(frozen=True)
class Adapter:
    """A GPU as WebGPU sees it.

    Attributes:
        name: Of the GPU.
        kind: "DiscreteGPU", "IntegratedGPU", "CPU" or "Unknown".
        backend: "Vulkan", "Metal" or "D3D12".
        driver: In the driver's words.
        limits: Of the adapter.
        gpu: The object of wgpu.
    """

    name: str
    kind: str
    backend: str
    driver: str
    limits: Limits
    gpu: Any

    @property
    def is_cpu(self) -> bool:
        """Whether it is a program of the CPU, which takes many times as long as our CPU path."""
        return self.kind == "CPU"

    def __str__(self) -> str:
        return f"{self.name} ({self.kind}, {self.backend})"

    def open(self) -> wgpu.GPUDevice:
        """Return a device with the adapter's limits, and with timestamps where it has them."""
        features = [name for name in ("timestamp-query",) if name in self.gpu.features]
        needed = ("max-buffer-size", "max-storage-buffer-binding-size")
        return self.gpu.request_device_sync(
            required_features=features, required_limits={name: self.gpu.limits[name] for name in needed}
        )


def missing() -> str | None:
    """Return what WebGPU lacks here, and what to do; None where nothing is missing."""
    if importlib.util.find_spec("wgpu") is None:
        return f"the package wgpu is not installed; {_INSTALL} (Python 3.11 or newer)"
    return None


@contextmanager
def _runtime_folder() -> Iterator[None]:
    """Give Wayland's client library a folder where the session has none: it prints an error per driver otherwise."""
    if "XDG_RUNTIME_DIR" in os.environ:
        yield
        return
    with TemporaryDirectory() as folder:
        os.environ["XDG_RUNTIME_DIR"] = folder
        try:
            yield
        finally:
            del os.environ["XDG_RUNTIME_DIR"]


@lru_cache
def adapters() -> tuple[Adapter, ...]:
    """Return the adapters, each GPU by one of its ways, the fastest kinds first. Equal cards are several adapters."""
    if missing() is not None:
        return ()
    import wgpu

    with _runtime_folder():
        gpus = wgpu.gpu.enumerate_adapters_sync()
    found: dict[tuple[str, str], list[Adapter]] = {}
    for gpu in sorted(
        (gpu for gpu in gpus if gpu.info["backend_type"] in _BACKENDS),
        key=lambda gpu: _BACKENDS.index(gpu.info["backend_type"]),
    ):
        info = gpu.info
        limits = Limits(gpu.limits["max-storage-buffer-binding-size"], gpu.limits["max-buffer-size"])
        adapter = Adapter(info["device"], info["adapter_type"], info["backend_type"], info["description"], limits, gpu)
        same = found.setdefault((adapter.name, adapter.kind), [])
        if not same or same[0].backend == adapter.backend:
            same.append(adapter)
    rank = {"DiscreteGPU": 0, "IntegratedGPU": 1, "CPU": 3}
    known = (adapter for same in found.values() for adapter in same)
    return tuple(sorted(known, key=lambda adapter: rank.get(adapter.kind, 2)))


def adapter_at(index: int) -> Adapter:
    """Return an adapter by its place in the list.

    Raises:
        InputError: There is none, or it is a program of the CPU.
    """
    if (lacking := missing()) is not None:
        raise InputError(f"device 'webgpu': {lacking}, or use device 'cpu'")
    known = adapters()
    if not known:
        raise InputError(
            "device 'webgpu': no adapter for Vulkan, Metal or D3D12; install the GPU's driver, or use device 'cpu'"
        )
    if index >= len(known):
        raise InputError(f"device 'webgpu:{index}': expected 0..{len(known) - 1}: {', '.join(map(str, known))}")
    adapter = known[index]
    if adapter.is_cpu and os.environ.get(ALLOW_CPU) != "1":
        raise InputError(
            f"device 'webgpu:{index}': {adapter} is a program of the CPU and slower than device 'cpu': use that "
            f"({ALLOW_CPU}=1 allows it for tests)"
        )
    return adapter
