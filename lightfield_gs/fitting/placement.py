"""The places of a fit's photographs and of Adam's moments, and whether there is room for the fit.

Photographs are on the device, in the host's memory or in files; moments are on the device or in the host's memory. No
place changes a bit of the scene.
"""

from __future__ import annotations

import shutil
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import torch

from lightfield_gs.base.device import free_memory
from lightfield_gs.base.errors import InputError
from lightfield_gs.base.options import MomentsOn, PhotosOn
from lightfield_gs.base.system import free_host_memory
from lightfield_gs.fitting.memory import MemoryEstimate, to_words

REMEDIES = "use a smaller cap_max=, a smaller scale= or a lower sh_degree="
_SPARE = 0.8  # of the free memory, or of the free disk, that a fit may take by its own choice
_MOST_PHOTOGRAPHS = 0.5  # of the free memory
_TOLERANCE = 1.1  # the estimate may be too high by this factor
_PINNED = 2  # torch takes a power of two of bytes for a tensor in pinned memory


@dataclass(frozen=True)
class Room:
    """The free bytes that a fit finds; None where the system does not state them.

    Attributes:
        device: name of the fit's device; "cpu" has the host's memory.
        on_device: of its memory.
        on_host: of the host's memory.
        on_disk: of the disk of `folder`.
        folder: where files of photographs would be.
    """

    device: str
    on_device: int | None
    on_host: int | None
    on_disk: int
    folder: Path

    @classmethod
    def find(cls, device: str, folder: Path, processes: int) -> Room:
        """Return the present room of one of some processes, which may share a host; the folder may be absent."""
        there = next(path for path in (folder, *folder.absolute().parents) if path.is_dir())
        host, disk = free_bytes("cpu"), shutil.disk_usage(there).free
        host = None if host is None else host // processes
        return cls(device, host if device == "cpu" else free_bytes(device), host, disk // processes, folder)


@dataclass(frozen=True)
class Placement:
    """The places of photographs and moments.

    Attributes:
        need: the memory of the fit.
        room: the free memory.
        photographs: their place.
        moments: their place.
    """

    need: MemoryEstimate
    room: Room
    photographs: Literal["device", "host", "disk"]
    moments: Literal["device", "host"]

    @classmethod
    def choose(cls, need: MemoryEstimate, room: Room, photos_on: PhotosOn, moments_on: MomentsOn) -> Placement:
        """Return the fastest places that suffice.

        Photographs may take half of the memory of the device, or else of the host. Moments are on the device as long as
        it has the memory: steps that read and write them elsewhere take longer.

        Args:
            need: the memory of the fit.
            room: the free memory.
            photos_on: "memory" excludes files, "disk" demands them.
            moments_on: "device" or "host" demands it.

        Raises:
            InputError: files are demanded, and the disk lacks the room for them.
        """
        on_device = cls(need, room, _place_photographs(need, room, photos_on), "device")
        if room.device == "cpu" or moments_on == "device" or moments_on == "auto" and on_device.suffices:
            return on_device
        return replace(on_device, moments="host")

    @property
    def suffices(self) -> bool:
        """Whether the memory clearly suffices."""
        return all(_fits(bytes_, free, _SPARE) for _, bytes_, free in self._needs())

    def check(self, is_certain: bool) -> None:
        """Raise InputError where clearly less memory is free than the fit needs.

        Args:
            is_certain: whether the fit will need it, or only may need it.
        """
        for where, bytes_, free in self._needs():
            if is_certain and not _fits(bytes_, free, _TOLERANCE):
                raise InputError(
                    f"the fit needs {to_words(bytes_)} of the memory of {where} ({self.need.words()}), and "
                    f"{to_words(free or 0)} are free; {REMEDIES}"
                )

    def describe(self) -> list[str]:
        """Return lines about the needed memory, and about each place that is not the device."""
        parts = [
            f"{to_words(bytes_)} of memory of {where}" + ("" if free is None else f" ({to_words(free)} free)")
            for where, bytes_, free in self._needs()
        ]
        lines = [f"needs about {' and '.join(parts)}: {self.need.words()}"]
        if self.photographs == "host":
            lines.append("photographs stay in the host's memory")
        if self.photographs == "disk":
            lines.append(
                f"decodes the photographs to files of {to_words(self.need.photographs)} in {self.room.folder.parent} "
                f"({to_words(self.room.on_disk)} free), and removes them at the end"
            )
        if self.moments == "host":
            lines.append("Adam's moments stay in the host's memory")
        return lines

    def assumptions(self, photos_on: PhotosOn, moments_on: MomentsOn) -> list[str]:
        """Return lines about places that the fit chose by itself, and that slow it down or fill a disk."""
        lines = []
        if photos_on == "auto" and self.photographs == "disk":
            lines.append("photographs go to disk, since they would fill more than half of the memory; photos_on=memory")
        if moments_on == "auto" and self.moments == "host":
            lines.append(
                f"Adam's moments go to the host's memory, since that of {self.room.device} does not suffice, and steps "
                "take longer; use a smaller cap_max=, or moments_on=device"
            )
        return lines

    def _needs(self) -> list[tuple[str, int, int | None]]:
        """Return names of memories, the bytes that a fit needs of each, and its free ones."""
        need, room = self.need, self.room
        device = need.parameters + need.parameter_copies + need.gradients + need.work
        host, moments = 0, need.moments + need.moment_copies
        if self.photographs == "device":
            device += need.photographs
        else:
            device += need.read_ahead
            host += need.read_ahead + (need.photographs if self.photographs == "host" else 0)
        if self.moments == "device":
            device += moments
        else:
            host += _PINNED * moments
        if room.device == "cpu":
            return [("the host", device, room.on_device)]
        return [(room.device, device, room.on_device), *([("the host", host, room.on_host)] if host else [])]


def free_bytes(device: str) -> int | None:
    """Return the free memory of a device, or of the host for "cpu"; None if the system does not state it."""
    return free_host_memory() if device == "cpu" else free_memory(torch.device(device))


def _place_photographs(need: MemoryEstimate, room: Room, wanted: PhotosOn) -> Literal["device", "host", "disk"]:
    if wanted == "disk":
        if need.photographs > room.on_disk:
            raise InputError(
                f"the photographs need {to_words(need.photographs)} of disk, and {room.folder.parent} has "
                f"{to_words(room.on_disk)} free; use a folder= on another disk, or a smaller scale="
            )
        return "disk"
    if _fits(need.photographs, room.on_device, _MOST_PHOTOGRAPHS):
        return "device"
    on_host: Literal["device", "host"] = "device" if room.device == "cpu" else "host"
    is_full = wanted == "auto" and not _fits(need.photographs, room.on_host, _MOST_PHOTOGRAPHS)
    return "disk" if is_full and _fits(need.photographs, room.on_disk, _SPARE) else on_host


def _fits(bytes_: int, free: int | None, fraction: float) -> bool:
    """Return whether bytes are within a fraction of the free ones; True where these are unknown."""
    return free is None or bytes_ <= fraction * free
