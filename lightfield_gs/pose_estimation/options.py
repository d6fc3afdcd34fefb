"""What is posed, and by what."""

from __future__ import annotations

from dataclasses import dataclass

from lightfield_gs.base.options import POSED_FRAMES, Device


@dataclass(frozen=True)
class PoseOptions:
    """The choice of photographs, and of the ways to their poses.

    Attributes:
        frames: of a film or a burst, at most.
        keep_blurred: whether blurred photographs and frames are posed too.
        mask_people: whether people are left out of the photographs.
        pose_model: name or folder of a network that poses where structure from motion fails; None: none does.
        device: "auto" and "cuda" use a GPU where there is one.
    """

    frames: int = POSED_FRAMES
    keep_blurred: bool = False
    mask_people: bool = False
    pose_model: str | None = None
    device: Device = "auto"
