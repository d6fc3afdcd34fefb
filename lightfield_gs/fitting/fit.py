"""From a capture to a scene: what a fit begins with, its run, and what it leaves."""

from __future__ import annotations

import difflib
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, fields, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

from lightfield_gs.base.assumptions import assume
from lightfield_gs.base.checks import expect, is_row, real_number, shown
from lightfield_gs.base.device import choose_device
from lightfield_gs.base.errors import InputError
from lightfield_gs.base.options import DEVICES, Device
from lightfield_gs.base.paths import checked_path
from lightfield_gs.fitting import checkpoint, memory
from lightfield_gs.fitting.angles import Angles
from lightfield_gs.fitting.checkpoint import Identity
from lightfield_gs.fitting.display import Display, placed, rig_path
from lightfield_gs.fitting.dropout import words_on_dropout
from lightfield_gs.fitting.evaluate import Scores
from lightfield_gs.fitting.fields import Fields
from lightfield_gs.fitting.initial import initial_gaussians
from lightfield_gs.fitting.progress import Progress
from lightfield_gs.fitting.run import Habits, Run
from lightfield_gs.fitting.settings import Density, FitSettings, Masks
from lightfield_gs.fitting.several import Group, joined
from lightfield_gs.fitting.shown import CONTRIBUTION_CUT, FrameScores, Shown, pruned
from lightfield_gs.fitting.trainer import Trainer
from lightfield_gs.fitting.views import Views
from lightfield_gs.fitting.world import World
from lightfield_gs.io.atomic import make_folder, remove_left_over
from lightfield_gs.io.captures.capture import Capture, TestEvery, read_capture
from lightfield_gs.io.captures.photo_files import first_names
from lightfield_gs.io.scenes.comments import ANTIALIASED, fit_comment
from lightfield_gs.io.scenes.plausibility import float32_step, typical_size
from lightfield_gs.panels.panel import Panel
from lightfield_gs.scene.gaussians import Gaussians

_ORIGIN_STEP = 1e-3  # of the usual Gaussian's size: rounding to float32 may move one by so much


@dataclass(frozen=True)
class FitResult:
    """What a fit made.

    gaussians: the scene in the capture's coordinates, float32 on the CPU. settings: as it was fitted. steps: how many
    were done, fewer than settings.steps where it was stopped. scores: of the photographs held out; None: none were.
    history: of all evaluations: step, psnr_db, ssim, gaussians. stopped: whether it was asked to end before its time.
    display: what the scene was fitted for. angles: of the photographs held out, where they are scored by these. shown:
    what was left out for the display; None: nothing, or the fit was stopped. frame_scores:
    by the pixels of the photographs held out that the display can show, before and after.
    """

    gaussians: Gaussians
    settings: FitSettings
    steps: int
    scores: Scores | None
    history: list[dict[str, Any]]
    stopped: bool
    display: Display | None = None
    angles: Angles | None = None
    shown: Shown | None = None
    frame_scores: FrameScores | None = None

    def save(self, path: str | Path, comments: Sequence[str] = ()) -> None:
        """Writes the scene as .ply, .spz or .splat; a .ply has the settings in its header, see Gaussians.save. That
        of a display has its framing there too, and its rig beside it: scene.rig.yaml for scene.ply."""
        if self.display is not None:
            comments = [*comments, *self.display.comments()]
            self.display.rig.to_yaml(rig_path(Path(path)))
        said = {**asdict(self.settings), "steps_done": self.steps}
        trained = [ANTIALIASED] if self.settings.antialiased else []
        self.gaussians.save(path, [fit_comment(said), *trained, *comments])


def fit(
    capture: str | Path | Capture,
    *,
    steps: int = 30_000,
    cap_max: int = 300_000,
    density: Density = "mcmc",
    test_every: TestEvery = "own",
    test_names: Sequence[str] | None = None,
    cone: Panel | str | Path | float | None = None,
    centre: str | None = None,
    score_cone: float | None = None,
    contribution_cut: float = CONTRIBUTION_CUT,
    device: Device = "auto",
    folder: str | Path | None = None,
    fresh: bool = False,
    checkpoint_every: int | None = None,
    evaluate_every: int | None = None,
    picture_every: int | None = None,
    stop_early: bool = False,
    tensorboard: bool = False,
    progress: bool = True,
    stop: Callable[[], bool] = lambda: False,
    **settings: Any,
) -> FitResult:
    """Fits Gaussians to posed photographs of a scene that stands still (Kerbl et al. 2023).

    capture: a folder (COLMAP's sparse/0 or a transforms.json, and the photographs), or what read_capture returned.
    steps, cap_max (the most Gaussians), density ("mcmc" or "adaptive") and settings: see FitSettings.
    test_every: k holds out the middle one of every k photographs and scores the scene by them; None: none; "own": those
    that the capture itself keeps for tests, or of every 8. test_names: those held out instead. device: "auto", "cpu" or
    "cuda". folder: where checkpoints, scores.json and pictures go; a fit that was stopped goes on from there, to the
    same bits, unless `fresh`. The other arguments: see Habits.

    Where torchrun starts several processes that all call it alike, they share out the photographs of a step
    (settings.batch_size), one GPU each; the first one writes and talks, and all return the result.

    cone: a panel, its name or file, or degrees, 1..179, in place of the default panel's: the fit is for what that
    shows, see Display, and leaves out what it does not, within contribution_cut (0..1), see shown_by. centre: the name
    of the photograph in the middle of the cone; None: the most central one. score_cone: photographs held out are scored
    by their angle in a cone of this full angle, degrees, without `cone` too; None: in that of `cone`.

    The same capture, settings and device give the same bits. Raises InputError: what is no capture, settings that
    cannot be, a folder of another fit.
    """
    chosen = settings_of(steps=steps, cap_max=cap_max, density=density, **settings)
    where = None if folder is None else checked_path(folder)
    habits = Habits(
        where, fresh, checkpoint_every, evaluate_every, picture_every, stop_early, tensorboard, progress, stop
    )
    if device not in DEVICES:
        raise InputError(f"device: expected {', '.join(DEVICES)}, got {shown(device)}")
    if test_names is not None and not is_row(test_names):
        raise InputError(f"test_names: expected names of photographs, got {shown(test_names)}")
    expect("capture", capture, str, Path, Capture)
    read = capture if isinstance(capture, Capture) else read_capture(capture)
    train, test = read.split(test_every, None if test_names is None else list(test_names))
    cut = real_number("contribution_cut", contribution_cut, 0.0, 1.0)
    with joined(choose_device(device)) as (group, own):
        run, world, display = _prepared(read, train, test, chosen, habits, own, group, (cone, centre, score_cone))
        run.go()
        scene, found, in_frame = run.trainer.fields.gaussians().detach(), None, None
        if display is not None and not run.stopped:
            scene, found, in_frame = pruned(run, world, display, cut)
        scene = _without_origin(world.back(scene.to("cpu")))
    return FitResult(
        scene, chosen, run.trainer.done, run.scores, run.history, run.stopped, display, run.angles, found, in_frame
    )


def _prepared(
    capture: Capture,
    train: list[int],
    test: list[int],
    settings: FitSettings,
    habits: Habits,
    device: str,
    group: Group,
    asked: tuple[Panel | str | Path | float | None, str | None, float | None],
) -> tuple[Run, World, Display | None]:
    """The run before its first step, the coordinates that it is in, and what it is for; says what was chosen. asked:
    cone, centre and score_cone."""
    display, judged, said = placed(capture, *asked)
    shares = None if display is None else display.shares(train)
    identity = Identity.of(settings, capture, train, shares)
    progress = Progress(
        habits.progress and group.is_first, habits.folder if habits.tensorboard and group.is_first else None
    )
    if habits.folder is not None:
        remove_left_over(make_folder(habits.folder))
        identity.check_file(habits.folder / checkpoint.FILE, habits.fresh)
    width, height = map(int, capture.sizes_px.max(0))
    need = memory.needed(settings, len(capture.names), width, height)
    if on_host := memory.stays_on_host(need, device):
        progress.say(f"photographs stay in the host's memory: they take {need.photographs / 1e9:.1f} GB")
        need = need._replace(photographs=0)
    progress.say(f"needs about {memory.check(need, device, is_certain=settings.density == 'mcmc')}")
    world = World.of(capture.centres, capture.extent)
    load = partial(Views.load, capture, world=world, device=device, masks=settings.masks, on_host=on_host)
    views, held = load(train, ticks=train), load(test, ticks=test) if test else None
    held, scored = _with_pixels(views, held, settings.masks)
    angles = None if judged is None or held is None else judged.angles([test[place] for place in scored])
    trainer = _begun(capture, views, world, settings, group, shares)
    progress.say(
        f"fits {len(train)} photographs of {width} x {height} pixels, {len(scored)} held out, on {device}: "
        f"{settings.steps} steps, {trainer.fields.count} Gaussians to begin with, {settings.cap_max} at most"
    )
    if (words := words_on_dropout(settings, len(train))) is not None:
        progress.say(words)
    for line in said:
        progress.say(line)
    return Run(trainer, held, identity, habits, progress, angles), world, display


def _with_pixels(views: Views, held: Views | None, masks: Masks) -> tuple[Views | None, list[int]]:
    """The views held out of which masks leave something to score, None where they leave nothing of any; and their
    places. Says of which photographs masks leave nothing. Raises InputError where they leave nothing to fit to."""
    places = [] if held is None else list(range(held.count))
    fitted, unscored = views.masked_out(), [] if held is None else held.masked_out()
    empty = [views.names[place] for place in fitted] + [held.names[place] for place in unscored if held is not None]
    if not empty:
        return held, places
    which = f"masks leave nothing of {len(empty)} of {views.count + len(places)} photographs"
    if len(fitted) == views.count:
        raise InputError(
            f"{which}, and nothing to fit to: expected masks that are white, or photographs that are opaque, where the "
            "scene is: turn black and white round, or take the masks away"
        )
    if masks == "alpha":
        assume(f"{which}, in which the scene is to be transparent all over: {first_names(empty)}")
        return held, places
    assume(f"{which}, which count nowhere and are not scored: {first_names(empty)}")
    places = [place for place in places if place not in unscored]
    return held.some(places) if held is not None and places else None, places


def settings_of(**given: Any) -> FitSettings:
    """FitSettings of these fields. Raises InputError for names that it does not have, and for values that cannot be."""
    known = [field.name for field in fields(FitSettings)]
    for name in given:
        if name not in known:
            near = difflib.get_close_matches(name, known, 1)
            hint = f"did you mean {near[0]}?" if near else f"expected one of {', '.join(known)}"
            raise InputError(f"fit: there is no setting {name}; {hint}")
    return FitSettings(**given)


def _begun(
    capture: Capture, views: Views, world: World, settings: FitSettings, group: Group, shares: Sequence[float] | None
) -> Trainer:
    """The trainer before its first step."""
    gaussians = initial_gaussians(
        world.points(capture.points), capture.colours, world.points(capture.centres), settings
    )
    return Trainer(Fields.of(gaussians.to(views.device)), views, settings, group, shares)


def _without_origin(gaussians: Gaussians) -> Gaussians:
    """The same from an origin of zero, where float32 is fine enough for that: not every program reads doubles."""
    exact = gaussians.means.double().numpy() + gaussians.origin
    if float32_step(np.median(exact, 0)) > _ORIGIN_STEP * typical_size(gaussians.scales.numpy()):
        return gaussians
    return replace(gaussians, means=torch.from_numpy(exact.astype(np.float32)), origin=(0.0, 0.0, 0.0))
