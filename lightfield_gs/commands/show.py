"""`lightfield-gs show`: an encoded image on the panel, full screen and pixel for pixel, with a check that it is."""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path

from lightfield_gs.app.options import PanelOptions
from lightfield_gs.app.panel import shown_panel, where_to_show
from lightfield_gs.base.cli_messages import say
from lightfield_gs.base.errors import InputError
from lightfield_gs.commands.options.panel import add_device_serial
from lightfield_gs.commands.options.parser import read_options
from lightfield_gs.commands.options.serving import ServingOptions, add_serving, serve
from lightfield_gs.io.images import as_floats, read_image
from lightfield_gs.panels.panel import Panel


@dataclass(frozen=True, slots=True)
class ShowOptions:
    """An encoded image, its panel (None: the panel that it names), and the address of the page."""

    image: Path
    panel: PanelOptions
    serving: ServingOptions


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `lightfield-gs show`."""
    parser.description = (
        "Open a page in the browser with an encoded image, full screen and pixel for pixel: on the panel, "
        "if the browser is there. A large warning appears if the image is scaled or on another screen. "
        "Ctrl-C ends it."
    )
    add = parser.add_argument
    add("image", type=Path, metavar="IMAGE", help="an encoded image, as `encode` writes it")
    add(
        "--panel",
        metavar="PANEL",
        help="name, .yaml or visual.json (default: the profile in the image, else the display that is connected)",
    )
    add_device_serial(add)
    add_serving(add)


def run(args: argparse.Namespace) -> None:
    """Serve the panel's page of args.image until Ctrl-C. Raises InputError."""
    _show(read_options(ShowOptions, args))


def _show(options: ShowOptions) -> None:
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
