"""How deep a scene is on a panel: disparities, what stands before and behind the panel, comfort, sharpness, gaps."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import Any

from lightfield_gs.base.checks import expect
from lightfield_gs.panels.panel import Panel
from lightfield_gs.panels.rig import Rig
from lightfield_gs.panels.visibility import background_warning, view_coverage
from lightfield_gs.scene.gaussians import Gaussians

EYE_SEPARATION_MM = 63.0  # mean of adults (Dodgson, "Variation and extrema of human interpupillary distance", 2004)
# The one-degree rule: disparities between the eyes of up to one degree, either way, are seen without discomfort
# (Lambooij et al., "Visual discomfort and visual fatigue of stereoscopic displays: a review", J. Imaging Sci. Technol.
# 53(3), 030201, 2009).
COMFORT_DEG = 1.0
_RULE = "the one-degree rule, Lambooij et al. 2009"


@dataclass(frozen=True)
class Place:
    """Where content of one depth is on the panel; before the panel lengths and angles are negative, behind it positive.

    depth: view-space z, scene units.
    edge_px, edge_mm: how far it is displaced in the outermost views against the centre view (there to the right and
        here to the left), s fx (1/Z0 - 1/Z) with s = Z0 tan(cone/2) (1 - 1/N), pixels and mm of the panel.
    eyes_px, eyes_mm: how much farther right the right eye sees it than the left one, both at the viewing distance L.
        An eye at x sees the view whose camera has s = Z0 tan(cone/2) x / (L tan(panel's cone/2)).
    behind_mm: how far behind the panel the eyes see it, L d/(e - d), with d = eyes_mm and e between the eyes; None
        where that is infinitely far or farther.
    angle_deg: by how much less the eyes converge than on the panel, 2 atan(e/2L) - 2 atan((e - d)/2L).
    blur_lenses: how many lenses a point is spread over, 1 within the sharp range (see DepthReport).
    All but depth, edge_px and blur_lenses are None where the panel lacks pixel_pitch_mm or viewing_distance_mm.
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
    """What a rig makes of a scene on a panel; see depth_report.

    zero_depth: view-space z of the panel's plane, scene units.
    near, far: of what the centre view shows, but for 1 % at either end.
    comfortable: whether both are within one degree of the panel's plane for the eyes; None: the panel does not say.
    amount: factor of all disparities (--depth-amount) at which that is just so; None: not known, or nothing is deep.
    sharp_depths: view-space z, from and to, that the panel shows as sharp as its own plane; None: however far.
    sharp_mm: how far that is before and behind the panel; None: not known, or however far.
        A lens has P_e sub-pixels, each 1/P_e of the cone wide, and a view is 1/N of the cone: the panel's angular step
        is the larger of the two, a. It shows one sample of a direction a lens, P_e/3 pixels apart. A plane keeps its
        detail where it moves by one sample a step at most (Zwicker et al., "Antialiasing for automultiscopic 3D
        displays", 2006, on the bandwidth of a display): 2 fx tan(cone/2) |1 - Z0/Z| a <= P_e/3. In mm that is a
        distance D = lens/(2 tan(panel's cone/2) a) to the front and back for a viewer far off, L D/(L +- D) at L.
        Beyond, a point is spread over, or seen several times within, as many lenses as it moves by.
    unseen: for the left-most and the right-most view, share of where the scene goes on that shows background, 0..1.
    """

    zero_depth: float
    near: Place
    far: Place
    comfortable: bool | None
    amount: float | None
    sharp_depths: tuple[float, float | None]
    sharp_mm: tuple[float | None, float | None]
    unseen: tuple[float, float]

    def to_dict(self) -> dict[str, Any]:
        """The fields, as json.dumps takes them."""
        return asdict(self)

    def lines(self) -> list[str]:
        """The report, for the user."""
        return [
            f"depth: {self.near.depth:.4g} to {self.far.depth:.4g} is seen, {self.zero_depth:.4g} lies in the panel",
            f"near: {_words(self.near)}",
            f"far: {_words(self.far)}",
            f"comfortable: {self._comfort()}",
            f"sharp: {self._sharp()}",
            "outermost views: {:.1%} (left) and {:.1%} (right) of the scene's place is background".format(*self.unseen),
        ]

    def warnings(self) -> list[str]:
        """What an owner should change, a line each, with the way out."""
        out = []
        if self.comfortable is False:
            way = "" if self.amount is None else f", {_floored(self.amount)} of what it is at the most"
            out.append(
                f"the depth strains the eyes: {self._angles()}; give a smaller --depth-amount{way}, or another --focus"
            )
        if (words := background_warning(max(self.unseen))) is not None:
            out.append(words)
        return out

    def _comfort(self) -> str:
        if self.comfortable is None:
            return "not known: the panel lacks viewing_distance_mm or pixel_pitch_mm (--viewing-distance MM)"
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
    """How deep a scene [N Gaussians, in the rig's coordinates] is on a panel: see DepthReport.

    Three small pictures are rendered for it. Raises InputError, also where the centre camera sees nothing.
    """
    expect("panel", panel, Panel)
    expect("rig", rig, Rig)
    seen = view_coverage(gaussians, panel, rig)
    near, far = (place_of(depth, panel, rig) for depth in (seen.near, seen.far))
    comfortable = amount = None
    if near.angle_deg is not None and far.angle_deg is not None:
        comfortable = max(-near.angle_deg, far.angle_deg) <= COMFORT_DEG
        amount = _comfortable_amount((near, far), panel)
    left_first = seen.unseen if panel.invert_views else seen.unseen[::-1]
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


def place_of(depth: float, panel: Panel, rig: Rig) -> Place:
    """Where content at this view-space z, > 0, is on the panel."""
    # Displacement in px of a view whose camera stands at the end of the fan, at s = Z0 tan(cone/2)
    end_px = rig.focal_px[0] * _tangent(panel, rig) * (1 - rig.zero_depth / depth)
    edge_px = end_px * (1 - 1 / panel.views)
    blur = max(1.0, 2 * abs(end_px) * _angular_step(panel) / (panel.line_number / 3))
    pitch, distance = panel.pixel_pitch_mm, panel.viewing_distance_mm
    if pitch is None or distance is None:
        return Place(depth, edge_px, None, None, None, None, None, blur)
    eyes_px = end_px * EYE_SEPARATION_MM / (distance * _panel_tangent(panel))
    apart = eyes_px * pitch
    return Place(
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
    """The angle in radians between the eyes' lines to two places of the panel that are so far apart."""
    return 2 * math.atan((EYE_SEPARATION_MM - apart_mm) / (2 * distance_mm))


def _comfortable_amount(places: tuple[Place, Place], panel: Panel) -> float | None:
    """The factor of the disparities at which the first of these places is at the limit."""
    factors = []
    for place in places:
        if panel.viewing_distance_mm is not None and place.eyes_mm:
            limit = math.radians(math.copysign(COMFORT_DEG, place.eyes_mm))
            angle = _vergence(0, panel.viewing_distance_mm) - limit
            most = EYE_SEPARATION_MM - 2 * panel.viewing_distance_mm * math.tan(angle / 2)
            factors.append(most / place.eyes_mm)
    return min(factors, default=None)


def sharp_depths(panel: Panel, rig: Rig) -> tuple[float, float | None]:
    """DepthReport.sharp_depths: Z0/(1 + r) to Z0/(1 - r), r the largest |1 - Z0/Z|."""
    per_step = 2 * rig.focal_px[0] * _tangent(panel, rig) * _angular_step(panel)
    if per_step == 0:
        return 0.0, None
    reach = panel.line_number / 3 / per_step  # of |1 - Z0/Z|
    return rig.zero_depth / (1 + reach), rig.zero_depth / (1 - reach) if reach < 1 else None


def _sharp_mm(panel: Panel, rig: Rig) -> tuple[float | None, float | None]:
    distance, pitch = panel.viewing_distance_mm, panel.pixel_pitch_mm
    if distance is None or pitch is None or _tangent(panel, rig) == 0:
        return None, None
    reach = panel.line_number / 3 * pitch / (2 * _panel_tangent(panel) * _angular_step(panel))
    return distance * reach / (distance + reach), distance * reach / (distance - reach) if reach < distance else None


def _angular_step(panel: Panel) -> float:
    """What the panel tells apart, as a share of its cone."""
    return max(1 / panel.views, 1 / panel.line_number)


def _tangent(panel: Panel, rig: Rig) -> float:
    return rig.half_width(panel) / rig.zero_depth


def _panel_tangent(panel: Panel) -> float:
    return math.tan(math.radians(panel.cone_deg) / 2)


def _words(place: Place) -> str:
    edges = f"{abs(place.edge_px):.1f} px"
    if place.edge_mm is None or place.eyes_px is None or place.eyes_mm is None:
        side = "before" if place.edge_px < 0 else "behind"
        return f"{side} the panel, {edges} to either side in the outermost views"
    side = "before" if place.eyes_mm < 0 else "behind"
    how_far = "infinitely far" if place.behind_mm is None else f"{abs(place.behind_mm):.3g} mm"
    return (
        f"{how_far} {side} the panel, {edges} ({abs(place.edge_mm):.2f} mm) to either side in the outermost views, "
        f"{abs(place.eyes_px):.1f} px ({abs(place.eyes_mm):.2f} mm) between the eyes"
    )


def _floored(amount: float) -> str:
    """With two digits, and never more than it is."""
    digits = 10.0 ** (math.floor(math.log10(amount)) - 1)
    return f"{math.floor(amount / digits) * digits:.2g}"
