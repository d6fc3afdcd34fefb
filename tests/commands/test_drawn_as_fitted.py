"""A scene is drawn as its file says that it was fitted or trained, unless an option says otherwise."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import scene_formats as made
from command_line import PANEL, complaint, run, scene

from lightfield_gs import Gaussians, prune
from lightfield_gs.fitting.fit import FitResult
from lightfield_gs.fitting.settings import FitSettings
from lightfield_gs.io.images import read_image, read_info
from lightfield_gs.panels.rig import Rig

COMMON = "--panel p.yaml --rig r.yaml --device cpu"


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The folder that commands run in: a panel, a rig, and the scene without a word on its fit."""
    monkeypatch.chdir(tmp_path)
    PANEL.to_yaml("p.yaml")
    Rig(np.eye(4), (96.0, 96.0), (48.0, 30.0), 2.0).to_yaml("r.yaml")
    shifted().save("plain.ply")


def shifted() -> Gaussians:
    """Before the rig, with Gaussians smaller than a pixel, which anti-aliasing shows fainter."""
    made = scene()
    made.means[:, 2] += 2
    made.scales *= 0.1
    return made


def fitted(name: str, **settings) -> None:
    FitResult(shifted(), FitSettings(**settings), 5, None, [], False).save(name)


def picture(capsys, line: str) -> tuple[np.ndarray, str]:
    out = run(capsys, f"encode {line} -o o.png {COMMON}")
    return read_image("o.png", as_stored=True), out


def test_background_and_anti_aliasing_are_those_of_the_fit(capsys):
    fitted("f.ply", antialiased=True, background=(0.0, 0.5, 0.25))
    options = "--antialiased --background 0,0.5,0.25"
    expected, silent = picture(capsys, f"plain.ply {options}")
    image, out = picture(capsys, "f.ply")
    assert np.array_equal(image, expected)
    assert "background: 0,0.5,0.25, which the scene was fitted before" in out and "--no-antialiased" in out
    encoding = json.loads(read_info("o.png").metadata["encoding"])
    assert encoding["antialiased"] is True and encoding["background"] == [0, 0.5, 0.25]
    assert "fitted" not in silent
    assert "fitted: by lightfield-gs, anti-aliased, background 0,0.5,0.25\n" in run(capsys, "info f.ply")


def test_options_go_before_it(capsys):
    fitted("f.ply", antialiased=True)
    plain, _ = picture(capsys, "plain.ply")
    image, out = picture(capsys, "f.ply --no-antialiased --background 1,1,1")
    assert np.array_equal(image, plain) and "fitted" not in out
    assert not np.array_equal(picture(capsys, "f.ply --background 1,1,1")[0], plain)


def test_a_random_background_is_none(capsys):
    fitted("f.ply", background=None)
    assert np.array_equal(picture(capsys, "f.ply")[0], picture(capsys, "plain.ply")[0])


@pytest.mark.parametrize(
    "command", ["prune f.ply -o g.ply --contribution-cut 1e-3", "encode f.ply -o o.png --save-gaussians g.ply"]
)
def test_scenes_made_of_it_say_it_too(capsys, command):
    fitted("f.ply", antialiased=True, background=(0.0, 0.0, 1.0))
    out = run(capsys, f"{command} {COMMON}")
    assert "drawn with anti-aliasing" in out
    assert "fitted: by lightfield-gs, anti-aliased, background 0,0,1\n" in run(capsys, "info g.ply")
    if command.startswith("prune"):
        expected = prune(Gaussians.load("plain.ply"), PANEL, Rig.from_yaml("r.yaml"), 1e-3, antialiased=True)
        with pytest.warns(UserWarning, match="antialiased=True"):
            assert np.array_equal(Gaussians.load("g.ply").means, expected.means)


@pytest.mark.parametrize("said", ["{", "[]", '{"background": [0, 0, 7]}', '{"antialiased": 1}'])
def test_a_line_that_is_none_is_refused_and_options_go_before_it(capsys, said):
    shifted().save("f.ply", [f"lightfield-gs fit: {said}"])
    assert "f.ply: its line of how it was fitted is none" in complaint(capsys, f"encode f.ply -o o.png {COMMON}")
    picture(capsys, "f.ply --no-antialiased --background 0,0,0")
    assert "fitted: its line of how" in run(capsys, "info f.ply")


MARKED = {  # file: what it holds
    "brush.ply": lambda: ["Exported from Brush", "SplatRenderMode: mip"],
    "postshot.ply": lambda: ["antialiased 1"],
    "spelled.ply": lambda: ["Antialiasing = yes"],
    "last-word.ply": lambda: ["splatrendermode: default", "Antialiased 1"],
    "packed.ply": lambda: made.compressed_ply().replace(b"comment by hand", b"comment SplatRenderMode: mip"),
    "a.spz": lambda: made.spz(3, flags=1),
    "model.sog": lambda: made.zipped(made.sog(model="antialiased")),
    "older.sog": lambda: made.zipped(made.sog(antialias=True)),
}
UNMARKED = {
    "none.ply": lambda: ["Exported from Brush", "SplatRenderMode: default"],
    "last-word.ply": lambda: ["SplatRenderMode: mip", "antialiased 0"],
    "prose.ply": lambda: ["not antialiased 1 bit", "SplatRenderMode: mipmaps"],
    "a.spz": lambda: made.spz(3),
    "surfels.sog": lambda: made.zipped(made.sog(model="2dgs", antialias=False)),
}


def marked(name: str, holds) -> None:
    if isinstance(content := holds(), bytes):
        Path(name).write_bytes(content)
    else:
        shifted().save(name, content)


@pytest.mark.parametrize("name", MARKED)
def test_what_a_file_says_of_anti_aliasing_decides_in_every_format(capsys, name):
    marked(name, MARKED[name])
    image, out = picture(capsys, name)
    assert out.count("anti-aliasing: the file says that it was trained so (without: --no-antialiased)") == 1
    asserted, _ = picture(capsys, f"{name} --antialiased")
    otherwise, silent = picture(capsys, f"{name} --no-antialiased")
    assert np.array_equal(image, asserted) and "anti-aliasing" not in silent
    assert "anti-aliasing: trained with it" in run(capsys, f"info {name}")
    if name not in ("a.spz", "packed.ply") and not name.endswith(".sog"):  # whose Gaussians are large
        assert not np.array_equal(image, otherwise)
    with pytest.warns(UserWarning, match="antialiased=True"):
        Gaussians.load(name)


@pytest.mark.parametrize("name", UNMARKED)
def test_no_other_word_on_anti_aliasing_decides(capsys, name):
    marked(name, UNMARKED[name])
    assert "anti-aliasing" not in picture(capsys, name)[1] + run(capsys, f"info {name}")


@pytest.mark.parametrize("end", ["ply", "spz"])
def test_scenes_drawn_with_anti_aliasing_say_so_when_they_are_written(capsys, end):
    for index, options in enumerate(("plain.ply --antialiased", "brush.ply")):
        marked("brush.ply", MARKED["brush.ply"])
        run(capsys, f"encode {options} -o o.png --save-gaussians {index}.{end} {COMMON}")
        assert "trained so" in picture(capsys, f"{index}.{end}")[1]
    fitted("f.ply", antialiased=True)
    run(capsys, f"encode f.ply --no-antialiased -o o.png --save-gaussians g.{end} {COMMON}")
    assert "anti-aliasing" not in picture(capsys, f"g.{end}")[1]
    fitted("f.spz", antialiased=True)
    assert "trained so" in picture(capsys, "f.spz")[1]
    assert "cannot say" in run(capsys, f"prune brush.ply -o g.splat --contribution-cut 1e-3 {COMMON}")
