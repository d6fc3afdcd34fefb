"""Pictures and films for one screen, found in files and folders."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from fractions import Fraction
from pathlib import Path

from lightfield_gs.app.options import PanelOptions
from lightfield_gs.app.panel import found_panel, lens_differs, parse_panel, shown_panel, stored_panel
from lightfield_gs.app.slide_pixels import native_frames
from lightfield_gs.base.cli_messages import note
from lightfield_gs.base.errors import InputError, reading
from lightfield_gs.base.options import StereoLayout
from lightfield_gs.io.depth_names import is_sidecar_name
from lightfield_gs.io.file_kinds import VIDEO_INPUTS
from lightfield_gs.io.images import read_info
from lightfield_gs.io.pillow_images import is_heif
from lightfield_gs.io.stereo_names import layout_in_name
from lightfield_gs.io.text_files import read_object
from lightfield_gs.panels.panel import Panel
from lightfield_gs.panels.quilt import stated_layout
from lightfield_gs.panels.stereo_screen import StereoScreen
from lightfield_gs.show.playlist import Playlist, Slide
from lightfield_gs.video.frame_folder import MANIFEST, MANIFEST_BYTES

_BROWSER_FILMS = (".mp4", ".m4v", ".mov", ".webm", ".mkv")  # as browsers play them
_DEFAULT_FPS = Fraction(30)
_MOST_NAMED = 3  # files of a folder that are named where they are left out


def find_slides(inputs: Sequence[Path], options: PanelOptions, stereo: StereoLayout | None) -> Playlist:
    """Return the slides of files and folders.

    The first one decides what the screen is, unless an option does: a panel, or a screen of two eyes. Files that are
    not for it are refused; in a folder they are left out, and said.

    Args:
        inputs: Files, and folders of files or of a film's frames.
        options: --panel.
        stereo: --stereo.

    Raises:
        InputError: There is nothing to show, or a file cannot be shown.
    """
    if stereo is not None and options.panel is not None:
        raise InputError("--stereo is for a screen of two eyes, and --panel is another; leave out one of them")
    wanted = None if stereo is None and options.panel is None else stereo is not None
    slides: list[Slide] = []
    left_out: list[str] = []
    for path in inputs:
        if not path.is_dir() or (path / MANIFEST).is_file():
            slides.append(_slide(path, wanted))
            continue
        found, refused = _in_folder(path, wanted if not slides else slides[0].pair is not None)
        slides += found
        left_out += refused
        if not found:
            raise InputError(f"{path}: nothing in it can be shown" + "".join(f"; {words}" for words in refused[:1]))
    pairs = [slide for slide in slides if slide.pair is not None]
    if pairs and len(pairs) < len(slides):
        other = next(slide for slide in slides if slide.pair is None)
        raise InputError(
            f"{pairs[0].path} is for a screen of two eyes, and {other.path} is for a panel; show them one after the "
            "other"
        )
    if pairs:
        panel = replace(StereoScreen().panel(), name="stereo screen")
        return Playlist(slides, panel, stereo or "sbs", _left_out_words(left_out))
    panel = _panel(slides, options)
    kept = []
    for slide in slides:
        if words := _why_not_on(slide, panel):
            if slide.path in inputs:
                raise InputError(words)
            left_out.append(words)
            continue
        kept.append(slide)
        if options.panel is None and slide.panel is not None and lens_differs(slide.panel, panel):
            note(f"{slide.path} was made for panel {slide.panel.name}, whose lens is not that of {panel.name}")
    if not kept:
        raise InputError(f"nothing in these folders can be shown; {left_out[0]}")
    return Playlist(kept, panel, None, _left_out_words(left_out))


def _left_out_words(reasons: list[str]) -> list[str]:
    """Return a line on the files of folders that are left out."""
    if not reasons:
        return []
    some = "; ".join(reasons[:_MOST_NAMED]) + ("; ..." if len(reasons) > _MOST_NAMED else "")
    return [f"{len(reasons)} file{' is' if len(reasons) == 1 else 's are'} left out: {some}"]


def _in_folder(folder: Path, wants_pairs: bool | None) -> tuple[list[Slide], list[str]]:
    """Return the slides of a folder in natural order, and why its other files are none."""
    from lightfield_gs.video.sequence import PICTURES, natural_order

    found: list[Slide] = []
    refused = []
    with reading(folder):
        paths = sorted((path for path in folder.iterdir() if not path.name.startswith(".")), key=natural_order)
    for path in paths:
        is_frames = path.is_dir() and (path / MANIFEST).is_file()
        if not is_frames and path.suffix.lower() not in (*PICTURES, *VIDEO_INPUTS) or is_sidecar_name(path.name):
            continue
        try:
            slide = _slide(path, wants_pairs)
        except InputError as error:
            refused.append(str(error))
            continue
        wants_pairs = slide.pair is not None
        found.append(slide)
    return found, refused


def _slide(path: Path, wants_pairs: bool | None) -> Slide:
    """Return what a file shows.

    Args:
        path: A file, or a folder of frames.
        wants_pairs: Whether it is for a screen of two eyes; None: as it is.

    Raises:
        InputError: It cannot be read, or is of another kind.
    """
    if path.is_dir():
        slide = _frame_folder(path)
    elif path.suffix.lower() in VIDEO_INPUTS and path.is_file():
        slide = _film(path)
    else:
        slide = _picture(path, wants_pairs)
    if wants_pairs is not None and wants_pairs != (slide.pair is not None):
        if wants_pairs:
            raise InputError(
                f"{path}: neither the file nor its name says that it is stereo; rename it, as NAME_2x1{path.suffix}"
            )
        raise InputError(f"{path} is a stereo picture, for a screen of two eyes: show it alone, without --panel")
    return slide


def _picture(path: Path, wants_pairs: bool | None) -> Slide:
    from lightfield_gs.photo.stereo_pair import find_pair
    from lightfield_gs.view_sets.view_set import read_quilt_layout

    if wants_pairs is not True and path.is_file():
        stored = None if is_heif(path) else read_info(path).metadata.get("panel")
        if stored is not None:
            return Slide(path, parse_panel(path, stored))
        if (stated := read_quilt_layout(path, None)) is not None:
            return Slide(path, quilt=stated[0])
    if wants_pairs is not False and path.is_file() and (pair := find_pair(path)) is not None:
        return Slide(path, pair=pair)
    return Slide(path)


def _film(path: Path) -> Slide:
    """Return a film: of quilts by its name, of pairs by its name or its metadata, else of native frames."""
    from lightfield_gs.video.sequence import open_sequence

    if (quilt := stated_layout(path)) is not None:
        slide = Slide(path, quilt=quilt, is_film=True)
    elif (named := layout_in_name(path)) is not None:
        slide = Slide(path, pair=named, is_film=True)
    else:
        try:
            frames = open_sequence(path)
        except InputError as error:
            raise InputError(f"{error}; `lightfield-gs video` makes films for the panel") from None
        fps = frames.fps or _DEFAULT_FPS
        slide = Slide(path, pair=frames.pair, is_film=True, fps=fps, frames=frames.count)
    if not slide.is_native and path.suffix.lower() not in _BROWSER_FILMS:
        raise InputError(f"{path}: browsers play {', '.join(_BROWSER_FILMS)}, no {path.suffix}; convert it to .mp4")
    return slide


def _frame_folder(folder: Path) -> Slide:
    """Return the film whose frames `video` wrote to a folder."""
    from lightfield_gs.video.sequence import open_sequence

    manifest = read_object(folder / MANIFEST, MANIFEST_BYTES)
    made = manifest.get("made", {})
    if made.get("kind", "native") != "native":
        raise InputError(f"{folder}: its frames are of --kind {made['kind']}; make a video of it: -o NAME.mp4")
    frames = open_sequence(folder)
    panel = parse_panel(folder, json.dumps(made["panel"])) if "panel" in made else None
    fps = Fraction(manifest.get("fps", _DEFAULT_FPS)).limit_denominator(1001)
    return Slide(folder, panel, is_film=True, fps=fps, frames=frames.count)


def _panel(slides: Sequence[Slide], options: PanelOptions) -> Panel:
    """Return the panel: the named one, that of the first picture that names one, or that of the connected display."""
    if options.panel is not None:
        return Panel.load(options.panel, serial=options.device_serial)
    named = [slide for slide in slides if slide.panel is not None]
    if named and options.device_serial is None:
        assert named[0].panel is not None
        return named[0].panel
    if slides[0].is_native and not slides[0].is_film:
        try:
            return shown_panel(slides[0].path, options.device_serial)
        except InputError as error:
            raise InputError(f"{error}; a photo needs `lightfield-gs encode` first") from None
    return found_panel(options.device_serial) if not named else stored_panel(named[0].path, options.device_serial)


def _why_not_on(slide: Slide, panel: Panel) -> str:
    """Return why a slide cannot be shown on a panel; "" where it can."""
    if not slide.is_native:
        return ""
    if slide.is_film:
        height, width, channels = next(native_frames(slide)).shape
    else:
        info = read_info(slide.path)
        height, width, channels = info.height_px, info.width_px, info.channels
    if (height, width) == (panel.height_px, panel.width_px) and channels >= 3:
        return ""
    if slide.is_film:
        way = "make a film for the panel with `video`"
    elif slide.panel is None:
        from lightfield_gs.photo.stereo_pair import find_pair

        is_pair = find_pair(slide.path) is not None
        way = "it is for a screen of two eyes" if is_pair else "encode it first, if it is a photo"
    else:
        way = "name the panel it was encoded for"
    return (
        f"{slide.path} is {width} x {height} pixels of {channels} channels, panel "
        f"{panel.name} is {panel.width_px} x {panel.height_px} of 3; {way}"
    )
