"""Processes that do items, and items that kill processes."""

import json
import os
import signal
import threading
import time
from collections import Counter
from multiprocessing.process import BaseProcess

import pytest
from batch_maker import run_shard

from lightfield_gs import InputError
from lightfield_gs.batch import shards
from lightfield_gs.batch.run import Worker, now
from lightfield_gs.batch.shards import choose_workers, processes_per_gpu, run_shards

pytestmark = pytest.mark.not_sanitized
WORKERS = [Worker("one", "cpu", readers=2, writers=2), Worker("two", "cpu", readers=2, writers=2)]
MOST_ON_WAY = 2 + 2 + 4


def ended(folder) -> dict[str, dict]:
    """How each item ended, of the manifests in a folder; each once."""
    lines = [json.loads(line) for path in folder.glob("batch*.jsonl") for line in path.read_text().splitlines()]
    ends = [line for line in lines if line.get("status") in ("done", "failed")]
    assert len({line["item"] for line in ends}) == len(ends)
    return {line["item"]: line for line in ends}


def test_what_kills_a_process_fails_and_takes_nothing_with_it(tmp_path, capfd):
    plain = [f"plain-{number:02d}" for number in range(40)]
    bad = ["dies-in-draw", "dies-in-write", "fails-in-read", "fails-in-draw", "fails-in-write", "breaks-in-draw"]
    bad.append("exits")
    names = [*plain[:20], *bad, *plain[20:], "kept"]
    options = {"names": names, "folder": str(tmp_path), "since": now()}
    assert run_shards(run_shard, options, WORKERS, tmp_path) == 1
    found = ended(tmp_path)
    status = {name: record["status"] for name, record in found.items()}
    assert status == dict.fromkeys(names, "done") | dict.fromkeys(bad, "failed")
    reasons = {name: found[name]["reason"] for name in bad}
    assert reasons.pop("breaks-in-draw").startswith("RuntimeError: CUDA error: an illegal memory access")
    assert reasons == {
        "dies-in-draw": "the process died of it",
        "dies-in-write": "the process died of it",
        "exits": "SystemExit: 3",
        **{f"fails-in-{part}": "ZeroDivisionError: as its name says" for part in ("read", "draw", "write")},
    }
    assert "batch_maker.py" in found["fails-in-write"]["trace"] and found["plain-00"]["said"] == ["reads plain-00"]
    assert list(found["kept"]["seconds"]) == ["read"] and list(found["plain-00"]["seconds"]) == [
        "read",
        "draw",
        "write",
    ]
    begun = Counter({name: len((tmp_path / name).read_text()) for name in names})
    assert begun["dies-in-draw"] == begun["dies-in-write"] == 2 and begun["fails-in-draw"] <= 3
    processes = Counter(record["process"] for record in found.values() if "process" in record)
    assert 2 <= len(processes) <= 2 + 5  # five deaths
    again = [name for name in plain if begun[name] > 1]
    assert len(again) <= 3 * MOST_ON_WAY  # those that were on their way when three processes died
    told = capfd.readouterr().out
    assert "one: " in told and "two: " in told and "bound by" in told


def test_a_process_that_cannot_begin_ends_the_batch(tmp_path, capfd):
    options = {"names": ["a", "b"], "folder": str(tmp_path), "unfit": "no such thing", "since": now()}
    assert run_shards(run_shard, options, WORKERS, tmp_path) == 2
    assert "error: no such thing" in capfd.readouterr().err


def test_processes_note_what_an_interruption_stops_though_no_signal_reaches_them(tmp_path, monkeypatch):
    def interrupt():
        deadline = time.monotonic() + 100
        while not all((tmp_path / name).exists() for name in names) and time.monotonic() < deadline:
            time.sleep(0.05)
        os.kill(os.getpid(), signal.SIGINT)

    names = ["long-1", "long-2"]
    monkeypatch.setattr(shards, "_PATIENCE_S", 60.0)  # beside other tests a process may take long to wake up
    monkeypatch.setattr(BaseProcess, "terminate", lambda process: pytest.fail("on Windows that leaves no time"))
    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # ignored, where the tests run in the background
    threading.Thread(target=interrupt, daemon=True).start()
    try:
        with pytest.raises(KeyboardInterrupt):
            run_shards(run_shard, {"names": names, "folder": str(tmp_path), "since": now()}, WORKERS, tmp_path)
    finally:
        signal.signal(signal.SIGINT, before)
    lines = [json.loads(line) for path in tmp_path.glob("batch*.jsonl") for line in path.read_text().splitlines()]
    assert sorted(line["item"] for line in lines if line.get("status") == "stopped") == names


def test_cores_are_shared_out():
    workers = choose_workers("cpu", 2, None)
    assert [worker.name for worker in workers] == ["cpu:0", "cpu:1"] and workers[0].threads == workers[1].threads >= 1
    assert choose_workers("cpu", 1, 3)[0].threads == 3
    assert [processes_per_gpu(cores, False, 80 << 30) for cores in (1, 4, 8, 64)] == [1, 1, 2, 4]
    assert processes_per_gpu(64, True, 80 << 30) == 1
    assert [processes_per_gpu(64, False, gib << 30) for gib in (1, 5, 80)] == [1, 2, 4]
    with pytest.raises(InputError, match="devices=: expected cpu, or GPUs such as cuda:0,cuda:1, got 'gpu'"):
        choose_workers("gpu", None, None)
