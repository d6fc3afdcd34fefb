"""The scene that a command makes of a photo: an object through the network, or the whole photo with its depth map."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from functools import lru_cache
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, cast

from lightfield_gs.app.options import AUTO, FLAT, LookOptions, PhotoOptions
from lightfield_gs.app.photo_depth import (
    depth_beside,
    depth_by_network,
    depth_camera,
    depth_from_file,
    depth_within,
    field_of_view_deg,
    flat_depth,
    has_depth,
    is_depth_inside,
    without_holes,
)
from lightfield_gs.app.photo_pair import MatchedPair, guessed_pair, match_pair, pair_depth, pair_of
from lightfield_gs.base.cli_messages import Stopwatch, note, say
from lightfield_gs.base.errors import InputError
from lightfield_gs.base.options import Detail, Fit
from lightfield_gs.io.file_kinds import refuse_unsupported
from lightfield_gs.io.stereo_names import PairLayout
from lightfield_gs.photo.side_by_side import depth_side, split_halves

if TYPE_CHECKING:
    from torch import Tensor

    from lightfield_gs.io.images import Picture
    from lightfield_gs.models.config import ModelConfig
    from lightfield_gs.models.detail import DetailLevel
    from lightfield_gs.models.splatter_net import ReplayedNet
    from lightfield_gs.panels.panel import Panel
    from lightfield_gs.panels.rig import Rig
    from lightfield_gs.photo.cut_out import NoCutOut
    from lightfield_gs.photo.depth import DepthMap
    from lightfield_gs.photo.margin import Margin, PanelFit
    from lightfield_gs.photo.photo import Photo
    from lightfield_gs.photo.second_eye import SecondEye
    from lightfield_gs.photo.steady_depth import PictureEstimate
    from lightfield_gs.photo.stereo_pair import Pair
    from lightfield_gs.scene.gaussians import Gaussians

_MOST_BESIDE = 200  # files in a photo's folder up to which a depth map is looked for: each photo of a batch looks
# Each pixel of a whole photo becomes a Gaussian. A view of a panel has fewer: 0.3 million pixels on the default panel
_MOST_WHOLE_PX = 1_500_000
_TRANSPARENT = 0.5  # alpha below which a pixel of the photo's border is cut out: no margin is made for a cut-out


@dataclass
class ReadPhoto:
    """The files of a photo, read; nothing is computed yet.

    Attributes:
        path: of the photo.
        options: those given, or with the depth AUTO or FLAT where no object could be cut out.
        photo: its pixels.
        is_whole: whether the whole photo is shown, not an object in it.
        depth: the depth map of a whole photo. None: a network estimates it.
        estimate: the network's numbers, where they were computed before.
        matched: of a stereo pair, both eyes' pictures.
        second: of a stereo pair, the other eye.
        refused: why no object was cut out, where the whole photo is shown instead.
        notes: doubts, for the user.
        lines: further decisions, for the user.
    """

    path: Path
    options: PhotoOptions
    photo: Photo
    is_whole: bool = False
    depth: DepthMap | None = None
    estimate: PictureEstimate | None = None
    matched: MatchedPair | None = None
    second: SecondEye | None = None
    refused: NoCutOut | None = None
    notes: list[str] = field(default_factory=list)
    lines: list[str] = field(default_factory=list)


@dataclass(frozen=True)
class PhotoPlacement:
    """The origin of a photo's scene, for its rig and its metadata.

    Attributes:
        options: as they were used.
        is_whole: whether the whole photo is shown.
        placed: rig and margin of a whole photo without a cut-out border.
    """

    options: PhotoOptions
    is_whole: bool = False
    placed: PanelFit | None = None


def quilt_in_name(path: Path) -> re.Match[str] | None:
    """Return columns and rows in a quilt's name, <name>_qs<columns>x<rows>a<aspect>; None of other names."""
    return re.search(r"_qs(\d+)x(\d+)a\d", path.stem)


def read_photo(path: Path, options: PhotoOptions) -> ReadPhoto:
    """Read a photo, and its depth map where it has one. Raises InputError."""
    return _read_whole(path, options) if has_depth(path, options) else _read_object(path, options)


def read_frame(path: Path, picture: Picture, options: PhotoOptions) -> ReadPhoto:
    """Return a picture of a film as it is read, without a file and without guesses.

    Args:
        path: Its name, for messages.
        picture: Its pixels.
        options: As the first picture settled them: an object is cut out unless they name depths or a pair.

    Raises:
        InputError: Nothing can be cut out, or the depths cannot be read.
    """
    from lightfield_gs.photo.load import cut_out_photo

    if (pair := pair_of(path, options)) is not None:
        return _pair_of_picture(path, picture, options, pair)
    if options.depth is not None or options.rgbd is not None:
        return _whole_of_picture(path, picture, options, options.rgbd)
    clean = options.clean_edges is not False
    photo = cut_out_photo(path, picture, remove_background=options.remove_background, clean_edges=clean)
    return ReadPhoto(path, options, photo)


def photo_scene(
    source: ReadPhoto, panel: Panel, look: LookOptions, device: str, watch: Stopwatch
) -> tuple[Gaussians, PhotoPlacement]:
    """Make the Gaussians of a photo: of its object, by the network, or of all that it shows. Raises InputError."""
    if not source.is_whole:
        return _scene_of_object(source, panel, device, watch), PhotoPlacement(source.options)
    if source.refused is None:
        return _scene_of_whole(source, panel, look, device, watch)
    with _trying(source.path, source.refused):
        scene = _scene_of_whole(source, panel, look, device, watch)
    if source.options.is_flat:
        how = "it is shown flat, as with --depth flat; for estimated depth give --depth auto"
    else:
        how = "it is shown as a whole scene, as with --depth auto"
    note(f"{source.refused.reason}: {how}; for one object give --mask FILE or --remove-background")
    return scene


def photo_rig(photo: PhotoPlacement, panel: Panel, gaussians: Gaussians) -> Rig:
    """Return the rig of a photo: as it was placed, or framed around the Gaussians.

    The panel's plane goes through the subject of a whole photo. Raises InputError.
    """
    from lightfield_gs.panels.framing import focus_on_subject
    from lightfield_gs.panels.rig import frame_photo

    rig = frame_photo(gaussians, panel) if photo.placed is None else photo.placed.rig
    return focus_on_subject(rig, gaussians, panel) if photo.is_whole else rig


def _read_object(path: Path, options: PhotoOptions) -> ReadPhoto:
    """Read a photo and cut its object out; where that fails and depths can be estimated, read the whole photo."""
    from lightfield_gs.io.images import read_picture
    from lightfield_gs.photo.cut_out import NoCutOut
    from lightfield_gs.photo.load import cut_out_photo
    from lightfield_gs.photo.stereo_matching import PairMismatch

    picture = read_picture(path)
    if not quilt_in_name(path) and (guess := guessed_pair(options, picture)) is not None:
        try:
            return _read_pair(path, options, guess)
        except PairMismatch:
            note(f"{path}: its halves do not match as two eyes' pictures: it is one picture (else: --stereo-in sbs)")
    side = depth_side(picture.pixels)
    notes = _other_ways(path, picture, side)
    try:
        photo = cut_out_photo(
            path,
            picture,
            options.mask,
            remove_background=options.remove_background,
            clean_edges=options.clean_edges is not False,
            map_orientation=options.map_orientation,
        )
    except InputError as error:
        ways = [words.removeprefix(f"{path}: ") for words in notes]
        if not isinstance(error, NoCutOut):
            raise InputError("; ".join([str(error), *ways[: side is not None]])) from None
        if side is not None:
            words = f"{error.reason}; {ways[0]}; to show all of it as one photo, give depth=auto"
            raise InputError("; ".join([words, *ways[1:]])) from None
        refused = NoCutOut(error.reason, "; ".join([str(error).removeprefix(error.reason), *ways]), error.is_page)
        for_network = (options.checkpoint, options.detail, options.detail_budget)
        if any(value is not None for value in for_network):
            raise refused from None
        return _read_whole_instead(path, options, refused)
    return ReadPhoto(path, options, photo, notes=notes)


def _other_ways(path: Path, picture: Picture, side: str | None) -> list[str]:
    """Return notes on depth maps of a photo that are not used, and on other kinds of picture that it may be.

    Args:
        side: The half that looks like a depth map; its note comes first.
    """
    from lightfield_gs.io.depth_names import depth_maps_beside
    from lightfield_gs.photo.embedded_depth import embedded_notes

    notes = []
    if side is not None:
        notes.append(
            f"{path}: its {side} half is grey, as a photo's depth map beside it would be: --rgbd {side} takes it so"
        )
    notes += _notes_on_eyes(path, picture)
    notes += embedded_notes(path, is_depth_used=False)
    some = [file.name for file in islice(path.parent.iterdir(), _MOST_BESIDE)]
    beside = depth_maps_beside(some) if len(some) < _MOST_BESIDE else {}
    if maps := beside.get(path.name):
        notes.append(f"{path}: {maps[0]} beside it looks like its depth map: --depth takes it")
    return notes


def _notes_on_eyes(path: Path, picture: Picture) -> list[str]:
    """Return a note on a picture that looks like a stereo pair."""
    from lightfield_gs.photo.side_by_side import stereo_layout

    layout = None if quilt_in_name(path) else stereo_layout(picture.pixels)
    if layout is None:
        return []
    return [
        f"{path}: it looks like a stereo pair, two eyes' pictures {layout}, and is taken for one photo; give one of "
        "them alone, or --stereo-in to take its depth from both"
    ]


def _scene_of_object(source: ReadPhoto, panel: Panel, device: str, watch: Stopwatch) -> Gaussians:
    from lightfield_gs.photo.detail_level import detail_level

    photo, options = source.photo, source.options
    network = load_network(options.checkpoint, device)
    watch.lap("load")
    detail, budget = network_detail(options)
    level = detail_level(detail, network.config, max(photo.pixels.shape[:2]), panel, budget)
    gaussians = network.predict(photo.pixels, level)
    watch.lap("network")
    _say(source, [detail_words(level, network.config)], source.notes)
    return gaussians


def _read_whole_instead(path: Path, options: PhotoOptions, refused: NoCutOut) -> ReadPhoto:
    """Read the whole photo: a page is flat, and others are for estimated depths.

    Raises `refused` where no network for depths is installed.
    """
    from lightfield_gs.photo.depth_network import is_installed

    if refused.is_page:
        return replace(_read_whole(path, replace(options, depth=FLAT)), refused=refused)
    if not is_installed():
        raise refused
    with _trying(path, refused):
        return replace(_read_whole(path, replace(options, depth=AUTO)), refused=refused)


@contextmanager
def _trying(path: Path, refused: NoCutOut) -> Iterator[None]:
    """Say that the whole photo was tried for want of an object in the message of an error with it."""
    try:
        yield
    except InputError as error:
        raise InputError(
            f"{refused.reason}, and could not be shown as a whole scene: "
            f"{str(error).removeprefix(f'{path}: ')}; for one object give a cut-out with mask=FILE or "
            "remove_background=True"
        ) from None


def _read_whole(path: Path, options: PhotoOptions) -> ReadPhoto:
    """Read a photo that is shown whole, with its depth map unless a network estimates it."""
    from lightfield_gs.io.images import read_picture
    from lightfield_gs.photo.embedded_depth import embedded_notes

    if (pair := pair_of(path, options)) is not None:
        return _read_pair(path, options, pair)
    picture = read_picture(path)
    is_inside = is_depth_inside(path, options)
    side = None
    if options.depth is None and not is_inside:
        side = options.rgbd or depth_side(picture.pixels, is_named=True)
        if side is None:
            raise InputError(
                f"{path}: its name says that its depth map is in it, and none of its halves is grey beside one in "
                "colour; say which it is with --rgbd, or rename it"
            )
    read = _whole_of_picture(path, picture, options, side, is_inside)
    notes = embedded_notes(path, is_depth_used=is_inside or not options.is_estimated)
    notes += [] if side or options.is_flat else _notes_on_eyes(path, picture)
    return replace(read, notes=notes)


def _whole_of_picture(
    path: Path, picture: Picture, options: PhotoOptions, side: str | None, is_inside: bool = False
) -> ReadPhoto:
    """Return a picture that is shown whole, with its depth map unless a network estimates it.

    Args:
        path: Its file, or its name.
        picture: Its pixels.
        options: Of the photo.
        side: The half of the picture that is its depth map. None: none is.
        is_inside: Whether the depth map is inside the file.
    """
    from lightfield_gs.photo.load import cut_out_photo
    from lightfield_gs.photo.photo import reduce_photo
    from lightfield_gs.photo.rgbd import check_photo_size

    colour = picture if side is None else replace(picture, pixels=split_halves(path, picture.pixels, side)[0])
    check_photo_size(str(path), *colour.pixels.shape[:2])
    photo = cut_out_photo(
        path,
        colour,
        options.mask,
        remove_background=options.remove_background,
        clean_edges=options.clean_edges is not False,
        whole=True,
        map_orientation=options.map_orientation,
    )
    reduce_photo(photo, _MOST_WHOLE_PX)
    if options.is_estimated:
        depth = None
    elif options.is_flat:
        depth = flat_depth(photo)
    elif is_inside:
        depth = depth_within(path, options, photo)
    elif side is not None:
        depth = depth_beside(path, options, picture, side, photo)
    else:
        depth = depth_from_file(cast(Path, options.depth), options, photo)
    lines: list[str] = []
    if depth is not None:
        depth, lines = without_holes(depth, options, photo)
    return ReadPhoto(path, options, photo, is_whole=True, depth=depth, lines=lines)


def _read_pair(path: Path, options: PhotoOptions, pair: PairLayout) -> ReadPhoto:
    """Read a stereo pair, which is shown whole, with the depths of both eyes."""
    from lightfield_gs.photo.stereo_pair import read_pair

    refuse_unsupported(path)
    return _matched(path, options, read_pair(path, pair))


def _pair_of_picture(path: Path, picture: Picture, options: PhotoOptions, layout: PairLayout) -> ReadPhoto:
    """Return a stereo pair in a picture without a file."""
    from lightfield_gs.photo.stereo_pair import split_pair

    return _matched(path, options, split_pair(path, picture, layout))


def _matched(path: Path, options: PhotoOptions, pair: Pair) -> ReadPhoto:
    options, photo, matched = match_pair(path, options, pair, _MOST_WHOLE_PX)
    depth, second = pair_depth(options, photo, matched)
    return ReadPhoto(path, options, photo, is_whole=True, depth=depth, matched=matched, second=second)


def _scene_of_whole(
    source: ReadPhoto, panel: Panel, look: LookOptions, device: str, watch: Stopwatch
) -> tuple[Gaussians, PhotoPlacement]:
    import torch

    from lightfield_gs.photo.rgbd import check_depth_size, from_depth, known_camera

    photo, depth, options = source.photo, source.depth, source.options
    if depth is None:
        watch.lap("load")
        depth = depth_by_network(options, photo, device, source.estimate)
        check_depth_size(str(options.depth), depth.z, photo.pixels)
    height, width = photo.size
    focal, centre, camera, notes = depth_camera(options, height, width, depth.focal_px)
    if options.is_estimated and depth.focal_px is not None and focal is not None and options.intrinsics is None:
        options = replace(options, fov=field_of_view_deg(focal, height, width))  # of pictures that follow, too
    watch.lap("load" if source.depth is not None else "depth network")
    image = torch.from_numpy(photo.floats()).to(device)
    known = known_camera(focal, centre, height, width)
    if photo.full_size is not None:
        across, down = photo.pixels.shape[1] / width, photo.pixels.shape[0] / height
        focal, centre = known = ((known[0][0] * across, known[0][1] * down), (known[1][0] * across, known[1][1] * down))
    placed, words = place_photo(options, panel, look, image, torch.from_numpy(depth.z), *known)
    margin = (0, 0, 0, 0) if placed is None else placed.margin_px
    is_blurred = options.is_smooth or (placed is not None and placed.fit == "contain")
    kind: Margin = "blur" if is_blurred else "texture"
    how = focal, centre
    gaussians = from_depth(
        image, depth.z, *how, margin_px=margin, margin=kind, second=source.second, texture=not options.is_smooth
    )
    watch.lap("depth")
    _say(source, [depth.description, camera, *words], source.notes + depth.notes + notes)
    return gaussians, PhotoPlacement(options, is_whole=True, placed=placed)


def place_photo(
    options: PhotoOptions,
    panel: Panel,
    look: LookOptions,
    image: Tensor,
    depth: Tensor,
    focal_px: tuple[float, float],
    principal_point_px: tuple[float, float],
) -> tuple[PanelFit | None, list[str]]:
    """Fit a photo to the panel's shape. A photo whose border is cut out is not placed: it needs no margin.

    Args:
        options: the options of the photo.
        panel: the panel that shows it.
        look: the cone, the amount of depth and the zoom decide how wide the margin is.
        image: [H, W, 4].
        depth: [H, W], z.
        focal_px: fx, fy of the photo.
        principal_point_px: cx, cy of the photo.

    Returns:
        Rig and margin, and words on them.
    """
    alpha = image[..., 3]
    border = min(float(part.min()) for part in (alpha[0], alpha[-1], alpha[:, 0], alpha[:, -1]))
    if border < _TRANSPARENT or not bool(((depth > 0) & depth.isfinite()).any()):
        return None, []
    from lightfield_gs.photo.margin import fit_to_panel

    cone = panel.cone_deg if look.cone is None else look.cone
    amount = 1.0 if look.depth_amount is None else look.depth_amount

    def placed(fit: Fit) -> PanelFit:
        return fit_to_panel(
            depth,
            focal_px,
            principal_point_px,
            panel,
            fit,
            widest_tan=amount * math.tan(math.radians(cone) / 2),
            zoom=look.zoom or 1,
            pan=look.pan or (0.0, 0.0),
            on_near=True,
            about_middle=options.is_in_row,
        )

    found = placed(options.fit or ("contain" if options.is_flat else "auto"))
    rest = "made up" if found.fit == "cover" else "its blurred, darker continuation"
    words = f"fit {found.fit}: {found.cropped:.0%} of it cropped, {found.made_up:.0%} of the panel {rest}"
    is_given = options.fit not in (None, "auto")
    return found, [words + ("" if is_given else " (assumed; --fit cover, --fit contain)")]


def _say(source: ReadPhoto, more: list[str], notes: list[str]) -> None:
    for words in source.photo.notes + notes:
        note(words)
    height, width = source.photo.size
    say(f"{source.path}: {width} x {height}, {', '.join([*source.photo.messages, *more])}")
    for words in source.lines:
        say(words)


def load_network(checkpoint: Path | None, device: str) -> ReplayedNet:
    """Return the network of a checkpoint (None: the package's own), on the device. Raises InputError.

    The last network is kept, and read again when its file has changed.
    """
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
    from lightfield_gs.models.splatter_net import ReplayedNet

    with torch.inference_mode(False):  # the weights could not be used outside of it otherwise
        return ReplayedNet(SplatterNet.from_pretrained(checkpoint).to(device))


def network_detail(options: PhotoOptions) -> tuple[Detail | None, int]:
    """Return detail and budget as `detail_level` takes them."""
    from lightfield_gs.photo.detail_level import DEFAULT_BUDGET

    detail = None if options.detail == "none" else cast(Detail, options.detail or "auto")
    return detail, DEFAULT_BUDGET if options.detail_budget is None else options.detail_budget


def detail_words(level: DetailLevel | None, config: ModelConfig) -> str:
    """Return words on the level of detail."""
    if level is None:
        return "detail none: the network's own Gaussians"
    side = level.factor * config.image_size_px
    return f"detail {level.factor}: the object's square at {side} x {side} px"
