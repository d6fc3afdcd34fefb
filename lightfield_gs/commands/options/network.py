"""The network of a command, which is read once however many photos the command takes."""

from __future__ import annotations

from contextlib import suppress
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from lightfield_gs.models.replayed import ReplayedNet


def network_of(checkpoint: Path | None, device: str) -> ReplayedNet:
    """The network of --checkpoint, on the device; None: the one inside. The last one is kept, and read again when its
    file is another. Raises InputError."""
    version = None
    if checkpoint is not None:
        with suppress(OSError):  # its reader says what is wrong with it
            found = checkpoint.stat()
            version = found.st_size, found.st_mtime_ns
    return _network(checkpoint, version, device)


@lru_cache(maxsize=1)
def _network(checkpoint: Path | None, version: tuple[int, int] | None, device: str) -> ReplayedNet:
    import torch

    from lightfield_gs.models import SplatterNet
    from lightfield_gs.models.replayed import ReplayedNet

    with torch.inference_mode(False):  # whose weights could not be used outside
        return ReplayedNet(SplatterNet.from_pretrained(checkpoint).to(device))
