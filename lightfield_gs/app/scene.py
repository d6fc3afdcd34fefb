"""The scene of a command, from a file of Gaussians or from a photo; and its cameras."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lightfield_gs.app.cameras import (
    CameraChoice,
    ChosenRig,
    apply_look,
    chosen_rig,
    file_rig,
    frame_automatically,
    has_own_camera,
    path_beside,
    report_depth,
    turned_words,
)
from lightfield_gs.app.levels import LevelledFile, read_levelled, turned_round
from lightfield_gs.app.options import WHITE, CameraOptions, LookOptions, PhotoOptions, RenderOptions, SceneOptions
from lightfield_gs.app.photo import PhotoPlacement, ReadPhoto, photo_rig, photo_scene, quilt_in_name, read_photo
from lightfield_gs.app.photo_depth import has_depth
from lightfield_gs.app.photo_pair import check_pair_options
from lightfield_gs.base.cli_messages import Stopwatch, note
from lightfield_gs.base.errors import InputError, named
from lightfield_gs.io.atomic import check_output_path
from lightfield_gs.io.file_kinds import refuse_unsupported
from lightfield_gs.io.scenes.comments import antialiasing_source, find_fit_record, format_rgb
from lightfield_gs.io.scenes.files import check_written_suffix, is_scene_path
from lightfield_gs.panels.panel import Panel
from lightfield_gs.panels.stored_rigs import RigFile, read_rig_file, rig_path

if TYPE_CHECKING:
    from lightfield_gs.io.scenes.files import SceneFile
    from lightfield_gs.panels.rig import Rig
    from lightfield_gs.photo.background import Rgb
    from lightfield_gs.scene.gaussians import Gaussians

# A cone by which most programs draw (the default of Looking Glass' Unity plug-in), and a step between views that is
# seen; the step is chosen by hand
_NARROWER_DEG = 35.0
_WIDE_STEP_PX = 5.0
_PALE = 0.5  # fraction of an outline that is like white from which on a scene is not drawn before white
_DEPTH_OPTIONS: tuple[str, ...] = ("depth_kind", "depth_range", "depth_scale", "depth_invalid", "pixel_aspect", "fov")
_DEPTH_OPTIONS += ("intrinsics", "fit", "swap_eyes")
_NETWORK_OPTIONS = ("checkpoint", "detail", "detail_budget")
_PHOTO_OPTIONS: tuple[str, ...] = ("mask", "remove_background", "checkpoint", "depth", "depth_model", "rgbd")
_PHOTO_OPTIONS += ("stereo_in", "map_orientation", "detail", "detail_budget", "clean_edges")


@dataclass(frozen=True)
class RenderSettings:
    """Anti-aliasing and background of a picture, by the options or else by the scene's file.

    Attributes:
        background: red, green and blue, 0..1.
        antialiased: see render.
        view_filter: see encode.
        is_assumed: whether neither the options nor the file give a background.
    """

    background: tuple[float, float, float]
    antialiased: bool
    view_filter: float
    is_assumed: bool = False

    def arguments(self) -> dict[str, Any]:
        """Return the settings as the functions that draw take them."""
        return {"background": self.background, "antialiased": self.antialiased, "view_filter": self.view_filter}


@dataclass
class LoadedScene:
    """A scene on the device.

    Attributes:
        path: the file it is from.
        gaussians: the scene.
        render: how it is drawn.
        file: what else its file holds. None: it is from a photo.
        photo: how the scene of a photo came about.
        messages: lines on what was decided.
    """

    path: Path
    gaussians: Gaussians
    render: RenderSettings
    file: SceneFile | None = None
    photo: PhotoPlacement | None = None
    messages: list[str] = field(default_factory=list)

    def in_file(self, rig: Rig) -> Rig:
        """Return a rig in the coordinates of the scene's file, as files of cameras are."""
        return rig.relative_to([-part for part in self.gaussians.origin])


@dataclass
class FramedScene:
    """A scene on the device, and a rig in its coordinates; messages: lines on decisions."""

    scene: LoadedScene
    rig: Rig
    messages: list[str]


def check_scene_options(options: SceneOptions, camera: CameraOptions) -> None:
    """Raise InputError where options of the scene exclude each other, or do not suit the input."""
    path, photo = options.input, options.photo
    is_file = is_scene_path(path)
    if is_file:
        _refuse(photo, _PHOTO_OPTIONS, f"is for photos, and {path} is a file of Gaussians")
    else:
        refuse_unsupported(path)
        reason = f"is for files of Gaussians, and {path} is none"
        _refuse(options, ("skip_invalid", "time", "lod"), reason)
        _refuse(camera, ("up", "camera", "turn", "tilt"), reason)
    check_photo_options(photo, not is_file and has_depth(path, photo))


def check_photo_options(photo: PhotoOptions, has_depth: bool) -> None:
    """Raise InputError where options of a photo exclude each other; has_depth: whether it is shown with its depths."""
    if has_depth:
        _refuse(photo, _NETWORK_OPTIONS, "is for the network, which --depth does without")
    else:
        _refuse(photo, _DEPTH_OPTIONS, "is about a depth map, and there is no --depth")
    check_pair_options(photo)
    is_estimated, has_map = photo.is_estimated, photo.depth_file is not None
    if photo.depth is not None:
        _refuse(photo, ("rgbd",), "takes the place of --depth")
    if is_estimated:
        if photo.depth_kind == "ray":
            raise InputError("--depth-kind: ray is for a depth map in a file; --depth auto estimates none of that kind")
        _refuse(photo, ("depth_scale", "depth_invalid"), "is about a depth map in a file, and --depth auto has none")
    else:
        _refuse(photo, ("depth_model",), "is for --depth auto")
    if photo.is_flat:
        names = ("depth_kind", "depth_range", "depth_scale", "depth_invalid")
        _refuse(photo, names, "is about a depth map, and --depth flat has none")
    if photo.mask is None and not has_map:
        _refuse(photo, ("map_orientation",), "is about a mask or a depth map in a file of its own, and there is none")
    if photo.intrinsics is not None and min(photo.intrinsics[:2]) <= 0:
        raise InputError(
            f"--intrinsics: expected focal lengths > 0 px, got {photo.intrinsics[0]:g} and {photo.intrinsics[1]:g}"
        )
    for one, other in (("depth_range", "depth_scale"), ("fov", "intrinsics"), ("pixel_aspect", "intrinsics")):
        if getattr(photo, one) is not None:
            _refuse(photo, (other,), f"takes the place of {_option(one)}")


def _refuse(options: PhotoOptions | SceneOptions | CameraOptions, names: tuple[str, ...], reason: str) -> None:
    """Raise InputError for the first of these options that was given."""
    for name in names:
        if getattr(options, name) not in (None, False):
            raise InputError(f"{_option(name)} {reason}; leave out one of them")


def _option(name: str) -> str:
    return "--" + name.replace("_", "-")


def check_scene_path(path: Path) -> None:
    """Raise InputError where Gaussians cannot be written to a path, by its folder or its extension."""
    check_output_path(path)
    check_written_suffix(path)


def read_noted(path: Path, skip_invalid: bool, time: float | None = None, lod: int | None = None) -> SceneFile:
    """Read a file of Gaussians, and note suspicious contents and losses. Raises InputError."""
    from lightfield_gs.io.scenes.files import read_scene

    scene = read_scene(path, skip_invalid=skip_invalid, time=time, lod=lod)
    for words in scene.notes:
        note(f"{path}: {words}")
    return scene


def say_origin(path: Path, gaussians: Gaussians) -> None:
    """Print the origin that was taken off the coordinates of a file, where it has one."""
    if any(gaussians.origin):
        origin = ", ".join(f"{part:.0f}" for part in gaussians.origin)
        print(f"{path}: origin {origin}, taken off its double coordinates (rigs and cameras are in the file's)")


def read_source(options: SceneOptions, by_rig: bool = True) -> SceneFile | ReadPhoto:
    """Read the files of the input; nothing is computed yet.

    Args:
        options: the options of the input.
        by_rig: whether a rig will show the scene, and levels of detail are read when it is known.

    Raises:
        InputError: a file cannot be read.
    """
    path = options.input
    if is_scene_path(path):
        if by_rig and options.lod is None and (levelled := read_levelled(path, options.skip_invalid)) is not None:
            return levelled
        file = read_noted(path, options.skip_invalid, options.time, options.lod)
        say_origin(path, file.gaussians)
        return file
    if name := quilt_in_name(path):
        note(
            f"{path}: this looks like a Looking Glass quilt of {name[1]} x {name[2]} views, and is taken for one "
            "photo; `lightfield-gs weave` takes its views"
        )
    return read_photo(path, options.photo)


def build_scene(
    options: SceneOptions,
    source: SceneFile | ReadPhoto,
    render: RenderOptions,
    look: LookOptions,
    panel: Panel,
    device: str,
    watch: Stopwatch,
) -> LoadedScene:
    """Return the scene of an input that was read, on the device, and settle how it is drawn.

    Args:
        options: the options of the input.
        source: the contents of its files.
        render: anti-aliasing and background, as far as they are given.
        look: decides how wide a margin a photo with depths needs.
        panel: decides how finely a photo is taken, and which shape one with depths is to fill.
        device: where the scene goes.
        watch: notes the times.

    Raises:
        InputError: there is no scene in the photo, or the file's notes on its fit cannot be read.
    """
    photo, file = None, None
    if isinstance(source, ReadPhoto):
        gaussians, photo = photo_scene(source, panel, look, device, watch)
    else:
        gaussians, file = source.gaussians.to(device), source
        watch.lap("load")
    settings, messages = settle_render(render, options.input, file)
    if isinstance(source, ReadPhoto) and render.background is None:
        settings, chosen = _photo_background(settings, source)
        messages += chosen
    return LoadedScene(options.input, gaussians, settings, file, photo, messages)


def load_scene(
    options: SceneOptions, render: RenderOptions, look: LookOptions, panel: Panel, device: str, watch: Stopwatch
) -> LoadedScene:
    """Read the input and build its scene, see `build_scene`. Raises InputError."""
    return build_scene(options, read_source(options), render, look, panel, device, watch)


def settle_render(options: RenderOptions, path: Path, file: SceneFile | None) -> tuple[RenderSettings, list[str]]:
    """Return the options of drawing a scene, or else its file's, and lines on the file's part.

    Args:
        options: those given.
        path: of the scene's file, for errors.
        file: the contents of the file. None: the scene is from a photo.

    Raises:
        InputError: the file's notes on its fit cannot be read.
    """
    antialiased, background = options.antialiased, options.background
    comments = file.comments if file is not None and None in (antialiased, background) else ()
    fitted, trained = None, None
    if comments:
        with named(path):
            fitted, trained = find_fit_record(comments), antialiasing_source(comments)
    messages = []
    beside = _drawn_beside(path) if file is not None and None in (antialiased, background) else None
    if antialiased is None:
        antialiased = trained is not None
        if not antialiased and beside is not None and beside.antialiased:
            antialiased = True
            messages.append(f"drawn with anti-aliasing, as {rig_path(path)} says (without: --no-antialiased)")
        elif antialiased:
            messages.append(
                f"drawn with anti-aliasing: the file says that it was {trained} so (without: --no-antialiased)"
            )
    is_assumed = background is None
    if background is None:
        background = (fitted and fitted.background) or (beside and beside.background) or WHITE
        if beside is not None and beside.background == background:
            is_assumed = False
            messages.append(f"background: {format_rgb(background)}, as {rig_path(path)} says (--background)")
        elif fitted is not None and fitted.background is not None:
            is_assumed = False
            messages.append(
                f"background: {format_rgb(fitted.background)}, which the scene was fitted before (--background)"
            )
    return RenderSettings(background, antialiased, options.view_filter, is_assumed), messages


def _drawn_beside(path: Path) -> RigFile | None:
    """Return the file beside a scene that says how it was drawn; None without one, or where the scene says it."""
    return None if (beside := path_beside(path)) is None else read_rig_file(beside)


def _photo_background(settings: RenderSettings, source: ReadPhoto) -> tuple[RenderSettings, list[str]]:
    """Return the settings with the background that a cut-out object stands out from, and a line on it."""
    from lightfield_gs.photo.background import LIGHT, choose_background

    found = choose_background(source.photo.pixels)
    if found is None:
        return settings, []
    background, alike = found
    kind = "light" if background == LIGHT else "dark"
    return replace(settings, background=background), [_background_words(kind, background, alike)]


def _background_words(kind: str, background: Rgb, alike: dict[Rgb, float]) -> str:
    """Return a line on a background that was chosen by an outline."""
    fractions = ", ".join(f"{alike[one]:.0%} of its outline is like {format_rgb(one)}" for one in alike)
    return f"background: {kind}, {format_rgb(background)}; {fractions} (another: --background)"


def _darken_behind(scene: LoadedScene, rig: Rig, panel: Panel) -> list[str]:
    """Draw a pale scene before a dark background, where none was given and white would hide most of its outline.

    Returns:
        A line on it, if so.
    """
    if scene.file is None or not scene.render.is_assumed:
        return []
    from lightfield_gs.panels.visibility import centre_colours
    from lightfield_gs.photo.background import DARK, LIGHT, choose_background

    found = choose_background(centre_colours(scene.gaussians, panel, rig))
    if found is None or found[0] != DARK or found[1][LIGHT] <= _PALE:
        return []
    scene.render = replace(scene.render, background=DARK)
    return [_background_words("dark", *found)]


def choose_rig(choice: CameraChoice, scene: LoadedScene, panel: Panel) -> ChosenRig:
    """Return the rig in the coordinates of the Gaussians.

    The first of these counts: the options, the photo, the cameras that the scene's file brings along, automatic
    framing; then --turn and --tilt. Raises InputError.
    """
    if (own := _own_rig(choice, scene, panel)) is None:
        assert scene.file is not None
        return frame_automatically(choice, scene.file, panel, scene.gaussians)
    turn, tilt = choice.turn_deg or 0.0, choice.tilt_deg
    if not (turn or tilt):
        return own
    from lightfield_gs.panels.look import orbited

    return replace(own, rig=orbited(own.rig, turn, tilt), messages=[*own.messages, turned_words(turn, tilt)])


def _own_rig(choice: CameraChoice, scene: LoadedScene, panel: Panel) -> ChosenRig | None:
    """Return the rig of the options, the photo or the scene's file; None where there is none."""
    if (chosen := chosen_rig(choice, panel, scene.gaussians)) is not None:
        return chosen
    if scene.photo is not None:
        return ChosenRig(photo_rig(scene.photo, panel, scene.gaussians), [])
    if choice.up or scene.file is None:
        return None
    return file_rig(scene.path, scene.file, panel, scene.gaussians)


def is_framed_here(choice: CameraChoice, scene: LoadedScene) -> bool:
    """Return whether neither the options nor the scene's file have a camera. Raises InputError."""
    if choice.rig is not None or choice.pose is not None:
        return False
    return scene.file is None or bool(choice.up) or not has_own_camera(scene.path, scene.file)


def _ease_depth(look: LookOptions, rig: Rig, panel: Panel, scene: LoadedScene) -> tuple[Rig, list[str]]:
    """Return the rig with as much depth as the eyes take, where the options do not say how much; and lines on it."""
    from lightfield_gs.panels.comfort import comfortable_amount
    from lightfield_gs.panels.look import Look

    if look.depth_amount is not None or look.cone is not None:
        return rig, []
    amount = comfortable_amount(scene.gaussians, panel, rig)
    if amount is None:
        return rig, []
    words = f"depth: {amount:g} of what it is, the most that does not strain the eyes (all of it: depth_amount=1)"
    return Look(depth_amount=amount).applied(rig, panel), [words]


def _wide_cone(look: LookOptions, rig: Rig, panel: Panel, scene: LoadedScene) -> list[str]:
    """Return a line where a wide cone puts neighbouring views far apart, and nobody chose the cone.

    A screen of two eyes, or of one picture that follows them, has no neighbouring views.
    """
    from lightfield_gs.panels.comfort import neighbour_step_px

    cone_deg = panel.cone_deg if rig.cone_deg is None else rig.cone_deg
    if look.cone is not None or cone_deg <= _NARROWER_DEG or panel.views <= 2:
        return []
    step = neighbour_step_px(scene.gaussians, panel, rig)
    if step is None or step <= _WIDE_STEP_PX:
        return []
    less = step * math.tan(math.radians(_NARROWER_DEG) / 2) / math.tan(math.radians(cone_deg) / 2)
    return [
        f"cone: {cone_deg:.3g} degrees put neighbouring views up to {step:.1f} px apart, which looks double or blurred "
        f"away from the panel's plane; --cone {_NARROWER_DEG:g}, as other programs have it, makes that {less:.1f} px"
    ]


def frame_scene(
    choice: CameraChoice, look: LookOptions, scene: LoadedScene, panel: Panel, is_turned: bool = False
) -> tuple[Rig, list[str]]:
    """Return the rig as the options want it, and lines on how it came about and how deep the scene is.

    Of a scene in levels of detail, the coarsest is framed; then it becomes what the rig shows.

    Args:
        choice: the cameras that are asked for.
        look: changes of the rig.
        scene: what is shown.
        panel: the panel to fill.
        is_turned: whether the cameras will go round the scene.

    Returns:
        The rig in the coordinates of the Gaussians, and the lines. Raises InputError.
    """
    chosen = choose_rig(choice, scene, panel)
    rig, looks = apply_look(look, chosen.rig, panel, scene.gaussians)
    how = [*chosen.messages, *show_levels(scene, turned_round(rig) if is_turned else [rig], panel)]
    if not chosen.is_settled:
        rig, eased = _ease_depth(look, rig, panel, scene)
        looks += eased
    # The framing of an object leaves space around it, as no other does
    if scene.photo is not None and scene.photo.is_whole and choice.rig is None and look.focus is None:
        how = [*how, f"focus: the subject, at depth {rig.zero_depth:.4g}, lies in the panel (another: --focus)"]
    may_fill = scene.photo is None or choice.rig is not None or scene.photo.is_whole
    looks += _darken_behind(scene, rig, panel)
    looks += _wide_cone(look, rig, panel, scene)
    return rig, [*how, *looks, *report_depth(look, rig, panel, scene.gaussians, may_fill)]


def show_levels(scene: LoadedScene, rigs: list[Rig], panel: Panel) -> list[str]:
    """Let a scene in levels of detail become what these rigs show; return a line on it. Raises InputError."""
    if not isinstance(scene.file, LevelledFile):
        return []
    gaussians, words = scene.file.choose(panel, rigs)
    scene.gaussians = gaussians.to(scene.gaussians.device)
    return [words]


def load_framed(
    options: SceneOptions,
    choice: CameraChoice,
    render: RenderOptions,
    look: LookOptions,
    panel: Panel,
    device: str,
    watch: Stopwatch,
    is_turned: bool = False,
) -> FramedScene:
    """Load the scene of a command and frame it, see `build_scene` and `frame_scene`. Raises InputError."""
    scene = load_scene(options, render, look, panel, device, watch)
    rig, how = frame_scene(choice, look, scene, panel, is_turned)
    return FramedScene(scene, rig, scene.messages + how)
