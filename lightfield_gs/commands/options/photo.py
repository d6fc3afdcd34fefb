"""The scene that a command makes of a photo: an object through the network, or all of it with its depth map."""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from lightfield_gs.base.complaint import note
from lightfield_gs.base.errors import InputError
from lightfield_gs.base.options import DEPTH_INVALID, DEPTH_KINDS, DEPTH_PARTS, DETAILS, MAP_ORIENTATIONS, Detail
from lightfield_gs.base.stopwatch import Stopwatch
from lightfield_gs.commands.options.estimated import AUTO, add_depth_model, depth_by_network, is_estimated
from lightfield_gs.commands.options.placing import add_fit, place_photo
from lightfield_gs.commands.options.values import numbers
from lightfield_gs.photo.side_by_side import depth_side, halves, is_named_so

if TYPE_CHECKING:
    from lightfield_gs.io.images import Picture
    from lightfield_gs.models.config import ModelConfig
    from lightfield_gs.models.detail_level import DetailLevel
    from lightfield_gs.panels.panel import Panel
    from lightfield_gs.photo.depth import DepthMap, DepthNumbers
    from lightfield_gs.photo.load import Photo
    from lightfield_gs.scene.gaussians import Gaussians

# How a depth map beside its photo is taken when nothing else is said: bright is near, as Looking Glass has it
_BESIDE_KIND, _BESIDE_LIMITS = "disparity", (1.0, 1.6)
_OFF_CENTRE = 0.1  # a principal point that is farther off the middle, in sides of the photo, may be another photo's
# Angles of the longer side that are usual, and those beyond which intrinsics must be in other units
_USUAL_ANGLES_DEG, _ANGLES_DEG = (10.0, 130.0), (1.0, 175.0)


def add_depth(add: Callable[..., argparse.Action]) -> None:
    """The depth map of a photo, and what its numbers mean."""
    add(
        "--depth",
        type=Path,
        metavar="FILE|auto",
        help="depth map of the photo, of its size: the whole scene is shown, "
        "without the network; a grey .png (8 or 16 bits), .exr or .tif, or a .npy or .npz of numbers [H,W]; auto: a "
        "network of transformers estimates it (pip install 'lightfield-gs[depth]'; downloads 99 MB once)",
    )
    add_depth_model(add)
    add(
        "--depth-kind",
        choices=DEPTH_KINDS,
        help="what its numbers are: distance, along the camera's "
        "axis (default), or disparity, 1 / distance, as most networks give it (bright is near)",
    )
    add(
        "--depth-range",
        type=numbers(2),
        metavar="NEAR,FAR",
        help="distances, in any unit, at the ends of the file's "
        "full scale (0..255, 0..65535, floats 0..1); their ratio sets how deep the scene looks",
    )
    add(
        "--depth-scale",
        type=float,
        metavar="S",
        help="in place of a range: distance = S * number, or S / number of a "
        "disparity; 0.001 for millimetres to metres (default for floats: 1); the distance 0 is no measurement",
    )
    add(
        "--depth-invalid",
        choices=DEPTH_INVALID,
        help="what infinite distances and the disparity 0 are: far away "
        "(default), or holes, as NaN and the distance 0 always are",
    )
    add(
        "--rgbd",
        choices=DEPTH_PARTS,
        help="in place of --depth: the half of the photo that is its depth map (found by "
        "itself for names like photo_rgbd.png); bright is near and --depth-range 1,1.6 when not said",
    )
    add(
        "--map-orientation",
        choices=MAP_ORIENTATIONS,
        help="of --mask and --depth for a photo that its Exif "
        "orientation turns: as the photo's file has its pixels, or as it is seen (default: by their size)",
    )
    add(
        "--fov",
        type=float,
        metavar="DEG",
        help="angle that the photo's longer side takes, degrees (default 60, "
        "unless the depth map's .npz has a focal length)",
    )
    add(
        "--intrinsics",
        type=numbers(4),
        metavar="FX,FY,CX,CY",
        help="in place of --fov: focal lengths and principal "
        "point of the photo, in its pixels, from the outer corner of the first",
    )
    add_fit(add)


def add_detail(add: Callable[..., argparse.Action]) -> None:
    """How finely the photo of an object is laid over what the network makes of it."""
    add(
        "--detail",
        type=lambda text: int(text) if text.isdecimal() else text,
        choices=(*DETAILS, "none"),
        help="resolution of the photo on the object: 1, 2 or 4 times the network's, none for the network's own soft "
        "colours, or auto, what a view of the panel can show (default auto)",
    )
    add("--detail-budget", type=int, metavar="N", help="Gaussians at most for --detail auto (default 1500000)")


def detail_given(args: argparse.Namespace) -> tuple[Detail | None, int]:
    """Detail and budget of SplatterNet.predict, by the options."""
    from lightfield_gs.models.detail_level import DEFAULT_BUDGET

    detail: Detail | None = None if args.detail == "none" else args.detail or "auto"
    return detail, DEFAULT_BUDGET if args.detail_budget is None else args.detail_budget


def has_depth(args: argparse.Namespace) -> bool:
    """Whether the photo comes with its depths, in a file or beside it in the picture, or they are to be estimated."""
    return args.depth is not None or args.rgbd is not None or is_named_so(args.input)


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
    _say(args, photo, [_words(level, network.config)], [f"{args.input}: {hint}"] if side else [])
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


def _words(level: DetailLevel | None, config: ModelConfig) -> str:
    if level is None:
        return "detail none: the network's own Gaussians"
    side = level.factor * config.image_size_px
    return f"detail {level.factor}: the object's square at {side} x {side} px"


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
        depth = _depth_file(args, photo) if side is None else _depth_beside(args, picture, side)
    check_depth_size(str(args.depth), depth.z, photo.pixels)
    height, width = photo.pixels.shape[:2]
    focal, centre, camera, notes = _camera(args, height, width, depth.focal_px)
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


def _depth_file(args: argparse.Namespace, photo: Photo) -> DepthMap:
    from lightfield_gs.photo.depth import depth_map, read_numbers
    from lightfield_gs.photo.orientation import turned_with_photo

    def turn(numbers: DepthNumbers):
        return turned_with_photo(
            str(args.depth),
            numbers.values,
            numbers.orientation,
            photo.pixels.shape[:2],
            photo.orientation,
            args.map_orientation,
        )

    depth = depth_map(
        args.depth,
        read_numbers(args.depth),
        args.depth_kind,
        scale=args.depth_scale,
        limits=args.depth_range,
        invalid=args.depth_invalid or "far",
        turn=turn,
    )
    return replace(depth, said=f"depth by {args.depth.name}: {depth.said}")


def _depth_beside(args: argparse.Namespace, picture: Picture, side: str) -> DepthMap:
    from lightfield_gs.photo.depth import depth_map, grey_numbers

    numbers = grey_numbers(f"{args.input}: its {side} half", halves(args.input, picture.pixels, side)[1])
    limits = args.depth_range
    if limits is None and args.depth_scale is None:
        limits = _BESIDE_LIMITS
    kind = args.depth_kind or (_BESIDE_KIND if limits is not None else None)
    depth = depth_map(
        args.input, numbers, kind, scale=args.depth_scale, limits=limits, invalid=args.depth_invalid or "far"
    )
    assumed = [
        name
        for name, value in (
            ("--depth-kind", args.depth_kind),
            ("--depth-range", args.depth_range),
            ("--rgbd", args.rgbd),
        )
        if value is None and args.depth_scale is None
    ]
    said = f"depth by its {side} half: {depth.said}" + (f" (assumed; {', '.join(assumed)})" if assumed else "")
    return replace(depth, said=said)


def _camera(args: argparse.Namespace, height: int, width: int, focal_px: float | None) -> tuple:
    """Focal lengths and principal point for from_depth, words for them, and notes; focal_px: of the depth's file."""
    from lightfield_gs.photo.rgbd import FIELD_OF_VIEW_DEG, focal_length_px

    if args.intrinsics is not None:
        return args.intrinsics[:2], args.intrinsics[2:], *_checked_intrinsics(args.intrinsics, height, width)
    if args.fov is not None:
        return (focal_length_px(args.fov, height, width),) * 2, None, f"field of view {args.fov:g} degrees", []
    if focal_px is not None:
        _, notes = _checked_intrinsics((focal_px, focal_px, width / 2, height / 2), height, width)
        return (focal_px,) * 2, None, f"focal length {focal_px:.5g} px, of {args.depth.name}", notes
    return None, None, f"field of view {FIELD_OF_VIEW_DEG:g} degrees (assumed; --fov)", []


def _checked_intrinsics(intrinsics: tuple[float, ...], height: int, width: int) -> tuple[str, list[str]]:
    """Words for intrinsics, and notes on what is unusual; raises InputError where they cannot be this photo's."""
    fx, fy, cx, cy = intrinsics
    angle = 2 * math.degrees(math.atan(max(width / fx, height / fy) / 2))
    off = max(abs(cx / width - 0.5), abs(cy / height - 0.5))
    at = f"{fx:g},{fy:g},{cx:g},{cy:g} of a photo of {width} x {height}"
    if off > 0.5 or not _ANGLES_DEG[0] <= angle <= _ANGLES_DEG[1]:
        why = (
            f"the principal point {cx:g},{cy:g} is outside it"
            if off > 0.5
            else f"the longer side would take {angle:.4g} degrees"
        )
        raise InputError(
            f"--intrinsics: {why} ({at}); expected pixels of this photo, upright: scale them with its "
            "size, or give --fov DEG"
        )
    notes = []
    if off > _OFF_CENTRE:
        notes.append(
            f"--intrinsics {at}: the principal point is far off its middle; are they of another size, or of "
            "the photo before it was turned?"
        )
    if not _USUAL_ANGLES_DEG[0] <= angle <= _USUAL_ANGLES_DEG[1] or not 0.5 <= fx / fy <= 2:
        notes.append(
            f"--intrinsics {at}: the longer side takes {angle:.4g} degrees, fx / fy is {fx / fy:.3g}; are "
            "they of another size?"
        )
    return f"focal lengths {fx:g},{fy:g} px", notes
