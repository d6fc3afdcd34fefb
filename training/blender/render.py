"""Render meshes from the cameras of a plan, one transforms.json object each. Runs inside Blender 4.2 or newer:

    blender --background --python training/blender/render.py -- --plan cone.json --output data/own MESH [MESH ...]
    python training/blender/render.py --plan cone.json ...          # where the bpy module is installed

training/blender/plan.py writes the plan; this file needs nothing but bpy and the standard library. Each mesh is moved
to the origin and scaled to a bounding box with a diagonal of 1. Images are RGBA, their colours sRGB as shaded by Cycles
under even white light and a sun. An object's folder appears whole or not at all; one that is there is left alone.
"""

from __future__ import annotations

import argparse
import itertools
import json
import math
import shutil
import sys
import tempfile
from pathlib import Path

# Operator of bpy.ops for each kind of file.
IMPORTERS = {
    ".glb": ("import_scene", "gltf"),
    ".gltf": ("import_scene", "gltf"),
    ".fbx": ("import_scene", "fbx"),
    ".obj": ("wm", "obj_import"),
    ".ply": ("wm", "ply_import"),
    ".stl": ("wm", "stl_import"),
}
_SENSOR_WIDTH_MM = 36.0
_SUN_ENERGY, _AMBIENT = 1.5, 0.5  # white that faces the sun reflects 1.5 / pi + 0.5, just below 1
_SUN_ROTATION_RAD = (math.radians(40), math.radians(20), 0.0)


class PlanError(ValueError):
    """A plan or mesh that cannot be used; the message is one line."""


def parse_arguments(arguments: list[str]) -> argparse.Namespace:
    """Options from sys.argv[1:] of Python, or from those after "--" of Blender."""
    if "--" in arguments:
        arguments = arguments[arguments.index("--") + 1 :]
    parser = argparse.ArgumentParser(
        prog="render.py", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("meshes", nargs="+", type=Path, metavar="MESH", help=" ".join(IMPORTERS))
    parser.add_argument("--plan", type=Path, required=True, help="cameras, written by training.blender.plan")
    parser.add_argument("--output", type=Path, required=True, help="folder for the objects' folders")
    parser.add_argument("--samples", type=int, default=64, help="rays a pixel (default: 64)")
    return parser.parse_args(arguments)


def read_plan(path: Path) -> dict:
    """The plan: w, h, fl_x in pixels and frames of file_path and transform_matrix (camera-to-world, OpenGL axes, which
    are Blender's too). Raises PlanError when there is more, less or something else in it."""
    try:
        plan = json.loads(Path(path).read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise PlanError(f"{path}: expected a plan by training.blender.plan, but {error}") from None
    if not isinstance(plan, dict) or set(plan) != {"w", "h", "fl_x", "frames"}:
        raise PlanError(f"{path}: expected w, h, fl_x and frames and nothing else; make it with training.blender.plan")
    for name, kind in (("w", int), ("h", int), ("fl_x", (int, float))):
        if not isinstance(plan[name], kind) or not 0 < plan[name] < 1e6:
            raise PlanError(
                f"{path}: {name}: expected {'a whole' if kind is int else 'a'} number of pixels, got {plan[name]!r}"
            )
    if not isinstance(plan["frames"], list) or not plan["frames"]:
        raise PlanError(f"{path}: frames: expected a list of cameras")
    for index, frame in enumerate(plan["frames"]):
        if not isinstance(frame, dict) or not isinstance(frame.get("file_path"), str):
            raise PlanError(f"{path}: frames[{index}].file_path: expected the name of an image")
        if Path(frame["file_path"]).is_absolute() or ".." in Path(frame["file_path"]).parts:
            raise PlanError(f"{path}: frames[{index}].file_path: expected a name within the object's folder")
        if not _is_right_handed(frame.get("transform_matrix")):
            raise PlanError(
                f"{path}: frames[{index}].transform_matrix: expected 4 rows of 4 numbers, a "
                "right-handed rotation and a last row of 0 0 0 1"
            )
    return plan


def _is_right_handed(matrix: object) -> bool:
    """Whether rows of numbers are a proper rotation beside a translation, over 0 0 0 1."""
    try:
        rows = [[float(value) for value in row] for row in matrix]
    except (TypeError, ValueError):
        return False
    if [len(row) for row in rows] != [4] * 4 or rows[3] != [0, 0, 0, 1]:
        return False
    x, y, z = (tuple(row[axis] for row in rows[:3]) for axis in range(3))
    cross = (x[1] * y[2] - x[2] * y[1], x[2] * y[0] - x[0] * y[2], x[0] * y[1] - x[1] * y[0])
    products = [sum(a * b for a, b in zip(*pair)) for pair in ((x, x), (y, y), (x, y))]
    return all(abs(value - wanted) < 1e-4 for value, wanted in zip([*products, *cross], [1, 1, 0, *z]))


def lens_mm(plan: dict) -> float:
    """Focal length that makes a horizontal sensor of _SENSOR_WIDTH_MM the camera of the plan."""
    return plan["fl_x"] * _SENSOR_WIDTH_MM / plan["w"]


def unit_box(corners: list[tuple[float, float, float]]) -> tuple[float, tuple[float, float, float]]:
    """Scale, and the translation after it, that bring the bounding box of points to the origin with a diagonal of 1."""
    low, high = ([extreme(corner[axis] for corner in corners) for axis in range(3)] for extreme in (min, max))
    diagonal = math.dist(low, high)
    if not 0 < diagonal < math.inf:
        raise PlanError("expected a mesh with an extent, got none")
    scale = 1 / diagonal
    return scale, tuple(-scale * (a + b) / 2 for a, b in zip(low, high))


def import_mesh(bpy, path: Path) -> None:
    """Make the mesh of a file the only content of the scene, in the unit box about the origin."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    group, name = IMPORTERS[path.suffix.lower()]
    try:
        getattr(getattr(bpy.ops, group), name)(filepath=str(path))
    except RuntimeError as error:
        raise PlanError(f"{path}: Blender cannot import it: {' '.join(str(error).split())}") from None
    for found in [found for found in bpy.data.objects if found.type in ("CAMERA", "LIGHT")]:
        bpy.data.objects.remove(found)
    bpy.context.view_layer.update()
    meshes = [found for found in bpy.data.objects if found.type == "MESH"]
    corners = [tuple(mesh.matrix_world @ vertex.co) for mesh in meshes for vertex in mesh.data.vertices]
    if not corners:
        raise PlanError(f"{path}: expected a mesh, found none in the file")
    scale, translation = unit_box(corners)
    root = bpy.data.objects.new("unit box", None)
    bpy.context.scene.collection.objects.link(root)
    for top in [found for found in bpy.data.objects if found.parent is None and found is not root]:
        top.parent = root
    root.scale, root.location = (scale,) * 3, translation


def set_up(bpy, plan: dict, samples: int) -> object:
    """Light, renderer and camera; returns the camera's object."""
    scene = bpy.context.scene
    scene.render.engine = "CYCLES"
    scene.cycles.samples = samples
    scene.cycles.use_denoising = False
    scene.render.resolution_x, scene.render.resolution_y = plan["w"], plan["h"]
    scene.render.resolution_percentage = 100
    scene.render.film_transparent = True
    scene.render.image_settings.file_format = "PNG"
    scene.render.image_settings.color_mode = "RGBA"
    # Colours as shaded: the default transform is a film's, and no display shows it.
    scene.view_settings.view_transform = "Standard"
    world = scene.world = bpy.data.worlds.new("even light")
    world.use_nodes = True
    world.node_tree.nodes["Background"].inputs["Strength"].default_value = _AMBIENT
    world.node_tree.nodes["Background"].inputs["Color"].default_value = (1, 1, 1, 1)
    sun = bpy.data.objects.new("sun", bpy.data.lights.new("sun", "SUN"))
    sun.data.energy, sun.rotation_euler = _SUN_ENERGY, _SUN_ROTATION_RAD
    lens = bpy.data.cameras.new("camera")
    lens.sensor_fit, lens.sensor_width, lens.lens = "HORIZONTAL", _SENSOR_WIDTH_MM, lens_mm(plan)
    lens.clip_start, lens.clip_end = 0.01, 1000.0
    camera = bpy.data.objects.new("camera", lens)
    for new in (sun, camera):
        scene.collection.objects.link(new)
    scene.camera = camera
    return camera


def render_object(bpy, mesh: Path, plan: dict, folder: Path, samples: int) -> None:
    """Render all frames of the plan into a folder, with the plan as its transforms.json."""
    from mathutils import Matrix

    import_mesh(bpy, mesh)
    camera = set_up(bpy, plan, samples)
    folder.parent.mkdir(parents=True, exist_ok=True)
    partial = Path(tempfile.mkdtemp(prefix=f".{folder.name}.", dir=folder.parent))
    try:
        for frame in plan["frames"]:
            camera.matrix_world = Matrix(frame["transform_matrix"])
            bpy.context.scene.render.filepath = str((partial / frame["file_path"]).resolve())
            bpy.ops.render.render(write_still=True)
        (partial / "transforms.json").write_text(json.dumps(plan, indent=1) + "\n", encoding="utf-8")
        partial.chmod(0o755)
        partial.rename(folder)
    finally:
        shutil.rmtree(partial, ignore_errors=True)


def main(arguments: list[str]) -> int:
    """Entry point; returns the exit code."""
    options = parse_arguments(arguments)
    try:
        import bpy
    except ImportError:
        print("render.py: error: no bpy: run it with the blender program, or pip install bpy", file=sys.stderr)
        return 2
    try:
        plan = read_plan(options.plan)
        folders = {mesh: options.output / mesh.stem for mesh in options.meshes}
        for mesh, other in itertools.combinations(folders, 2):
            if folders[mesh] == folders[other]:
                raise PlanError(f"{other}: expected names of their own, got the same as {mesh}; rename one")
        for mesh, folder in folders.items():
            if mesh.suffix.lower() not in IMPORTERS or not mesh.is_file():
                raise PlanError(f"{mesh}: expected a file ending in {', '.join(IMPORTERS)}")
            if folder.exists():
                print(f"{folder}: left alone, since it is there already")
                continue
            render_object(bpy, mesh, plan, folder, options.samples)
            print(f"{folder}: {len(plan['frames'])} views")
    except PlanError as error:
        print(f"render.py: error: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
