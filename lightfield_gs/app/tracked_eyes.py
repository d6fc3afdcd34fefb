"""The screen before which eyes are tracked: a panel with lenses, or a plain screen."""

from __future__ import annotations

from dataclasses import dataclass, replace

from lightfield_gs.app.options import EyesOptions, LookOptions, PanelOptions
from lightfield_gs.app.own_eyes import OwnEyes, own_eyes
from lightfield_gs.app.panel import is_display_connected, load_panel
from lightfield_gs.base.cli_messages import note
from lightfield_gs.base.errors import InputError
from lightfield_gs.base.options import StereoLayout
from lightfield_gs.panels.look import Look
from lightfield_gs.panels.panel import Panel
from lightfield_gs.panels.rig import Rig
from lightfield_gs.panels.simulate import check_geometry
from lightfield_gs.panels.stereo_screen import StereoScreen
from lightfield_gs.panels.tracked_eyes import eye_crosstalk

_TOO_MUCH = 0.1  # crosstalk from which on a picture is double


@dataclass(frozen=True)
class TrackedScreen:
    """What tracked eyes look at.

    Attributes:
        panel: Its measures are in mm.
        is_plain: Whether it has no lenses.
        eye_distance_mm: Between the eyes.
        messages: Lines on what was assumed.
    """

    panel: Panel
    is_plain: bool
    eye_distance_mm: float
    messages: list[str]

    @property
    def drawn_panel(self) -> Panel:
        """The panel for which scenes are framed and drawn.

        A plain screen has no pixel pitch here: both eyes see one picture, so no depth strains them.
        """
        return replace(self.panel, pixel_pitch_mm=None) if self.is_plain else self.panel

    def deepened(self, rig: Rig, look: LookOptions) -> Rig:
        """Return the rig of a scene, on a plain screen as deep as behind a window, times the options' depth."""
        if not self.is_plain or look.cone is not None:
            return rig
        amount = 1.0 if look.depth_amount is None else look.depth_amount
        return Look(depth_amount=amount).applied(replace(rig, cone_deg=None), self.panel)


def refuse_eyes(options: EyesOptions) -> None:
    """Raise InputError for options of the camera that sees the eyes, without --eyes."""
    for name in ("tracker_fov", "tracker_at"):
        if getattr(options, name) is not None:
            raise InputError(f"--{name.replace('_', '-')} is for --eyes; give it too, or leave this one out")


def tracked_screen(
    options: EyesOptions, layout: StereoLayout | None, panel: PanelOptions, view_filter: float
) -> TrackedScreen:
    """Return the screen of --eyes: the panel that is named or connected, else a plain screen.

    Args:
        options: Of the eyes.
        layout: Of --stereo, which excludes them.
        panel: Of the panel.
        view_filter: See RenderOptions: two views have none between them.

    Raises:
        InputError: Options exclude each other, or before the panel no eye can be placed.
    """
    if layout is not None:
        raise InputError("--stereo is for glasses, and --eyes for eyes without; leave out one")
    if view_filter:
        raise InputError("--view-filter averages over views, and --eyes draws two alone; leave out one")
    if options.screen_size is not None and panel.panel is not None:
        raise InputError("--screen-size is of a screen without lenses, and --panel of one with lenses; leave out one")
    is_plain = options.screen_size is not None or panel.panel is None and not is_display_connected()
    is_open = options.eye_distance is None or is_plain and options.screen_size is None
    own = own_eyes() if is_open else OwnEyes()
    apart_mm = options.eye_distance or own.eye_distance_mm
    if is_plain:
        width, height = options.eye_size or (StereoScreen.width_px, StereoScreen.height_px)
        screen = StereoScreen(
            width, height, options.screen_size or own.diagonal_in, viewing_distance_mm=panel.viewing_distance
        )
        why = "" if options.screen_size is not None else " (no 3D display was found: --panel; --screen-size INCHES)"
        words = f"eyes: the picture follows them on a plain screen of {screen.diagonal_in:g} inches{why}"
        plain = replace(screen.panel(), name=f"screen of {screen.diagonal_in:g} inches")
        return TrackedScreen(plain, True, apart_mm, [words])
    if options.eye_size is not None:
        raise InputError("--eye-size is of a screen without lenses, and this panel has its own; leave it out")
    lenses = load_panel(panel)
    check_geometry(lenses)
    distance = lenses.viewing_distance_mm
    assert distance is not None
    other = eye_crosstalk(lenses, [(-apart_mm / 2, 0, distance), (apart_mm / 2, 0, distance)])
    words = f"{100 * other:.1f} % of the other eye's picture reaches each eye at {distance:g} mm, {apart_mm:g} mm apart"
    if other > _TOO_MUCH:
        note(f"eyes: {words}: the lenses of panel {lenses.name} are too wide for two tracked eyes; leave --eyes out")
        return TrackedScreen(lenses, False, apart_mm, [])
    return TrackedScreen(lenses, False, apart_mm, [f"eyes: {words}"])
