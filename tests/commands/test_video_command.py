"""`lightfield-gs video` from outside."""

import json
import signal
import subprocess
import sys
import time
from dataclasses import replace
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
import torch
from command_line import PANEL, complaint, heed_ctrl_c, run
from rgbd_scene import view

from lightfield_gs import Gaussians, cli, encode, render
from lightfield_gs.io.images import read_image, read_info, write_image
from lightfield_gs.panels.rig import Rig
from lightfield_gs.show.preview import to_integers
from lightfield_gs.video.camera_path import orbit, turntable
from lightfield_gs.video.frame_folder import frame_name
from lightfield_gs.video.video_file import VideoFile

SIZE = 40, 30


def frame(folder: str, number: int) -> np.ndarray:
    return read_image(Path(folder) / frame_name(number), as_stored=True)


def contents(folder: str) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in Path(folder).iterdir()}


def decoded(path: str) -> list[np.ndarray]:
    av = pytest.importorskip("av", reason="videos need the extra `video`")
    with av.open(path) as container:
        return [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]


def write_rgbd(count: int = 3) -> list[np.ndarray]:
    """Folders `photos` and `depths`, and `both` with the two side by side; the latter's pictures are returned."""
    pictures = []
    for name in ("photos", "depths", "both"):
        Path(name).mkdir()
    for number in range(count):
        colours, depth, _ = view(*SIZE, 40.0, 0.1 * number)
        grey = to_integers(np.repeat(((1 / depth - 0.3) / 0.7)[..., None], 3, 2), 8)
        colours = to_integers(colours, 8)
        write_image(f"photos/{number + 9}.png", colours)  # 9, 10, 11: by value, not by letters
        write_image(f"depths/{number + 9}.png", grey)
        pictures.append(np.concatenate([colours, grey], 1))
        write_image(f"both/{number + 9}_rgbd.png", pictures[-1])
    return pictures


# Scenes


def test_frames_are_those_of_encode(folder, capsys):
    run(capsys, "encode s.ply -o o.png --panel p.yaml")
    out = run(capsys, "video s.ply -o frames --panel p.yaml --turntable 2 --fps 3")
    assert out.startswith("frames: 6 frames of 96 x 60, native, PNG, 3 a second\n")
    assert (frame("frames", 0) == read_image("o.png", as_stored=True)).all()
    gaussians = Gaussians.load("s.ply")
    rig = Rig.frame(gaussians, PANEL)
    for number, degrees in ((1, 60), (5, 300)):
        expected = orbit(rig, PANEL, degrees)
        assert (frame("frames", number) == encode(gaussians, PANEL, expected).numpy()).all()
        told = read_info(Path("frames") / frame_name(number)).metadata
        assert json.loads(told["rig"]) == expected.to_dict() and json.loads(told["panel"])["views"] == 12
    assert len(list(Path("frames").iterdir())) == 7


def test_frames_have_the_look_that_is_asked_for(folder, capsys):
    look = "--panel p.yaml --focus 3.9 --zoom 1.1 --cone 8"
    for line in ("encode s.ply -o o.png", "video s.ply -o frames --frames 2"):
        assert cli.main(f"{line} {look}".split()) == 0
        told = capsys.readouterr()  # a scene so deep is worth a note
        assert "look: depth 3.9 in" in told.out and told.err.count("note:") == told.err.count("\n")
    assert (frame("frames", 0) == read_image("o.png", as_stored=True)).all()


def test_frames_of_every_kind_are_averaged_over_the_views_that_are_asked_for(folder, capsys):
    rest = "--panel p.yaml --frames 1 --view-filter 3"
    for kind in ("native", "quilt --quilt 4x3 --quilt-size 400x186", "2d"):
        run(capsys, f"video s.ply -o {kind[:2]} --kind {kind} {rest}")
    run(capsys, "encode s.ply -o o.png --panel p.yaml --view-filter 3")
    run(capsys, "quilt s.ply -o q_qs4x3a1.6.png --tiles 4x3 --size 400x186 --panel p.yaml --view-filter 3")
    assert (frame("na", 0) == read_image("o.png", as_stored=True)).all()
    assert (frame("qu", 0) == read_image("q_qs4x3a1.6.png", as_stored=True)).all()
    run(capsys, "video s.ply -o without --kind 2d --panel p.yaml --frames 1")
    assert np.abs(frame("2d", 0).astype(int) - frame("without", 0)).max() > 5


def test_a_lossless_video_has_the_same_frames(folder, capsys):
    pytest.importorskip("av", reason="videos need the extra `video`")
    line = "video s.ply --panel p.yaml --turntable 1 --fps 5 --degrees 40 -o"
    run(capsys, f"{line} frames")
    for name in ("a.mkv", "a.mp4"):
        run(capsys, f"{line} {name}")
        frames = decoded(name)
        assert len(frames) == 5 and all((image == frame("frames", n)).all() for n, image in enumerate(frames))


def test_a_path(folder, capsys):
    gaussians = Gaussians.load("s.ply")
    rigs = turntable(Rig.frame(gaussians, PANEL), PANEL, 3, 90)
    keyframes = [{"time": 2 * number, "rig": rig.to_dict()} for number, rig in enumerate(rigs)]
    Path("path.json").write_text(json.dumps({"keyframes": keyframes}))
    out = run(capsys, "video s.ply -o frames --panel p.yaml --path path.json --fps 1")
    assert "5 frames" in out and "path: path.json, 3 keyframes in 4 s" in out
    for number, rig in enumerate(rigs):
        assert (frame("frames", 2 * number) == encode(gaussians, PANEL, rig).numpy()).all()


def test_a_quilt_has_the_left_most_camera_at_the_bottom_left(folder, capsys):
    out = run(capsys, "video s.ply -o frames --kind quilt --quilt 4x3 --quilt-size 400x186 --panel p.yaml --frames 2")
    assert out.startswith("frames: 2 frames of 400 x 186, quilt of 4 x 3 views")
    gaussians = Gaussians.load("s.ply")
    rig = Rig.frame(gaussians, PANEL)
    scale = 100 / 96, 62 / 60
    rig.focal_px = tuple(np.multiply(rig.focal_px, scale))
    rig.principal_point_px = tuple(np.multiply(rig.principal_point_px, scale))
    views = render(gaussians, rig.cameras(replace(PANEL, width_px=100, height_px=62)), background=(1, 1, 1)).image
    quilt = frame("frames", 0)
    for number, (row, column) in ((0, (2, 0)), (1, (2, 1)), (4, (1, 0)), (11, (0, 3))):
        tile = quilt[62 * row : 62 * (row + 1), 100 * column : 100 * (column + 1)]
        expected = (255 * views[11 - number].clamp(0, 1)).round().to(torch.uint8).numpy()
        assert (tile == expected).all()


def test_one_eye_sways(folder, capsys):
    run(capsys, "video s.ply -o still --kind 2d --panel p.yaml --frames 1")
    run(capsys, "video s.ply -o sway --sway 1 --fps 4 --panel p.yaml --frames 4 --degrees 0")
    frames = [frame("sway", number).astype(int) for number in range(4)]
    assert frames[0].shape == (60, 96, 3) and np.abs(frames[0] - frame("still", 0)).max() <= 1
    assert np.abs(frames[0] - frames[2]).max() <= 1 and np.abs(frames[1] - frames[3]).max() > 20


def test_a_quilt_video_has_the_name_that_says_so(folder, capsys, monkeypatch):
    pytest.importorskip("av", reason="videos need the extra `video`")
    casts = []
    monkeypatch.setattr("lightfield_gs.show.bridge.check_bridge", lambda url: None)
    monkeypatch.setattr("lightfield_gs.show.bridge.cast", lambda *args, **more: casts.append((*args, more)))
    line = "video s.ply --panel p.yaml --frames 2 --quilt-size 400x186 --crf 0 --bridge http://localhost:1"
    run(capsys, f"{line} -o q.mp4 --quilt 4x3")
    out = run(capsys, f"{line} -o other_qs4x3a1.6.mp4")
    assert {path.name for path in Path().glob("*.mp4")} == {"q_qs4x3a1.6.mp4", "other_qs4x3a1.6.mp4"}
    assert casts[0] == (Path("q_qs4x3a1.6.mp4"), 4, 3, 1.6, {"url": "http://localhost:1"})
    assert "shown by Looking Glass Bridge" in out and decoded("q_qs4x3a1.6.mp4")[1].shape == (186, 400, 3)


# Ends and beginnings

SLOW = "video s.ply -o {} --panel toy-8v --turntable 4 --fps 30 --compression small --threads 1 --writers 2"


def start(folder: str) -> subprocess.Popen:
    """The command as a program, once it has written some frames."""
    program = [sys.executable, "-m", "lightfield_gs", *SLOW.format(folder).split()]
    running = subprocess.Popen(
        program, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, preexec_fn=heed_ctrl_c
    )
    while not (Path(folder) / frame_name(5)).exists():
        assert running.poll() is None, running.communicate()
        time.sleep(0.01)
    return running


@pytest.mark.parametrize("number, code", [(signal.SIGKILL, -9), (signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_stopped_and_taken_up_again_is_the_same_folder(folder, capsys, number, code):
    running = start("part")
    running.send_signal(number)
    _, errors = running.communicate()
    assert running.returncode == code and "Traceback" not in errors
    there = {name: data for name, data in contents("part").items() if name.startswith("frame-")}
    assert 4 <= len(there) < 120  # two writers: one frame before the sixth may be missing
    out = run(capsys, SLOW.format("part").replace("--writers 2", "--writers 3"))
    assert f"of which {len(there)} were there" in out
    run(capsys, SLOW.format("whole"))
    part = contents("part")
    assert part == contents("whole") and there.items() <= part.items() and len(part) == 121


def test_another_scene_or_option_is_another_job(folder, capsys):
    line = "video s.ply -o frames --panel p.yaml --frames 2"
    run(capsys, line)
    before = contents("frames")
    assert "another job: background differ" in complaint(capsys, f"{line} --background 0,0,0")
    assert contents("frames") == before
    assert "of which 2 were there" in run(capsys, line)
    run(capsys, f"{line} --background 0,0,0 --overwrite")
    assert contents("frames").keys() == before.keys() and frame("frames", 0).mean() < frame("frames", 0).max()


# Sequences


def test_photos_with_depths_in_a_row(folder, capsys):
    write_rgbd()
    more = "--panel p.yaml --depth-kind disparity --depth-range 1,3.3333 --fov 53"
    out = run(capsys, f"video photos -o apart --depth depths {more}")
    assert out.count("3 frames of 96 x 60") == 1 and out.count("photos/9.png: 40 x 30") == 1
    run(capsys, f"video both -o joined {more} --rgbd right")
    run(capsys, f"encode photos/9.png --depth depths/9.png -o first.png --save-rig r.yaml --fit cover {more}")
    run(capsys, f"encode photos/11.png --depth depths/11.png -o last.png --rig r.yaml --fit cover {more}")
    for name in ("apart", "joined"):
        assert (frame(name, 0) == read_image("first.png", as_stored=True)).all()
        assert (frame(name, 2) == read_image("last.png", as_stored=True)).all()  # framed as the first
    run(capsys, f"video photos -o each --depth depths --reframe {more}")
    run(capsys, f"encode photos/11.png --depth depths/11.png -o each.png {more}")
    assert (frame("each", 2) == read_image("each.png", as_stored=True)).all()


def test_a_video_with_depth_beside_it(folder, capsys):
    pytest.importorskip("av", reason="videos need the extra `video`")
    pictures = write_rgbd()
    with VideoFile("in.mkv", 3, (2 * SIZE[0], SIZE[1]), Fraction(12), "ffv1") as sink:
        for number, picture in enumerate(pictures):
            sink.put(number, picture)
    more = "--panel p.yaml --rgbd right --depth-range 1,3.3333 --fov 53"
    run(capsys, f"video both -o files {more}")
    out = run(capsys, f"video in.mkv -o frames {more}")
    assert "3 frames of 96 x 60, native, PNG, 12 a second" in out
    assert "\nin.mkv: " in f"\n{out}" and "all as in.mkv, the first" in out and "in.png" not in out
    assert complaint(capsys, "video in.mkv -o no --panel p.yaml").startswith("lightfield-gs: error: in.mkv has no")
    assert all((frame("frames", number) == frame("files", number)).all() for number in range(3))
    (Path("frames") / frame_name(1)).unlink()
    assert "of which 2 were there" in run(capsys, f"video in.mkv -o frames {more}")
    assert (frame("frames", 1) == frame("files", 1)).all()


@pytest.mark.parametrize("black", [0, 2])
def test_the_half_of_depths_is_that_of_the_first_picture_that_shows_it(folder, capsys, black):
    """Videos fade in from black and out to it."""
    pictures = write_rgbd()
    write_image(f"both/{black + 9}_rgbd.png", 0 * pictures[black])
    out = run(capsys, "video both -o frames --panel p.yaml")
    shows = 1 if black == 0 else 0
    assert f"depth: the right half of each picture, as picture {shows} shows it (assumed; --rgbd)" in out
    run(capsys, f"encode both/{shows + 9}_rgbd.png -o shown.png --panel p.yaml --rgbd right --fit cover")
    assert (
        frame("frames", black).max() < 10 and (frame("frames", shows) == read_image("shown.png", as_stored=True)).all()
    )


@pytest.mark.parametrize(
    "line, words",
    [
        ("video s.ply", "required"),
        ("video s.ply -o a.mp4 --codec h264", "4:2:0"),
        ("video s.ply -o a.gif", "expected .mp4"),
        ("video s.ply -o frames --codec ffv1", "is a folder of PNG files"),
        ("video s.ply -o a.mp4 --quilt 4x3 --kind native", "--quilt is for --kind quilt"),
        ("video s.ply -o frames --quilt 4x3 --bridge", "--bridge shows one file"),
        ("video s.ply -o a.mp4 --quilt 4x3 --bridge http://127.0.0.1:9", "Bridge does not answer|PyAV"),
        ("video s.ply -o frames --turntable 3 --path p.json", "take each other's place"),
        ("video s.ply -o frames --rig r.yaml --path p.json", "--path and --rig take each other's place"),
        ("video s.ply -o frames --turntable 3 --frames 5", "take each other's place"),
        ("video s.ply -o frames --path no.json", "cannot read"),
        ("video s.ply -o frames --fps 0", "expected frames a second"),
        ("video s.ply -o frames --fps nan", "expected frames a second"),
        ("video s.ply -o frames --quilt 4x3 --quilt-size 3x300", "too few for 4 x 3 views"),
        ("video s.ply -o a_qs4x3a1.6.mp4 --quilt portrait", "its name says|PyAV"),
        ("video s.ply -o frames --reframe", "is for pictures in a row"),
        ("video s.ply -o frames --depth d", "--depth is for photos"),
        ("video s.ply -o frames --kind 2d --quality fast", "of native pictures"),
        ("video s.ply -o p.yaml", "expected .mp4"),
        ("video photos -o frames --turntable 3", "is a sequence"),
        ("video photos -o frames --depth p.yaml", "expected a folder or a video"),
        ("video photos -o frames --depth one", "one for each of the 3 pictures"),
        ("video empty -o frames", ""),
        ("video p.mp4 -o frames", "not a video|PyAV"),
    ],
)
def test_complaints(folder, capsys, line, words):
    import re

    write_rgbd()
    for name in ("one", "empty"):
        Path(name).mkdir()
    write_image("one/a.png", np.zeros((30, 40, 3), np.uint8))
    Path("p.mp4").write_text("no video")
    assert re.search(words, complaint(capsys, line + " --panel p.yaml"))
    assert not Path("frames").exists() and not Path("a.mp4").exists()
