"""One thing that a batch does."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Command = Literal["encode", "fit", "video"]
COMMANDS: tuple[Command, ...] = ("encode", "fit", "video")


@dataclass(frozen=True)
class Item:
    """One thing to do: command: encode a photo or a scene, fit a capture and encode its scene, or make a video.

    name: of its output in the folder of the batch, with / between folders; the item is known by it. input: its path.
    words: options of its own, as on the command line; fit_words: those of the fit.
    """

    name: str
    input: str
    command: Command = "encode"
    words: tuple[str, ...] = ()
    fit_words: tuple[str, ...] = ()

    @property
    def is_long(self) -> bool:
        """Whether it takes minutes, and a process for itself."""
        return self.command != "encode"
