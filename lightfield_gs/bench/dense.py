"""Measure the time of an ordinary image: forward and backward of one camera, ours and gsplat's by turns.

The scene is synthetic, so that other programs can draw the same one: see `frustum`.
"""

from __future__ import annotations

import argparse
import gc
import math
import statistics
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, cast

import numpy as np
import torch
from torch import Tensor

from lightfield_gs.base.errors import InputError
from lightfield_gs.bench import options
from lightfield_gs.bench.benchmarks import load_from_checkout
from lightfield_gs.bench.report import aligned, in_ms, megabytes, or_dash
from lightfield_gs.bench.timing import ms_in_a_row, timed_by_turns
from lightfield_gs.commands.options.parser import whole_numbers
from lightfield_gs.rasterizer.images import render
from lightfield_gs.scene.cameras import Cameras
from lightfield_gs.scene.gaussians import Gaussians, from_tensors

OURS = "lightfield-gs"
COUNTS = {"cpu": (10_000,), "cuda": (100_000, 500_000, 1_000_000, 3_000_000)}
SIZES_PX = {"cpu": (400, 266), "cuda": (1600, 1066)}
SH_DEGREE = 3
RUNS_IN_A_ROW = {"cpu": 3, "cuda": 30}
_STD_PX, _STD_COUNT, _STD_PIXELS = 1.2, 1_000_000, 1600 * 1066  # median: 1.2 px for a million at this size
_FOCAL_WIDTHS = 0.75  # the focal length in widths of the image
_HARMONIC_DEVIATIONS = (0.5, 0.1)  # of the coefficients of degree 0, and of the others

Draw = Callable[[Gaussians], Tensor]
# What draws images [1, H, W, 3] before black; or features [N, D], if there are any, in place of colours
Program = Callable[[Cameras, Tensor | None], Draw]


class Step:
    """A training step in two parts: images of Gaussians that ask for gradients, and the gradients of a loss."""

    def __init__(
        self,
        gaussians: Gaussians,
        draw: Callable[[Gaussians], Any],
        loss: Callable[[Any], Tensor],
        features: Tensor | None = None,
    ) -> None:
        self.gaussians, self._draw, self._loss = gaussians, draw, loss
        leaves = gaussians.fields() | ({} if features is None else {"features": features})
        self._leaves = {name: leaf for name, leaf in leaves.items() if leaf.requires_grad}
        self._outputs: Any = None

    def forward(self) -> None:
        """Run draw(gaussians)."""
        for leaf in self._leaves.values():
            leaf.grad = None
        self._outputs = self._draw(self.gaussians)

    def backward(self) -> None:
        """Run the backward pass from loss(outputs) to the fields of the Gaussians."""
        self._loss(self._outputs).backward()

    def both(self) -> None:
        """Run forward and backward pass."""
        self.forward()
        self.backward()

    def image_and_gradients(self) -> dict[str, Tensor]:
        """Return the image of the last step, and the gradient of every field that asks for it, and of features."""
        gradients = {name: cast(Tensor, leaf.grad) for name, leaf in self._leaves.items()}
        return {"image": self._outputs.detach(), **gradients}

    def release(self) -> None:
        """Release the drawn images; the gradients stay."""
        self._outputs = None


def frustum(count: int, width_px: int, height_px: int, seed: int = 0) -> Gaussians:
    """Return `count` Gaussians of SH degree 3 before a camera at the origin that looks along +z, float32.

    Depths are log-uniform in 2..10, positions on the image uniform over 1.2 times its width and height. Standard
    deviations are log-normal (0.6) along each of three axes, rotations random. Their median on the image is 1.2 px for
    a million Gaussians at 1600 x 1066 px. Fewer Gaussians are larger, and cover as much. Opacities are the sigmoid of
    normal numbers times 2, at least 0.01.
    """
    random = np.random.default_rng(seed)
    # The scene depends on the order of the random draws: none may be left out.
    depth = 2 * 5 ** random.random(count)
    x, y = ((1.2 * random.random(count) - 0.1) * side for side in (width_px, height_px))
    focal = _FOCAL_WIDTHS * width_px
    means = np.stack([(x - width_px / 2) / focal * depth, (y - height_px / 2) / focal * depth, depth], axis=1)
    std_px = _STD_PX * math.sqrt(_STD_COUNT / count * (width_px * height_px / _STD_PIXELS))
    scales = (std_px / focal * depth)[:, None] * np.exp(0.6 * random.normal(size=(count, 3)))
    quaternions = random.normal(size=(count, 4))
    quaternions /= np.linalg.norm(quaternions, axis=1, keepdims=True)
    opacities = np.maximum(1 / (1 + np.exp(-2 * random.normal(size=count))), 0.01)
    base, others = _HARMONIC_DEVIATIONS
    sh = np.concatenate([base * random.normal(size=(count, 1, 3)), others * random.normal(size=(count, 15, 3))], axis=1)
    fields = (means, quaternions, scales, opacities, sh)
    return from_tensors(torch.from_numpy(np.ascontiguousarray(field, np.float32)) for field in fields)


def camera(width_px: int, height_px: int, device: str) -> Cameras:
    """Return the camera in front of the Gaussians of `frustum`."""
    focal, centre = (
        torch.tensor([pair], device=device) for pair in ([_FOCAL_WIDTHS * width_px] * 2, [width_px / 2, height_px / 2])
    )
    return Cameras(torch.eye(4, device=device)[None], focal, centre, width_px, height_px)


def rows(
    counts: Sequence[int],
    size_px: tuple[int, int],
    device: str,
    repeats: int | None,
    channels: Sequence[int | None] = (None,),
) -> list[dict[str, Any]]:
    """Return a row for each number of Gaussians, number of channels of features (None: colours) and program.

    There are rows of gsplat on CUDA if it is installed; else a line on stderr says why not.
    """
    programs: dict[str, Program] = {OURS: _ours}
    if device == "cuda":
        try:
            version = load_from_checkout("peers").gsplat().__version__
            programs[f"gsplat {version}"] = _gsplats
        except InputError as error:
            options.progress(f"no rows of gsplat: {error}")
    found = []
    for count in counts:
        for each in channels:
            found += _scene_rows(frustum(count, *size_px), camera(*size_px, device), programs, repeats, each)
            taken = (f"{row['program']} {in_ms(row['ms_total'])} ms" for row in found[-len(programs) :])
            what = "" if each is None else f" of {each} channels"
            options.progress(f"{count} Gaussians{what}: {', '.join(taken)}")
    return found


def _ours(cameras: Cameras, features: Tensor | None = None) -> Draw:
    if features is None:
        return lambda gaussians: render(gaussians, cameras, background=(0.0, 0.0, 0.0)).image
    return lambda gaussians: cast(Tensor, render(gaussians, cameras, features=features).features)


def _gsplats(cameras: Cameras, features: Tensor | None = None) -> Draw:
    peers = load_from_checkout("peers")
    rasterization, matrices = peers.gsplat().rasterization, peers.intrinsic_matrices(cameras)
    view, black = cameras.world_to_camera, torch.zeros(1, 3, device=cameras.world_to_camera.device)
    coloured = {"sh_degree": None, "backgrounds": None} if features is not None else {"backgrounds": black}

    def draw(gaussians: Gaussians) -> Tensor:
        *shapes, sh = gaussians.fields().values()
        options = {**peers.GSPLAT_OPTIONS, "sh_degree": gaussians.sh_degree, **coloured}
        colours, size = sh if features is None else features, (cameras.width_px, cameras.height_px)
        return rasterization(*shapes, colours, view, matrices, *size, **options)[0]

    return draw


def _scene_rows(
    gaussians: Gaussians,
    cameras: Cameras,
    programs: dict[str, Program],
    repeats: int | None,
    channels: int | None = None,
) -> list[dict[str, Any]]:
    """Return the rows of one scene. Every program has its own Gaussians, which keep their gradients."""
    device, cuda = cameras.world_to_camera.device, cameras.world_to_camera.is_cuda
    width, height = cast(int, cameras.width_px), cast(int, cameras.height_px)
    random = np.random.default_rng(1)
    gradient = random.normal(size=(1, height, width, channels or 3)).astype(np.float32)
    weights, steps = torch.from_numpy(gradient).to(device), []
    numbers = None if channels is None else random.random((gaussians.count, channels), np.float32)
    for program in programs.values():
        own = from_tensors(field.to(device, copy=True).requires_grad_() for field in gaussians.fields().values())
        features = None
        if numbers is not None:
            own.sh.requires_grad_(False)
            features = torch.from_numpy(numbers).to(device, copy=True).requires_grad_()
        steps.append(Step(own, program(cameras, features), lambda image: (image * weights).sum(), features))
    peaks = [_peak_bytes(step, cuda) for step in steps]
    first = steps[0].image_and_gradients()
    differences = [{}, *(_differences(first, step.image_and_gradients()) for step in steps[1:])]
    for step in steps:
        step.release()
    del first
    times = timed_by_turns([(step.forward, step.backward) for step in steps], cuda, repeats)
    in_a_row = [ms_in_a_row(step.both, cuda, RUNS_IN_A_ROW[device.type]) for step in steps]
    what = {"device": device.type, "gaussians": gaussians.count, "sh_degree": gaussians.sh_degree}
    what |= {"width_px": width, "height_px": height, "channels": channels}
    if cuda:
        what["card"] = torch.cuda.get_device_name()
    return [
        {**what, "program": program, **_medians(taken), "ms_in_a_row": ms, "peak_bytes": peak, "differences": other}
        for program, taken, ms, peak, other in zip(programs, times, in_a_row, peaks, differences)
    ]


def _medians(times: list[tuple[float, ...]]) -> dict[str, float]:
    """Return the medians of a program's runs: forward, backward and both."""
    forward, backward, both = map(statistics.median, (*zip(*times), map(sum, times)))
    return {"ms_forward": forward, "ms_backward": backward, "ms_total": both, "runs": len(times)}


def _peak_bytes(step: Step, cuda: bool) -> int | None:
    """Return the peak bytes of a step on the device, beyond the Gaussians and their gradients."""
    step.both()
    if not cuda:
        return None
    step.both()  # caches are filled
    step.release()
    gc.collect()
    torch.cuda.synchronize()
    before = torch.cuda.memory_allocated()
    torch.cuda.reset_peak_memory_stats()
    step.both()
    torch.cuda.synchronize()
    return torch.cuda.max_memory_allocated() - before


def _differences(ours: dict[str, Tensor], theirs: dict[str, Tensor]) -> dict[str, float]:
    """Return the relative norms of the differences from ours, of image and gradients.

    Return also the largest difference of the image.
    """
    found = {name: float((ours[name] - theirs[name]).norm() / ours[name].norm()) for name in ours}
    return {**found, "image_largest": float((ours["image"] - theirs["image"]).abs().max())}


def table(found: list[dict[str, Any]]) -> str:
    """Return the rows as text, one a line, and a comparison of ours with the other program."""
    head = (
        "Gaussians",
        "channels",
        "program",
        "forward ms",
        "backward ms",
        "both ms",
        "in a row ms",
        "peak MB",
        "image",
        "gradients",
    )
    lines = [
        (
            str(row["gaussians"]),
            or_dash(row["channels"], "d"),
            row["program"],
            *(in_ms(row[f"ms_{part}"]) for part in ("forward", "backward", "total", "in_a_row")),
            megabytes(row["peak_bytes"]),
            or_dash(row["differences"].get("image"), ".1e"),
            or_dash(max((d for name, d in row["differences"].items() if "image" not in name), default=None), ".1e"),
        )
        for row in found
    ]
    first = found[0]
    title = f"{first['width_px']} x {first['height_px']} px, SH {first['sh_degree']}, {first.get('card', 'CPU')}"
    return "\n".join([title, *aligned([head, *lines]), *_comparisons(found)])


def _comparisons(found: list[dict[str, Any]]) -> list[str]:
    lines, ours = [], found[0]
    for row in found:
        if row["program"] == OURS:
            ours = row
            continue
        both, backward = (row[key] / ours[key] for key in ("ms_total", "ms_backward"))
        channels = "" if row["channels"] is None else f" of {row['channels']} channels"
        memory = (
            "" if not row["peak_bytes"] else f", with {ours['peak_bytes'] / row['peak_bytes']:.2f} times its memory"
        )
        lines.append(
            f"{row['gaussians']} Gaussians{channels}: ours is {both:.2f} times as fast as {row['program']}, backward "
            f"{backward:.2f} times{memory}"
        )
    return lines


@dataclass(frozen=True, kw_only=True)
class Options(options.BenchmarkOptions):
    """The options of the benchmark.

    Attributes:
        gaussians: numbers of Gaussians. None: those of COUNTS.
        size: width and height of the image, px. None: that of SIZES_PX.
        features: numbers of channels that are drawn in place of colours. None: colours.
    """

    gaussians: tuple[int, ...] | None = None
    size: tuple[int, int] | None = None
    features: tuple[int, ...] | None = None


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the benchmark."""
    parser.add_argument(
        "--gaussians",
        type=whole_numbers(1, 100_000_000),
        metavar="N",
        help=f"number of Gaussians, several with commas (default: {_listed(COUNTS['cuda'])}, on the CPU "
        f"{_listed(COUNTS['cpu'])})",
    )
    parser.add_argument(
        "--size",
        type=whole_numbers(16, 16_384, "x", 2),
        metavar="WxH",
        help=f"size of the image, px (default: {_listed(SIZES_PX['cuda'], 'x')}, on the CPU "
        f"{_listed(SIZES_PX['cpu'], 'x')})",
    )
    parser.add_argument(
        "--features",
        type=whole_numbers(1, 4096),
        metavar="D",
        help="channels of features in place of colours, several with commas: 3,16,32,64",
    )
    options.add_repeats(parser)
    options.add_machine(parser)


def run(given: Options) -> tuple[dict[str, Any], str]:
    """Return the rows of every number of Gaussians, also of gsplat if it is installed, on CUDA; and their text."""
    torch.set_num_threads(given.thread_count or torch.get_num_threads())
    counts, size = given.gaussians or COUNTS[given.device], given.size or SIZES_PX[given.device]
    found = rows(counts, size, given.device, given.repeats, given.features or (None,))
    return {"rows": found}, table(found)


def _listed(values: tuple[int, ...], separator: str = ",") -> str:
    return separator.join(map(str, values))
