"""Gradients of light-field images to the numbers of their panel and rig."""

from dataclasses import replace

import pytest
import torch
from rasterizer_cases import panel, projected, random_scene, rig

from lightfield_gs import Gaussians, InputError, Optics, Panel, _core, encode
from lightfield_gs.panels.rig import lenticular_camera
from lightfield_gs.rasterizer.direct import DirectRender
from lightfield_gs.rasterizer.stats import Stats

SMALL = dict(width_px=12, height_px=7)
CASES = {
    "colours as they are": (0, "default lens", {}),
    "harmonics": (3, "default lens", {}),
    "anti-aliased": (1, "leaning the other way, BGR", {"antialiased": True}),
    "view filter": (1, "inverted", {"view_filter": 3.0}),
    "cells": (1, "cells", {}),
    "cells of four rows": (0, "cells of four rows", {}),
}


def fan(shown: Panel):
    return replace(rig(shown, 0.1, -0.15, (0.53, 0.44)), focal_px=(14.0, 15.0), cone_deg=31.0)


def check(scene: Gaussians, shown: Panel, **options) -> None:
    given = Optics.of(shown, fan(shown)).given()

    def draw(*values):
        optics = Optics(**dict(zip(given, values)))
        return [encode(scene, shown, fan(shown), views="continuous", output="float64", optics=optics, **options)]

    values = tuple(given.values())
    assert torch.autograd.gradcheck(projected(draw), values, eps=1e-7, atol=1e-5, rtol=1e-5, nondet_tol=0)


@pytest.mark.parametrize("case", CASES)
def test_gradcheck_of_all_numbers_of_panel_and_rig(case):
    degree, name, options = CASES[case]
    check(random_scene(4, degree, seed=1, extent=0.2, size=0.3), panel(name, **SMALL), **options)


def test_gradcheck_near_the_cameras_where_colours_are_on_circles():
    scene, shown = random_scene(4, 2, seed=1, depth=0.3, extent=0.03, size=0.04), panel(**SMALL)
    pose = torch.from_numpy(fan(shown).world_to_camera)
    scene = replace(scene, means=(scene.means - pose[:3, 3]) @ pose[:3, :3])
    render = DirectRender(scene.fields().values(), torch.ones(3).double(), lenticular_camera(shown, fan(shown)))
    work = render.workspace(Stats(), 1)
    drawn = work.splats.splats[0, :, _core.SPLAT_REACH_INDEX] >= 0
    assert (work.splats.orders[0, drawn] < 0).any()
    check(scene, shown)


def test_gaussians_have_the_same_gradients_with_optics_as_without():
    scene, shown = random_scene(6, 1, seed=3), panel(**SMALL)
    found = []
    for optics in (None, Optics.of(shown, fan(shown))):
        fields = {name: t.clone().requires_grad_() for name, t in scene.fields().items()}
        colour = torch.tensor([0.2, 0.4, 0.9], dtype=torch.float64, requires_grad=True)
        options = dict(views="continuous", output="float64", background=colour, optics=optics)
        image = encode(Gaussians(**fields), shown, fan(shown), **options)
        image.square().sum().backward()
        found.append((image.detach(), colour.grad, *(t.grad for t in fields.values())))
    for plain, beside in zip(*found):
        assert torch.equal(plain, beside)


@pytest.mark.parametrize("degree, error", [(0, 1e-4), (1, 5e-3)])  # colours by polynomials err by up to 5e-5 in float
def test_single_precision_agrees_with_double(degree, error):
    scene, shown, found = random_scene(4, degree, seed=1, extent=0.2, size=0.3), panel(**SMALL), []
    for output in ("float32", "float64"):
        optics = Optics.of(shown, fan(shown))
        image = encode(scene, shown, fan(shown), views="continuous", output=output, optics=optics)
        found.append(torch.autograd.grad(image.square().sum(), tuple(optics.given().values())))
    for single, double in zip(*found):
        assert (single - double).norm() < error * double.norm()


def test_numbers_take_the_place_of_those_of_panel_and_rig():
    scene, shown = random_scene(6, 1, seed=3), panel("cells", **SMALL)
    other = replace(shown, line_number=17.0, phase=3.0, subpixel_cells=shown.subpixel_cells[::-1])
    turned = replace(fan(other), zero_depth=2.3, cone_deg=20.0)
    for method in ("direct", "classic"):
        for views in ("integer", "continuous"):
            expected = encode(scene, other, turned, method, views=views)
            with torch.no_grad():
                given = encode(scene, shown, fan(shown), method, views=views, optics=Optics.of(other, turned))
            assert torch.equal(given, expected)


def test_the_rig_has_gradients_with_integer_views_and_the_lens_has_none():
    scene, shown = random_scene(4, 1, seed=1, extent=0.2, size=0.3), panel(**SMALL)
    names = "world_to_camera", "zero_depth", "cone_deg", "focal_px"
    given = Optics.of(shown, fan(shown), names).given()

    def draw(*values):
        return [encode(scene, shown, fan(shown), output="float64", optics=Optics(**dict(zip(given, values))))]

    assert torch.autograd.gradcheck(projected(draw), tuple(given.values()), eps=1e-7, atol=1e-5, rtol=1e-5)
    for name in ("line_number", "slant_tan", "phase"):
        with pytest.raises(InputError, match=f"{name} have no gradients: use views='continuous'"):
            encode(scene, shown, fan(shown), output="float64", optics=Optics.of(shown, names=[name]))


def test_what_has_no_gradients_to_optics_is_refused():
    scene, shown = random_scene(4, 1, seed=1), panel(**SMALL)
    options = dict(views="continuous", output="float64")
    with pytest.raises(InputError, match="'classic' has no gradients to phase: use method 'direct'"):
        encode(scene, shown, fan(shown), "classic", optics=Optics.of(shown, names=["phase"]), **options)
    with pytest.raises(InputError, match="cone of 0 degrees has no gradients"):
        flat = replace(fan(shown), cone_deg=0.0)
        encode(scene, shown, flat, optics=Optics.of(shown, flat, ["zero_depth"]), **options)
    with pytest.raises(InputError, match="phase must be floating point numbers .., got torch.int64"):
        Optics(phase=torch.tensor(3))
    with pytest.raises(InputError, match="subpixel_cells: expected names of line_number, slant_tan"):
        Optics.of(shown, names=["subpixel_cells"])
    with pytest.raises(InputError, match="has stripes: leave them out"):
        encode(scene, shown, fan(shown), optics=Optics(subpixel_cells=torch.zeros(1, 3, 2)))
    with pytest.raises(InputError, match="line_number must be"):
        encode(scene, shown, fan(shown), optics=Optics(line_number=torch.tensor(-1.0)))
