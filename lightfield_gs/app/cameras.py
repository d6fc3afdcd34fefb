"""The rig of a command: from a file, from the scene's file, or from automatic framing; and the look of the scene."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from lightfield_gs.app.options import CameraOptions, LookOptions
from lightfield_gs.app.trainer_cameras import central_camera, trainer_cameras
from lightfield_gs.base.cli_messages import note
from lightfield_gs.base.errors import InputError, named
from lightfield_gs.io.scenes.comments import antialiasing_source, find_fit_record, render_comments
from lightfield_gs.panels.panel import Panel
from lightfield_gs.panels.rig import Rig
from lightfield_gs.panels.stored_rigs import (
    framing_comment,
    needs_rig_beside,
    photo_camera,
    read_rig_file,
    rig_path,
    stored_framing,
)
from lightfield_gs.scene.axes import DEFAULT_UP, Up, find_up

if TYPE_CHECKING:
    from lightfield_gs.io.captures.camera_files import FileCamera
    from lightfield_gs.io.scenes.files import SceneFile
    from lightfield_gs.scene.cameras import Cameras
    from lightfield_gs.scene.gaussians import Gaussians

_OTHERS = "another: --camera, --rig, --up"
# Names of the options, and the fields of Look that they set
_FIELDS = {"focus": "focus", "depth_amount": "depth_amount", "cone": "cone_deg", "zoom": "zoom", "pan": "pan"}


@dataclass(frozen=True)
class CameraChoice:
    """The camera that the options name, read from its file, in the coordinates of the scene's file.

    Attributes:
        rig: of --rig; for_px: width and height of the panel that it is for, where that is another one.
        pose: world to camera of --camera, [4, 4]; focal_px and principal_point_px: at the panel's resolution.
        up: the axis of --up, for automatic framing.
        turn_deg, tilt_deg: of --turn and --tilt, from whichever camera it is. A scene without a camera is seen from
            its front where turn_deg is None.
        messages: lines on decisions.
    """

    rig: Rig | None = None
    for_px: tuple[int, int] | None = None
    pose: np.ndarray | None = None
    focal_px: tuple[float, float] = (1.0, 1.0)
    principal_point_px: tuple[float, float] = (0.0, 0.0)
    up: str | None = None
    turn_deg: float | None = None
    tilt_deg: float = 0.0
    messages: list[str] = field(default_factory=list)


def read_camera(options: CameraOptions, panel: Panel) -> CameraChoice:
    """Read the camera that the options name, before the scene is read. Raises InputError."""
    return replace(_named_camera(options, panel), turn_deg=options.turn, tilt_deg=options.tilt or 0.0)


def _named_camera(options: CameraOptions, panel: Panel) -> CameraChoice:
    if options.rig is not None and options.camera is not None:
        raise InputError("--camera takes the place of --rig; leave out one of them")
    up = options.up
    unused = ["axes: --up is not used: the camera was given, in the file's own axes"] if up else []
    if options.rig is not None:
        rig, other_px = _read_rig(options.rig, panel)
        return CameraChoice(rig, other_px, up=up, messages=[*_fitted_words(options.rig, other_px), *unused])
    if options.camera is None:
        return CameraChoice(up=up)
    path, index = options.camera
    if path.suffix.lower() in (".yaml", ".yml"):
        if index is not None:
            raise InputError(f"{path}:{index}: a rig is one camera; leave out the index")
        rig, other_px = _read_rig(path, panel)
        if other_px is not None:
            rig = rig.fitted(other_px, panel)
        words = f"camera: {path}, a rig, at the panel's resolution; its zero plane was placed anew"
        messages = [words, *_fitted_words(path, other_px), *unused]
        return CameraChoice(
            None, None, rig.world_to_camera, rig.focal_px, rig.principal_point_px, up, messages=messages
        )
    return _read_camera_file(path, index, panel, up, unused)


def _read_rig(path: Path, panel: Panel) -> tuple[Rig, tuple[int, int] | None]:
    """Return the rig of a file, and the size of the panel that it is for where that is another one.

    Raises:
        InputError: The file is no rig, or that of another panel, whose size it does not say.
    """
    from lightfield_gs.io.captures.camera_files import LIMIT_BYTES, is_camera_file
    from lightfield_gs.io.text_files import read_json

    if path.suffix.lower() == ".json" and is_camera_file(read_json(path, LIMIT_BYTES)):
        raise InputError(f"{path}: holds the cameras of photographs, no rig; give it as --camera FILE[:INDEX]")
    read = read_rig_file(path)
    if read.size_px is None:
        if words := _off_centre(read.rig.principal_point_px, panel):
            raise InputError(
                f"{path}: {words}, as a rig of a panel of another size is; add its size to the file, as "
                "`size_px: [7680, 3840]`, and it is fitted to this panel"
            )
        return read.rig, None
    return read.rig, _other_size(read.size_px, panel)


def _other_size(size_px: tuple[int, int], panel: Panel) -> tuple[int, int] | None:
    """Return the size unless it is the panel's own."""
    return None if size_px == (panel.width_px, panel.height_px) else size_px


def _fitted_words(path: Path, size_px: tuple[int, int] | None) -> list[str]:
    """Return a line on a rig that is for a panel of another size."""
    return [] if size_px is None else [f"rig: {path}, fitted from {_by(size_px)} to the panel"]


def _by(size_px: tuple[int, int]) -> str:
    return "{} x {}".format(*size_px)


def _read_camera_file(path: Path, index: int | None, panel: Panel, up: str | None, messages: list[str]) -> CameraChoice:
    """Return the camera of a camera file, fitted to the panel.

    Args:
        messages: Lines that follow the function's own messages.
    """
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
    fitted = camera.fitted(panel.width_px, panel.height_px)
    return CameraChoice(None, None, camera.world_to_camera, *fitted, up, messages=[words, *messages])


@dataclass(frozen=True)
class ChosenRig:
    """The cameras of the views, in the coordinates of the Gaussians.

    Attributes:
        rig: the cameras.
        messages: lines on how they were chosen.
        is_settled: whether their depth was settled for this panel before, and is kept.
    """

    rig: Rig
    messages: list[str]
    is_settled: bool = False


def chosen_rig(choice: CameraChoice, panel: Panel, gaussians: Gaussians) -> ChosenRig | None:
    """Return the rig of the options; None where they name no camera."""
    if choice.rig is not None:
        rig = _on_panel(choice.rig, choice.for_px, panel, gaussians)
        return ChosenRig(rig, choice.messages, is_settled=choice.for_px is None)
    if choice.pose is None:
        return None
    rig = Rig(choice.pose, choice.focal_px, choice.principal_point_px, 1.0)
    return ChosenRig(_focused(_on_panel(rig, None, panel, gaussians), panel, gaussians), choice.messages)


def _on_panel(rig: Rig, for_px: tuple[int, int] | None, panel: Panel, gaussians: Gaussians) -> Rig:
    """Return a rig of a file in the coordinates of the Gaussians, fitted to the panel where it is for another one."""
    rig = rig.relative_to(gaussians.origin)
    if for_px is None:
        return rig
    from lightfield_gs.photo.fill_panel import fill_panel

    return fill_panel(rig, for_px, panel, gaussians)


def file_rig(path: Path, file: SceneFile, panel: Panel, gaussians: Gaussians) -> ChosenRig | None:
    """Return the rig that a scene's file brings along; None where it brings none.

    Args:
        path: of the file, for errors.
        file: its contents beside the Gaussians.
        panel: the panel that shows the scene.
        gaussians: the scene; the rig is in its coordinates.

    Raises:
        InputError: the framing in the file cannot be read.
    """
    return (
        _rig_inside(path, file, panel, gaussians)
        or _rig_beside(path, panel, gaussians)
        or _rig_of_trainer(path, panel, gaussians)
    )


def has_own_camera(path: Path, file: SceneFile) -> bool:
    """Return whether a scene's file brings a framing or a camera along, in it or beside it. Raises InputError."""
    with named(path):
        inside = stored_framing(file.comments) is not None or photo_camera(file.elements) is not None
    return inside or path_beside(path) is not None or trainer_cameras(path) is not None


def _rig_inside(path: Path, file: SceneFile, panel: Panel, gaussians: Gaussians) -> ChosenRig | None:
    """Return the rig of the cameras in the scene's file; None without any."""
    with named(path):
        if (stored := stored_framing(file.comments)) is not None:
            rig, size_px = stored
            other_px = _other_size(size_px, panel)
            words = "" if other_px is None else f", made for {_by(size_px)}"
            return ChosenRig(
                _on_panel(rig, other_px, panel, gaussians),
                [f"camera: the framing stored in the file{words} ({_OTHERS})"],
                is_settled=other_px is None,
            )
        if (camera := photo_camera(file.elements)) is None:
            return None
    words = f"camera: that of the photo, {camera.width_px:g} x {camera.height_px:g}, which the file brings along"
    return ChosenRig(_photo_rig(camera, panel, gaussians), [f"{words} ({_OTHERS})"])


def _photo_rig(camera: FileCamera, panel: Panel, gaussians: Gaussians) -> Rig:
    """Return the rig of a photo's camera, whose picture fills the panel as far as its subject lets."""
    photo = Rig(camera.world_to_camera, camera.focal_px, camera.principal_point_px, 1.0)
    rig = _on_panel(photo, (round(camera.width_px), round(camera.height_px)), panel, gaussians)
    return _focused(rig, panel, gaussians)


def _rig_of_trainer(path: Path, panel: Panel, gaussians: Gaussians) -> ChosenRig | None:
    """Return the rig of the photograph in the middle of those that a trainer made the scene of; None without them."""
    if (cameras := trainer_cameras(path)) is None or (found := central_camera(cameras, panel.cone_deg)) is None:
        return None
    camera, index = found
    words = f"camera: {cameras}, {index} ({camera.name}), which most others are near ({_OTHERS})"
    try:
        return ChosenRig(_photo_rig(camera, panel, gaussians), [words])
    except InputError:  # it sees nothing: the file belongs to another scene
        return None


def path_beside(path: Path) -> Path | None:
    """Return the file of the framing beside a scene whose format has no place for it; None where there is none."""
    return rig_path(path) if needs_rig_beside(path) and rig_path(path).is_file() else None


def _rig_beside(path: Path, panel: Panel, gaussians: Gaussians) -> ChosenRig | None:
    """Return the rig in the file beside a scene; None where there is none."""
    if (beside := path_beside(path)) is None:
        return None
    rig, other_px = _read_rig(beside, panel)
    words = f"camera: the framing in {beside}, beside the scene ({_OTHERS})"
    return ChosenRig(
        _on_panel(rig, other_px, panel, gaussians),
        [words, *_fitted_words(beside, other_px)],
        is_settled=other_px is None,
    )


def _focused(rig: Rig, panel: Panel, gaussians: Gaussians) -> Rig:
    from lightfield_gs.panels.framing import focus_on_scene

    return focus_on_scene(rig, gaussians, panel)


def frame_automatically(choice: CameraChoice, file: SceneFile, panel: Panel, gaussians: Gaussians) -> ChosenRig:
    """Return the rig of a scene that has no cameras, seen from its front or as --turn says.

    Raises:
        InputError: there is nothing to frame.
    """
    axis = scene_up(choice.up, file)
    words = [f"axes: {axis.describe()}"]
    turn, tilt = choice.turn_deg, choice.tilt_deg
    if turn is None:
        from lightfield_gs.panels.front import find_front

        turn = find_front(gaussians, axis.axis)
        if turn:
            words.append(f"front: turned by {turn:g} degrees, to the side that shows most (unturned: --turn 0)")
    if choice.turn_deg or tilt:
        words.append(turned_words(turn, tilt))
    notes: list[str] = []
    rig = Rig.frame(gaussians, panel, up=axis.axis, turn_deg=turn, tilt_deg=tilt, notes=notes)
    others = "another view: --camera, --rig or --up"
    return ChosenRig(rig, [*words, *(f"framing: {line}; {others}" for line in notes)])


def turned_words(turn_deg: float, tilt_deg: float) -> str:
    """Return a line on cameras that were turned round the scene."""
    return f"turned: {turn_deg:g} degrees to the right, {tilt_deg:g} up"


def scene_up(up: str | None, file: SceneFile) -> Up:
    """Return the axis that points up: the option's, else the file's, else the default."""
    if up:
        return Up(up, "--up")
    return find_up(file.comments) or Up(DEFAULT_UP, "assumed: the file does not say; another: --up")


def fit_and_cameras(file: SceneFile) -> list[tuple[str, str]]:
    """Return a scene file's notes on its fit and its cameras, for `info`."""
    try:
        fitted = find_fit_record(file.comments)
        fit = [] if fitted is None else [("fitted", fitted.describe())]
        if antialiasing_source(file.comments) == "trained":
            fit.append(("anti-aliasing", "trained with it, the file says, and drawn with it"))
    except InputError as error:
        fit = [("fitted", str(error))]
    return fit + _cameras_in(file)


def _cameras_in(file: SceneFile) -> list[tuple[str, str]]:
    try:
        if (stored := stored_framing(file.comments)) is not None:
            return [("camera", f"a framing stored for {_by(stored[1])}")]
        camera = photo_camera(file.elements)
    except InputError as error:
        return [("camera", str(error))]
    return [] if camera is None else [("camera", f"that of the photo, {camera.width_px:g} x {camera.height_px:g}")]


def scene_comments(
    up: str | None, antialiased: bool, panel: Panel, file: SceneFile | None, rig: Rig | None
) -> list[str]:
    """Return comments for the header of a scene's file, with the framing of this drawing.

    Args:
        up: the axis of --up.
        antialiased: whether it was drawn so.
        panel: the panel of the rig.
        file: the file that the scene is from.
        rig: the cameras, in the coordinates of the file.
    """
    known = render_comments(file.comments if file is not None else (), antialiased)
    if file is not None and (up or find_up(file.comments)):
        known.append(f"Vertical Axis: {scene_up(up, file).axis}")
    return known + ([] if rig is None else [framing_comment(rig, panel)])


def load_view_cameras(path: Path, panel: Panel, has_view_map: bool) -> Cameras:
    """Read the camera of each view, and note where they are in the wrong order or look like another panel's.

    Args:
        has_view_map: Whether the cameras belong to a view map, whose views have an order of their own.

    Raises:
        InputError: the file cannot be used.
    """
    from lightfield_gs.encoding.view_files import read_cameras

    cameras = read_cameras(path, panel)
    _note_off_centre(path, cameras.intrinsics()[:, 2:].median(0).values.tolist(), panel)
    if not has_view_map:
        _note_wrong_order(path, cameras, panel)
    return cameras


def _note_off_centre(path: Path, principal_point_px: Sequence[float], panel: Panel) -> None:
    """Note cameras that look as if their lengths counted pixels of another panel."""
    if words := _off_centre(principal_point_px, panel):
        note(
            f"{path}: {words}; if it was made for a panel of another size, scale focal_px and principal_point_px by "
            "the ratio"
        )


def _off_centre(principal_point_px: Sequence[float], panel: Panel) -> str:
    """Return words on cameras that look as if their lengths counted pixels of another panel; "" for others.

    Then the principal point is off the middle in both directions alike. It is off in one alone where the content is
    beside the axis and was centred.
    """
    size = panel.width_px, panel.height_px
    fractions = [centre / pixels for centre, pixels in zip(principal_point_px, size)]
    if 0.3 <= max(fractions) and min(fractions) <= 0.7:
        return ""
    x, y = principal_point_px
    return f"its principal point ({x:g}, {y:g}) is far from the middle of the panel's {_by(size)} pixels"


def _note_wrong_order(path: Path, cameras: Cameras, panel: Panel) -> None:
    """Note cameras that go from left to right, as a quilt's do, where the views go from right to left, or reversed."""
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


def given_look(options: LookOptions) -> dict[str, Any]:
    """Return the options that were given, by their names."""
    return {name: value for name in _FIELDS if (value := getattr(options, name)) is not None}


def apply_look(options: LookOptions, rig: Rig, panel: Panel, gaussians: Gaussians) -> tuple[Rig, list[str]]:
    """Return the rig as the options want it, and lines on the result.

    Args:
        options: what is asked for.
        rig: the cameras so far.
        panel: the panel that shows the scene.
        gaussians: the scene, in the rig's coordinates.

    Raises:
        InputError: there is nothing at the point of --focus, or the options cannot be met.
    """
    if not (given := given_look(options)):
        return rig, []
    from lightfield_gs.panels.look import Look

    look = Look(**{_FIELDS[name]: value for name, value in given.items()})
    seen = look.applied(rig, panel, gaussians)
    cone = panel.cone_deg if seen.cone_deg is None else seen.cone_deg
    words = [f"depth {seen.zero_depth:.5g} in the panel's plane", f"a cone of {cone:.4g} degrees"]
    if look.zoom != 1:
        words.append(f"{look.zoom:g} times as large")
    if any(look.pan):
        words.append(f"moved by {look.pan[0]:g} of the width and {look.pan[1]:g} of the height")
    return seen, [f"look: {', '.join(words)}"]


def report_depth(
    options: LookOptions, rig: Rig, panel: Panel, gaussians: Gaussians, may_fill: bool = True
) -> list[str]:
    """Return the lines of --depth-report, and note what looks wrong with the depth.

    Without options, only outermost views that the scene does not fill are noted.

    Args:
        options: what was asked for.
        rig: the cameras.
        panel: the panel that shows the scene.
        gaussians: the scene, in the rig's coordinates.
        may_fill: whether the scene can fill the picture where nothing was steered.

    Raises:
        InputError: a report is asked for, and the rig shows nothing.
    """
    if not options.depth_report and not given_look(options):
        if not may_fill:
            return []
        from lightfield_gs.panels.visibility import background_fraction, background_warning

        past = background_fraction(gaussians, panel, rig)
        if past is not None and (words := background_warning(past)) is not None:
            note(words)
        return []
    from lightfield_gs.panels.comfort import depth_report

    report = depth_report(gaussians, panel, rig)
    for words in report.warnings():
        note(words)
    return report.lines() if options.depth_report else []


def refuse_look(options: LookOptions, reason: str) -> None:
    """Raise InputError for the first of the options that was given."""
    for name in given_look(options):
        raise InputError(f"--{name.replace('_', '-')} {reason}; leave out one of them")
