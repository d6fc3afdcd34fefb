"""The order of views by the numbers in their file names, and the grid of cameras that two numbers make."""

from __future__ import annotations

import math
import re
from collections import Counter, defaultdict
from collections.abc import Sequence
from fractions import Fraction
from itertools import combinations
from pathlib import Path
from typing import NamedTuple

from lightfield_gs.base.assumptions import assume
from lightfield_gs.base.errors import InputError
from lightfield_gs.io.depth_names import is_sidecar_name

Grid = dict[tuple[int, int], Path]  # (row, column) of cameras -> picture

# A sign follows no digit: in 2026-11-26 it separates numbers
_NUMBER = re.compile(r"((?<!\d)[+-])?(\d+)(?:\.(\d+))?")
_WORDS = re.compile(r"[a-z]+")
_ACROSS = frozenset("x c col column columns u s".split())
_DOWN = frozenset("y r row rows v t".split())
_OF_TIME = frozenset("f frame frames frm time".split())
_OF_VIEWS = frozenset("view views v cam camera angle deg".split())
_MOST_NAMED = 3


class _Number(NamedTuple):
    """A number in a name.

    Attributes:
        sign: "", "+" or "-".
        after_letter: whether a letter stands right before the sign.
        whole: digits.
        decimals: digits after a point.
    """

    sign: str
    after_letter: bool
    whole: str
    decimals: str

    def value(self, is_signed: bool) -> Fraction:
        """Return the number as a decimal one."""
        value = Fraction(f"{int(self.whole)}.{self.decimals or 0}")
        return -value if is_signed and self.sign == "-" else value


class _Name(NamedTuple):
    """A file's name as texts, with a number between each two."""

    path: Path
    texts: tuple[str, ...]
    parts: tuple[_Number, ...]

    @property
    def natural(self) -> list[tuple[str, int, int]]:
        """Sort key by text and value in turn, so that b9 comes before b10."""
        parts = (*self.parts, _Number("", False, "0", ""))
        return [(text, int(part.whole), int(part.decimals or 0)) for text, part in zip(self.texts, parts)]


def _parsed(path: Path) -> _Name:
    stem, texts, parts, end = path.stem.casefold(), [], [], 0
    for match in _NUMBER.finditer(stem):
        before = stem[: match.start()]
        texts.append(stem[end : match.start()])
        parts.append(_Number(match[1] or "", before[-1:].isalpha(), match[2], match[3] or ""))
        end = match.end()
    return _Name(path, (*texts, stem[end:]), tuple(parts))


def without_maps(folder: Path, pictures: list[Path]) -> list[Path]:
    """Leave out pictures that are named as depth maps, masks and the like, with a note, unless all are."""
    named = [path for path in pictures if is_sidecar_name(path.name)]
    if not named or len(named) == len(pictures):
        return pictures
    assume(
        f"{len(named)} of the {len(pictures)} pictures of {folder} are no views by their names and left out: "
        f"{_listed(named)} (else give them other names)"
    )
    return [path for path in pictures if path not in set(named)]


def arrange(folder: Path, pictures: Sequence[Path]) -> list[Path] | Grid:
    """Return the pictures in the order of the number that varies in their names, or the grid that two numbers make.

    Assumptions are noted. Raises InputError where numbers are missing, repeated, or contradict each other.
    """
    names = [_parsed(path) for path in pictures]
    kinds: dict[tuple[str, ...], list[_Name]] = defaultdict(list)
    for name in names:
        kinds[name.texts].append(name)
    if len(kinds) > 1:
        return _arrange_mixed_names(folder, names, list(kinds.values()))
    varying = [k for k, parts in enumerate(zip(*(name.parts for name in names))) if len(set(parts)) > 1]
    if not varying:
        return [name.path for name in names]
    if grid := _grid(folder, names, varying):
        return grid
    return _row(folder, names, varying)


def _arrange_mixed_names(folder: Path, names: list[_Name], kinds: list[list[_Name]]) -> list[Path]:
    """Order names that differ in more than their numbers, by a first number that all have, or by name."""
    firsts = [(name.texts[0], name.parts[0].value(False)) for name in names if name.parts]
    if len(firsts) == len(names) and len({text for text, _ in firsts}) == 1 and len(set(firsts)) == len(names):
        return [name.path for name in sorted(names, key=lambda name: name.parts[0].value(False))]
    kinds.sort(key=len)
    most, numbers = kinds[-1], [{name.parts for name in kind} for kind in kinds]
    rival = next((kind for kind, own in zip(kinds[:-1], numbers) if len(kind) > 1 and own & numbers[-1]), None)
    if rival is None and 2 <= len(names) // 2 < len(most):
        rival = kinds[0]
    if rival is not None:
        raise InputError(
            f"{folder}: expected pictures of one kind, got {len(most)} named as {most[0].path.name} and {len(rival)} "
            f"as {rival[0].path.name}; give a folder with the views alone, named alike but for a number"
        )
    ordered = [name.path for name in sorted(names, key=lambda name: name.natural)]
    assume(
        f"the views of {folder} are in the order of their names, for no number tells it: {_listed(ordered)} "
        "(else number them)"
    )
    return ordered


def _row(folder: Path, names: list[_Name], varying: list[int]) -> list[Path]:
    """Order names by the number that varies."""
    found = {k: _values(folder, names, k) for k in varying}
    telling = {k: values for k, values in found.items() if len(set(values)) == len(names)}
    by_name = {k: values for k, values in telling.items() if _label(names[0], k) in _OF_VIEWS}
    even = {k: values for k, values in telling.items() if not _missing(values)[0]}
    if len(varying) == 1 and not telling:
        twice = Counter(found[varying[0]]).most_common(1)[0][0]
        alike = [name.path for name, value in zip(names, found[varying[0]]) if value == twice]
        raise InputError(
            f"{folder}: expected each view once, number {_written(twice)} comes more than once, as {_listed(alike)}; "
            "leave one of them"
        )
    if len(varying) > 1 and not by_name and not even:  # as of times
        ordered = [name.path for name in sorted(names, key=lambda name: name.natural)]
        assume(f"the views of {folder} are in the order of all numbers in their names: {_listed(ordered)}")
        return ordered
    if by_name and _differ(telling):
        telling = by_name
        word = _label(names[0], next(iter(by_name)))
        assume(f"the views of {folder} are in the order of the number after '{word}'; others tell another order")
    if even and _differ(telling):
        telling = even
    if _differ(telling):
        one, other = (names[0].parts[k].whole for k in list(telling)[:2])
        raise InputError(
            f"{folder}: expected one number that tells the order of the views, got two that tell different ones, {one} "
            f"and {other} in {names[0].path.name}; rename the pictures so that one number varies"
        )
    values = min(telling.values(), key=lambda values: _missing(values)[0])
    _check_gaps(folder, values)
    return [names[index].path for index in _order(values)]


def _differ(found: dict[int, tuple[Fraction, ...]]) -> bool:
    """Return whether these numbers give different orders."""
    return len(set(map(_order, found.values()))) > 1


def _order(values: Sequence[Fraction]) -> tuple[int, ...]:
    return tuple(sorted(range(len(values)), key=values.__getitem__))


def _values(folder: Path, names: list[_Name], k: int) -> tuple[Fraction, ...]:
    """Return the k-th number of each name, signed where "-" is a sign, as a decimal or as a counter after a point."""
    parts = [name.parts[k] for name in names]
    is_signed = _is_signed(parts)
    values = tuple(part.value(is_signed) for part in parts)
    if is_signed and max(values) < 0:
        assume(f"the numbers {_written(min(values))} .. {_written(max(values))} of the views of {folder} are below 0")
    if all(part.decimals for part in parts) and len({part.whole for part in parts}) == 1:
        counted = tuple(Fraction(int(part.decimals)) for part in parts)
        if _missing(values)[0] and not _missing(counted)[0]:
            return counted
    return values


def _is_signed(parts: Sequence[_Number]) -> bool:
    """Return whether "-" is a sign: not where it stands before all numbers after a letter, as in view-1."""
    signs = {part.sign for part in parts}
    return "-" in signs and not (len(signs) == 1 and all(part.after_letter for part in parts))


def _missing(values: Sequence[Fraction]) -> tuple[int, Fraction]:
    """Return how many evenly spaced numbers are missing or repeated, and the first missing one."""
    ordered = sorted(set(values))
    if len(ordered) < 2:
        return len(values) - 1, ordered[0]
    steps = [after - before for before, after in zip(ordered, ordered[1:])]
    common = math.lcm(*(step.denominator for step in steps))
    step = Fraction(math.gcd(*(int(step * common) for step in steps)), common)
    missing = int((ordered[-1] - ordered[0]) / step) + 1 - len(ordered) + len(values) - len(ordered)
    return missing, next((before + step for before, after in zip(ordered, ordered[1:]) if after - before > step), step)


def _check_gaps(folder: Path, values: Sequence[Fraction]) -> None:
    """Raise InputError where some numbers are missing; where most are, as of times, note it."""
    missing, first = _missing(values)
    ends = f"{_written(min(values))}..{_written(max(values))}"
    if missing > len(values):
        assume(f"the views of {folder} are in the order of their numbers, {ends}, though these are not evenly spaced")
    elif missing:
        raise InputError(
            f"{folder}: views are numbered {ends}, and {_written(first)} is missing; add it, or number them anew"
        )


def _grid(folder: Path, names: list[_Name], varying: list[int]) -> Grid | None:
    """Return the grid by two numbers, row and column, if (nearly) all their pairs exist; else None."""
    columns = {}
    for k in varying:
        parts = [name.parts[k] for name in names]
        if not any(part.decimals for part in parts):
            columns[f"{k}"] = [part.value(_is_signed(parts)) for part in parts]
    if len(varying) == 1:  # row.column looks like a decimal number
        parts = [name.parts[varying[0]] for name in names]
        if not all(part.decimals for part in parts) or not _missing([part.value(False) for part in parts])[0]:
            return None
        columns = {part: [Fraction(int(getattr(one, part))) for one in parts] for part in ("whole", "decimals")}
    for one, other in combinations(columns, 2):
        pairs = list(zip(columns[one], columns[other]))
        down, across = set(columns[one]), set(columns[other])
        size = len(down) * len(across)
        is_full = len(set(pairs)) == len(names) > max(len(down), len(across)) and size < 2 * len(names)
        if not is_full or _missing(list(down))[0] or _missing(list(across))[0]:
            continue
        labels = [_label(names[0], int(key)) if key.isdecimal() else "" for key in (one, other)]
        if labels[0] in _OF_TIME or labels[1] in _OF_TIME:
            raise InputError(
                f"{folder}: expected the views of one moment, got {len(down)} x {len(across)} pictures by frame and "
                "view; give a folder with one frame's views"
            )
        is_swapped = labels[0] in _ACROSS and labels[1] not in _ACROSS or labels[1] in _DOWN and labels[0] not in _DOWN
        numbers = [pair[::-1] if is_swapped else pair for pair in pairs]
        positions = zip(*(_indices([pair[axis] for pair in numbers]) for axis in (0, 1)))
        words = "column and row" if is_swapped else "row and column"
        assume(
            f"the two numbers in names such as {names[0].path.name} in {folder} are {words} of a grid of cameras, from "
            "the top left (else name them as x0_y0)"
        )
        return {position: name.path for position, name in zip(positions, names)}
    return None


def _indices(values: Sequence[Fraction]) -> list[int]:
    """Return numbers of rows or columns as they are, if they count from 0 or more; else from 0."""
    ordered = sorted(set(values))
    if ordered[0] >= 0 and ordered[-1] - ordered[0] == len(ordered) - 1:
        return [int(value) for value in values]
    return [ordered.index(value) for value in values]


def _label(name: _Name, k: int) -> str:
    """Return the word right before the k-th number of a name."""
    words = _WORDS.findall(name.texts[k].rstrip("_-. =(["))
    return words[-1] if words and name.texts[k].rstrip("_-. =([").endswith(words[-1]) else ""


def _written(value: Fraction) -> str:
    return f"{float(value):.12g}"


def _listed(paths: Sequence[Path]) -> str:
    names = [path.name for path in paths]
    return ", ".join(names[:_MOST_NAMED] + [f"... {names[-1]}"] * (len(names) > _MOST_NAMED))
