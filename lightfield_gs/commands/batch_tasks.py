"""The tasks of a batch: each does what `encode`, `fit` or `video` does, by their own functions."""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lightfield_gs.app.encoding import Encoding, use_threads
from lightfield_gs.app.options import AUTO, EncodeOptions
from lightfield_gs.base.cli_messages import Stopwatch, as_options
from lightfield_gs.base.device import HostCopies
from lightfield_gs.batch.items import Item
from lightfield_gs.batch.manifest import Known, facts
from lightfield_gs.batch.pipeline import DRAWN_AHEAD, Record
from lightfield_gs.batch.run import Worker
from lightfield_gs.commands.options.parser import Parser, join_values, read_options
from lightfield_gs.io.atomic import make_folder

if TYPE_CHECKING:
    from lightfield_gs.app.video import VideoOptions
    from lightfield_gs.commands.options.fit import FitOptions


@dataclass(frozen=True)
class Setup:
    """The options that all items have in common.

    Attributes:
        folder: of the batch, absolute.
        given: options of `encode` other than the defaults, by their names in its arguments.
        fit_words: options of `fit`.
        video_words: options of `video`.
    """

    folder: Path
    given: dict[str, Any]
    fit_words: tuple[str, ...] = ()
    video_words: tuple[str, ...] = ()


def load(setup: Setup, worker: Worker) -> Callable[[tuple[Item, Known | None]], Any]:
    """Load what all items need, and return the function that makes the task of an item."""
    import torch

    use_threads(worker.threads)
    if worker.device == "cuda":
        torch.zeros(1, device="cuda")  # loads what takes seconds
    copies = HostCopies(worker.writers + DRAWN_AHEAD) if worker.device == "cuda" else None
    kinds = {"encode": EncodeTask, "fit": FitTask, "video": VideoTask}
    return lambda pair: kinds[pair[0].command](pair[0], pair[1], setup, worker, copies)


class EncodeTask:
    """Encodes a photo or a scene.

    Args:
        item: the photo or scene.
        known: the manifest's knowledge of the item.
        setup: the options of all items.
        worker: where the process works.
        copies: as Encoding takes them.
    """

    def __init__(
        self, item: Item, known: Known | None, setup: Setup, worker: Worker, copies: HostCopies | None = None
    ) -> None:
        self.item, self.known, self.setup, self.worker, self.copies = item, known, setup, worker, copies
        self.output = setup.folder / item.name
        self.inputs: Record = {}
        self.outputs: Record = {}
        self.status = "done"

    def read(self) -> bool:
        """Read the input, unless it is unchanged since the item was done."""
        if self._is_kept():
            return False
        make_folder(self.output.parent)
        self.begin()
        return True

    def begin(self) -> None:
        """Do the host's part before drawing."""
        self.encoding = Encoding(self.encode_options(self.item.input), Stopwatch(0.0), self.copies)
        self.encoding.read()

    def draw(self) -> None:
        """Draw the image."""
        self.encoding.draw()

    def write(self) -> None:
        """Write the image, and note its hash."""
        self.encoding.write()
        self.note_outputs(*self.encoding.options.outputs())

    def record(self) -> Record:
        """Return status, inputs and outputs, as far as they are known."""
        said = getattr(getattr(self, "encoding", None), "messages", [])
        return {"status": self.status, "inputs": self.inputs, "outputs": self.outputs, "said": [*map(as_options, said)]}

    def files(self) -> list[Path | str | None]:
        """Return the files and folders that the item reads, its input first."""
        return list(self.encode_options(self.item.input).inputs())

    def encode_options(self, source: str | Path) -> EncodeOptions:
        """Return the options of `encode` for the file that becomes the image."""
        words = [*self.item.words, "-o", str(self.output), "--", str(source)]
        return read_options(EncodeOptions, _parsed("encode", words, self._given()))

    def note_outputs(self, *paths: Path | None) -> None:
        """Note the hashes of outputs."""
        for path in paths:
            if path is not None and path.exists():
                name = path.relative_to(self.setup.folder) if path.is_relative_to(self.setup.folder) else path
                self.outputs[name.as_posix()] = facts(path)

    @property
    def is_fresh(self) -> bool:
        """Whether an unfinished output of an earlier run belongs to other options or inputs."""
        known = self.known
        return known is not None and (known.is_other or bool(known.inputs))

    def _given(self) -> dict[str, Any]:
        return self.setup.given | {"device": self.worker.device, "threads": self.worker.threads}

    def _is_kept(self) -> bool:
        """Note the hashes of the inputs; return whether the outputs were made of the same."""
        named = [path for path in self.files() if path not in (None, AUTO)]
        source = named[0]  # the input alone; the readers of the other files describe their faults better
        self.inputs = {str(path): facts(str(path)) for path in named if path == source or Path(str(path)).exists()}
        if self.known is None or not self.known.outputs:
            return False
        now, before = ([held["sha256"] for held in each.values()] for each in (self.inputs, self.known.inputs))
        if now != before:
            return False
        self.status, self.outputs = "kept", self.known.outputs
        return True


class FitTask(EncodeTask):
    """Fits a capture, which gives the scene NAME.ply, and encodes that."""

    def begin(self) -> None:
        """Check the options before the photographs are read."""
        self.scene = self.output.with_suffix(".ply")
        self.fit_options = self._fit_options()

    def draw(self) -> None:
        """Fit the scene, from where an earlier run stopped, and draw it."""
        from lightfield_gs.commands import fit
        from lightfield_gs.fitting.cone import rig_path

        fit.fit_scene(self.fit_options)
        options = self.encode_options(self.scene)
        camera = options.camera
        if camera.rig is None and camera.camera is None and rig_path(self.scene).exists():
            options = replace(options, camera=replace(camera, rig=rig_path(self.scene)))
        self.encoding = Encoding(options, Stopwatch(0.0), self.copies)
        self.encoding.read()
        self.encoding.draw()

    def write(self) -> None:
        """Write the image, and note the hashes of image and scene."""
        from lightfield_gs.fitting.cone import rig_path

        super().write()
        self.note_outputs(self.scene, rig_path(self.scene))

    def files(self) -> list[Path | str | None]:
        """Return the folder of the capture, and the other files that the item reads."""
        source, capture = Path(self.item.input), self._fit_options().capture
        more = self.encode_options(source).inputs()[1:]
        return [
            source if source.is_dir() else source.parent,
            capture.images,
            capture.mask_folder,
            capture.test_list,
            *more,
        ]

    def _fit_options(self) -> FitOptions:
        from lightfield_gs.commands.options.fit import FitOptions

        scene = str(self.output.with_suffix(".ply"))
        words = [*self.setup.fit_words, *self.item.fit_words, "-o", scene, "--", self.item.input]
        options = read_options(FitOptions, _parsed("fit", words, {"device": self.worker.device}))
        return replace(options, report=replace(options.report, fresh=options.report.fresh or self.is_fresh))


class VideoTask(EncodeTask):
    """Makes a video of a scene with moving cameras, or of pictures in a row."""

    def begin(self) -> None:
        """Check the options before the first picture is read."""
        from lightfield_gs.app.panel import load_panel
        from lightfield_gs.app.video import video_target

        self.options = self._video_options()
        self.result = video_target(self.options, load_panel(self.options.panel)).path

    def draw(self) -> None:
        """Draw and write the frames that are missing."""
        from lightfield_gs.commands import video

        video.make_frames(self.options, Stopwatch(time.perf_counter()))

    def write(self) -> None:
        """Note the hashes of the frames."""
        self.note_outputs(self.result)

    def files(self) -> list[Path | str | None]:
        """Return the files and folders that the item reads, its input first."""
        return list(self._video_options().inputs())

    def _video_options(self) -> VideoOptions:
        from lightfield_gs.app.video import VideoOptions

        words = [*self.setup.video_words, *self.item.words, "-o", str(self.output), "--", self.item.input]
        options = read_options(VideoOptions, _parsed("video", words, self._given()))
        return replace(options, overwrite=options.overwrite or self.is_fresh)


@cache
def _parser(command: str) -> Parser:
    parser = Parser(f"lightfield-gs {command}", allow_abbrev=False)
    import_module(f"lightfield_gs.commands.{command}").add_arguments(parser)
    return parser


def _parsed(command: str, words: list[str], given: dict[str, Any]) -> argparse.Namespace:
    """Return the arguments of a command; `given` replaces the defaults of the options that it has."""
    parser = _parser(command)
    known = {action.dest for action in parser._actions}
    return parser.parse_args(
        join_values(words), argparse.Namespace(**{name: value for name, value in given.items() if name in known})
    )


def defaults(command: str) -> dict[str, Any]:
    """Return the defaults of a command's options."""
    return vars(_parsed(command, ["-o", "-", "--", "-"], {}))
