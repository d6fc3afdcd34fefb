"""The scene that a command makes of a photo: an object through the network, or all of it with its depth map."""

from __future__ import annotations

import argparse
from dataclasses import replace
from typing import TYPE_CHECKING

from lightfield_gs.base.complaint import note
from lightfield_gs.base.errors import InputError
from lightfield_gs.base.stopwatch import Stopwatch
from lightfield_gs.commands.options.depth_map import depth_beside, depth_of_file
from lightfield_gs.commands.options.detail import detail_given, detail_words
from lightfield_gs.commands.options.estimated import AUTO, depth_by_network, is_estimated
from lightfield_gs.commands.options.photo_camera import camera_of_photo
from lightfield_gs.commands.options.placing import place_photo
from lightfield_gs.photo.side_by_side import depth_side, halves

if TYPE_CHECKING:
    from lightfield_gs.panels.panel import Panel
    from lightfield_gs.photo.load import Photo
    from lightfield_gs.scene.gaussians import Gaussians


def photo_object(args: argparse.Namespace, device: str, watch: Stopwatch, panel: Panel) -> Gaussians:
    """The Gaussians of the object in a photo, by the network; or of all that it shows, where no object is cut out and
    there is a network for its depths, which args.depth says then. Raises InputError."""
    from lightfield_gs.io.images import read_picture
    from lightfield_gs.models import SplatterNet
    from lightfield_gs.models.detail_level import detail_level
    from lightfield_gs.photo.load import NoCutOut, photo_of

    picture = read_picture(args.input)
    side = depth_side(picture.pixels)
    hint = f"its {side} half is grey, as a photo's depth map beside it would be: --rgbd {side} takes it so"
    try:
        photo = photo_of(
            args.input,
            picture,
            args.mask,
            remove_background=args.remove_background,
            map_orientation=args.map_orientation,
        )
    except InputError as error:
        if side is not None:
            raise InputError(f"{error}; {hint}") from None
        of_network = (args.checkpoint, args.detail, args.detail_budget)
        if not isinstance(error, NoCutOut) or any(value is not None for value in of_network):
            raise
        return _whole_instead(args, device, watch, panel, error)
    del picture
    network = SplatterNet.from_pretrained(args.checkpoint).to(device)
    watch.lap("load")
    detail, budget = detail_given(args)
    gaussians = network.predict(photo.pixels, detail, panel, budget)
    watch.lap("network")
    level = detail_level(detail, network.config, max(photo.pixels.shape[:2]), panel, budget)
    _say(args, photo, [detail_words(level, network.config)], [f"{args.input}: {hint}"] if side else [])
    return gaussians


def _whole_instead(
    args: argparse.Namespace, device: str, watch: Stopwatch, panel: Panel, refused: InputError
) -> Gaussians:
    """The Gaussians of a photo in which no object is cut out, with estimated depths. Raises `refused` where there is no
    network for them."""
    from lightfield_gs.photo.depth_network import is_installed

    if not is_installed():
        raise refused
    args.depth = AUTO
    try:
        gaussians = photo_scene(args, device, watch, panel)
    except InputError as error:
        raise InputError(f"{refused}; that was tried: {error}") from None
    note(
        f"{args.input} has no cut-out and no plain background: it is shown as a whole scene, as with --depth auto; for "
        "one object give --mask FILE or --remove-background"
    )
    return gaussians


def photo_scene(args: argparse.Namespace, device: str, watch: Stopwatch, panel: Panel) -> Gaussians:
    """The Gaussians of all that a photo with depths shows. Raises InputError."""
    import torch

    from lightfield_gs.io.images import read_picture
    from lightfield_gs.photo.load import photo_of
    from lightfield_gs.photo.rgbd import check_depth_size, from_depth, known_camera

    picture = read_picture(args.input)
    side = None if args.depth is not None else args.rgbd or depth_side(picture.pixels)
    if side is None and args.depth is None:
        raise InputError(
            f"{args.input}: its name says that its depth map is in it, and none of its halves is grey; "
            "say which it is with --rgbd, or rename it"
        )
    colour = picture if side is None else replace(picture, pixels=halves(args.input, picture.pixels, side)[0])
    photo = photo_of(
        args.input,
        colour,
        args.mask,
        remove_background=args.remove_background,
        whole=True,
        map_orientation=args.map_orientation,
    )
    if is_estimated(args):
        watch.lap("load")
        depth = depth_by_network(args, photo, device)
    else:
        depth = depth_of_file(args, photo) if side is None else depth_beside(args, picture, side)
    check_depth_size(str(args.depth), depth.z, photo.pixels)
    height, width = photo.pixels.shape[:2]
    focal, centre, camera, notes = camera_of_photo(args, height, width, depth.focal_px)
    watch.lap("depth network" if is_estimated(args) else "load")
    image = torch.from_numpy(photo.floats()).to(device)
    known = known_camera(focal, centre, height, width)
    margin, placed = place_photo(args, panel, image, torch.from_numpy(depth.z), *known)
    gaussians = from_depth(image, depth.z, focal, centre, margin_px=margin)
    watch.lap("depth")
    _say(args, photo, [depth.said, camera, *placed], depth.notes + notes)
    return gaussians


def _say(args: argparse.Namespace, photo: Photo, more: list[str], notes: list[str]) -> None:
    for words in photo.notes + notes:
        note(words)
    height, width = photo.pixels.shape[:2]
    print(f"{args.input}: {width} x {height}, {', '.join([*photo.said, *more])}")
