"""The record of a batch is never lost, and never mixed with a batch that runs at the same time."""

import json

import pytest
import windows

from lightfield_gs import InputError
from lightfield_gs.batch import manifest as manifest_module
from lightfield_gs.batch.items import Item
from lightfield_gs.batch.manifest import WHOLE, Known, Manifest, facts, make_plan, stamp

RECORD = {"item": "a", "status": "done", "job": "", "inputs": {}, "outputs": {}}
LINE = json.dumps(RECORD).encode() + b"\n"


@pytest.fixture(autouse=True)
def without_patience(monkeypatch):
    monkeypatch.setattr(manifest_module, "_PATIENCE_S", 0.0)


def test_the_last_line_of_an_item_counts(tmp_path):
    with Manifest(tmp_path / "out") as manifest:
        assert manifest.last("a") is None
        for status in ("begun", "failed", "done"):
            manifest.append(RECORD | {"status": status, "said": ["öäü 光"]})
    with Manifest(tmp_path / "out") as manifest:
        assert manifest.last("a") == RECORD | {"status": "done", "said": ["öäü 光"]}
    assert len((tmp_path / "out/batch.jsonl").read_bytes().splitlines()) == 3


@pytest.mark.parametrize("torn", [b'{"item": "b", "sta', LINE.replace(b"a", b"b", 1).rstrip(), b"\x00\x00\n", b"[1]\n"])
def test_what_a_power_failure_left_of_a_line_is_passed_over(tmp_path, torn):
    path = tmp_path / "batch.jsonl"
    path.write_bytes(LINE + torn)
    with Manifest(tmp_path) as manifest:
        assert manifest.last("a") is not None and manifest.damaged == (b"done" not in torn)
        manifest.append(RECORD | {"item": "c"})
    with Manifest(tmp_path) as manifest:
        assert manifest.last("c") is not None and (manifest.last("b") is not None) == (b"done" in torn)


@pytest.mark.parametrize("is_windows", [False, True])
def test_runs_of_the_same_items_do_not_share_a_folder(tmp_path, monkeypatch, is_windows):
    if is_windows:
        windows.stand_in(monkeypatch)

    def is_free(shard=WHOLE) -> bool:
        try:
            with Manifest(tmp_path, shard):
                return True
        except InputError as error:
            assert "another batch is at work" in str(error)
            return False

    with Manifest(tmp_path):
        assert not is_free() and not is_free((1, 2))
        assert (tmp_path / "batch.jsonl").read_bytes() == b""  # a lock does not keep it from being read
    with Manifest(tmp_path, (1, 2)) as manifest:
        manifest.append(RECORD)
        assert is_free((2, 2)) and not is_free((1, 2)) and not is_free()
    assert is_free() and is_free((1, 2))


def test_the_hash_of_a_folder_is_of_names_and_contents(tmp_path):
    for name in ("a", "b"):
        (tmp_path / name / "in").mkdir(parents=True)
        (tmp_path / name / "in/one").write_text("1")
        (tmp_path / name / "two").write_text("2")
    assert facts(tmp_path / "a")["sha256"] == facts(tmp_path / "b")["sha256"]
    (tmp_path / "b/two").rename(tmp_path / "b/three")
    (tmp_path / "b/in/one").write_text("12")
    assert facts(tmp_path / "a")["sha256"] != facts(tmp_path / "b")["sha256"]
    assert stamp(tmp_path / "b")[::2] == [3, 2]


def test_what_is_to_be_done_again(tmp_path):
    source, output = tmp_path / "a.png", tmp_path / "out/a.png"
    output.parent.mkdir()
    source.write_text("in")
    output.write_text("out")
    item, options = Item("a.png", str(source)), {"all": {}}
    record = {"item": "a.png", "inputs": {str(source): facts(source)}, "outputs": {"a.png": facts(output)}}
    with Manifest(tmp_path / "out") as manifest:
        job = make_plan([item], manifest, options).jobs["a.png"]
        manifest.append(record | {"status": "done", "job": job})
    held = record["inputs"], record["outputs"]

    def todo(options=options, **more):
        with Manifest(tmp_path / "out") as manifest:
            plan = make_plan([item], manifest, options, **more)
            assert plan.kept + len(plan.todo) == 1
            return plan.todo[0][1] if plan.todo else "kept"

    assert todo() == "kept"
    assert todo({"all": {"zoom": "2"}}) == Known(is_other=True) == todo(overwrite=True)
    assert todo(check=True) == Known(*held)
    source.write_text("in, another")
    assert todo() == Known(*held)  # whose hash tells
    output.write_text("tuo")
    assert todo(check=True) == Known() and todo() == Known(*held)
    output.unlink()
    assert todo() == Known()
    with Manifest(tmp_path / "out") as manifest:
        manifest.append({"item": "a.png", "status": "failed", "job": job})
    assert json.loads((tmp_path / "out/batch.jsonl").read_text().splitlines()[-1])["status"] == "failed"
    assert todo() == Known()


def test_shards_work_side_by_side_and_not_beside_a_whole_batch(tmp_path):
    with Manifest(tmp_path, (1, 2)) as one, Manifest(tmp_path, (2, 2)) as two:
        one.append(RECORD | {"at": "1"})
        two.append(RECORD | {"item": "b", "at": "1"})
        for shard in ((1, 2), (1, 1)):
            with pytest.raises(InputError, match="another batch is at work"), Manifest(tmp_path, shard):
                pass
    with Manifest(tmp_path) as whole:
        assert whole.last("a") is not None and whole.last("b") is not None
        whole.append(RECORD | {"status": "failed", "at": "2"})
        with pytest.raises(InputError, match="another batch is at work"), Manifest(tmp_path, (2, 2)):
            pass
    with Manifest(tmp_path, (2, 2)) as manifest:
        assert manifest.last("a")["status"] == "failed" and manifest.last("b")["status"] == "done"


def test_what_ended_a_run_is_done_first_and_fails_after_another(tmp_path):
    items, options = [Item(name, f"{name}.png") for name in "abcd"], {"all": {}}
    with Manifest(tmp_path) as manifest:
        jobs = make_plan(items, manifest, options).jobs
        for name, tries in (("b", 1), ("c", 2)):
            manifest.append({"item": name, "status": "begun", "tries": tries, "job": jobs[name]})
        manifest.append({"item": "d", "status": "stopped", "job": jobs["d"]})
    with Manifest(tmp_path) as manifest:
        plan = make_plan(items, manifest, options)
    assert [item.name for item, _ in plan.todo] == ["b", "a", "d"] and plan.suspects == 1
    assert plan.failed == [items[2]] and plan.tries == {"b": 1, "c": 2}
