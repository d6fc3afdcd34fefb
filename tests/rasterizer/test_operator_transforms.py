"""The operators under torch.func, torch.compile and torch.export, without values, and asked for second derivatives."""

import pytest
import torch
from rasterizer_cases import panel, rig
from test_gradients import SMALL, dense, dense_inputs, leaves, lens, lens_inputs
from test_traced_render import WHOLE_GRAPHS, by_torch, everything, fields, gradients
from torch.func import grad, hessian, jacrev, vmap
from torch.utils._python_dispatch import TorchDispatchMode

from lightfield_gs import InputError, reference
from lightfield_gs.encoding.compiled import encode_in_graph

COPIES = 2


def ordinary():
    """The function of image, alpha and depth, the oracle's, and their arguments."""
    moving, fixed = dense_inputs(1, 2, 3, 1, 7, 5)
    return lambda *m: dense(*m, *fixed), lambda *m: reference.dense_torch(*m, *fixed), moving


def light_field():
    moving, fixed, (shown, fan) = lens_inputs("default lens", 3, 1, cone_deg=12.0, **SMALL)
    return lambda *m: (lens(*m, *fixed),), lambda *m: (reference.lens_torch(*m, shown, fan),), moving


SENSORS = pytest.mark.parametrize("sensor", [ordinary, light_field])


def loss_of(draw):
    return lambda *moving: sum((k + 1) * image.square().sum() for k, image in enumerate(draw(*moving)))


def several(moving):
    """Rows of arguments that differ but in the poses, which would have to stay rotations."""
    return [torch.stack([t + 0.01 * k * (t.shape[-2:] != (4, 4)) for k in range(COPIES)]).detach() for t in moving]


def of_each(function, batch):
    """What vmap(function)(*batch) is to be."""
    rows = [function(*(t[k] for t in batch)) for k in range(COPIES)]
    return [torch.stack(outputs) for outputs in zip(*rows)]


def assert_near(got, want, **tolerance):
    assert len(got) == len(want)
    for have, true in zip(got, want):
        torch.testing.assert_close(have, true, **tolerance)


class Calls(TorchDispatchMode):
    """Records the calls of the package's operators."""

    def __init__(self):
        super().__init__()
        self.calls = []

    def __torch_dispatch__(self, function, types, args=(), kwargs=None):
        if function.namespace == "lightfield_gs":
            self.calls.append((function, args))
        return function(*args, **(kwargs or {}))

    def names(self):
        return [function.name().split("::")[1] for function, _ in self.calls]


@SENSORS
def test_gradients_and_jacobians_of_torch_func_are_those_of_the_oracle(sensor):
    draw, oracle, moving = sensor()
    every, plain = tuple(range(len(moving))), [t.detach() for t in moving]
    want = torch.autograd.grad(loss_of(oracle)(*moving), moving)
    assert_near(grad(loss_of(draw), every)(*plain), want, rtol=1e-5, atol=1e-6)
    jacobian = jacrev(lambda means: draw(means, *plain[1:])[0])(plain[0])
    want = torch.autograd.functional.jacobian(lambda means: oracle(means, *plain[1:])[0], plain[0])
    torch.testing.assert_close(jacobian, want, rtol=1e-5, atol=1e-6)


@SENSORS
def test_vmap_and_its_gradients_are_those_of_each_row(sensor):
    draw, _, moving = sensor()
    batch, every = several(moving), tuple(range(len(moving)))
    assert_near(vmap(draw)(*batch), of_each(draw, batch))
    gradient = grad(loss_of(draw), every)
    want = of_each(gradient, batch)
    assert_near(vmap(gradient)(*batch), want)
    assert_near(grad(lambda *b: vmap(loss_of(draw))(*b).sum(), every)(*batch), want)
    last, *others = batch[-1].movedim(0, -1), *(t.detach() for t in moving[:-1])
    in_dims = (*(None for _ in others), last.dim() - 1)
    assert_near(
        vmap(gradient, in_dims)(*others, last), of_each(lambda one: gradient(*others, one), [last.movedim(-1, 0)])
    )


def test_vmap_draws_all_rows_at_once():
    draw, _, moving = ordinary()
    with Calls() as calls:
        vmap(grad(loss_of(draw)))(*several(moving))
    assert calls.names() == ["render_images_with_state", "render_images_backward"]


@pytest.mark.parametrize("sensor", [pytest.param(ordinary, marks=WHOLE_GRAPHS), light_field])
def test_compiled_transforms_are_whole_graphs(sensor):
    draw, _, moving = sensor()
    batch, every = several(moving), tuple(range(len(moving)))
    gradient = vmap(grad(loss_of(draw), every))
    assert_near(torch.compile(gradient, fullgraph=True, backend="aot_eager")(*batch), gradient(*batch))


@SENSORS
def test_second_derivatives_and_forward_mode_are_refused(sensor):
    draw, _, moving = sensor()
    plain, linear = [t.detach() for t in moving], lambda *m: draw(*m)[0].sum()
    for loss in (loss_of(draw), linear):
        (first,) = torch.autograd.grad(loss(*moving), moving[0], create_graph=True)
        with pytest.raises(InputError, match="differentiable once"):
            torch.autograd.grad(first.sum(), moving[1])
        with pytest.raises(InputError, match="differentiable once"):
            grad(lambda *m, loss=loss: grad(loss)(*m).sum())(*plain)
    with pytest.raises(InputError, match="forward mode"):
        hessian(loss_of(draw))(*plain)


@SENSORS
def test_tensors_without_values_draw_shapes(sensor):
    draw, _, moving = sensor()
    want = [image.shape for image in draw(*moving)]
    meta = leaves(t.to("meta") for t in moving)
    images = draw(*meta) if sensor is light_field else dense(*meta, *(t.to("meta") for t in VIEWS), 7, 5)
    assert [image.shape for image in images] == want and images[0].is_meta
    found = torch.autograd.grad(images[0].sum(), meta)
    assert [t.shape for t in found] == [t.shape for t in moving]


VIEWS = [torch.empty(1, 2, size, dtype=torch.float64) for size in (4, 5)]  # intrinsics and limits


def test_every_operator_is_registered_as_torch_wants_it():
    """Also the backward ones, of the arguments that they are called with."""
    with Calls() as calls:
        for draw in (everything, by_torch):
            given = leaves(fields())
            gradients(draw(*given), given)
        for sensor in (ordinary, light_field):
            draw, _, moving = sensor()
            torch.autograd.grad(loss_of(draw)(*moving), moving)
        shown = panel("cells", **SMALL)
        image = encode_in_graph(tuple(given), given[3][:3], shown, rig(shown), True, 0.5, True)
        torch.autograd.grad(image.sum(), given)
    schemas = torch._C._jit_get_all_schemas()
    known = {schema.name.split("::")[1] for schema in schemas if schema.name.startswith("lightfield_gs::")}
    assert set(calls.names()) == known - {"render_images"}  # that is made of render_images_with_state
    for function, given in dict(calls.calls).items():
        torch.library.opcheck(function, tuple(t.detach() if isinstance(t, torch.Tensor) else t for t in given))
