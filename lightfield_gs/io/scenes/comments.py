"""Lines of a scene file's header: how the scene was trained and is therefore to be drawn.

Brush, gsplat and splat-transform write "SplatRenderMode: mip" or "default", Postshot "antialiased 1" or "0". Other
formats have a bit or a key instead, for which their readers return the first of these lines. This package writes the
settings of a fit, "lightfield-gs fit: {...}": the background and anti-aliasing among them are for any program.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from lightfield_gs.base.checks import is_row, real_number, shown
from lightfield_gs.base.errors import InputError
from lightfield_gs.io.text_files import parse_json

Y_DOWN = "Vertical Axis: -y"  # of readers that turn y up to the axes of a .ply
ANTIALIASED, NOT_ANTIALIASED = "SplatRenderMode: mip", "SplatRenderMode: default"
ANTIALIASED_WARNING = "the file says that it was trained with anti-aliasing; draw it with antialiased=True"
_WORDS = re.compile(r"(?:splatrendermode[\s:=]+(mip|default|2dgs)|antialias(?:ed|ing)[\s:=]+([01]|true|false|yes|no))")
_KEY = "lightfield-gs fit:"


def parse_antialiased(comment: str) -> bool | None:
    """Return whether a line declares the scene trained with anti-aliasing; None for lines on other things."""
    words = _WORDS.fullmatch(comment.strip().lower())
    return None if words is None else (words[1] or words[2]) in ("mip", "1", "true", "yes")


def is_antialiased(comments: Iterable[str]) -> bool | None:
    """Return the last declaration of `parse_antialiased` among the lines of a header; None without one."""
    found = [one for comment in comments if (one := parse_antialiased(comment)) is not None]
    return found[-1] if found else None


@dataclass(frozen=True)
class FitRecord:
    """The settings of a fit that decide how its scene is drawn.

    Attributes:
        antialiased: fitted for drawing with anti-aliasing.
        background: red, green and blue in 0..1 behind the scene; None without one, or with another one at each step.
    """

    antialiased: bool
    background: tuple[float, float, float] | None

    def describe(self) -> str:
        """Describe the record for the user."""
        before = "no background of its own" if self.background is None else f"background {format_rgb(self.background)}"
        return f"by lightfield-gs, {'' if self.antialiased else 'not '}anti-aliased, {before}"


def format_rgb(colour: Iterable[float]) -> str:
    """Format a colour as red, green and blue: "0,0.5,1"."""
    return ",".join(f"{part:g}" for part in colour)


def fit_comment(settings: Mapping[str, Any]) -> str:
    """Format the settings of a fit as a line of a header."""
    return f"{_KEY} {json.dumps(dict(settings))}"


def fit_comments(comments: Iterable[str]) -> list[str]:
    """Select the lines with settings of a fit; files made from this one keep them."""
    return [comment.strip() for comment in comments if comment.strip().startswith(_KEY)]


def antialiasing_source(comments: Iterable[str]) -> str | None:
    """Return who trained the scene for anti-aliasing: "fitted" by this package, or "trained" by another program.

    Returns:
        None without such a line, or where the last one declares the opposite.

    Raises:
        InputError: the line of a fit is malformed.
    """
    found = None
    for comment in comments:
        record = find_fit_record([comment])
        if record is not None:
            found = "fitted" if record.antialiased else None
        elif (antialiased := parse_antialiased(comment)) is not None:
            found = ("trained" if found is None else found) if antialiased else None
    return found


def render_comments(comments: Iterable[str], antialiased: bool) -> list[str]:
    """Return a header's lines on the fit, and a line on anti-aliasing as drawn where they do not declare it."""
    known = fit_comments(comments)
    if antialiased:
        return [*known, ANTIALIASED]
    try:
        is_plain = antialiasing_source(known) is None
    except InputError:
        is_plain = False
    return known if is_plain else [*known, NOT_ANTIALIASED]


def find_fit_record(comments: Iterable[str]) -> FitRecord | None:
    """Parse the last line with settings of a fit; return None without one, raise InputError for a malformed one."""
    lines = fit_comments(comments)
    if not lines:
        return None
    try:
        settings = parse_json(lines[-1][len(_KEY) :])
        antialiased, background = settings.get("antialiased", False), settings.get("background")
        if not isinstance(antialiased, bool):
            raise InputError(f"antialiased: expected true or false, got {shown(antialiased)}")
        if background is not None:
            if not is_row(background, 3):
                raise InputError(f"background: expected red, green and blue, got {shown(background)}")
            red, green, blue = (real_number("background", part, 0.0, 1.0) for part in background)
            background = (red, green, blue)
    except (InputError, ValueError, AttributeError) as error:
        raise InputError(
            f"its line of how it was fitted is none ({' '.join(str(error).split())[:100]}); give background=R,G,B, "
            "and antialiased=True or antialiased=False, which go before it"
        ) from None
    return FitRecord(antialiased, background)
