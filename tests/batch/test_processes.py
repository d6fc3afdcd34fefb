"""Processes that do items, and items that kill processes."""

from collections import Counter
from pathlib import Path

import pytest

from lightfield_gs import InputError
from lightfield_gs.batch.dispatch import Dispatch
from lightfield_gs.batch.item import Item
from lightfield_gs.batch.places import on_a_gpu, places_here
from lightfield_gs.batch.processes import Processes
from lightfield_gs.batch.tally import Tally
from lightfield_gs.batch.worker import Job, Place

pytestmark = pytest.mark.not_sanitized
PLACES = [Place("one", "cpu", readers=2, writers=2), Place("two", "cpu", readers=2, writers=2)]


def done(names: list[str], long: tuple[str, ...] = (), **options) -> dict[str, dict]:
    """How each item ended, of two processes."""
    ended: dict[str, dict] = {}
    begun: list[str] = []
    items = [(Item(name, name, "fit" if name in long else "encode"), None) for name in names]
    tally = Tally(PLACES, len(items), shown=False)

    def end(item, record, worker):
        assert item.name not in ended
        ended[item.name] = record
        tally.ended(record, worker)

    with Processes(Job("batch_maker:maker", options), PLACES) as crew:
        Dispatch(
            items, crew, ended=end, began=lambda item: begun.append(item.name), ready=tally.ready, waiting=lambda: None
        ).run()
    assert set(begun) == set(long)
    assert tally.done + tally.failed == len(items) and f"{len(items)} items in" in tally.summary()[0]
    return ended


def test_what_kills_a_process_fails_and_takes_nothing_with_it(tmp_path):
    plain = [f"plain-{number:02d}" for number in range(40)]
    bad = [
        "dies-in-draw",
        "dies-in-write",
        "fails-in-read",
        "fails-in-draw",
        "fails-in-write",
        "breaks-in-draw",
        "exits",
    ]
    names = [*plain[:20], *bad, *plain[20:], "long", "kept"]
    ended = done(names, ("long",), folder=str(tmp_path))
    status = {name: record["status"] for name, record in ended.items()}
    assert status == dict.fromkeys(names, "done") | dict.fromkeys(bad, "failed")
    reasons = {name: ended[name]["reason"] for name in bad}
    assert reasons.pop("breaks-in-draw").startswith("RuntimeError: CUDA error: an illegal memory access")
    assert reasons == {
        "dies-in-draw": "the process died of it (signal 9)",
        "dies-in-write": "the process died of it (signal 9)",
        "exits": "SystemExit: 3",
        **{f"fails-in-{part}": "ZeroDivisionError: as its name says" for part in ("read", "draw", "write")},
    }
    assert "batch_maker.py" in ended["fails-in-write"]["trace"] and ended["plain-00"]["said"] == ["reads plain-00"]
    assert list(ended["kept"]["seconds"]) == ["read"] and list(ended["long"]["seconds"]) == ["read", "draw", "write"]
    begun = Counter({path.name: len(path.read_text()) for path in Path(tmp_path).iterdir()})
    assert begun["dies-in-draw"] == begun["dies-in-write"] == 2 and begun["fails-in-draw"] <= 3
    processes = Counter(record["process"] for record in ended.values() if "process" in record)
    assert 2 <= len(processes) <= 2 + 5  # five deaths
    again = [name for name in plain if begun[name] > 1]
    assert len(again) <= 3 * 2 * PLACES[0].room  # those that were on their way when three processes died


def test_a_process_that_cannot_begin_ends_the_batch(tmp_path):
    with pytest.raises(InputError, match="no such thing"):
        done(["a"], folder=str(tmp_path), unfit="no such thing")


def test_cores_are_shared_out():
    places = places_here("cpu", 2, None)
    own = [core for place in places for core in place.cores]
    assert [place.name for place in places] == ["cpu:0", "cpu:1"]
    assert len(set(own)) == len(own) or len(own) == 2 and len(set(own)) == 1
    assert all(place.threads == len(place.cores) for place in places)
    assert places_here("cpu", 1, 3)[0].threads == 3
    assert [on_a_gpu(cores, False) for cores in (1, 4, 8, 64)] == [1, 1, 2, 4] and on_a_gpu(64, True) == 1
    assert [on_a_gpu(64, False, gib << 30) for gib in (1, 5, 80)] == [1, 2, 4]
    with pytest.raises(InputError, match="--devices: expected cpu, or GPUs such as cuda:0,cuda:1, got 'gpu'"):
        places_here("gpu", None, None)
