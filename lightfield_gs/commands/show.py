"""`lightfield-gs show`: an encoded image on the panel, full screen and pixel for pixel, with a check that it is."""

from __future__ import annotations

import argparse
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from lightfield_gs.app.options import PanelOptions
from lightfield_gs.app.panel import shown_panel, where_to_show
from lightfield_gs.base.cli_messages import say
from lightfield_gs.base.errors import InputError
from lightfield_gs.base.options import StereoLayout
from lightfield_gs.commands.options.parser import read_options
from lightfield_gs.commands.options.serving import ServingOptions, serve
from lightfield_gs.io.images import as_floats, read_image, read_info
from lightfield_gs.io.pillow_images import is_heif
from lightfield_gs.io.stereo_names import PairLayout
from lightfield_gs.panels.panel import Panel


@dataclass(frozen=True, slots=True)
class ShowOptions:
    """An encoded image, its panel (None: the panel that it names), and the address of the page.

    Attributes:
        stereo: how a stereo picture is shown on a screen of two eyes. None: side by side, if it is one.
    """

    image: Path
    panel: PanelOptions
    serving: ServingOptions
    stereo: StereoLayout | None = None


def run(args: argparse.Namespace) -> None:
    """Serve the panel's page of args.image until Ctrl-C. Raises InputError."""
    _show(read_options(ShowOptions, args))


def _show_pair(options: ShowOptions, pair: PairLayout) -> None:
    """Serve the page with both eyes' pictures, which fill the screen."""
    import torch

    from lightfield_gs.encoding.stereo import join_eyes
    from lightfield_gs.panels.stereo_screen import StereoScreen
    from lightfield_gs.photo.stereo_pair import read_pair
    from lightfield_gs.show.page.routes import shown_routes
    from lightfield_gs.show.preview import to_integers

    path, layout = options.image, options.stereo or "sbs"
    read = read_pair(path, pair)
    width = read.left.pixels.shape[1] // 2 * 2  # even, as halves take it
    eyes = [to_integers(as_floats(eye.pixels[:, :width, :3]), 8) for eye in (read.left, read.right)]
    pixels = join_eyes(torch.from_numpy(np.stack(eyes)), layout).numpy()
    panel = StereoScreen().panel()
    panel = replace(panel, width_px=pixels.shape[1], height_px=pixels.shape[0], name="stereo screen")
    print(f"{path}: stereo by {pair.source}, shown as {layout} on the whole screen (another: --stereo)")
    serve(options.serving, shown_routes(panel, pixels, fills=True), "/panel")


def _pair(options: ShowOptions) -> PairLayout | None:
    """Return the layout of a stereo picture that is to be shown as one; raise InputError where --stereo has none."""
    from lightfield_gs.photo.stereo_pair import find_pair

    path, panel = options.image, options.panel.panel
    if panel is not None and options.stereo is not None:
        raise InputError("--stereo is for a screen of two eyes, and --panel is another; leave out one of them")
    if panel is not None or not path.is_file():
        return None
    is_encoded = options.stereo is None and not is_heif(path) and "panel" in read_info(path).metadata
    found = None if is_encoded else find_pair(path)
    if found is None and options.stereo is not None:
        raise InputError(f"{path}: neither the file nor its name says that it is stereo; rename it, as NAME_2x1.png")
    return found


def _show(options: ShowOptions) -> None:
    if (pair := _pair(options)) is not None:
        _show_pair(options, pair)
        return
    from lightfield_gs.show.page.routes import shown_routes
    from lightfield_gs.show.preview import to_integers

    path, name, serial = options.image, options.panel.panel, options.panel.device_serial
    panel = shown_panel(path, serial) if name is None else Panel.load(name, serial=serial)
    image = read_image(path, as_stored=True)
    if image.shape[:2] != (panel.height_px, panel.width_px) or image.shape[2] < 3:
        raise InputError(
            f"{path} is {image.shape[1]} x {image.shape[0]} pixels of {image.shape[2]} channels, panel "
            f"{panel.name} is {panel.width_px} x {panel.height_px} of 3; name the panel it was encoded for"
        )
    pixels = image[..., :3] if image.dtype == "uint8" else to_integers(as_floats(image[..., :3]), 8)
    print(f"{path}: {panel.width_px} x {panel.height_px}, for panel {panel.name}")
    if name is None:
        say(*where_to_show(panel))
    serve(options.serving, shown_routes(panel, pixels), "/panel")
