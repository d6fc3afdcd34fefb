"""Exposure: its gradient, its mean, and photographs of other exposures of one scene."""

from __future__ import annotations

import torch
from fit_scene import first_state, known_scene, photograph_scene, psnr_db

from lightfield_gs.fitting.image_optimizers import ExposureOptimizer
from lightfield_gs.fitting.settings import FitSettings
from lightfield_gs.fitting.trainer import Trainer

CPU = torch.device("cpu")


def some_exposure(photographs: int = 4) -> ExposureOptimizer:
    exposure = ExposureOptimizer(photographs, FitSettings(), CPU)
    random = torch.Generator().manual_seed(0)
    exposure.values += 0.2 * torch.randn(exposure.values.shape, generator=random)
    exposure.values, exposure._adam.first = exposure.values.double(), exposure._adam.first.double()
    return exposure


def test_the_backward_pass_is_the_gradient():
    """Against differences in double; photograph 2 stands twice in the step."""
    exposure, chosen = some_exposure(), torch.tensor([2, 0, 2])
    random = torch.Generator().manual_seed(1)
    values = exposure.values.clone().requires_grad_()
    colours = torch.rand(3, 2, 3, 3, generator=random, dtype=torch.float64, requires_grad=True)

    def exposed(values, colours):
        exposure.values = values
        return exposure.apply(colours, chosen)

    assert torch.autograd.gradcheck(exposed, (values, colours))
    weights = torch.randn(3, 2, 3, 3, generator=random, dtype=torch.float64)
    right = torch.autograd.grad((exposed(values, colours) * weights).sum(), (colours, values))
    found = exposure.backward(colours.detach(), weights, chosen)
    torch.testing.assert_close(found[0], right[0])
    torch.testing.assert_close(found[1].detach(), right[1].flatten(1))


def test_photographs_keep_the_scenes_colour_in_the_mean():
    exposure, random = ExposureOptimizer(5, FitSettings(), CPU), torch.Generator().manual_seed(2)
    for step in range(20):
        gradient = torch.randn(5, 12, generator=random) + 3
        exposure.update(gradient, torch.tensor([step]), torch.tensor([1]))
    torch.testing.assert_close(exposure.values.mean(0), torch.eye(3, 4), atol=1e-6, rtol=0)
    assert (exposure.values - torch.eye(3, 4)).abs().max() > 0.01
    before = exposure.values.clone()
    exposure.update(torch.full((5, 12), torch.nan), torch.tensor([3]), torch.tensor([0]))
    assert exposure.values.equal(before)


def test_a_fit_finds_the_scene_behind_exposures():
    """Photographs brighter and darker by turns: with exposures the scene is nearer to its colours at the mean one."""
    scene = known_scene()
    right, images = photograph_scene(scene), photograph_scene(scene)
    gains = torch.tensor([0.7, 1.3, 0.7, 1.3, 0.7, 1.3])[:, None, None, None]
    images.photos = (right.photos * gains).clamp(0, 255).to(torch.uint8)
    scores = []
    for exposure in (False, True):
        settings = FitSettings(steps=300, cap_max=300, sh_degree=1, exposure=exposure)
        trainer = Trainer(first_state(scene, settings, 300), images, settings)
        trainer.advance(settings.steps)
        scores.append(psnr_db(trainer.state, right))
    assert scores[1] > scores[0] + 1
    grey = trainer.exposure.apply(torch.full((6, 3), 0.4), torch.arange(6)).mean(1)
    assert (grey[1::2] > 1.3 * grey[::2]).all()
