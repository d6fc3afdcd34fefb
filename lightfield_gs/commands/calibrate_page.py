"""`lightfield-gs calibrate page`: a page on the panel that leads to the right lens by eye."""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path

from lightfield_gs.base.system import quoted
from lightfield_gs.commands.options.parser import read_options
from lightfield_gs.commands.options.serving import ServingOptions, serve
from lightfield_gs.panels.lens_change import check_profile_path
from lightfield_gs.panels.lens_history import write_kept
from lightfield_gs.panels.lens_words import change_lines, large_changes
from lightfield_gs.panels.panel import Panel
from lightfield_gs.show.page.lens_guide import LensGuide


@dataclass(frozen=True, slots=True)
class PageOptions:
    """A profile that a page changes.

    Attributes:
        profile: name of the profile, or a path to it.
        output: the changed profile.
        serving: the address of the page.
        device_serial: the display, where the profile has several.
    """

    profile: str
    output: Path
    serving: ServingOptions
    device_serial: str | None = None


def run(args: argparse.Namespace) -> None:
    """Serve the page of args.profile until Ctrl-C. Raises InputError."""
    options = read_options(PageOptions, args)
    path = check_profile_path(options.output, options.profile)
    panel = Panel.load(options.profile, serial=options.device_serial)
    print(f"{options.profile}: {panel.width_px} x {panel.height_px}; S on the page saves the new lens in {path}")
    serve(options.serving, lens_guide(options, panel, path).routes(), "/")


def lens_guide(options: PageOptions, panel: Panel, path: Path) -> LensGuide:
    """Return the guide that changes the lens of a panel and saves it in `path`."""

    def save(changed: Panel, words: str) -> list[str]:
        lines = change_lines(options.profile, panel, changed, options.device_serial)
        write_kept(path, options.profile, changed, options.device_serial, f"{words}: {lines[0]}")
        print(f"{path}: {words}", flush=True)
        return [f"Saved in {path}.", f"The way back: {quoted('lightfield-gs', 'calibrate', 'undo', path)}"]

    def describe(changed: Panel) -> tuple[list[str], str]:
        words = large_changes(panel, changed)
        return change_lines(options.profile, panel, changed, options.device_serial), words[:1].upper() + words[1:]

    return LensGuide(panel, save, describe)
