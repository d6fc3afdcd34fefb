"""The panel that an encoded image says it was made for."""

from __future__ import annotations

import argparse
from pathlib import Path

from lightfield_gs.base.errors import InputError
from lightfield_gs.io.images import read_info
from lightfield_gs.io.text_files import parse_json
from lightfield_gs.panels.panel import Panel


def stored_panel(args: argparse.Namespace) -> Panel:
    """The panel that args.image was encoded for. Raises InputError where it does not say."""
    if args.device_serial is not None:
        raise InputError("--device-serial chooses among the calibrations of a --panel; give one, or leave it out")
    stored = read_info(args.image).metadata.get("panel")
    if stored is None:
        raise InputError(f"{args.image} does not say which panel it is for; give --panel")
    return profile(args.image, stored)


def profile(image: Path, stored: str) -> Panel:
    """A panel from what is stored in an image. Raises InputError."""
    try:
        return Panel(**parse_json(stored))
    except (TypeError, ValueError) as error:
        raise InputError(f"{image}: its panel profile cannot be used ({error}); give --panel") from None
