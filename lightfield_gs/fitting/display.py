"""A fit for a panel: its rig in the capture, the photographs that count for it, and only what it shows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from lightfield_gs.base.checks import expect, real_number
from lightfield_gs.base.errors import InputError
from lightfield_gs.fitting.cone import Cone, place_cone
from lightfield_gs.io.captures.camera_files import FileCamera
from lightfield_gs.io.captures.capture import Capture
from lightfield_gs.io.captures.pinhole import nearest_rotation
from lightfield_gs.panels.framing import framing_comment
from lightfield_gs.panels.panel import DEFAULT_PANEL, Panel
from lightfield_gs.panels.rig import Rig

# Where down is in a stored photograph, (x, y): of one to be turned by 0, 1, 2 and 3 quarter turns clockwise, and by its
# Exif orientation (JEITA CP-3451, tag 274). What is mirrored stays so.
_DOWN = ((0, 1), (1, 0), (0, -1), (-1, 0))
_STORED_DOWN = {2: _DOWN[0], 3: _DOWN[2], 4: _DOWN[2], 5: _DOWN[1], 6: _DOWN[1], 7: _DOWN[3], 8: _DOWN[3]}
_SURE = 0.5  # the least length of a direction across the centre camera's axis that says anything


@dataclass(frozen=True)
class Display:
    """The panel that a scene is fitted for, and where it stands in the capture.

    rig: in the capture's coordinates, at the panel's resolution, with the cone's angle. messages: what was
    chosen, one line each.
    """

    panel: Panel
    cone: Cone
    rig: Rig
    messages: tuple[str, ...]

    @classmethod
    def of(cls, capture: Capture, cone: Panel | str | Path | float, centre: str | None = None) -> Display:
        """For a panel, its name or file, or the full angle of a cone in degrees, 1..179, which is then that of the
        default panel; round the photograph of this name, or the most central one. Raises InputError."""
        panel, words = panel_of(cone)
        placed = place_cone(capture, panel.cone_deg, centre)
        quarters, turned = quarter_turns(capture, placed.centre)
        rig = rig_of(capture, placed, panel, quarters)
        return cls(panel, placed, rig, (*placed.messages, *turned, words))

    def shares(self, indices: Sequence[int]) -> list[float]:
        """For photographs at these indices of the capture: in how many of the epochs each is, the largest 1."""
        weights = self.cone.weights()[list(indices)]
        return (weights / weights.max()).tolist()

    def comments(self) -> list[str]:
        """Lines for the header of the scene's file: encoding it for any panel shows it by this rig."""
        return [framing_comment(self.rig, self.panel)]


def rig_path(scene: Path) -> Path:
    """Where the rig is written: scene.ply has it beside it in scene.rig.yaml."""
    return scene.with_suffix(".rig.yaml")


def placed(
    capture: Capture, cone: Panel | str | Path | float | None, centre: str | None, score_cone: float | None
) -> tuple[Display | None, Cone | None, tuple[str, ...]]:
    """What a fit is for, and the cone that it is judged in: that of the display, or of score_cone degrees round the
    same photograph; None: not asked for. And what was chosen, in lines. Raises InputError."""
    if centre is not None and cone is None and score_cone is None:
        raise InputError(
            f"centre: {centre} is the middle of a cone, and there is none: give cone or score_cone as well"
        )
    display = None if cone is None else Display.of(capture, cone, centre)
    judged = None if display is None else display.cone
    if score_cone is not None:
        judged = place_cone(capture, score_cone, centre if display is None else display.cone.name)
    if display is not None:
        return display, judged, display.messages
    return None, judged, () if judged is None else judged.messages


def panel_of(cone: Panel | str | Path | float) -> tuple[Panel, str]:
    """The panel that `--cone` names, or the default panel with a cone of so many degrees; and what to say of it."""
    expect("cone", cone, Panel, str, Path, int, float, np.integer, np.floating)
    if isinstance(cone, str) and is_angle(cone):
        cone = float(cone)
    if not isinstance(cone, (Panel, str, Path)):
        panel = replace(Panel.load(DEFAULT_PANEL), cone_deg=real_number("cone", cone, 1.0, 179.0))
        return panel, f"cone: the panel is {_words(panel)}, the default, but for its cone; another: --cone PANEL.yaml"
    panel = cone if isinstance(cone, Panel) else Panel.load(cone)
    return panel, f"cone: the panel is {_words(panel)}"


def quarter_turns(capture: Capture, centre: int) -> tuple[int, tuple[str, ...]]:
    """By how many quarter turns clockwise, 0..3, the stored photograph at the index `centre` is to be turned to stand
    upright, by the Exif orientation of all; and what to say of it.

    Every photograph says where down is in the scene, and so in the centre photograph. What most of them say holds, and
    of equally many the centre photograph.
    """
    tags = [photograph.orientation for photograph in capture.photographs]
    if not any(tag in _STORED_DOWN for tag in tags):
        return 0, ()
    stored = np.array([(*_STORED_DOWN.get(tag, _DOWN[0]), 0) for tag in tags])
    rotations = capture.world_to_camera[:, :3, :3]
    down = (rotations[centre] @ rotations.swapaxes(1, 2) @ stored[..., None])[:, :2, 0]
    votes = (down @ np.array(_DOWN).T).argmax(1)
    counts = np.bincount(votes[np.linalg.norm(down, axis=1) > _SURE], minlength=len(_DOWN))
    own = int(votes[centre])
    quarters = own if counts[own] == counts.max() else int(counts.argmax())
    how = (
        "is not turned",
        "is turned by 90 degrees clockwise",
        "is turned by 180 degrees",
        "is turned by 90 degrees counter-clockwise",
    )[quarters]
    name = capture.names[centre]
    return quarters, (
        f"cone: the rig {how} from {name} as stored (Exif orientation {tags[centre]}), so that "
        f"{counts[quarters]} of {len(tags)} photographs stand upright",
    )


def rig_of(capture: Capture, cone: Cone, panel: Panel, quarters: int = 0) -> Rig:
    """The rig whose centre camera is that of the centre photograph, all of which is in the panel's middle, turned by so
    many quarter turns clockwise.

    Its zero plane goes through the pivot, which lies on the camera's axis: it is seen at the photograph's principal
    point in every view, and the views at the ends of the fan see it from half the cone to either side.
    """
    fx, fy, cx, cy = map(float, capture.intrinsics[cone.centre])
    width, height = map(int, capture.sizes_px[cone.centre])
    pose = capture.world_to_camera[cone.centre]
    camera = FileCamera(capture.names[cone.centre], pose, (fx, fy), (cx, cy), width, height).turned(quarters)
    focal, principal = camera.fitted(panel.width_px, panel.height_px)
    pose = camera.world_to_camera.copy()
    pose[:3, :3] = nearest_rotation(pose[:3, :3])
    return Rig(pose, focal, principal, cone.zero_depth, panel.cone_deg)


def _words(panel: Panel) -> str:
    return f"{panel.name}, {panel.width_px} x {panel.height_px}, {panel.views} views in {panel.cone_deg:g} degrees"


def is_angle(cone: str) -> bool:
    """Whether what was given as a cone is a number of degrees, not the name of a panel."""
    try:
        float(cone)
    except ValueError:
        return False
    return True
