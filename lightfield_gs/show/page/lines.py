"""The threads that draw for a page."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

from lightfield_gs.show.page.server import Superseded

T = TypeVar("T")


class Lines:
    """The drawing threads: one for moving pictures and one for pictures at rest, which may take seconds.

    On a GPU one thread draws both. A thread for each connection would have a pool of torch's own.
    """

    def __init__(self, is_on_gpu: bool):
        self._still = ThreadPoolExecutor(1, "still")
        self._moving = self._still if is_on_gpu else ThreadPoolExecutor(1, "moving")
        self._tickets = itertools.count(1)
        self._newest = 0

    def draw(self, still: bool, work: Callable[[], T]) -> T:
        """Run work in its turn. Raises Superseded if another picture at rest is requested before."""
        if not still:
            return self._moving.submit(work).result()
        ticket = self._newest = next(self._tickets)

        def in_turn() -> T:
            if ticket != self._newest:
                raise Superseded
            return work()

        return self._still.submit(in_turn).result()

    def last(self, work: Callable[[], T]) -> T:
        """Run work after the pictures at rest that were requested before."""
        return self._still.submit(work).result()
