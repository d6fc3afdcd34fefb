"""Commands with --device cuda and with --device cpu make the same pictures, of every kind of source. Needs a GPU."""

import os
from pathlib import Path

import numpy as np
import pytest
import torch
from fit_capture import write_capture
from photo_cases import photo, psnr_db
from PIL import Image
from rgbd_scene import TEXTURED, textured

from lightfield_gs import _core, cli
from lightfield_gs.bench.scenes import cloud, with_harmonics
from lightfield_gs.photo.stereo_pair import can_match

DEVICE = os.environ.get("LFGS_TEST_DEVICE", "cuda")
if DEVICE == "cuda" and not (torch.cuda.is_available() and hasattr(_core, "cuda")):
    pytest.skip("needs a CUDA device and a build with LFGS_CUDA", allow_module_level=True)

# The command up to its device, and the least PSNR in dB; networks are in bfloat16 on CUDA
COMMANDS = {
    "scene": ("encode scene.ply -o {} --panel toy-8v", 60),
    "sorted": ("encode scene.ply -o {} --panel toy-8v --method sorted", 60),
    "quilt": ("quilt scene.ply -o {} --panel toy-8v", 60),
    "object": ("encode object.png -o {} --panel toy-8v", 30),
    "depth map": ("encode room.png --depth room.npy -o {} --panel toy-8v", 50),
    "flat": ("encode room.png --depth flat -o {} --panel toy-8v", 50),
    "its half is its depth": ("encode halves.png --rgbd right -o {} --panel toy-8v", 40),
    "stereo pair": ("encode pair.png --stereo-in sbs -o {} --panel toy-8v", 40),
    "smaller scene": ("simplify scene.ply -o {}.ply --panel toy-8v --gaussians 300", None),
    "pruned scene": ("prune scene.ply -o {}.ply --panel toy-8v", None),
    "film": ("video scene.ply -o {}.mkv --panel toy-8v --turntable 0.2", None),
    "fit": ("fit capture -o {}.ply --steps 60 --gaussians 200", None),
}


@pytest.fixture(scope="module")
def sources(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("sources")
    scene = with_harmonics(cloud(500), 3)
    scene.save(folder / "scene.ply")
    image, depth = textured()
    as_bytes = (image * 255).round().astype(np.uint8)
    Image.fromarray(as_bytes).save(folder / "room.png")
    np.save(folder / "room.npy", depth)
    near = (1 / depth - (1 / depth).min()) / np.ptp(1 / depth)
    Image.fromarray(np.hstack([as_bytes, np.repeat((255 * near[..., None]).astype(np.uint8), 3, 2)])).save(
        folder / "halves.png"
    )
    pair = np.hstack([image, textured(0.065)[0]])
    Image.fromarray((pair * 255).round().astype(np.uint8)).save(folder / "pair.png")
    Image.fromarray((photo(120, 160) * 255).round().astype(np.uint8)).save(folder / "object.png")
    write_capture(folder / "capture")
    assert TEXTURED[0] == image.shape[1]
    return folder


@pytest.mark.parametrize("name", COMMANDS)
def test_a_command_does_on_cuda_what_it_does_on_the_cpu(name, sources, tmp_path, monkeypatch):
    if name == "stereo pair" and not can_match():
        pytest.skip("matching takes the extra `photo`")
    if name == "film":
        pytest.importorskip("av", reason="films take the extra `video`")
    monkeypatch.chdir(sources)
    words, least_db = COMMANDS[name]
    made = []
    for device in ("cpu", DEVICE):
        path = tmp_path / f"{device}.png" if least_db else tmp_path / device
        assert cli.main([*words.format(path).split(), "--device", device]) == 0
        made += [path]
    if least_db is not None:
        written = (next(tmp_path.glob(f"{path.stem}*.png")) for path in made)  # a quilt has its layout in its name
        here, there = (torch.from_numpy(np.array(Image.open(path))) for path in written)
        assert psnr_db(here, there) >= least_db
