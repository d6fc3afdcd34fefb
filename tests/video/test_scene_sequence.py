"""Scenes in a row: which folders are one, reading ahead, one framing for all, and the film of `video`."""

import json
import threading
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from command_line import PANEL, complaint, run
from PIL import Image
from scene_film_maker import dance, write_dance

from lightfield_gs import Gaussians, cli, encode
from lightfield_gs.io.images import read_image, read_info
from lightfield_gs.io.scenes.files import read_scene
from lightfield_gs.panels.rig import Rig
from lightfield_gs.video.frame_folder import frame_name
from lightfield_gs.video.scene_sequence import SceneReader, find_scene_sequence


@pytest.mark.parametrize("suffix", [".ply", ".glb", ".spz", ".splat"])
@pytest.mark.filterwarnings("ignore::lightfield_gs.base.assumptions.Loss")
def test_numbered_scenes_are_a_sequence_in_the_order_of_their_numbers(suffix, tmp_path):
    paths = write_dance(tmp_path / "s", suffix=suffix)
    paths[1].unlink()
    (tmp_path / "s/notes.txt").touch()
    (tmp_path / "s/.hidden_3.ply").touch()
    found = find_scene_sequence(tmp_path / "s")
    assert [path.name for path in found.files] == [f"frame_{number}{suffix}" for number in (8, 10, 11, 12)]
    assert found.gaps == 1 and "1 number between them without a file" in found.describe()


@pytest.mark.parametrize(
    "names",
    [
        ["a_1.ply"],
        ["a_1.ply", "b_2.ply"],
        ["a.ply", "b.ply"],
        ["a_1.ply", "a_2.spz"],
        ["a_1.ply", "a_2.ply", "photo.jpg"],
        ["meta.json", "a_1.ply", "a_2.ply"],
    ],
)
def test_other_folders_are_no_sequence(names, tmp_path):
    for name in names:
        (tmp_path / name).touch()
    assert find_scene_sequence(tmp_path) is None
    assert find_scene_sequence(tmp_path / names[0]) is None


def test_a_thread_reads_ahead_and_few_scenes_are_held(tmp_path):
    write_dance(tmp_path / "s", steps=9)
    sequence = find_scene_sequence(tmp_path / "s")
    seen, threads, arrived = [], set(), threading.Semaphore(0)

    def read(path):
        seen.append(sequence.files.index(path))
        threads.add(threading.current_thread())
        arrived.release()
        return read_scene(path)

    with SceneReader(sequence, read) as reader:
        arrived.acquire()  # the first file, by this thread
        assert torch.equal(reader.at(1, [2, 3]).means, dance(1, 9).means)
        for _ in range(3):
            assert arrived.acquire(timeout=30)  # 2 and 3 come unasked
        assert seen == [0, 1, 2, 3] and len(threads) == 2
        for number in range(2, 9):
            reader.at(number, range(number + 1, 9))
        assert sorted(seen) == list(range(9)) and len(reader._held) <= 3
    with SceneReader(sequence, read, most_bytes=1 << 30) as reader:  # as on a page that plays again and again
        seen.clear()
        for number in [*range(9)] * 3:
            reader.at(number, [(number + 1) % 9, (number + 2) % 9])
        assert sorted(seen) == list(range(1, 9))


def test_all_scenes_have_the_origin_of_the_first(tmp_path):
    (tmp_path / "s").mkdir()
    for number in range(2):
        dance(number, 2, origin=(1e6 + 100 * number, 0.0, -5.0)).save(tmp_path / f"s/{number}.ply")
    sequence = find_scene_sequence(tmp_path / "s")
    with SceneReader(sequence, read_scene) as reader:
        one, other = reader.at(0), reader.at(1)
    assert one.origin == other.origin
    shift = np.array([1e6 + 100, 0, -5]) - one.origin
    assert torch.allclose(other.means.double(), dance(1, 2).means.double() + torch.from_numpy(shift), atol=1e-4)


def test_the_sample_holds_what_rests_once_and_what_moves_everywhere(tmp_path):
    write_dance(tmp_path / "s", steps=5)
    with SceneReader(find_scene_sequence(tmp_path / "s"), read_scene) as reader:
        sample = reader.sample()
    rests = dance(0).means[:40]
    assert sample.count == 60
    found = (sample.means[:, None] == rests).all(2).sum(0)
    assert found.tolist() == [1] * 40
    assert sample.means[:, 0].max() > 2.5 and sample.means[:, 0].min() < -0.3


# video


@pytest.fixture
def desk(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    PANEL.to_yaml("p.yaml")
    return tmp_path


def test_video_draws_each_scene_by_the_same_rig_that_holds_all(desk, capsys):
    paths = write_dance(desk / "dance")
    said = run(capsys, "video dance -o out --panel p.yaml --fps 12 --device cpu")
    assert "5 frames" in said and "12 a second" in said and "scenes: 5 in a row, frame_8.ply to frame_12.ply" in said
    rigs = {read_info(f"out/{frame_name(number)}").metadata["rig"] for number in range(5)}
    assert len(rigs) == 1
    rig = Rig(**json.loads(rigs.pop()))
    for number, path in enumerate(paths):
        image = encode(Gaussians.load(path), PANEL, rig)
        assert np.array_equal(read_image(f"out/{frame_name(number)}", as_stored=True), image.numpy())
    for scene in (dance(0), dance(4)):  # both ends of the way are on the panel
        camera = scene.means.double().numpy() @ rig.world_to_camera[:3, :3].T + rig.world_to_camera[:3, 3]
        across = rig.focal_px[0] * camera[:, 0] / camera[:, 2] + rig.principal_point_px[0]
        assert 0 < across.min() and across.max() < PANEL.width_px
    alone = Rig.frame(dance(0), PANEL)
    camera = dance(4).means.double().numpy() @ alone.world_to_camera[:3, :3].T + alone.world_to_camera[:3, 3]
    assert (alone.focal_px[0] * camera[:, 0] / camera[:, 2] + alone.principal_point_px[0]).max() > PANEL.width_px


def test_a_stopped_film_goes_on_and_a_changed_scene_begins_another(desk, capsys):
    paths = write_dance(desk / "dance")
    line = "video dance -o out --panel p.yaml --device cpu"
    run(capsys, f"{line}")
    before = {path.name: path.read_bytes() for path in Path("out").iterdir()}
    Path("out", frame_name(2)).unlink()
    assert "of which 4 were there" in run(capsys, line)
    assert {path.name: path.read_bytes() for path in Path("out").iterdir()} == before
    moved = dance(2)
    replace(moved, means=moved.means + 0.01).save(paths[2])
    assert "another job" in complaint(capsys, line)
    assert "2 frames" in run(capsys, f"{line} --overwrite --frames 2")


def test_what_is_wrong_with_a_scene_names_its_file(desk, capsys):
    paths = write_dance(desk / "dance", 12)
    paths[6].write_bytes(paths[6].read_bytes()[:-50])
    assert cli.main("video dance -o out --panel p.yaml --device cpu".split()) == 2
    assert "frame_14.ply" in capsys.readouterr().err


@pytest.mark.parametrize("words", ["--turntable 4", "--path k.yaml", "--reframe"])
def test_options_of_one_scene_are_refused(words, desk, capsys):
    write_dance(desk / "dance")
    assert "is not for scenes in a row" in complaint(capsys, f"video dance -o out --panel p.yaml {words}")
    Image.new("RGB", (8, 8)).save("m.png")
    assert "is for photos" in complaint(capsys, "video dance -o out --panel p.yaml --mask m.png")
    assert "video and view play scenes that are numbered" in complaint(capsys, "encode dance -o o.png --panel p.yaml")
