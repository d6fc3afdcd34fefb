"""Scenes and panels where numbers go to extremes, for the stress suite: on every vector instruction set and on CUDA.

A case is made of what it changes in an ordinary scene before an ordinary panel, and of a bound. Units of the bounds:
largest error of a colour, of 1, over sub-pixels whose decisions (cut, stop) are not within `SETTLED` of a threshold.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace

import pytest
import torch
from rasterizer_cases import panel as panel_of
from rasterizer_cases import random_scene, rig

from lightfield_gs import Gaussians, Panel, Rig, _core, build_info

BACKGROUND = (0.1, 0.6, 0.3)
SETTLED = 5e-3
BACKENDS = [*build_info()["simd_targets"], "cuda"]
EXACT, SINGLE = 1e-8, 5e-5  # bounds of float64 and float32
# Of a light-field frame on CUDA that draws shapes as polynomials in s: what is promised of its bytes
POLYNOMIALS = 1 / 255

Change = Callable[[Gaussians], None]


@dataclass(frozen=True)
class Case:
    """change: what it does to a random scene of `count`. panel: what is not as usual. single: bound of float32.
    single_cuda: that of a light-field frame on CUDA, where it is larger. gradient: relative bound of float32 gradients,
    as vectors of a field; float64's is a twentieth. gradient_cuda: that of ordinary images on CUDA where it is larger,
    for samples are summed in float there. no_rotation: spheres, whose gradients of the quaternions are zero but for
    rounding."""

    change: Change
    count: int = 40
    panel: dict = field(default_factory=dict)
    single: float = SINGLE
    single_cuda: float = 0.0
    gradient: float = 1e-4
    gradient_cuda: float = 0.0
    no_rotation: bool = False

    def scene(self) -> Gaussians:
        """Float64 numbers that float32 can hold, so that both precisions draw the same scene."""
        scene = random_scene(self.count, seed=7, dtype=torch.float32)
        self.change(scene)
        return scene.to(torch.float64)

    def view(self) -> tuple[Panel, Rig]:
        shown = panel_of(**{"width_px": 50, "height_px": 34, "views": 24, **self.panel})
        return shown, rig(shown, 0.05, -0.1)

    def frame_bound(self, device: torch.device) -> float:
        return max(self.single, self.single_cuda) if device.type == "cuda" else self.single

    def smaller(self) -> Case:
        """With an oracle whose gradients take no long time."""
        size = {key: min(self.panel.get(key, usual), 99) for key, usual in (("width_px", 16), ("height_px", 12))}
        return replace(self, count=min(self.count, 300), panel={**self.panel, **size})


def _all(name: str, value: float | list[float]) -> Change:
    def change(scene: Gaussians) -> None:
        scene.fields()[name][:] = torch.tensor(value, dtype=scene.dtype)

    return change


def _times(name: str, factor: float | list[float]) -> Change:
    def change(scene: Gaussians) -> None:
        scene.fields()[name].mul_(torch.tensor(factor, dtype=scene.dtype))

    return change


def _depths(*depths: float) -> Change:
    """Gaussians at these view-space depths by turns, small enough not to reach the camera's plane."""

    def change(scene: Gaussians) -> None:
        axis = torch.arange(scene.count) % len(depths)
        scene.means[:, 2] = torch.tensor(depths, dtype=scene.dtype)[axis]
        scene.means[:, :2] *= scene.means[:, 2:].abs() / 2
        scene.scales.mul_(scene.means[:, 2:].abs().clamp_min(1e-3) / 2)

    return change


def _far_origin(scene: Gaussians) -> None:
    scene.means[:, :2] += torch.tensor([1e6, -1e6])


def _far_depth(scene: Gaussians) -> None:
    scene.means.mul_(5e5)
    scene.scales.mul_(5e5)


def _needles(scene: Gaussians) -> None:
    """Seen end-on by some view of the rig and nearly so by the others: the 2D covariance is nearly singular."""
    scene.scales[:] = torch.tensor([1e-7, 1e-7, 1.0])
    scene.quaternions[:] = torch.tensor([1.0, 0, 0, 0])
    scene.quaternions[::2, 2] = 0.02
    scene.means[:, 2] = 3.5


def _blades(length: float) -> Change:
    """Lines across the picture at every angle: the low pass alone makes them wide, and the 2D covariance regular."""

    def change(scene: Gaussians) -> None:
        scene.scales[:] = torch.tensor([length, 1e-8 * length, 1e-8 * length])
        angle = torch.linspace(0, math.pi, scene.count)
        scene.quaternions[:] = torch.stack([(angle / 2).cos(), 0 * angle, 0 * angle, (angle / 2).sin()], 1)

    return change


def _covering(scene: Gaussians) -> None:
    scene.means[:] = torch.tensor([0.0, 0, 2])
    scene.scales[:] = 50


def _sh_extremes(scene: Gaussians) -> None:
    scene.sh[::2] = 1e6
    scene.sh[1::2] = -1e6


CASES = {
    **{
        f"scales {s:g}": Case(_all("scales", s), no_rotation=True, single_cuda=POLYNOMIALS if s == 1 else 0)
        for s in (1e-12, 1e-6, 1e-3, 1.0, 1e3, 1e6)
    },
    **{
        f"ratio 1e8 at {s:g}": Case(
            _all("scales", [s, s * 1e-4, s * 1e-8]),
            gradient=1e-4 if s < 1e6 else 2e-3,
            single_cuda=POLYNOMIALS if s in (1.0, 1e2) else 0,
        )
        for s in (1e-3, 1.0, 1e2, 1e6)
    },
    "ratio 1e8 the other way": Case(_all("scales", [1e-10, 1e-2, 1e-6]), single_cuda=POLYNOMIALS),
    **{
        f"quaternions times {s:g}": Case(_times("quaternions", s)) for s in (1e-38, 1e-30, 1e-18, 1e-6, 1e6, 1e18, 1e37)
    },
    **{f"opacity {o:g}": Case(_all("opacities", o)) for o in (0.0, 1e-45, 1e-38, 1 / 255, 0.0040, 0.99, 1.0)},
    "at the near plane": Case(_depths(0.0099999, 0.01, 0.0100001, 0.011)),
    "behind": Case(_depths(-1e6, -2.0, -0.01, -1e-30, 0.0)),
    "before and behind": Case(_depths(-2.0, 0.0, 0.02, 2.0, 1e3)),
    "one depth for thousands": Case(_all("means", [0.0, 0, 2]), count=1500, single_cuda=POLYNOMIALS),
    "means at 1e6 aside": Case(_far_origin),
    "means at 1e6 before": Case(_far_depth),
    "needles end-on": Case(_needles),
    **{
        f"blades of {length:g}": Case(
            _blades(length),
            gradient=1e-4 if length < 1e6 else 0.5,
            single_cuda=POLYNOMIALS if length < 1e6 else 0,
            gradient_cuda=5e-3 if length == 30 else 0,
        )
        for length in (1.0, 30.0, 1e3, 1e6)
    },
    "one that covers the panel": Case(_covering, count=1, no_rotation=True),
    "forty that cover the panel": Case(_covering, no_rotation=True),
    "single": Case(lambda scene: None, count=1),
    "none": Case(lambda scene: None, count=0),
    **{f"{n} views": Case(lambda scene: None, panel=dict(views=n)) for n in (1, 2, 96, 1000, 65536)},
    **{
        f"line number {p:g}": Case(lambda scene: None, panel=dict(line_number=p, phase=0.2537 * p))
        for p in (1e-3, 0.3, 0.999, 1.0, 2.999, 3.0, 63.0, 63.001, 1e4, 123456.7, 1e6)
    },
    **{
        f"slant {a} degrees": Case(lambda scene: None, panel=dict(slant_tan=math.tan(math.radians(a))))
        for a in (-84, -60, -45, 45, 60, 84)
    },
    **{
        f"panel {w} x {h}": Case(
            lambda scene: None, panel=dict(width_px=w, height_px=h), single_cuda=POLYNOMIALS if h == 1500 else 0
        )
        for w, h in ((1, 1), (2, 1), (1, 2), (17, 16), (16, 17), (4096, 1), (1, 1500))
    },
    **{f"cone {c:g} degrees": Case(lambda scene: None, panel=dict(cone_deg=c)) for c in (1e-6, 150.0, 179.9)},
}


@contextmanager
def use_backend(name: str) -> Iterator[torch.device]:
    """The device of a backend: the CPU, on this vector instruction set only, or CUDA."""
    if name == "cuda":
        if not torch.cuda.is_available():
            pytest.skip("needs a CUDA GPU")
        yield torch.device("cuda")
        return
    _core.set_simd_target(name)
    try:
        yield torch.device("cpu")
    finally:
        _core.set_simd_target("")


# For the methods that draw view by view, and so take longer
_SLOW = ("quaternions", "line number", "slant", "65536 views", "1000 views")
METHODS = [name for name in CASES if not name.startswith(_SLOW)]


@contextmanager
def one_thread() -> Iterator[None]:
    """For the oracle's many small steps, which are slower on several."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def check_gradients(case, want, single, double, least_bound=0.0):
    """Assert that the gradients of the five fields are finite, and equal the oracle's within the case's bound.

    The bound of float32 is least_bound if that is larger.
    """
    for name, true, s, d in zip(case.scene().fields(), want, single, double):
        assert torch.isfinite(s).all() and torch.isfinite(d).all(), name
        if name == "quaternions" and case.no_rotation:
            continue
        assert (d - true).norm() <= case.gradient / 20 * true.norm(), name
        held = true.clamp(-torch.finfo(torch.float32).max, torch.finfo(torch.float32).max)
        assert (s.cpu().double() - held).norm() <= max(case.gradient, least_bound) * held.norm(), name
