"""Options of a scene: the reading of its file, and the scene that is made of a photo."""

from __future__ import annotations

import argparse
from pathlib import Path

from lightfield_gs.base.options import (
    DEPTH_INVALID,
    DEPTH_KINDS,
    DEPTH_MODEL,
    DEPTH_PARTS,
    DETAILS,
    FITS,
    MAP_ORIENTATIONS,
    STEREO_INPUTS,
)
from lightfield_gs.commands.options import groups
from lightfield_gs.commands.options.groups import Add, in_group, rarely
from lightfield_gs.commands.options.parser import numbers, whole, within

# Formats in help, short and in full
SCENES = "a scene: .ply .glb .usd .spz .sog .splat"
SCENE_FORMATS = ".ply, .glb, .gltf, .usd*, .spz, .sog or its folder, .splat, .ksplat"
SAVED_FORMATS = ".ply, .glb, .gltf, .usd*, .spz or .splat"
_time = within(-1e6, 1e6)
_lod = whole(0, 9999)
_depth_range = numbers(2)
_pixel_aspect = within(0.1, 10)
_intrinsics = numbers(4)


def add_input(add: Add, short: str = "a photo, or a scene", more: str = "") -> None:
    """Add the photo or the scene that a command shows; more: words of the help on other inputs."""
    add(
        "input",
        type=Path,
        metavar="INPUT",
        short=short,
        help=f"a photo or a file of Gaussians, as `encode` takes it{more}",
    )


def add_scene(
    add: Add,
    cutting: str,
    mask: str = "cut-out of a photo, of the same size: bright or opaque on the object",
    of_mask: str = "IMAGE",
) -> None:
    """Add the options of a scene, see `add_photo`."""
    add_photo(add, cutting, mask, of_mask)
    add_reading(add)


def add_photo(
    add: Add,
    cutting: str,
    mask: str = "cut-out of a photo, of the same size: bright or opaque on the object",
    of_mask: str = "IMAGE",
    has_maps: bool = True,
) -> None:
    """Add the options of a photo.

    Args:
        add: adds an option.
        cutting: help of --remove-background.
        mask: help of --mask.
        of_mask: placeholder of --mask.
        has_maps: whether masks and depth maps may be files; the command refuses them otherwise.
    """
    add = in_group(add, groups.PHOTO)
    add_mask = add if has_maps else rarely(add)
    add_mask("--mask", type=Path, metavar=of_mask, short="cut-out of the object: a picture, bright there", help=mask)
    add("--remove-background", action="store_true", short="cut the object out of the photo", help=cutting)
    add(
        "--clean-edges",
        action=argparse.BooleanOptionalAction,
        help="take the colour of the old background out of a cut-out's edges, where they have it (default)",
    )
    add_depth(add, has_maps)
    add_detail(add)
    add(
        "--checkpoint",
        type=Path,
        metavar="FILE",
        help="weights of the network, .safetensors (default: the weights in the package)",
    )


def add_reading(add: Add) -> None:
    """Add the options of how a file of Gaussians is read."""
    add = in_group(add, groups.SCENE)
    add(
        "--skip-invalid",
        action="store_true",
        help="leave out Gaussians with invalid values (not finite, a rotation of zeros), and print their number",
    )
    add(
        "--time",
        type=_time,
        metavar="T",
        help="time at which moving Gaussians (Spacetime Gaussians) are drawn, mostly 0..1 of their film "
        "(default: the middle; a note states it)",
    )
    add(
        "--lod",
        type=lambda text: None if text == "auto" else _lod(text),
        metavar="N|auto",
        help="level of detail of a streamed SOG, 0 being the finest. auto (default): for each part of the scene the "
        "level that it shows on the panel, if the file has the errors of its levels, as `simplify` writes them; else "
        "the finest that fits half of the free memory",
    )


def add_depth(add: Add, has_maps: bool = True) -> None:
    """Add the options of a photo's depth map, and of the meaning of its numbers; has_maps: see add_photo."""
    add = in_group(add, groups.DEPTH)
    add(
        "--depth",
        type=Path,
        metavar="FILE|auto|flat" if has_maps else "auto|flat",
        short="depth map; auto: estimate it; flat: none" if has_maps else "auto: estimate the depth; flat: none",
        help="depth map of the photo, of the same shape; the whole scene is then shown, without the network of "
        "the object. A grey .png (8 or 16 bits) or .tif, an .exr with a depth channel, or a .npy or .npz "
        "of numbers [H,W]; auto: a network of transformers estimates it (pip install "
        "'lightfield-gs[photo]'; it downloads 99 MB once); flat: the whole photo is a plane in the panel, as pages and "
        "screenshots are by themselves",
    )
    add_depth_model(add)
    add(
        "--depth-kind",
        choices=DEPTH_KINDS,
        help="meaning of the map's numbers. distance: along the camera's axis (default); ray: along each "
        "pixel's ray, as some renderers and scanners store it; disparity: 1 / distance, as most networks "
        "estimate it (bright is near)",
    )
    add(
        "--depth-range",
        type=_depth_range,
        metavar="NEAR,FAR",
        help="distances, in any unit, at the ends of the file's full scale (0..255, 0..65535, floats 0..1); "
        "their ratio sets the depth of the scene; FAR,NEAR if bright is near in a map of distances, as in "
        "1.6,1",
    )
    add(
        "--depth-scale",
        type=float,
        metavar="S",
        help="in place of a range: distance = S * number, or S / number for a disparity; 0.001 for millimetres "
        "to metres (default for floats: 1); the distance 0 is no measurement",
    )
    add(
        "--depth-invalid",
        choices=DEPTH_INVALID,
        help="meaning of infinite distances, of numbers for the sky (1e10, 65504, 65535) and of the disparity "
        "0: far away (default), or holes, which NaN and the distance 0 are then, too; else surfaces go on there",
    )
    add(
        "--rgbd",
        choices=DEPTH_PARTS,
        help="in place of --depth: the half of the photo that is its depth map; bright is near, and "
        "--depth-range is 1,1.6 if not given. Names like photo_rgbd.png and maps inside a phone's .jpg "
        "need no option",
    )
    add_pair(add)
    add(
        "--map-orientation",
        choices=MAP_ORIENTATIONS,
        help="orientation of --mask and --depth if the photo's Exif orientation turns it: as stored in the "
        "photo's file, or upright (default: by their size)",
    )
    add(
        "--pixel-aspect",
        type=_pixel_aspect,
        metavar="A",
        help="width by height of a pixel of a photo with depths: 2 if photo and map, side by side, are squeezed "
        "to half their width; 0.5 if to half their height (default 1)",
    )
    add(
        "--fov",
        type=float,
        metavar="DEG",
        help="field of view of the photo's longer side, degrees (default 60, unless the depth map's .npz has a "
        "focal length)",
    )
    add(
        "--intrinsics",
        type=_intrinsics,
        metavar="FX,FY,CX,CY",
        help="in place of --fov: focal lengths and principal point of the photo, in pixels from the outer "
        "corner of the first pixel",
    )
    add_fit(add)


def add_pair(add: Add) -> None:
    """Add the options of where the pictures of two eyes are in a stereo photo."""
    add = in_group(add, groups.EYES)
    add(
        "--stereo-in",
        choices=STEREO_INPUTS,
        help="the two eyes' pictures of a stereo photo, whose depth comes of both (pip install "
        "'lightfield-gs[stereo]'): side by side, one above the other, either squeezed to half; two: pictures of their "
        "own in the file; none: it is one photo (default: by the file's metadata, its name, as photo_half_2x1.png, or "
        "its halves)",
    )
    add(
        "--swap-eyes",
        action="store_true",
        help="of a stereo photo: the right eye's picture comes first, where near and far look exchanged",
    )


def add_depth_model(add: Add) -> None:
    add = in_group(add, groups.DEPTH)
    add(
        "--depth-model",
        metavar="NAME|FOLDER",
        help="network of --depth auto: DA3MONO-LARGE, MoGe-2, Video-Depth-Anything, another name on huggingface.co, or "
        f"a folder with its files (default {DEPTH_MODEL})",
    )


def add_fit(add: Add) -> None:
    add = in_group(add, groups.DEPTH)
    add(
        "--fit",
        choices=FITS,
        short="cover: crop the photo; contain: show all of it",
        help="how a photo with depths fills a panel of another shape: cover crops it; contain shows all of it "
        "before its blurred, darker continuation; auto (default): cover about the subject, unless that would crop it",
    )


def add_detail(add: Add) -> None:
    """Add the options of how finely a photo is laid over the network's Gaussians."""
    add = in_group(add, groups.PHOTO)
    add(
        "--detail",
        type=lambda text: int(text) if text.isdecimal() else text,
        choices=(*DETAILS, "none"),
        help="resolution of the photo on the object: 1, 2 or 4 times the network's; none: the network's own "
        "soft colours; auto: as fine as a view of the panel can show (default auto)",
    )
    add("--detail-budget", type=int, metavar="N", help="most Gaussians for --detail auto (default 1500000)")
