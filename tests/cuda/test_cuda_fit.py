"""The stages of fitting on a GPU, against those of the CPU in float64."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import fit_scene
import pytest
import torch
from cuda_on_cpu import fit_cases

from lightfield_gs import _core
from lightfield_gs.base.errors import InputError
from lightfield_gs.fitting import trainer
from lightfield_gs.fitting.evaluate import evaluate
from lightfield_gs.fitting.optimizer import GaussianState, Gradients, RawParameters, activate, update, update_table
from lightfield_gs.fitting.photo_loss import photo_loss, photo_loss_and_gradient
from lightfield_gs.fitting.photo_storage import RowFile
from lightfield_gs.fitting.posed_images import PosedImages
from lightfield_gs.fitting.settings import FitSettings
from lightfield_gs.fitting.trainer import Trainer

if not (torch.cuda.is_available() and hasattr(_core, "cuda")):
    pytest.skip("needs a CUDA device and a build with LFGS_CUDA", allow_module_level=True)

CUDA = "cuda"


def test_fitting_is_that_of_the_cpu():
    fit_cases.compare(fit_cases.fitted(torch.float32, CUDA))


def test_every_run_gives_the_same_bits():
    first, again = (fit_cases.fitted(torch.float32, CUDA) for _ in range(2))
    for what, cases in first.items():
        for case, same in zip(cases, again[what], strict=True):
            assert all(torch.equal(value, same[name]) for name, value in case.items()), what


class Run:
    """Three steps on the device that a graph can hold."""

    def __init__(self) -> None:
        random = torch.Generator(CUDA).manual_seed(1)
        n, options = 5000, dict(device=CUDA, generator=random)
        shapes = [(n, 3), (n, 3), (n, 4), (n,), (n, 16, 3)]
        self.values = RawParameters(*(torch.randn(shape, **options) for shape in shapes))
        self.first, self.second = self.values.zeros_like(), self.values.zeros_like()
        self.drawn = activate(self.values)
        self.gradients = Gradients(*(torch.randn(shapes[k], **options) for k in (0, 2, 1, 3, 4)))
        self.table = update_table(3, **fit_cases.RATES, noise_lr=300.0, device=CUDA)
        self.step, self.skipped = (torch.zeros((), dtype=torch.int64, device=CUDA) for _ in range(2))
        self.image, self.photo = torch.rand(2, 1, 60, 80, 3, **options)
        self.losses = torch.zeros(4, device=CUDA)

    def once(self) -> None:
        loss, gradient = photo_loss_and_gradient(self.image, self.photo)
        self.losses.index_copy_(0, self.step.view(1), loss.view(1))
        self.image -= 1e3 * gradient
        update(self.values, self.first, self.second, self.gradients, *self.drawn,
               table=self.table, step=self.step, skipped=self.skipped, seed=9)  # fmt: skip
        self.step += 1


def test_a_graph_repeats_the_steps_of_the_table():
    plain, captured = Run(), Run()
    for _ in range(3):
        plain.once()
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        captured.once()
    for _ in range(3):
        graph.replay()
    assert plain.losses[0] > plain.losses[1] > plain.losses[2] > 0
    assert torch.equal(plain.losses, captured.losses) and torch.equal(plain.image, captured.image)
    for name, value, same in zip(RawParameters._fields, plain.values, captured.values):
        assert torch.equal(value, same), name


def test_a_step_outside_the_table_skips_all():
    run = Run()
    run.step += 3
    before = [field.clone() for field in run.values]
    run.once()
    assert run.skipped == 5000 and all(torch.equal(a, b) for a, b in zip(before, run.values))


def test_what_cannot_be_used_is_said():
    image = torch.zeros(1, 4, 4, 3, device=CUDA)
    with pytest.raises(InputError, match="image must be float32 on cuda:0, got torch.float64"):
        photo_loss(image.double(), image.double())
    with pytest.raises(InputError, match="photo must be torch.float32 on cuda:0, got torch.float32 on cpu"):
        photo_loss(image, image.cpu())


def fitted_state(images: PosedImages, moments_on_host: bool = False, **others: Any) -> list[torch.Tensor]:
    """Return the tensors of a few Gaussians after 60 steps, with changes of density between them."""
    settings = FitSettings(steps=60, cap_max=400, sh_degree=1, **others)
    first = fit_scene.first_state(fit_scene.known_scene(), settings, device=CUDA)
    fit = Trainer(GaussianState.start(first.gaussians(), moments_on_host), images, settings)
    assert fit.state.first.sh.is_pinned() == moments_on_host
    fit.advance(60)
    assert fit.done == 60 and not int(fit.counters.skipped)
    assert settings.density == "adaptive" or fit.state.count == 400
    return list(fit.state.tensors().values())


@pytest.mark.parametrize("batch_size", [1, 3])
def test_photographs_of_the_host_and_of_files_make_the_same_scene(tmp_path, batch_size):
    images = fit_scene.photograph_scene(fit_scene.known_scene(), device=CUDA)
    file = RowFile(tmp_path / "photographs.uint8", images.photos.shape)
    for row, photo in enumerate(images.photos.cpu()):
        file[row] = photo
    gaussians = fit_scene.known_scene().to(CUDA)
    expected = fitted_state(images, batch_size=batch_size)
    for stored in (images.photos.cpu(), file):
        other = replace(images, photos=stored)
        assert other.is_staged and not images.is_staged
        for value, same in zip(expected, fitted_state(other, batch_size=batch_size), strict=True):
            assert torch.equal(value, same)
        assert evaluate(gaussians, other, (0.0, 0.0, 0.0)) == evaluate(gaussians, images, (0.0, 0.0, 0.0))


@pytest.mark.parametrize("density", ["mcmc", "adaptive"])
def test_moments_of_the_host_make_the_same_scene(density):
    images = fit_scene.photograph_scene(fit_scene.known_scene(), device=CUDA)
    expected, hosted = (fitted_state(images, on_host, density=density, grow_grad2d=1e-5) for on_host in (False, True))
    for value, same in zip(expected, hosted, strict=True):
        assert torch.equal(value.cpu(), same.cpu())


def test_too_little_capacity_changes_nothing_but_time(monkeypatch):
    images = fit_scene.photograph_scene(fit_scene.known_scene(), device=CUDA)
    plenty = fitted_state(images)
    for name, value in (("_SLACK", 1.0), ("_LEAST_SLACK", 0.0), ("_LEAST_CAPACITY", 0)):  # the next image may need more
        monkeypatch.setattr(trainer, name, value)
    for value, same in zip(plenty, fitted_state(images), strict=True):
        assert torch.equal(value, same)
