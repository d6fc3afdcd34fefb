"""The tracker of --eyes, for the commands that have it."""

from __future__ import annotations

from collections.abc import Callable

from lightfield_gs.app.options import EyesOptions
from lightfield_gs.app.tracked_eyes import TrackedScreen
from lightfield_gs.base.errors import InputError
from lightfield_gs.tracking.camera import DEFAULT_FOV_DEG, TrackerCamera, above
from lightfield_gs.tracking.sources import open_eyes, takes_pictures
from lightfield_gs.tracking.tracker import EyeTracker


def open_tracker(
    options: EyesOptions, screen: TrackedScreen, say: Callable[[str], None]
) -> tuple[EyeTracker, list[str]]:
    """Return the tracker of --eyes, which has begun, and lines on it. Raises InputError.

    Args:
        options: With a source.
        screen: Before which the eyes are.
        say: Called with a line where something happens later, from any thread.
    """
    assert options.eyes is not None
    at, fov = options.tracker_at or above(screen.panel), options.tracker_fov or DEFAULT_FOV_DEG
    given = {"--tracker-fov": options.tracker_fov is not None, "--tracker-at": options.tracker_at is not None}
    lines = []
    if takes_pictures(options.eyes):
        assumed = ", ".join(name for name, is_given in given.items() if not is_given)
        place = "{:g},{:g},{:g}".format(*(round(part, 1) for part in at))
        words = (
            f"eyes: a camera that sees {fov:g} degrees from left to right, {place} mm from the middle of the display"
        )
        lines = [
            f"{words}, and eyes {screen.eye_distance_mm:g} mm apart" + (f" (assumed: {assumed})" if assumed else "")
        ]
    else:
        for name, is_given in given.items():
            if is_given:
                raise InputError(f"{name} is of a camera that sees the eyes, and {options.eyes} is none; leave it out")
    source = open_eyes(options.eyes, TrackerCamera(fov, at, screen.eye_distance_mm), say)
    tracker = EyeTracker(source, screen.panel, say)
    return tracker, lines + tracker.start()
