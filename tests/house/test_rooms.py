"""The house: which room of the package may import which, and that no two files import each other."""

from __future__ import annotations

import ast
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]

# From the ground up: a room imports itself and rooms above it in this list, never one below. The package's own names
# (lightfield_gs, its version) and the native module belong to the ground.
ROOMS = (
    "lightfield_gs._core",
    "lightfield_gs.base",
    "lightfield_gs.io",
    "lightfield_gs.io.captures",
    "lightfield_gs.scene",
    "lightfield_gs.io.scenes",
    "lightfield_gs.rasterizer",
    "lightfield_gs.models",
    "lightfield_gs.panels",
    "lightfield_gs.webgpu",
    "lightfield_gs.encoding",
    "lightfield_gs.simplification",
    "lightfield_gs.reference",
    "lightfield_gs.photo",
    "lightfield_gs.show",
    "lightfield_gs.displays",
    "lightfield_gs.video",
    "lightfield_gs.pose_estimation",
    "lightfield_gs.view_sets",
    "lightfield_gs.fitting",
    "lightfield_gs.gsplat",
    "training",
    "lightfield_gs.app",
    "lightfield_gs.live",
    "lightfield_gs.tracking",
    "lightfield_gs.commands.options",
    "lightfield_gs.bench",
    "benchmarks",
    "lightfield_gs.batch",
    "lightfield_gs.commands",
    "lightfield_gs.cli",
    "lightfield_gs.__main__",
)


def modules() -> dict[str, Path]:
    paths = [path for top in ("lightfield_gs", "training", "benchmarks") for path in sorted((ROOT / top).rglob("*.py"))]
    names = {".".join(path.relative_to(ROOT).with_suffix("").parts): path for path in paths}
    return {name.removesuffix(".__init__"): path for name, path in names.items()}


def imports(name: str, path: Path, known: set[str], types: bool = True) -> set[str]:
    """The modules that a file imports, wherever in it; types: also those that only a type checker reads."""
    package = name.split(".") if path.name == "__init__.py" else name.split(".")[:-1]
    found, nodes = set(), list(ast.parse(path.read_text()).body)
    while nodes:
        node = nodes.pop()
        if types or not (isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING"):
            nodes += ast.iter_child_nodes(node)
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            start = ".".join(package[: len(package) - node.level + 1]) if node.level else ""
            whole = ".".join(part for part in (start, node.module) if part)
            found |= {f"{whole}.{alias.name}" if f"{whole}.{alias.name}" in known else whole for alias in node.names}
    return found & known - {"lightfield_gs", name}


def room_of(name: str) -> str:
    """The room that a module stands in: the longest that its name begins with."""
    return max((room for room in ROOMS if f"{name}.".startswith(f"{room}.")), key=len, default="")


def arrows(types: bool = True) -> dict[str, set[str]]:
    files = modules()
    known = {*files, "lightfield_gs._core"}
    return {name: imports(name, path, known, types) for name, path in files.items() if name != "lightfield_gs"}


def test_every_file_stands_in_a_room():
    assert [name for name in arrows() if not room_of(name)] == []


def test_no_room_imports_one_above_it():
    backwards = [
        f"{name} imports {other}"
        for name, others in arrows().items()
        for other in others
        if room_of(name) and ROOMS.index(room_of(other)) > ROOMS.index(room_of(name))
    ]
    assert backwards == []


def test_no_circle_of_files():
    """Also where an import waits for its function: a circle cannot be read in any order."""
    left = arrows(types=False)
    while free := [name for name, others in left.items() if not others & left.keys()]:
        for name in free:
            del left[name]
    in_circles = {name: sorted(others & left.keys()) for name, others in left.items()}
    assert in_circles == {}
