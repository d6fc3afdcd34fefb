"""`lightfield-gs show`: pictures and films on the display, full screen and pixel for pixel, with a check that it is."""

from __future__ import annotations

import argparse
import socket
import time
from dataclasses import dataclass, replace
from multiprocessing.sharedctypes import Synchronized
from pathlib import Path

from lightfield_gs.app.options import PanelOptions
from lightfield_gs.app.panel import BROWSER_OPENS, connected_position, where_to_show
from lightfield_gs.app.playlist import find_slides
from lightfield_gs.base.cli_messages import quiet, report_error, say
from lightfield_gs.base.errors import InputError
from lightfield_gs.base.options import StereoLayout
from lightfield_gs.commands.options.parser import read_options
from lightfield_gs.commands.options.serving import ServingOptions, serve
from lightfield_gs.show.display_browser import DisplayBrowser, find_browser
from lightfield_gs.show.playlist import Playlist


@dataclass(frozen=True, slots=True)
class ShowOptions:
    """Pictures and films, their panel (None: the panel that the first one names), and the address of the page.

    Attributes:
        stereo: how stereo pictures are shown on a screen of two eyes. None: side by side, if they are some.
        seconds, fade: of a picture, and of the change to the next.
        once: whether it stops at the last one.
        shuffle: whether the order is by chance.
        wall: whether the browser and the server are started again where they end.
    """

    inputs: tuple[Path, ...]
    panel: PanelOptions
    serving: ServingOptions
    stereo: StereoLayout | None = None
    seconds: float = 10.0
    fade: float = 0.5
    once: bool = False
    shuffle: bool = False
    wall: bool = False


def run(args: argparse.Namespace) -> None:
    """Serve the page of args.inputs until Ctrl-C. Raises InputError."""
    _show(read_options(ShowOptions, args))


def _show(options: ShowOptions) -> None:
    playlist = find_slides(options.inputs, options.panel, options.stereo)
    say(*_lines(options, playlist))
    panel, of_panel = playlist.panel, playlist.layout is None
    position, size = (connected_position(), (panel.width_px, panel.height_px)) if of_panel else (None, None)
    has_browser = position is not None and find_browser() is not None and not options.serving.no_open
    if of_panel and options.panel.panel is None:
        say(*where_to_show(panel, BROWSER_OPENS if has_browser else None))
    if options.wall:
        _show_on_wall(options, position, size)
        return
    browser = DisplayBrowser(position, size) if has_browser else None
    try:
        serve(options.serving, _routes(options, playlist), "/", None if browser is None else browser.open)
    finally:
        if browser is not None:
            browser.close()


def _routes(options: ShowOptions, playlist: Playlist, alive: Synchronized[float] | None = None):
    from lightfield_gs.app.slide_pixels import native_frames, read_slide
    from lightfield_gs.show.page.slides import SlideOptions, SlidePixels, slide_routes

    def seen() -> None:
        if alive is not None:
            alive.value = time.monotonic()

    how = SlideOptions(options.seconds, options.fade, not options.once, options.shuffle)
    pixels = SlidePixels(lambda slide: read_slide(slide, playlist), native_frames)
    return slide_routes(playlist, how, pixels, seen)


def _lines(options: ShowOptions, playlist: Playlist) -> list[str]:
    """Return lines on what is shown, and how."""
    panel, slides = playlist.panel, playlist.slides
    if playlist.layout is not None:
        pair = slides[0].pair
        assert pair is not None
        source = f"by {pair.source}" if options.stereo is None or len(slides) == 1 else f"the first by {pair.source}"
        where = f"stereo {source}, shown as {playlist.layout} on the whole screen (another: --stereo)"
    else:
        where = f"{panel.width_px} x {panel.height_px}, for panel {panel.name}"
    if len(slides) == 1:
        return [f"{slides[0].path}: {where}", *playlist.messages]
    films = sum(slide.is_film for slide in slides)
    kinds = ((len(slides) - films, "picture"), (films, "film"))
    counts = [f"{count} {words}{'s' if count > 1 else ''}" for count, words in kinds if count]
    each = f"{options.seconds:g} s each" if options.seconds else "by the arrow keys"
    ways = f"{each}{', by chance' if options.shuffle else ''}{', once' if options.once else ''}"
    return [f"{' and '.join(counts)}: {where}", f"pictures: {ways} (--seconds; H lists the keys)", *playlist.messages]


def _show_on_wall(options: ShowOptions, position: tuple[int, int] | None, size: tuple[int, int] | None) -> None:
    """Serve in a process of its own, and start the browser and it again where they end."""
    from lightfield_gs.show.wall import keep_showing

    host = options.serving.host
    port = options.serving.port or _free_port(host)
    served = replace(options, serving=replace(options.serving, port=port, no_open=True))
    browser = None if options.serving.no_open else DisplayBrowser(position, size, is_kiosk=True)
    local = host if host not in ("0.0.0.0", "::") else "127.0.0.1" if host == "0.0.0.0" else "::1"
    url = f"http://{f'[{local}]' if ':' in local else local}:{port}/"
    print(f"wall mode at {url}: what ends is started again; Ctrl-C ends it", flush=True)
    keep_showing(_serve_alone, (served,), url, browser)


def _free_port(host: str) -> int:
    """Return a port that is free, and stays the same when the server begins anew."""
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    with socket.socket(family, socket.SOCK_STREAM) as probe:
        probe.bind((host.strip("[]"), 0))
        return probe.getsockname()[1]


def _serve_alone(options: ShowOptions, alive: Synchronized[float]) -> None:
    """Serve the page in a process of its own."""
    try:
        with quiet():
            playlist = find_slides(options.inputs, options.panel, options.stereo)
            serve(options.serving, _routes(options, playlist, alive), "/")
    except KeyboardInterrupt:
        pass
    except (InputError, OSError) as error:
        raise SystemExit(report_error("lightfield-gs", error, "")) from None
