"""Masks as the target of alpha over any background, and masks that leave nothing."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
import torch
from fit_capture import write_capture
from fit_scene import first_state, known_scene, photograph_scene
from PIL import Image

import lightfield_gs as lf
from lightfield_gs.base.assumptions import Assumption
from lightfield_gs.base.errors import InputError
from lightfield_gs.fitting.photo_loss import photo_loss_and_gradient
from lightfield_gs.fitting.posed_images import Normalization, PosedImages
from lightfield_gs.fitting.settings import FitSettings
from lightfield_gs.fitting.trainer import Trainer
from lightfield_gs.io.captures.capture import read_capture


def cut_out(images: PosedImages, scene: lf.Gaussians) -> tuple[PosedImages, torch.Tensor]:
    """Views whose masks are the alpha of the scene, their photographs of straight colours; and that alpha."""
    image, alpha, *_ = lf.render(scene, images.cameras(), background=(0.0, 0.0, 0.0), alpha=True)
    straight = image / alpha.clamp_min(1e-3)[..., None]
    images.photos = straight.clamp(0, 1).mul(255).round().to(torch.uint8)
    images.opacity = alpha.mul(255).round().to(torch.uint8)
    return images, alpha


def test_the_scene_itself_is_the_target_over_any_background():
    scene = known_scene()
    scene.sh = scene.sh.clamp(-1.5, 1.5)  # colours that a photograph can show
    images, _ = cut_out(photograph_scene(scene), scene)
    everything = torch.arange(images.count)
    for background in ((0.0, 0.0, 0.0), (1.0, 0.2, 0.6)):
        target, weights = images.targets(everything, torch.tensor([background]).expand(6, 3))
        image = lf.render(scene, images.cameras(), background=background).image
        assert weights is None and (image - target).abs().max() < 0.006
        assert photo_loss_and_gradient(image, target)[0] / images.count < 0.002


def test_a_random_background_empties_what_masks_leave_out():
    """Black photographs with a hole: over black nothing is wrong with opaque black, over others it is."""
    scene = known_scene()
    images = photograph_scene(scene)
    images.photos = images.photos.clone()
    images.photos[:, :, :24] = 0
    images.opacity = torch.full_like(images.photos[..., 0], 255)
    images.opacity[:, :, :24] = 0
    settings = FitSettings(steps=250, cap_max=300, sh_degree=0, masks="alpha", background=None)
    trainer = Trainer(first_state(scene, settings, 300), images, settings)
    alpha = [cut_out(photograph_scene(scene), gaussians)[1] for gaussians in (scene, trainer.state.gaussians())]
    trainer.advance(settings.steps)
    alpha.append(cut_out(photograph_scene(scene), trainer.state.gaussians())[1])
    assert alpha[2][:, :, :20].mean() < 0.4 * alpha[1][:, :, :20].mean()
    assert alpha[2][:, :, 28:].mean() > 0.8 * alpha[0][:, :, 28:].mean()


def test_masks_are_read_as_what_they_are_to_be(tmp_path):
    capture = read_capture(write_capture(tmp_path / "capture", masked=True))
    world, some = Normalization.from_centres(capture.centres, capture.extent), [0, 3]
    ignored, alpha = (PosedImages.load(capture, some, world, "cpu", some, masks) for masks in ("ignore", "alpha"))
    assert ignored.opacity is None and alpha.weights is None
    assert ignored.weights.equal(alpha.opacity) and (alpha.opacity[:, :, :16] == 0).all()
    target, weights = alpha.targets(torch.tensor([1]), torch.tensor([[0.25, 0.5, 0.75]]))
    assert weights is None and target[0, 5, 3].tolist() == [0.25, 0.5, 0.75]
    torch.testing.assert_close(target[0, :, 20:], alpha.photos[1, :, 20:] / 255)


def blackened(folder: Path, photographs: Sequence[str]) -> Path:
    """Write a capture of eight; the masks of `photographs` are black, the other masks are white."""
    write_capture(folder, masked=True)
    for path in (folder / "masks").iterdir():
        Image.new("L", (48, 32), 0 if path.name in photographs else 255).save(path)
    return folder


def test_masks_that_are_grey_all_over_count(tmp_path):
    """In a mask without black, grey pixels count less than fully."""
    folder = write_capture(tmp_path / "c", masked=True)
    for path in (folder / "masks").iterdir():
        Image.fromarray(np.maximum(np.asarray(Image.open(path)), 51)).save(path)
    capture = read_capture(folder)
    for masks in ("ignore", "alpha"):
        images = PosedImages.load(
            capture, [0, 1], Normalization.from_centres(capture.centres, capture.extent), "cpu", [0, 1], masks
        )
        grey = images.weights if masks == "ignore" else images.opacity
        assert grey is not None and (grey[:, :, 0] == 51).all() and (grey[:, :, -1] == 255).all()


def test_masks_that_leave_nothing_are_refused(tmp_path):
    everything = [f"{index:02d}.png" for index in range(8)]
    folder = blackened(tmp_path / "all", everything)
    for masks in ("ignore", "alpha"):
        with pytest.raises(InputError, match="masks leave nothing of 8 of 8 photographs, and nothing to fit to"):
            lf.fit(folder, steps=2, cap_max=200, masks=masks, progress=False)
    folder = blackened(tmp_path / "fitted", everything[:4] + everything[5:])
    with pytest.raises(InputError, match="masks leave nothing of 7 of 8 photographs, and nothing"):
        lf.fit(folder, steps=2, cap_max=200, progress=False)


def test_no_photograph_is_scored_by_no_pixels(tmp_path):
    folder = blackened(tmp_path / "held", ["04.png"])
    with pytest.warns(Assumption, match="nothing of 1 of 8 photographs, which count nowhere and are not scored: 04"):
        assert lf.fit(folder, steps=2, cap_max=200, score_cone=30, progress=False).scores is None
    folder = blackened(tmp_path / "some", ["02.png", "05.png"])
    with pytest.warns(Assumption, match="nothing of 2 of 8 photographs, which count nowhere"):
        result = lf.fit(folder, steps=2, cap_max=200, test_every=4, score_cone=30, progress=False)
    assert result.scores.names == ["06.png"]
    assert result.scores.mean_psnr_db < 50 and torch.isfinite(result.gaussians.means).all()
