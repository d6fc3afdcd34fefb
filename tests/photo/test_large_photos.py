"""Photos with more pixels than a panel shows: whole scenes are made of fewer."""

import numpy as np
import pytest
from command_line import run

import lightfield_gs as lf
from lightfield_gs.app import photo as app_photo
from lightfield_gs.io.images import write_image
from lightfield_gs.photo.photo import Photo, reduce_photo

LINE = "encode a.png --depth z.npy -o o.png --panel p.yaml --device cpu --fit cover"


@pytest.mark.parametrize("options", ["", " --fov 40", " --intrinsics 70,72,50,30"])
def test_a_large_photo_is_reduced_and_its_camera_with_it(folder, capsys, monkeypatch, options):
    rows, columns = np.mgrid[:64, :96]
    write_image("a.png", np.stack([2 * columns, 3 * rows, 99 + 0 * rows], 2).astype(np.uint8))
    np.save("z.npy", (2 + columns / 96).astype(np.float32))
    full = run(capsys, f"{LINE}{options} --save-gaussians full.ply --save-rig full.yaml")
    monkeypatch.setattr(app_photo, "_MOST_WHOLE_PX", 48 * 32)
    reduced = run(capsys, f"{LINE}{options} --save-gaussians small.ply --save-rig small.yaml")
    assert "reduced to 48 x 32" in reduced and "reduced" not in full and "a.png: 96 x 64, whole picture" in reduced
    scenes = [lf.Gaussians.load(name).means[:count] for name, count in (("full.ply", 96 * 64), ("small.ply", 48 * 32))]
    corners = [scene.reshape(-1, width, 3)[[0, -1]][:, [0, -1]] for scene, width in zip(scenes, (96, 48))]
    assert np.allclose(*corners, atol=0.04)
    rigs = [lf.Rig.from_yaml(name) for name in ("full.yaml", "small.yaml")]
    assert rigs[0].zero_depth == pytest.approx(rigs[1].zero_depth, rel=0.01)


def test_pixels_are_averaged_with_their_alpha():
    pixels = np.zeros((4, 4, 4), np.uint8)
    pixels[..., :3], pixels[:2, :2, 3] = 200, 255
    pixels[:2, 2:, :3], pixels[0, 2, :] = 10, (90, 90, 90, 255)
    photo = Photo(pixels)
    reduce_photo(photo, 4)
    assert photo.size == (4, 4) and photo.pixels.shape == (2, 2, 4)
    assert photo.pixels[0].tolist() == [[200, 200, 200, 255], [90, 90, 90, 64]]
