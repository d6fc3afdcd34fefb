"""python draw.py MODULE OUT: the cases, drawn by the CUDA stages in a native module of build.py.

It reads the names of cases, one a line, and answers each with the exit code of the process that drew it. Every case has
a process of its own, forked after all imports, because some cases change what others need. OUT/NAME.pt, by torch.save,
is a list with the image and the counters of every frame of cases.py, or the numbers of images, gradients and norms.
OUT/NAME.log is the output of the process.
"""

from __future__ import annotations

import os
import sys
import traceback
from dataclasses import replace
from pathlib import Path

import emulation  # before all that loads the native module

sys.path.append(str(Path(__file__).parents[1]))  # rasterizer_cases

import cases
import crop_cases
import feature_cases
import fit_cases
import intersection_cases
import png_cases
import sheet_cases
import surface_cases
import torch

import lightfield_gs
from lightfield_gs.base.options import DEFAULT_PANEL
from lightfield_gs.models import unet
from lightfield_gs.panels.panel import Panel
from lightfield_gs.panels.rig import lenticular_camera
from lightfield_gs.rasterizer import frame_cuda
from lightfield_gs.rasterizer.direct import DirectRender
from lightfield_gs.rasterizer.quality import EXACT, Quality


def frame(kernel: str, name: str, degree: int, views: str, dtype: torch.dtype = torch.float32) -> dict[str, object]:
    """Continuous views: with a capacity for half of the intersections."""
    panel, capacity = cases.panel_of(name), 0.5 if views == "continuous" else 1.01
    return drawn(cases.scene_of(degree), panel, cases.rig_of(panel), views, kernel, EXACT, capacity, dtype)


def lattice_frame(
    kernel: str,
    quality: str,
    views: str,
    changes: dict,
    degree: int,
    capacity: float = 1.0,
    dtype: torch.dtype = torch.float32,
) -> dict[str, object]:
    return drawn(*cases.lattice_frame(changes, degree), views, kernel, Quality.of(quality), capacity, dtype)


def drawn(
    scene,
    panel,
    rig,
    views,
    kernel,
    quality,
    capacity,
    dtype=torch.float32,
    colour_order=8,
    antialiased=False,
    view_filter=0.0,
) -> dict[str, object]:
    """Draw a frame. kernel: None, if the frame chooses. capacity: for intersections, as a fraction of their number."""
    job = DirectRender(
        scene.fields().values(),
        torch.tensor(cases.BACKGROUND),
        lenticular_camera(panel, rig, views == "continuous", view_filter),
        antialiased,
    )

    def with_capacity(intersections: int) -> frame_cuda.DirectFrame:
        order = colour_order if job.scene.degree else 0
        return frame_cuda.DirectFrame(job, quality, order, intersections, kernel)

    probe = with_capacity(0)
    probe.project(), probe.bin()
    image = torch.full((job.height, job.width, 3), 7, dtype=dtype)
    frame = with_capacity(int(capacity * probe.state()["intersections"]))
    frame.draw(job.background, image)
    return {"image": image, "layout": frame.native.lens_column_layout, **frame.state()}


def compact() -> list[dict[str, object]]:
    """On a device of small shared memory: frames as floats and as bytes, an anti-aliased one, the piece of a cloud."""
    os.environ[frame_cuda.SHARED_MEMORY_LIMIT] = str(cases.SMALL_SHARED_MEMORY)
    dtypes = torch.float32, torch.uint8
    frames = [frame("lens-column", *case, dtype) for case in cases.COMPACT_FRAMES for dtype in dtypes]
    antialiased = compensated(*cases.COMPACT_ANTIALIASED, antialiased=True)
    return [*frames, antialiased, harmonic_piece()]


def harmonic_piece() -> dict[str, object]:
    return drawn(*cases.harmonic_piece(), "integer", "lens-column", EXACT, 1.0, colour_order=8)


def work_bytes(gaussians: int, degree: int, order: int, intersections: int) -> int:
    """Return the bytes of a frame's work buffer for the default 8K panel."""
    panel = Panel.load(DEFAULT_PANEL)
    job = DirectRender(
        cases.scene_of(degree).fields().values(),
        torch.tensor(cases.BACKGROUND),
        lenticular_camera(panel, cases.rig_of(panel), False),
    )
    frame = lightfield_gs._core.cuda.DirectFrame(
        gaussians=gaussians, sh_degree=degree, colour_order=order, rig=job.native.rig, lens=job.native.lens,
        capacity=intersections, quality=EXACT.native, colour_error=1e-5, left_out=1e-5, shared_memory=0,
    )  # fmt: skip
    return frame.bytes()


def chosen(scene, panel, rig) -> str:
    """The kernel that a frame chooses; it is not drawn."""
    job = DirectRender(scene.fields().values(), torch.tensor(cases.BACKGROUND), lenticular_camera(panel, rig, False))
    frame = frame_cuda.DirectFrame(job, EXACT, 0, 0)
    frame.project()
    return frame.state()["kernel"]


def settings(kernel: str) -> list[dict[str, object]]:
    """A frame with harmonics: as it is, with more places, as bytes, with polynomials of another order."""
    panel, scene = cases.panel_of("default"), cases.scene_of(3)
    options = (1.0, torch.float32, 8), (2.0, torch.float32, 8), (1.0, torch.uint8, 8), (1.0, torch.float32, 4)
    return [drawn(scene, panel, cases.rig_of(panel), "integer", kernel, EXACT, *option) for option in options]


def parabolas(kernel: str, cone_deg: float) -> list[dict[str, object]]:
    """A frame of which colours are parabolas over a small rig, and with polynomials of a higher order."""
    panel = replace(cases.panel_of("default"), cone_deg=cone_deg)
    return [
        drawn(cases.scene_of(3), panel, cases.rig_of(panel), "integer", kernel, EXACT, 1.0, colour_order=order)
        for order in (2, 8)
    ]


def recoloured(kernel: str, quality: str, views: str, changes: dict, capacity: float) -> dict[str, object]:
    """An image with other harmonics than in binning, and the image of a frame that has them from the start."""
    scene, panel, rig = cases.lattice_frame(changes, 1)
    expected = drawn(scene, panel, rig, views, kernel, Quality.of(quality), capacity)
    right = scene.sh.clone()
    scene.sh.neg_()
    job = DirectRender(
        scene.fields().values(), torch.tensor(cases.BACKGROUND), lenticular_camera(panel, rig, views == "continuous")
    )
    frame = frame_cuda.DirectFrame(job, Quality.of(quality), 8, int(capacity * expected["intersections"]), kernel)
    image = torch.full((job.height, job.width, 3), 7.0)
    frame.draw(job.background, image)
    scene.sh.copy_(right)
    frame.draw(job.background, image, keep_lists=True)
    found = {"image": image, "layout": frame.native.lens_column_layout, **frame.state()}
    return {"expected": expected, "found": found}


def in_chunks() -> list[dict[str, object]]:
    """Images by `sorted` without a budget, and with parts of the memory of all views at once, over memory with junk."""
    empty, images = torch.empty, []
    torch.empty = lambda *shape, **options: empty(*shape, **options).fill_(77)
    whole = None
    for parts in (None, 1, 3, 9):
        image, memory = cases.sorted_frame(None if parts is None else whole // parts)
        whole = whole or memory["memory_bytes_unchunked"]
        images.append({"image": image, **memory})
    return images


def compensated(
    kernel: str | None, name: str, degree: int, views: str, quality: str, **options: object
) -> dict[str, object]:
    """With a capacity for half of the intersections, if views are continuous."""
    panel, continuous = cases.panel_of(name), views == "continuous"
    kept = replace(Quality.of(quality), lattice_error=0.0, evaluation_error=0.0)  # as DirectFrames does
    return drawn(
        cases.fine(degree), panel, cases.rig_of(panel), views, kernel, kept, 0.5 if continuous else 1.0, **options
    )


def main(what: str) -> object:
    emulation.use_cuda_stages()
    if what == "half":
        return [
            drawn(*cases.half_frame(changes, degree, brightness), views, kernel, cases.HALF_QUALITY, 1.0)
            for kernel, changes, degree, views, brightness in cases.HALF_FRAMES
        ]
    if what == "fit":
        return fit_cases.fitted(torch.float32)
    if what == "capacities":
        return intersection_cases.with_capacities()
    if what == "images":
        return cases.images_step(torch.float32)
    if what == "features":
        return feature_cases.steps(torch.float32)
    if what == "words":
        return [
            lattice_frame("pixel", "fast", "integer", changes, 0, dtype=dtype)
            for changes in cases.WORDS
            for dtype in (torch.float32, torch.uint8)
        ]
    if what == "lattice":
        found = [lattice_frame(*case, degree=0) for case in cases.LATTICE_FRAMES]
        first = cases.LATTICE_FRAMES[0]
        return [
            *found,
            lattice_frame(*first, degree=1),
            lattice_frame(*first, degree=0, capacity=0.5),
            lattice_frame(*first, degree=0, dtype=torch.uint8),
            *(
                drawn(*scene, "integer", "pixel", cases.WIDE_QUALITY, 1.0)
                for scene in (cases.speckled(), cases.wide_rig())
            ),
        ]
    if what == "harmonics":
        return harmonic_piece()
    if what == "memory":
        return [work_bytes(*case) for case in cases.WORK_BUFFERS]
    if what == "compact":
        return compact()
    if what == "opaque":
        return [drawn(*cases.opaque(name), "integer", kernel, EXACT, 1.0) for kernel, name in cases.OPAQUE_FRAMES]
    if what == "half empty":
        return [
            drawn(*cases.half_empty(changes), views, kernel, Quality.of(quality), 1.0, dtype)
            for kernel, quality, views, changes in cases.LATTICE_FRAMES
            for dtype in (torch.float32, torch.uint8)
        ]
    if what == "gradients":
        return [cases.gradients(scene(), sensor, torch.float32) for scene, sensor in cases.HARD_GRADIENTS]
    if what == "optics":
        return [cases.optics_gradients(*case, torch.float32) for case in cases.OPTICS]
    if what == "antialiased":
        return [compensated(*case, antialiased=True) for case in cases.ANTIALIASED]
    if what == "view filter":
        found = [compensated(*case, view_filter=cases.VIEW_FILTER) for case in cases.FILTERED]
        return [*found, cases.gradients(cases.fine(1), "direct", torch.float32, view_filter=cases.VIEW_FILTER)]
    if what == "antialiased gradients":
        return [
            cases.gradients(scene, sensor, torch.float32, antialiased=True)
            for scene in (cases.fine(1), cases.beams())
            for sensor in ("direct", "images")
        ]
    if what == "camera models":
        return [
            cases.gradients(cases.fine(1), model, torch.float32, antialiased)
            for model in cases.CURVED
            for antialiased in (False, True)
        ]
    if what == "chosen":
        return [chosen(*case) for case in cases.wide_frames()]
    if what == "widest":
        return [drawn(*cases.widest(changes), views, kernel, EXACT, 1.0) for kernel, views, changes in cases.WIDEST]
    if what == "crowd":
        return [drawn(*cases.crowd(), "integer", "pixel-quadratic", EXACT, capacity) for capacity in (1.0, 0.5)]
    if what == "pruned":
        panel = cases.panel_of("default")
        return drawn(cases.scene_of(3), panel, cases.rig_of(panel), "integer", "pixel-quadratic", cases.PRUNING, 1.0)
    if what == "recoloured":
        return [recoloured(*case, capacity) for case, capacity in zip(cases.LATTICE_FRAMES[1:], (1.0, 0.5, 1.0))]
    if what == "sorted":
        return in_chunks()
    if what == "norms":
        unet._is_ours = lambda *arguments: True
        return [unet.group_norm_silu(*cases.norm_case(*case)) for case in cases.NORMS]
    if what == "sheet":
        return [sheet_cases.laid(case) for case in sheet_cases.CASES]
    if what == "surface":
        return [surface_cases.found(case) for case in surface_cases.CASES]
    if what == "crops":
        return [[crop_cases.cropped(case) for case in crop_cases.CASES], crop_cases.refused()]
    if what == "png":
        return {name: png_cases.compressed(name) for name in png_cases.IMAGES}
    if what == "settings":
        return [settings(kernel) for kernel in ("pixel-quadratic", "lens-column")]
    if what == "near":
        return [drawn(*cases.near(nearest), "integer", None, EXACT, 1.01) for nearest in cases.NEAR]
    if what == "parabolas":
        return [parabolas(*case) for case in cases.PARABOLAS]
    if what == "shapes":
        return [drawn(*case(), "integer", kernel, EXACT, 1.0) for kernel, case in cases.SHAPES_THAT_VARY]
    return [frame(what, *case) for case in cases.frames_of(what)]


def apart(what: str, out: Path) -> int:
    """Draws in a process of its own. Returns its exit code."""
    process = os.fork()
    if process:
        return os.waitstatus_to_exitcode(os.waitpid(process, 0)[1])
    code = 1
    try:
        with (out / f"{what}.log").open("w") as log:
            os.dup2(log.fileno(), 1), os.dup2(log.fileno(), 2)
        torch.save(main(what), out / f"{what}.pt")
        code = 0
    except BaseException:
        traceback.print_exc()
        sys.stderr.flush()
    os._exit(code)


if __name__ == "__main__":
    for line in sys.stdin:
        print(apart(line.strip(), Path(sys.argv[2])), flush=True)
