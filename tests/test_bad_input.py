"""Tensors that make no sense: one line that names the field, from every entry into the library."""

import math

import numpy as np
import pytest
import torch

from lightfield_gs.errors import InputError
from lightfield_gs.gaussians import Gaussians
from lightfield_gs.panel import Panel
from lightfield_gs.rendering import encode, interlace, render
from lightfield_gs.rig import Rig

PANEL = Panel(width_px=24, height_px=16, views=4, line_number=7.3, slant_tan=0.2)
RIG = Rig(np.eye(4), (24, 24), (12, 8), 2.0)


def scene(**changes) -> Gaussians:
    fields = dict(means=torch.tensor([[0.0, 0, 2], [0.1, 0, 3]]), quaternions=torch.ones(2, 4),
                  scales=torch.full((2, 3), 0.1), opacities=torch.full((2,), 0.5), sh=torch.zeros(2, 1, 3))
    return Gaussians(**{**fields, **changes})


BAD_SCENES = {
    "nan mean": (dict(means=torch.tensor([[0.0, 0, 2], [math.nan, 0, 3]])), "means"),
    "infinite scale": (dict(scales=torch.full((2, 3), math.inf)), "scales"),
    "zero scale": (dict(scales=torch.zeros(2, 3)), "scales"),
    "opacity": (dict(opacities=torch.tensor([0.5, 1.5])), "opacities"),
    "zero quaternion": (dict(quaternions=torch.zeros(2, 4)), "quaternions"),
    "nan sh": (dict(sh=torch.full((2, 1, 3), math.nan)), "sh"),
    "shape": (dict(opacities=torch.ones(3)), "opacities"),
    "sh count": (dict(sh=torch.zeros(2, 7, 3)), "sh"),
    "dtype": (dict(scales=torch.ones(2, 3, dtype=torch.float64)), "scales"),
    "integers": (dict(means=torch.zeros(2, 3, dtype=torch.int64)), "means"),
    "device": (dict(scales=torch.ones(2, 3, device="meta")), "scales"),
}


@pytest.mark.parametrize("case", BAD_SCENES)
@pytest.mark.parametrize("method", ["direct", "sorted", "classic"])
def test_encode_refuses(case, method):
    change, field = BAD_SCENES[case]
    with pytest.raises(InputError, match=field) as caught:
        encode(scene(**change), PANEL, RIG, method)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("case", ["shape", "sh count", "dtype", "integers", "device"])
def test_render_refuses(case):
    change, field = BAD_SCENES[case]
    with pytest.raises(InputError, match=field):
        render(scene(**change), RIG.cameras(PANEL, [0]).to(torch.float32))


@pytest.mark.parametrize("options, words", [
    (dict(method="guess"), "method"), (dict(views="all"), "views"), (dict(output="int7"), "output"),
    (dict(background=(1, 2)), "background"), (dict(background=(math.nan, 0, 0)), "background")])
def test_encode_options(options, words):
    with pytest.raises(InputError, match=words):
        encode(scene(), PANEL, RIG, **options)


@pytest.mark.parametrize("out, options, words", [
    (torch.empty(16, 24, 3), {}, "uint8"), (torch.empty(24, 16, 3, dtype=torch.uint8), {}, r"\[16, 24, 3\]"),
    (torch.empty(16, 3, 24, dtype=torch.uint8).transpose(1, 2), {}, "strides"), (np.empty((16, 24, 3)), {}, "out"),
    (torch.empty(16, 24, 3, dtype=torch.uint8, device="meta"), {}, "meta"),
    (torch.empty(16, 24, 3, dtype=torch.uint8), dict(method="sorted"), "direct"),
    (torch.empty(16, 24, 3, requires_grad=True), dict(output="float32"), "gradients")])
def test_images_that_cannot_be_drawn_over(out, options, words):
    with pytest.raises(InputError, match=words):
        encode(scene(), PANEL, RIG, out=out, **options)


def test_an_image_with_gradients_is_a_new_one():
    drawn = scene(means=torch.tensor([[0.0, 0, 2], [0.1, 0, 3]], requires_grad=True))
    with pytest.raises(InputError, match="no_grad"):
        encode(drawn, PANEL, RIG, output="float32", out=torch.empty(16, 24, 3))


def test_a_batch_is_not_encoded():
    with pytest.raises(InputError):
        encode(Gaussians(*(tensor[None] for tensor in scene().fields().values())), PANEL, RIG)


def test_no_gaussians_give_the_background():
    empty = Gaussians(*(tensor[:0] for tensor in scene().fields().values()))
    for method in ("direct", "sorted", "classic"):
        image = encode(empty, PANEL, RIG, method, background=(1, 0.5, 0), output="float32")
        assert image.tolist() == torch.tensor([1, 0.5, 0]).expand(16, 24, 3).tolist()


@pytest.mark.parametrize("views", [torch.zeros(3, 16, 24, 3), torch.zeros(4, 15, 24, 3), torch.zeros(4, 16, 24),
                                   torch.zeros(4, 16, 24, 1)])
def test_interlace_refuses(views):
    with pytest.raises(InputError):
        interlace(views, PANEL)
