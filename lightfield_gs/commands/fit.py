"""`lightfield-gs fit`: a scene from posed photographs."""

from __future__ import annotations

import argparse
import os
import signal
import sys
import threading
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any

from lightfield_gs.app.panel import panel_words
from lightfield_gs.app.scene import check_scene_path
from lightfield_gs.base.checks import counted
from lightfield_gs.base.cli_messages import say_next
from lightfield_gs.base.device import choose_device
from lightfield_gs.base.errors import InputError, named
from lightfield_gs.base.options import POSED_FRAMES, Device, Masks
from lightfield_gs.base.system import stop_signals
from lightfield_gs.commands.options.fit import CaptureOptions, FitOptions, read_names
from lightfield_gs.commands.options.parser import read_options
from lightfield_gs.io.atomic import check_folder, make_folder

if TYPE_CHECKING:
    from lightfield_gs.fitting.fit import FitResult
    from lightfield_gs.io.captures.capture import Capture

_NUMBERS = (signal.SIGINT, *stop_signals())


def run(args: argparse.Namespace) -> int:
    """Fit args.input into args.output; return 128 and the signal where one stopped it. Raises InputError."""
    return fit_scene(read_options(FitOptions, args))


def fit_scene(options: FitOptions) -> int:
    """Fit a capture and write its scene; return 128 and the signal where one stopped it. Raises InputError."""
    output, report = options.output, options.report
    check_scene_path(output)
    folder = check_folder(output.with_suffix(".fit") if report.run is None else report.run)
    options = options.complete(choose_device(options.device))
    source = options.capture
    held_out = None if source.test_list is None else read_names(source.test_list)
    options.cone.check()
    _check_choice(source, options.optimisation.masks)

    from lightfield_gs.base.torchrun import is_first
    from lightfield_gs.fitting.fit import fit

    if options.quick and is_first():
        print(options.describe_quick(), flush=True)
    with Interrupts() as interrupts:
        capture = _read_capture(source, folder, options.device)
        if held_out is not None:
            with named(source.test_list):
                capture.split(None, held_out)
        result = fit(
            capture,
            test_every=source.test_every,
            test_names=held_out,
            device=options.device,
            photos_on=options.photos_on,
            moments_on=options.moments_on,
            folder=folder,
            fresh=report.fresh,
            checkpoint_every=report.checkpoint_every,
            evaluate_every=report.evaluate_every,
            picture_every=report.picture_every,
            stop_early=report.stop_early,
            tensorboard=report.tensorboard,
            stop=lambda: interrupts.number is not None,
            **options.cone.arguments(),
            **options.optimisation.arguments(),
        )
        if is_first():
            result.save(output)
    if is_first():
        _say(options, result, folder)
    return 128 + interrupts.number if result.stopped and interrupts.number is not None else 0


def _check_choice(options: CaptureOptions, masks: Masks) -> None:
    """Raise InputError where options of --sfm are given without it, or masks of people beside others."""
    alone = {
        "--frames": options.frames,
        "--keep-blurred": options.keep_blurred,
        "--mask-people": options.mask_people,
        "--pose-model": options.pose_model,
    }
    if not options.sfm and (given := [name for name, value in alone.items() if value]):
        raise InputError(f"{given[0]} takes --sfm, which poses photographs: those of a capture have poses")
    if options.mask_people and masks == "alpha":
        raise InputError("--mask-people takes no --masks alpha: the scene would be transparent behind people")
    if options.mask_people and options.mask_folder is not None:
        raise InputError("--mask-people makes the masks: leave out --mask-folder, or paint people in its masks")


def _read_capture(options: CaptureOptions, folder: Path, device: Device) -> Capture:
    """Read the capture; with --sfm find its cameras first."""
    from lightfield_gs.io.captures.capture import folder_in, read_capture
    from lightfield_gs.pose_estimation.find_poses import find_poses, folder_of_photographs
    from lightfield_gs.pose_estimation.options import PoseOptions

    where, images, masks = options.input, options.images, options.mask_folder
    if options.sfm:
        if images is not None:
            raise InputError("--sfm: CAPTURE itself is the folder of photographs; leave out --images")
        where, source = folder / "sfm", options.input.absolute()
        if masks is not None:
            masks = folder_in("masks", source, masks).absolute()
        if not (where / "sparse/0").exists():
            if "RANK" in os.environ:
                raise InputError("--sfm: find the cameras in one process first: leave torchrun out, or use pycolmap")
            choice = PoseOptions(
                options.frames or POSED_FRAMES, options.keep_blurred, options.mask_people, options.pose_model, device
            )
            find_poses(source, make_folder(where), choice, lambda words: print(words, flush=True), masks)
        images = folder_of_photographs(source, where)
    return read_capture(where, images=images, masks=masks, scale=options.scale, longest_px=options.longest_px)


def _say(options: FitOptions, result: FitResult, folder: Path) -> None:
    """Print the scores, the files, and how to go on."""
    from lightfield_gs.fitting.evaluate import describe_protocol

    if result.scores is not None:
        print(f"{result.scores.table()}\n{describe_protocol(result.settings)}")
        _say_angles(result)
    print(f"{options.output}: {result.gaussians.count} Gaussians after {result.steps} of {result.settings.steps} steps")
    words: list[object] = ["encode", options.output, "-o", options.output.with_suffix(".png")]
    scores = ", scores.json" if result.scores is not None else ""
    print(f"{folder}: checkpoint{scores} and last.png, a view beside its photograph")
    if result.display is not None:
        from lightfield_gs.panels.stored_rigs import rig_path

        rig = rig_path(options.output)
        words += ["--rig", rig, *panel_words(_panel(options.cone.cone))]
        print(f"{rig}: the rig in the capture's coordinates")
        if result.pruning is None:
            print("stopped: nothing was left out yet of what the panel does not show")
    elif result.front is not None:
        print(f"front: {result.front.cone.name}, which most photographs are near (another side: encode --turn)")
    if result.stopped:
        print("stopped: the same command goes on from the checkpoint")
    else:
        say_next(*words)


def _say_angles(result: FitResult) -> None:
    """Print scores by angle where there is a cone, and in the panel's frame before and after pruning."""
    if result.angles is None or result.scores is None:
        return
    print(f"from {result.angles.centre}, cone of {result.angles.cone_deg:g} degrees:")
    print(result.angles.table(result.scores))
    if (framed := result.window_scores) is not None:
        whole, pruned, count = framed.whole, framed.pruned, len(framed.whole.names)
        print(
            f"in the panel's frame, {framed.coverage:.0%} of {counted(count, 'photograph')} inside its cone: PSNR "
            f"{whole.mean_psnr_db:.2f} dB, SSIM {whole.mean_ssim:.4f}; with the {result.gaussians.count} Gaussians "
            f"that it shows {pruned.mean_psnr_db:.2f} dB, {pruned.mean_ssim:.4f}"
        )


def _panel(cone: str | None) -> str:
    """Return the --panel of `encode` that shows the panel of --cone."""
    from lightfield_gs.base.options import DEFAULT_PANEL
    from lightfield_gs.fitting.cone import is_angle

    return DEFAULT_PANEL if cone is None or is_angle(cone) else cone


class Interrupts:
    """Catches Ctrl-C and SIGTERM: the first one asks the command to stop in good order, a second one aborts it.

    `number` is the first signal that came, or None. Outside the main thread signals go their usual way.
    """

    def __init__(self) -> None:
        self.number: int | None = None
        self._usual: dict[int, Any] = {}

    def __enter__(self) -> Interrupts:
        if threading.current_thread() is threading.main_thread():
            self._usual = {number: signal.signal(number, self._came) for number in _NUMBERS}
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._usual.items():
            signal.signal(number, handler)

    def _came(self, number: int, frame: FrameType | None) -> None:
        if self.number is not None:
            raise KeyboardInterrupt
        self.number = number
        print("\nstops after this step and writes the scene; once more to abort", file=sys.stderr, flush=True)
