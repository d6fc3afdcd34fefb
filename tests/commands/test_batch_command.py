"""`lightfield-gs batch` from outside: what it makes is what `encode`, `fit` and `video` make, whatever happens."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from command_line import complaint, scene
from fit_capture import write_capture
from PIL import Image

from lightfield_gs import cli
from lightfield_gs.batch import manifest
from lightfield_gs.io.images import read_image
from lightfield_gs.io.text_files import config_path

pytestmark = pytest.mark.not_sanitized  # what draws is in other processes, and the same as that of `encode`
PHOTO = Path(__file__).resolve().parents[2] / "lightfield_gs/data/cat.png"
LIKE = "--panel p.yaml --threads 1"
PROGRAM = (sys.executable, "-m", "lightfield_gs", "batch")
ONE = f"{LIKE} --processes 1 --devices cpu"


def lines() -> list[dict]:
    paths = sorted(Path("out").glob("batch*.jsonl"))
    found = [json.loads(line) for path in paths for line in path.read_text().splitlines()]
    return [line for line in found if line.get("status") != "begun"]


def of_items(since: int = 0) -> dict[str, str]:
    """How items ended, of the lines from a number on, each of which must be of another item."""
    found = [(line["item"], line["status"]) for line in lines()[since:] if "item" in line]
    assert len(dict(found)) == len(found)
    return dict(found)


def batch(capsys, line: str, code: int = 0) -> str:
    assert cli.main(["batch", *line.split(), *ONE.split()]) == code
    told = capsys.readouterr()
    return told.out + told.err


def same_as(capsys, command: str, one: str, other: str) -> None:
    assert cli.main([*command.split(), *LIKE.split(), "--device", "cpu"]) == 0
    capsys.readouterr()
    assert Path(one).read_bytes() == Path(other).read_bytes()


@pytest.fixture
def inputs(folder: Path) -> Path:
    """In the folder of commands: a list of a photo, two scenes, one of them with options, and what is no image."""
    for number in range(2):
        scene(seed=number).save(f"s{number}.ply")
    Image.open(PHOTO).resize((64, 64)).save("cat.png")
    Path("bad.png").write_text("no image")
    entries = ["cat.png", "s0.ply", {"input": "s1.ply", "output": "deep/one.png", "depth_amount": 0.5}, "bad.png"]
    Path("list").write_text("\n".join(line if isinstance(line, str) else json.dumps(line) for line in entries))
    return folder


@pytest.mark.slow
def test_a_batch_is_what_encode_is_and_does_only_what_is_to_be_done(inputs, capsys):
    told = batch(capsys, "list -o out", code=1)
    assert "out: 3 of 4 items are done, 0 of them before" in told and "cpu:0: 4 items in" in told
    assert "failed: bad.png: bad.png is not an image that can be read" in told and "1 item failed" in told
    same_as(capsys, "encode cat.png -o 1.png", "out/cat.png", "1.png")
    same_as(capsys, "encode s0.ply -o 2.png", "out/s0.png", "2.png")
    same_as(capsys, "encode s1.ply -o 3.png --depth-amount 0.5", "out/deep/one.png", "3.png")
    cat = next(line for line in lines() if line.get("item") == "cat.png")
    assert cat["said"][0].startswith("cat.png: 64 x 64, cut out by its alpha") and set(cat["seconds"]) == {
        "read",
        "draw",
        "write",
    }
    assert lines()[0]["options"]["all"]["panel"]["views"] == 12 and "ended" in lines()[-1]

    # What changed is done again, also where its size and date are as before; what only has another date is not
    before, kept = len(lines()), Path("out/cat.png").stat().st_mtime_ns
    os.utime("cat.png")
    scene(seed=5).save("s0.ply")
    shutil.copy("s1.ply", "bad.png")  # whose content says what it is
    Path("bad.png").rename("bad.ply")
    Path("list").write_text(Path("list").read_text().replace("bad.png", "bad.ply"))
    Path("out/deep/one.png").unlink()
    assert "out: 4 of 4 items are done, 0 of them before" in batch(capsys, "list -o out")
    assert of_items(before) == {"cat.png": "done", "s0.png": "done", "deep/one.png": "done", "bad.png": "done"}
    assert Path("out/cat.png").stat().st_mtime_ns == kept
    same_as(capsys, "encode s0.ply -o 4.png", "out/s0.png", "4.png")
    assert Path("out/deep/one.png").read_bytes() == Path("3.png").read_bytes()
    assert "all 4 items were done before" in batch(capsys, "list -o out")

    # An image that is not what it was is found, and other options make other images
    Path("out/s0.png").write_bytes(Path("4.png").read_bytes()[:-1] + b"x")
    before = len(lines())
    assert "all 4 items" in batch(capsys, "list -o out")
    assert "4 of 4 items are done" in batch(capsys, "list -o out --check")
    assert Path("out/s0.png").read_bytes() == Path("4.png").read_bytes() and len(of_items(before)) == 4
    Path("list").write_text("s0.ply")
    batch(capsys, "list -o out --zoom 2")
    same_as(capsys, "encode s0.ply -o 5.png --zoom 2", "out/s0.png", "5.png")


COUNT = 60  # items, of which each takes some time


def start(line: str) -> subprocess.Popen:
    program = [*PROGRAM, *line.split(), *ONE.replace("1 --d", "2 --d").split()]
    return subprocess.Popen(program, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def wait_for(running: subprocess.Popen, count: int) -> None:
    """Until so many items are done."""
    while sum(path.read_text().count('"status": "done"') for path in Path("out").glob("batch*.jsonl")) < count:
        assert running.poll() is None, running.communicate()
        time.sleep(0.01)


def workers_of(running: subprocess.Popen) -> list[int]:
    """The processes that a batch has begun, and that are not over."""
    found = subprocess.run(
        ["ps", "-ww", "-o", "pid=,args=", "--ppid", str(running.pid)], capture_output=True, text=True
    )
    return [int(line.split()[0]) for line in found.stdout.splitlines() if "spawn_main" in line]


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="asks Linux's ps for the processes")
def test_a_batch_that_is_killed_goes_on(folder, capsys, monkeypatch):
    Path("in").mkdir()
    shutil.copy(config_path("panels", "toy-8v"), "p.yaml")  # of a size that takes time
    for number in range(COUNT):
        shutil.copy("s.ply", f"in/{number:03d}.ply")
    running = start("in -o out --compression small")
    wait_for(running, 3)
    with monkeypatch.context() as patch:
        patch.setattr(manifest, "_PATIENCE_S", 0.0)  # the first batch may be over in less
        assert "another batch is at work in out" in complaint(capsys, f"batch in -o out {ONE}")
    os.kill(workers_of(running)[0], signal.SIGKILL)  # which the batch survives
    wait_for(running, 16)
    running.kill()
    running.wait()
    done = {name for name, status in of_items().items() if status == "done"}
    times = {name: (Path("out") / name).stat().st_mtime_ns for name in done}
    assert 16 <= len(done) < COUNT
    Path("out/.000.0123456789ab.png").write_bytes(b"half")  # as of a file that was being written
    assert f"{COUNT} of {COUNT} items are done, {len(done)} of them before" in batch(
        capsys, "in -o out --compression small"
    )
    assert of_items() == dict.fromkeys((f"{number:03d}.png" for number in range(COUNT)), "done")
    assert times == {name: (Path("out") / name).stat().st_mtime_ns for name in done}
    assert not list(Path("out").glob(".*")) and len(list(Path("out").glob("*.png"))) == COUNT


@pytest.mark.slow
def test_captures_and_videos(folder, capsys):
    write_capture(Path("in/capture"))
    frames = Path("frames")
    frames.mkdir()
    for number in range(2):
        Image.open(PHOTO).resize((64, 64)).rotate(9 * number).save(frames / f"{number}.png")
    entries = ["in/capture", "frames", {"input": "s.ply", "command": "video", "output": "turn", "frames": 2}]
    Path("list").write_text("\n".join(line if isinstance(line, str) else json.dumps(line) for line in entries))
    fit = "--steps 4 --gaussians 200 --test-every none"
    line = ["batch", "list", "-o", "out", *ONE.split(), "--fit-options", fit, "--video-options", "--fps 5"]
    assert cli.main(line) == 0
    assert "3 of 3 items are done" in capsys.readouterr().out
    assert cli.main(f"fit in/capture -o capture.ply {fit} --device cpu".split()) == 0
    assert Path("capture.ply").read_bytes() == Path("out/in/capture.ply").read_bytes()
    same_as(capsys, "encode capture.ply -o capture.png", "out/in/capture.png", "capture.png")
    for source, there in (("frames", "frames"), ("s.ply", "turn")):
        more = "--frames 2" if there == "turn" else ""
        assert cli.main(f"video {source} -o v-{there} --fps 5 {more} {LIKE} --device cpu".split()) == 0
        for name in ("frame-000000.png", "frame-000001.png"):
            assert (Path("out") / there / name).read_bytes() == (Path(f"v-{there}") / name).read_bytes()

    # The frames of one video over all processes: a folder of pictures, seen by the rig of the first
    assert cli.main(f"encode frames/0.png -o 0.png --save-rig rig.yaml {LIKE} --device cpu".split()) == 0
    batch(capsys, "frames -o each --rig rig.yaml")
    for number in range(2):
        there = read_image(f"v-frames/frame-{number:06d}.png", as_stored=True)
        assert (read_image(f"each/{number}.png", as_stored=True) == there).all()

    # Other options start a fit and a video over, and another picture a video
    entries = len(lines())
    line[-1] = "--fps 6"
    line[-3] = fit.replace("4", "5", 1)
    assert cli.main(line) == 0
    ended = [line["status"] for line in lines()[entries:] if "item" in line]
    assert ended == ["done"] * 3
    assert json.loads(Path("out/turn/frames.json").read_text())["fps"] == 6


@pytest.mark.slow
def test_shards_make_the_same_side_by_side(inputs, capsys):
    shards = [subprocess.Popen([*PROGRAM, *f"list -o out {LIKE} --devices cpu --shard {n}/2".split()]) for n in (1, 2)]
    assert [shard.wait() for shard in shards] == [0, 1]  # the second has bad.png
    assert of_items() == {"cat.png": "done", "deep/one.png": "done", "s0.png": "done", "bad.png": "failed"}
    assert len({line["where"] for line in lines() if "item" in line}) == 2
    same_as(capsys, "encode cat.png -o 1.png", "out/cat.png", "1.png")
    same_as(capsys, "encode s1.ply -o 3.png --depth-amount 0.5", "out/deep/one.png", "3.png")
    told = batch(capsys, "list -o out", code=1)  # which goes by their manifests
    assert "out: 3 of 4 items are done, 3 of them before" in told and "failed: bad.png" in told


def test_what_cannot_be_done_is_said_at_once(folder, capsys):
    def refused(line: str) -> str:
        return complaint(capsys, f"batch {line}")

    Path("in").mkdir()
    assert "in: expected photos, scenes, captures or videos, got none" in refused("in -o out")
    assert "s.ply is not a list of inputs" in refused("s.ply -o out")
    shutil.copy("s.ply", "in/s.ply")
    assert "q.yaml" in refused("in -o out --panel q.yaml")
    assert "--devices: expected cpu, or GPUs" in refused("in -o out --panel p.yaml --devices gpu")
    assert "--fit-options: expected options" in refused("in -o out --panel p.yaml --fit-options '")
    assert "it is a file; give a folder" in refused("in -o s.ply --panel p.yaml")
    assert "expected I/N, such as 1/8 to 8/8, got '9/8'" in refused("in -o out --panel p.yaml --shard 9/8")
    assert "leave out --processes" in refused("in -o out --panel p.yaml --shard 1/2 --processes 2")
