"""The command line `lightfield-gs`.

Each command imports what it needs when it runs, so that --help is quick.
"""

from __future__ import annotations

import argparse
import importlib
import os
import signal
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NoReturn

from lightfield_gs.base.complaint import assumptions_said, complain
from lightfield_gs.base.errors import InputError
from lightfield_gs.base.options import (
    COMPRESSIONS,
    DEPTH_INVALID,
    DEPTH_KINDS,
    DEPTH_PARTS,
    DEVICES,
    MAP_ORIENTATIONS,
    METHODS,
    QUALITY_NAMES,
    VIEWS,
)
from lightfield_gs.commands.options.values import background, byte_size, camera_choice, numbers, threads, within
from lightfield_gs.panels.panel import DEFAULT_PANEL
from lightfield_gs.scene.axes import UP_AXES

_VECTOR_OPTIONS = ("--eye", "--background", "--depth-range", "--intrinsics", "--up")  # may begin with a minus sign


class _Parser(argparse.ArgumentParser):
    """Complains in one line."""

    def error(self, message: str) -> NoReturn:
        raise InputError(f"{message}; see {self.prog} --help")


def main(argv: Sequence[str] | None = None) -> int:
    """Runs one command and returns the exit code: the command's, or 2 after a one-line complaint about the input."""
    signal.signal(signal.SIGTERM, _terminate)
    # As a program, what was imported before this line (torch, a second) is part of the wait.
    began = time.perf_counter() - (time.process_time() if argv is None else 0)
    arguments = list(sys.argv[1:] if argv is None else argv)
    if argv is None:
        sys.stdout.reconfigure(errors="backslashreplace")  # what files are called, or hold, may be no text
    try:
        args = build_parser(arguments[:1]).parse_args(_joined(arguments), argparse.Namespace(began=began))
        with assumptions_said():
            code = importlib.import_module(args.module).run(args) or 0
        sys.stdout.flush()
        return code
    except BrokenPipeError:  # of stdout: nobody reads on
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except (Exception, KeyboardInterrupt) as error:
        return complain("lightfield-gs", error, "use a smaller scene or panel")


def build_parser(command: Sequence[str] = ()) -> argparse.ArgumentParser:
    """The parser. The options of `bench` are only there when it is the command: its module needs torch."""
    parser = _Parser(
        "lightfield-gs",
        description="One photo, or a scene of 3D Gaussians, to the image that a slanted-lenticular 3D panel shows.",
        allow_abbrev=False,
    )
    parser.add_argument("--version", action=_Version, nargs=0, help="print the version and exit")
    commands = parser.add_subparsers(title="commands", required=True, metavar="COMMAND", parser_class=_Parser)
    _add_encode(commands)
    _add_prune(commands)
    _add_simulate(commands)
    info = commands.add_parser("info", help="say what a file holds", allow_abbrev=False)
    info.add_argument(
        "file",
        type=Path,
        metavar="FILE",
        help="a .ply, an image, a panel or rig (.yaml, visual.json, panel name) or a .safetensors file",
    )
    _add_device_serial(info.add_argument)
    _add_skip_invalid(info.add_argument)
    _add_up(info.add_argument)
    info.set_defaults(module="lightfield_gs.commands.info")
    bench = commands.add_parser("bench", help="measure speed and accuracy", allow_abbrev=False)
    bench.set_defaults(module="lightfield_gs.commands.bench")
    if list(command) == ["bench"]:
        importlib.import_module("lightfield_gs.commands.bench").add_arguments(bench)
    return parser


def _add_panel(add: Callable[..., argparse.Action], purpose: str) -> None:
    """The panel that is drawn for, and what it is seen from."""
    add(
        "--panel",
        default=DEFAULT_PANEL,
        metavar="PANEL",
        help=f"name of a profile, a .yaml or a Looking Glass visual.json (default {DEFAULT_PANEL})",
    )
    _add_device_serial(add)
    _add_viewing_distance(add, f"distance of the viewer from the panel, in place of the panel's own: {purpose}")


def _add_device_serial(add: Callable[..., argparse.Action]) -> None:
    add(
        "--device-serial",
        metavar="SERIAL",
        help="which display, where a Looking Glass .json has calibrations of several",
    )


def _add_viewing_distance(add: Callable[..., argparse.Action], help: str) -> None:
    add("--viewing-distance", type=within(1e-3, 1e9, "mm"), metavar="MM", help=help)


def _add_skip_invalid(add: Callable[..., argparse.Action]) -> None:
    add(
        "--skip-invalid",
        action="store_true",
        help="leave out Gaussians whose values have no meaning (not finite, a rotation of zeros), and say how many",
    )


def _add_camera(add: Callable[..., argparse.Action]) -> None:
    """The cameras of the views, of a scene that has a file; without any, framed automatically."""
    add(
        "--rig",
        type=Path,
        metavar="YAML",
        help="cameras of the views, in the file's own axes (default: those that "
        "the file brings along, else framed automatically)",
    )
    add(
        "--camera",
        type=camera_choice,
        metavar="FILE[:INDEX]",
        help="centre camera of the views, in the file's own "
        "axes: one of a cameras.json (3D Gaussian splatting), of a transforms.json (NeRF), or a rig; its picture is "
        "fitted to the panel (default index 0)",
    )
    _add_up(add)


def _add_up(add: Callable[..., argparse.Action]) -> None:
    add(
        "--up",
        choices=UP_AXES,
        metavar="AXIS",
        help="axis that points up in the file, x, y, z, -x, -y or -z, for "
        "automatic framing; the Gaussians stay as they are (default: what the file says, else -y)",
    )


def _add_encode(commands: argparse._SubParsersAction) -> None:
    encode = commands.add_parser(
        "encode",
        help="a photo or a .ply to the image of a panel",
        allow_abbrev=False,
        description="Encodes a photo of one object, or a scene of 3D Gaussians, for a slanted-lenticular panel.",
    )
    encode.set_defaults(module="lightfield_gs.commands.encode")
    add = encode.add_argument
    add(
        "input",
        type=Path,
        metavar="INPUT",
        help="a photo of an object (RGBA, or RGB with a plain background, --mask "
        "or --remove-background), a photo of a scene with --depth, or a standard 3DGS .ply",
    )
    add("-o", "--output", type=Path, required=True, metavar="FILE", help=".png (8 or 16 bit), .tif or .exr (float)")
    _add_panel(add, "for --preview, for framing, and for `simulate` afterwards")
    _add_camera(add)
    add(
        "--cameras",
        type=Path,
        metavar="JSON",
        help="one camera for each view, the right-most eye's first, for --method sorted, in place of a rig: "
        "world_to_camera [N,4,4] (OpenCV axes, scene units), focal_px [N,2] and principal_point_px [N,2] (pixels of "
        "the panel)",
    )
    add(
        "--view-map",
        type=Path,
        metavar="NPY",
        help="the view of each sub-pixel, for --method sorted, in place of the panel's lens: int32 [H,W,3], 0..N-1, or "
        "-1 for the background",
    )
    add("--save-rig", type=Path, metavar="YAML", help="write the rig that was used")
    add("--mask", type=Path, metavar="IMAGE", help="cut-out of a photo, of its size: bright or opaque on the object")
    add(
        "--remove-background",
        action="store_true",
        help="cut the object out of a photo with rembg (pip install 'lightfield-gs[rembg]'; downloads 176 MB once)",
    )
    _add_depth(encode)
    add("--checkpoint", type=Path, metavar="FILE", help="weights of the network, .safetensors (default: those inside)")
    add(
        "--save-gaussians",
        type=Path,
        metavar="PLY",
        help="write the scene as a 3DGS .ply, in its own axes, with the framing: encoding it gives the same picture",
    )
    _add_skip_invalid(add)
    add(
        "--method",
        choices=METHODS,
        default="direct",
        help="direct: all sub-pixels in one pass; sorted: view by view, for any --cameras and --view-map; classic: a "
        "picture a view, then interlaced (slow; for comparison)",
    )
    add(
        "--memory-budget",
        type=byte_size,
        metavar="SIZE",
        help="work memory of --method sorted beside the image, for example 256MB (B, KB, MB, GB, KiB, MiB, GiB; "
        "default 256MiB, or 1GiB on cuda, beside the sorted sub-pixels, 0.2GB on an 8K panel)",
    )
    add(
        "--device",
        choices=DEVICES,
        default="auto",
        help="where network and rasterizer run (default auto: cuda where there is a GPU and this build can use it)",
    )
    add(
        "--views",
        choices=VIEWS,
        default="integer",
        help="integer: N views; continuous: every sub-pixel its own viewpoint (default integer)",
    )
    add(
        "--quality",
        choices=QUALITY_NAMES,
        default="exact",
        help="less time for more error, of --method direct (default exact)",
    )
    _add_antialiased(add)
    add("--background", type=background, default=(1.0, 1.0, 1.0), metavar="R,G,B", help="0..1 each (default 1,1,1)")
    add(
        "--preview",
        type=Path,
        metavar="DIR",
        help="write views.png, look-around.webp and, where the "
        "panel has a pixel pitch and a viewing distance (see there), left-eye.png and right-eye.png",
    )
    add(
        "--bit-depth",
        type=int,
        choices=(8, 16, 32),
        metavar="BITS",
        help="8, 16 or 32 (float: .exr, .tif); default 8, .exr 32",
    )
    add("--compression", choices=COMPRESSIONS, default="fast", help="of the file: quick to write, or small")
    add("--threads", type=threads, metavar="N", help="number of threads (default: all cores)")
    add("--stats", action="store_true", help="print what was drawn and what was skipped")


def _add_antialiased(add: Callable[..., argparse.Action]) -> None:
    add(
        "--antialiased",
        action="store_true",
        help="for scenes trained with anti-aliasing (Mip-Splatting, gsplat's "
        "antialiased mode), which look too bright and too thick without: what a pixel blurs becomes fainter by as much",
    )


def _add_depth(encode: argparse.ArgumentParser) -> None:
    add = encode.add_argument
    add(
        "--depth",
        type=Path,
        metavar="FILE",
        help="depth map of the photo, of its size: the whole scene is shown, "
        "without the network; a grey .png (8 or 16 bits), .exr or .tif, or a .npy or .npz of numbers [H,W]",
    )
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


def _add_prune(commands: argparse._SubParsersAction) -> None:
    prune = commands.add_parser(
        "prune",
        help="leave out of a scene what hardly shows on a panel",
        allow_abbrev=False,
        description="Writes a scene without the Gaussians that contribute least to its image on a panel, from all "
        "viewpoints of the panel: it is drawn faster from then on.",
    )
    prune.set_defaults(module="lightfield_gs.commands.prune")
    add = prune.add_argument
    add("input", type=Path, metavar="INPUT", help="a standard 3DGS .ply")
    add("-o", "--output", type=Path, required=True, metavar="PLY", help="the scene without them")
    _add_skip_invalid(add)
    add(
        "--contribution-cut",
        type=within(0, 1),
        default=3e-4,
        metavar="SHARE",
        help="0..1, mean error that colours of 0..1 may have for it (default 3e-4: 50 dB and more)",
    )
    _add_antialiased(add)
    _add_panel(add, "for framing, as `encode` takes it")
    _add_camera(add)
    add(
        "--save-rig",
        type=Path,
        metavar="YAML",
        help="write the rig that was used: automatic framing may see a pruned scene otherwise",
    )
    add("--device", choices=DEVICES, default="auto", help="where the scene is drawn (default auto)")


def _add_simulate(commands: argparse._SubParsersAction) -> None:
    simulate = commands.add_parser(
        "simulate",
        help="what an eye sees through the lenses",
        allow_abbrev=False,
        description="The picture that an eye sees of an encoded image through the lenses, one sample a lens.",
    )
    simulate.set_defaults(module="lightfield_gs.commands.simulate")
    add = simulate.add_argument
    add("image", type=Path, metavar="IMAGE", help="an encoded image, as `encode` writes it")
    add("--panel", metavar="PANEL", help="name, .yaml or visual.json (default: the profile stored in the image)")
    _add_device_serial(add)
    _add_viewing_distance(add, "distance from which the panel shows one view all over, in place of the panel's own")
    add(
        "--eye",
        type=numbers(3),
        required=True,
        metavar="X,Y,Z",
        help="place of the eye in mm from the panel's centre: right, up, towards the viewer",
    )
    add(
        "--spread",
        type=within(0.01, 1000, "sub-pixels"),
        default=1.0,
        metavar="SUBPIXELS",
        help="width of what a lens lights, in sub-pixels; more is crosstalk (default 1)",
    )
    add("-o", "--output", type=Path, required=True, metavar="FILE", help=".png, .tif or .exr")


def _joined(arguments: list[str]) -> list[str]:
    """`--eye -5,0,600` as `--eye=-5,0,600`: argparse takes the value for an option otherwise."""
    out: list[str] = []
    for argument in arguments:
        if out and out[-1] in _VECTOR_OPTIONS:
            out[-1] += f"={argument}"
        else:
            out.append(argument)
    return out


class _Version(argparse.Action):
    def __call__(self, parser, namespace, values, option_string=None):
        from importlib.metadata import version

        print(f"lightfield-gs {version('lightfield-gs')}")
        parser.exit()


def _terminate(number: int, frame: object) -> NoReturn:
    raise SystemExit(128 + number)  # unwinds, so that temporary files go


if __name__ == "__main__":
    sys.exit(main())
