"""A fit from its first step, or from a checkpoint, to its last; scores, pictures and checkpoints between steps."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lightfield_gs.base.checks import expect, shown, whole_number
from lightfield_gs.base.errors import InputError
from lightfield_gs.fitting import checkpoint
from lightfield_gs.fitting.checkpoint import Identity
from lightfield_gs.fitting.evaluate import ConeAngles, Scores, align_poses, describe_protocol, evaluate
from lightfield_gs.fitting.posed_images import PosedImages
from lightfield_gs.fitting.progress import Progress, write_pictures
from lightfield_gs.fitting.trainer import Trainer
from lightfield_gs.io.text_files import write_json
from lightfield_gs.scene.gaussians import Gaussians

_CHUNK_S, _LONGEST_CHUNK = 0.3, 100  # seconds and steps between two looks whether to stop
_LEAST_REST_S, _CHECKPOINT_FRACTION = 30.0, 0.02  # seconds between checkpoints, and their fraction of the time
_PATIENCE = 3  # evaluations without a better one, after which stop_early ends a fit


@dataclass(frozen=True)
class FitState:
    """A fit under way, as callbacks see it.

    Attributes:
        step: number of steps done.
        loss: mean of the last 100 steps.
        gaussians: a copy of the scene, in the normalised coordinates of the fit, on its device.
        scores: of the last evaluation; None before it, and without held-out photographs.
    """

    step: int
    loss: float
    gaussians: Gaussians
    scores: Scores | None


@dataclass(frozen=True)
class RunOptions:
    """The side tasks of a fit: checkpoints, scores and pictures. They do not change a bit of the scene.

    Attributes:
        folder: for checkpoints, scores and pictures; None: nothing is written.
        fresh: remove a checkpoint in the folder.
        checkpoint_every: steps between checkpoints; None: they take 2 % of the time.
        evaluate_every: steps between evaluations; None: a tenth of all steps.
        picture_every: steps between pictures; None: one at the end.
        stop_early: end the fit once three evaluations in a row were no better.
        tensorboard: write scalars in the folder.
        progress: print lines and a bar.
        stop: function called between steps; True ends the fit.
        callback: function called with the state of the fit after the steps of callback_every, and after the last step.
        callback_every: steps between its calls; None: as evaluate_every.
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
    callback: Callable[[FitState], None] | None = None
    callback_every: int | None = None

    def __post_init__(self) -> None:
        for name in ("checkpoint_every", "evaluate_every", "picture_every", "callback_every"):
            if getattr(self, name) is not None:
                whole_number(name, getattr(self, name), 1, 10_000_000)
        for name in ("fresh", "stop_early", "tensorboard", "progress"):
            expect(name, getattr(self, name), bool)
        if not callable(self.stop):
            raise InputError(f"stop: expected a function without arguments, got {shown(self.stop)}")
        if self.callback is not None and not callable(self.callback):
            raise InputError(f"callback: expected a function of a FitState, got {shown(self.callback)}")
        if self.tensorboard and self.folder is None:
            raise InputError("tensorboard: expected a folder for its files too")


class Run:
    """A trainer on its way, with the held-out photographs, if any.

    Attributes:
        history: of evaluations: step, psnr_db, ssim, gaussians.
        scores: of the last evaluation.
        stopped: whether options.stop ended the fit.
    """

    def __init__(
        self,
        trainer: Trainer,
        held_out: PosedImages | None,
        identity: Identity,
        options: RunOptions,
        progress: Progress,
        angles: ConeAngles | None = None,
    ):
        """Keep the parts of the run.

        Args:
            trainer: the fit.
            held_out: photographs for scores.
            identity: of the fit, for checkpoints.
            options: of the run.
            progress: shows how far the fit is.
            angles: scores of the held-out photographs by angle, if asked for.
        """
        self.angles = angles
        self.trainer, self.held_out, self.options, self._progress = trainer, held_out, options, progress
        self._identity = identity
        self.history: list[dict[str, Any]] = []
        self.scores: Scores | None = None
        self.stopped = False
        self._saved_at, self._saving_s = time.monotonic(), 0.0

    def go(self) -> None:
        """Run all remaining steps, or as many as the options allow."""
        self._resume()
        trainer, steps, chunk = self.trainer, self.trainer.settings.steps, 1
        self._progress.begin(trainer.done, steps, trainer.settings.batch_size)
        try:
            while trainer.done < steps and not self.stopped and not self._is_no_better():
                began = time.monotonic()
                before = trainer.done
                trainer.advance(min(self._next_stop(), before + chunk))
                chunk = self._agree(_next_chunk(trainer.done - before, time.monotonic() - began))
                self._between()
            self._end()
        finally:
            self._progress.close()

    def _next_stop(self) -> int:
        """Return the next step after which something is due."""
        options = self.options
        wanted = options.checkpoint_every, options.picture_every, options.callback_every, self._evaluate_every
        every = [n for n in wanted if n is not None]
        return min((self.trainer.done // n + 1) * n for n in every)

    @property
    def _evaluate_every(self) -> int:
        return self.options.evaluate_every or max(1, self.trainer.settings.steps // 10)

    def _between(self) -> None:
        trainer, options = self.trainer, self.options
        done = trainer.done
        self._progress.step(done, self._mean_loss(), trainer.state.count)
        if done % self._evaluate_every == 0 and done < trainer.settings.steps:
            self._evaluate()
        if done % (options.callback_every or self._evaluate_every) == 0 and done < trainer.settings.steps:
            self._call_back()
        if options.picture_every is not None and done % options.picture_every == 0:
            self._write_pictures()
        if self._checkpoint_is_due():
            self._save()
        self.stopped = bool(self._agree(1 if options.stop() else 0))

    def _mean_loss(self) -> float:
        done = self.trainer.done
        return float(self.trainer.counters.losses[max(0, done - 100) : done].mean())

    def _call_back(self) -> None:
        if self.options.callback is not None:
            trainer = self.trainer
            scene = trainer.state.gaussians().detach().clone()
            self.options.callback(FitState(trainer.done, self._mean_loss(), scene, self.scores))

    def _agree(self, number: int) -> int:
        """Return the largest of the processes' numbers: all stop at the same step."""
        return self.trainer.group.largest(number, self.trainer.device)

    @property
    def _folder(self) -> Path | None:
        """The folder that this process writes to."""
        return self.options.folder if self.trainer.group.is_first else None

    def _end(self) -> None:
        """Score the present scene, and write checkpoint and pictures."""
        if not self.history or self.history[-1]["step"] != self.trainer.done or self.scores is None:
            self._evaluate()
        self._call_back()
        self._save()
        self._write_pictures()

    def say(self, line: str) -> None:
        """Print a line, unless progress is off."""
        self._progress.say(line)

    # --- Scores

    def align_held_out(self, gaussians: Gaussians) -> PosedImages | None:
        """Return the held-out photographs for scores of a scene in normalised coordinates; None if there are none.

        Their poses are aligned with the scene if the fit refines poses.
        """
        held, settings = self.held_out, self.trainer.settings
        return align_poses(held, gaussians, settings) if held is not None and settings.poses else held

    def score(self, gaussians: Gaussians, images: PosedImages) -> Scores:
        """Score a scene in normalised coordinates by photographs from align_held_out."""
        settings = self.trainer.settings
        return evaluate(gaussians, images, settings.steady_background, settings.antialiased, settings.exposure)

    def _evaluate(self) -> None:
        trainer, settings = self.trainer, self.trainer.settings
        gaussians = trainer.state.gaussians()
        if (held := self.align_held_out(gaussians)) is None:
            return
        self.scores = scores = self.score(gaussians, held)
        row = {"step": trainer.done, **scores.to_dict(), "gaussians": trainer.state.count}
        del row["views"]
        self.history = [*(old for old in self.history if old["step"] < trainer.done), row]
        self._progress.scores(trainer.done, scores.mean_psnr_db, scores.mean_ssim)
        self._progress.say(
            f"step {trainer.done}: held-out PSNR {scores.mean_psnr_db:.2f} dB, SSIM {scores.mean_ssim:.4f}, "
            f"{trainer.state.count} Gaussians"
            + (", held-out poses aligned" if settings.poses else "")
            + (", colours matched" if settings.exposure else "")
        )
        self.write_scores()

    def write_scores(self, **more: Any) -> None:
        """Write scores.json, if there are a folder and scores. more: further fields."""
        if self._folder is not None and (scores := self.scores) is not None:
            by_angle = {} if self.angles is None else {"angles": self.angles.to_dict(scores)}
            words = describe_protocol(self.trainer.settings)
            content = {"protocol": words, "step": self.trainer.done, **scores.to_dict(), **by_angle, **more}
            content["history"] = self.history
            write_json(content, self._folder / "scores.json")

    def _is_no_better(self) -> bool:
        """Return whether stop_early ends the fit.

        Evaluations at other steps, where a fit was stopped, do not count: the fit ends as if it had not been stopped.
        """
        scores = [row["psnr_db"] for row in self.history if row["step"] % self._evaluate_every == 0]
        if not self.options.stop_early or len(scores) <= _PATIENCE:
            return False
        return max(scores[-_PATIENCE:]) <= max(scores[:-_PATIENCE])

    def _write_pictures(self) -> None:
        if self._folder is not None:
            write_pictures(self._folder, self.trainer, self.held_out or self.trainer.images)

    # --- Checkpoints

    def _resume(self) -> None:
        if self.options.folder is None:
            return
        path = self.options.folder / checkpoint.FILE
        if path.exists():
            self.history = checkpoint.restore(path, self.trainer, self._identity)
            self._progress.say(f"goes on from {path}, {self.trainer.done} of {self.trainer.settings.steps} steps done")

    def _checkpoint_is_due(self) -> bool:
        every = self.options.checkpoint_every
        if every is not None:
            return self.trainer.done % every == 0
        return time.monotonic() - self._saved_at > max(_LEAST_REST_S, self._saving_s / _CHECKPOINT_FRACTION)

    def _save(self) -> None:
        if self._folder is None:
            return
        began = time.monotonic()
        checkpoint.save(self._folder / checkpoint.FILE, self.trainer, self._identity, self.history)
        self._saved_at = time.monotonic()
        self._saving_s = self._saved_at - began


def _next_chunk(steps: int, seconds: float) -> int:
    """Return the number of steps to do next, by the seconds that the last ones took: _CHUNK_S of work."""
    return max(1, min(int(_CHUNK_S * steps / max(seconds, 1e-9)), 2 * steps, _LONGEST_CHUNK))
