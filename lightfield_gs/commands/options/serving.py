"""Options of the server of a command's page."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

from lightfield_gs.base.cli_messages import note
from lightfield_gs.commands.options import groups
from lightfield_gs.commands.options.groups import Add, in_group
from lightfield_gs.commands.options.parser import whole

if TYPE_CHECKING:
    from lightfield_gs.show.page.server import Route

_HOST = "127.0.0.1"


@dataclass(frozen=True, slots=True)
class ServingOptions:
    """The address at which a page is served.

    Attributes:
        port: 0 for any free port.
        no_open: Whether to leave the browser closed.
    """

    port: int = 0
    host: str = _HOST
    no_open: bool = False


def add_serving(add: Add) -> None:
    """Add the options of where the page is served."""
    add = in_group(add, groups.PAGE)
    add(
        "--port",
        type=whole(0, 65535),
        default=0,
        metavar="NUMBER",
        help="port of the page's address (default 0: any free port)",
    )
    add(
        "--host",
        default=_HOST,
        metavar="ADDRESS",
        short="0.0.0.0: let other machines open the page",
        help="address of the server (default 127.0.0.1, or ::1: this machine alone; 0.0.0.0, or ::: everybody "
        "in the whole network)",
    )
    add(
        "--no-open",
        action="store_true",
        short="print the address, leave the browser closed",
        help="print the address without opening the browser",
    )


def serve(
    options: ServingOptions,
    routes: Mapping[str, Route],
    start: str,
    opened: Callable[[str], object] | None = None,
    began: Callable[[Callable[[], None]], None] | None = None,
) -> None:
    """Serve the routes until Ctrl-C, and open the one named `start` in the browser. Raises InputError.

    Args:
        options: The address.
        routes: By their paths.
        start: A path among them.
        opened: Opens a browser at an address; None: the usual one is opened.
        began: Called when the address is taken, with what ends the serving, from another thread.
    """
    from lightfield_gs.show.page.server import Server

    server = Server(routes, options.port, options.host)
    if not server.is_local:
        note(f"--host {options.host}: everybody who reaches this machine there can see and steer the page")
    if server.is_name_of_itself:
        note(
            f"--host {options.host}: this system leads its own name to {server.url}, which this machine alone "
            "reaches: give another address of it, or 0.0.0.0, for others to open the page"
        )
    print(f"open {server.url}{start} in a browser; Ctrl-C ends it")
    if server.is_everywhere:
        urls = [url + start for url in server.other_urls]
        print(f"from other machines: {', '.join(urls) or 'by an address of this one, which is not known'}")
    sys.stdout.flush()
    if began is not None:
        began(server.shutdown)
    server.run(None if options.no_open else start, *([] if opened is None else [opened]))
