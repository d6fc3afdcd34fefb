"""The records of a run: losses.jsonl, scores.jsonl, TensorBoard, a progress bar."""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import Any

from tqdm import tqdm

_BOARD_EVERY = 10  # steps; scalars cost TensorBoard more time than a small network's step has to spare


class RunLog:
    """The log of a run, kept by one of its processes; on the others (writes=False) every method does nothing.

    losses.jsonl has a line per step: step, loss, gradient_norm, learning_rate and the terms of the loss. scores.jsonl
    has a line per validation: step (how many steps had been taken) and the scores. TensorBoard has the same (of
    every tenth step) and steps_per_second. scored: step of the last validation, 0 before the first. total_steps: 0
    where it is not known.
    """

    def __init__(self, output: Path, step: int, total_steps: int, writes: bool) -> None:
        self._writes, self._first, self._step, self.scored = writes, step, step, 0
        self._begun = self._marked = time.monotonic()
        self._marked_step = step
        if not writes:
            return
        from torch.utils.tensorboard import SummaryWriter

        self._lines = open(output / "losses.jsonl", "a", buffering=1)
        self._score_lines = open(output / "scores.jsonl", "a+", buffering=1)
        self._score_lines.seek(0)
        self.scored = max((json.loads(line)["step"] for line in self._score_lines), default=0)
        self._board = SummaryWriter(output / "tensorboard", purge_step=step)
        self._progress = tqdm(total=total_steps or None, initial=step, unit="step", dynamic_ncols=True)

    def __enter__(self) -> RunLog:
        return self

    def __exit__(self, *_: Any) -> None:
        if self._writes:
            for part in (self._lines, self._score_lines, self._board, self._progress):
                part.close()

    def record(self, values: dict[str, float]) -> None:
        """Record a step: its number and its report."""
        if not self._writes:
            return
        self._lines.write(json.dumps(values) + "\n")
        self._step = int(values["step"]) + 1
        for name, value in values.items() if self._step % _BOARD_EVERY == 0 else ():
            if name != "step":
                self._board.add_scalar(f"train/{name}", value, self._step - 1)
        self._progress.set_postfix(loss=f"{values['loss']:.4f}", lr=f"{values['learning_rate']:.1e}", refresh=False)
        self._progress.update()

    def mark_speed(self) -> None:
        """Records the steps per second since the last call; for a moment when no step is under way."""
        now = time.monotonic()
        if self._writes and self._step > self._marked_step:
            speed = (self._step - self._marked_step) / (now - self._marked)
            self._board.add_scalar("train/steps_per_second", speed, self._step)
        self.resume_clock()

    def resume_clock(self) -> None:
        """Leaves the time since mark_speed out: it went into saving and scoring."""
        self._marked, self._marked_step = time.monotonic(), self._step

    def scores(self, step: int, values: dict[str, float]) -> None:
        """Scores of the averaged weights after so many steps."""
        if self._writes:
            self.scored = step
            self._score_lines.write(json.dumps({"step": step, **values}) + "\n")
            self.say(f"step {step}: " + json.dumps(values))
            for name, value in values.items():
                self._board.add_scalar(f"validation/{name}", value, step)

    def say(self, line: str) -> None:
        """A line on the terminal."""
        if self._writes:
            self._progress.write(line)

    def say_speed(self) -> None:
        """How many steps this process has done, and how fast, everything included."""
        seconds, steps = time.monotonic() - self._begun, self._step - self._first
        self.say(f"{steps} steps in {seconds:.1f} s, {steps / max(seconds, 1e-9):.2f} steps/s")
