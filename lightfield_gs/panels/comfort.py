"""Depth of a scene on a panel: disparities, distances before and behind the panel, comfort, sharpness, background."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import Any

from lightfield_gs.base.checks import expect
from lightfield_gs.panels.panel import Panel
from lightfield_gs.panels.rig import Rig
from lightfield_gs.panels.visibility import background_warning, view_coverage, visible_depths
from lightfield_gs.scene.gaussians import Gaussians

EYE_SEPARATION_MM = 63.0  # mean of adults (Dodgson, "Variation and extrema of human interpupillary distance", 2004)
# The one-degree rule: disparities between the eyes of up to one degree, either way, are seen without discomfort
# (Lambooij et al., "Visual discomfort and visual fatigue of stereoscopic displays: a review", J. Imaging Sci. Technol.
# 53(3), 030201, 2009).
COMFORT_DEG = 1.0
_RULE = "the one-degree rule, Lambooij et al. 2009"


@dataclass(frozen=True)
class PanelDepth:
    """Content of one depth on the panel. Lengths and angles are negative before the panel, positive behind it.

    All but depth, edge_px and blur_lenses are None where the panel lacks pixel_pitch_mm or viewing_distance_mm.

    Attributes:
        depth: View-space z, scene units.
        edge_px: Displacement in the outermost views against the centre view, pixels: to the right in one view, to the
            left in the other. It is s fx (1/Z0 - 1/Z) with s = Z0 tan(cone/2) (1 - 1/N).
        edge_mm: The same in mm.
        eyes_px: Displacement of the right eye's image against the left eye's, to the right, both at the viewing
            distance L, pixels. An eye at x sees the view whose camera has s = Z0 tan(cone/2) x / (L tan(panel's
            cone/2)).
        eyes_mm: The same in mm.
        behind_mm: Distance behind the panel at which the eyes see the content; None where it is infinite or the eyes
            diverge. It is L d/(e - d), with d = eyes_mm and e between the eyes.
        angle_deg: Convergence of the eyes on the panel minus their convergence on the content, 2 atan(e/2L) - 2 atan((e
            - d)/2L).
        blur_lenses: Number of lenses over which a point is blurred, 1 within the sharp range (see DepthReport).
    """

    depth: float
    edge_px: float
    edge_mm: float | None
    eyes_px: float | None
    eyes_mm: float | None
    behind_mm: float | None
    angle_deg: float | None
    blur_lenses: float


@dataclass(frozen=True)
class DepthReport:
    """The depth of a scene on a panel, by a rig; see depth_report.

    A lens has P_e sub-pixels, each 1/P_e of the cone wide, and a view is 1/N of the cone. The panel's angular step a is
    the larger angle. A lens shows one sample of a direction; lenses are P_e/3 pixels apart. A plane keeps its detail
    while it moves by at most one sample a step: 2 fx tan(cone/2) |1 - Z0/Z| a <= P_e/3 (the bandwidth of a display:
    Zwicker et al., "Antialiasing for automultiscopic 3D displays", 2006). For a viewer far off this depth reaches D =
    lens/(2 tan(panel's cone/2) a) mm to the front and to the back. For a viewer at L it reaches L D/(L +- D). A point
    beyond moves by several lenses a step: it is blurred over them, or seen several times.

    Attributes:
        zero_depth: View-space z of the panel's plane, scene units.
        near: View-space z of the nearest content of the centre view; 1 % of the content is nearer.
        far: View-space z of the farthest content of the centre view; 1 % of the content is farther.
        comfortable: Whether near and far are within one degree of the panel's plane for the eyes; None: unknown for
            this panel.
        amount: Factor of all disparities (Look.depth_amount) at the limit of comfort; None: unknown, or the scene is
            flat.
        sharp_depths: Range of view-space z that the panel shows as sharp as its own plane; None: the limit is infinite.
        sharp_mm: The same range in mm before and behind the panel; None: unknown, or infinite.
        unseen: Fraction 0..1 of the left-most and of the right-most view that shows background where the scene should
            go on.
    """

    zero_depth: float
    near: PanelDepth
    far: PanelDepth
    comfortable: bool | None
    amount: float | None
    sharp_depths: tuple[float, float | None]
    sharp_mm: tuple[float | None, float | None]
    unseen: tuple[float, float]

    def to_dict(self) -> dict[str, Any]:
        """Return the fields as json.dumps takes them."""
        return asdict(self)

    def lines(self) -> list[str]:
        """Return the report as lines of text."""
        return [
            f"depth: {self.near.depth:.4g} to {self.far.depth:.4g} is seen, {self.zero_depth:.4g} lies in the panel",
            f"near: {_describe(self.near)}",
            f"far: {_describe(self.far)}",
            f"comfortable: {self._comfort()}",
            f"sharp: {self._sharp()}",
            "outermost views: {:.1%} (left) and {:.1%} (right) of the scene's place is background".format(*self.unseen),
        ]

    def warnings(self) -> list[str]:
        """Return a line for each problem that an owner should fix, with the remedy."""
        out = []
        if self.comfortable is False:
            way = "" if self.amount is None else f", {_round_down(self.amount)} of what it is at the most"
            out.append(
                f"the depth strains the eyes: {self._angles()}; give a smaller depth_amount={way}, or another focus="
            )
        if (words := background_warning(max(self.unseen))) is not None:
            out.append(words)
        return out

    def _comfort(self) -> str:
        if self.comfortable is None:
            return "not known: the panel lacks viewing_distance_mm or pixel_pitch_mm (viewing_distance_mm=MM)"
        return f"{'yes' if self.comfortable else 'no'}, {self._angles()}"

    def _angles(self) -> str:
        where = f"{self.near.angle_deg:+.2f} to {self.far.angle_deg:+.2f} degrees between the eyes"
        return f"{where}, {COMFORT_DEG:g} is the most ({_RULE})"

    def _sharp(self) -> str:
        first, last = self.sharp_depths
        depths = f"depths {first:.4g} to {'any' if last is None else f'{last:.4g}'}"
        before, behind = self.sharp_mm
        if before is not None:
            to = "any distance" if behind is None else f"{behind:.3g} mm"
            depths = f"{before:.3g} mm before to {to} behind the panel, {depths}"
        return f"{depths}; near content over {self.near.blur_lenses:.1f} lenses, far over {self.far.blur_lenses:.1f}"


def depth_report(gaussians: Gaussians, panel: Panel, rig: Rig) -> DepthReport:
    """Measure how deep a scene is on a panel.

    The function renders three small pictures.

    Args:
        gaussians: One set, in the rig's coordinates.
        panel: The panel.
        rig: Its rig.

    Raises:
        InputError: An argument is invalid, or the centre camera sees nothing.
    """
    expect("panel", panel, Panel)
    expect("rig", rig, Rig)
    coverage = view_coverage(gaussians, panel, rig)
    near, far = (locate_depth(depth, panel, rig) for depth in (coverage.near, coverage.far))
    comfortable = amount = None
    if near.angle_deg is not None and far.angle_deg is not None:
        comfortable = max(-near.angle_deg, far.angle_deg) <= COMFORT_DEG
        amount = _comfortable_amount((near, far), panel)
    left_first = coverage.background if panel.invert_views else coverage.background[::-1]
    return DepthReport(
        rig.zero_depth,
        near,
        far,
        comfortable,
        amount,
        sharp_depths(panel, rig),
        _sharp_mm(panel, rig),
        (left_first[0], left_first[1]),
    )


def comfortable_amount(gaussians: Gaussians, panel: Panel, rig: Rig) -> float | None:
    """Return the factor of all disparities, below 1, at which a scene keeps within one degree, rounded down.

    Args:
        gaussians: One set, in the rig's coordinates.
        panel: The panel.
        rig: Its rig.

    Returns:
        None where the scene keeps within it as it is, or where that is unknown.
    """
    if panel.pixel_pitch_mm is None or panel.viewing_distance_mm is None:
        return None
    ends = visible_depths(gaussians, panel, rig)
    if ends is None:
        return None
    near, far = (locate_depth(depth, panel, rig) for depth in ends)
    amount = _comfortable_amount((near, far), panel)
    return None if amount is None or amount >= 1 else float(_round_down(amount))


def neighbour_step_px(gaussians: Gaussians, panel: Panel, rig: Rig) -> float | None:
    """Return how far apart two neighbouring views show the same point of a scene, px of the panel, at the most.

    Args:
        gaussians: One set, in the rig's coordinates.
        panel: The panel.
        rig: Its rig.

    Returns:
        Of the depths that 1 % of the centre view is nearer or farther than; None where its camera sees nothing.
    """
    ends = visible_depths(gaussians, panel, rig)
    if ends is None:
        return None
    # The outermost of N views are N - 1 steps apart
    edges = [abs(locate_depth(depth, panel, rig).edge_px) for depth in ends]
    return 2 * max(edges) / max(1, panel.views - 1)


def locate_depth(depth: float, panel: Panel, rig: Rig) -> PanelDepth:
    """Return the position on the panel of content at this view-space z, > 0."""
    # Displacement in px of a view whose camera stands at the end of the fan, at s = Z0 tan(cone/2)
    end_px = rig.focal_px[0] * _tangent(panel, rig) * (1 - rig.zero_depth / depth)
    edge_px = end_px * (1 - 1 / panel.views)
    blur = max(1.0, 2 * abs(end_px) * _angular_step(panel) / (panel.line_number / 3))
    pitch, distance = panel.pixel_pitch_mm, panel.viewing_distance_mm
    if pitch is None or distance is None:
        return PanelDepth(depth, edge_px, None, None, None, None, None, blur)
    eyes_px = end_px * EYE_SEPARATION_MM / (distance * _panel_tangent(panel))
    apart = eyes_px * pitch
    return PanelDepth(
        depth,
        edge_px,
        edge_px * pitch,
        eyes_px,
        apart,
        distance * apart / (EYE_SEPARATION_MM - apart) if apart < EYE_SEPARATION_MM else None,
        math.degrees(_vergence(0, distance) - _vergence(apart, distance)),
        blur,
    )


def _vergence(apart_mm: float, distance_mm: float) -> float:
    """Return the angle in radians between the eyes' lines to two points of the panel so far apart."""
    return 2 * math.atan((EYE_SEPARATION_MM - apart_mm) / (2 * distance_mm))


def _comfortable_amount(contents: tuple[PanelDepth, PanelDepth], panel: Panel) -> float | None:
    """Return the factor of the disparities at which the first of these depths reaches the limit."""
    factors = []
    for content in contents:
        if panel.viewing_distance_mm is not None and content.eyes_mm:
            limit = math.radians(math.copysign(COMFORT_DEG, content.eyes_mm))
            angle = _vergence(0, panel.viewing_distance_mm) - limit
            most = EYE_SEPARATION_MM - 2 * panel.viewing_distance_mm * math.tan(angle / 2)
            factors.append(most / content.eyes_mm)
    return min(factors, default=None)


def sharp_depths(panel: Panel, rig: Rig) -> tuple[float, float | None]:
    """Return DepthReport.sharp_depths: Z0/(1 + r) to Z0/(1 - r), r the largest |1 - Z0/Z|."""
    per_step = 2 * rig.focal_px[0] * _tangent(panel, rig) * _angular_step(panel)
    if per_step == 0:
        return 0.0, None
    reach = panel.line_number / 3 / per_step  # of |1 - Z0/Z|
    return rig.zero_depth / (1 + reach), rig.zero_depth / (1 - reach) if reach < 1 else None


def _sharp_mm(panel: Panel, rig: Rig) -> tuple[float | None, float | None]:
    """Return DepthReport.sharp_mm."""
    distance, pitch = panel.viewing_distance_mm, panel.pixel_pitch_mm
    if distance is None or pitch is None or _tangent(panel, rig) == 0:
        return None, None
    reach = panel.line_number / 3 * pitch / (2 * _panel_tangent(panel) * _angular_step(panel))
    return distance * reach / (distance + reach), distance * reach / (distance - reach) if reach < distance else None


def _angular_step(panel: Panel) -> float:
    """Return the panel's angular step as a fraction of its cone."""
    return max(1 / panel.views, 1 / panel.line_number)


def _tangent(panel: Panel, rig: Rig) -> float:
    """Return tan(cone/2) of the rig's fan."""
    return rig.half_width(panel) / rig.zero_depth


def _panel_tangent(panel: Panel) -> float:
    """Return tan(cone/2) of the panel."""
    return math.tan(math.radians(panel.cone_deg) / 2)


def _describe(content: PanelDepth) -> str:
    """Return the line of a report on one depth."""
    edges = f"{abs(content.edge_px):.1f} px"
    if content.edge_mm is None or content.eyes_px is None or content.eyes_mm is None:
        side = "before" if content.edge_px < 0 else "behind"
        return f"{side} the panel, {edges} to either side in the outermost views"
    side = "before" if content.eyes_mm < 0 else "behind"
    how_far = "infinitely far" if content.behind_mm is None else f"{abs(content.behind_mm):.3g} mm"
    return (
        f"{how_far} {side} the panel, {edges} ({abs(content.edge_mm):.2f} mm) to either side in the outermost views, "
        f"{abs(content.eyes_px):.1f} px ({abs(content.eyes_mm):.2f} mm) between the eyes"
    )


def _round_down(amount: float) -> str:
    """Return the number with two digits, rounded down."""
    digits = 10.0 ** (math.floor(math.log10(amount)) - 1)
    return f"{math.floor(amount / digits) * digits:.2g}"
