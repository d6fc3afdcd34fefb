"""Cameras for own meshes, the file that carries them to Blender, and what Blender makes of it where there is one."""

import ast
import importlib.util
import json
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from lightfield_gs.panels.panel import Panel
from lightfield_gs.panels.rig import Rig
from training.blender import render
from training.blender.plan import fan, main, make_plan
from training.comparison import azimuths_from_source
from training.data.images import read_view
from training.data.objects import find_objects, read_object
from training.data.validate import problems

PANEL = Panel.load("65in-8k-96v")
SCRIPT = Path(render.__file__)


def _poses(plan: dict) -> np.ndarray:
    """Camera-to-world matrices of a plan, OpenCV axes."""
    return np.array([frame["transform_matrix"] for frame in plan["frames"]]) @ np.diag([1.0, -1, -1, 1])


def test_cameras_stand_where_the_rig_has_its_views():
    """On a straight line, at the offsets s = Z0 tan(angle) of the rig; upright, right-handed, looking at the origin."""
    poses = fan(PANEL, 1.3, 40.0, direction_deg=30, elevation_deg=15, columns=9)
    position, right = poses[0, :3, 3], poses[0, :3, 0]
    assert np.linalg.norm(position) == pytest.approx(1.3)
    angles = np.radians([0, 5, 5, 10, 10, 15, 15, 20, 20])
    offsets = (poses[:, :3, 3] - position) @ right
    np.testing.assert_allclose(np.abs(offsets), 1.3 * np.tan(angles), atol=1e-12)
    assert offsets.sum() == pytest.approx(0)
    np.testing.assert_allclose(poses[:, :3, 3], position + offsets[:, None] * right, atol=1e-12)
    # Positions of the rig's own cameras at the ends of its fan.
    half = Rig(np.eye(4), (1, 1), (0, 0), 1.3).half_width(PANEL)
    assert np.abs(offsets).max() == pytest.approx(half)
    np.testing.assert_allclose(np.linalg.det(poses[:, :3, :3]), 1)
    distance = np.linalg.norm(poses[:, :3, 3], axis=1)[:, None]
    np.testing.assert_allclose(poses[:, :3, 3] + distance * poses[:, :3, 2], 0, atol=1e-12)
    np.testing.assert_allclose(poses[:, 2, 0], 0, atol=1e-12)
    assert (poses[:, 2, 1] < 0).all()  # the camera's y axis, down, has the world's z, up, against it


def test_one_column_stands_in_the_middle_of_the_cone():
    poses = [fan(PANEL, 1.3, 40.0, direction_deg=30, elevation_deg=15, columns=columns) for columns in (1, 3)]
    np.testing.assert_allclose(poses[0], poses[1][:1], atol=1e-12)
    assert np.abs(poses[1] - poses[0]).max((1, 2))[1:].min() > 0.1


@pytest.mark.parametrize("panel", [PANEL, Panel(**PANEL.to_dict() | {"invert_views": True})])
def test_views_of_a_level_fan_fill_the_bins_of_the_evaluation(panel):
    poses = _poses(make_plan(panel, rows=1, elevation_deg=0))
    np.testing.assert_allclose(sorted(azimuths_from_source(poses)), np.arange(-20, 21, 5), atol=1e-9)


def test_margin_rows_directions_and_rig():
    plan = make_plan(PANEL, cone_margin=1.5, columns=3, rows=3, row_step_deg=8, elevation_deg=10, directions=2)
    poses = _poses(plan)
    assert len(poses) == 18
    np.testing.assert_allclose(np.degrees(np.arcsin(poses[:9:3, 2, 3] / 1.3)), [10, 18, 2])
    np.testing.assert_allclose(poses[9, :3, 3], poses[0, :3, 3] * (-1, -1, 1), atol=1e-12)  # from the other side
    sideways = (poses[1:3, :3, 3] - poses[0, :3, 3]) @ poses[0, :3, 0]
    np.testing.assert_allclose(np.abs(sideways), 1.3 * np.tan(np.radians(30)))
    rig = Rig(np.eye(4), (900, 900), (0, 0), zero_depth=2.0, cone_deg=10.0)
    poses = _poses(make_plan(PANEL, rig, columns=3, rows=1))
    assert np.linalg.norm(poses[0, :3, 3]) == pytest.approx(2)
    sideways = (poses[1:, :3, 3] - poses[0, :3, 3]) @ poses[0, :3, 0]
    np.testing.assert_allclose(np.abs(sideways), 2 * np.tan(np.radians(5)))


def test_the_whole_object_is_in_every_frame():
    plan = make_plan(PANEL, cone_margin=1.5, directions=3)
    points = np.random.default_rng(0).normal(size=(500, 3))
    points *= 0.5 / np.linalg.norm(points, axis=1)[:, None]
    for pose in _poses(plan):
        x, y, z = ((points - pose[:3, 3]) @ pose[:3, :3]).T
        assert plan["fl_x"] * max(np.abs(x / z).max(), np.abs(y / z).max()) <= plan["w"] / 2


@pytest.fixture
def plan_file(tmp_path, capsys) -> Path:
    path = tmp_path / "cone.json"
    assert main(["--size", "64", "--columns", "3", "--rows", "1", "-o", str(path)]) == 0
    assert "3 cameras" in capsys.readouterr().out
    return path


def test_plan_with_images_is_an_object(tmp_path, plan_file):
    """The plan is the transforms.json of what Blender renders from it."""
    (tmp_path / "set/a/images").mkdir(parents=True)
    shutil.copy(plan_file, tmp_path / "set/a/transforms.json")
    picture = np.zeros((64, 64, 4), np.uint8)
    picture[20:40, 20:40] = 200
    for index in range(3):
        Image.fromarray(picture).save(tmp_path / f"set/a/images/{index:06d}.png")
    assert list(problems(find_objects(tmp_path / "set"))) == []
    views = read_object(*find_objects(tmp_path / "set"))
    assert views.intrinsics.tolist() == [[65.6, 65.6, 32, 32]] * 3
    wanted = _poses(render.read_plan(plan_file))
    np.testing.assert_allclose(views.camera_to_world[:, :3, :3], wanted[:, :3, :3], atol=1e-12)


@pytest.mark.parametrize(
    "options, complaint",
    [
        ("--panel 65in", "unknown name"),
        ("--cone-margin 9", "cone-margin"),
        ("--columns 0", "columns"),
        ("--size 3", "size"),
        ("--focal 1.5", "focal.*whole object"),
        ("--elevation 84", "elevation"),
        ("--elevation nan", "elevation"),
        ("--rig none.yaml", "none.yaml"),
        ("--rows 1000000000", "rows"),
    ],
)
def test_plan_refuses_what_makes_no_views(tmp_path, capsys, options, complaint):
    assert main([*options.split(), "-o", str(tmp_path / "cone.json")]) == 2
    error = capsys.readouterr().err
    assert error.startswith("training.blender.plan: error: ") and complaint.split(".*")[0] in error
    assert error.count("\n") == 1 and not list(tmp_path.iterdir())


def test_script_needs_only_bpy_and_the_standard_library():
    imported = set()
    for node in ast.walk(ast.parse(SCRIPT.read_text())):
        if isinstance(node, ast.Import):
            imported |= {alias.name.split(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            imported.add((node.module or ".").split(".")[0])
    assert imported - set(sys.stdlib_module_names) == {"bpy", "mathutils"}


def test_script_finds_its_options_behind_those_of_blender():
    line = "blender --background --python render.py -- --plan p.json --output out --samples 8 a.glb b.obj"
    options = render.parse_arguments(line.split()[1:])
    assert (options.plan, options.output, options.samples) == (Path("p.json"), Path("out"), 8)
    assert options.meshes == [Path("a.glb"), Path("b.obj")]


def test_lens_and_unit_box():
    assert render.lens_mm({"w": 72, "fl_x": 100}) == pytest.approx(50)  # on a sensor 36 mm wide
    scale, translation = render.unit_box([(1, 2, 3), (3, 2, 3), (2, 5, 9)])
    assert scale == pytest.approx(1 / 7)
    np.testing.assert_allclose(
        np.array([[1, 2, 3], [3, 5, 9]]) * scale + translation, np.array([[-1], [1]]) * [1 / 7, 1.5 / 7, 3 / 7]
    )
    with pytest.raises(render.PlanError, match="extent"):
        render.unit_box([(1, 1, 1), (1, 1, 1)])


@pytest.mark.parametrize(
    "change, complaint",
    [
        (lambda p: p.pop("w"), "expected w, h, fl_x"),
        (lambda p: p.update(cx=3), "nothing else"),
        (lambda p: p.update(h=64.5), "h: expected a whole number"),
        (lambda p: p.update(fl_x=-1), "fl_x"),
        (lambda p: p.update(frames=[]), "frames"),
        (lambda p: p["frames"].append(3), r"frames\[3\].file_path"),
        (lambda p: p["frames"][1].update(file_path="../x.png"), r"frames\[1\].file_path.*within"),
        (lambda p: p["frames"][1].update(transform_matrix=np.diag([-1, 1, 1, 1]).tolist()), "right-handed"),
        (lambda p: p["frames"][1].update(transform_matrix=np.diag([2, 2, 2, 1]).tolist()), "right-handed"),
        (lambda p: p["frames"][1].update(transform_matrix=[[1, 2], [3]]), "4 rows of 4"),
        (lambda p: p["frames"][1].update(transform_matrix=np.eye(4).tolist()[:3] + [["a"] * 4]), "4 rows of 4"),
    ],
)
def test_script_names_what_is_wrong_with_a_plan(plan_file, change, complaint):
    plan = json.loads(plan_file.read_text())
    change(plan)
    plan_file.write_text(json.dumps(plan))
    with pytest.raises(render.PlanError, match=complaint) as error:
        render.read_plan(plan_file)
    assert str(plan_file) in str(error.value)


@pytest.mark.skipif(importlib.util.find_spec("bpy") is not None, reason="bpy is installed")
def test_script_says_what_is_missing_without_blender(plan_file, capsys):
    assert render.main(["--plan", str(plan_file), "--output", "x", "a.glb"]) == 2
    assert "pip install bpy" in capsys.readouterr().err


# With Blender


def _blender() -> list[str]:
    """Command that runs the script in Blender; skips the test where there is none."""
    if importlib.util.find_spec("bpy") is not None:
        return [sys.executable, str(SCRIPT)]
    if shutil.which("blender"):
        return ["blender", "--background", "--python-exit-code", "1", "--python", str(SCRIPT), "--"]
    pytest.skip("neither the bpy module nor the blender program is installed")


# Centre in Blender's axes (z up) of three of the four boxes below, and their colours.
_BOXES = {(1, 0, 0): (255, 0, 0), (0, 0, 1): (0, 255, 0), (0, -1, 0): (0, 0, 255)}


def _write_boxes(path: Path) -> None:
    """Write an OBJ file (y up) of small boxes within a cube of side 2.5.

    They are at (1,0,0), (0,1,0), (0,0,1) and (-1,-1,-1).
    """
    corners = 0.25 * np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    sides = np.array([[1, 2, 4, 3], [5, 7, 8, 6], [1, 5, 6, 2], [3, 4, 8, 7], [1, 3, 7, 5], [2, 6, 8, 4]])
    colours = {(1, 0, 0): "1 0 0", (0, 1, 0): "0 1 0", (0, 0, 1): "0 0 1", (-1, -1, -1): "0.5 0.5 0.5"}
    lines = [f"mtllib {path.stem}.mtl"]
    for index, centre in enumerate(colours):
        lines += ["usemtl m" + str(index), *("v {} {} {}".format(*row) for row in corners + centre)]
        lines += ["f {} {} {} {}".format(*row) for row in sides + 8 * index]
    path.write_text("\n".join(lines) + "\n")
    path.with_suffix(".mtl").write_text(
        "".join(f"newmtl m{index}\nKd {colour}\n" for index, colour in enumerate(colours.values()))
    )


@pytest.mark.slow
def test_blender_renders_what_the_cameras_see(tmp_path, plan_file):
    """Each coloured box appears where the reader's cameras project it; a set that is there is left alone."""
    _write_boxes(tmp_path / "boxes.obj")
    command = [
        *_blender(),
        "--plan",
        str(plan_file),
        "--output",
        str(tmp_path / "set"),
        "--samples",
        "8",
        str(tmp_path / "boxes.obj"),
    ]
    subprocess.run(command, check=True, capture_output=True)
    assert [path.name for path in (tmp_path / "set").iterdir()] == ["boxes"]
    assert list(problems(find_objects(tmp_path / "set"))) == []
    (path,) = find_objects(tmp_path / "set")
    views = read_object(path)
    for index, (pose, (fx, fy, cx, cy)) in enumerate(zip(views.camera_to_world, views.intrinsics)):
        pixels = read_view(views, index).astype(int)
        for centre, colour in _BOXES.items():
            x, y, z = np.linalg.inv(pose)[:3] @ [*(np.array(centre) / (2.5 * np.sqrt(3))), 1]
            found = pixels[int(fy * y / z + cy), int(fx * x / z + cx)]
            assert found[3] == 255 and np.argmax(found[:3]) == np.argmax(colour) and np.sort(found)[1] < 60
        assert pixels[0, 0, 3] == 0
    before = path.stat().st_mtime_ns
    assert "left alone" in subprocess.run(command, check=True, capture_output=True, text=True).stdout
    assert path.stat().st_mtime_ns == before
