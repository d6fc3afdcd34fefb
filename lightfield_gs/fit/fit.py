"""From a capture to a scene: what a fit begins with, its run, and what it leaves."""

from __future__ import annotations

import difflib
import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

from lightfield_gs.base.checks import expect
from lightfield_gs.base.device import choose_device
from lightfield_gs.base.errors import InputError
from lightfield_gs.base.options import Device
from lightfield_gs.fit.angles import Angles
from lightfield_gs.fit.checkpoint import Origin
from lightfield_gs.fit.display import Display, placed, rig_path
from lightfield_gs.fit.evaluate import Scores
from lightfield_gs.fit.fields import Fields
from lightfield_gs.fit.initial import initial_gaussians
from lightfield_gs.fit.progress import Progress
from lightfield_gs.fit.run import Habits, Run
from lightfield_gs.fit.settings import Density, FitSettings
from lightfield_gs.fit.shown import CONTRIBUTION_CUT, Shown, pruned
from lightfield_gs.fit.trainer import Trainer
from lightfield_gs.fit.views import Views
from lightfield_gs.fit.world import World
from lightfield_gs.io.atomic import make_folder
from lightfield_gs.io.captures.capture import Capture, read_capture
from lightfield_gs.panels.panel import Panel
from lightfield_gs.scene.gaussians import Gaussians


@dataclass(frozen=True)
class FitResult:
    """What a fit made.

    gaussians: the scene in the capture's coordinates, float32 on the CPU. settings: as it was fitted. steps: how many
    were done, fewer than settings.steps where it was stopped. scores: of the photographs held out; None: none were.
    history: of all evaluations: step, psnr_db, ssim, gaussians. stopped: whether it was asked to end before its time.
    angles: of the photographs held out, where they are scored by these. display: what the scene was fitted for. shown:
    what of it that shows, None where the fit was stopped; then all Gaussians are there. pruned_scores: as scores, of
    what is left.
    """

    gaussians: Gaussians
    settings: FitSettings
    steps: int
    scores: Scores | None
    history: list[dict[str, Any]]
    stopped: bool
    angles: Angles | None = None
    display: Display | None = None
    shown: Shown | None = None
    pruned_scores: Scores | None = None

    def save(self, path: str | Path, comments: Sequence[str] = ()) -> None:
        """Writes the scene as a standard 3DGS .ply, the settings in a line of its header; see Gaussians.save. That of a
        display has its framing there too, and its rig beside it: scene.rig.yaml for scene.ply."""
        path = Path(path)
        if self.display is not None:
            comments = [*comments, *self.display.comments()]
            self.display.rig.to_yaml(rig_path(path))
        said = {**asdict(self.settings), "steps_done": self.steps}
        self.gaussians.save(path, [f"lightfield-gs fit: {json.dumps(said)}", *comments])


def fit(
    capture: str | Path | Capture,
    *,
    steps: int = 30_000,
    gaussians: int = 300_000,
    density: Density = "mcmc",
    test_every: int | None = 8,
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
    steps, gaussians (a budget), density ("mcmc" or "adaptive") and settings: see FitSettings, whose fields they are.
    test_every: k holds out the middle one of every k photographs and scores the scene by them; None: none. test_names:
    those held out instead. device: "auto", "cpu" or "cuda". folder: where checkpoints, scores.json and pictures go; a
    fit that was stopped goes on from there, to the same bits, unless `fresh`. The other arguments: see Habits.

    cone: a panel, its name or file, or degrees, 1..179, in place of the default panel's: the fit is for what that
    shows, see Display, and leaves out what it does not, within contribution_cut (0..1), see shown_by. centre: the name
    of the photograph in the middle of the cone; None: the most central one. score_cone: photographs held out are scored
    by their angle in a cone of this full angle, degrees, without `cone` too; None: in that of `cone`.

    The same capture, settings and device give the same bits. Raises InputError: what is no capture, settings that
    cannot be, a folder of another fit.
    """
    chosen = settings_of(steps=steps, gaussians=gaussians, density=density, **settings)
    where = None if folder is None else make_folder(folder)
    habits = Habits(
        where, fresh, checkpoint_every, evaluate_every, picture_every, stop_early, tensorboard, progress, stop
    )
    on = choose_device(device)
    expect("capture", capture, str, Path, Capture)
    read = capture if isinstance(capture, Capture) else read_capture(capture)
    train, test = read.split(test_every, None if test_names is None else list(test_names))
    if tensorboard and where is None:
        raise InputError("tensorboard: expected a folder for it as well")
    teller = Progress(progress, where / "tensorboard" if tensorboard and where is not None else None)
    display, judged = placed(read, cone, centre, score_cone, teller.say)
    shares = None if display is None else display.shares(train)
    world = World.of(read.world_to_camera, read.extent)
    trainer = _begun(read, train, world, chosen, on, shares)
    held = Views.load(read, test, world, on, test) if test else None
    views = trainer.views
    teller.say(
        f"fits {len(train)} photographs of {views.width_px} x {views.height_px} pixels, {len(test)} held out, on {on}: "
        f"{chosen.steps} steps, {trainer.fields.count} Gaussians to begin with, {chosen.gaussians} at most"
    )
    angles = None if judged is None or not test else judged.angles(test)
    run = Run(trainer, held, Origin.of(chosen, read, train, shares), habits, teller, angles)
    run.go()
    scene, shown, pruned_scores = trainer.fields.gaussians(), None, None
    if display is not None and not run.stopped:
        scene, shown, pruned_scores = pruned(run, world, display, contribution_cut, teller.say)
    return FitResult(
        world.back(scene.detach().to("cpu")),
        chosen,
        trainer.done,
        run.scores,
        run.history,
        run.stopped,
        angles,
        display,
        shown,
        pruned_scores,
    )


def settings_of(**given: Any) -> FitSettings:
    """FitSettings of these fields. Raises InputError for names that it does not have."""
    known = [field.name for field in fields(FitSettings)]
    for name in given:
        if name not in known:
            near = difflib.get_close_matches(name, known, 1)
            raise InputError(
                f"fit: there is no setting {name}; "
                + (f"did you mean {near[0]}?" if near else f"expected one of {', '.join(known)}")
            )
    return FitSettings(**given)


def _begun(
    capture: Capture, train: list[int], world: World, settings: FitSettings, device: str, shares: Sequence[float] | None
) -> Trainer:
    """The trainer before its first step."""
    views = Views.load(capture, train, world, device, train)
    gaussians = initial_gaussians(
        world.points(capture.points), capture.colours, world.points(capture.centres), settings
    )
    return Trainer(Fields.of(gaussians.to(device)), views, settings, shares)
