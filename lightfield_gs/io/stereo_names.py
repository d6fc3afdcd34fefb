"""Stereo pairs by their file names, as players and cameras write them."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

from lightfield_gs.base.options import StereoLayout

# What players read at the end of a name
_SUFFIXES: dict[StereoLayout, str] = {"sbs": "_LRF_Full_SBS", "half-sbs": "_half_2x1", "tab": "_LR_Full_TAB"}
_EYES = ("_left", "_right")
_NAMED = re.compile(
    r"(?:^|[_. -])(?P<order>lrf?|rlf?)?[_. -]?(?P<size>half|full|h|f)?[_. -]?"
    r"(?:(?P<beside>sbs|2x1|side[_ -]?by[_ -]?side)"
    r"|(?P<above>tab|1x2|over[_ -]?under|top[_ -]?bottom|(?<=[_-])(?:tb|ou)))"
    r"(?: ?\(\d+\))?$",
    re.IGNORECASE,
)
_CROSSED = (".jps", ".pns")  # formats whose left half is the right eye's, unless they say otherwise


@dataclass(frozen=True)
class PairLayout:
    """Where the pictures of two eyes are in a file.

    Attributes:
        kind: "sbs", "half-sbs", "tab", "half-tab", or "two": pictures of their own.
        is_swapped: Whether the right eye's comes first: at the left, on top, or as the first picture.
        source: What says so, for people.
    """

    kind: str
    is_swapped: bool
    source: str


def layout_in_name(path: Path) -> PairLayout | None:
    """Return the layout that a name states: photo_LRF_Full_SBS.png, film_half_2x1.mp4, a.jps; None of other names.

    A name that says neither half nor full is full.
    """
    suffix = path.suffix.lower()
    found = _NAMED.search(path.stem)
    if found is None:
        return PairLayout("sbs", True, f"its extension {suffix}") if suffix in _CROSSED else None
    kind = "sbs" if found["beside"] else "tab"
    if (found["size"] or "").lower() in ("half", "h"):
        kind = f"half-{kind}"
    is_swapped = (found["order"] or "").lower().startswith("rl") or suffix in _CROSSED and not found["order"]
    return PairLayout(kind, is_swapped, "its name")


def stereo_paths(path: Path, layout: StereoLayout) -> tuple[Path, ...]:
    """Return the files of a pair to write: the name completed by what players read, or two names."""
    if layout == "left-right":
        return tuple(path.with_name(f"{path.stem}{eye}{path.suffix or '.png'}") for eye in _EYES)
    path = path if path.suffix else path.with_name(f"{path.name}{'.mpo' if layout == 'mpo' else '.png'}")
    wanted = _SUFFIXES.get(layout)
    stated = layout_in_name(path.with_suffix(""))
    if wanted is None or path.suffix.lower() in _CROSSED or stated is not None and stated.kind == layout:
        return (path,)
    return (path.with_name(f"{path.stem}{wanted}{path.suffix}"),)
