"""Options of `lightfield-gs fit`."""

from __future__ import annotations

import argparse
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

from lightfield_gs.base.errors import InputError
from lightfield_gs.base.options import (
    DENSITIES,
    DEVICES,
    LOSSES,
    MASKS,
    MOMENTS_ON,
    PHOTOS_ON,
    POSE_MODEL,
    POSED_FRAMES,
    Density,
    Device,
    LossName,
    Masks,
    MomentsOn,
    PhotosOn,
    TestEvery,
)
from lightfield_gs.commands.options import groups
from lightfield_gs.commands.options.groups import Add, in_group
from lightfield_gs.commands.options.parser import background, whole, within

_MOST = 10_000_000
# Names of options, and of their settings
_SETTINGS = {"gaussians": "cap_max", "absolute_gradients": "absgrad", "views_per_step": "batch_size"}
# Options that depend on --quick: usual values, and those of a first look by device. Those of a CPU were chosen on the
# banana of the package (14 photographs), for a minute on two cores; their quality was reported on no other capture
_USUAL: dict[str, Any] = {"longest_px": None, "steps": None, "gaussians": 300_000, "sh_degree": 3, "init_scale": 0.3}
_QUICK = {
    "cpu": _USUAL | {"longest_px": 320, "steps": 1500, "gaussians": 15_000, "sh_degree": 2, "init_scale": 0.1},
    "cuda": _USUAL | {"steps": 7000},
}


@dataclass(frozen=True, slots=True)
class CaptureOptions:
    """The photographs of a scene.

    Attributes:
        input: the capture, or with sfm a folder of photographs or a film.
        images: folder of the photographs.
        mask_folder: folder of their masks.
        scale: factor of their width.
        longest_px: their longer side at most.
        test_every: number of photographs of which the middle one is held out.
        test_list: file with the names of the held-out photographs.
        sfm: whether pycolmap finds the cameras.
        frames: of a film, at most, for sfm; None: POSED_FRAMES.
        keep_blurred: whether sfm takes blurred photographs too.
        mask_people: whether sfm leaves people out.
        pose_model: network that poses where sfm fails.
    """

    input: Path
    images: Path | None = None
    mask_folder: Path | None = None
    scale: float | None = None
    longest_px: int | None = None
    test_every: TestEvery = "own"
    test_list: Path | None = None
    sfm: bool = False
    frames: int | None = None
    keep_blurred: bool = False
    mask_people: bool = False
    pose_model: str | None = None


@dataclass(frozen=True, slots=True)
class OptimisationOptions:
    """The settings of a fit, see FitSettings for their meaning."""

    steps: int | None
    gaussians: int | None
    density: Density
    absolute_gradients: bool
    sh_degree: int | None
    init_scale: float | None
    views_per_step: int
    exposure: bool | None
    dropout: float
    poses: bool
    masks: Masks
    background: tuple[float, ...] | None
    antialiased: bool
    seed: int
    loss: LossName

    def arguments(self) -> dict[str, Any]:
        """Return them by the names of `lightfield_gs.fit`."""
        values = {field.name: getattr(self, field.name) for field in fields(self)}
        return {_SETTINGS.get(name, name): value for name, value in values.items()}


@dataclass(frozen=True, slots=True)
class ConeOptions:
    """The panel that a scene is fitted for.

    Attributes:
        cone: the panel, or degrees.
        centre: name of the photograph in the middle of the cone.
        score_cone: angle of the cone for scores, degrees.
        contribution_cut: allowed mean error of the Gaussians that are left out.
    """

    cone: str | None = None
    centre: str | None = None
    score_cone: float | None = None
    contribution_cut: float | None = None

    def arguments(self) -> dict[str, Any]:
        """Return them by the names of `lightfield_gs.fit`."""
        cut = {} if self.contribution_cut is None else {"contribution_cut": self.contribution_cut}
        return {"cone": self.cone, "centre": self.centre, "score_cone": self.score_cone, **cut}

    def check(self) -> None:
        """Raise InputError where cone is neither a panel nor an angle: at once, not after the capture was read."""
        from lightfield_gs.fitting.cone import read_cone

        if self.cone is None:
            return
        try:
            read_cone(self.cone)
        except InputError as error:
            raise InputError(f"--cone: expected a panel, or degrees, 1..179: {error}") from None


@dataclass(frozen=True, slots=True)
class ReportOptions:
    """The folder of a run, and the files that go there; see `lightfield_gs.fit`.

    Attributes:
        run: The folder; None: beside the scene.
    """

    run: Path | None = None
    fresh: bool = False
    checkpoint_every: int | None = None
    evaluate_every: int | None = None
    picture_every: int | None = None
    stop_early: bool = False
    tensorboard: bool = False


@dataclass(frozen=True, slots=True)
class FitOptions:
    """A capture that becomes a scene.

    Attributes:
        output: File of the scene.
        device: Device of the fit.
        photos_on: Place of the decoded photographs.
        moments_on: Place of Adam's moments.
    """

    output: Path
    capture: CaptureOptions
    optimisation: OptimisationOptions
    cone: ConeOptions
    report: ReportOptions
    device: Device = "auto"
    photos_on: PhotosOn = "auto"
    moments_on: MomentsOn = "auto"
    quick: bool = False

    def complete(self, device: str) -> FitOptions:
        """Return the options with values for those that were not given; device: "cpu" or "cuda"."""
        values = _QUICK[device] if self.quick else _USUAL
        capture, optimisation = self.capture, self.optimisation
        if capture.longest_px is None and capture.scale is None:
            capture = replace(capture, longest_px=values["longest_px"])
        own: dict[str, Any] = {
            name: values[name]
            for name in ("steps", "gaussians", "sh_degree", "init_scale")
            if getattr(optimisation, name) is None
        }
        return replace(self, capture=capture, optimisation=replace(optimisation, **own))

    def describe_quick(self) -> str:
        """Return in words what a first look is made of; the options are complete."""
        made, longest = self.optimisation, self.capture.longest_px
        size = "" if longest is None else f", photographs of {longest} pixels at most"
        return (
            f"a first look: {made.steps} steps, {made.gaussians} Gaussians that begin at {made.init_scale:g} of the "
            f"distance to neighbours, harmonics of degree {made.sh_degree}{size} (each has its own option)"
        )


def _every_or_none(text: str) -> TestEvery:
    """Parse "8" to 8, "none" to None, "own" to "own"."""
    if text == "own":
        return "own"
    return None if text == "none" else whole(2, 1 << 30)(text)


def _backdrop(text: str) -> tuple[float, ...] | None:
    """Parse "white" to (1.0, 1.0, 1.0), "random" to None, "0,0.5,1" to (0.0, 0.5, 1.0)."""
    return None if text == "random" else background(text)


def add_capture(add: Add) -> None:
    """Add the options of the capture."""
    add = in_group(add, "photographs")
    add(
        "--images",
        type=Path,
        metavar="FOLDER",
        short="folder of the photographs (default: images)",
        help="folder of photographs, absolute or in CAPTURE (default: images)",
    )
    add(
        "--mask-folder",
        type=Path,
        metavar="FOLDER",
        short="folder of masks, white on what counts",
        help="folder of masks named as the photographs, white on the pixels that count (default: masks)",
    )
    add(
        "--masks",
        choices=MASKS,
        default="ignore",
        help="meaning of black in masks and of transparent pixels in photographs. ignore: anything may be "
        "there; alpha: the scene is transparent there; default ignore",
    )
    add(
        "--scale",
        instead_of="size",
        type=within(1e-3, 1),
        metavar="FRACTION",
        short="0..1: shrink the photographs to this fraction",
        help="0..1, shrink photographs to this fraction of their width (default 1)",
    )
    add(
        "--longest-px",
        instead_of="size",
        type=whole(16, 1 << 20),
        metavar="PIXELS",
        help="shrink photographs whose longer side has more pixels (default: as far as the memory takes them)",
    )
    add(
        "--photos-on",
        choices=PHOTOS_ON,
        default="auto",
        help="place of the decoded photographs during the fit. disk: files in the folder of the run, so that thousands "
        "of photographs need little memory; the next ones are read while a step runs (default auto: memory where they "
        "fill less than half of it)",
    )
    add(
        "--test-every",
        instead_of="test",
        type=_every_or_none,
        default="own",
        metavar="N",
        help="hold out the middle one of every N photographs, in the order of their names, to score the scene; "
        "none: fit to all; own: hold out the capture's own test photographs, else as with 8 (default own)",
    )
    add(
        "--test-list",
        instead_of="test",
        type=Path,
        metavar="FILE",
        help="hold out the photographs that a text file names, one a line",
    )
    add(
        "--sfm",
        action="store_true",
        short="CAPTURE is photographs or a film: find the cameras",
        help="CAPTURE is a folder of photographs, or a film, with unknown cameras. pycolmap finds them first (pip "
        "install 'lightfield-gs[sfm,video]'), and stores them in the folder of the run",
    )
    add(
        "--frames",
        type=whole(3, 10_000),
        metavar="N",
        help=f"with --sfm, frames of a film or a burst at most: the sharpest of each step of parallax (default "
        f"{POSED_FRAMES})",
    )
    add(
        "--keep-blurred",
        action="store_true",
        help="with --sfm, take blurred photographs and frames too (default: they are left out)",
    )
    add(
        "--mask-people",
        action="store_true",
        help="with --sfm, leave people who walk by out of the photographs, by rembg (pip install "
        "'lightfield-gs[photo]')",
    )
    add(
        "--pose-model",
        metavar="NAME",
        help=f"with --sfm, a network that poses photographs where COLMAP poses fewer than half: {POSE_MODEL}, "
        "DA3-SMALL, DA3-LARGE, DA3-GIANT, or a folder of its files (pip install 'lightfield-gs[poses]')",
    )


def add_optimisation(add: Add) -> None:
    """Add the options that become FitSettings."""
    add = in_group(add, "fit")
    add(
        "--quick",
        action="store_true",
        short="a first look: a minute on two cores",
        help=f"a first look, in a minute on two cores: {_QUICK['cpu']['steps']} steps, {_QUICK['cpu']['gaussians']} "
        f"Gaussians, photographs of {_QUICK['cpu']['longest_px']} pixels, harmonics of degree "
        f"{_QUICK['cpu']['sh_degree']}; on a GPU {_QUICK['cuda']['steps']} steps. Their own options set others",
    )
    add(
        "--steps",
        type=whole(1, _MOST),
        metavar="N",
        short="number of steps (default 7000; 30000 of 50 photographs or more)",
        help="number of steps; schedules scale with it (default 7000; 30000 of 50 photographs or more, since fewer are "
        "overfitted by so many)",
    )
    add(
        "--gaussians",
        type=whole(1, 2**31 - 1),
        metavar="N",
        short="number of Gaussians (default 300000)",
        help="number of Gaussians at the end, or at most with --density adaptive (default 300000)",
    )
    add(
        "--density",
        choices=DENSITIES,
        default="mcmc",
        help="density control of the Gaussians. mcmc: they move to where they are needed (Kheradmand et al. "
        "2024); adaptive: they are cloned, split and removed (Kerbl et al. 2023); default mcmc",
    )
    add(
        "--absolute-gradients",
        action="store_true",
        help="use absolute gradients for --density adaptive (Ye et al. 2024)",
    )
    add(
        "--sh-degree",
        type=int,
        choices=range(4),
        help="degree of the spherical harmonics, 0..3: how much colours may change with the viewing direction; "
        "0: not at all (default 3)",
    )
    add(
        "--init-scale",
        type=within(1e-6, 1e6),
        metavar="FACTOR",
        help="size of the first Gaussians in distances to their neighbours (default 0.3; with --quick on a CPU 0.1, "
        "which leaves short fits more texture)",
    )
    add(
        "--views-per-step",
        type=whole(1, 1024),
        default=1,
        metavar="N",
        help="number of photographs in each step (default 1)",
    )
    add(
        "--exposure",
        action=argparse.BooleanOptionalAction,
        short="also fit a change of colours for each photograph",
        help="also fit an affine change of colours for each photograph, for different exposure or white balance "
        "(default: if their exposures differ by 1 %% or more)",
    )
    add(
        "--loss",
        choices=LOSSES,
        default="l1-ssim",
        short="wd: by texture, as VGG-16 sees it; for long fits on a GPU",
        help="comparison of renders with photographs. l1-ssim: pixel by pixel (Kerbl et al. 2023); wd: by the texture "
        "that the network VGG-16 sees, too, in the second half of the steps (WD-R, Ozyilkan et al. 2026), for fits on "
        "a GPU. Its weights are fetched once, 528 MB (default l1-ssim)",
    )
    add(
        "--dropout",
        type=within(0.0, 0.9),
        default=0.0,
        metavar="FRACTION",
        short="0.1 may help with a dozen photographs or fewer",
        help="each step leaves out a random fraction of the Gaussians, which grows from 0 to this value after 70 %% of "
        "the steps, and falls to 0 again; 0..0.9. With few photographs it removes stray Gaussians before the views "
        "between them; 0.1 gained up to 0.4 dB or lost up to 0.1, by the scene (default 0: none)",
    )
    add(
        "--poses",
        action="store_true",
        short="also refine the cameras",
        help="also refine the cameras' poses, if they are off by some pixels",
    )
    add(
        "--background",
        type=_backdrop,
        default=(0.0, 0.0, 0.0),
        metavar="COLOUR",
        short="R,G,B in 0..1, or a name (default black)",
        help="background of the scene in the fit, and later in encode: R,G,B in 0..1, a name, #rrggbb, or random, "
        "another colour at each step (default black)",
    )
    add(
        "--antialiased",
        action="store_true",
        help="fit for drawing with anti-aliasing; encode and prune then draw the scene with it",
    )
    add(
        "--seed",
        type=whole(0, 2**63 - 1),
        default=0,
        metavar="N",
        help="seed of the random numbers, 0 or more (default 0)",
    )
    add(
        "--device",
        choices=DEVICES,
        default="auto",
        short="cpu or cuda (default auto: a GPU where there is one)",
        help="device of the fit (default auto: cuda if there is a GPU and this build can use it)",
    )
    add(
        "--moments-on",
        choices=MOMENTS_ON,
        default="auto",
        help="place of Adam's moments in a fit on a GPU. host: the memory of the computer, which leaves the GPU room "
        "for more Gaussians; steps take longer (default auto: device where its memory suffices)",
    )


def add_run(add: Add) -> None:
    """Add the options of the run's folder."""
    add = in_group(add, "files of the run")
    add(
        "--run",
        type=Path,
        metavar="FOLDER",
        help="folder of checkpoints, scores and pictures (default: beside the output, scene.fit for scene.ply); "
        "a stopped fit goes on from there",
    )
    add(
        "--fresh",
        action="store_true",
        short="start over, do not go on from where a fit stopped",
        help="start over, and remove the checkpoint in the folder of the run",
    )
    for name, words in (
        ("checkpoint", "checkpoints (default: they take 2 %% of the time)"),
        ("evaluate", "scores of the held-out photographs (default: a tenth of --steps)"),
        ("picture", "pictures of a view beside its photograph, held out if possible (default: one at the end)"),
    ):
        add(f"--{name}-every", type=whole(1, _MOST), metavar="N", help=f"steps between {words}")
    add(
        "--stop-early",
        action="store_true",
        short="end when it gets no better",
        help="end once the held-out PSNR has not improved over the last 3 evaluations",
    )
    add("--tensorboard", action="store_true", help="write scalars for TensorBoard in the folder of the run")


def add_cone(add: Add) -> None:
    """Add the options of the panel that a scene is fitted for, and of the cone that it is scored in."""
    add = in_group(add, groups.DISPLAY)
    add(
        "--cone",
        metavar="PANEL|DEG",
        short="the display that it is for: 27, visual.json, ...",
        help="fit for the views of a panel, by its name, .yaml or .json, or for the default panel with a cone "
        "of this full angle, 1..179. Photographs in the cone count fully, others less. Gaussians that no "
        "view of the panel sees are left out. The rig is written beside the scene, scene.rig.yaml for "
        "scene.ply (default: all photographs count alike)",
    )
    add(
        "--centre",
        metavar="NAME",
        help="name of the centre camera's photograph, in the middle of the cone (default: the photograph with "
        "the most others near)",
    )
    add(
        "--score-cone",
        type=within(1, 179, "degrees"),
        metavar="DEG",
        help="score held-out photographs by their angle in a cone of this full angle, also without --cone. So a "
        "fit for a cone is compared with a fit for all photographs (default: the cone of --cone)",
    )
    add(
        "--contribution-cut",
        type=within(0, 1),
        metavar="FRACTION",
        help="0..1, allowed mean error on the panel, of colours in 0..1, for the Gaussians that --cone leaves "
        "out (default 1e-4)",
    )


def read_names(path: Path) -> list[str]:
    """Read names of photographs from a text file, one a line; skip empty lines and comments. Raises InputError."""
    from lightfield_gs.io.text_files import read_text

    lines = [line.strip() for line in read_text(path, 1 << 24, "a list of photographs").splitlines()]
    names = [line for line in lines if line and not line.startswith("#")]
    if not names:
        raise InputError(f"{path}: expected names of photographs, one a line, got none")
    return names
