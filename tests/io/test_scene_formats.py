"""Every format of scenes: against bytes packed by hand, files of other programs, and each other."""

import math
import struct
import zipfile
import zlib

import numpy as np
import pytest
import scene_formats as made
import torch
from command_line import complaint, run, scene

from lightfield_gs import Gaussians, InputError
from lightfield_gs.base.assumptions import Loss
from lightfield_gs.io.scenes.files import read_scene
from lightfield_gs.io.scenes.plausibility import import_zstd


def zstd():
    try:
        return import_zstd()
    except InputError:
        pytest.skip("no zstd: an extra of Python before 3.14")


def difference(one: Gaussians, other: Gaussians) -> dict[str, float]:
    """The largest of each field: of centres, of logarithms of scales, radians of rotations, of harmonics."""
    count = min(one.sh.shape[1], other.sh.shape[1])
    turns = [torch.nn.functional.normalize(each.quaternions.double(), dim=-1) for each in (one, other)]
    apart = torch.minimum((turns[0] - turns[1]).norm(dim=-1), (turns[0] + turns[1]).norm(dim=-1))
    return {
        "means": float((one.means - other.means).abs().max()),
        "scales": float((one.scales.log() - other.scales.log()).abs().max()),
        "rotations": float(2 * apart.max()),
        "opacities": float((one.opacities - other.opacities).abs().max()),
        "dc": float((one.sh[:, 0] - other.sh[:, 0]).abs().max()),
        "rest": float((one.sh[:, 1:count] - other.sh[:, 1:count]).abs().max()) if count > 1 else 0.0,
    }


def expected(degree: int) -> Gaussians:
    first = torch.tensor([made.dc(colour) for colour in made.COLOURS])[:, None]
    rest = torch.tensor(made.REST, dtype=torch.float32)[:, : (degree + 1) ** 2 - 1]
    return Gaussians(
        torch.tensor(made.MEANS),
        torch.tensor(made.ROTATIONS),
        torch.tensor(made.LOG_SCALES).exp(),
        torch.tensor(made.OPACITIES),
        torch.cat([first, rest], 1),
    )


# Name, bytes or files, degree, the format's words, and half a step of: centres, log scales, rotations, opacities,
# colours (harmonic of degree 0) and harmonics
CASES = {
    "a.splat": (made.splat, 0, ".splat", (0, 1e-6, 0.02, 0, 0.007, 0)),
    "v1.spz": (lambda: made.spz(1), 3, "SPZ version 1", (0, 0.032, 0.03, 0, 0.014, 0.001)),
    "v2.spz": (lambda: made.spz(2, 2), 2, "SPZ version 2", (1e-4, 0.032, 0.03, 0, 0.014, 0.001)),
    "v3.spz": (lambda: made.spz(3), 3, "SPZ version 3", (1e-4, 0.032, 0.005, 0, 0.014, 0.001)),
    "v4.spz": (lambda: made.spz4(zstd().compress), 3, "SPZ version 4", (1e-4, 0.032, 0.005, 0, 0.014, 0.001)),
    "c.ply": (made.compressed_ply, 3, "compressed .ply", (0.003, 0.003, 0.005, 0.002, 0.008, 0.017)),
    "0.ksplat": (lambda: made.ksplat(0), 2, ".ksplat version 0.1", (0, 1e-6, 1e-6, 0, 0.007, 0)),
    "1.ksplat": (lambda: made.ksplat(1, 1), 1, "compression level 1", (1e-4, 1e-3, 2e-3, 0, 0.007, 0)),
    "2.ksplat": (lambda: made.ksplat(2), 2, "compression level 2", (1e-4, 1e-3, 2e-3, 0, 0.007, 0.007)),
    "2.sog": (lambda: made.zipped(made.sog()), 3, "SOG version 2, a ZIP", (2e-4, 0.016, 0.03, 0, 0.017, 0.001)),
    "1.sog": (
        lambda: made.zipped(made.sog(1, 2), zipfile.ZIP_DEFLATED, "scene/"),
        2,
        "SOG version 1, a ZIP",
        (2e-4, 0.016, 0.03, 0.008, 0.017, 0.001),
    ),
}


@pytest.mark.parametrize("name", CASES)
def test_every_format_gives_what_was_packed_to_its_quantisation(name, tmp_path):
    make, degree, words, steps = CASES[name]
    (tmp_path / name).write_bytes(make())
    file = read_scene(tmp_path / name)
    assert words in file.kind and file.gaussians.validate().sh_degree == degree
    found = difference(file.gaussians, expected(degree))
    for (field, error), step in zip(found.items(), steps):
        assert error <= step + 1e-6, (field, error)
    assert Gaussians.load(tmp_path / name).count == 4


def test_a_sog_is_a_folder_or_its_meta_json_too(tmp_path):
    folder = made.written(tmp_path / "scene", made.sog(2, 1))
    (tmp_path / "scene.sog").write_bytes(made.zipped(made.sog(2, 1)))
    packed = Gaussians.load(tmp_path / "scene.sog")
    for path in (folder, folder / "meta.json"):
        assert read_scene(path).kind == "SOG version 2, a folder"
        assert torch.equal(Gaussians.load(path).means, packed.means)


def test_content_goes_before_the_name(tmp_path):
    (tmp_path / "a.ply").write_bytes(made.spz(3))
    (tmp_path / "b.splat").write_bytes(made.zipped(made.sog()))
    (tmp_path / "c.spz").write_bytes(made.compressed_ply())
    kinds = [read_scene(tmp_path / name).kind.split()[0] for name in ("a.ply", "b.splat", "c.spz")]
    assert kinds == ["SPZ", "SOG", "compressed"]


# Files of other programs


def test_three_formats_of_one_scene_agree(shared_dir):
    stem = str(shared_dir / "data/gaussians/three-formats/test-splat.3-points-from-train")
    ply, splat, spz = (Gaussians.load(stem + suffix) for suffix in (".ply", ".splat", ".spz"))
    order = [int((ply.means - mean).abs().sum(1).argmin()) for mean in splat.means]
    sorted_ply = Gaussians(*(field[order] for field in ply.fields().values()))
    found = difference(splat, sorted_ply)
    assert found["means"] == 0 and found["scales"] < 1e-6 and found["rotations"] < 0.02 and found["dc"] < 0.014
    found = difference(spz, ply)
    assert found["means"] <= 0.5 / 4096 + 1e-6 and found["scales"] <= 1 / 32 + 1e-6 and found["rotations"] < 0.005
    assert found["rest"] <= 1 / 16 + 1 / 128 and found["opacities"] <= 0.5 / 255 + 1e-6


def test_the_biker_is_the_same_in_both_formats(shared_dir):
    zstd()
    folder = shared_dir / "data/gaussians"
    spz, ply = (Gaussians.load(folder / name) for name in ("biker.spz", "biker.compressed.ply"))
    assert spz.count == ply.count == 152746
    keys = [np.lexsort((each.opacities, *each.means.round(decimals=1).T.numpy())) for each in (spz, ply)]
    assert np.array_equal(np.sort(spz.opacities.numpy()), np.sort(ply.opacities.numpy())) and len(keys[0]) == len(
        keys[1]
    )
    for one, other in zip(spz.means.T, ply.means.T):
        assert float((one.sort().values - other.sort().values).abs().max()) <= 0.5 / 4096 + 1e-6


def test_files_of_playcanvas_and_others_are_read(shared_dir):
    folder = shared_dir / "data/gaussians"
    logo, bot = read_scene(folder / "playcanvas-logo-sog1"), read_scene(folder / "playbot-sog2/5_0/meta.json")
    assert (logo.gaussians.count, logo.gaussians.sh_degree) == (307128, 0) and "version 1" in logo.kind
    assert bot.gaussians.sh_degree == 2 and bot.gaussians.means.abs().max() < 1.2
    guitar, packed = (Gaussians.load(folder / f"guitar{kind}.ply") for kind in ("", ".compressed"))
    assert torch.allclose(guitar.means.aminmax(dim=0).min, packed.means.aminmax(dim=0).min, atol=1e-5)
    fixtures = folder / "format-fixtures"
    places = Gaussians.load(fixtures / "minimal.splat").means
    for name in ("minimal.ksplat", "minimal-v3.spz"):
        assert torch.equal(Gaussians.load(fixtures / name).means, places), name
    with pytest.raises(InputError, match="version 2 that is not compressed"):
        Gaussians.load(fixtures / "minimal-raw.spz")


# Writing


def test_what_is_written_is_read_again_to_the_quantisation(tmp_path):
    given = scene()
    given.sh.clamp_(-0.9, 0.9)
    given.save(tmp_path / "a.spz")
    found = difference(Gaussians.load(tmp_path / "a.spz"), given)
    assert found["means"] <= 0.5 / 4096 + 1e-6 and found["scales"] <= 1 / 32 + 1e-5 and found["rotations"] < 0.006
    assert found["opacities"] <= 0.5 / 255 + 1e-6 and found["dc"] < 0.014 and found["rest"] <= 1 / 32 + 1 / 256
    with pytest.warns(Loss, match="no harmonics above degree 0"):
        given.save(tmp_path / "a.splat")
    found = difference(Gaussians.load(tmp_path / "a.splat"), given)
    assert found["means"] == 0 and found["scales"] < 1e-6 and found["rotations"] < 0.02 and found["dc"] < 3.3
    for name in ("a.spz", "a.splat"):  # a second time nothing is lost
        again = Gaussians.load(tmp_path / name)
        again.save(tmp_path / f"b{name[1:]}")
        assert max(difference(Gaussians.load(tmp_path / f"b{name[1:]}"), again).values()) < 5e-3


def test_small_scenes_are_written_to_spz_with_finer_steps(tmp_path):
    given = scene()
    given = Gaussians(given.means * 1e-3, given.quaternions, given.scales * 1e-3, given.opacities, given.sh[:, :1])
    with pytest.warns(Loss, match="scales outside of"):
        given.save(tmp_path / "a.spz")
    assert difference(Gaussians.load(tmp_path / "a.spz"), given)["means"] < float(given.scales.median()) / 8
    far = Gaussians(given.means + 1e8, given.quaternions, given.scales, given.opacities, given.sh)
    with pytest.raises(InputError, match="holds coordinates up to"):
        far.save(tmp_path / "b.spz")
    assert not (tmp_path / "b.spz").exists()


# What cannot be read


def refused(path, words):
    with pytest.raises(InputError, match=words) as caught:
        Gaussians.load(path)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("name", CASES)
def test_cut_files_are_refused(name, tmp_path):
    data = CASES[name][0]()
    for share in (0, 0.3, 0.9):
        (tmp_path / name).write_bytes(data[: int(share * len(data))])
        refused(tmp_path / name, ".")


def test_counts_are_compared_with_the_file_before_memory_is_taken(tmp_path):
    path = tmp_path / "a.spz"
    path.write_bytes(made.spz(3, count=1 << 31))
    refused(path, "more than 64 to one")
    path.write_bytes(made.spz(3, count=5))
    refused(path, "5 Gaussians of degree 3 .* take")
    path.write_bytes(made.spz(3, count=3))
    refused(path, "3 Gaussians")
    path.write_bytes(zlib.compress(b"NGSP" + bytes(1 << 25), 1, wbits=31))
    refused(path, "expected version 1, 2 or 3")
    data = bytearray(made.ksplat(1))
    struct.pack_into("<I", data, 4096 + 4, 1 << 31)
    (tmp_path / "a.ksplat").write_bytes(data)
    refused(tmp_path / "a.ksplat", "it is cut")
    (tmp_path / "a.ply").write_bytes(made.compressed_ply().replace(b"vertex 4", b"vertex 257"))
    refused(tmp_path / "a.ply", "1 chunks are too few for 257")


def test_a_sog_reads_no_file_but_those_beside_it(tmp_path):
    for name in ("../means_l.webp", "/etc/passwd", "a/b.webp", "..", "", 7, "c:\\x.webp"):
        files = made.sog(means={"mins": [0] * 3, "maxs": [1] * 3, "files": [name, "means_u.webp"]})
        (tmp_path / "a.sog").write_bytes(made.zipped({**files, "../means_l.webp": files["means_l.webp"]}))
        refused(tmp_path / "a.sog", "expected the name of a file beside it")


def test_zip_and_image_bombs_are_refused(tmp_path):
    files = made.sog()
    bomb = {**files, "sh0.webp": bytes(1 << 26)}
    (tmp_path / "a.sog").write_bytes(made.zipped(bomb, zipfile.ZIP_DEFLATED))
    refused(tmp_path / "a.sog", "more than 64 to one")
    folder = made.written(tmp_path / "b", {**files, "sh0.webp": made.webp(np.zeros((1 << 23, 4)), 1 << 12)})
    refused(folder, "more than 64 to one")


@pytest.mark.parametrize(
    "changes, words",
    [
        ({"count": 1 << 30}, "pixels, expected 1073741824"),
        ({"count": float("nan")}, "count"),
        ({"version": 3}, "version must be 1..2"),
        ({"sh0": {"codebook": [0.0] * 255, "files": ["sh0.webp"]}}, "expected 256 finite numbers"),
        ({"scales": {"codebook": [float("inf")] * 256, "files": ["scales.webp"]}}, "expected 256 finite numbers"),
        ({"quats": {"files": ["scales.webp"]}}, "another|wrong|252"),
        ({"means": 5}, "expected an object means"),
    ],
)
def test_lies_of_a_meta_json_are_refused(changes, words, tmp_path):
    files = made.sog(**changes)
    files["scales.webp"] = made.webp([[0, 0, 0, 9]] * 4, 4) if "quats" in changes else files["scales.webp"]
    refused(made.written(tmp_path / "s", files), words)


def test_numbers_without_a_meaning_are_named_or_left_out(tmp_path):
    data = bytearray(made.splat())
    struct.pack_into("<f", data, 32, math.nan)
    struct.pack_into("<f", data, 64 + 12, -1.0)
    path = tmp_path / "a.splat"
    path.write_bytes(data)
    refused(path, "Gaussian 1 has a centre that is not finite; 2 of 4")
    with pytest.warns(UserWarning, match="2 of 4 Gaussians"):
        assert Gaussians.load(path, skip_invalid=True).count == 2


def test_other_extensions_of_spz_are_skipped_and_those_that_change_numbers_refused(tmp_path):
    path, compress = tmp_path / "a.spz", zstd().compress
    path.write_bytes(made.spz4(compress, flags=3, extensions=struct.pack("<II4x", 0xADBE0002, 4)))
    assert "SplatRenderMode: mip" in read_scene(path).comments
    path.write_bytes(made.spz4(compress, flags=2, extensions=struct.pack("<II4x", 0xADBE0001, 4)))
    refused(path, "sh_quantization")


# Commands


def test_commands_take_and_give_every_format(folder, capsys):
    (folder / "a.spz").write_bytes(made.spz(2))
    made.written(folder / "sog", made.sog())
    for name in ("a.spz", "sog", "sog/meta.json"):
        run(capsys, f"encode {name} -o out.png --panel p.yaml")
    assert "format: SPZ version 2" in run(capsys, "info a.spz")
    assert "format: SOG version 2, a folder" in run(capsys, "info sog/meta.json")
    said = run(capsys, "prune s.ply -o b.spz --panel p.yaml")
    assert "lost: b.spz: a .spz holds no comments" in said and "SPZ version 3" in run(capsys, "info b.spz")
    assert "expected a name that ends in .ply, .glb, .gltf, .spz, .splat" in complaint(
        capsys, "prune s.ply -o b.sog --panel p.yaml"
    )
