"""What a fit tells while it runs: lines, a bar on a terminal, and TensorBoard."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

from tqdm import tqdm

from lightfield_gs.base.errors import InputError

_BOARD_EVERY_S = 1.0  # scalars cost more time than a quick step has


class Progress:
    """shown: whether anything is printed; folder: TensorBoard's files go below it, None: there are none. Raises
    InputError where TensorBoard is asked for and not installed."""

    def __init__(self, shown: bool, folder: Path | None = None):
        self._shown, self._bar, self._board, self._noted = shown, None, None, 0.0
        self._psnr: float | None = None
        self._folder, self._writer = folder, None if folder is None else _summary_writer()

    def begin(self, done: int, steps: int, views: int) -> None:
        """The clock, and the bar where there is a terminal, of a fit of so many steps with `views` photographs each."""
        self._views, self._first, self._began = views, done, time.monotonic()
        if self._folder is not None and self._writer is not None:
            self._board = self._writer(self._folder / "tensorboard", purge_step=done)
        self._bar = tqdm(
            total=steps, initial=done, unit="step", dynamic_ncols=True, disable=None if self._shown else True
        )

    def step(self, done: int, loss: float, gaussians: int) -> None:
        """Where the fit is. loss: the mean of the last 100 steps."""
        rate = (done - self._first) * self._views / max(time.monotonic() - self._began, 1e-9)
        assert self._bar is not None
        score = {} if self._psnr is None else {"PSNR": f"{self._psnr:.2f}"}
        words: dict[str, Any] = {"loss": f"{loss:.4f}", **score, "Gaussians": gaussians, "images/s": f"{rate:.1f}"}
        self._bar.set_postfix(words, refresh=False)
        self._bar.update(done - self._bar.n)
        if self._board is not None and time.monotonic() - self._noted > _BOARD_EVERY_S:
            self._noted = time.monotonic()
            for name, value in (("loss", loss), ("gaussians", gaussians), ("images_per_second", rate)):
                self._board.add_scalar(f"fit/{name}", value, done)

    def scores(self, done: int, psnr_db: float, ssim: float) -> None:
        """Of the held-out photographs."""
        self._psnr = psnr_db
        if self._board is not None:
            for name, value in (("psnr_db", psnr_db), ("ssim", ssim)):
                self._board.add_scalar(f"held_out/{name}", value, done)

    def say(self, line: str) -> None:
        """A line of its own, above the bar where there is one."""
        if self._shown:
            tqdm.write(line)

    def close(self) -> None:
        for part in (self._bar, self._board):
            if part is not None:
                part.close()


def _summary_writer() -> Any:
    """TensorBoard's class of that name; it needs no more of torch than is there."""
    try:
        from torch.utils.tensorboard import SummaryWriter
    except ImportError:
        raise InputError(
            "tensorboard=True needs tensorboard, which is not installed: pip install 'lightfield-gs[fit]'"
        ) from None
    return SummaryWriter
