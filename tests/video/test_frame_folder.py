"""Frames in a folder: kept where they belong to the same job, refused where not, whole after any end."""

import json

import numpy as np
import pytest

from lightfield_gs import InputError
from lightfield_gs.io.images import read_image, read_info
from lightfield_gs.video.frame_folder import MANIFEST, FrameFolder, frame_name, job_hash

JOB = {"scene": "abc", "panel": {"views": 8}}


def picture(number: int) -> np.ndarray:
    return np.full((4, 6, 3), number, np.uint8)


def fill(folder, numbers=None, count=5, job=JOB, **options) -> FrameFolder:
    with FrameFolder(folder, count, job, fps=25, **options) as sink:
        for number in sink.missing if numbers is None else numbers:
            sink.put(number, picture(number))
    return sink


def contents(folder) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def test_frames_and_manifest(tmp_path):
    sink = fill(tmp_path / "new" / "frames", metadata=lambda number: {"frame": str(number)})
    assert sorted(path.name for path in sink.path.iterdir()) == [*map(frame_name, range(5)), MANIFEST]
    assert (read_image(sink.path / frame_name(3), as_stored=True) == 3).all()
    assert read_info(sink.path / frame_name(3)).metadata == {"frame": "3"}
    manifest = json.loads((sink.path / MANIFEST).read_text())
    assert manifest["frames"] == 5 and manifest["fps"] == 25 and manifest["job"] == job_hash(JOB)


def test_what_is_there_is_kept(tmp_path):
    whole = contents(fill(tmp_path / "whole").path)
    part = tmp_path / "part"
    fill(part, [0, 3])
    (part / ".frame-000001.1234.png").write_bytes(b"what a killed run left")
    stamp = (part / frame_name(3)).stat().st_mtime_ns
    sink = fill(part)
    assert sink.missing == [1, 2, 4] and (part / frame_name(3)).stat().st_mtime_ns == stamp
    assert contents(part) == whole
    assert fill(part).missing == []


def test_another_job_is_refused_and_said_which(tmp_path):
    fill(tmp_path, [0, 1])
    before = contents(tmp_path)
    for job in ({**JOB, "panel": {"views": 9}}, {"scene": "abc"}):
        with pytest.raises(InputError, match="holds frames of another job: panel differ"):
            FrameFolder(tmp_path, 5, job, fps=25)
    assert contents(tmp_path) == before
    assert fill(tmp_path, [2], job={"other": 1}, overwrite=True).missing == list(range(5))
    assert sorted(path.name for path in tmp_path.iterdir()) == [frame_name(2), MANIFEST]


@pytest.mark.parametrize("manifest", [None, "[]", "{"])
def test_frames_of_nobody_are_refused(tmp_path, manifest):
    fill(tmp_path, [0])
    (tmp_path / MANIFEST).unlink()
    if manifest:
        (tmp_path / MANIFEST).write_text(manifest)
    with pytest.raises(InputError, match="without a frames.json|expected an object|not JSON"):
        FrameFolder(tmp_path, 5, JOB, fps=25)


def test_a_frame_that_cannot_be_written_ends_it(tmp_path):
    with pytest.raises(InputError, match="cannot write"), FrameFolder(tmp_path, 99, JOB, fps=25, writers=1) as sink:
        for _ in range(99):
            sink.put(0, picture(0)[..., :2])


def test_an_interrupt_leaves_whole_frames(tmp_path):
    with pytest.raises(KeyboardInterrupt), FrameFolder(tmp_path, 5, JOB, fps=25) as sink:
        sink.put(0, picture(0))
        raise KeyboardInterrupt
    assert sorted(path.name for path in tmp_path.iterdir()) == [frame_name(0), MANIFEST]
    assert fill(tmp_path).missing == [1, 2, 3, 4]
