"""The scene that a command makes of a photo: an object through the network, or all of it with its depth map."""

from __future__ import annotations

import argparse
import math
import re
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from functools import lru_cache
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING

from lightfield_gs.app.photo_camera import camera_of_photo
from lightfield_gs.app.photo_depth import (
    AUTO,
    depth_beside,
    depth_by_network,
    depth_of_file,
    depth_within,
    has_depth,
    is_depth_inside,
    is_estimated,
)
from lightfield_gs.base.cli_messages import note
from lightfield_gs.base.errors import InputError
from lightfield_gs.base.options import FITS, Detail
from lightfield_gs.base.stopwatch import Stopwatch
from lightfield_gs.photo.side_by_side import depth_side, split_halves

if TYPE_CHECKING:
    from torch import Tensor

    from lightfield_gs.io.images import Picture
    from lightfield_gs.models.config import ModelConfig
    from lightfield_gs.models.detail import DetailLevel
    from lightfield_gs.models.replayed import ReplayedNet
    from lightfield_gs.panels.panel import Panel
    from lightfield_gs.panels.rig import Rig
    from lightfield_gs.photo.depth import DepthMap
    from lightfield_gs.photo.load import Photo
    from lightfield_gs.photo.margin import PhotoPlacement
    from lightfield_gs.scene.gaussians import Gaussians

_MOST_BESIDE = 200  # files in the folder of a photo up to which a depth map is looked for: each of a batch does so

_MOST_CROPPED = 0.34  # share of the photo beyond which all of it is shown when nothing was said
_TRANSPARENT = 0.5  # alpha below which a pixel of the photo's border is cut out: nothing is made up around a cut-out


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
    from lightfield_gs.photo.load import NoCutOut, cut_out_photo

    picture = read_picture(args.input)
    side = depth_side(picture.pixels)
    notes = _other_ways(args, picture, side)
    try:
        photo = cut_out_photo(
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
    from lightfield_gs.photo.embedded_depth import embedded_notes

    notes = []
    if side is not None:
        notes.append(
            f"{args.input}: its {side} half is grey, as a photo's depth map beside it would be: --rgbd {side} takes it "
            "so"
        )
    notes += _notes_on_eyes(args, picture)
    notes += embedded_notes(args.input, is_depth_used=False)
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
    from lightfield_gs.photo.detail_level import detail_level

    photo = source.photo
    network = network_of(args.checkpoint, device)
    watch.lap("load")
    detail, budget = detail_given(args)
    level = detail_level(detail, network.config, max(photo.pixels.shape[:2]), panel, budget)
    gaussians = network.predict(photo.pixels, level)
    watch.lap("network")
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
    from lightfield_gs.photo.embedded_depth import embedded_notes
    from lightfield_gs.photo.load import cut_out_photo
    from lightfield_gs.photo.rgbd import check_photo_size

    picture = read_picture(args.input)
    is_inside = is_depth_inside(args)
    side = None if args.depth is not None or is_inside else args.rgbd or depth_side(picture.pixels, is_named=True)
    if side is None and args.depth is None and not is_inside:
        raise InputError(
            f"{args.input}: its name says that its depth map is in it, and none of its halves is grey beside one in "
            "colour; say which it is with --rgbd, or rename it"
        )
    colour = picture if side is None else replace(picture, pixels=split_halves(args.input, picture.pixels, side)[0])
    check_photo_size(str(args.input), *colour.pixels.shape[:2])
    photo = cut_out_photo(
        args.input,
        colour,
        args.mask,
        remove_background=args.remove_background,
        whole=True,
        map_orientation=args.map_orientation,
    )
    notes = embedded_notes(args.input, is_depth_used=is_inside or not is_estimated(args))
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
    _say(args, photo, [depth.description, camera, *placed], source.notes + depth.notes + notes)
    return gaussians


def _say(args: argparse.Namespace, photo: Photo, more: list[str], notes: list[str]) -> None:
    for words in photo.notes + notes:
        note(words)
    height, width = photo.pixels.shape[:2]
    print(f"{args.input}: {width} x {height}, {', '.join([*photo.messages, *more])}")


def network_of(checkpoint: Path | None, device: str) -> ReplayedNet:
    """The network of --checkpoint, on the device; None: the one inside. The last one is kept, and read again when its
    file is another. Raises InputError."""
    version = None
    if checkpoint is not None:
        with suppress(OSError):  # its reader says what is wrong with it
            found = checkpoint.stat()
            version = found.st_size, found.st_mtime_ns
    return _network(checkpoint, version, device)


@lru_cache(maxsize=1)
def _network(checkpoint: Path | None, version: tuple[int, int] | None, device: str) -> ReplayedNet:
    import torch

    from lightfield_gs.models import SplatterNet
    from lightfield_gs.models.replayed import ReplayedNet

    with torch.inference_mode(False):  # whose weights could not be used outside
        return ReplayedNet(SplatterNet.from_pretrained(checkpoint).to(device))


def detail_given(args: argparse.Namespace) -> tuple[Detail | None, int]:
    """Detail and budget of detail_level, by the options."""
    from lightfield_gs.photo.detail_level import DEFAULT_BUDGET

    detail: Detail | None = None if args.detail == "none" else args.detail or "auto"
    return detail, DEFAULT_BUDGET if args.detail_budget is None else args.detail_budget


def detail_words(level: DetailLevel | None, config: ModelConfig) -> str:
    """What was decided, in words."""
    if level is None:
        return "detail none: the network's own Gaussians"
    side = level.factor * config.image_size_px
    return f"detail {level.factor}: the object's square at {side} x {side} px"


def place_photo(
    args: argparse.Namespace,
    panel: Panel,
    image: Tensor,
    depth: Tensor,
    focal: tuple[float, float],
    centre: tuple[float, float],
) -> tuple[tuple[int, int, int, int], list[str]]:
    """The margin that from_depth makes up, and words on it; the rig is kept in args.placed for `photo_rig`.

    image: [H, W, 4]; depth: [H, W], z. Of a photo whose border is cut out nothing is made up.
    """
    args.placed = None
    alpha = image[..., 3]
    border = min(float(part.min()) for part in (alpha[0], alpha[-1], alpha[:, 0], alpha[:, -1]))
    if border < _TRANSPARENT or not bool(((depth > 0) & depth.isfinite()).any()):
        return (0, 0, 0, 0), []
    from lightfield_gs.photo.margin import fit_to_panel

    def placed(fit: str) -> PhotoPlacement:
        return fit_to_panel(
            depth,
            focal,
            centre,
            panel,
            fit,
            widest_tan=_widest_tan(args, panel),
            zoom=getattr(args, "zoom", None) or 1,
            on_near=is_estimated(args),
        )

    fit = args.fit or FITS[0]
    found = placed(fit)
    if args.fit is None and found.cropped > _MOST_CROPPED:
        fit = FITS[1]
        found = placed(fit)
    args.placed = found
    words = f"fit {fit}: {found.cropped:.0%} of it cropped, {found.made_up:.0%} of the panel made up"
    return found.margin_px, [words + ("" if args.fit else " (assumed; --fit cover, --fit contain)")]


def photo_rig(args: argparse.Namespace, panel: Panel, gaussians: Gaussians) -> Rig:
    """The rig of a photo: as it was placed, or fitted to what it shows; of one whose depths are a network's, whose
    scale means little, with the panel in the subject. Raises InputError."""
    from lightfield_gs.panels import framing

    placed: PhotoPlacement | None = getattr(args, "placed", None)
    rig = framing.frame_photo(gaussians, panel) if placed is None else placed.rig
    return framing.focus_on_subject(rig, gaussians, panel) if is_estimated(args) else rig


def _widest_tan(args: argparse.Namespace, panel: Panel) -> float:
    """tan(cone / 2) of the outermost views, as --cone and --depth-amount have it."""
    cone = panel.cone_deg if getattr(args, "cone", None) is None else args.cone
    amount = 1.0 if getattr(args, "depth_amount", None) is None else args.depth_amount
    return amount * math.tan(math.radians(cone) / 2)
