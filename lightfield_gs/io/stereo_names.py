"""Stereo pairs by their file names, as players and cameras write them."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from pathlib import Path

from lightfield_gs.base.options import StereoLayout

# What players read at the end of a name
_SUFFIXES: dict[StereoLayout, str] = {"sbs": "_LRF_Full_SBS", "half-sbs": "_half_2x1", "tab": "_LR_Full_TAB"}
_EYES = ("_left", "_right")
_SIZE = r"(?P<size>half|full|h|f)?"
# At the end of a name, where players look
_NAMED = re.compile(
    r"(?:^|[][_. (-])(?:3d[_. -]?)?(?P<order>lrf?|rlf?)?[_. -]?" + _SIZE + r"[_. -]?"
    r"(?:(?P<beside>sbs|2x1|3dh|side[_ -]?by[_ -]?side)"
    r"|(?P<above>tab|1x2|3dv|over[_ -]?under|top[_ -]?(?:and[_ -]?)?bottom|(?<=[_.-])(?:tb|ou)|(?<=[_. -]h)ou))"
    r"(?:[_. -]?(?P<after>lr|rl|l|r))?[])]?(?:[_. -](?:[248]k|u?hd|\d{3,4}p))?(?: ?\(\d+\))?$",
    re.IGNORECASE,
)
# Within the name of a film, where only whole phrases are sure: Film.3D.Half-OU.1080p
_WITHIN = re.compile(
    r"(?<![a-z0-9])(?:3d[_. -](?P<order>)" + _SIZE + r"|(?P<size_alone>half|full|h|f))[_. -]?"
    r"(?:(?P<beside>sbs)|(?P<above>tab|tb|ou))(?P<after>)(?![a-z0-9])",
    re.IGNORECASE,
)
_CROSS_EYED = re.compile(r"(?<![a-z])(?:cross[_ -]?(?:eyed?|view)|x[_ -]?eyed?)(?![a-z])", re.IGNORECASE)
_PARALLEL = re.compile(r"(?<![a-z])parallel[_ -]?(?:eyed?|view)(?![a-z])", re.IGNORECASE)
_FILM = 1.7, 1.86  # width by height of a picture of 16:9, and of 1.85:1
_CROSSED = (".jps", ".pns")  # formats whose left half is the right eye's, unless they say otherwise


@dataclass(frozen=True)
class PairLayout:
    """Where the pictures of two eyes are in a file.

    Attributes:
        kind: "sbs", "half-sbs", "tab", "half-tab", or "two": pictures of their own.
        is_swapped: Whether the right eye's comes first: at the left, on top, or as the first picture.
        source: What says so, for people.
        is_squeezed: None: as the shape of both halves tells, see `resolved`.
    """

    kind: str
    is_swapped: bool
    source: str
    is_squeezed: bool | None = False

    def resolved(self, height: int, width: int) -> PairLayout:
        """Return the layout with squeezed halves, where nothing states their size and both make a film's picture.

        Side by side, halves of a picture of 16:9 would be upright; one above the other, they would be very wide.

        Args:
            height: Of both halves together, pixels.
            width: The same.
        """
        if self.is_squeezed is not None or self.kind not in ("sbs", "tab"):
            return self
        low, high = _FILM
        if not low < width / height < high:
            return replace(self, is_squeezed=False)
        source = f"{self.source} and its shape (else: --stereo-in {self.kind})"
        return PairLayout(f"half-{self.kind}", self.is_swapped, source, True)


def layout_in_name(path: Path) -> PairLayout | None:
    """Return the layout that a name states: photo_LRF_Full_SBS.png, film_half_2x1.mp4, a.jps; None of other names."""
    suffix = path.suffix.lower()
    found = _NAMED.search(path.stem) or _WITHIN.search(path.stem)
    if found is None:
        if (crossed := _CROSS_EYED.search(path.stem)) or _PARALLEL.search(path.stem):
            return PairLayout("sbs", crossed is not None, "its name")
        return PairLayout("sbs", True, f"its extension {suffix}") if suffix in _CROSSED else None
    parts = {name: (part or "").lower() for name, part in found.groupdict().items()}
    size, order = parts["size"] or parts.get("size_alone", ""), parts["order"] or parts["after"]
    kind = "sbs" if parts["beside"] else "tab"
    is_half = size in ("half", "h")
    is_swapped = order.startswith("r") or suffix in _CROSSED and not order
    squeezed = False if size or parts["beside"] == "2x1" or parts["above"] == "1x2" else None
    return PairLayout(f"half-{kind}" if is_half else kind, is_swapped, "its name", is_half or squeezed)


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
