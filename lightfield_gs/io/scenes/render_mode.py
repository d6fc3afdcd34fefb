"""How a scene was trained and is therefore to be drawn, in the words that programs write into a file's header.

Brush, gsplat and splat-transform write "SplatRenderMode: mip" or "default", Postshot "antialiased 1" or "0". What other
formats say by a bit or a key, their readers give as the first of these.
"""

from __future__ import annotations

import re
from collections.abc import Iterable

ANTIALIASED, PLAIN = "SplatRenderMode: mip", "SplatRenderMode: default"
ANTIALIASED_WARNING = "the file says that it was trained with anti-aliasing; draw it with antialiased=True"
_WORDS = re.compile(r"(?:splatrendermode[\s:=]+(mip|default|2dgs)|antialias(?:ed|ing)[\s:=]+([01]|true|false|yes|no))")


def said_antialiased(comment: str) -> bool | None:
    """Whether one line of a header says that the scene was trained with anti-aliasing; None: it is about another
    thing."""
    words = _WORDS.fullmatch(comment.strip().lower())
    return None if words is None else (words[1] or words[2]) in ("mip", "1", "true", "yes")


def stated_antialiased(comments: Iterable[str]) -> bool | None:
    """What the lines of a header say, of which the last word counts; None: nothing."""
    said = [one for comment in comments if (one := said_antialiased(comment)) is not None]
    return said[-1] if said else None
