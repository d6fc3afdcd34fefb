"""The command line from outside: files in, files out; what it refuses is in test_cli_complaints.py."""

import hashlib
import json
import re
import shlex
import subprocess
import sys

import numpy as np
import pytest
import torch
from command_line import PANEL, complaint, run, scene
from PIL import Image

from lightfield_gs import cli
from lightfield_gs.io.images import read_image, read_info, write_image
from lightfield_gs.panels.panel import Panel
from lightfield_gs.panels.rig import Rig
from lightfield_gs.scene.gaussians import Gaussians
from lightfield_gs.show import preview
from lightfield_gs.show.preview import contact_sheet, look_around

# encode


def test_encode_writes_the_image_and_says_what_it_took(folder, capsys):
    lines = run(capsys, "encode s.ply -o o.png --panel p.yaml").splitlines()
    assert lines[0] == "o.png: 96 x 60, 12 views, 60 Gaussians"
    assert lines[-1] == "next: lightfield-gs show o.png" and not any(" s, total " in line for line in lines)
    pixels = read_image("o.png", as_stored=True)
    assert pixels.shape == (60, 96, 3) and pixels.dtype == np.uint8 and 20 < pixels.mean() < 250


def test_encode_prints_what_was_skipped(folder, capsys):
    plain = run(capsys, "encode s.ply -o o.png --panel p.yaml").splitlines()
    shown = run(capsys, "encode s.ply -o o.png --panel p.yaml --stats").splitlines()
    assert plain[1:] == shown[-2:] and shown[-2].startswith("axes: -y is up (assumed: ")
    stages = [part.rsplit(" ", 2)[0] for part in shown[1].split(", ")]
    assert {"load", "project", "composite", "write"} <= set(stages) and stages[-1] == "total"
    assert shown[2].startswith("intersections of tile and Gaussian: ")
    assert re.fullmatch(r"of 60 Gaussians not drawn: \d+ behind, \d+ faint, \d+ pruned, \d+ outside", shown[3])
    for start in (
        "colours by polynomial order",
        "tiles: ",
        "lattices: 0 good enough",
        "sub-pixels that ended early: ",
        "evaluations per sub-pixel: ",
    ):
        assert any(line.startswith(start) for line in shown)
    sorted_lines = run(capsys, "encode s.ply -o o.png --panel p.yaml --method sorted --stats").splitlines()
    assert [line.split(":")[0] for line in sorted_lines[2:-2]] == [shown[2].split(":")[0], "evaluations per sub-pixel"]


def test_the_last_line_says_what_to_do_next(folder, capsys):
    def last(line: str) -> str:
        assert cli.main(shlex.split(line)) == 0
        return capsys.readouterr().out.splitlines()[-1]

    assert last("encode s.ply -o 'my o.png' --panel p.yaml") == "next: lightfield-gs show 'my o.png'"
    weave = last("quilt s.ply -o q --panel p.yaml --tiles 4x3 --size 96x60")
    assert weave.startswith("next: lightfield-gs weave q_qs4x3") and weave.endswith(" -o q-3d.png --panel p.yaml")
    assert last(weave.removeprefix("next: lightfield-gs ")) == "next: lightfield-gs show q-3d.png"
    encode = last("prune s.ply -o less.ply --panel p.yaml")
    assert encode == "next: lightfield-gs encode less.ply -o less.png --panel p.yaml"
    assert last("calibrate nudge p.yaml -o n.yaml --pitch-by 0.1% --pattern pitch").endswith(" show n-pitch.png")
    assert run(capsys, "encode s.ply -o o.png --panel p.yaml --quiet") == ""


def test_encode_is_the_library_call(folder, capsys):
    from lightfield_gs.encoding.encode import encode

    run(capsys, "encode s.ply -o o.exr --panel p.yaml --save-rig r.yaml --background 0,0.5,1 --views continuous")
    gaussians = Gaussians.load("s.ply")
    rig = Rig.frame(gaussians, PANEL)
    assert Rig.from_yaml("r.yaml").to_dict() == rig.to_dict()
    expected = encode(gaussians, PANEL, rig, views="continuous", background=(0, 0.5, 1), output="float32").numpy()
    assert np.array_equal(read_image("o.exr"), expected)


def test_bit_depths_agree(folder, capsys):
    run(capsys, "encode s.ply -o f.exr --panel p.yaml")
    exact = read_image("f.exr").astype(np.float64).clip(0, 1)
    for arguments, name, levels in (
        ("", "a.png", 255),
        ("--bit-depth 16", "b.png", 65535),
        ("", "a.tif", 255),
        ("--bit-depth 16 --compression small", "b.tiff", 65535),
    ):
        run(capsys, f"encode s.ply -o {name} --panel p.yaml {arguments}")
        stored = read_image(name, as_stored=True)
        assert stored.dtype.itemsize == (1 if levels == 255 else 2)
        assert np.abs(stored - np.floor(exact * levels + 0.5)).max() <= 1
        assert (stored != np.floor(exact * levels + 0.5)).mean() < 0.01
    run(capsys, "encode s.ply -o c.tif --panel p.yaml --bit-depth 32")
    assert np.array_equal(read_image("c.tif"), read_image("f.exr"))


def test_rig_and_gaussians_round_trip(folder, capsys):
    run(capsys, "encode s.ply -o a.exr --panel p.yaml --save-rig r.yaml --save-gaussians g.ply")
    run(capsys, "encode g.ply -o b.exr --panel p.yaml --rig r.yaml --threads 1")
    assert np.abs(read_image("a.exr") - read_image("b.exr")).max() < 2e-4


def test_methods_agree(folder, capsys):
    for method in ("direct", "sorted", "classic"):
        run(capsys, f"encode s.ply -o {method}.exr --panel p.yaml --method {method}")
    error = np.abs(read_image("direct.exr") - read_image("classic.exr"))
    assert np.quantile(error, 0.999) < 1 / 255
    assert np.abs(read_image("sorted.exr") - read_image("classic.exr")).max() < 1 / 255


def cameras_json(path, cameras, **changes):
    fields = {name: getattr(cameras, name).tolist() for name in ("world_to_camera", "focal_px", "principal_point_px")}
    path.write_text(json.dumps({**fields, **changes}))


def test_sorted_takes_cameras_a_view_map_and_a_budget(folder, capsys):
    from sorted_cases import random_map, toe_in

    from lightfield_gs.encoding.encode import encode

    cameras, table = toe_in(PANEL, 7), random_map(PANEL, 7, 1)
    cameras_json(folder / "c.json", cameras)
    np.save("m.npy", table)
    run(
        capsys,
        "encode s.ply -o o.exr --panel p.yaml --method sorted --cameras c.json --view-map m.npy "
        "--memory-budget 500KB --device cpu",
    )
    expected = encode(Gaussians.load("s.ply"), PANEL, None, "sorted", cameras=cameras, view_map=table, output="float32")
    assert np.array_equal(read_image("o.exr"), expected.numpy())
    metadata = read_info("o.exr").metadata
    assert "rig" not in metadata
    made = json.loads(metadata["encoding"])
    for name, file in (("cameras", "c.json"), ("view_map", "m.npy")):
        assert made[name] == {"file": file, "sha256": hashlib.sha256((folder / file).read_bytes()).hexdigest()}
    run(capsys, "encode s.ply -o v.png --panel p.yaml --method sorted --view-map m.npy --preview v")
    assert (folder / "v/views.png").exists()


@pytest.mark.parametrize(
    "change, words",
    [
        ({"focal_px": None}, "focal_px.*\\[N, 2\\]"),
        ({"focal_px": [[1, 2], [3]]}, "focal_px.*lengths"),
        ({"focal_px": [["1", "2"]] * 12}, "focal_px"),
        ({"focal_px": [[0, 5]] * 12}, "focal_px must be > 0"),
        ({"principal_point_px": [[1, 2]] * 11}, "same number"),
        ({"focal_px": [[10**400, 1]] * 12}, "focal_px"),
        ({"principal_point_px": [[1, float("nan")]] * 12}, "finite"),
        ({"principal_point_px": [[True, False]] * 12}, "principal_point_px"),
        ({"world_to_camera": [[[2.0, 0, 0, 0], [0, 2, 0, 0], [0, 0, 2, 0], [0, 0, 0, 1]]] * 12}, "rotation"),
        ({"world_to_camera": [[[1e300] * 4] * 4] * 12}, "rotation"),
        ({"world_to_camera": []}, r"got float64 \[0\]"),
        ({"fx": 1}, "unknown key 'fx'"),
    ],
)
def test_cameras_that_make_no_sense(folder, capsys, change, words):
    from sorted_cases import toe_in

    cameras_json(folder / "c.json", toe_in(PANEL, 12), **change)
    error = complaint(capsys, "encode s.ply -o o.png --panel p.yaml --method sorted --cameras c.json")
    assert "c.json" in error and re.search(words, error) and not (folder / "o.png").exists()


def test_view_maps_that_are_none(folder, capsys):
    good = np.zeros((60, 96, 3), np.int32)
    np.save("m.npy", good)
    stored = (folder / "m.npy").read_bytes()
    random = np.random.default_rng(0)
    files = {"empty": b"", "text": b"hello", "cut": stored[:-1], "header only": stored[:128], "zip": b"PK\3\4" + stored}
    for index in range(60):
        damaged = bytearray(stored[:300])
        for place in random.integers(0, 128, 3):
            damaged[place] = random.integers(0, 256)
        files[f"damaged {index}"] = bytes(damaged)
    np.save("o.npy", np.array([{}], object), allow_pickle=True)
    np.save("f.npy", good.astype(np.float32))
    np.save("r.npy", good + 12)
    files |= {name: (folder / f"{name[0]}.npy").read_bytes() for name in ("object", "float", "range")}
    for name, content in files.items():
        (folder / "m.npy").write_bytes(content)
        error = complaint(capsys, "encode s.ply -o o.png --panel p.yaml --method sorted --view-map m.npy")
        assert "m.npy" in error and not (folder / "o.png").exists(), name


def test_metadata(folder, capsys):
    run(capsys, "encode s.ply -o o.png --panel p.yaml --background 1,0,0")
    metadata = read_info("o.png").metadata
    assert Panel(**json.loads(metadata["panel"])) == PANEL
    assert set(json.loads(metadata["rig"])) == {"world_to_camera", "focal_px", "principal_point_px", "zero_depth"}
    fields = Gaussians.load("s.ply").fields().values()
    digest = hashlib.sha256(b"".join(tensor.numpy().astype("<f4").tobytes() for tensor in fields)).hexdigest()
    assert json.loads(metadata["scene"]) == {"gaussians": 60, "sh_degree": 1, "sha256": digest}
    assert json.loads(metadata["encoding"]) == {
        "method": "direct",
        "views": "integer",
        "background": [1, 0, 0],
        "quality": "exact",
    }
    assert json.loads(metadata["versions"])["torch"].startswith("2.")
    out = run(capsys, "info o.png")
    assert "image: 96 x 60, 3 channels, uint8" in out and digest in out


def test_preview(folder, capsys):
    run(capsys, "encode s.ply -o o.png --panel p.yaml --preview deep/preview")
    sheet = read_image("deep/preview/views.png")
    assert sheet.shape == (3 * 60, 4 * 96, 3)
    animation = Image.open("deep/preview/look-around.webp")
    assert animation.n_frames == 24 + 22 and animation.size == (96, 60)  # there and back
    eyes = [read_image(f"deep/preview/{side}-eye.png") for side in ("left", "right")]
    lenses = round(180 / PANEL.line_number), round(288 / PANEL.line_number)
    times = -(-1280 // max(lenses))  # they fill a screen
    assert eyes[0].shape == (times * lenses[0], times * lenses[1], 3)
    assert not np.array_equal(*eyes)
    assert len(list((folder / "deep/preview").iterdir())) == 5


def test_preview_of_an_upright_panel_fills_a_screen_and_takes_no_longer():
    upright, lying = (
        Panel(**{**PANEL.to_dict(), "width_px": w, "height_px": h}) for w, h in ((900, 1600), (1600, 900))
    )
    for panel, size, sheet in ((upright, (509, 905), (320, 569)), (lying, (905, 509), (480, 270))):
        frames = look_around(scene(), panel, Rig.frame(scene(), panel))
        assert len(frames) == 24 and {frame.shape for frame in frames} == {(size[1], size[0], 3)}
        columns = 6 if panel is upright else 4
        shown = contact_sheet(frames)
        assert shown.shape == (12 // columns * sheet[1], columns * sheet[0], 3)
        assert np.abs(shown.mean((0, 1)) - np.mean(frames, (0, 1, 2))).max() < 1  # the same views, smaller


def test_preview_of_a_large_scene_has_every_second_view(folder, capsys, monkeypatch):
    monkeypatch.setattr(preview, "_MANY_GAUSSIANS", 10)
    run(capsys, "encode s.ply -o o.png --panel p.yaml --device cpu --preview v")
    animation = Image.open("v/look-around.webp")
    assert animation.n_frames == 12 + 10 and read_image("v/views.png").shape == (3 * 60, 4 * 96, 3)
    animation.load()
    assert animation.info["duration"] == round(60 * 46 / 22)  # the loop takes as long


def test_preview_of_a_panel_without_viewing_distance_keeps_no_old_eyes(folder, capsys):
    fields = {key: value for key, value in PANEL.to_dict().items() if key != "viewing_distance_mm"}
    Panel(**fields).to_yaml("far.yaml")
    run(capsys, "encode s.ply -o o.png --panel p.yaml --preview v")
    assert cli.main("encode s.ply -o o.png --panel far.yaml --preview v".split()) == 0
    words = capsys.readouterr().err
    assert words.startswith("note: v has no left-eye.png") and words.endswith("give --viewing-distance MM\n")
    assert {path.name for path in (folder / "v").iterdir()} == {"views.png", "look-around.webp", "look-around.html"}


@pytest.mark.parametrize("invert", [False, True])
def test_depth_is_not_inside_out(folder, capsys, invert):
    """A near dot over a far one: to the right eye the near one is further left. In the views and through the lenses."""
    panel = Panel(**{**PANEL.to_dict(), "width_px": 480, "height_px": 240, "invert_views": invert})
    panel.to_yaml("q.yaml")
    colours = torch.tensor([[[1.0, -1, -1]], [[-1, -1, 1]]]) * 0.5 / 0.28209479177387814
    dots = Gaussians(
        torch.tensor([[0, -0.15, 0.6], [0, 0.15, 1.6]]),
        torch.tensor([[1.0, 0, 0, 0]]).repeat(2, 1),
        torch.tensor([[0.03], [0.08]]).repeat(1, 3),
        torch.tensor([0.99, 0.99]),
        colours,
    )
    dots.save("d.ply")
    Rig(np.eye(4), (480, 480), (240, 120), 1.0).to_yaml("r.yaml")
    run(capsys, "encode d.ply -o o.png --panel q.yaml --rig r.yaml --preview v --background 0,0,0")
    for side, x_mm in (("left", -60), ("right", 60)):
        run(capsys, f"simulate o.png --eye {x_mm},0,600 -o {side}.png")
    seen = {
        side: [columns_of(read_image(f"{side}.png")[..., channel]) for channel in (0, 2)] for side in ("left", "right")
    }
    shift = [right - left for left, right in zip(seen["left"], seen["right"])]
    assert shift[0] < -0.02 and shift[1] > 0.02
    sheet = read_image("v/views.png").reshape(3, 240, 4, 480, 3)
    first, last = sheet[0, :, 0], sheet[2, :, 3]  # left-most and right-most camera
    assert columns_of(last[..., 0]) < columns_of(first[..., 0]) - 0.05
    assert columns_of(last[..., 2]) > columns_of(first[..., 2]) + 0.05


@pytest.mark.parametrize("background", ["alpha", "plain", "mask"])
def test_photo_keeps_its_place_and_colours(folder, capsys, background):
    """Four coloured quarters, through an untrained network, in the light field: upright and not mirrored."""
    from lightfield_gs.models import SplatterNet

    torch.manual_seed(0)
    SplatterNet().save("n.safetensors")
    photo = np.full((160, 200, 4), (200, 210, 190, 0), np.uint8)
    colours = {(0, 0): (200, 20, 20), (0, 1): (20, 160, 20), (1, 0): (20, 20, 200), (1, 1): (190, 180, 20)}
    for (row, column), colour in colours.items():
        photo[40 + 40 * row : 80 + 40 * row, 60 + 40 * column : 100 + 40 * column] = *colour, 255
    write_image("photo.png", photo if background == "alpha" else photo[..., :3])
    write_image("mask.png", photo[..., 3:])
    option = "--mask mask.png" if background == "mask" else ""
    run(capsys, f"encode photo.png -o o.png --panel p.yaml --checkpoint n.safetensors --save-rig r.yaml {option}")
    assert np.array_equal(Rig.from_yaml("r.yaml").world_to_camera, np.eye(4))
    image = read_image("o.png", as_stored=True)
    assert image[2, 2].min() > 250
    for (row, column), colour in colours.items():
        seen = image[15 + 30 * row, 34 + 28 * column]
        assert np.abs(seen.astype(int) - colour).max() < 60


def columns_of(picture: np.ndarray) -> float:
    """Mean column of what is bright, 0..1."""
    weight = picture.sum(0)
    return float((weight * (np.arange(len(weight)) + 0.5)).sum() / weight.sum() / len(weight))


# info, simulate, help


def test_info(folder, capsys):
    assert "gaussians: 60\nsh_degree: 1\n" in run(capsys, "info s.ply")
    assert "line_number: 9.848282191911\n" in run(capsys, "info p.yaml")
    assert "views: 96\n" in run(capsys, "info 65in-8k-96v")
    Rig(np.eye(4), (96, 96), (48, 30), 2.0).to_yaml("r.yaml")
    assert "zero_depth: 2.0\n" in run(capsys, "info r.yaml")
    (folder / "visual.json").write_text(
        json.dumps({"pitch": 42, "slope": -6, "center": 0.3, "DPI": 136, "screenW": 7680, "screenH": 4320})
    )
    assert "height_px: 4320\n" in run(capsys, "info visual.json")


def test_what_is_no_text_is_printed_escaped(folder):
    (folder / "q.yaml").write_text((folder / "p.yaml").read_text().replace('"small"', '"\\ud800"'))
    command = [sys.executable, "-c", "from lightfield_gs import cli; cli.main()", "info", "q.yaml"]
    assert "name: \\ud800\n" in subprocess.run(command, capture_output=True, text=True, check=True).stdout


def test_info_of_a_checkpoint(folder, capsys):
    from safetensors.numpy import save_file

    save_file({"a": np.zeros((3, 4), np.float16), "b": np.zeros(5, np.float16)}, "c.safetensors", {"note": "hello"})
    out = run(capsys, "info c.safetensors")
    assert "parameters: 17\ntensors: 2\ntypes: F16\n" in out and "note: hello\n" in out


def test_simulate(folder, capsys):
    from lightfield_gs.panels.simulate import simulate

    image = (PANEL.view_map() * 20).astype(np.uint8)
    write_image("o.png", image)
    run(capsys, "simulate o.png --panel p.yaml --eye -31.5,10,600 -o e.exr")
    seen = simulate(image, PANEL, (-31.5, 10, 600))
    assert np.array_equal(read_image("e.exr"), seen)
    assert "enlarged 45 times, from" in run(capsys, "simulate o.png --panel p.yaml --eye -31.5,10,600 -o e.png")
    large = read_image("e.png").reshape(len(seen), 45, -1, 45, 3).mean((1, 3))
    assert np.abs(large - seen)[1:-1, 1:-1].mean() < 0.03  # smooth between the samples
    run(capsys, "simulate o.png --panel p.yaml --eye -31.5,10,600 -o e.png --lens-pixels")
    assert np.abs(read_image("e.png") - seen).max() < 1 / 255


def test_simulate_a_row_of_eyes_with_a_measured_spread(folder, capsys):
    from lightfield_gs.panels.simulate import Psf, simulate
    from lightfield_gs.show.preview import in_rows

    image, psf = (PANEL.view_map() * 20).astype(np.uint8), Psf((-2.0, 0.0, 3.0), (0.0, 1.0, 0.2))
    write_image("o.png", image)
    (folder / "lens.csv").write_text("-2 0\n0 1\n3 0.2\n")
    out = run(capsys, "simulate o.png --panel p.yaml --eyes -60,60,5 --psf lens.csv -o e.exr")
    assert "from 5 places, -60 to 60 mm" in out
    pictures = [simulate(image, PANEL, (x, 0, 600), psf=psf) for x in (-60, -30, 0, 30, 60)]
    assert np.array_equal(read_image("e.exr"), in_rows(pictures))
    assert "of a viewer's two eyes" in run(capsys, "simulate o.png --panel p.yaml -o two.exr")
    pictures = [simulate(image, PANEL, (x, 0, 600)) for x in (-31.5, 31.5)]
    assert np.array_equal(read_image("two.exr"), in_rows(pictures))
    for options, words in (
        ("--eye 0,0,600 --eyes 0,1,2", "one of them"),
        ("--eye 0,0,600 --psf lens.csv --spread 1", "leave out one of them"),
        ("--eyes 0,1,0", "1..1000"),
        ("--eye 0,0,600 --psf none.csv", "none.csv"),
    ):
        assert words in complaint(capsys, f"simulate o.png --panel p.yaml {options} -o e.png")


@pytest.mark.parametrize(
    "eye, words",
    [
        ("0.06,0,0.6", "the eye is 0.6 mm from the panel, which is made for 600 mm: views repeat or mix"),
        ("0,0,7000", "made for 600 mm"),
        ("1e6,0,600", "90 degrees aside, the panel's viewing cone ends at 15"),
        ("0,1e6,600", "89.8 degrees"),
        ("-170,0,600", "15.8 degrees aside"),
        ("150,0,600", None),
        ("40,240,600", None),
        ("0,0,61", None),
    ],
)
def test_an_eye_where_hardly_any_is_gets_a_note(folder, capsys, eye, words):
    write_image("o.png", np.zeros((60, 96, 3), np.uint8))
    assert cli.main(f"simulate o.png --panel p.yaml --eye {eye} -o e.png".split()) == 0
    error = capsys.readouterr().err
    if words is None:
        assert error == ""
    else:
        assert error.startswith("note: ") and words in error and error.count("\n") == 1


def test_viewing_distance_of_a_looking_glass(folder, capsys):
    (folder / "visual.json").write_text(
        json.dumps({"pitch": 42, "slope": -6, "center": 0.3, "DPI": 136, "screenW": 96, "screenH": 60})
    )
    run(capsys, "encode s.ply -o o.png --panel visual.json")
    assert "give --viewing-distance MM" in complaint(capsys, "simulate o.png --eye 0,0,500 -o e.png")
    run(capsys, "simulate o.png --eye 31.5,0,500 --viewing-distance 500 -o e.png")
    rig = json.loads(read_info("o.png").metadata["rig"])
    Rig(**rig).to_yaml("r.yaml")
    run(capsys, "encode s.ply -o far.png --panel visual.json --viewing-distance 500 --preview v --rig r.yaml")
    assert np.array_equal(read_image("v/right-eye.png"), read_image("e.png"))
    assert json.loads(read_info("far.png").metadata["panel"])["viewing_distance_mm"] == 500
    run(capsys, "encode s.ply -o framed.png --panel visual.json --viewing-distance 500")
    run(capsys, "prune s.ply -o less.ply --panel visual.json --viewing-distance 500 --save-rig pruned.yaml")
    assert Rig.from_yaml("pruned.yaml").to_dict() == json.loads(read_info("framed.png").metadata["rig"]) != rig


def test_help_says_units_and_is_quick():
    code = (
        "import sys; from lightfield_gs import cli\ntry: cli.main(sys.argv[1:])\n"
        "except SystemExit: pass\nprint([m for m in ('OpenImageIO', 'yaml', 'safetensors') if m in sys.modules])"
    )
    for command, words in (("--help", "encode"), ("encode --help", "0..1"), ("simulate --help", "in mm")):
        arguments = [sys.executable, "-c", code, *command.split()]
        done = subprocess.run(arguments, capture_output=True, text=True, check=True)
        assert words in done.stdout and done.stdout.splitlines()[-1] == "[]"
