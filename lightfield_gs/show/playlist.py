"""Pictures and films that one screen shows in turn."""

from __future__ import annotations

from dataclasses import dataclass, field
from fractions import Fraction
from pathlib import Path

from lightfield_gs.base.options import StereoLayout
from lightfield_gs.io.stereo_names import PairLayout
from lightfield_gs.panels.panel import Panel
from lightfield_gs.panels.quilt import QuiltLayout


@dataclass(frozen=True)
class Slide:
    """A picture or a film.

    Attributes:
        path: Its file, or the folder of its frames.
        panel: The panel that it was encoded for, where it says so.
        quilt: Its tiles, of a quilt.
        pair: Where both eyes' pictures are, of a stereo picture or film.
        is_film: Whether it moves.
        fps: Of a film of native frames, frames a second.
        frames: The same, their number.
    """

    path: Path
    panel: Panel | None = None
    quilt: QuiltLayout | None = None
    pair: PairLayout | None = None
    is_film: bool = False
    fps: Fraction | None = None
    frames: int = 0

    @property
    def is_native(self) -> bool:
        """Whether it has the panel's own pixels."""
        return self.quilt is None and self.pair is None


@dataclass(frozen=True)
class Playlist:
    """Slides for one screen.

    Attributes:
        slides: In order.
        panel: The screen: a panel, or one of two eyes.
        layout: How a screen of two eyes takes both pictures; None for panels.
        messages: Lines on what was found.
    """

    slides: list[Slide]
    panel: Panel
    layout: StereoLayout | None = None
    messages: list[str] = field(default_factory=list)
