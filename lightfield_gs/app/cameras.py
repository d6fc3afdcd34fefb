"""The rig of a command: of its options, of what the scene's file brings along, or framed automatically."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from lightfield_gs.app.photo import photo_rig
from lightfield_gs.base.cli_messages import note
from lightfield_gs.base.errors import InputError, named
from lightfield_gs.io.scenes.comments import antialiasing_source, find_fit_record, render_comments
from lightfield_gs.panels.panel import Panel
from lightfield_gs.panels.rig import Rig
from lightfield_gs.scene.axes import DEFAULT_UP, Up, find_up

if TYPE_CHECKING:
    from lightfield_gs.io.scenes.files import SceneFile
    from lightfield_gs.panels.rig import Rig
    from lightfield_gs.scene.cameras import Cameras
    from lightfield_gs.scene.gaussians import Gaussians

_OTHERS = "another: --camera, --rig, --up"


@dataclass(frozen=True)
class Given:
    """What the options say of the cameras, in the coordinates of the scene's file.

    rig: of --rig, complete. pose, focal_px, principal_point_px: of --camera, at the panel's resolution. messages:
    lines.
    """

    rig: Rig | None = None
    pose: np.ndarray | None = None
    focal_px: tuple[float, float] = (1.0, 1.0)
    principal_point_px: tuple[float, float] = (0.0, 0.0)
    messages: list[str] = field(default_factory=list)


def read_given(args: argparse.Namespace, panel: Panel) -> Given:
    """The cameras that the options name, read before the scene is. Raises InputError."""
    if args.rig is not None and args.camera is not None:
        raise InputError("--camera takes the place of --rig; leave out one of them")
    if args.rig is None and args.camera is None:
        return Given()
    unused = ["axes: --up is not used: the camera was given, in the file's own axes"] if args.up else []
    if args.rig is not None:
        _refuse_cameras(args.rig)
        return Given(load_rig(args, panel), messages=unused)
    path, index = args.camera
    if path.suffix.lower() in (".yaml", ".yml"):
        if index is not None:
            raise InputError(f"{path}:{index}: a rig is one camera; leave out the index")
        rig = Rig.from_yaml(path)
        return Given(
            None,
            rig.world_to_camera,
            rig.focal_px,
            rig.principal_point_px,
            [f"camera: {path}, a rig, at the panel's resolution; its zero plane was placed anew", *unused],
        )
    return _of_camera_file(path, index, panel, unused)


def _refuse_cameras(path: Path) -> None:
    """Raises InputError where a file that was given as a rig holds the cameras of photographs."""
    from lightfield_gs.io.captures.camera_files import LIMIT_BYTES, is_camera_file
    from lightfield_gs.io.text_files import read_json

    if path.suffix.lower() == ".json" and is_camera_file(read_json(path, LIMIT_BYTES)):
        raise InputError(f"{path}: holds the cameras of photographs, no rig; give it as --camera FILE[:INDEX]")


def _of_camera_file(path: Path, index: int | None, panel: Panel, messages: list[str]) -> Given:
    from lightfield_gs.io.captures.camera_files import read_camera_file

    cameras = read_camera_file(path)
    if index is not None and index >= len(cameras):
        raise InputError(f"{path}:{index}: expected an index of 0..{len(cameras) - 1}, as many cameras are in it")
    camera = cameras[index or 0]
    words = f"camera: {path}, {index or 0} ({camera.name}) of {len(cameras)}"
    if index is None and len(cameras) > 1:
        words += f", the first; another: --camera {path}:1"
    if camera.assumed:
        words += f"; {camera.assumed}"
    if camera.distorted:
        words += "; its lens distortion is left out"
    return Given(None, camera.world_to_camera, *camera.fitted(panel.width_px, panel.height_px), [words, *messages])


def choose_rig(
    given: Given, args: argparse.Namespace, panel: Panel, gaussians: Gaussians, file: SceneFile | None
) -> tuple[Rig, list[str]]:
    """The rig in the coordinates that the Gaussians have, and lines on how it was chosen. file: None for a photo.

    Raises InputError.
    """
    if given.rig is not None:
        return given.rig.relative_to(gaussians.origin), given.messages
    if given.pose is not None:
        return _looking(given.pose, given.focal_px, given.principal_point_px, panel, gaussians), given.messages
    if file is None:
        return photo_rig(args, panel, gaussians), []
    own = None if args.up else _own_camera(args.input, file, panel, gaussians)
    return own or _automatic(args, panel, gaussians, file)


def _own_camera(path: Path, file: SceneFile, panel: Panel, gaussians: Gaussians) -> tuple[Rig, list[str]] | None:
    from lightfield_gs.panels.framing import photo_camera, stored_framing

    with named(path):
        if (stored := stored_framing(file.comments, panel)) is not None:
            return stored[0].relative_to(gaussians.origin), [f"camera: {stored[1]} ({_OTHERS})"]
        if (camera := photo_camera(file.elements)) is None:
            return None
    return (
        _looking(camera.world_to_camera, *camera.fitted(panel.width_px, panel.height_px), panel, gaussians),
        [
            f"camera: that of the photo, {camera.width_px:g} x {camera.height_px:g}, which the file brings along "
            f"({_OTHERS})"
        ],
    )


def _looking(
    pose: np.ndarray,
    focal_px: tuple[float, float],
    principal_point_px: tuple[float, float],
    panel: Panel,
    gaussians: Gaussians,
) -> Rig:
    from lightfield_gs.panels import framing

    pose = Rig(pose, focal_px, principal_point_px, 1.0).relative_to(gaussians.origin).world_to_camera
    return framing.frame_from_camera(gaussians, panel, pose, focal_px, principal_point_px)


def _automatic(args: argparse.Namespace, panel: Panel, gaussians: Gaussians, file: SceneFile) -> tuple[Rig, list[str]]:
    up = axes_of(args.up, file)
    notes: list[str] = []
    from lightfield_gs.panels.framing import frame_scene

    rig = frame_scene(gaussians, panel, up=up.axis, notes=notes)
    others = "another view: --camera, --rig or --up"
    return rig, [f"axes: {up.describe()}", *(f"framing: {words}; {others}" for words in notes)]


def axes_of(up: str | None, file: SceneFile) -> Up:
    """Which axis points up, and who says so; up: what the command line says."""
    if up:
        return Up(up, "--up")
    return find_up(file.comments) or Up(DEFAULT_UP, "assumed: the file does not say; another: --up")


def brought_along(file: SceneFile) -> list[tuple[str, str]]:
    """What a scene's file says of its fit and of cameras, for `info`."""
    try:
        fitted = find_fit_record(file.comments)
        fit = [] if fitted is None else [("fitted", fitted.describe())]
        if antialiasing_source(file.comments) == "trained":
            fit.append(("anti-aliasing", "trained with it, the file says, and drawn with it"))
    except InputError as error:
        fit = [("fitted", str(error))]
    return fit + _cameras_along(file)


def _cameras_along(file: SceneFile) -> list[tuple[str, str]]:
    from lightfield_gs.panels.framing import photo_camera, stored_size

    try:
        if (size := stored_size(file.comments)) is not None:
            return [("camera", f"a framing stored for {size[0]} x {size[1]}")]
        camera = photo_camera(file.elements)
    except InputError as error:
        return [("camera", str(error))]
    return [] if camera is None else [("camera", f"that of the photo, {camera.width_px:g} x {camera.height_px:g}")]


def comments_of(args: argparse.Namespace, panel: Panel, file: SceneFile | None, rig: Rig | None) -> list[str]:
    """Lines for the header of a file of the Gaussians, so that it is seen as it was drawn; rig: in its coordinates."""
    from lightfield_gs.panels.framing import framing_comment

    known = render_comments(file.comments if file is not None else (), args.antialiased)
    if file is not None and (args.up or find_up(file.comments)):
        known.append(f"Vertical Axis: {axes_of(args.up, file).axis}")
    return known + ([] if rig is None else [framing_comment(rig, panel)])


def load_rig(args: argparse.Namespace, panel: Panel) -> Rig | None:
    """The rig of --rig, if there is one; says where it looks like one of another panel. Raises InputError."""
    from lightfield_gs.panels.rig import Rig

    if args.rig is None:
        return None
    rig = Rig.from_yaml(args.rig)
    _note_of_centre(args.rig, rig.principal_point_px, panel)
    return rig


def load_cameras(args: argparse.Namespace, panel: Panel) -> Cameras:
    """Those of --cameras; says where they look as if they were in the wrong order, or made for another panel."""
    from lightfield_gs.encoding.view_files import read_cameras

    cameras = read_cameras(args.cameras, panel)
    _note_of_centre(args.cameras, cameras.intrinsics()[:, 2:].median(0).values.tolist(), panel)
    if args.view_map is None:  # a view map has the views in an order of its own
        _note_of_order(args.cameras, cameras, panel)
    return cameras


def _note_of_centre(path: Path, principal_point_px: Sequence[float], panel: Panel) -> None:
    """Says where cameras' lengths look as if they counted pixels of another panel: then the principal point is off the
    middle in both directions alike. In one alone it is where the content is beside the axis and was centred."""
    size = panel.width_px, panel.height_px
    places = [centre / pixels for centre, pixels in zip(principal_point_px, size)]
    if max(places) < 0.3 or min(places) > 0.7:
        x, y = principal_point_px
        note(
            f"{path}: its principal point ({x:g}, {y:g}) is far from the middle of the panel's {size[0]} x {size[1]} "
            "pixels; if it was made for a panel of another size, scale focal_px and principal_point_px by the ratio"
        )


def _note_of_order(path: Path, cameras: Cameras, panel: Panel) -> None:
    """Says where the cameras go from left to right, as those of quilts do, and views from right to left, or the other
    way round."""
    rotations, moves = cameras.world_to_camera[:, :3, :3], cameras.world_to_camera[:, :3, 3:]
    centres = -(rotations.transpose(1, 2) @ moves)[..., 0]
    right = rotations[cameras.count // 2, 0]
    half = (cameras.count + 1) // 2
    way = centres[:half].mean(0) - centres[-half:].mean(0)  # from the last to the first
    to_right = float(way @ right) * (-1 if panel.invert_views else 1)
    if to_right < -0.1 * float(way.norm()):
        sides = ("left", "right") if panel.invert_views else ("right", "left")
        note(
            f"{path}: view 0 of panel {panel.name} goes to the {sides[0]}-most eye, and camera 0 stands on the "
            f"{sides[1]}: depth is inside out; write the cameras in the other order"
        )
