"""A fit for a panel: the cone of views in the capture, the weights of photographs in it, and the panel's rig.

A panel shows a scene from places on a line, at most half its cone to either side of a centre camera. Only the views
from these places have to be right. Angles are between the places of cameras, seen from the pivot: the point of the
centre camera's axis in the panel's zero plane.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from lightfield_gs.base.assumptions import assume
from lightfield_gs.base.checks import counted, expect, real_number
from lightfield_gs.base.errors import InputError
from lightfield_gs.base.options import DEFAULT_PANEL
from lightfield_gs.fitting.evaluate import ConeAngles
from lightfield_gs.io.captures.camera_files import FileCamera
from lightfield_gs.io.captures.capture import Capture
from lightfield_gs.io.captures.central import FEWEST, angles_from, axes_intersection, directions_from, most_central
from lightfield_gs.io.captures.pinhole import nearest_rotation
from lightfield_gs.panels.comfort import comfortable_amount
from lightfield_gs.panels.look import Look
from lightfield_gs.panels.panel import Panel
from lightfield_gs.panels.rig import Rig
from lightfield_gs.panels.stored_rigs import framing_comment
from lightfield_gs.scene.gaussians import Gaussians

# Photographs within half the cone and this margin count fully. Objects before and behind the zero plane are seen at
# other angles than the pivot. Views at the cone's edge lie between photographs, too.
MARGIN_DEG = 5.0
# Beyond, weights fall as a cosine over FALL_DEG to a floor. Photographs far outside still show the places of objects,
# but not their look from the panel.
FALL_DEG, FLOOR = 20.0, 0.05

# The direction (x, y) of down in a stored photograph, by the clockwise quarter turns to upright, and by Exif
# orientation (JEITA CP-3451, tag 274). Mirrored photographs stay mirrored.
_DOWN = ((0, 1), (1, 0), (0, -1), (-1, 0))
_STORED_DOWN = {2: _DOWN[0], 3: _DOWN[2], 4: _DOWN[2], 5: _DOWN[1], 6: _DOWN[1], 7: _DOWN[3], 8: _DOWN[3]}
_LEAST_ACROSS = 0.5  # the least length across the centre camera's axis of a direction that counts


@dataclass(frozen=True)
class Cone:
    """The cone of a panel's views in a capture of C photographs.

    Attributes:
        name: of the centre photograph.
        centre: its index.
        pivot: [3] float64, coordinates of the capture, on the axis of the centre camera.
        zero_depth: its depth before the centre camera, scene units.
        cone_deg: full angle.
        angles_deg: [C] float64, 0..180, of every photograph from the centre photograph, seen from the pivot.
        messages: the choices, one line each.
    """

    name: str
    centre: int
    pivot: np.ndarray
    zero_depth: float
    cone_deg: float
    angles_deg: np.ndarray
    messages: tuple[str, ...]

    @property
    def inside(self) -> np.ndarray:
        """[C] bool, photographs within half the cone of the centre."""
        return self.angles_deg <= self.cone_deg / 2

    def held_out_angles(self, indices: Sequence[int]) -> ConeAngles:
        """Return the angles of held-out photographs, by their indices in the capture; warn if few are inside."""
        if (inside := int(self.inside[list(indices)].sum())) < FEWEST:
            assume(
                f"cone: {inside} of {len(indices)} held-out photographs are inside, whose mean says little; hold out "
                "more of them (test_every=3, or test_names=)"
            )
        return ConeAngles(self.name, self.cone_deg, self.angles_deg[list(indices)].tolist())


def cone_weights(angles_deg: np.ndarray, cone_deg: float) -> np.ndarray:
    """Return weights FLOOR..1 at angles from the centre.

    They are 1 within half the cone and MARGIN_DEG, then fall as half a period of a cosine to FLOOR at FALL_DEG farther.
    """
    beyond = np.clip((angles_deg - cone_deg / 2 - MARGIN_DEG) / FALL_DEG, 0, 1)
    return FLOOR + (1 - FLOOR) * (1 + np.cos(np.pi * beyond)) / 2


def place_cone(capture: Capture, cone_deg: float, centre: str | None = None) -> Cone:
    """Place a cone round a photograph of a capture.

    The pivot is on the centre camera's axis, at the median depth of the points in the middle third, each way, of its
    photograph: a panel is sharpest there, and the surface of the subject should be. With few such points the axes of
    the cameras in the cone intersect at the pivot's depth, within a subject photographed from around.

    Args:
        capture: the photographs and cameras.
        cone_deg: full angle, 1..179.
        centre: name of the centre photograph. None: the photograph with the most others within half the cone and
            MARGIN_DEG, seen from the intersection of the capture's axes. Among equals the least mean square of their
            angles decides.

    Raises:
        InputError: the name is unknown, or nothing tells the depth.
    """
    cone_deg = real_number("cone", cone_deg, 1.0, 179.0)
    half = cone_deg / 2 + MARGIN_DEG
    chosen_by = "given"
    middle = _capture_middle(capture)
    if centre is None:
        index, others = most_central(directions_from(capture.centres, middle), half)
        chosen_by = f"it has the most others within {half:g} degrees, {others}, seen from the middle of the capture"
    else:
        index = capture.find_index(centre, "centre photograph")
    near = np.flatnonzero(angles_from(directions_from(capture.centres, middle), index) <= half)
    depth, how = _zero_depth(capture, index, near, middle)
    axis = capture.world_to_camera[index, 2, :3]
    pivot = capture.centres[index] + depth * axis
    angles = angles_from(directions_from(capture.centres, pivot), index)
    count, full, inside = len(angles), int((angles <= half).sum()), int((angles <= cone_deg / 2).sum())
    messages = (
        f"cone: {cone_deg:g} degrees round {capture.names[index]} ({chosen_by})",
        f"cone: {counted(inside, 'photograph', count, 'are inside')}; {full} within {half:g} degrees of the centre "
        f"count fully, the others less, down to {FLOOR:g}",
        f"cone: zero plane {depth:.4g} scene units before the centre camera, {how}",
    )
    return Cone(capture.names[index], index, pivot, depth, cone_deg, angles, messages)


def central_depth(capture: Capture, index: int) -> float | None:
    """Return the median depth of the points in the middle third, each way, of a photograph; None with few points.

    Some of the points may be hidden in the photograph.
    """
    pose, (fx, fy, cx, cy) = capture.world_to_camera[index], capture.intrinsics[index]
    x, y, z = (capture.points @ pose[:3, :3].T + pose[:3, 3]).T
    width, height = capture.sizes_px[index]
    with np.errstate(divide="ignore", invalid="ignore"):
        u, v = fx * x / z + cx - width / 2, fy * y / z + cy - height / 2
    middle = (z > 0) & (abs(u) < width / 6) & (abs(v) < height / 6)
    return float(np.median(z[middle])) if middle.sum() >= 10 * FEWEST else None


def _capture_middle(capture: Capture) -> np.ndarray:
    """Return [3], the intersection of the axes, or the point in the view of the middle camera."""
    centres, axes = capture.centres, capture.world_to_camera[:, 2, :3]
    if (point := axes_intersection(centres, axes)) is not None:
        return point
    index = int(np.linalg.norm(centres - np.median(centres, 0), axis=1).argmin())
    if (depth := central_depth(capture, index)) is None:
        raise InputError(
            f"cone: expected photographs of one thing, or points in the middle of {capture.names[index]}: the axes of "
            f"{len(centres)} cameras meet nowhere before them, and there are no such points, so that nothing says at "
            "which depth the panel's plane is"
        )
    return centres[index] + depth * axes[index]


def _zero_depth(capture: Capture, index: int, near: np.ndarray, middle: np.ndarray) -> tuple[float, str]:
    """Return the depth of the pivot before the centre camera, > 0, and its source; near: cameras in the cone."""
    centres, axes = capture.centres, capture.world_to_camera[:, 2, :3]
    centre, axis = centres[index], axes[index]
    if (found := central_depth(capture, index)) is not None:
        return found, "at the median depth of the points in the middle of the centre photograph"
    point = axes_intersection(centres[near], axes[near])
    if point is not None and (depth := float((point - centre) @ axis)) > 0:
        return depth, f"where the axes of {len(near)} photographs in the cone meet"
    if (depth := float((middle - centre) @ axis)) > 0:
        return depth, "where the axes of the capture meet"
    raise InputError(
        f"cone: {capture.names[index]} looks away from what the other photographs show, and there are no points in its "
        "middle, so that nothing says at which depth the panel's plane is; give another centre="
    )


# --- The panel's rig


@dataclass(frozen=True)
class Display:
    """The panel that a scene is fitted for, and its place in the capture.

    Attributes:
        panel: the panel.
        cone: its cone.
        rig: in the capture's coordinates, at the panel's resolution, with the cone's angle.
        messages: the choices, one line each.
    """

    panel: Panel
    cone: Cone
    rig: Rig
    messages: tuple[str, ...]

    @classmethod
    def place(cls, capture: Capture, cone: Panel | str | Path | float, centre: str | None = None) -> Display:
        """Place a panel in a capture.

        Args:
            capture: the photographs and cameras.
            cone: a panel, its name or file, or the full angle in degrees, 1..179, of the default panel's cone.
            centre: name of the centre photograph; None: the most central one.

        Raises:
            InputError: see place_cone.
        """
        panel, panel_message = read_cone(cone)
        placed = place_cone(capture, panel.cone_deg, centre)
        quarters, turn_messages = upright_turns(capture, placed.centre)
        rig = centre_rig(capture, placed, panel, quarters)
        return cls(panel, placed, rig, (*placed.messages, *turn_messages, panel_message))

    @classmethod
    def place_front(cls, capture: Capture) -> Display | None:
        """Place a panel of the photograph's shape before the one that most others are near.

        The rig leaves the cone to the panel that shows the scene.

        Returns:
            None where the capture has no middle.
        """
        panel = Panel.load(DEFAULT_PANEL)
        try:
            placed = place_cone(capture, panel.cone_deg)
        except InputError:
            return None
        quarters, _ = upright_turns(capture, placed.centre)
        width, height = map(int, capture.sizes_px[placed.centre])
        size = (height, width) if quarters % 2 else (width, height)
        panel = replace(panel, width_px=size[0], height_px=size[1])
        rig = replace(centre_rig(capture, placed, panel, quarters), cone_deg=None)
        return cls(panel, placed, rig, ())

    def eased(self, gaussians: Gaussians) -> Display:
        """Return the display with as much depth as does not strain the eyes.

        Args:
            gaussians: the fitted scene, in the capture's coordinates.
        """
        rig = self.rig.relative_to(gaussians.origin)
        amount = comfortable_amount(gaussians, self.panel, rig)
        if amount is None:
            return self
        words = f"depth: {amount:g} of what it is, the most that does not strain the eyes"
        return replace(
            self, rig=Look(depth_amount=amount).applied(self.rig, self.panel), messages=(*self.messages, words)
        )

    def photo_weights(self, indices: Sequence[int]) -> list[float]:
        """Return the weights of photographs, by their indices in the capture; the largest is 1."""
        weights = cone_weights(self.cone.angles_deg, self.cone.cone_deg)[list(indices)]
        return (weights / weights.max()).tolist()

    def comments(self) -> list[str]:
        """Return lines for the header of the scene's file, by which encode shows it with this rig on any panel."""
        return [framing_comment(self.rig, self.panel)]


def place_display(
    capture: Capture, cone: Panel | str | Path | float | None, centre: str | None, score_cone: float | None
) -> tuple[Display | None, Cone | None, tuple[str, ...]]:
    """Place the display of a fit, and the cone by which it is scored.

    Args:
        capture: the photographs and cameras.
        cone: see Display.place; None: there is no display.
        centre: name of the centre photograph; None: the most central one.
        score_cone: full angle in degrees of the cone for scores; None: the display's.

    Returns:
        The display, the cone for scores, each None if not asked for, and messages.

    Raises:
        InputError: centre without a cone; see place_cone.
    """
    if centre is not None and cone is None and score_cone is None:
        raise InputError(
            f"centre: {centre} is the middle of a cone, and there is none: give cone or score_cone as well"
        )
    display = None if cone is None else Display.place(capture, cone, centre)
    judged = None if display is None else display.cone
    if score_cone is not None:
        judged = place_cone(capture, score_cone, centre if display is None else display.cone.name)
    placed = display or judged
    return display, judged, () if placed is None else placed.messages


def read_cone(cone: Panel | str | Path | float) -> tuple[Panel, str]:
    """Return the panel of a `cone` argument, see Display.place, and a message about it."""
    expect("cone", cone, Panel, str, Path, int, float, np.integer, np.floating)
    if isinstance(cone, str) and is_angle(cone):
        cone = float(cone)
    if not isinstance(cone, (Panel, str, Path)):
        panel = replace(Panel.load(DEFAULT_PANEL), cone_deg=real_number("cone", cone, 1.0, 179.0))
        words = f"cone: the panel is {_describe(panel)}, the default, but for its cone; another: give it as the cone"
        return panel, words
    panel = cone if isinstance(cone, Panel) else Panel.load(cone)
    return panel, f"cone: the panel is {_describe(panel)}"


def upright_turns(capture: Capture, centre: int) -> tuple[int, tuple[str, ...]]:
    """Return the quarter turns clockwise that make the centre photograph upright, 0..3, and messages.

    The Exif orientation of each photograph tells where down is in the scene, and so in the centre photograph. The
    majority decides; among equals the centre photograph's own.
    """
    tags = [photograph.orientation for photograph in capture.photographs]
    if not any(tag in _STORED_DOWN for tag in tags):
        return 0, ()
    stored = np.array([(*_STORED_DOWN.get(tag, _DOWN[0]), 0) for tag in tags])
    rotations = capture.world_to_camera[:, :3, :3]
    down = (rotations[centre] @ rotations.swapaxes(1, 2) @ stored[..., None])[:, :2, 0]
    votes = (down @ np.array(_DOWN).T).argmax(1)
    counts = np.bincount(votes[np.linalg.norm(down, axis=1) > _LEAST_ACROSS], minlength=len(_DOWN))
    own = int(votes[centre])
    quarters = own if counts[own] == counts.max() else int(counts.argmax())
    ways = ("", "90 degrees clockwise", "180 degrees", "90 degrees counter-clockwise")
    how = f"is turned by {ways[quarters]}" if quarters else "is not turned"
    name = capture.names[centre]
    return quarters, (
        f"cone: the rig {how} from {name} as stored (Exif orientation {tags[centre]}), so that "
        f"{counts[quarters]} of {len(tags)} photographs stand upright",
    )


def centre_rig(capture: Capture, cone: Cone, panel: Panel, quarters: int = 0) -> Rig:
    """Return the rig with the camera of the centre photograph as its centre; the panel shows all of the photograph.

    Its zero plane goes through the pivot on the camera's axis. Every view shows the pivot at the photograph's principal
    point. The outermost views see it from half the cone to either side.

    Args:
        capture: the photographs and cameras.
        cone: the panel's cone in it.
        panel: the panel.
        quarters: quarter turns clockwise of the photograph.
    """
    fx, fy, cx, cy = map(float, capture.intrinsics[cone.centre])
    width, height = map(int, capture.sizes_px[cone.centre])
    pose = capture.world_to_camera[cone.centre]
    camera = FileCamera(capture.names[cone.centre], pose, (fx, fy), (cx, cy), width, height).turned(quarters)
    focal, principal = camera.fitted(panel.width_px, panel.height_px)
    pose = camera.world_to_camera.copy()
    pose[:3, :3] = nearest_rotation(pose[:3, :3])
    return Rig(pose, focal, principal, cone.zero_depth, panel.cone_deg)


def _describe(panel: Panel) -> str:
    return f"{panel.name}, {panel.width_px} x {panel.height_px}, {panel.views} views in {panel.cone_deg:g} degrees"


def is_angle(cone: str) -> bool:
    """Return whether a `cone` argument is a number of degrees, and no panel's name."""
    try:
        float(cone)
    except ValueError:
        return False
    return True
