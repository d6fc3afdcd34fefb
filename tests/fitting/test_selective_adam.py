"""Adam of some rows: against the formulas, in plain torch and of torch's own SparseAdam, in float64."""

import pytest
import torch

from lightfield_gs import InputError
from lightfield_gs.fitting import MCMCStrategy, SelectiveAdam

SHAPES = ((7,), (7, 3), (7, 4, 3))
BETAS, EPSILON, RATE = (0.8, 0.95), 1e-3, 0.1


def gradients(step: int) -> tuple[torch.Tensor, list[torch.Tensor]]:
    """The rows that a step sees, and gradients of them."""
    draw = torch.Generator().manual_seed(step)
    rows = torch.randperm(7, generator=draw)[:3]
    return rows, [torch.randn(3, *shape[1:], generator=draw, dtype=torch.float64) for shape in SHAPES]


def parameters() -> list[torch.nn.Parameter]:
    draw = torch.Generator().manual_seed(99)
    return [torch.nn.Parameter(torch.randn(shape, generator=draw, dtype=torch.float64)) for shape in SHAPES]


def sparse(rows: torch.Tensor, values: torch.Tensor) -> torch.Tensor:
    """As backward leaves it after two cameras: every row twice, in no order."""
    twice = torch.cat([rows, rows.flip(0)])[None], torch.cat([values / 4, values.flip(0) * 0.75])
    return torch.sparse_coo_tensor(*twice, (7, *values.shape[1:]), check_invariants=True)


def test_sparse_gradients_move_their_rows_as_sparse_adam_does():
    ours, theirs = parameters(), parameters()
    mine = SelectiveAdam(ours, EPSILON, BETAS, lr=RATE, bias_correction=True)
    other = torch.optim.SparseAdam(theirs, lr=RATE, betas=BETAS, eps=EPSILON)
    for step in range(6):
        rows, values = gradients(step)
        for own, its, value in zip(ours, theirs, values):
            own.grad, its.grad = sparse(rows, value), sparse(rows, value)
        mine.step()
        other.step()
    for own, its in zip(ours, theirs):
        torch.testing.assert_close(own.detach(), its.detach(), atol=1e-13, rtol=1e-13)
        for name in ("exp_avg", "exp_avg_sq"):
            torch.testing.assert_close(mine.state[own][name], other.state[its][name], atol=1e-13, rtol=1e-13)


@pytest.mark.parametrize("kind", ["mask", "sparse"])
def test_rows_move_by_the_formula_of_gsplat_and_the_others_stay(kind):
    ours, expected = parameters(), [value.detach().clone() for value in parameters()]
    moments = [[torch.zeros_like(value) for value in expected] for _ in range(2)]
    optimizer = SelectiveAdam([{"params": ours, "lr": RATE}], eps=EPSILON, betas=BETAS)
    for step in range(6):
        rows, values = gradients(step)
        for own, value in zip(ours, values):
            own.grad = sparse(rows, value)
            if kind == "mask":  # rows that are not seen have gradients too, and stay
                own.grad = torch.ones_like(own).index_copy(0, rows, value)
        optimizer.step(*([torch.zeros(7).index_fill(0, rows, 1)] if kind == "mask" else []))
        for value, first, second, gradient in zip(expected, *moments, values):
            for row, g in zip(rows.tolist(), gradient):
                first[row] = BETAS[0] * first[row] + (1 - BETAS[0]) * g
                second[row] = BETAS[1] * second[row] + (1 - BETAS[1]) * g**2
                value[row] -= RATE * first[row] / (second[row].sqrt() + EPSILON)
    for own, value in zip(ours, expected):
        torch.testing.assert_close(own.detach(), value, atol=1e-13, rtol=1e-13)


def test_rows_that_are_not_known_are_refused():
    (value,) = parameters()[:1]
    optimizer = SelectiveAdam([value])
    value.grad = torch.ones_like(value)
    for mask, words in ((None, "gradient is dense"), (torch.ones(6), r"expected \[7\]")):
        with pytest.raises(InputError, match=words):
            optimizer.step(mask)
    value.grad = value.grad.to_sparse()
    with pytest.raises(InputError, match="rows of its own"):
        optimizer.step(torch.ones(7))
    with pytest.raises(InputError, match="betas"):
        SelectiveAdam([value], betas=(0.9, 1.0))


def test_strategies_take_its_moments_with_the_rows():
    shapes = {"means": (40, 3), "scales": (40, 3), "quats": (40, 4), "opacities": (40,)}
    params = {name: torch.nn.Parameter(torch.ones(shape)) for name, shape in shapes.items()}
    optimizers = {name: SelectiveAdam([value]) for name, value in params.items()}
    sum(value.sum() for value in params.values()).backward()
    for optimizer in optimizers.values():
        optimizer.step(torch.arange(40) % 2)
    strategy = MCMCStrategy(cap_max=43, refine_start_iter=0, refine_every=1)
    for step in range(1, 5):
        strategy.step_post_backward(params, optimizers, {}, step, {}, lr=0.0)
    moments = optimizers["means"].state[params["means"]]["exp_avg"]
    assert moments.shape == params["means"].shape == (43, 3) and int(moments[40:].count_nonzero()) == 0
