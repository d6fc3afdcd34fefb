"""Refusals of the command line: one line for every complaint, nothing half-written and no input overwritten."""

import re

import numpy as np
import pytest
import torch
from command_line import complaint

from lightfield_gs import _core, cli
from lightfield_gs.base.cli_messages import as_options
from lightfield_gs.io.images import write_image
from lightfield_gs.io.scenes import files as scene_file
from lightfield_gs.panels.panel import Panel


@pytest.mark.parametrize(
    "line, words",
    [
        ("", "COMMAND"),
        ("paint x", "invalid choice"),
        ("encode", "required"),
        ("encode s.ply", "-o"),
        ("encode s.ply -o o.jpg", "extension"),
        ("encode s.ply -o no/o.png", "no folder"),
        ("encode s.ply -o .", "folder"),
        ("encode s.ply -o o.png --panel nix", "known: "),
        ("encode s.ply -o o.png --panel no.yaml", "cannot read"),
        ("encode s.ply -o o.png --panel s.ply", "unknown name|not YAML"),
        ("encode s.ply -o o.png --rig no.yaml", "cannot read"),
        ("encode s.ply -o o.png --rig p.yaml", "unknown key"),
        ("encode no.ply -o o.png", "cannot read"),
        ("encode no.jpg -o o.png", "cannot read"),
        ("encode text.png -o o.png", "not an image"),
        ("encode cut.ply -o o.png", "cut"),
        ("encode scene.spz -o o.png", "is no .spz"),
        ("encode s.ply -o o.png --mask m.png", "--mask is for photos"),
        ("encode s.ply -o o.png --cameras c.json", "for --method sorted"),
        ("encode s.ply -o o.png --method classic --view-map m.npy", "for --method sorted"),
        ("encode s.ply -o o.png --memory-budget 1GB", "for --method sorted"),
        ("encode s.ply -o o.png --method sorted --memory-budget 1000", "256MB"),
        ("encode s.ply -o o.png --method sorted --memory-budget 0MB", "256MB"),
        ("encode s.ply -o o.png --method sorted --memory-budget 1KB", "too small"),
        ("encode s.ply -o o.png --method sorted --cameras no.json", "cannot read"),
        ("encode s.ply -o o.png --method sorted --cameras text.png", "not JSON"),
        ("encode s.ply -o o.png --method sorted --cameras c.json --save-rig r.yaml", "leave out one"),
        ("encode s.ply -o o.png --method sorted --cameras c.json --rig r.yaml", "leave out one"),
        ("encode s.ply -o o.png --method sorted --view-map no.npy", "cannot read"),
        ("encode s.ply -o o.png --device tpu", "invalid choice"),
        ("encode s.ply -o o.png --method guess", "invalid choice"),
        ("encode s.ply -o o.png --views all", "invalid choice"),
        ("encode s.ply -o o.png --background 1,2,3", "0..1"),
        ("encode s.ply -o o.png --background -1,0,0", "0..1"),
        ("encode s.ply -o o.png --background redd", "3 numbers"),
        ("encode s.ply -o o.png --background nan,0,0", "3 numbers"),
        ("encode s.ply -o o.png --bit-depth 12", "invalid choice"),
        ("encode s.ply -o o.png --bit-depth 32", "bits"),
        ("encode s.ply -o o.exr --bit-depth 8", "bits"),
        ("encode s.ply -o o.png --threads 0", "1..1024"),
        ("encode s.ply -o o.png --threads many", "1..1024"),
        ("encode s.ply -o o.png --unknown", "unrecognized"),
        ("encode s.ply -o o.png --save-rig no/r.yaml", "no folder"),
        ("encode s.ply -o o.png --save-gaussians no/g.ply", "no folder"),
        (
            "encode s.ply -o o.png --method sorted --cameras c.json --views continuous",
            "--views continuous .* --cameras",
        ),
        ("encode s.ply -o o.png --method sorted --view-map m.npy --views continuous", "--view-map takes the place"),
        ("encode s.ply -o o.png --method sorted --quality fast", "--quality fast is for --method direct, not sorted"),
        (
            "encode photo.png -o o.png --depth d.npy",
            "d.npy: expected a depth map of the photo's size 16 x 16, or of its shape, got 9 x 8",
        ),
        ("encode photo.png -o o.png --depth d.npy --depth-scale inf", "finite number > 0, got inf"),
        ("encode photo.png -o o.png --depth d.npy --intrinsics 0,9,8,8", "--intrinsics: expected focal lengths > 0"),
        ("encode s.ply -o o.png --viewing-distance 0", "--viewing-distance: .* mm"),
        ("encode s.ply -o o.png --save-gaussians g.txt", "ends in .ply"),
        ("encode s.ply -o o.png --save-rig o.png", "o.png is named for two outputs"),
        ("encode s.ply -o o.png --save-gaussians g.ply --save-rig ./g.ply", "named for two outputs"),
        ("encode s.ply -o views.png --preview .", "two outputs"),
        ("prune s.ply -o l.ply --save-rig l.ply", "two outputs"),
        ("encode photo.png -o o.png --checkpoint text.png", "checkpoint"),
        ("encode photo.png -o o.png --mask wrong.png", "mask"),
        ("encode busy.png -o o.png", "--mask"),
        ("encode s.ply -o o.png --preview text.png", "it is a file; give a folder"),
        ("encode s.ply -o o.png --preview /proc/x", "/proc/x"),
        ("encode s.ply -o o.png --preview /proc", "write in /proc"),
        ("encode no.ply -o o.png --preview deep/v", "cannot read"),
        ("simulate photo.png --eye 0,0,600 -o e.png", "give --panel"),
        ("simulate o.png --eye 0,0 -o e.png", "3 numbers"),
        ("simulate photo.png --panel p.yaml --eye 0,0,600 -o e.png", "16 x 16 pixels"),
        ("simulate plain.png --panel p.yaml --eye 0,0,-600 -o e.png", "above 0"),
        ("simulate plain.png --panel p.yaml --eye 0,0,600 --spread 0 -o e.png", "--spread: .*1000 sub-pixels"),
        (
            "simulate plain.png --panel bare.yaml --eye 0,0,600 -o e.png",
            "lacks viewing_distance_mm and .*give --viewing",
        ),
        ("info", "required"),
        ("info no.png", "cannot read"),
        ("info text.png", "not an image"),
        ("info text.safetensors", "safetensors"),
        ("info nix", "known: "),
    ],
)
def test_complaints_are_one_line_and_leave_nothing(folder, capsys, line, words):
    (folder / "text.png").write_text("hello")
    (folder / "text.safetensors").write_text("hello")
    (folder / "scene.spz").write_bytes(b"\0")
    (folder / "cut.ply").write_bytes((folder / "s.ply").read_bytes()[:-9])
    (folder / "bare.yaml").write_text("width_px: 96\nheight_px: 60\nviews: 4\nline_number: 9.8\nslant_tan: 0\n")
    cut_out = np.zeros((16, 16, 4), np.uint8)
    cut_out[4:12, 4:12] = 255
    write_image("photo.png", cut_out)
    write_image("wrong.png", cut_out[:9])
    np.save("d.npy", np.ones((8, 9)))
    write_image("busy.png", np.random.default_rng(0).integers(0, 255, (32, 32, 3), np.uint8))
    write_image("plain.png", np.zeros((60, 96, 3), np.uint8))
    before = {path.name for path in folder.iterdir()}
    if "--panel" not in line and line.startswith("encode") and "-o" in line:
        line += " --panel p.yaml"
    assert re.search(words, complaint(capsys, line))
    after = {path.name for path in folder.iterdir()}
    assert after == before


@pytest.mark.parametrize(
    "line, name",
    [
        ("encode photo.png -o photo.png", "photo.png"),
        ("encode photo.png -o ./deep/../photo.png", "photo.png"),
        ("encode photo.png -o link.png", "link.png"),
        ("encode s.ply -o o.png --save-rig s.ply", "s.ply"),
        ("encode s.ply -o o.png --save-gaussians s.ply", "s.ply"),
        ("encode s.ply -o o.png --save-rig p.yaml", "p.yaml"),
        ("encode s.ply -o o.png --rig r.yaml --save-rig r.yaml", "r.yaml"),
        ("encode photo.png -o m.png --mask m.png", "m.png"),
        ("encode photo.png -o d.png --depth d.png", "d.png"),
        ("encode s.ply -o o.png --method sorted --cameras c.json --save-rig c.json", "c.json"),
        ("encode s.ply -o o.png --method sorted --view-map m.npy --save-rig m.npy", "m.npy"),
        ("encode photo.png -o o.png --checkpoint n.safetensors --save-rig n.safetensors", "n.safetensors"),
        ("encode deep/views.png -o o.png --preview deep", "deep/views.png"),
        ("prune s.ply -o s.ply", "s.ply"),
        ("prune s.ply -o l.ply --rig r.yaml --save-rig r.yaml", "r.yaml"),
        ("simulate photo.png --eye 0,0,600 -o photo.png", "photo.png"),
        ("bench --scene sheet:8,s.ply --json s.ply", "s.ply"),
        ("bench photo --photo photo.png --json photo.png", "photo"),
    ],
)
def test_an_input_is_never_written_over(folder, capsys, line, name):
    (folder / "deep").mkdir()
    for file in ("photo.png", "m.png", "d.png", "r.yaml", "c.json", "m.npy", "n.safetensors", "deep/views.png"):
        (folder / file).write_text("kept")
    (folder / "link.png").symlink_to("photo.png")
    before = {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}
    if "--panel" not in line:
        line += " --panel p.yaml"
    error = complaint(capsys, line)
    assert name in error and "is also an input; give the output another name" in error
    assert {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()} == before


@pytest.mark.parametrize(
    "devices, version, words",
    [
        (("cpu",), "13.0", "this build has no CUDA stages; install"),
        (("cpu", "cuda"), None, f"this torch, {torch.__version__}, is a CPU build; install"),
        (("cpu", "cuda"), "13.0", f"torch {torch.__version__} finds no GPU that it can use; see"),
    ],
)
def test_cuda_is_asked_for_in_vain(folder, capsys, monkeypatch, devices, version, words):
    monkeypatch.setattr(_core, "cuda", None, raising=False)
    if "cuda" not in devices:
        monkeypatch.delattr(_core, "cuda")
    monkeypatch.setattr(torch.version, "cuda", version)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert words in complaint(capsys, "encode s.ply -o o.png --panel p.yaml --device cuda")
    assert cli.main("encode s.ply -o o.png --panel p.yaml".split()) == 0


def test_interrupt(folder, capsys, monkeypatch):
    monkeypatch.setattr(Panel, "load", lambda source, serial: (_ for _ in ()).throw(KeyboardInterrupt))
    assert cli.main("encode s.ply -o o.png --panel p.yaml".split()) == 130
    assert capsys.readouterr().err == "lightfield-gs: error: interrupted\n"


def test_out_of_memory(folder, capsys, monkeypatch):
    for error in (
        MemoryError(),
        RuntimeError("DefaultCPUAllocator: can't allocate memory: you tried"),
        torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 20.00 GiB."),
    ):
        monkeypatch.setattr(scene_file, "read_scene", lambda *_, error=error, **__: (_ for _ in ()).throw(error))
        assert "out of memory" in complaint(capsys, "encode s.ply -o o.png --panel p.yaml")


def test_faults_of_our_own_are_not_hidden(folder, monkeypatch):
    monkeypatch.setattr(scene_file, "read_scene", lambda *_, **__: (_ for _ in ()).throw(RuntimeError("a bug")))
    with pytest.raises(RuntimeError, match="a bug"):
        cli.main("encode s.ply -o o.png".split())


@pytest.mark.parametrize(
    "message, expected",
    [
        ("leave out cameras= and view_map=, or", "leave out --cameras and --view-map, or"),
        ("device='cuda': none, or use device='cpu'", "--device cuda: none, or use --device cpu"),
        ("(else tiles=4x3); give span=FIRST:LAST:STEP", "(else --tiles 4x3); give --frames FIRST:LAST:STEP"),
        (
            "antialiased=True or antialiased=False, serial=SERIAL",
            "--antialiased or --no-antialiased, --device-serial SERIAL",
        ),
        ("a=1.png: got 'b=2', in x/c=3", "a=1.png: got 'b=2', in x/c=3"),
    ],
)
def test_arguments_in_messages_become_options(message, expected):
    assert as_options(message) == expected
