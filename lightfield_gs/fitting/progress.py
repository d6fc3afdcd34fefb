"""Progress of a fit: lines, a bar on a terminal, TensorBoard, and pictures."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from tqdm import tqdm

from lightfield_gs.base.arrays import to_bytes
from lightfield_gs.base.errors import InputError
from lightfield_gs.fitting.evaluate import render_and_photo
from lightfield_gs.fitting.posed_images import PosedImages
from lightfield_gs.fitting.trainer import Trainer
from lightfield_gs.io.atomic import make_folder
from lightfield_gs.io.images import write_image

_BOARD_EVERY_S = 1.0  # scalars take longer than a quick step
_DIFFERENCE = 4.0  # factor of the differences in pictures


class Progress:
    """Tells how far a fit is."""

    def __init__(self, shown: bool, folder: Path | None = None):
        """Prepare the output.

        Args:
            shown: print lines and a bar.
            folder: write scalars for TensorBoard below it; None: write none.

        Raises:
            InputError: TensorBoard is asked for and not installed.
        """
        self._shown, self._bar, self._board, self._noted = shown, None, None, 0.0
        self._psnr: float | None = None
        self._folder, self._writer = folder, None if folder is None else _summary_writer()

    def begin(self, done: int, steps: int, batch_size: int) -> None:
        """Start the clock and the bar of a fit with `done` of `steps` steps behind it."""
        self._batch_size, self._first, self._began = batch_size, done, time.monotonic()
        if self._folder is not None and self._writer is not None:
            self._board = self._writer(self._folder / "tensorboard", purge_step=done)
        self._bar = tqdm(
            total=steps, initial=done, unit="step", dynamic_ncols=True, disable=None if self._shown else True
        )

    def step(self, done: int, loss: float, gaussians: int) -> None:
        """Show the steps done, the mean loss of the last 100 steps and the number of Gaussians."""
        rate = (done - self._first) * self._batch_size / max(time.monotonic() - self._began, 1e-9)
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
        """Show the mean scores of the held-out photographs."""
        self._psnr = psnr_db
        if self._board is not None:
            for name, value in (("psnr_db", psnr_db), ("ssim", ssim)):
                self._board.add_scalar(f"held_out/{name}", value, done)

    def say(self, line: str) -> None:
        """Print a line, above the bar if there is one."""
        if self._shown:
            tqdm.write(line)

    def close(self) -> None:
        for part in (self._bar, self._board):
            if part is not None:
                part.close()


def write_pictures(folder: Path, trainer: Trainer, images: PosedImages) -> None:
    """Write folder/pictures/<step>.png and folder/last.png, of the middle one of `images`."""
    settings = trainer.settings
    gaussians, background = trainer.state.gaussians(), settings.steady_background
    image, photo, weights = render_and_photo(gaussians, images, images.count // 2, background, settings.antialiased)
    pixels = to_bytes(side_by_side(image, photo, weights)).cpu().numpy()
    for path in (make_folder(folder / "pictures") / f"{trainer.done:07d}.png", folder / "last.png"):
        write_image(path, pixels)


def side_by_side(image: Tensor, photo: Tensor, weights: Tensor) -> Tensor:
    """Return [H,3W,3] in 0..1: image and photo [H,W,3], and 4 x their difference times weights [H,W]."""
    return torch.cat([image, photo, (image - photo).abs() * weights[..., None] * _DIFFERENCE], 1).clamp(0, 1)


def _summary_writer() -> Any:
    """Return TensorBoard's class of that name."""
    try:
        from torch.utils.tensorboard import SummaryWriter
    except ImportError:
        raise InputError(
            "tensorboard=True needs tensorboard, which is not installed: pip install 'lightfield-gs[fit]'"
        ) from None
    return SummaryWriter
