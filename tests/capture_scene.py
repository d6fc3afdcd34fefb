"""Captures on disk: models in COLMAP's formats, written from its documentation, and photographs of dots.

The positions of the dots in the scene are known, and the lens of each camera model shows them by its formula.
"""

from __future__ import annotations

import json
import struct
import warnings
from math import atan, sqrt, tan
from pathlib import Path

import numpy as np
from PIL import Image
from transforms_scene import OPENGL

from lightfield_gs.base.assumptions import Assumption
from lightfield_gs.io.captures.capture import read_capture
from lightfield_gs.io.captures.pinhole import pose_matrix

WIDTH, HEIGHT = 96, 72
DOTS = ((0.0, 0.0), (0.31, 0.12), (-0.35, 0.2), (-0.22, -0.29), (0.28, -0.25))  # x / z and y / z of what is seen
FOCAL = {1: [70.0], 2: [70.0, 78.0]}
CENTRE = [49.5, 34.0]
# number in binary files, how many focal lengths, coefficients after the principal point
MODELS = {
    "SIMPLE_PINHOLE": (0, 1, []),
    "PINHOLE": (1, 2, []),
    "SIMPLE_RADIAL": (2, 1, [-0.21]),
    "RADIAL": (3, 1, [0.12, 0.3]),
    "OPENCV": (4, 2, [-0.2, 0.05, 0.01, -0.02]),
    "OPENCV_FISHEYE": (5, 2, [0.1, -0.05, 0.2, 0.03]),
    "FULL_OPENCV": (6, 2, [0.1, 0.05, 0.01, -0.02, 0.03, 0.4, -0.1, 0.2]),
    "FOV": (7, 2, [0.92]),
    "SIMPLE_RADIAL_FISHEYE": (8, 1, [-0.1]),
    "RADIAL_FISHEYE": (9, 1, [0.2, -0.1]),
    "THIN_PRISM_FISHEYE": (10, 2, [0.1, -0.1, 0.01, 0.02, 0.05, 0.1, -0.03, 0.04]),
    "RAD_TAN_THIN_PRISM_FISHEYE": (11, 2, [0.1, -0.1, 0.05, 0.1, 0.2, 0.1, 0.01, -0.02, 0.03, -0.01, 0.02, 0.05]),
    "SIMPLE_DIVISION": (12, 1, [-0.3]),
    "DIVISION": (13, 2, [0.15]),
    "SIMPLE_FISHEYE": (14, 1, []),
    "FISHEYE": (15, 2, []),
    "EUCM": (16, 2, [0.6, 1.1]),
}


def parameters(model: str) -> list[float]:
    _, focal_lengths, coefficients = MODELS[model]
    return [*FOCAL[focal_lengths], *CENTRE, *coefficients]


def seen(model: str, u: float, v: float, coefficients: list[float] | None = None) -> tuple[float, float]:
    """Where a lens shows the point (u, v) at depth 1, term by term."""
    c = MODELS[model][2] if coefficients is None else coefficients
    r = sqrt(u * u + v * v)
    if "FISHEYE" in model and r > 0:
        u, v = u * atan(r) / r, v * atan(r) / r
    r2 = u**2 + v**2
    match model:
        case "SIMPLE_RADIAL" | "SIMPLE_RADIAL_FISHEYE":
            return u * (1 + c[0] * r2), v * (1 + c[0] * r2)
        case "RADIAL" | "RADIAL_FISHEYE":
            return u * (1 + c[0] * r2 + c[1] * r2**2), v * (1 + c[0] * r2 + c[1] * r2**2)
        case "OPENCV":
            radial = 1 + c[0] * r2 + c[1] * r2**2
            return _tangential(u, v, u * radial, v * radial, c[2], c[3])
        case "OPENCV_FISHEYE":
            radial = 1 + c[0] * r2 + c[1] * r2**2 + c[2] * r2**3 + c[3] * r2**4
            return u * radial, v * radial
        case "FULL_OPENCV":
            radial = (1 + c[0] * r2 + c[1] * r2**2 + c[4] * r2**3) / (1 + c[5] * r2 + c[6] * r2**2 + c[7] * r2**3)
            return _tangential(u, v, u * radial, v * radial, c[2], c[3])
        case "FOV":
            scale = atan(2 * r * tan(c[0] / 2)) / c[0] / r if r else 1
            return u * scale, v * scale
        case "THIN_PRISM_FISHEYE":
            radial = 1 + c[0] * r2 + c[1] * r2**2 + c[4] * r2**3 + c[5] * r2**4
            x, y = _tangential(u, v, u * radial, v * radial, c[2], c[3])
            return x + c[6] * r2, y + c[7] * r2
        case "RAD_TAN_THIN_PRISM_FISHEYE":
            radial = 1 + c[0] * r2 + c[1] * r2**2 + c[2] * r2**3 + c[3] * r2**4 + c[4] * r2**5 + c[5] * r2**6
            x, y = u * radial, v * radial
            q2 = x * x + y * y
            return (
                x + (2 * x * x + q2) * c[6] + 2 * x * y * c[7] + c[8] * q2 + c[9] * q2**2,
                y + (2 * y * y + q2) * c[7] + 2 * x * y * c[6] + c[10] * q2 + c[11] * q2**2,
            )
        case "SIMPLE_DIVISION" | "DIVISION":
            d = (1 - sqrt(1 - 4 * c[0] * r2)) / (2 * c[0] * r) if r else 0  # r = d / (1 + k d^2)
            return (u * d / r, v * d / r) if r else (u, v)
        case "EUCM":
            w = c[0] * sqrt(c[1] * r2 + 1) + 1 - c[0]
            return u / w, v / w
    return u, v


def _tangential(u: float, v: float, x: float, y: float, p1: float, p2: float) -> tuple[float, float]:
    r2 = u * u + v * v
    return x + 2 * p1 * u * v + p2 * (r2 + 2 * u * u), y + 2 * p2 * u * v + p1 * (r2 + 2 * v * v)


def in_pixels(model: str, place: tuple[float, float]) -> tuple[float, float]:
    focal = FOCAL[MODELS[model][1]]
    return focal[0] * place[0] + CENTRE[0], focal[-1] * place[1] + CENTRE[1]


def dots(places, width: int = WIDTH, height: int = HEIGHT, size: float = 2.0) -> np.ndarray:
    """A picture uint8 [H,W,3] of bright dots round these places, in pixels."""
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    light = sum(np.exp(-((x - u) ** 2 + (y - v) ** 2) / (2 * size**2)) for u, v in places)
    return np.repeat(np.rint(200 * np.minimum(light, 1)).astype(np.uint8)[..., None], 3, 2)


def centre_of_dot(picture: np.ndarray, near: tuple[float, float], reach: float = 7.0) -> np.ndarray:
    """The centre of light [2], x and y in pixels, within a reach of a place."""
    y, x = np.mgrid[: picture.shape[0], : picture.shape[1]] + 0.5
    light = picture[..., 0].astype(float) * (np.hypot(x - near[0], y - near[1]) < reach)
    return np.array([(light * x).sum(), (light * y).sum()]) / light.sum()


def write_model(folder: Path, form: str, cameras, images, points=()) -> None:
    """cameras: (number, model, width, height, parameters). images: (name, camera, quaternion w x y z, translation).
    points: ((x, y, z), (r, g, b)). form: bin or txt. Each image has two observations, each point a track of one."""
    folder.mkdir(parents=True, exist_ok=True)
    (_binary if form == "bin" else _text)(folder, cameras, images, points)


def _binary(folder: Path, cameras, images, points) -> None:
    data = struct.pack("<Q", len(cameras))
    for number, model, width, height, numbers in cameras:
        data += struct.pack("<iiQQ", number, MODELS[model][0], width, height) + struct.pack(
            f"<{len(numbers)}d", *numbers
        )
    (folder / "cameras.bin").write_bytes(data)
    data = struct.pack("<Q", len(images))
    for index, (name, camera, quaternion, translation) in enumerate(images):
        data += struct.pack("<I7dI", index + 1, *quaternion, *translation, camera) + name.encode() + b"\0"
        data += struct.pack("<Q", 2) + struct.pack("<ddq", 1.5, 2.5, 1) + struct.pack("<ddq", 3.5, 4.5, -1)
    (folder / "images.bin").write_bytes(data)
    data = struct.pack("<Q", len(points))
    for index, (place, colour) in enumerate(points):
        data += struct.pack("<Q3d3BdQ", index + 1, *place, *colour, 0.4, 1) + struct.pack("<II", 1, 0)
    (folder / "points3D.bin").write_bytes(data)


def _text(folder: Path, cameras, images, points) -> None:
    lines = ["# Camera list", "#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]"]
    lines += [f"{number} {model} {w} {h} {' '.join(map(repr, numbers))}" for number, model, w, h, numbers in cameras]
    (folder / "cameras.txt").write_text("\n".join(lines) + "\n")
    lines = ["# Image list with two lines of data per image:"]
    for index, (name, camera, quaternion, translation) in enumerate(images):
        pose = " ".join(map(repr, map(float, [*quaternion, *translation])))
        lines += [f"{index + 1} {pose} {camera} {name}", "" if index % 2 else "1.5 2.5 1 3.5 4.5 -1"]
    (folder / "images.txt").write_text("\n".join(lines) + "\n")
    lines = [
        f"{index + 1} {' '.join(map(repr, map(float, place)))} {' '.join(map(str, colour))} 0.4 1 0"
        for index, (place, colour) in enumerate(points)
    ]
    (folder / "points3D.txt").write_text("\n".join(["# 3D point list", *lines]) + "\n")


def ring(count: int, radius: float = 2.0) -> list:
    """Poses (quaternion, translation) of cameras on a ring round the y axis that look at its middle."""
    angles = 2 * np.pi * np.arange(count) / count
    return [((np.cos(angle / 2), 0.0, np.sin(angle / 2), 0.0), (0.0, 0.0, radius)) for angle in angles]


def write_capture(folder: Path, model: str = "PINHOLE", form: str = "bin", count: int = 3, picture=None, **changes):
    """A capture of `count` photographs on a ring, one camera; what is changed of write_model's arguments."""
    picture = dots([in_pixels(model, seen(model, *dot)) for dot in DOTS]) if picture is None else picture
    names = changes.pop("names", [f"{index:03d}.png" for index in range(count)])
    for name in names:
        path = folder / "images" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(picture).save(path)
    given = {
        "cameras": [(7, model, WIDTH, HEIGHT, parameters(model))],
        "images": [(name, 7, *pose) for name, pose in zip(names, ring(max(count, len(names))))],
        "points": [((0.1, 0.2, 0.3), (255, 0, 7)), ((-0.1, 0.2, 0.1), (1, 2, 3)), ((0.3, 0.0, 0.0), (4, 5, 6))],
    }
    write_model(folder / "sparse/0", form, **{**given, **changes})


CAMERA = {"w": WIDTH, "h": HEIGHT, "fl_x": 70.0, "fl_y": 78.0, "cx": CENTRE[0], "cy": CENTRE[1]}


def said(*arguments, **options) -> tuple:
    """A capture, and what was assumed of it, as one text."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        capture = read_capture(*arguments, **options)
    assert [w.message for w in caught if not issubclass(w.category, Assumption)] == []
    return capture, "\n".join(str(warning.message) for warning in caught)


def to_world(count: int) -> np.ndarray:
    """Camera to world [C,4,4] of the ring, OpenGL axes."""
    return np.stack([np.linalg.inv(pose_matrix(*pose)) @ OPENGL for pose in ring(count)])


def write_ring(folder, count: int = 6, name="transforms.json", first=0, change=None, **top) -> np.ndarray:
    """A transforms.json of photographs images/0.png and so on; change(frames) may change its frames."""
    (folder / "images").mkdir(parents=True, exist_ok=True)
    matrices = to_world(first + count)[first:]
    frames = []
    for index, matrix in enumerate(matrices, first):
        Image.fromarray(dots([(20, 20 + index)])).save(folder / f"images/{index}.png")
        frames.append({"file_path": f"images/{index}.png", "transform_matrix": matrix.tolist()})
    if change:
        change(frames)
    (folder / name).write_text(json.dumps({**CAMERA, **top, "frames": frames}))
    return matrices
