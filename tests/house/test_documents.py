"""README.md and docs/: their commands run, and their links lead somewhere.

Commands run in this process, one document after the other, each in a folder of its own with stand-ins for the files
that it names. Slow things are made small: panels, the scenes and repeats of benchmarks, the steps and Gaussians of
fits, the steps and networks of training. The other options of a document stay, except the names of panels,
benchmark scenes and networks.
"""

from __future__ import annotations

import json
import pkgutil
import re
import runpy
import shlex
import shutil
import subprocess
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from importlib import import_module
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
import torch
import yaml
from command_line import PANEL, scene
from documents import DOCUMENTS, LANGUAGES, REASONS, ROOT, anchors, blocks, links, named_paths, prose
from fit_capture import write_capture
from PIL import Image
from srn_scene import write_object

from benchmarks import training_step
from lightfield_gs import Panel, Rig, cli
from lightfield_gs.bench import pareto
from lightfield_gs.bench.scenes import oracle_samples
from lightfield_gs.encoding.view_files import read_cameras

# What the documents name is tested where it belongs, and under the sanitizers there
pytestmark = pytest.mark.not_sanitized

SMALL = replace(PANEL, views=96)  # documents name views of the default panel
UNET = {"base_channels": 8, "multipliers": [1, 2], "blocks": 1, "attention_px": [8], "heads": 2}
by_name = pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: path.name)


@pytest.fixture
def desk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """The folder that a document's commands run in: a reader's own files under the names that documents give them."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(training_step, "OBJECTS", 1)
    monkeypatch.setattr(training_step, "SIZE_PX", 16)
    monkeypatch.setattr(pareto, "oracle_samples", partial(oracle_samples, count=20))
    threads = torch.get_num_threads()
    torch.set_num_threads(1)  # nothing here has work for more
    _write_photos()
    _write_scene()
    _write_panels()
    write_capture(Path("capture"))
    for number, folder in enumerate(("data/own/train/a", "data/own/train/b", "data/own/val/c")):
        write_object(Path(folder), seed=number)
    shutil.copytree(ROOT / "configs", "configs")
    Path("tiny.yaml").write_text(yaml.safe_dump({"image_size_px": 16, "features": 8, "unet": UNET}))
    yield tmp_path
    torch.set_num_threads(threads)


def _write_photos() -> None:
    cat = Image.open(ROOT / "lightfield_gs/data/cat.png").resize((96, 96))
    white = Image.new("RGBA", cat.size, "white")
    white.alpha_composite(cat)
    depth = np.tile(np.linspace(40, 200, 96).astype(np.uint8), (96, 1))
    cat.save("photo.png")
    white.convert("RGB").save("photo.jpg", quality=95)
    cat.getchannel("A").save("mask.png")
    Path("photos").mkdir()
    for number in range(2):
        cat.save(f"photos/{number}.png")
    Image.fromarray(depth).save("depth.png")
    np.save("depth.npy", 1 + depth.astype(np.float32) / 255)
    pair = np.concatenate([np.asarray(white.convert("RGB")), np.repeat(depth[..., None], 3, 2)], axis=1)
    Image.fromarray(pair).save("pair.jpg", quality=95)


def _write_scene() -> None:
    moved = scene()
    moved.means[:, 2] += 3  # before cameras at the origin that look along z
    moved.save("scene.ply")
    Path("dance").mkdir()
    for number in range(2):
        moved.save(f"dance/frame_{number}.ply")
    camera = {"width": 96, "height": 60, "fx": 90.0, "fy": 90.0, "position": [0, 0, 0], "rotation": np.eye(3).tolist()}
    cameras = [{**camera, "id": number, "img_name": f"{number:03d}"} for number in range(13)]
    Path("cameras.json").write_text(json.dumps(cameras))


def _write_panels() -> None:
    SMALL.to_yaml("small.yaml")
    SMALL.to_yaml("my-panel.yaml")
    display = {"pitch": 42.0, "slope": -6.0, "center": 0.3, "DPI": 136, "screenW": 96, "screenH": 60, "viewCone": 40}
    display = {key: {"value": value} for key, value in display.items()}
    Path("visual.json").write_text(json.dumps(display))
    devices = {str(n): {"hwid": {"value": name}, "calibration": display} for n, name in enumerate(("LKG-A", "LKG-B"))}
    Path("displays.json").write_text(json.dumps({"devices": devices}))
    views = Rig(np.eye(4), (90.0, 90.0), (48.0, 30.0), 3.0).cameras(SMALL)
    fields = ("world_to_camera", "focal_px", "principal_point_px")
    Path("views.json").write_text(json.dumps({name: getattr(views, name).tolist() for name in fields}))
    np.save("views.npy", SMALL.view_map())


# How commands run


def _is_panel_name(word: str) -> bool:
    return (ROOT / f"configs/panels/{word}.yaml").is_file()


def _with_small_panel(words: list[str]) -> list[str]:
    """The panels that have names, and the default one, become the small one."""
    words = ["small.yaml" if _is_panel_name(word) else word for word in words]
    takes_panel = words[0] in ("encode", "batch", "simulate", "prune", "bench") and words[1] not in (
        "dense",
        "training-step",
    )
    if "--stereo" in words:  # a screen of two eyes is no panel
        return words if "--eye-size" in words else [*words, "--eye-size", "96x60"]
    return [*words, "--panel", "small.yaml"] if takes_panel and "--panel" not in words else words


def _small_bench(words: list[str]) -> list[str]:
    """Synthetic scenes of a few Gaussians, judged at a few sub-pixels, each drawn once."""
    kind = next((word for word in words[1:2] if not word.startswith("-")), "light-field")
    words = [re.sub(r"sheet:\d+", "sheet:8", re.sub(r"cloud:\d+", "cloud:64", word)) for word in words]
    words += ["--repeats", "1"]
    if kind in ("light-field", "paper"):
        words += ["--oracle-samples", "20"]
    if kind in ("light-field", "paper", "pareto", "skips") and "--scene" not in words:
        words += ["--scene", "sheet:8"]
    if kind == "dense":
        words += ["--gaussians", "100", "--size", "60x40"]
    return [*words, "--cone", "40"] if kind == "pareto" else words


def _run_lightfield_gs(words: list[str]) -> None:
    words = _with_small_panel(words)
    if words[0] in SHORTENED and "dance" not in words:  # scenes in a row are as many frames as files
        words = [*words, *SHORTENED[words[0]]]
    assert cli.main(_small_bench(words) if words[0] == "bench" else words) == 0, words


SHORTENED = {
    "fit": ("--steps", "4", "--gaussians", "200", "--device", "cpu"),
    "quilt": ("--size", "96x96"),
    "video": ("--turntable", "0.1"),  # seconds
}
SHORT_RUN = "--stages [{steps:~1,~image_size_px:~32,~objects:~2}] --targets 1 --validation_objects 1 --validate_every 1"
SHORTER = {
    "benchmarks.make_captures": "--photographs 3 --width 32",
    "training.data.make_small": "--objects 1",
    "training.train": f"{SHORT_RUN} --optimizer.warmup_steps 1",
    "training.compare": f"{SHORT_RUN} --optimizer.warmup_steps 1 --model tiny.yaml",
    "training.evaluate": "--limit 1",
}


def _run_module(module: str, words: list[str]) -> None:
    """A command of training/ or benchmarks/, as long as it takes to try it."""
    words = words + [word.replace("~", " ") for word in SHORTER.get(module, "").split()]
    if module == "training.train" and "configs/training/finetune.yaml" not in words:
        words += ["--model", "tiny.yaml"]
    assert import_module(module).main(words) == 0, (module, words)


def _run_make(target: str, *settings: str) -> None:
    """Assert that make knows the target, and run the demos' commands. The suite does not run itself."""
    plan = subprocess.run(["make", "-n", target, *settings], cwd=ROOT, capture_output=True, text=True)
    assert plan.returncode == 0, plan.stderr
    if target in ("demo", "demo-fit"):
        lines = [line for line in plan.stdout.replace("\\\n", "").splitlines() if "bin/lightfield-gs" in line]
        assert lines
        Path("demo").mkdir(exist_ok=True)
        for line in lines:
            words = shlex.split(line)[1:]
            _run_lightfield_gs([str(ROOT / word) if _is_of_the_checkout(word) else word for word in words])


def _is_of_the_checkout(word: str) -> bool:
    return "/" in word and (ROOT / word).exists() and not Path(word).exists()


def _run_line(line: str) -> None:
    words = shlex.split(line, comments=True)
    if words[0] == "lightfield-gs":
        _run_lightfield_gs(words[1:])
    elif words[0] == "make":
        _run_make(*words[1:])
    elif words[:2] == ["python", "-m"]:
        _run_module(words[2], words[3:])
    elif words[:2] == ["python", "-c"]:
        exec(compile(words[2], line, "exec"), {})
    else:
        pytest.fail(f"no way to run it: {line}")


def _run_python(text: str) -> None:
    text = re.sub(r'"([\w-]+)"', lambda found: '"small.yaml"' if _is_panel_name(found[1]) else found[0], text)
    Path("block.py").write_text(text)
    runpy.run_path("block.py")


@pytest.mark.slow
@by_name
def test_every_command_runs_or_says_what_it_needs(document, desk):
    for block in blocks(document):
        assert block.language in LANGUAGES, block
        assert block.needs in {None, *REASONS}, block
        if block.needs is not None:
            assert block.language in ("sh", "python"), block
        elif block.language == "sh":
            for line in block.text.splitlines():
                _run_line(line)
        elif block.language == "python" and not block.included:  # test_examples.py runs files
            _run_python(block.text)


@by_name
def test_no_command_hides_outside_of_a_block(document):
    assert (
        re.findall(r"^ {4,}(?:\$ )?(?:lightfield-gs|python|make|pip|torchrun|blender) .*", prose(document), re.M) == []
    )


@by_name
def test_panels_rigs_and_cameras_are_read_as_they_are_printed(document, tmp_path):
    base: dict = {}
    for block in blocks(document):
        path = tmp_path / f"block.{block.language}"
        path.write_text(block.text)
        if block.language == "yaml" and "world_to_camera" in block.text:
            Rig.from_yaml(path)
        elif block.language == "yaml":
            base = {**base, **yaml.safe_load(block.text)}
            path.write_text(yaml.safe_dump(base))
            Panel.from_yaml(path)
        elif block.language == "json":
            assert read_cameras(path, replace(SMALL, views=1)).count == 1


def test_the_default_panel_is_the_one_that_is_printed(tmp_path):
    (text, *_) = (b.text for b in blocks(ROOT / "docs/panels.md") if b.language == "yaml" and "width_px" in b.text)
    (tmp_path / "65in-8k-96v.yaml").write_text(text)
    assert Panel.from_yaml(tmp_path / "65in-8k-96v.yaml") == Panel.load("65in-8k-96v")


# What documents point at


@by_name
def test_links_lead_somewhere(document):
    for link in links(document):
        name, _, anchor = link.partition("#")
        target = document.parent / name if name else document
        assert target.is_file(), link
        assert not anchor or anchor in anchors(target), link
        assert document.parent == ROOT or ROOT / "docs" in target.resolve().parents, f"{link} leaves the website"


@by_name
def test_files_that_are_named_exist(document):
    assert sorted(name for name in named_paths(document) if not (ROOT / name).exists()) == []


@pytest.mark.parametrize("picture", sorted((ROOT / "docs/pictures").glob("*.svg")), ids=lambda path: path.name)
def test_files_that_are_drawn_exist(picture):
    names = re.findall(r"[\w/]+(?:\.py|/(?=[<,]))", picture.read_text(encoding="utf-8"))
    assert [name for name in names if not (ROOT / "lightfield_gs" / name).exists()] == []


@by_name
def test_targets_of_make_that_are_named_exist(document):
    known = set(re.findall(r"^([\w-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE)) | {"sanitize-cuda"}
    assert set(re.findall(r"`make (?:-\w+ )*([\w-]+)", prose(document))) <= known


def test_comments_point_at_headings_that_exist():
    found = {}
    for path in (path for top in ("csrc", "lightfield_gs", "training", "tests") for path in (ROOT / top).rglob("*.*")):
        if path.suffix in (".py", ".h", ".cuh", ".cu", ".cpp") and path != Path(__file__):
            text = path.read_text(encoding="utf-8")
            assert "DESIGN, section" not in text, path
            named = re.findall(r'docs/design\.md, "([^"]+)"', text)
            found.update({" ".join(re.sub("\n *(//|#)?", " ", heading).split()): path for heading in named})
    headings = set(re.findall(r"^#+ (.+)$", prose(ROOT / "docs/design.md"), re.MULTILINE))
    assert found and {heading: path for heading, path in found.items() if heading not in headings} == {}


# What they say


def test_every_public_name_is_in_the_reference():
    """The names of the package, and of every room that says by __all__ which of its names are public."""
    entries = re.findall(r"^::: (\S+)$", (ROOT / "docs/reference.md").read_text(encoding="utf-8"), re.MULTILINE)
    shown = [pkgutil.resolve_name(entry) for entry in entries]
    for room in (one for one in list(shown) if isinstance(one, ModuleType)):
        shown += [getattr(room, name) for name in room.__all__]
    files = [
        path for path in (ROOT / "lightfield_gs").rglob("*.py") if "\n__all__ = " in path.read_text(encoding="utf-8")
    ]
    rooms = [".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__") for path in files]
    assert {"lightfield_gs", "lightfield_gs.fitting", "lightfield_gs.gsplat", "lightfield_gs.reference"} <= set(rooms)
    public = {
        f"{room}.{name}": getattr(import_module(room), name) for room in rooms for name in import_module(room).__all__
    }
    assert [name for name, value in public.items() if not any(value is one for one in shown)] == []
    assert len(set(entries)) == len(entries)


def test_every_page_is_in_the_table_of_contents():
    text = (ROOT / "mkdocs.yml").read_text(encoding="utf-8")
    pages = {page for entry in yaml.safe_load(text)["nav"] for page in entry.values()}
    assert pages == {path.name for path in DOCUMENTS if path.parent != ROOT}
