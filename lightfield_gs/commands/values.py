"""Values of options, as the parsers of the command line read them. Each raises ArgumentTypeError."""

from __future__ import annotations

import argparse
import math
import re

_UNITS = {"B": 1, "KB": 10**3, "MB": 10**6, "GB": 10**9, "KiB": 1 << 10, "MiB": 1 << 20, "GiB": 1 << 30}


def numbers(count: int):
    """Parser of `count` comma-separated finite numbers."""
    def parse(text: str) -> tuple[float, ...]:
        try:
            values = tuple(float(word) for word in text.split(","))
        except ValueError:
            values = ()
        if len(values) != count or not all(map(math.isfinite, values)):
            raise argparse.ArgumentTypeError(f"expected {count} numbers separated by commas, got '{text}'")
        return values
    return parse


def background(text: str) -> tuple[float, ...]:
    """"1,0.5,0" -> (1.0, 0.5, 0.0)."""
    values = numbers(3)(text)
    if not all(0 <= value <= 1 for value in values):
        raise argparse.ArgumentTypeError(f"expected red, green and blue in 0..1, got '{text}'")
    return values


def share(text: str) -> float:
    """"0.01" -> 0.01, in 0..1."""
    value = numbers(1)(text)[0]
    if not 0 <= value <= 1:
        raise argparse.ArgumentTypeError(f"expected a number in 0..1, got '{text}'")
    return value


def millimetres(text: str) -> float:
    """"600" -> 600.0, a distance of 0.001..1e9 mm."""
    value = numbers(1)(text)[0]
    if not 1e-3 <= value <= 1e9:
        raise argparse.ArgumentTypeError(f"expected a distance of 0.001..1e9 mm, got '{text}'")
    return value


def threads(text: str) -> int:
    """"8" -> 8."""
    if not text.isdecimal() or not 1 <= int(text[:9]) <= 1024:
        raise argparse.ArgumentTypeError(f"expected 1..1024, got '{text}'")
    return int(text)


def byte_size(text: str) -> int:
    """"256MB" -> 256000000."""
    match = re.fullmatch(r"(\d{1,15}(?:\.\d{1,15})?)(B|[KMG]i?B)", text)
    value = 0 if match is None else int(float(match[1]) * _UNITS[match[2]])
    if value < 1:
        raise argparse.ArgumentTypeError(f"expected a size such as 256MB or 1.5GiB, got '{text}'")
    return value
