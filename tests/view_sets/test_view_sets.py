"""Sets of views in files: their order by names, grids, quilts as other programs write them, colours, and movies."""

import contextlib
import json
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from command_line import complaint, run
from icc_profile import matrix_profile
from PIL import Image

from lightfield_gs.base.assumptions import collect_assumptions
from lightfield_gs.base.errors import InputError
from lightfield_gs.io.images import read_image, write_image
from lightfield_gs.panels.quilt import QuiltLayout
from lightfield_gs.view_sets.file_names import arrange
from lightfield_gs.view_sets.movies import FrameRange
from lightfield_gs.view_sets.view_set import QuiltViews, open_views


def in_order(*names):
    """The names as they are arranged, given by name, and what is told of it."""
    with collect_assumptions() as lines:
        found = arrange(Path("d"), [Path(name) for name in sorted(names)])
    assert not isinstance(found, dict)
    return [path.name for path in found], " ".join(lines)


def rows_of(*names):
    """The grid of cameras that names make, as rows of names."""
    with collect_assumptions() as lines:
        found = arrange(Path("d"), [Path(name) for name in sorted(names)])
    assert isinstance(found, dict) and "of a grid of cameras" in lines[0]
    rows = sorted({row for row, _ in found})
    return [[found[place].name for place in sorted(found) if place[0] == row] for row in rows]


@pytest.mark.parametrize(
    "names",
    [
        [f"view_{k}_of_12.png" for k in range(12)],
        [f"view_{k}.png" for k in range(-6, 6)],
        [f"x{k:+d}.png" for k in range(-3, 4)],
        [f"x{k / 2:g}.png" for k in range(-3, 4)],
        [f"view-{k}.png" for k in range(1, 12)],  # no sign
        [f"shot.1.{k}.png" for k in range(1, 12)],  # a counter, no decimals
        ["0.25.png", "0.5.png", "0.75.png", "1.png"],
        ["08.png", "9.png", "010.png", "11.png"],
        [f"view_{k}.png" for k in range(0, 360, 45)],
        [f"2026-11-26_10.59.0{k}_v{k}.png" for k in range(5)],
        [f"IMG_{410 + 3 * k}_{k}.png" for k in range(12)],
        ["cam1_left.png", "cam2.png", "cam10_right.png"],
    ],
    ids=lambda names: names[0],
)
def test_the_number_that_varies_orders_views(names):
    assert in_order(*names) == (names, "")


def test_an_order_that_is_guessed_is_told():
    for names, words in (
        ([f"view_{k}.png" for k in (-3, -2, -1)], "-3 .. -1 of the views of d are below 0"),
        ([f"IMG_1015{k:02}.png" for k in (1, 5, 9, 30, 44)], "not evenly spaced"),
        (["10_58_59.png", "10_59_03.png", "11_00_01.png"], "in the order of all numbers"),
        (["left.png", "middle.png", "right.png"], "right.png (else number them)"),
        ([f"IMG_{9 - k}_view_{k}.png" for k in range(4)], "the number after 'view'"),
    ):
        found, told = in_order(*names)
        assert found == names and words in told
    for names, words in (
        ([f"IMG_{9 - k}_{k}.png" for k in range(4)], "two that tell different ones"),
        (["1.png", "01.png", "2.png"], "more than once, as 01.png, 1.png; leave one of them"),
        ([f"{side}_{k}.png" for side in ("left", "right") for k in range(4)], "expected pictures of one kind"),
        (["cover.png", *(f"view_{k}.png" for k in range(4))], "as cover.png"),
        ([f"frame_{j}_view_{k}.png" for j in range(3) for k in range(4)], "3 x 4 pictures by frame and view"),
    ):
        with pytest.raises(InputError, match=words):
            in_order(*names)


def test_two_numbers_are_row_and_column():
    assert rows_of(*(f"{i}_{j}.png" for i in range(5) for j in range(4)))[2] == [f"2_{j}.png" for j in range(4)]
    assert rows_of(*(f"{i}.{j}.png" for i in range(5) for j in range(4)))[4] == [f"4.{j}.png" for j in range(4)]
    swapped = rows_of(*(f"x{i}_y{j}.png" for i in range(-2, 3) for j in range(4)))
    assert swapped[1] == [f"x{i}_y1.png" for i in range(-2, 3)]


def camera(x: float, y: float = 0.0, size: int = 40) -> np.ndarray:
    """The view of a camera at (x, y): soft blobs, each with its own depth and motion."""
    rng = np.random.default_rng(3)
    rows, columns = np.mgrid[:size, :size]
    image = np.full((size, size, 3), 40.0)
    for across, down, near in rng.uniform((0, 0, 0.5), (size, size, 2), (25, 3)):
        blob = np.exp(-((columns - across + near * x) ** 2 + (rows - down + near * y) ** 2) / 18)
        image += 120 * blob[..., None] * rng.uniform(0, 1, 3)
    return image.clip(0, 255).astype(np.uint8)


def write_views(folder: Path, views: dict[str, np.ndarray]) -> Path:
    folder.mkdir()
    for name, pixels in views.items():
        write_image(folder / name, pixels)
    return folder


def shown(path: Path, *args, **options) -> tuple[list[np.ndarray], str]:
    """The views of a path, and all that is said of them."""
    with collect_assumptions() as lines:
        found = open_views(path, *args, **options)
    return [found.views.view(number) for number in range(found.views.count)], " ".join([found.description, *lines])


def test_depth_maps_among_the_views_are_left_out_and_said(tmp_path):
    views = {f"v{k}.png": camera(k) for k in range(4)}
    maps = {f"v{k}_depth.png": camera(k)[..., :1] for k in range(4)}
    found, said = shown(write_views(tmp_path / "views", views | maps))
    assert len(found) == 4 and np.array_equal(found[3], camera(3))
    assert "4 of the 8 pictures" in said and "left out: v0_depth.png" in said
    found, _ = shown(write_views(tmp_path / "maps", maps))  # where all are named so, they are the views
    assert len(found) == 4


def test_a_grid_of_cameras_is_taken_row_by_row(tmp_path):
    views = [camera(2 * column, 2 * row) for row in range(4) for column in range(4)]
    for name, named in (("hci", "input_Cam{:03}.png"), ("plain", "{:03}.png")):
        folder = write_views(tmp_path / name, {named.format(k): view for k, view in enumerate(views)})
        found, said = shown(folder)
        assert len(found) == 4 and np.array_equal(found[1], views[9]) and "4 x 4 cameras" in said
        assert np.array_equal(shown(folder, row=0)[0][3], views[3])
        assert np.array_equal(shown(folder, (8, 2), row=1)[0][7], views[15])
    row = write_views(tmp_path / "row", {f"{k:03}.png": camera(k) for k in range(16)})
    found, said = shown(row)
    assert len(found) == 16 and "cameras" not in said
    with pytest.raises(InputError, match="expected 5 x 3 pictures as tiles= says, got 16"):
        open_views(row, (5, 3))


def quilt_of(views: list[np.ndarray], columns: int) -> np.ndarray:
    """A quilt whose rows go on upwards from the bottom, as Looking Glass has them."""
    rows = [np.concatenate(views[k : k + columns], 1) for k in range(0, len(views), columns)]
    return np.concatenate(rows[::-1], 0)


def test_quilts_come_from_the_top_and_from_the_right(tmp_path):
    views = [camera(k) for k in range(12)]
    below, above = tmp_path / "below_qs4x3a1.png", tmp_path / "above_qs4x3a1.png"
    write_image(below, quilt_of(views, 4))
    write_image(above, np.concatenate([np.concatenate(views[k : k + 4], 1) for k in (0, 4, 8)], 0))
    for path, options, hint in (
        (below, {}, ""),
        (above, {"top_first": True}, ""),
        (above, {}, "give top_first=True"),
        (below, {"top_first": True}, "leave top_first= out"),
    ):
        found, said = shown(path, **options)
        assert np.array_equal(found, views) == (not hint)
        assert hint in said and ("jump" in said) == bool(hint)
    assert np.array_equal(shown(below, right_to_left=True)[0], views[::-1])
    flat = tmp_path / "flat_qs4x3a1.png"
    write_image(flat, quilt_of([camera(0)] * 12, 4))
    assert "jump" not in shown(flat)[1]


def test_plain_tiles_at_the_end_of_a_quilt_are_no_views(tmp_path):
    views = [camera(k) for k in range(10)]
    path = tmp_path / "a_qs4x3a1.png"
    write_image(path, quilt_of([*views, *[np.zeros_like(views[0])] * 2], 4))
    found, said = shown(path)
    assert np.array_equal(found, views) and "holds 10 views, for the last 2 of its 4 x 3 tiles are plain" in said
    assert np.array_equal(shown(path, right_to_left=True)[0], views[::-1])
    assert len(shown(path, (4, 3))[0]) == 12


def test_what_does_not_divide_is_left_over_at_the_right_and_the_top_if_it_is_little():
    views = QuiltViews(np.zeros((1024, 1024, 3), np.uint8), QuiltLayout(5, 9, 16 / 9), "quilt")
    assert (views.width_px, views.height_px) == (204, 113) and views.layout.tile(0)[0] == slice(911, 1024)
    assert views.layout.tile(0, top_first=True)[0] == slice(0, 113)
    with pytest.raises(InputError, match="do not divide into 7 x 12 .* they do into 12 x 7"):
        QuiltViews(np.zeros((14, 24, 3), np.uint8), QuiltLayout(7, 12, 1.0), "q")
    with pytest.raises(InputError, match="do not divide"):
        QuiltViews(np.zeros((200, 200, 3), np.uint8), QuiltLayout(11, 4, 1), "quilt")


def test_exif_says_the_tiles_as_looking_glass_wrote_it(tmp_path):
    said = {"LKGNumViews": 11, "LKGRows": 3, "LKGColumns": 4, "LKGAspect": 0.75, "LKGType": "Image"}
    exif = Image.Exif()
    exif.get_ifd(0x8769)[0x9286] = b"ASCII\0\0\0" + json.dumps(said).encode()
    picture = Image.fromarray(quilt_of([camera(k) for k in range(12)], 4))
    picture.save(tmp_path / "a.jpg", exif=exif)
    found = open_views(tmp_path / "a.jpg")
    assert found.views.count == 11 and found.views.layout.columns == 4 and found.aspect == 0.75
    for order in ("utf-16-le", "utf-16-be"):
        exif.get_ifd(0x8769)[0x9286] = b"UNICODE\0" + json.dumps(said).encode(order)
        picture.save(tmp_path / "wide.jpg", exif=exif)
        assert open_views(tmp_path / "wide.jpg").views.count == 11
    picture.save(tmp_path / "a_qs2x6a1.jpg", exif=exif)
    assert "2 x 6 views as its name says, though its Exif says 4 x 3" in shown(tmp_path / "a_qs2x6a1.jpg")[1]
    exif.get_ifd(0x8769)[0x9286] = b"ASCII\0\0\0" + json.dumps(said | {"LKGRows": 0}).encode()
    picture.save(tmp_path / "b.jpg", exif=exif)
    with pytest.raises(InputError, match="its Exif cannot be used"):
        open_views(tmp_path / "b.jpg")


def test_views_of_unknown_aspect_take_the_panels_and_say_so(folder, capsys):
    write_image("q.png", quilt_of([camera(k) for k in range(12)], 4))
    words = run(capsys, "weave q.png --tiles 4x3 --panel p.yaml -o w.png")
    assert "as wide as the panel, 1.6 times their height (else --aspect 1" in words
    assert "as wide" not in run(capsys, "weave q.png --tiles 4x3 --aspect 1.6 --panel p.yaml -o a.png")
    assert np.array_equal(read_image("w.png"), read_image("a.png"))
    write_image("p.png", np.zeros((180, 384, 3), np.uint8))  # tiles as wide as the panel
    assert "as wide" not in run(capsys, "weave p.png --tiles 4x3 --panel p.yaml -o w.png")


def test_colours_become_srgb_as_their_files_say_them(folder, capsys):
    quilt = np.full((60, 96, 3), (230, 20, 20), np.uint8)
    # Display P3's primaries, by which this red is more than sRGB's
    wide = matrix_profile((0.5151, 0.2412, -0.0011), (0.2920, 0.6922, 0.0419), (0.1571, 0.0666, 0.7841), 2.2, "P3")
    Image.fromarray(quilt).save("wide_qs4x3a1.6.png", icc_profile=wide)
    assert "colours: profile 'P3' converted to sRGB" in run(capsys, "weave wide_qs4x3a1.6.png --panel p.yaml -o w.png")
    assert np.abs(read_image("w.png", True)[30, 48].astype(int) - (251, 0, 0)).max() <= 4
    write_image("linear_qs4x3a1.6.exr", np.full((60, 96, 3), 0.2140411, np.float32))
    for name, level in (("l.png", 0.5), ("l.tif", 0.5), ("l.exr", 0.2140411)):
        words = run(capsys, f"weave linear_qs4x3a1.6.exr --panel p.yaml -o {name}")
        assert ("linear, and kept so" if name == "l.exr" else "linear, encoded as sRGB") in words
        assert np.abs(read_image(name) - level).max() < 1e-4
    deep = np.full((60, 96, 3), 12345, np.uint16)
    write_image("deep_qs4x3a1.6.png", deep)
    assert "colours" not in run(capsys, "weave deep_qs4x3a1.6.png --panel p.yaml -o d.png")
    assert np.array_equal(read_image("d.png", True), deep)


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_views_that_are_not_finite_are_refused(folder, capsys, value):
    views = np.full((4, 40, 40, 3), 0.5, np.float32)
    views[2, 3, 4] = value
    write_views(Path("set"), {f"{k}.exr": view for k, view in enumerate(views)})
    write_image("a_qs2x2a1.exr", quilt_of(list(views), 2))
    for path, name in (("set", "set/2.exr"), ("a_qs2x2a1.exr", "a_qs2x2a1.exr")):
        refused = complaint(capsys, f"weave {path} --panel p.yaml -o w.png")
        assert f"{name} has pixels that are not finite" in refused


@pytest.mark.parametrize("suffix", [".gif", ".webp", ".png", ".mkv"])
def test_frames_are_quilts_or_views(folder, capsys, suffix):
    frames = [np.full((60, 96, 3), 40 * k, np.uint8) for k in range(5)]
    path, tiles = f"m{suffix}", f"t_qs4x3a1.6{suffix}"
    if suffix == ".mkv":
        av = pytest.importorskip("av")
        with av.open(path, "w") as container:
            stream = container.add_stream("ffv1", rate=10)
            stream.width, stream.height, stream.pix_fmt = 96, 60, "bgr0"
            for frame in frames:
                container.mux(stream.encode(av.VideoFrame.from_ndarray(frame, format="rgb24").reformat(format="bgr0")))
            container.mux(stream.encode(None))
    else:
        first, *rest = map(Image.fromarray, frames)
        first.save(path, save_all=True, append_images=rest, duration=100, lossless=True)
    Path(tiles).write_bytes(Path(path).read_bytes())
    refused = complaint(capsys, f"weave {path} --panel p.yaml -o w.png")
    assert "has 5 frames" in refused and "--frames FIRST:LAST:STEP" in refused and "--tiles" in refused
    words = run(capsys, f"weave {path} --frames 1:4:3 --panel p.yaml -o w.png --interpolation nearest")
    assert "2 frames as views, from 1 to 4" in words
    assert set(np.unique(read_image("w.png", True))) == {40, 160}
    words = run(capsys, f"weave {tiles} --frames 1: --panel p.yaml -o out")
    assert "a movie of 4 quilts of 4 x 3 views" in words and "10 a second" in words
    assert [int(read_image(f"out/frame-00000{k}.png", True)[30, 48, 0]) for k in range(4)] == [40, 80, 120, 160]
    assert "of which 4 were there" in run(capsys, f"weave {tiles} --frames 1: --panel p.yaml -o out")
    assert "expected .mp4, .mkv, .mov, or a folder" in complaint(capsys, f"weave {tiles} --panel p.yaml -o w.png")


def test_what_holds_no_views_is_refused_with_a_way_out(tmp_path):
    (tmp_path / "set").mkdir()
    write_views(tmp_path / "set" / "rgb", {f"{k}.png": camera(k) for k in range(2)})
    with pytest.raises(InputError, match=r"give the folder in it that has them \(rgb\)"):
        open_views(tmp_path / "set")
    Image.fromarray(camera(0)).save(tmp_path / "pages.tif", save_all=True, append_images=[Image.fromarray(camera(1))])
    with pytest.raises(InputError, match="give its pictures as files in a folder"):
        open_views(tmp_path / "pages.tif", span=FrameRange())


def test_what_is_done_to_the_frames_of_a_video_is_told(tmp_path):
    av = pytest.importorskip("av")
    with av.open(str(tmp_path / "a.mp4"), "w") as container:
        stream = container.add_stream("libx264rgb", rate=10)
        stream.width, stream.height, stream.pix_fmt, stream.sample_aspect_ratio = 40, 40, "rgb24", Fraction(4, 3)
        for k in range(3):
            container.mux(stream.encode(av.VideoFrame.from_ndarray(camera(k), format="rgb24")))
        container.mux(stream.encode(None))
    assert "a.mp4: pixels of 4:3 are made square" in shown(tmp_path / "a.mp4", span=FrameRange())[1]


def test_each_frame_of_a_video_is_one_view_whenever_it_comes(tmp_path):
    """Quilts are repeated as they are seen in time, views are not."""
    av = pytest.importorskip("av")
    with av.open(str(tmp_path / "a.mkv"), "w") as container:
        stream = container.add_stream("ffv1", rate=10)
        stream.width, stream.height, stream.pix_fmt = 40, 40, "bgr0"
        stream.codec_context.time_base = Fraction(1, 10)
        for k, time in enumerate((0, 1, 5, 6)):
            frame = av.VideoFrame.from_ndarray(camera(k), format="rgb24").reformat(format="bgr0")
            frame.pts, frame.time_base = time, Fraction(1, 10)
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    views, said = shown(tmp_path / "a.mkv", span=FrameRange())
    assert len(views) == 4 and "repeated" not in said
    with collect_assumptions() as lines:
        assert len(open_views(tmp_path / "a.mkv", (2, 2)).numbers) == 7 and "repeated to 7" in lines[0]


def test_frames_that_come_back_are_noticed(tmp_path):
    for name, there, words in (("fro.gif", [0, 2, 4, 6, 8, 6, 4, 2], "span=0:4:1"), ("to.gif", range(8), "")):
        first, *rest = (Image.fromarray(camera(k)) for k in there)
        first.save(tmp_path / name, save_all=True, append_images=rest, duration=100)
        said = shown(tmp_path / name, span=FrameRange())[1]
        assert words in said and ("there and back" in said) == bool(words)


def test_damaged_animations_and_exif_are_refused_in_a_line(tmp_path):
    said = b"ASCII\0\0\0" + json.dumps({"LKGRows": 3, "LKGColumns": 4}).encode()
    exif = Image.Exif()
    exif.get_ifd(0x8769)[0x9286] = said
    quilt = Image.fromarray(quilt_of([camera(k, size=8) for k in range(12)], 4))
    quilt.save(tmp_path / "a.jpg", exif=exif)
    quilt.save(tmp_path / "a.gif", save_all=True, append_images=[quilt.rotate(180)])
    rng = np.random.default_rng(0)
    for path in (tmp_path / "a.jpg", tmp_path / "a.gif"):
        whole = path.read_bytes()
        for _ in range(60):
            damaged = bytearray(whole[: rng.integers(1, len(whole) + 1)])
            for place in rng.integers(0, min(len(damaged), 200), 3):
                damaged[place] = rng.integers(256)
            path.write_bytes(damaged)
            with collect_assumptions(), contextlib.suppress(InputError):
                found = open_views(path, span=FrameRange() if path.suffix == ".gif" else None)
                [found.views.view(k) for k in range(found.views.count)]
