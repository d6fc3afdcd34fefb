"""A small synthetic object on disk, as transforms.json."""

import json
import shutil
from pathlib import Path

import numpy as np
from srn_scene import FOCAL, HEIGHT, WIDTH, write_object

from lightfield_gs.io.captures.objects import read_srn_object

OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
CAMERA = {"w": WIDTH, "h": HEIGHT, "fl_x": FOCAL, "fl_y": FOCAL, "cx": WIDTH / 2, "cy": HEIGHT / 2}


def write_transforms(folder: Path, name: str = "transforms.json", scale: float = 1.0, camera=CAMERA, **scene) -> None:
    """The object that write_object(..., **scene) makes, the world `scale` times as large."""
    temporary = folder.parent / f".{folder.name}"
    write_object(temporary, **scene)
    views = read_srn_object(temporary)
    stem = name.removesuffix(".json")
    (folder / stem).mkdir(parents=True)
    frames = []
    for path, pose in zip(views.image_paths, views.camera_to_world):
        shutil.copy(path, folder / stem / path.name)
        pose = pose @ OPENGL
        pose[:3, 3] *= scale
        frames.append({"file_path": f"./{stem}/{path.name}", "transform_matrix": pose.tolist()})
    shutil.rmtree(temporary)
    (folder / name).write_text(json.dumps({"aabb_scale": 16, **camera, "frames": frames}))


def edit(path: Path, change) -> None:
    """Change the data of a transforms file with a function."""
    data = json.loads(path.read_text())
    change(data)
    path.write_text(json.dumps(data))
