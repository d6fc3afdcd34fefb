"""The items of a batch."""

import json
import shutil
from pathlib import Path

import pytest
from command_line import scene
from fit_capture import write_capture

from lightfield_gs import InputError
from lightfield_gs.batch.items import Item, read_items

PHOTO = Path(__file__).resolve().parents[2] / "lightfield_gs/data/cat.png"
OUT = Path("out")


@pytest.fixture
def inputs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    for name in ("in/a.png", "in/deep/b.jpg", "in/out/c.png", "in/.hidden.png"):
        Path(name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(PHOTO, name)
    scene().save("in/deep/s.v2.ply")
    write_capture(Path("in/capture"))
    Path("in/clip.mp4").write_bytes(b"")
    Path("in/readme.txt").write_text("words")
    Path("in/deep/back").symlink_to(tmp_path / "in")
    return tmp_path


def listed(*lines: str | dict) -> list[Item]:
    text = "\n".join(line if isinstance(line, str) else json.dumps(line) for line in lines)
    Path("list.txt").write_text(text)
    return read_items("list.txt", ".png", OUT)[0]


def test_a_folder_has_what_it_holds(inputs):
    items, left = read_items("in", ".png", Path("in/out"))
    found = {item.name: (item.input, item.command) for item in items}
    assert found == {
        "a.png": ("in/a.png", "encode"),
        "capture.png": ("in/capture", "fit"),
        "clip": ("in/clip.mp4", "video"),
        "deep/b.png": ("in/deep/b.jpg", "encode"),
        "deep/s.v2.png": ("in/deep/s.v2.ply", "encode"),
    }
    assert left == {".txt": 1} and [item.is_long for item in items] == [False, True, True, False, False]


def test_a_list_has_paths_and_objects(inputs):
    absolute = inputs / "in/deep/b.jpg"
    items = listed(
        "# mine",
        "",
        "in/a.png",
        str(absolute),
        "in/deep",
        {"input": "in/a.png", "output": "x/other.tif", "depth_amount": 0.5, "pan": [-0.1, 0.2], "depth_report": True},
        {"input": "in/deep/s.v2.ply", "command": "video", "antialiased": False},
        {"input": "in/capture", "fit_options": "--steps 9"},
    )
    assert items == [
        Item("in/a.png", "in/a.png"),
        Item(absolute.with_suffix(".png").relative_to("/").as_posix(), str(absolute)),
        Item("in/deep", "in/deep", "video"),
        Item("x/other.tif", "in/a.png", "encode", ("--depth-amount=0.5", "--pan=-0.1,0.2", "--depth-report")),
        Item("in/deep/s.v2", "in/deep/s.v2.ply", "video", ("--no-antialiased",)),
        Item("in/capture.png", "in/capture", "fit", (), ("--steps", "9")),
    ]


@pytest.mark.parametrize(
    "line, words",
    [
        ('{"input": "a.png"', "list.txt, line 1: expected a path or a JSON object"),
        ({"output": "a.png"}, "input: expected a text, got none"),
        ({"input": "a.png", "output": "../a.png"}, "expected a name in the folder of the batch"),
        ({"input": "a.png", "output": "a.jpg"}, "expected a .png, .tif or .exr"),
        ({"input": "a.png", "command": "weave"}, "command: expected encode, fit, video, got 'weave'"),
        ({"input": "a.png", "rig": {"zero": 1}}, "rig: expected a text"),
        ({"input": "a.png", "fit_options": "'"}, "expected options as on the command line"),
        ("# nothing", "list.txt: expected photos, scenes, captures or videos, got none"),
    ],
)
def test_lists_that_cannot_be_meant(inputs, line, words):
    with pytest.raises(InputError, match=words.replace(".", r"\.")):
        listed(line)


def test_two_inputs_never_become_one_file(inputs):
    shutil.copy(PHOTO, "in/a.tif")
    with pytest.raises(InputError, match=r"in/a.png and in/a.tif would both become a.png; name outputs in a list"):
        read_items("in", ".png", OUT)
    with pytest.raises(InputError, match="in/capture is one capture; give the folder it is in"):
        read_items("in/capture", ".png", OUT)
