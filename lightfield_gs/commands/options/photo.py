"""The scene that a command makes of a photo: an object through the network, or all of it with its depth map."""

from __future__ import annotations

import argparse
import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING

from lightfield_gs.base.complaint import note
from lightfield_gs.base.errors import InputError
from lightfield_gs.base.stopwatch import Stopwatch
from lightfield_gs.commands.options.depth_map import (
    depth_beside,
    depth_of_file,
    depth_within,
    has_depth,
    is_depth_inside,
)
from lightfield_gs.commands.options.detail import detail_given, detail_words
from lightfield_gs.commands.options.estimated import AUTO, depth_by_network, is_estimated
from lightfield_gs.commands.options.network import network_of
from lightfield_gs.commands.options.photo_camera import camera_of_photo
from lightfield_gs.commands.options.placing import place_photo
from lightfield_gs.photo.side_by_side import depth_side, halves

if TYPE_CHECKING:
    from lightfield_gs.io.images import Picture
    from lightfield_gs.panels.panel import Panel
    from lightfield_gs.photo.depth import DepthMap
    from lightfield_gs.photo.load import Photo
    from lightfield_gs.scene.gaussians import Gaussians


_MOST_BESIDE = 200  # files in the folder of a photo up to which a depth map is looked for: each of a batch does so


@dataclass
class ReadPhoto:
    """What the files of a photo hold, before anything is computed of it.

    is_whole: whether all of it is shown. depth: of its map, then; None where a network estimates it, and of an object.
    refused: why no object was cut out where all is shown instead. notes: lines.
    """

    photo: Photo
    is_whole: bool = False
    depth: DepthMap | None = None
    refused: InputError | None = None
    notes: list[str] = field(default_factory=list)


def quilt_in_name(path: Path) -> re.Match[str] | None:
    """The columns and rows that the name of a picture says, where it is that of a quilt:
    <name>_qs<columns>x<rows>a<aspect>."""
    return re.search(r"_qs(\d+)x(\d+)a\d", path.stem)


def read_photo(args: argparse.Namespace) -> ReadPhoto:
    """The photo of args.input, with its depth map where it has one. Raises InputError."""
    return _read_whole(args) if has_depth(args) else _read_object(args)


def photo_scene(args: argparse.Namespace, source: ReadPhoto, device: str, watch: Stopwatch, panel: Panel) -> Gaussians:
    """The Gaussians of a photo that was read: of its object, by the network, or of all that it shows. Raises
    InputError."""
    if source.refused is not None:
        return _whole_instead(args, source, device, watch, panel)
    scene = _scene_of_whole if source.is_whole else _scene_of_object
    return scene(args, source, device, watch, panel)


def _read_object(args: argparse.Namespace) -> ReadPhoto:
    """A photo whose object is cut out; or all of it, where none is and there is a network for its depths, which
    args.depth says then."""
    from lightfield_gs.io.images import read_picture
    from lightfield_gs.photo.load import NoCutOut, photo_of

    picture = read_picture(args.input)
    side = depth_side(picture.pixels)
    notes = _other_ways(args, picture, side)
    try:
        photo = photo_of(
            args.input,
            picture,
            args.mask,
            remove_background=args.remove_background,
            map_orientation=args.map_orientation,
        )
    except InputError as error:
        ways = [words.removeprefix(f"{args.input}: ") for words in notes]
        if not isinstance(error, NoCutOut):
            raise InputError("; ".join([str(error), *ways[: side is not None]])) from None
        refused = NoCutOut("; ".join([str(error), *ways]))
        of_network = (args.checkpoint, args.detail, args.detail_budget)
        if side is not None or any(value is not None for value in of_network):
            raise refused from None
        return _read_whole_instead(args, refused)
    return ReadPhoto(photo, notes=notes)


def _other_ways(args: argparse.Namespace, picture: Picture, side: str | None) -> list[str]:
    """Lines on what a picture may be beside a photo, and what its file holds and others beside it, that is not used;
    side: the half that looks like a depth map, which comes first."""
    from lightfield_gs.io.depth_names import depth_maps_beside
    from lightfield_gs.photo.embedded_depth import notes_inside

    notes = []
    if side is not None:
        notes.append(
            f"{args.input}: its {side} half is grey, as a photo's depth map beside it would be: --rgbd {side} takes it "
            "so"
        )
    notes += _notes_on_eyes(args, picture)
    notes += notes_inside(args.input, is_depth_used=False)
    some = [path.name for path in islice(args.input.parent.iterdir(), _MOST_BESIDE)]
    beside = depth_maps_beside(some) if len(some) < _MOST_BESIDE else {}
    if maps := beside.get(args.input.name):
        notes.append(f"{args.input}: {maps[0]} beside it looks like its depth map: --depth takes it")
    return notes


def _notes_on_eyes(args: argparse.Namespace, picture: Picture) -> list[str]:
    """A line on a picture that looks like a stereo pair."""
    from lightfield_gs.photo.side_by_side import stereo_layout

    layout = None if quilt_in_name(args.input) else stereo_layout(picture.pixels)
    if layout is None:
        return []
    return [
        f"{args.input}: it looks like a stereo pair, two eyes' pictures {layout}, and is taken for one photo; give one "
        "of them alone"
    ]


def _scene_of_object(
    args: argparse.Namespace, source: ReadPhoto, device: str, watch: Stopwatch, panel: Panel
) -> Gaussians:
    from lightfield_gs.models.detail_level import detail_level

    photo = source.photo
    network = network_of(args.checkpoint, device)
    watch.lap("load")
    detail, budget = detail_given(args)
    gaussians = network.predict(photo.pixels, detail, panel, budget)
    watch.lap("network")
    level = detail_level(detail, network.config, max(photo.pixels.shape[:2]), panel, budget)
    _say(args, photo, [detail_words(level, network.config)], source.notes)
    return gaussians


def _read_whole_instead(args: argparse.Namespace, refused: InputError) -> ReadPhoto:
    """All of a photo in which no object is cut out, for estimated depths. Raises `refused` where there is no network
    for them."""
    from lightfield_gs.photo.depth_network import is_installed

    if not is_installed():
        raise refused
    args.depth = AUTO
    with _tried(refused):
        return replace(_read_whole(args), refused=refused)


def _whole_instead(
    args: argparse.Namespace, source: ReadPhoto, device: str, watch: Stopwatch, panel: Panel
) -> Gaussians:
    with _tried(source.refused):
        gaussians = _scene_of_whole(args, source, device, watch, panel)
    note(
        f"{args.input} has no cut-out and no plain background: it is shown as a whole scene, as with --depth auto; for "
        "one object give --mask FILE or --remove-background"
    )
    return gaussians


@contextmanager
def _tried(refused: InputError | None) -> Iterator[None]:
    """Puts why no object was cut out before what is wrong with the whole photo."""
    try:
        yield
    except InputError as error:
        raise InputError(f"{refused}; that was tried: {error}") from None


def _read_whole(args: argparse.Namespace) -> ReadPhoto:
    """All that a photo shows, with its depth map unless that is estimated."""
    from lightfield_gs.io.images import read_picture
    from lightfield_gs.photo.embedded_depth import notes_inside
    from lightfield_gs.photo.load import photo_of
    from lightfield_gs.photo.rgbd import check_photo_size

    picture = read_picture(args.input)
    is_inside = is_depth_inside(args)
    side = None if args.depth is not None or is_inside else args.rgbd or depth_side(picture.pixels, is_named=True)
    if side is None and args.depth is None and not is_inside:
        raise InputError(
            f"{args.input}: its name says that its depth map is in it, and none of its halves is grey beside one in "
            "colour; say which it is with --rgbd, or rename it"
        )
    colour = picture if side is None else replace(picture, pixels=halves(args.input, picture.pixels, side)[0])
    check_photo_size(str(args.input), *colour.pixels.shape[:2])
    photo = photo_of(
        args.input,
        colour,
        args.mask,
        remove_background=args.remove_background,
        whole=True,
        map_orientation=args.map_orientation,
    )
    notes = notes_inside(args.input, is_depth_used=is_inside or not is_estimated(args))
    notes += [] if side else _notes_on_eyes(args, colour)
    if is_estimated(args):
        return ReadPhoto(photo, is_whole=True, notes=notes)
    if is_inside:
        depth = depth_within(args, photo)
    else:
        depth = depth_of_file(args, photo) if side is None else depth_beside(args, picture, side)
    return ReadPhoto(photo, is_whole=True, depth=depth, notes=notes)


def _scene_of_whole(
    args: argparse.Namespace, source: ReadPhoto, device: str, watch: Stopwatch, panel: Panel
) -> Gaussians:
    import torch

    from lightfield_gs.photo.rgbd import check_depth_size, from_depth, known_camera

    photo, depth = source.photo, source.depth
    if depth is None:
        watch.lap("load")
        depth = depth_by_network(args, photo, device)
        check_depth_size(str(args.depth), depth.z, photo.pixels)
    height, width = photo.pixels.shape[:2]
    focal, centre, camera, notes = camera_of_photo(args, height, width, depth.focal_px)
    watch.lap("load" if source.depth is not None else "depth network")
    image = torch.from_numpy(photo.floats()).to(device)
    known = known_camera(focal, centre, height, width)
    margin, placed = place_photo(args, panel, image, torch.from_numpy(depth.z), *known)
    gaussians = from_depth(image, depth.z, focal, centre, margin_px=margin)
    watch.lap("depth")
    _say(args, photo, [depth.said, camera, *placed], source.notes + depth.notes + notes)
    return gaussians


def _say(args: argparse.Namespace, photo: Photo, more: list[str], notes: list[str]) -> None:
    for words in photo.notes + notes:
        note(words)
    height, width = photo.pixels.shape[:2]
    print(f"{args.input}: {width} x {height}, {', '.join([*photo.said, *more])}")
