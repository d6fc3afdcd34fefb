"""Which process does which item when, and what becomes of those that a process took with it."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol

from lightfield_gs.base.errors import InputError
from lightfield_gs.batch.worker import Place

if TYPE_CHECKING:
    from lightfield_gs.batch.item import Item

_MOST_FALSE_STARTS = 3  # of one process, one after the other
_LOOK_EVERY_S = 0.5


@dataclass(frozen=True)
class Event:
    """What a process tells. kind: "ready" (after so many seconds), "began" and "done" (of item `number`), "died" (why;
    the item that is to blame, where that is known) or "unfit" (why it could not begin)."""

    kind: str
    worker: int
    number: int | None = None
    record: dict[str, Any] | None = None
    reason: str = ""
    seconds: float = 0.0


class Crew(Protocol):
    """Processes, here or elsewhere."""

    places: list[Place]

    def send(self, worker: int, number: int, item: Any) -> None:
        """Hands an item to a process."""

    def events(self, timeout: float) -> Iterator[Event]:
        """What the processes tell, after `timeout` seconds at the latest."""


class Dispatch:
    """Hands out items one by one, to whoever has fewest, until all are done or have failed.

    A process has as many on their way as its place has room for, and no more than its share of what is left; a long one
    has it for itself. Where a process dies, the items that it had begun, or all where it does not tell, are done again,
    each alone in a process; one that takes that with it as well has failed. The others go back to where they were.
    ended(item, record, worker): is told how each ended; began: of those that are long, when they begin; ready(worker,
    seconds): when a process can begin; waiting: is called now and then.
    """

    def __init__(
        self,
        items: Iterable[tuple[Item, Any]],
        crew: Crew,
        *,
        ended: Callable[[Item, dict[str, Any], int], None],
        began: Callable[[Item], None],
        ready: Callable[[int, float], None],
        waiting: Callable[[], None],
    ):
        self._crew, self._ended, self._began, self._is_ready, self._waiting = crew, ended, began, ready, waiting
        self._items = list(items)
        numbers = range(len(self._items))
        self._long = deque(number for number in numbers if self._items[number][0].is_long)
        self._short = deque(number for number in numbers if not self._items[number][0].is_long)
        self._suspects: deque[int] = deque()
        self.deaths = 0  # of processes
        self._suspected: set[int] = set()  # those that were ever among them
        count = len(crew.places)
        self._ready = [False] * count
        self._false_starts = [0] * count
        self._begun: list[dict[int, bool]] = [{} for _ in range(count)]  # of each item on its way: whether it has begun
        self._alone = [False] * count

    def run(self) -> None:
        """Returns when all have ended. Raises InputError where a process cannot even begin."""
        self._hand_out()
        while self._long or self._short or self._suspects or any(self._begun):
            for event in self._crew.events(_LOOK_EVERY_S):
                self._take(event)
            self._hand_out()
            self._waiting()

    def _take(self, event: Event) -> None:
        worker, number = event.worker, event.number
        on_their_way = self._begun[worker]
        if event.kind == "ready":
            self._ready[worker], self._false_starts[worker] = True, 0
            self._is_ready(worker, event.seconds)
        elif event.kind == "unfit":
            raise InputError(event.reason)
        elif event.kind == "died":
            self._recover(event)
        elif event.kind == "began" and number in on_their_way:
            on_their_way[number] = True
            if self._items[number][0].is_long:
                self._began(self._items[number][0])
        elif event.kind == "done" and number in on_their_way:
            del on_their_way[number]
            self._ended(self._items[number][0], event.record or {}, worker)

    def _recover(self, event: Event) -> None:
        """Puts back what a process had that died, and finds who is to blame."""
        worker, lost = event.worker, self._begun[event.worker]
        self.deaths += 1
        if not self._ready[worker]:
            self._false_starts[worker] += 1
            if self._false_starts[worker] >= _MOST_FALSE_STARTS:
                raise InputError(f"process {self._crew.places[worker].name} cannot begin: {event.reason}")
        self._ready[worker], self._begun[worker] = False, {}
        for number, has_begun in reversed(lost.items()):
            if number == event.number or has_begun and number in self._suspected:
                self._ended(self._items[number][0], {"status": "failed", "reason": event.reason, "seconds": {}}, worker)
            elif has_begun:
                self._suspected.add(number)
                self._suspects.append(number)
            else:
                (self._long if self._items[number][0].is_long else self._short).appendleft(number)

    def _hand_out(self) -> None:
        """Gives items to those that have fewest, as long as there are any and somebody has room."""
        while sum(self._give(worker) for worker in self._by_load()):  # one each at a time, to all
            continue

    def _by_load(self) -> Sequence[int]:
        ready = [worker for worker, is_ready in enumerate(self._ready) if is_ready]
        return sorted(ready, key=lambda worker: len(self._begun[worker]))

    def _give(self, worker: int) -> bool:
        """Gives one item to a process; whether it did."""
        on_their_way = self._begun[worker]
        if not on_their_way:
            for queue in (self._suspects, self._long):
                if queue:
                    self._alone[worker] = True
                    self._send(worker, queue.popleft())
                    return True
            self._alone[worker] = False
        if self._alone[worker] or not self._short or len(on_their_way) >= self._room(worker):
            return False
        self._send(worker, self._short.popleft())
        return True

    def _room(self, worker: int) -> int:
        """How many items may be on their way to a process: at the end all are to have work."""
        left = len(self._short) + sum(len(begun) for begun in self._begun)
        return min(self._crew.places[worker].room, -(-left // len(self._begun)))

    def _send(self, worker: int, number: int) -> None:
        self._begun[worker][number] = False
        self._crew.send(worker, number, self._items[number])
