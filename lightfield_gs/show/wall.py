"""Wall mode: a server and a browser that are started again where they end or no longer answer."""

from __future__ import annotations

import multiprocessing
import time
from collections.abc import Callable
from multiprocessing.sharedctypes import Synchronized
from typing import Any

from lightfield_gs.base.cli_messages import EXIT_BAD_INPUT, note
from lightfield_gs.base.errors import InputError
from lightfield_gs.show.display_browser import DisplayBrowser

_LOOK_S = 0.5  # between two looks at both
_SILENT_S = 60.0  # without a sign of the page, after which the browser is started again
_LONGEST_PAUSE_S = 60.0  # before another start, where it fails again and again
_STEADY_S = 30.0  # after which a start counts as a success


class _Kept:
    """When something may be started again: at once, then after pauses that grow."""

    def __init__(self) -> None:
        self.began, self._pause, self._due = time.monotonic(), 0.0, 0.0

    def is_due(self) -> bool:
        """Return whether the pause since the last end is over; call it until it is."""
        now = time.monotonic()
        if self._due == 0:
            self._pause = 0.0 if now - self.began > _STEADY_S else min(_LONGEST_PAUSE_S, 2 * self._pause + 1)
            self._due = now + self._pause
        if now < self._due:
            return False
        self.began, self._due = now, 0.0
        return True


def keep_showing(
    serve: Callable[..., None], arguments: tuple[Any, ...], url: str, browser: DisplayBrowser | None
) -> None:
    """Run a server in a process of its own, and a browser, until Ctrl-C; start again what ends.

    Args:
        serve: Serves until it ends; its last argument is a shared time at which the page was last alive.
        arguments: Its other arguments.
        url: Of the page.
        browser: None: none is opened.

    Raises:
        InputError: The server refuses its arguments.
    """
    context = multiprocessing.get_context("spawn")
    alive: Synchronized[float] = context.Value("d", time.monotonic())

    def start() -> Any:
        process = context.Process(target=serve, args=(*arguments, alive), daemon=True)
        process.start()
        return process

    server, of_server, of_browser = start(), _Kept(), _Kept()
    is_opened, had_answer = False, False
    try:
        while True:
            time.sleep(_LOOK_S)
            had_answer = had_answer or answers(url)
            if not server.is_alive():
                if server.exitcode == EXIT_BAD_INPUT and not had_answer:
                    raise InputError("the server could not begin; the line above says why")
                if of_server.is_due():
                    note(f"the server ended with code {server.exitcode}, and is started again")
                    server = start()
                continue
            if browser is None or not had_answer:
                continue
            if not is_opened:
                browser.open(url)
                is_opened, alive.value = True, time.monotonic()
            elif browser.program is None:
                continue
            elif browser.has_ended() or time.monotonic() - alive.value > _SILENT_S:
                if of_browser.is_due():
                    note("the browser ended or no longer answers, and is started again")
                    browser.close()
                    browser.open(url)
                    alive.value = time.monotonic()
    except KeyboardInterrupt:
        print("\nended")
    finally:
        if browser is not None:
            browser.close()
        server.terminate()
        server.join(5)


def answers(url: str) -> bool:
    """Return whether something serves at an address."""
    import urllib.error
    import urllib.request

    try:
        opener = urllib.request.build_opener(urllib.request.ProxyHandler({}))
        with opener.open(url, timeout=5):
            return True
    except (OSError, urllib.error.URLError):
        return False
