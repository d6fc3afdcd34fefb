"""The stages on another system against Linux on x86-64, by files of stages_to_file: 64-bit ARM, and Windows.

`make test-arm` makes the files, with QEMU as the processor, and `make test-windows`, with Wine as the system. They name
the files in the environment, and the vectors that the other one has.
"""

import os
from pathlib import Path

import numpy as np
import pytest
import torch

import lightfield_gs.rasterizer.direct  # noqa: F401  the operator
from lightfield_gs.rasterizer.lenticular_camera import Lens, LenticularCamera

FILES = {name: os.environ.get(f"LFGS_STAGES_{name.upper()}", "") for name in ("elsewhere", "here")}
VECTORS = os.environ.get("LFGS_STAGES_VECTORS", "")
if not all(FILES.values()):
    pytest.skip(
        "`make test-arm` and `make test-windows` run these: they need a cross compiler, and QEMU or Wine",
        allow_module_level=True,
    )

WIDTH, HEIGHT, VIEWS, STEP = 150, 70, 24, int(18446744073709551615.0 / 9.85)
FIELDS = ("means", "quaternions", "scales", "opacities", "sh")
SHAPES = {"means": (-1, 3), "quaternions": (-1, 4), "scales": (-1, 3), "opacities": (-1,), "sh": (-1, 4, 3)}
INPUTS = (*FIELDS, "gradient")
# By precision: the largest error of a number of a result, and the largest mean error, in units of its largest number.
# In float32 a sample may lie on either side of a threshold, as alpha = 1/255, by the last digit of an exponent.
TOLERANCES = {"float32": (5e-3, 1e-5), "float64": (1e-9, 1e-12)}
# Whether a tile has a lattice depends on the lattice's errors, so that a tile at the limit may be drawn either way. The
# worst number stays within the limit in stages_to_file, 0.5 at a check
LATTICE = (0.1, 1e-4)


def read(path: str) -> tuple[str, dict[tuple[str, str], np.ndarray]]:
    """The vectors' name, and results by precision and name."""
    target, rest = Path(path).read_bytes().split(b"\n", 1)
    results = {}
    while rest:
        head, rest = rest.split(b"\n", 1)
        name, size, count = head.decode().rsplit(" ", 2)
        dtype = {"4": "float32", "8": "float64"}[size]
        results[dtype, name] = np.frombuffer(rest, dtype, int(count))
        rest = rest[int(size) * int(count) :]
    return target.decode(), results


TARGET, THERE = read(FILES["elsewhere"])
HERE = read(FILES["here"])[1]


def agree(precision: str, name: str, got: np.ndarray, want: np.ndarray) -> None:
    worst, mean = LATTICE if name.startswith("lattice") else TOLERANCES[precision]
    assert got.size == want.size and np.isfinite(want).all()
    off = np.abs(got.astype(np.float64) - want.astype(np.float64).ravel()) / max(np.abs(want).max(), 1e-30)
    assert off.max() <= worst and off.mean() <= mean, f"{name}: {off.max():.2g} at most, {off.mean():.2g} in the mean"


def test_the_vectors_are_those_of_the_processor():
    assert VECTORS and TARGET.startswith(VECTORS)


@pytest.mark.parametrize("precision, name", THERE)
def test_every_stage_computes_what_it_does_here(precision, name):
    got, want = THERE[precision, name], HERE[precision, name]
    if name in INPUTS or name == "fit uniforms":
        assert got.tobytes() == want.tobytes()
    else:
        agree(precision, name, got, want)


@pytest.mark.parametrize("continuous", [False, True])
@pytest.mark.parametrize("precision", TOLERANCES)
def test_light_fields_and_their_gradients_are_those_of_the_module(precision, continuous):
    fields = [torch.from_numpy(THERE[precision, f].copy()).reshape(SHAPES[f]).requires_grad_() for f in FIELDS]
    background = torch.tensor([0.2, 0.4, 0.6], dtype=fields[0].dtype)
    lens = Lens(
        width_px=WIDTH,
        height_px=HEIGHT,
        views=VIEWS,
        phases=(STEP, STEP, STEP // 2),
        line_number=9.85,
        slant_tan=1 / 6,
        phase=1.0,
        bgr=False,
        continuous=continuous,
        offset_start=0.7,
        offset_step=-1.4 / VIEWS,
    )
    camera = LenticularCamera(
        world_to_camera=tuple(np.eye(4).ravel().tolist()),
        intrinsics=(90.0, 90.0, 75.0, 35.0),
        limits=(-1.5, 1.5, -1.0, 1.0, 0.0),
        zero_depth=2.0,
        lens=lens,
    )
    image = torch.ops.lightfield_gs.render_direct(*fields, background, *camera.numbers())
    image.backward(torch.from_numpy(THERE[precision, "gradient"].copy()).reshape(image.shape))
    name = "continuous" if continuous else "steps"
    agree(precision, name, THERE[precision, f"{name} image"], image.detach().numpy())
    for field, tensor in zip(FIELDS, fields):
        agree(precision, name, THERE[precision, f"{name} g_{field}"], tensor.grad.numpy())
