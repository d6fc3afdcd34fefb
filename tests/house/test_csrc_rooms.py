"""The rooms of csrc: each includes what stands above it in this list, never what stands below."""

from __future__ import annotations

import re
from pathlib import Path

CSRC = Path(__file__).resolve().parents[2] / "csrc"
ROOMS = {  # and what each may include beside itself
    "base": "",
    "scene": "base",
    "math": "base scene",
    "math/fit": "base scene math",
    "math/photo": "base scene math",
    "stages": "base scene math math/fit math/photo",
    "cpu": "base scene math stages",
    "cpu/image": "base scene math stages cpu",
    "cpu/fit": "base math/fit stages",
    "cpu/direct": "base scene math stages cpu",
    "cpu/photo": "base math/photo stages",
    "cpu/sorted": "base scene math stages cpu",
    "cpu/weave": "base scene stages",
    "cuda/common": "base scene math",
    "cuda/stages": "base scene math stages cuda/common",
    "cuda/image": "base scene math stages cuda/common cuda/stages",
    "cuda/fit": "base math/fit cuda/common cuda/stages",
    "cuda/direct": "base scene math stages cuda/common cuda/stages",
    "cuda/photo": "base math/photo cuda/common cuda/stages",
    "cuda/png": "base cuda/common cuda/stages",
    "cuda/sorted": "base scene math stages cuda/common cuda/stages",
    "cuda/frame": "base scene math stages cuda/common cuda/stages cuda/direct",
    "cuda/frame/pixel": "base scene math stages cuda/common cuda/stages cuda/frame",
    "cuda/frame/lens_column": "base scene math stages cuda/common cuda/stages cuda/frame",
    "cuda/frame/lattice": "base scene math stages cuda/common cuda/stages cuda/frame",
    "network": "base cuda/common cuda/stages",
    "bind": "base scene math math/fit math/photo stages cuda/common cuda/fit cuda/photo cuda/png cuda/stages "
    "cuda/sorted cuda/frame network",
}
SUFFIXES = {".h", ".cuh", ".cpp", ".cu"}
INCLUDE = re.compile(r'^\s*#\s*include\s+"([^"]+)"', re.MULTILINE)
THEIRS = ("hwy/",)  # Highway's own headers are named with quotes, too


def room_of(path: str) -> str:
    return path.rpartition("/")[0]


def own_includes(text: str) -> list[str]:
    return [name for name in INCLUDE.findall(text) if not name.startswith(THEIRS)]


def wrong_includes(path: str, text: str) -> list[str]:
    """The includes of a source, given by its path within csrc, that its room may not have."""
    room = room_of(path)
    allowed = {room, *ROOMS[room].split()}
    return [name for name in own_includes(text) if room_of(name) not in allowed]


def sources() -> list[str]:
    return sorted(path.relative_to(CSRC).as_posix() for path in CSRC.rglob("*") if path.suffix in SUFFIXES)


def test_every_source_is_in_a_room_and_no_room_is_empty():
    assert {room_of(path) for path in sources()} == set(ROOMS)


def test_rooms_are_listed_after_those_that_they_include():
    listed: set[str] = set()
    for room, allowed in ROOMS.items():
        assert set(allowed.split()) <= listed, room
        listed.add(room)


def test_no_include_runs_back_up():
    wrong = {path: wrong_includes(path, (CSRC / path).read_text()) for path in sources()}
    assert {path: names for path, names in wrong.items() if names} == {}


def test_every_include_is_there():
    named = {name for path in sources() for name in own_includes((CSRC / path).read_text())}
    assert sorted(name for name in named if not (CSRC / name).is_file()) == []


def test_an_include_that_runs_back_up_is_found():
    text = '#include "base/config.h"\n#include <vector>\n  #  include "cpu/tile_lists.h"\n#include "hwy/highway.h"\n'
    assert wrong_includes("math/footprint.h", text) == ["cpu/tile_lists.h"]
    assert wrong_includes("cpu/direct/lens_layout.h", text) == []
    assert wrong_includes("cuda/frame/pixel/pixel_fit.cuh", '#include "cuda/frame/lattice/lattice_rows.cuh"') == [
        "cuda/frame/lattice/lattice_rows.cuh"
    ]
