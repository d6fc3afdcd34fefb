"""The CUDA stages of fitting and training, compiled for the CPU: gradients, and steps of a fit."""

from __future__ import annotations

import numpy as np
import torch
from cuda_on_cpu import cases, feature_cases, fit_cases, intersection_cases
from cuda_on_cpu.drawings import EMULATED

from lightfield_gs import reference

pytestmark = EMULATED

DRAWN = (
    "images",
    "features",
    "capacities",
    "gradients",
    "antialiased gradients",
    "camera models",
    "view filter",
    "optics",
    "fit",
)


def test_images_and_gradients_are_those_of_float64(drawn):
    found = drawn("images")
    for name, expected in cases.images_step(torch.float64).items():
        error = (found[name].double() - expected).norm() / expected.norm()
        assert error < (1e-5 if name in ("image", "alpha", "depth") else 1e-3), name


def test_features_and_their_gradients_are_those_of_float64(drawn):
    for found, expected in zip(drawn("features"), feature_cases.steps(torch.float64), strict=True):
        for name, right in expected.items():
            error = (found[name].double() - right).abs()
            if name == "median_depth":  # where half of the light is left but for rounding, either may be it
                assert (error > 1e-5).double().mean() < 1e-3
            else:
                assert error.norm() < (1e-3 if name.startswith("gradient") else 1e-5) * right.norm(), name


def test_splats_that_fill_images_and_capacities_for_intersections(drawn):
    """A block adds up the intersections; with too little capacity only the images are wrong, which is reported."""
    found, expected = drawn("capacities"), intersection_cases.images_and_gradients(torch.float64)[0]
    for name, right in expected.items():
        error = (found["waited"][name].double() - right).norm() / right.norm()
        assert error < (1e-5 if name in ("image", "alpha", "depth") else 1e-3), name
        assert torch.equal(found["enough"][name], found["waited"][name]), name
    assert found["intersections"] > intersection_cases.SCENES * intersection_cases.VIEWS * 4 * 256
    for short in found["short"]:
        assert short["intersections"] == found["intersections"] and short["buffers"] > 10 and short["intact"]


def test_gradients_of_long_needles_and_short_quaternions_are_those_of_float64(drawn):
    largest = torch.finfo(torch.float32).max
    for (scene, sensor), found in zip(cases.HARD_GRADIENTS, drawn("gradients"), strict=True):
        for name, expected in cases.gradients(scene(), sensor, torch.float64).items():
            held = expected.clamp(-largest, largest)
            assert (found[name].double() - held).norm() < 5e-3 * held.norm(), (scene.__name__, sensor, name)


def test_antialiased_images_and_gradients_are_those_of_float64(drawn):
    found = iter(drawn("antialiased gradients"))
    for scene in (cases.fine(1), cases.beams()):
        for sensor in ("direct", "images"):
            have = next(found)
            for name, expected in cases.gradients(scene, sensor, torch.float64, antialiased=True).items():
                error = (have[name].double() - expected).norm() / expected.norm()
                assert error < (1e-5 if name == "image" else 5e-3), (sensor, name)


def test_images_and_gradients_by_other_cameras_are_those_of_float64(drawn):
    found = iter(drawn("camera models"))
    for model in cases.CURVED:
        for antialiased in (False, True):
            have = next(found)
            for name, expected in cases.gradients(cases.fine(1), model, torch.float64, antialiased).items():
                error = (have[name].double() - expected).norm() / expected.norm()
                assert error < (1e-5 if name == "image" else 5e-3), (model, name)


def test_filtered_views_and_their_gradients_are_those_of_the_oracle(drawn):
    *images, gradients = drawn("view filter")
    for (kernel, name, degree, views, _), found in zip(cases.FILTERED, images, strict=True):
        panel, scene = cases.panel_of(name), cases.fine(degree)
        rig, where = cases.rig_of(panel), [axis.ravel() for axis in np.indices(found["image"].shape)]
        options = dict(continuous=views == "continuous", background=cases.BACKGROUND, view_filter=cases.VIEW_FILTER)
        expected = reference.subpixel_colours(scene, panel, rig, *where, **options)
        assert found["kernel"] == kernel
        assert ((found["image"].numpy().ravel() - expected) ** 2).mean() < 1e-8, name
    expected = cases.gradients(cases.fine(1), "direct", torch.float64, view_filter=cases.VIEW_FILTER)
    for name, value in expected.items():
        error = (gradients[name].double() - value).norm() / value.norm()
        assert error < (1e-5 if name == "image" else 5e-3), name


def test_gradients_to_optics_are_those_of_float64(drawn):
    for case, found in zip(cases.OPTICS, drawn("optics"), strict=True):
        for name, expected in cases.optics_gradients(*case, torch.float64).items():
            error = (found[name].double() - expected).norm() / expected.norm()
            assert error < (1e-5 if name == "image" else 1e-3), (case, name)


def test_fitting_is_that_of_the_cpu(drawn):
    fit_cases.compare(drawn("fit"))
