"""A fit from its first step, or a checkpoint's, to its last: what happens between steps, and when."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lightfield_gs.base.checks import expect, shown, whole_number
from lightfield_gs.base.errors import InputError
from lightfield_gs.fitting import checkpoint
from lightfield_gs.fitting.align import aligned
from lightfield_gs.fitting.angles import Angles
from lightfield_gs.fitting.checkpoint import Identity
from lightfield_gs.fitting.evaluate import Scores, evaluated, protocol
from lightfield_gs.fitting.pictures import write_pictures
from lightfield_gs.fitting.progress import Progress
from lightfield_gs.fitting.trainer import Trainer
from lightfield_gs.fitting.views import Views
from lightfield_gs.io.text_files import write_json
from lightfield_gs.scene.gaussians import Gaussians

_CHUNK_S, _LONGEST_CHUNK = 0.3, 100  # how long steps go on before the loop looks whether it is to stop
_LEAST_REST_S, _CHECKPOINT_SHARE = 30.0, 0.02  # seconds between checkpoints, and their share of the time
_PATIENCE = 3  # evaluations without a better one, after which --stop-early ends a fit


@dataclass(frozen=True)
class Habits:
    """What a fit does beside its steps; none of it changes a bit of the scene.

    folder: for checkpoints, scores and pictures; None: none are written. fresh: a checkpoint that is there is removed.
    checkpoint_every, evaluate_every, picture_every: steps; None: so that checkpoints take 2 % of the time, evaluations
    at every tenth of the steps, no pictures. stop_early: the fit ends once three evaluations in a row were no better.
    tensorboard: scalars in the folder. progress: whether lines and a bar are printed. stop: is asked between steps.
    """

    folder: Path | None = None
    fresh: bool = False
    checkpoint_every: int | None = None
    evaluate_every: int | None = None
    picture_every: int | None = None
    stop_early: bool = False
    tensorboard: bool = False
    progress: bool = True
    stop: Callable[[], bool] = lambda: False

    def __post_init__(self) -> None:
        for name in ("checkpoint_every", "evaluate_every", "picture_every"):
            if getattr(self, name) is not None:
                whole_number(name, getattr(self, name), 1, 10_000_000)
        for name in ("fresh", "stop_early", "tensorboard", "progress"):
            expect(name, getattr(self, name), bool)
        if not callable(self.stop):
            raise InputError(f"stop: expected a function without arguments, got {shown(self.stop)}")
        if self.tensorboard and self.folder is None:
            raise InputError("tensorboard: expected a folder for its files too")


class Run:
    """A trainer on its way, with the views that are held out from it, if any."""

    def __init__(
        self,
        trainer: Trainer,
        held: Views | None,
        identity: Identity,
        habits: Habits,
        progress: Progress,
        angles: Angles | None = None,
    ):
        """angles: of the views held out, where they are scored by these as well."""
        self.angles = angles
        self.trainer, self.held, self.habits, self._progress = trainer, held, habits, progress
        self._identity = identity
        self.history: list[dict[str, Any]] = []  # of evaluations: step, psnr_db, ssim, gaussians
        self.scores: Scores | None = None
        self.stopped = False  # by habits.stop
        self._saved_at, self._saving_s = time.monotonic(), 0.0

    def go(self) -> None:
        """Does all steps that are left, or as many as it may."""
        self._resume()
        trainer, steps, chunk = self.trainer, self.trainer.settings.steps, 1
        self._progress.begin(trainer.done, steps, trainer.settings.batch_size)
        try:
            while trainer.done < steps and not self.stopped and not self._is_no_better():
                began = time.monotonic()
                before = trainer.done
                trainer.advance(min(self._next_stop(), before + chunk))
                chunk = self._agreed(_next_chunk(trainer.done - before, time.monotonic() - began))
                self._between()
            self._end()
        finally:
            self._progress.close()

    def _next_stop(self) -> int:
        """The next step after which something is due."""
        habits = self.habits
        every = [n for n in (habits.checkpoint_every, habits.picture_every, self._evaluate_every) if n is not None]
        return min((self.trainer.done // n + 1) * n for n in every)

    @property
    def _evaluate_every(self) -> int:
        return self.habits.evaluate_every or max(1, self.trainer.settings.steps // 10)

    def _between(self) -> None:
        trainer, habits = self.trainer, self.habits
        done = trainer.done
        losses = trainer.counters.losses[max(0, done - 100) : done]
        self._progress.step(done, float(losses.mean()), trainer.fields.count)
        if done % self._evaluate_every == 0 and done < trainer.settings.steps:
            self._evaluate()
        if habits.picture_every is not None and done % habits.picture_every == 0:
            self._picture()
        if self._checkpoint_is_due():
            self._save()
        self.stopped = bool(self._agreed(1 if habits.stop() else 0))

    def _agreed(self, number: int) -> int:
        """The largest of the processes' numbers: all stop at the same step."""
        return self.trainer.group.largest(number, self.trainer.device)

    @property
    def _folder(self) -> Path | None:
        """Where this process writes."""
        return self.habits.folder if self.trainer.group.is_first else None

    def _end(self) -> None:
        """What is left for the scene as it is now."""
        if not self.history or self.history[-1]["step"] != self.trainer.done or self.scores is None:
            self._evaluate()
        self._save()
        self._picture()

    def say(self, line: str) -> None:
        """Tells it, unless progress is not to be shown."""
        self._progress.say(line)

    # --- Scores

    def held_for(self, gaussians: Gaussians) -> Views | None:
        """The views held out as a scene, coordinates of the fit, is scored by them; None where there are none."""
        settings = self.trainer.settings
        return aligned(self.held, gaussians, settings) if self.held is not None and settings.poses else self.held

    def scores_of(self, gaussians: Gaussians, held: Views) -> Scores:
        """Of a scene, coordinates of the fit, by views of held_for."""
        settings = self.trainer.settings
        return evaluated(gaussians, held, settings.steady_background, settings.antialiased)

    def _evaluate(self) -> None:
        trainer, settings = self.trainer, self.trainer.settings
        gaussians = trainer.fields.gaussians()
        if (held := self.held_for(gaussians)) is None:
            return
        self.scores = scores = self.scores_of(gaussians, held)
        row = {"step": trainer.done, **scores.to_dict(), "gaussians": trainer.fields.count}
        del row["views"]
        self.history = [*(old for old in self.history if old["step"] < trainer.done), row]
        self._progress.scores(trainer.done, scores.mean_psnr_db, scores.mean_ssim)
        self._progress.say(
            f"step {trainer.done}: held-out PSNR {scores.mean_psnr_db:.2f} dB, SSIM {scores.mean_ssim:.4f}, "
            f"{trainer.fields.count} Gaussians" + (", held-out poses aligned" if settings.poses else "")
        )
        self.write_scores()

    def write_scores(self, **more: Any) -> None:
        """Writes scores.json in the folder, if there is one, and scores; with what else is to be said."""
        if self._folder is not None and (scores := self.scores) is not None:
            by_angle = {} if self.angles is None else {"angles": self.angles.to_dict(scores)}
            words = protocol(self.trainer.settings.poses)
            said = {"protocol": words, "step": self.trainer.done, **scores.to_dict(), **by_angle, **more}
            said["history"] = self.history
            write_json(said, self._folder / "scores.json")

    def _is_no_better(self) -> bool:
        """Whether the last evaluations say that going on gains nothing, and the fit may end of that. Evaluations at
        other steps, of a fit that was stopped there, have no say: it ends where it would have without."""
        scores = [row["psnr_db"] for row in self.history if row["step"] % self._evaluate_every == 0]
        if not self.habits.stop_early or len(scores) <= _PATIENCE:
            return False
        return max(scores[-_PATIENCE:]) <= max(scores[:-_PATIENCE])

    def _picture(self) -> None:
        if self._folder is not None:
            write_pictures(self._folder, self.trainer, self.held or self.trainer.views)

    # --- Checkpoints

    def _resume(self) -> None:
        if self.habits.folder is None:
            return
        path = self.habits.folder / checkpoint.FILE
        if path.exists():
            self.history = checkpoint.restore(path, self.trainer, self._identity)
            self._progress.say(f"goes on from {path}, {self.trainer.done} of {self.trainer.settings.steps} steps done")

    def _checkpoint_is_due(self) -> bool:
        every = self.habits.checkpoint_every
        if every is not None:
            return self.trainer.done % every == 0
        return time.monotonic() - self._saved_at > max(_LEAST_REST_S, self._saving_s / _CHECKPOINT_SHARE)

    def _save(self) -> None:
        if self._folder is None:
            return
        began = time.monotonic()
        checkpoint.save(self._folder / checkpoint.FILE, self.trainer, self._identity, self.history)
        self._saved_at = time.monotonic()
        self._saving_s = self._saved_at - began


def _next_chunk(steps: int, seconds: float) -> int:
    """How many steps to do next, after so many in so many seconds: as many as take _CHUNK_S."""
    return max(1, min(int(_CHUNK_S * steps / max(seconds, 1e-9)), 2 * steps, _LONGEST_CHUNK))
