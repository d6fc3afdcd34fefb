"""A fit from a capture to a scene: its preparation, its run and its result."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass, fields, replace
from functools import partial
from pathlib import Path
from tempfile import gettempdir
from typing import Any

import numpy as np
import torch

from lightfield_gs.base.assumptions import assume
from lightfield_gs.base.checks import counted, expect, is_row, real_number, shown
from lightfield_gs.base.device import choose_device
from lightfield_gs.base.errors import InputError
from lightfield_gs.base.options import (
    DEVICES,
    LOSSES,
    MOMENTS_ON,
    PHOTOS_ON,
    Device,
    LossName,
    MomentsOn,
    PhotosOn,
    TestEvery,
)
from lightfield_gs.base.suggestions import nearest
from lightfield_gs.base.torchrun import is_first
from lightfield_gs.fitting import checkpoint
from lightfield_gs.fitting.checkpoint import Identity, loss_name
from lightfield_gs.fitting.cone import Display, place_display
from lightfield_gs.fitting.distributed import Group, join_group
from lightfield_gs.fitting.evaluate import ConeAngles, Scores
from lightfield_gs.fitting.exposure_spread import asks_for_exposures, exposure_spread
from lightfield_gs.fitting.initialization import initialize_gaussians
from lightfield_gs.fitting.memory import MemoryEstimate, estimate_memory, smaller_sizes
from lightfield_gs.fitting.optimizer import GaussianState
from lightfield_gs.fitting.panel_pruning import CONTRIBUTION_CUT, PanelPruning, WindowScores, prune_run
from lightfield_gs.fitting.photo_loss import Loss
from lightfield_gs.fitting.placement import Placement, Room
from lightfield_gs.fitting.posed_images import Normalization, PosedImages
from lightfield_gs.fitting.progress import Progress
from lightfield_gs.fitting.run import FitState, Run, RunOptions
from lightfield_gs.fitting.settings import RECIPE_STEPS, Density, FitSettings, Masks
from lightfield_gs.fitting.trainer import Trainer
from lightfield_gs.fitting.vgg16 import fetch_weights
from lightfield_gs.io.atomic import checked_path, make_folder, remove_left_over, scratch_folder
from lightfield_gs.io.captures.capture import SMALLEST_PX, Capture, read_capture
from lightfield_gs.io.captures.photo_files import first_names
from lightfield_gs.io.scenes.comments import ANTIALIASED, fit_comment
from lightfield_gs.io.scenes.plausibility import float32_step, typical_size
from lightfield_gs.panels.panel import Panel
from lightfield_gs.panels.stored_rigs import needs_rig_beside, write_rig_beside
from lightfield_gs.scene.gaussians import Gaussians
from lightfield_gs.show.notebook import NotebookPicture

_ORIGIN_STEP = 1e-3  # the largest rounding to float32 of a position, as a fraction of the usual Gaussian's size
_FEW_PHOTOGRAPHS = 12  # up to which dropout gained most in the measurements, and a fit mentions it
MANY_PHOTOGRAPHS, _STEPS_OF_FEW = 50, 7000  # fewer photographs take fewer steps than recipes, see _usual_steps


@dataclass(frozen=True)
class FitResult:
    """The result of a fit.

    Attributes:
        gaussians: the scene in the capture's coordinates, float32 on the CPU.
        settings: the settings of the fit.
        steps: number of steps done, fewer than settings.steps if the fit was stopped.
        scores: scores of the held-out photographs; None if there are none.
        history: all evaluations: step, psnr_db, ssim, gaussians.
        stopped: whether `stop` ended the fit.
        display: the panel that the scene is fitted for.
        front: the photograph that most others are near, from which a scene for no panel opens; None where the capture
            has no middle.
        angles: scores of the held-out photographs by angle, if asked for.
        pruning: the result of pruning for the panel; None without a display, or if the fit was stopped.
        window_scores: scores of the pixels of held-out photographs that the display can show, before and after pruning.
    """

    gaussians: Gaussians
    settings: FitSettings
    steps: int
    scores: Scores | None
    history: list[dict[str, Any]]
    stopped: bool
    display: Display | None = None
    angles: ConeAngles | None = None
    pruning: PanelPruning | None = None
    window_scores: WindowScores | None = None
    front: Display | None = None

    def _repr_html_(self) -> str:
        """Return the picture that a notebook shows."""
        return self._picture(1)._repr_html_()

    def show(self) -> NotebookPicture:
        """Return what the panel of the fit shows, as a picture that follows the pointer in a notebook.

        Without a panel it is what one of the photographs' shape shows before `front`, or the scene from all around.
        """
        return self._picture(NotebookPicture.FRAMES)

    def _picture(self, frames: int) -> NotebookPicture:
        """Return pictures of the scene, and what the fit says of itself."""
        if (shown := self.display or self.front) is None:
            drawn = NotebookPicture.of_gaussians(self.gaussians, frames)
        else:
            rig = shown.rig.relative_to(self.gaussians.origin)
            colour = self.settings.background or (1.0, 1.0, 1.0)
            drawn = NotebookPicture.of_views(
                self.gaussians,
                shown.panel,
                rig,
                frames,
                background=colour,
                antialiased=self.settings.antialiased,
                name=None if self.display is not None else f"views round photograph {shown.cone.name}",
            )
        facts = f"fit of {self.steps} steps{', stopped' if self.stopped else ''}"
        if self.scores is not None:
            held_out = counted(len(self.scores.names), "held-out photograph")
            facts += f", {self.scores.mean_psnr_db:.2f} dB and SSIM {self.scores.mean_ssim:.3f} on {held_out}"
        return replace(drawn, facts=f"{facts}; {drawn.facts}")

    def save(self, path: str | Path, comments: Sequence[str] = ()) -> None:
        """Write the scene as .ply, .glb, .usd, .spz or .splat, see Gaussians.save.

        The header of a .ply holds the settings and the framing. The rig and the background are beside the scene of a
        display, and beside other formats: scene.rig.yaml for scene.spz.

        Args:
            path: where to.
            comments: further lines of the header.
        """
        if (shown := self.display or self.front) is not None:
            comments = [*comments, *shown.comments()]
            if self.display is not None or needs_rig_beside(Path(path)):
                own = self.settings.background, self.settings.antialiased
                write_rig_beside(Path(path), shown.rig, shown.panel, *own)
        settings = {**asdict(self.settings), "steps_done": self.steps}
        trained = [ANTIALIASED] if self.settings.antialiased else []
        self.gaussians.save(path, [fit_comment(settings), *trained, *comments])


def fit(
    capture: str | Path | Capture,
    *,
    steps: int | None = None,
    cap_max: int = 300_000,
    density: Density = "mcmc",
    exposure: bool | None = None,
    test_every: TestEvery = "own",
    test_names: Sequence[str] | None = None,
    cone: Panel | str | Path | float | None = None,
    centre: str | None = None,
    score_cone: float | None = None,
    contribution_cut: float = CONTRIBUTION_CUT,
    device: Device = "auto",
    photos_on: PhotosOn = "auto",
    moments_on: MomentsOn = "auto",
    folder: str | Path | None = None,
    fresh: bool = False,
    checkpoint_every: int | None = None,
    evaluate_every: int | None = None,
    picture_every: int | None = None,
    stop_early: bool = False,
    tensorboard: bool = False,
    progress: bool = True,
    stop: Callable[[], bool] = lambda: False,
    callback: Callable[[FitState], None] | None = None,
    callback_every: int | None = None,
    loss: LossName | Loss = "l1-ssim",
    **settings: Any,
) -> FitResult:
    """Fit Gaussians to posed photographs of a static scene (Kerbl et al. 2023).

    The same capture, settings and device give the same bits. Under torchrun every process must make the same call. The
    processes split the photographs of a step (batch_size), one GPU each. The first process writes and prints; all
    return the result.

    Args:
        capture: a folder (COLMAP's sparse/0 or a transforms.json, and the photographs), or a result of read_capture.
        steps: number of steps. None: 30,000, or 7,000 where fewer than 50 photographs are fitted, see _usual_steps.
        cap_max: number of Gaussians at the end, or at most with "adaptive" density.
        density: "mcmc" or "adaptive".
        exposure: fit an affine change of colours for each photograph. None: if their exposures differ, see
            exposure_spread.
        test_every: k holds out the middle one of every k photographs for scores; None holds out none. "own" holds out
            the capture's own test photographs, or one of every 8.
        test_names: the photographs to hold out instead.
        cone: a panel, its name or file, or the angle of the default panel's cone in degrees, 1..179. The fit is then
            for the views of this panel, see Display, and prunes Gaussians that it does not show.
        centre: name of the photograph in the middle of the cone; None: the most central one.
        score_cone: full angle in degrees of the cone in which held-out photographs are scored by angle; None: the angle
            of `cone`.
        contribution_cut: 0..1, of pruning for the panel, see prune_for_panel.
        device: "auto", "cpu" or "cuda".
        photos_on: "memory" or "disk", where the decoded photographs are during the fit: on disk in files beside
            `folder`, and the next ones are read ahead. "auto" takes memory as long as they fill less than half of it.
        moments_on: "device" or "host", where Adam's moments are: in the host's memory they leave a GPU room for more
            Gaussians, and steps take longer. "auto" takes the device as long as it has the memory.
        folder: for checkpoints, scores.json and pictures. A stopped fit goes on from there, to the same bits.
        fresh: start over. For this and the following arguments see RunOptions.
        checkpoint_every: steps between checkpoints.
        evaluate_every: steps between evaluations.
        picture_every: steps between pictures.
        stop_early: end once evaluations are no better.
        tensorboard: write scalars for TensorBoard.
        progress: print lines and a bar.
        stop: function called between steps; True ends the fit.
        callback: function called with a FitState (step, loss, gaussians, scores) now and then, and after the last step.
        callback_every: steps between its calls; None: those between evaluations.
        loss: "l1-ssim", "wd" (WD-R, which asks for the photographs' texture, see wasserstein.py), or a function of
            renders [V,H,W,3], photographs [V,H,W,3] in 0..1, and weights [V,H,W] of their pixels or None. The function
            returns one number, the sum over V, by torch's operations. A fit that goes on needs the same loss, or a
            function of the same name.
        settings: further fields of FitSettings.

    Raises:
        InputError: there is no capture, a setting is outside its range, or the folder belongs to another fit; the loss
            "wd" lacks the weights of VGG-16, and cannot fetch them.
    """
    own_loss = None if isinstance(loss, str) else loss
    if own_loss is not None and not callable(own_loss):
        raise InputError(
            f"loss: expected {', '.join(LOSSES)}, or a function of renders, photographs and weights, got {shown(loss)}"
        )
    named_loss = {"loss": loss} if own_loss is None else {}
    named = {
        "steps": RECIPE_STEPS if steps is None else steps,
        "cap_max": cap_max,
        "density": density,
        **named_loss,
        **settings,
    }
    chosen = make_settings(exposure=False if exposure is None else exposure, **named)
    where = None if folder is None else checked_path(folder)
    options = RunOptions(
        where,
        fresh,
        checkpoint_every,
        evaluate_every,
        picture_every,
        stop_early,
        tensorboard,
        progress,
        stop,
        callback,
        callback_every,
    )
    for name, word, words in (
        ("device", device, DEVICES),
        ("photos_on", photos_on, PHOTOS_ON),
        ("moments_on", moments_on, MOMENTS_ON),
    ):
        if word not in words:
            raise InputError(f"{name}: expected {', '.join(words)}, got {shown(word)}")
    if chosen.loss == "wd":
        fetch_weights(Progress(progress and is_first()).say)
    read, train, test = _read_photographs(capture, test_every, test_names)
    cut = real_number("contribution_cut", contribution_cut, 0.0, 1.0)
    files = Path(gettempdir()) / "lightfield-gs" if where is None else where / "photographs"
    with ExitStack() as opened:
        group, own = opened.enter_context(join_group(choose_device(device)))
        room = Room.find(own, files, group.size)

        def place(one: Capture) -> Placement:
            return Placement.choose(_estimate(one, chosen, own), room, photos_on, moments_on)

        read = read if group.size > 1 else _fit_memory(read, place, options)
        placement = place(read)
        for line in placement.assumptions(photos_on, moments_on):
            assume(line)
        run, normalization, display = _prepare(
            read,
            train,
            test,
            chosen,
            (steps, exposure),
            options,
            placement,
            group,
            (cone, centre, score_cone),
            opened,
            own_loss,
        )
        run.go()
        trainer, pruning, window_scores = run.trainer, None, None
        scene = trainer.state.gaussians().detach()
        if display is not None and not run.stopped:
            scene, pruning, window_scores = prune_run(run, normalization, display, cut)
        scene = _remove_origin(normalization.restore(scene.to("cpu")))
    return FitResult(
        scene,
        trainer.settings,
        trainer.done,
        run.scores,
        run.history,
        run.stopped,
        None if display is None else display.eased(scene),
        run.angles,
        pruning,
        window_scores,
        Display.place_front(read) if display is None else None,
    )


def _read_photographs(
    capture: str | Path | Capture, test_every: TestEvery, test_names: Sequence[str] | None
) -> tuple[Capture, list[int], list[int]]:
    """Return the capture, and the indices of the photographs to fit to and to hold out; see fit."""
    if test_names is not None and not is_row(test_names):
        raise InputError(f"test_names: expected names of photographs, got {shown(test_names)}")
    expect("capture", capture, str, Path, Capture)
    read = capture if isinstance(capture, Capture) else read_capture(capture)
    return read, *read.split(test_every, None if test_names is None else list(test_names))


def _estimate(capture: Capture, settings: FitSettings, device: str) -> MemoryEstimate:
    width, height = map(int, capture.sizes_px.max(0))
    return estimate_memory(settings, device, len(capture.names), width, height, capture.may_be_masked)


def _fit_memory(capture: Capture, place: Callable[[Capture], Placement], options: RunOptions) -> Capture:
    """Reduce photographs of their files' size, with a note, until the memory suffices.

    A fit that goes on takes the size that it began with. Where no size suffices, the photographs stay as they are, and
    the fit is refused.
    """
    if not capture.is_whole:
        return capture

    path = None if options.folder is None or options.fresh else options.folder / checkpoint.FILE
    begun = None if path is None else checkpoint.stored_sizes_digest(path)
    if begun == checkpoint.sizes_digest(capture) or begun is None and place(capture).suffices:
        return capture
    for longest in smaller_sizes(int(capture.sizes_px.max()), SMALLEST_PX):
        smaller = capture.reduced(longest)
        if begun == checkpoint.sizes_digest(smaller) or begun is None and place(smaller).suffices:
            need, (width, height) = place(capture).need, map(int, capture.sizes_px.max(0))
            assume(
                f"photographs are reduced to {longest} pixels on the longer side: as they are, {width} x {height}, the "
                f"fit needs too much memory ({need.words()}); longest_px= or scale= sets another size"
            )
            return smaller
    return capture


def _usual_steps(photographs: int) -> int:
    """Return the number of steps for so many photographs, with a note where they are few.

    Few photographs are overfitted. After 7,000 steps the views between them were better by 0.3, 0.5 and 0.6 dB than
    after 30,000, of plush with 24 photographs, solids-round-1 and solids-arc-1 (28 each), by which this was chosen. Of
    plush with 85 photographs 30,000 steps were better by 0.2. Of banana (12), solids-arc-2 and solids-round-2 (28),
    which had no part in the choice, 7,000 steps are better by 0.5, 0.3 and 0.7 dB (docs/benchmarks.md).
    """
    if photographs >= MANY_PHOTOGRAPHS:
        return RECIPE_STEPS
    assume(
        f"{_STEPS_OF_FEW} steps: fewer than {MANY_PHOTOGRAPHS} photographs are overfitted by more "
        f"(steps={RECIPE_STEPS} takes the time)"
    )
    return _STEPS_OF_FEW


def _needs_exposure(capture: Capture, indices: list[int]) -> bool:
    """Return whether the exposures of photographs differ, with a note where they do."""
    spread = exposure_spread(capture, indices)
    if not asks_for_exposures(spread):
        return False
    assume(
        f"exposures of the photographs differ by {spread:.1%}: a change of colours is fitted for each, and held-out "
        "photographs are scored with colours matched (exposure=False leaves both out)"
    )
    return True


def make_settings(**values: Any) -> FitSettings:
    """Return FitSettings with these fields; raise InputError for unknown names and values outside their ranges."""
    known = [setting.name for setting in fields(FitSettings)]
    for name in values:
        if name not in known:
            near = nearest(name, known)
            hint = f"did you mean {near}?" if near else f"expected one of {', '.join(known)}"
            raise InputError(f"fit: there is no setting {name}; {hint}")
    return FitSettings(**values)


def _prepare(
    capture: Capture,
    train: list[int],
    test: list[int],
    settings: FitSettings,
    asked: tuple[int | None, bool | None],
    options: RunOptions,
    placement: Placement,
    group: Group,
    cones: tuple[Panel | str | Path | float | None, str | None, float | None],
    opened: ExitStack,
    loss: Loss | None,
) -> tuple[Run, Normalization, Display | None]:
    """Return the run before its first step, its coordinates and its display; print the choices.

    Args:
        asked: steps and exposure of the settings; None: by the photographs.
        cones: cone, centre and score_cone.
        opened: gets the folder of the run's temporary files.
        loss: in place of that of the settings.
    """
    display, judged, messages = place_display(capture, *cones)
    steps, exposure = asked
    if steps is None:
        settings = replace(settings, steps=_usual_steps(len(train)))
    if exposure is None:
        settings = replace(settings, exposure=_needs_exposure(capture, train))
    weights = None if display is None else display.photo_weights(train)
    identity = Identity.make(settings, capture, train, weights, loss)
    progress = Progress(
        options.progress and group.is_first, options.folder if options.tensorboard and group.is_first else None
    )
    if options.folder is not None:
        remove_left_over(make_folder(options.folder))
        identity.check_file(options.folder / checkpoint.FILE, options.fresh)
    placement.check(is_certain=settings.density == "mcmc")
    for line in placement.describe():
        progress.say(line)
    normalization = Normalization.from_centres(capture.centres, capture.extent)
    where: str | Path = "cpu"
    if placement.photographs == "disk":
        where = opened.enter_context(scratch_folder(None if options.folder is None else placement.room.folder))
    elif placement.photographs == "device":
        where = placement.room.device
    device = placement.room.device
    load = partial(PosedImages.load, capture, normalization=normalization, device=device, masks=settings.masks)
    images = load(train, progress=train, where=_part(where, "fitted"))
    held_out = load(test, progress=test, where=_part(where, "held-out")) if test else None
    held_out, scored = _drop_masked_out(images, held_out, settings.masks)
    angles = None
    if judged is not None and held_out is not None:
        angles = judged.held_out_angles([test[index] for index in scored])
    points, centres = normalization.points(capture.points), normalization.points(capture.centres)
    gaussians = initialize_gaussians(points, capture.colours, centres, settings)
    state = GaussianState.start(gaussians.to(images.device), placement.moments == "host")
    trainer = Trainer(state, images, settings, group, weights, loss)
    width, height = map(int, capture.sizes_px.max(0))
    progress.say(
        f"fits {len(train)} photographs of {width} x {height} pixels, {len(scored)} held out, on {images.device}: "
        f"{settings.steps} steps, {trainer.state.count} Gaussians to begin with, {settings.cap_max} at most"
    )
    for line in (_describe_loss(settings, loss, device), *_describe_dropout(settings, len(train)), *messages):
        progress.say(line)
    return Run(trainer, held_out, identity, options, progress, angles), normalization, display


def _part(where: str | Path, name: str) -> str | Path:
    """Return a new folder within a folder, or the same device."""
    return make_folder(where / name) if isinstance(where, Path) else where


def _drop_masked_out(
    images: PosedImages, held_out: PosedImages | None, masks: Masks
) -> tuple[PosedImages | None, list[int]]:
    """Drop held-out photographs without pixels to score under their masks, and report photographs without pixels.

    Returns:
        The other held-out photographs, None if there are none, and their indices.

    Raises:
        InputError: masks leave nothing of any training photograph.
    """
    indices = [] if held_out is None else list(range(held_out.count))
    unfitted, unscored = images.masked_out(), [] if held_out is None else held_out.masked_out()
    empty = [images.names[i] for i in unfitted] + [held_out.names[i] for i in unscored if held_out is not None]
    if not empty:
        return held_out, indices
    which = f"masks leave nothing of {len(empty)} of {images.count + len(indices)} photographs"
    if len(unfitted) == images.count:
        raise InputError(
            f"{which}, and nothing to fit to: expected masks that are white, or photographs that are opaque, where the "
            "scene is: turn black and white round, or take the masks away"
        )
    if masks == "alpha":
        assume(f"{which}, in which the scene is to be transparent all over: {first_names(empty)}")
        return held_out, indices
    assume(f"{which}, which count nowhere and are not scored: {first_names(empty)}")
    indices = [index for index in indices if index not in unscored]
    return held_out.select(indices) if held_out is not None and indices else None, indices


def _describe_loss(settings: FitSettings, own: Loss | None, device: str) -> str:
    """Return a line on the loss of a fit; own: in place of that of the settings."""
    if own is not None:
        return f"loss: {loss_name(own)}, a function of one's own"
    if settings.loss == "l1-ssim":
        return "loss: l1-ssim, of pixels (wd is of texture, too)"
    slow = "; on a CPU a step takes about 100 times as long as with l1-ssim" if device == "cpu" else ""
    return f"loss: WD-R, L1 and SSIM of the pixels, and from half of the steps on the texture that VGG-16 sees{slow}"


def _describe_dropout(settings: FitSettings, photographs: int) -> list[str]:
    """Return a line of advice on dropout for this number of photographs; None without advice."""
    if settings.dropout > 0:
        return [f"steps leave out a random part of the Gaussians, up to {settings.dropout:.0%} (dropout)"]
    words = (
        f"steps leave out no Gaussians: with {photographs} photographs a dropout of 0.1 gains up to 0.4 dB or loses up "
        "to 0.1, by the scene; compare the PSNR of photographs held out"
    )
    return [words] if photographs <= _FEW_PHOTOGRAPHS else []


def _remove_origin(gaussians: Gaussians) -> Gaussians:
    """Return the scene with an origin of zero if float32 is fine enough: not every program reads doubles."""
    exact = gaussians.means.double().numpy() + gaussians.origin
    if float32_step(np.median(exact, 0)) > _ORIGIN_STEP * typical_size(gaussians.scales.numpy()):
        return gaussians
    return replace(gaussians, means=torch.from_numpy(exact.astype(np.float32)), origin=(0.0, 0.0, 0.0))
