"""Files of depth maps: pictures, channels of an EXR, arrays; and files that are no depth map."""

import zipfile

import numpy as np
import pytest
from command_line import run
from PIL import Image

import lightfield_gs as lf
from lightfield_gs.io.images import write_image
from lightfield_gs.photo.depth import depth_map, read_depth, read_numbers
from lightfield_gs.photo.depth_holes import fill_holes

Z = np.array([[0.5, 1.0, 2.0], [4.0, 1.5, 0.8]])


def test_maps_that_are_almost_grey(tmp_path):
    """Saved in colour, as by a JPEG; or in two channels alone."""
    grey = np.repeat(np.arange(0, 240, 20, dtype=np.uint8).reshape(3, 4, 1), 3, 2)
    for change, expected in (((0, 0, 1), grey[..., 0]), ((-3, 3, 0), grey[..., 0])):
        write_image(tmp_path / "a.png", (grey.astype(int) + np.array(change)).clip(0, 255).astype(np.uint8))
        numbers = read_numbers(tmp_path / "a.png")
        assert np.abs(numbers.values.astype(int) - expected).max() <= 1 and "almost grey" in numbers.notes[0]
    grey[..., 2] = 255
    write_image(tmp_path / "a.png", grey)
    assert np.array_equal(read_numbers(tmp_path / "a.png").values, grey[..., 0])
    Image.fromarray(grey[..., :2], "LA").save(tmp_path / "a.png")
    assert np.array_equal(read_numbers(tmp_path / "a.png").values, grey[..., 0])


def test_an_archive_of_arrays(tmp_path):
    path = tmp_path / "a.npz"
    for names, kind in (
        ({"depth": Z, "focallength_px": np.array(50.0), "canonical": np.ones((2, 3))}, "distance"),
        ({"x": Z.T.copy().T}, None),
        ({"disparity": 1 / Z, "other": Z}, "disparity"),
    ):
        np.savez_compressed(path, **names)
        numbers = read_numbers(path)
        assert numbers.kind == kind and numbers.focal_px == (50 if "depth" in names else None)
        assert np.allclose(depth_map(path, numbers).z, Z)
    np.savez(path, first=Z, second=Z)
    with pytest.raises(lf.InputError, match="a.npz: expected a depth map .* named depth, .* holds first, second"):
        read_numbers(path)
    stored = path.read_bytes()
    for damaged in (b"", b"hello", stored[:-30], stored[:200], stored.replace(b"(2, 3)", b"(9**9)")):
        path.write_bytes(damaged)
        with pytest.raises(lf.InputError, match="a.npz"):
            read_numbers(path)


def test_an_archive_that_would_fill_the_memory(tmp_path):
    """A file of a few kilobytes claims 16 GB."""
    header = np.lib.format.header_data_from_array_1_0(np.ones((1, 1)))
    with zipfile.ZipFile(tmp_path / "a.npz", "w", zipfile.ZIP_DEFLATED) as archive:
        with archive.open("depth.npy", "w") as file:
            np.lib.format.write_array_header_1_0(file, {**header, "shape": (1 << 14, 1 << 17)})
            file.write(bytes(1 << 20))
    with pytest.raises(lf.InputError, match="'depth.npy' is damaged, too large"):
        read_numbers(tmp_path / "a.npz")


def test_files_that_are_no_depth_map(tmp_path):
    write_image(tmp_path / "colour.png", np.arange(12, dtype=np.uint8).reshape(2, 2, 3))
    (tmp_path / "text.png").write_text("hello")
    (tmp_path / "text.npy").write_text("hello")
    for name, words in (
        ("colour.png", "in colour"),
        ("text.png", "not an image"),
        ("text.npy", "not a .npy"),
        ("no.npy", "cannot read"),
        ("no.png", "cannot read"),
    ):
        with pytest.raises(lf.InputError, match=f"{name}.*{words}|{words}.*{name}"):
            read_depth(tmp_path / name, limits=(1, 2))


def write_channels(path, channels: dict[str, np.ndarray], parts: dict[str, dict[str, np.ndarray]] | None = None):
    """An EXR of these channels [H, W], or with a part for each name in parts."""
    import OpenImageIO as oiio

    specs, pixels = [], []
    for part, those in (parts or {"": channels}).items():
        height, width = next(iter(those.values())).shape
        spec = oiio.ImageSpec(width, height, len(those), "float")
        spec.channelnames = tuple(those)
        if part:
            spec["oiio:subimagename"] = part
        specs.append(spec)
        pixels.append(np.stack(list(those.values()), 2).astype(np.float32))
    out = oiio.ImageOutput.create(str(path))
    assert out.open(str(path), tuple(specs)) if parts else out.open(str(path), specs[0])
    for index, (spec, values) in enumerate(zip(specs, pixels)):
        if index:
            assert out.open(str(path), spec, "AppendSubimage")
        assert out.write_image(values)
    out.close()


@pytest.mark.parametrize("name", ["Z", "depth.Z", "ViewLayer.Depth.Z", "Depth.V", "V", "depth", "zdepth.R"])
@pytest.mark.parametrize("grey", [True, False])
def test_the_depth_channel_of_an_exr_is_taken_beside_a_picture(tmp_path, name, grey):
    """Of any picture, also a grey one, half transparent, and beside what else ends with Z or V."""
    picture = {part: np.full((2, 3), 0.2 if grey else value) for part, value in zip("RGBA", (0.1, 0.2, 0.3, 0.5))}
    other = {f"ViewLayer.{part}": np.full((2, 3), 7.0) for part in ("Normal.X", "Normal.Z", "UV.U", "UV.V", "Mist.Z")}
    write_channels(tmp_path / "z.exr", picture | other | {name: Z})
    numbers = read_numbers(tmp_path / "z.exr")
    assert np.array_equal(numbers.values, Z.astype(np.float32)) and numbers.kind == "distance"
    assert depth_map("z.exr", numbers).description.startswith(f"channel {name}: distance as z ")


def test_the_depth_part_of_an_exr_of_several_is_taken(tmp_path):
    parts = {"beauty": {part: np.ones((2, 3)) for part in "RGB"}, "depth": {"Y": Z}}
    write_channels(tmp_path / "z.exr", {}, parts)
    assert np.array_equal(read_numbers(tmp_path / "z.exr").values, Z.astype(np.float32))


def test_an_exr_without_a_depth_channel_is_what_it_was(tmp_path):
    """The Z of a normal is no depth; one grey channel, or three equal ones, are a map."""
    write_channels(tmp_path / "n.exr", {f"Normal.{part}": Z + index for index, part in enumerate("XYZ")})
    with pytest.raises(lf.InputError, match="in colour"):
        read_numbers(tmp_path / "n.exr")
    write_channels(tmp_path / "g.exr", dict.fromkeys("RGB", Z))
    assert np.array_equal(read_numbers(tmp_path / "g.exr").values, Z.astype(np.float32))


@pytest.mark.parametrize("shape", [(1, 2, 3), (2, 3, 1), (1, 1, 2, 3), (2, 1, 3)])
def test_axes_of_length_1_are_dropped(tmp_path, shape):
    np.save(tmp_path / "a.npy", Z.reshape(shape))
    np.savez(tmp_path / "a.npz", image=np.ones((2, 3, 3)), Depth=Z.reshape(shape), mask=np.ones((2, 3), bool))
    for name in ("a.npy", "a.npz"):
        assert np.array_equal(read_depth(tmp_path / name), Z.astype(np.float32))


def test_what_was_not_measured_goes_on_from_the_surface_of_its_colour(folder, capsys):
    rows, columns = np.mgrid[:40, :60]
    square = (abs(rows - 20) < 12) & (abs(columns - 30) < 12)
    truth = np.where(square, 1.2, 3 - 0.01 * rows).astype(np.float32)
    photo = np.where(square[..., None], (200, 30, 30), (40, 90, 160)).astype(np.uint8)
    depth = truth.copy()
    depth[np.random.default_rng(0).random(depth.shape) < 0.1] = np.nan
    depth[10:20, 36:50] = depth[:6, :6] = np.nan  # over the edge, and in a corner
    assert np.abs(fill_holes(depth, photo / 255) / truth - 1).max() < 0.05
    np.save("d.npy", depth)
    write_image("a.png", photo)
    line = "encode a.png --depth d.npy -o o.png --panel p.yaml --save-gaussians g.ply"
    out = run(capsys, line)
    assert f"depth: {np.isnan(depth).mean():.1%} was not measured" in out and "--depth-invalid hole" in out
    whole = len(lf.Gaussians.load("g.ply").means)
    assert "was not measured" not in run(capsys, f"{line} --depth-invalid hole")
    assert len(lf.Gaussians.load("g.ply").means) < whole
