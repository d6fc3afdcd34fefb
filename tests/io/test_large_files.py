"""Large files that are not what their names say are refused by their first bytes, in no time and in little memory."""

import resource
import sys
import time

import pytest

from lightfield_gs.base.errors import InputError
from lightfield_gs.io.images import read_image, read_info
from lightfield_gs.io.npy import open_array, stored_arrays
from lightfield_gs.io.scenes.files import read_arrays

READERS = {
    read_image: (".png", ".jpg", ".exr", ".hdr", ".tif", ".webp", ".heic", ".avif", ".tga", ".npy"),
    read_info: (".png", ".exr"),
    read_arrays: (".spz", ".ksplat", ".splat", ".sog", ".ply", ".glb", ".gltf", ".usda", ".usdc", ".usdz"),
    stored_arrays: (".npz",),
    open_array: (".npy",),
}
CASES = [(reader, suffix) for reader, suffixes in READERS.items() for suffix in suffixes]
NAMES = [f"{reader.__name__}{suffix}" for reader, suffix in CASES]


def peak_bytes() -> int:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)


@pytest.mark.parametrize("reader, suffix", CASES, ids=NAMES)
def test_four_gigabytes_of_zeros(tmp_path, reader, suffix):
    path = tmp_path / f"zeros{suffix}"
    path.touch()
    with path.open("r+b") as file:
        file.truncate(4 << 30)  # takes no room on the disk
    before, began = peak_bytes(), time.process_time()
    with pytest.raises(InputError, match=f"zeros{suffix}"):
        reader(path)
    assert time.process_time() - began < 1 and peak_bytes() - before < 100 << 20


@pytest.mark.parametrize(
    "suffix, start",
    [
        (".spz", b"\x1f\x8b\x08\x00"),
        (".spz", b"NGSP\x04\x00\x00\x00\xff\xff\x00\x00\x00\x0c\x00\x05\x20"),
        (".ksplat", b"\x00\x01\x00\x00\x01"),
        (".sog", b"PK\x03\x04"),
        (".glb", b"glTF\2\0\0\0\xff\xff\xff\x7f\xff\xff\xff\x7fJSON"),
        (".ply", b"ply\nformat binary_little_endian 1.0\nelement vertex 4000000000\nproperty float x\nend_header\n"),
    ],
)
def test_a_header_and_nothing_behind_it(tmp_path, suffix, start):
    path = tmp_path / f"scene{suffix}"
    path.write_bytes(start)
    with path.open("r+b") as file:
        file.truncate(4 << 30)
    before, began = peak_bytes(), time.process_time()
    with pytest.raises(InputError, match=f"scene{suffix}"):
        read_arrays(path)
    assert time.process_time() - began < 1 and peak_bytes() - before < 100 << 20


@pytest.mark.parametrize(
    "name, start",
    [
        ("a.jpg", b"\xff\xd8\xff\xe0\0\x10JFIF\0\1\1\0\0\1\0\1\0\0"),
        ("a.mpo", b"\xff\xd8\xff\xe1"),
        ("a.gif", b"GIF89a\x40\0\x40\0\xf7\0\0" + bytes(range(256)) * 3),
        ("a.webp", b"RIFF\xff\xff\xff\xffWEBPVP8 "),
        ("a.jp2", b"\0\0\0\x0cjP  \r\n\x87\n"),
        ("a.avif", b"\0\0\0\x1cftypavif"),
        ("a.ppm", b"P6\n"),
        ("a.ico", b"\0\0\1\0"),
        ("a.exr", b"\x76\x2f\x31\x01\2\0\0\0"),
        ("a.tif", b"II*\0\x08\0\0\0"),
        ("big.tif", b"MM\0+\0\x08\0\0\0\0\0\0\0\0\0\x10"),
        ("a.cr2", b"II*\0\x10\0\0\0CR\2\0"),
        ("a.raf", b"FUJIFILMCCD-RAW "),
        ("a.fits", b"SIMPLE  =                    T"),
        ("blank.fits", b"SIMPLE  =                    T".ljust(2000)),
        ("a.pfm", b"Pf\n4 4\n-1\n"),
        ("b.ppm", b"P6\n# by hand\n4 4\n255\n"),
        ("a.cin", b"\x80\x2a\x5f\xd7"),
        ("a.iff", b"FOR4"),
        ("a.pic", b"\x53\x80\xf6\x34"),
    ],
)
def test_an_image_s_start_and_nothing_behind_it(tmp_path, name, start):
    path = tmp_path / name
    path.write_bytes(start)
    with path.open("r+b") as file:
        file.truncate(4 << 30)
    before, began = peak_bytes(), time.process_time()
    with pytest.raises(InputError, match=name):
        read_image(path)
    assert time.process_time() - began < 1 and peak_bytes() - before < 100 << 20


def test_large_pictures_are_read_as_before(tmp_path):
    """Of every kind of image that may be so large, its start is known."""
    path = tmp_path / "large.pfm"
    path.write_bytes(b"PF\n4096 2048\n-1.0\n")
    with path.open("r+b") as file:
        file.truncate(len(b"PF\n4096 2048\n-1.0\n") + 4096 * 2048 * 12)
    assert read_info(path).width_px == 4096
