"""Numbered scenes in a row: one framing for all, for `video` and for the page of `view`."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass, replace

from lightfield_gs.app.cameras import CameraChoice, read_camera
from lightfield_gs.app.options import LookOptions, RenderOptions, SceneOptions
from lightfield_gs.app.scene import LoadedScene, check_scene_options, frame_scene, settle_render
from lightfield_gs.app.shots import Shots
from lightfield_gs.app.video import DEFAULT_FPS, VideoOptions
from lightfield_gs.base.cli_messages import Stopwatch, note
from lightfield_gs.base.errors import InputError
from lightfield_gs.base.system import free_host_memory
from lightfield_gs.io.scenes.files import SceneFile, read_scene
from lightfield_gs.panels.panel import Panel
from lightfield_gs.panels.rig import Rig
from lightfield_gs.scene.gaussians import Gaussians
from lightfield_gs.video.scene_sequence import SceneReader, SceneSequence, find_scene_sequence

_HELD = 4  # a fourth of the free memory holds scenes of a page


@dataclass
class FramedScenes:
    """Scenes in a row, and the rig of all.

    Attributes:
        reader: reads them; whoever opens it closes it.
        scene: a sample of all, by which they are framed, on the device.
        rig: in the coordinates of the scenes.
        messages: lines on decisions.
    """

    reader: SceneReader
    scene: LoadedScene
    rig: Rig
    messages: list[str]


def frame_scenes(
    sequence: SceneSequence,
    options: SceneOptions,
    choice: CameraChoice,
    render: RenderOptions,
    look: LookOptions,
    panel: Panel,
    device: str,
    holds_many: bool = False,
) -> FramedScenes:
    """Open scenes in a row, and frame a sample of all of them.

    Args:
        sequence: the files.
        options: the options of the input, a folder.
        choice: the cameras that are asked for.
        render: anti-aliasing and background, as far as they are given; else the first file's count for all.
        look: changes of the rig.
        panel: the panel to fill.
        device: where the sample goes.
        holds_many: whether scenes stay in memory, as far as it is free, to be shown again.

    Raises:
        InputError: a scene cannot be read, or the options do not suit.
    """

    def read(path) -> SceneFile:
        return read_scene(path, skip_invalid=options.skip_invalid, time=options.time, lod=options.lod)

    first = sequence.files[0]
    reader = SceneReader(sequence, read, (free_host_memory() or 0) // _HELD if holds_many else 0)
    for words in reader.first.notes:
        note(f"{first}: {words}")
    sample = reader.sample()
    file = replace(reader.first, gaussians=sample)
    settings, messages = settle_render(render, first, file)
    scene = LoadedScene(first, sample.to(device), settings, file, None, [*messages, sequence.describe()])
    rig, how = frame_scene(choice, look, scene, panel)
    return FramedScenes(reader, scene, rig, [*scene.messages, *how])


def scene_film_shots(options: VideoOptions, panel: Panel, device: str, watch: Stopwatch, stack: ExitStack) -> Shots:
    """Return the shots of scenes in a row, one frame each. Raises InputError."""
    motion, look, source = options.motion, options.look, options.scene.input
    sequence = find_scene_sequence(source)
    assert sequence is not None
    for name in ("turntable", "degrees", "path", "reframe"):
        if getattr(motion, name) not in (None, False):
            raise InputError(f"--{name} is not for scenes in a row, which {source} holds; leave it out")
    check_scene_options(replace(options.scene, input=sequence.files[0]), options.camera)
    choice = read_camera(options.camera, panel)
    framed = frame_scenes(sequence, options.scene, choice, options.render, look, panel, device)
    reader, rig = stack.enter_context(framed.reader), framed.rig

    def take(numbers: list[int]) -> Iterator[tuple[int, Gaussians, Rig]]:
        for place, number in enumerate(numbers):
            yield number, reader.at(number, numbers[place + 1 :]).to(device), rig

    of_file = framed.scene.in_file(rig)
    job = {
        "input": source.name,
        "device": options.device,
        "scenes": sequence.digest(),
        "rig": of_file.to_dict(),
        "lod": options.scene.lod,
        "time": options.scene.time,
        "skip_invalid": options.scene.skip_invalid,
    }
    watch.lap("scenes")
    return Shots(
        min(len(sequence.files), motion.frames or len(sequence.files)),
        motion.fps or DEFAULT_FPS,
        False,
        take,
        lambda number: of_file,
        framed.scene.render,
        job,
        framed.messages,
        reader.differences,
    )
