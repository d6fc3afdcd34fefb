"""The tasks of a batch: each does what `encode`, `fit` or `video` does, by their own functions."""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cache, cached_property
from importlib import import_module
from pathlib import Path
from typing import Any

import torch

from lightfield_gs.app.encoding import Encoding, use_threads
from lightfield_gs.app.options import AUTO, FLAT, EncodeOptions, PanelOptions
from lightfield_gs.app.panel import load_panel
from lightfield_gs.app.video import VideoOptions, video_target
from lightfield_gs.base.cli_messages import Stopwatch, as_options
from lightfield_gs.base.device import HostCopies
from lightfield_gs.base.errors import named
from lightfield_gs.batch.items import Item, split
from lightfield_gs.batch.manifest import Known, Record, facts
from lightfield_gs.batch.run import DRAWN_AHEAD, Task, Worker, now
from lightfield_gs.batch.shards import Shard
from lightfield_gs.commands.fit import fit_scene
from lightfield_gs.commands.options.fit import FitOptions
from lightfield_gs.commands.options.parser import Parser, join_values, read_options
from lightfield_gs.commands.video import make_frames
from lightfield_gs.io.atomic import make_folder
from lightfield_gs.panels.stored_rigs import rig_path


@dataclass(frozen=True)
class BatchOptions:
    """Many inputs that become images or videos.

    Attributes:
        input: folder or list of the inputs.
        output: folder of the batch.
        given: options of `encode` other than the defaults, by name.
        panel: the panel of all images.
        fit_options, video_options: options of `fit` and `video`, as words of a command line.
        format: suffix of images, without the dot.
        processes, devices, threads: see `choose_workers`.
        shard: number of this process, and how many there are. None: all items.
        overwrite, check: see `make_plan`.
        since: beginning of this batch, as the manifest writes it.
    """

    input: Path
    output: Path
    given: dict[str, Any]
    panel: PanelOptions
    fit_options: tuple[str, ...] = ()
    video_options: tuple[str, ...] = ()
    format: str = "png"
    processes: int | None = None
    devices: str | None = None
    threads: int | None = None
    shard: Shard | None = None
    overwrite: bool = False
    check: bool = False
    since: str = field(default_factory=now)


def read_batch_options(args: argparse.Namespace) -> BatchOptions:
    """Return the parsed arguments of `batch` as options. Raises InputError."""
    usual = vars(_parse("encode", ["-o", "-", "--", "-"], {})).items()
    taken, own = vars(args).copy(), ("input", "output", "threads", "quiet", "stats")
    taken["given"] = {name: taken[name] for name, value in usual if name not in own and taken.get(name, value) != value}
    for name in ("fit_options", "video_options"):
        with named(f"--{name.replace('_', '-')}"):
            taken[name] = split(taken[name])
    return read_options(BatchOptions, argparse.Namespace(**taken))


def load(options: BatchOptions, worker: Worker) -> Callable[[tuple[Item, Known | None]], Task]:
    """Load the resources of all items, and return the function that makes the task of an item."""
    use_threads(worker.threads)
    if worker.device == "cuda":
        torch.zeros(1, device="cuda")  # loads what takes seconds
    copies = HostCopies(worker.writers + DRAWN_AHEAD) if worker.device == "cuda" else None
    kinds = {"encode": EncodeTask, "fit": FitTask, "video": VideoTask}
    return lambda pair: kinds[pair[0].command](*pair, options, worker, copies)


@dataclass
class EncodeTask:
    """Encodes a photo or a scene.

    Attributes:
        item: the photo or scene.
        known: the manifest's knowledge of the item.
        batch: the options of all items.
        worker: where the process works.
        copies: as Encoding takes them.
        inputs, outputs: facts of files, by their names.
        status: of the item in the manifest.
    """

    item: Item
    known: Known | None
    batch: BatchOptions
    worker: Worker
    copies: HostCopies | None = None
    inputs: Record = field(default_factory=dict)
    outputs: Record = field(default_factory=dict)
    status: str = "done"
    encoding: Encoding | None = None

    def __post_init__(self) -> None:
        self.folder = Path(os.path.abspath(self.batch.output))
        self.output = self.folder / self.item.name
        self.given = self.batch.given | {"device": self.worker.device, "threads": self.worker.threads}
        # Whether an unfinished output of an earlier run belongs to other options or inputs
        self.is_fresh = self.known is not None and (self.known.is_other or bool(self.known.inputs))

    def read(self) -> bool:
        """Read the input, unless it is unchanged since the item was done."""
        if self._is_kept():
            return False
        make_folder(self.output.parent)
        self.begin()
        return True

    def begin(self) -> None:
        """Do the host's part before drawing."""
        self._read_scene(self.encode_options(self.item.input))

    def draw(self) -> None:
        """Draw the image."""
        assert self.encoding is not None
        self.encoding.draw()

    def write(self) -> None:
        """Write the image, and note its hash."""
        assert self.encoding is not None
        self.encoding.write()
        self.note_outputs(*self.encoding.options.outputs())

    def record(self) -> Record:
        """Return status, inputs and outputs, as far as they are known."""
        messages = [] if self.encoding is None else [*map(as_options, self.encoding.messages)]
        return {"status": self.status, "inputs": self.inputs, "outputs": self.outputs, "said": messages}

    def files(self) -> list[Path | str | None]:
        """Return the files and folders that the item reads, its input first."""
        return list(self.encode_options(self.item.input).inputs())

    def encode_options(self, source: str | Path) -> EncodeOptions:
        """Return the options of `encode` for the file that becomes the image."""
        words = [*self.item.words, "-o", str(self.output), "--", str(source)]
        return read_options(EncodeOptions, _parse("encode", words, self.given))

    def note_outputs(self, *paths: Path | None) -> None:
        """Note the hashes of outputs."""
        for path in paths:
            if path is not None and path.exists():
                name = path.relative_to(self.folder) if path.is_relative_to(self.folder) else path
                self.outputs[name.as_posix()] = facts(path)

    def _read_scene(self, options: EncodeOptions) -> None:
        self.encoding = Encoding(options, Stopwatch(0.0), self.copies)
        self.encoding.read()

    def _is_kept(self) -> bool:
        """Note the hashes of the inputs; return whether the outputs were made of the same."""
        files = [path for path in self.files() if path not in (None, AUTO, FLAT)]
        source = files[0]  # the input alone; the readers of the other files describe their faults better
        self.inputs = {str(path): facts(str(path)) for path in files if path == source or Path(str(path)).exists()}
        if self.known is None or not self.known.outputs:
            return False
        new, old = ([held["sha256"] for held in each.values()] for each in (self.inputs, self.known.inputs))
        if new != old:
            return False
        self.status, self.outputs = "kept", self.known.outputs
        return True


class FitTask(EncodeTask):
    """Fits a capture, which gives the scene NAME.ply, and encodes that."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self.scene = self.output.with_suffix(".ply")

    @cached_property
    def fit_options(self) -> FitOptions:
        """The options of `fit`."""
        words = [*self.batch.fit_options, *self.item.fit_words, "-o", str(self.scene), "--", self.item.input]
        options = read_options(FitOptions, _parse("fit", words, {"device": self.worker.device}))
        return replace(options, report=replace(options.report, fresh=options.report.fresh or self.is_fresh))

    def begin(self) -> None:
        """Leave all to `draw`; the options were checked with the files."""

    def draw(self) -> None:
        """Fit the scene, from where an earlier run stopped, and draw it."""
        fit_scene(self.fit_options)
        options = self.encode_options(self.scene)
        camera = options.camera
        if camera.rig is None and camera.camera is None and rig_path(self.scene).exists():
            options = replace(options, camera=replace(camera, rig=rig_path(self.scene)))
        self._read_scene(options)
        super().draw()

    def write(self) -> None:
        """Write the image, and note the hashes of image and scene."""
        super().write()
        self.note_outputs(self.scene, rig_path(self.scene))

    def files(self) -> list[Path | str | None]:
        """Return the folder of the capture, and the other files that the item reads."""
        source, capture = Path(self.item.input), self.fit_options.capture
        folder = source if source.is_dir() else source.parent
        more = self.encode_options(source).inputs()[1:]
        return [folder, capture.images, capture.mask_folder, capture.test_list, *more]


class VideoTask(EncodeTask):
    """Makes a video of a scene with moving cameras, or of pictures in a row."""

    @cached_property
    def options(self) -> VideoOptions:
        """The options of `video`."""
        words = [*self.batch.video_options, *self.item.words, "-o", str(self.output), "--", self.item.input]
        options = read_options(VideoOptions, _parse("video", words, self.given))
        return replace(options, overwrite=options.overwrite or self.is_fresh)

    def begin(self) -> None:
        """Check the options before the first picture is read."""
        self.result = video_target(self.options, load_panel(self.options.panel)).path

    def draw(self) -> None:
        """Draw and write the frames that are missing."""
        make_frames(self.options, Stopwatch(time.perf_counter()))

    def write(self) -> None:
        """Note the hashes of the frames."""
        self.note_outputs(self.result)

    def files(self) -> list[Path | str | None]:
        """Return the files and folders that the item reads, its input first."""
        return list(self.options.inputs())


@cache
def _parser(command: str) -> Parser:
    parser = Parser(f"lightfield-gs {command}", allow_abbrev=False)
    import_module(f"lightfield_gs.commands.arguments.{command}").add_arguments(parser)
    return parser


def _parse(command: str, words: list[str], given: dict[str, Any]) -> argparse.Namespace:
    """Return the arguments of a command; `given` replaces the defaults of the options that it has."""
    parser = _parser(command)
    known = {action.dest for action in parser._actions}
    return parser.parse_args(
        join_values(words), argparse.Namespace(**{name: value for name, value in given.items() if name in known})
    )
