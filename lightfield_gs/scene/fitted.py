"""How the scene in a file was fitted, by a line of its header, "lightfield-gs fit: {...}" with the fit's settings.

Two of them decide how the scene is to be drawn, by any program: before which background, and whether anti-aliased.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from lightfield_gs.base.checks import is_row, real_number, shown
from lightfield_gs.base.errors import InputError
from lightfield_gs.io.json_file import parse_json
from lightfield_gs.io.scenes.render_mode import ANTIALIASED, PLAIN, said_antialiased

_KEY = "lightfield-gs fit:"


@dataclass(frozen=True)
class Fitted:
    """antialiased: whether the scene was fitted for drawing with anti-aliasing.
    background: red, green and blue in 0..1 that it was fitted before; None: it says none, or another one at each step.
    """

    antialiased: bool
    background: tuple[float, float, float] | None

    def words(self) -> str:
        """What was taken from the line, for the user."""
        before = "no background of its own" if self.background is None else f"background {rgb(self.background)}"
        return f"by lightfield-gs, {'' if self.antialiased else 'not '}anti-aliased, {before}"


def rgb(colour: Iterable[float]) -> str:
    """As --background takes it: "0,0.5,1"."""
    return ",".join(f"{part:g}" for part in colour)


def fit_comment(settings: Mapping[str, Any]) -> str:
    """The line of a header that keeps the settings of a fit."""
    return f"{_KEY} {json.dumps(dict(settings))}"


def fit_comments(comments: Iterable[str]) -> list[str]:
    """The lines of a header that keep the settings of a fit: a file made from that one has them too."""
    return [comment.strip() for comment in comments if comment.strip().startswith(_KEY)]


def trained_antialiased(comments: Iterable[str]) -> str | None:
    """Who says that the scene was trained for drawing with anti-aliasing, in a word: "fitted" by this package, or
    "trained" by another. None where nobody does, or the last word on it is no.

    Raises InputError where the line of a fit cannot be read.
    """
    found = None
    for comment in comments:
        fitted = stated_fit([comment])
        if fitted is not None:
            found = "fitted" if fitted.antialiased else None
        elif (said := said_antialiased(comment)) is not None:
            found = ("trained" if found is None else found) if said else None
    return found


def drawn_comments(comments: Iterable[str], antialiased: bool) -> list[str]:
    """Of the lines of a header those on the fit, and a line on how the scene was drawn where they do not say it."""
    known = fit_comments(comments)
    if antialiased:
        return [*known, ANTIALIASED]
    try:
        is_plain = trained_antialiased(known) is None
    except InputError:
        is_plain = False
    return known if is_plain else [*known, PLAIN]


def stated_fit(comments: Iterable[str]) -> Fitted | None:
    """What the header of a .ply says of its fit; the last word counts. None where it says nothing.

    Raises InputError where the line cannot be read.
    """
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
            f"its line of how it was fitted is none ({' '.join(str(error).split())[:100]}); give --background R,G,B, "
            "and --antialiased or --no-antialiased, which go before it"
        ) from None
    return Fitted(antialiased, background)
