"""Poses by a network that sees all photographs at once, where structure from motion fails.

Source: Lin et al., "Depth Anything 3: Recovering the visual space from any views", 2025, through its own package, an
optional dependency. Networks for many pictures are DA3-SMALL and DA3-BASE (Apache-2.0), DA3-LARGE and DA3-GIANT (for
non-commercial use).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from lightfield_gs.base.assumptions import assume
from lightfield_gs.base.errors import InputError
from lightfield_gs.base.options import POSE_MODEL, Device
from lightfield_gs.io.atomic import atomic_folder
from lightfield_gs.io.captures.depth_points import unproject
from lightfield_gs.io.captures.photo_files import PhotoFiles
from lightfield_gs.io.images import as_floats, read_image

POSE_MODELS = ("DA3-SMALL", "DA3-BASE", "DA3-LARGE", "DA3-GIANT")
_FREE = POSE_MODELS[:2]
_LONGEST_PX = 504  # of the pictures that the networks see
_POINTS = 50_000  # of all photographs
_CONFIDENT = 0.4  # quantile of the confidence from which on a depth makes a point
Network = Callable[[list[np.ndarray]], Any]


def open_pose_model(name: str, device: Device) -> Network:
    """Return the function of a network from photographs, uint8 [H,W,3] each, to the package's Prediction.

    Args:
        name: one of POSE_MODELS, or a folder with a model's files. A name's weights are downloaded at first use.
        device: "auto" and "cuda" use a GPU where there is one.

    Raises:
        InputError: the name is another, or the package or the weights are missing.
    """
    is_folder = Path(name).is_dir()
    if name not in POSE_MODELS and not is_folder:
        raise InputError(f"pose_model: expected one of {', '.join(POSE_MODELS)}, or a folder of its files, got {name}")
    try:
        from depth_anything_3.api import DepthAnything3
    except ImportError as error:
        raise InputError(
            f"pose_model={name} takes the package depth_anything_3, which cannot be imported ({error}): pip install "
            "'lightfield-gs[poses]'"
        ) from None
    if not is_folder and name not in _FREE:
        assume(f"the weights of {name} are for non-commercial use (CC BY-NC 4.0); those of {POSE_MODEL} for any")
    where = "cuda" if device != "cpu" and torch.cuda.is_available() else "cpu"
    try:
        model = DepthAnything3.from_pretrained(name if is_folder else f"depth-anything/{name}").to(where)
    except Exception as error:  # of the download, its files or the device: it may be anything
        raise InputError(
            f"pose_model={name} could not be loaded: run it again with a connection, if its weights are not on this "
            f"machine. It failed with: {' '.join(str(error).split())[:200]}"
        ) from None
    return lambda pictures: model.inference(pictures, process_res=_LONGEST_PX)


def pose_by_network(
    network: Network, name: str, files: PhotoFiles, names: Sequence[str], output: Path, progress: Callable[[str], None]
) -> Path:
    """Pose photographs of one camera, and write cameras and points to output/sparse/0 as COLMAP's text.

    Args:
        network: see open_pose_model.
        name: its name, for messages.
        files: of the photographs' folder.
        names: the photographs. They count as stored, whatever their Exif.
        output: the folder of the new capture.
        progress: called with messages about the current stage.

    Returns:
        The model's folder.

    Raises:
        InputError: photographs are of several sizes, or the network fails.
    """
    progress(f"poses of {len(names)} photographs by {name}")
    pictures = [_read(files.paths[photograph]) for photograph in names]
    height, width = pictures[0].shape[:2]
    if other := next((one for one, picture in zip(names, pictures) if picture.shape[:2] != (height, width)), None):
        raise InputError(
            f"{files.folder}: {name} poses photographs of one size, and {other} is not {width} x {height} as "
            f"{names[0]}: take those of another size out"
        )
    try:
        found = network(pictures)
        poses, depths = np.asarray(found.extrinsics, np.float64), np.asarray(found.depth, np.float64)
        small = np.asarray(found.intrinsics, np.float64)
        sure = np.ones_like(depths) if found.conf is None else np.asarray(found.conf, np.float64)
    except Exception as error:  # of the network: it may be anything, as too little memory
        raise InputError(f"pose_model={name} failed: {' '.join(str(error).split())[:200]}") from error
    if poses.shape[:1] != (len(names),) or poses.shape[1:] not in ((3, 4), (4, 4)) or not np.isfinite(poses).all():
        raise InputError(f"pose_model={name}: expected {len(names)} poses, got an array {list(poses.shape)}")
    scale = width / depths.shape[2], height / depths.shape[1]
    focal = np.median(small[:, [0, 1], [0, 1]], 0) * scale  # all are of one lens
    intrinsics = np.array([*focal, *(np.median(small[:, :2, 2], 0) * scale)])
    points, colours = _points(poses, depths, sure, pictures, intrinsics)
    model = output / "sparse" / "0"
    with atomic_folder(model) as folder:
        _write_model(folder, names, poses, intrinsics, (width, height), points, colours)
    assume(
        f"the poses are those of {name}, and may be off by some pixels: poses=True refines them; one camera of "
        f"{focal[0]:.0f} px stands for all {len(names)} photographs"
    )
    return model


def _read(path: Path) -> np.ndarray:
    pixels = as_floats(read_image(path, as_stored=True, turn=False))
    colours = np.repeat(pixels[..., :1], 3, 2) if pixels.shape[2] < 3 else pixels[..., :3]
    return np.rint(255 * np.clip(colours, 0, 1)).astype(np.uint8)


def _points(
    poses: np.ndarray, depths: np.ndarray, sure: np.ndarray, pictures: Sequence[np.ndarray], intrinsics: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return points [P,3] at confident depths, and their colours uint8 [P,3]."""
    random, height, width = np.random.default_rng(0), *pictures[0].shape[:2]
    good = np.isfinite(depths) & (depths > 0) & (sure >= np.quantile(sure, _CONFIDENT))
    points, colours = [], []
    for pose, depth, usable, picture in zip(poses, depths, good, pictures):
        rows, columns = np.nonzero(usable)
        picked = random.permutation(len(rows))[: -(-_POINTS // len(poses))]
        rows, columns = rows[picked], columns[picked]
        places = np.column_stack([(columns + 0.5) * width / depth.shape[1], (rows + 0.5) * height / depth.shape[0]])
        points.append(unproject(places, depth[rows, columns], intrinsics, pose))
        x, y = places.astype(int).T
        colours.append(picture[y, x])
    return np.concatenate(points), np.concatenate(colours)


def _write_model(
    folder: Path,
    names: Sequence[str],
    poses: np.ndarray,
    intrinsics: np.ndarray,
    size_px: tuple[int, int],
    points: np.ndarray,
    colours: np.ndarray,
) -> None:
    """Write cameras.txt, images.txt and points3D.txt as COLMAP reads them; see its documentation of the format."""
    width, height = size_px
    (folder / "cameras.txt").write_text(f"1 PINHOLE {width} {height} {_numbers(intrinsics)}\n")
    lines = []
    for number, (name, pose) in enumerate(zip(names, poses), 1):
        x, y, z, w = Rotation.from_matrix(pose[:3, :3]).as_quat()
        lines.append(f"{number} {_numbers([w, x, y, z, *pose[:3, 3]])} 1 {name}\n\n")  # without observations
    (folder / "images.txt").write_text("".join(lines), encoding="utf-8")
    rows = (
        f"{number} {_numbers(point)} {' '.join(map(str, colour))} 0\n"
        for number, (point, colour) in enumerate(zip(points, colours), 1)
    )
    (folder / "points3D.txt").write_text("".join(rows))


def _numbers(values: Sequence[float] | np.ndarray) -> str:
    return " ".join(repr(float(value)) for value in values)
