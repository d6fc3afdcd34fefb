"""Files and folders that are neither scenes nor images: messages name their kind and a way out."""

import bz2
import gzip
import io
import re
import tarfile

import pytest
import scene_formats as made
from command_line import PANEL, complaint, run
from gltf_maker import Gltf
from test_scene_kinds import plain_ply

from lightfield_gs import InputError
from lightfield_gs.io.file_kinds import SCENE_SUFFIXES
from lightfield_gs.io.scenes.files import SUFFIXES, read_scene


def tarred() -> bytes:
    file = io.BytesIO()
    with tarfile.open(fileobj=file, mode="w") as archive:
        archive.addfile(tarfile.TarInfo("a.ply"))
    return file.getvalue()


def mesh_only() -> bytes:
    gltf = Gltf()
    gltf.root["meshes"] = [{"primitives": [{"attributes": {}}]}]
    return gltf.glb()


# With usd-core and without
USD_WAY = r"lightfield-gs fit|export it or download it again|pip install --upgrade 'lightfield-gs\[usd\]'"
UNSUPPORTED = {  # file name: content, and the message on its kind
    "a.glb": (b"glTF\2\0\0\0", ".glb has a header of 20 bytes, and it has 8; it is cut"),
    "a.gltf": (b"{}", "expected glTF of version 2"),
    "mesh.glb": (mesh_only(), "glTF without Gaussians.*KHR_gaussian_splatting.*lightfield-gs fit"),
    "renamed.png": (b"glTF\2\0\0\0", ".glb has a header"),
    "a.usda": (b"#usda 1.0\n", f"OpenUSD.*({USD_WAY})"),
    "a.usdz": (made.zipped({"a.usdc": b"PXR-USDC"}), f"OpenUSD.*({USD_WAY})"),
    "ckpt_29999_rank0.pt": (made.zipped({"ckpt/data.pkl": b"", "ckpt/data/0": b""}), "checkpoint.*--save_ply"),
    "step-29999.ckpt": (b"\x80\x02\x8a\x0al\xfc\x9cF", "checkpoint.*ns-export"),
    "ckpt.zip": (made.zipped({"ckpt/data.pkl": b"", "ckpt/data/0": b""}), "checkpoint"),
    "params.npz": (made.zipped({"means.npy": b""}), r"arrays.*\.save\('scene.ply'\)"),
    "params.zip": (made.zipped({"means.npy": b"", "sh.npy": b""}), "arrays"),
    "a.npy": (b"\x93NUMPY", "arrays"),
    "a.lcc": (b"{}", "LCC.*splat-transform"),
    "viewer.html": (b"<!DOCTYPE html><html></html>", "viewer's page.*export"),
    "a.splatv": (b"", "splaTV"),
    "a.rad": (b"RAD0", "Spark"),
    "mesh.obj": (b"v 0 0 0\n", "mesh.*fit"),
    "a.fbx": (b"Kaydara FBX Binary  \0", "mesh"),
    "a.vrm": (b"glTF", "a mesh, and no Gaussians"),
    "scan.laz": (b"LASF", "point cloud"),
    "scan.e57": (b"ASTM-E57", "point cloud"),
    "a.xyz": (b"0 0 0\n", "point cloud"),
    "a.ssproj": (made.zipped({"document.json": b"{}"}), "project"),
    "a.7z": (b"7z\xbc\xaf\x27\x1c", "archive.*unpack"),
    "a.tar": (tarred(), "archive"),
    "a.tar.gz": (gzip.compress(tarred()), "archive"),
    "a.ply.bz2": (bz2.compress(b"ply\n"), "archive"),
    "tileset.json": (b"{}", "3D Tiles"),
    "points3D.bin": (bytes(64), "COLMAP"),
    "two.zip": (made.zipped({"a.ply": plain_ply(), "b.spz": b""}), "holds 2 scenes.*unpack"),
    "photos.zip": (made.zipped({"in/a.jpg": b"", "in/b.jpg": b""}), "2 pictures.*lightfield-gs fit"),
    "models.zip": (made.zipped({"a.glb": b"glTF"}), "models.zip .a.glb.: a .glb has a header"),
    "text.zip": (made.zipped({"a.gltf": b"{}", "a.bin": b""}), "ZIP of a .gltf.*unpack"),
    "empty.zip": (made.zipped({}), "is an empty ZIP"),
    "empty.ply": (b"", "is empty; export it"),
    "notes.zip": (made.zipped({"a.txt": b""}), r"ZIP without a scene \('a.txt'\)"),
    "film.MP4": (b"\0\0\0\x18ftypmp42", "a video.*lightfield-gs video"),
    "really.ply": (b"glTF\2\0\0\0", ".glb has a header"),
    "capture.zip": (
        made.zipped({"images/a.jpg": b"", "images/b.jpg": b"", "sparse/0/points3D.ply": b"ply\n"}),
        "2 pictures.*lightfield-gs fit",
    ),
    "streamed.zip": (made.zipped({"lod-meta.json": b"{}", "0_0/meta.json": b"{}"}), "streamed SOG in a ZIP.*unpack"),
}


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    PANEL.to_yaml("p.yaml")
    return tmp_path


@pytest.mark.parametrize("name", UNSUPPORTED)
def test_files_that_are_not_read_are_named_with_a_way_out(name, folder, capsys):
    content, words = UNSUPPORTED[name]
    (folder / name).write_bytes(content)
    for line in (f"encode {name} -o o.png --panel p.yaml", f"info {name}"):
        assert re.search(words, complaint(capsys, line)), name
    with pytest.raises(InputError, match=words):
        read_scene(name)


NON_IMAGES = {  # file name: content, and the message on its kind
    **{name: UNSUPPORTED[name] for name in ("ckpt_29999_rank0.pt", "params.npz", "a.tar", "film.MP4")},
    "a.glb": (b"glTF\2\0\0\0", "is a scene or points.*encode"),
    "a.gltf": (b"{}", "is a scene or points.*encode"),
    "a.ply": (plain_ply(), "is a scene or points.*encode"),
    "a.ply.txt": (plain_ply(), "is a scene or points.*encode"),
    "a.splat": (made.splat(), "is a scene or points.*encode"),
    "a.spz.download": (gzip.compress(b"NGSP"), "rename it to a.spz"),
    "download": (gzip.compress(b"NGSP"), "packed by gzip.*rename"),
    "scene.zip": (made.zipped({"a.ply": plain_ply()}), "a ZIP.*encode"),
    "some.json": (b"{}", "settings or cameras.*--panel"),
}


@pytest.mark.parametrize("name", NON_IMAGES)
def test_files_that_are_no_image_are_named_where_one_is_expected(name, folder, capsys):
    content, words = NON_IMAGES[name]
    (folder / name).write_bytes(content)
    lines = [f"show {name} --panel p.yaml", f"simulate {name} -o o.png --panel p.yaml --eye 0,0,500"]
    lines += [] if name == "film.MP4" else [f"weave {name} -o o.png --panel p.yaml"]
    for line in lines:
        assert re.search(words, complaint(capsys, line)), line


@pytest.mark.parametrize("name", ["a.ply.txt", "a.ply.download", "a", "a.png"])
def test_a_ply_of_any_name_is_read_by_its_content(name, folder, capsys):
    (folder / name).write_bytes(plain_ply())
    assert "gaussians: 4" in run(capsys, f"info {name}")
    assert "4 Gaussians" in run(capsys, f"encode {name} -o o.png --panel p.yaml --device cpu")


def test_an_spz_with_another_ending_is_given_its_name(folder, capsys):
    (folder / "a.spz.txt").write_bytes(made.spz(3))
    assert "rename it to a.spz" in complaint(capsys, "encode a.spz.txt -o o.png --panel p.yaml")


@pytest.mark.parametrize(
    "name, content, words",
    [
        ("a.ply", plain_ply(), "is not a list of inputs; batch takes a folder"),
        ("a.JPG", b"\xff\xd8\xff", "is not a list of inputs; batch takes a folder"),
        ("a.gltf", b"{}", "is not a list of inputs; batch takes a folder"),
        ("a.pt", b"\x80\x02", "checkpoint"),
    ],
)
def test_a_batch_of_one_file_names_it(name, content, words, folder, capsys):
    (folder / name).write_bytes(content)
    assert re.search(words, complaint(capsys, f"batch {name} -o out --panel p.yaml"))


FOLDERS = {
    "sequence": (["frame_0000.ply", "frame_0001.ply", "frame_0002.ply"], "3 scenes .frame_0000.ply to .*batch"),
    "one": (["splat.ply", "readme.txt"], "one scene in it; give one/splat.ply"),
    "capture": (["images/a.jpg", "sparse/0/cameras.bin"], "capture.*lightfield-gs fit"),
    "nerf": (["transforms.json"], "capture"),
    "trainer": (["cfg_args", "cameras.json"], "trainer.*--save_ply"),
    "nerfstudio": (["config.yml", "nerfstudio_models/step-29999.ckpt"], "ns-export"),
    "photos": (["a.jpg", "b.JPG"], "2 pictures.*fit with --sfm"),
    "unfinished": (["cfg_args", "cameras.json", "input.ply"], "trainer.*--save_ply"),
    "lcc": (["meta.lcc", "data.bin", "thumb.jpg"], "LCC"),
    "deeper": (["time_0/a.ply", "time_1/a.ply"], "one of them: deeper/time_0/a.ply"),
    "sogs": (["time_0/meta.json", "time_1/meta.json"], "one of them: sogs/time_0$"),
    "empty": ([], "it is empty"),
}


@pytest.mark.parametrize("name", FOLDERS)
def test_folders_that_are_not_read_are_named_with_a_way_out(name, folder, capsys):
    names, words = FOLDERS[name]
    (folder / name).mkdir()
    for each in names:
        (folder / name / each).parent.mkdir(parents=True, exist_ok=True)
        (folder / name / each).write_bytes(b"ply\n")
    lines = [f"encode {name} -o o.png --panel p.yaml", f"quilt {name} -o q.png", f"prune {name} -o o.ply"]
    lines += [f"info {name}", *([] if name in ("photos", "lcc", "sequence") else [f"video {name} -o v --panel p.yaml"])]
    for line in lines:
        assert re.search(words, complaint(capsys, line)), line


def test_supported_and_absent_files_are_not_refused_by_their_names(folder, capsys):
    assert {*SUFFIXES} == {*SCENE_SUFFIXES, ".zip"}
    assert "cannot read" in complaint(capsys, "encode nothing.glb -o o.png --panel p.yaml")
    (folder / "a.splat").write_bytes(made.splat())
    (folder / "meta").mkdir()
    made.written(folder / "meta", made.sog())
    for name in ("a.splat", "meta"):
        assert "gaussians: 4" in run(capsys, f"info {name}")
