"""The program where its standard streams are closed, full or not read, and where its working folder is gone."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from command_line import PANEL

from lightfield_gs.io.images import write_image

pytestmark = pytest.mark.not_sanitized
RUN = f"{sys.executable} -m lightfield_gs"
needs_full = pytest.mark.skipif(not os.path.exists("/dev/full"), reason="there is no /dev/full here")


def shell(line: str, folder: Path) -> subprocess.CompletedProcess:
    """Runs a line of the shell."""
    return subprocess.run(["bash", "-c", line], cwd=folder, capture_output=True, text=True, timeout=120)


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """A folder with the picture of a panel."""
    folder = tmp_path_factory.mktemp("streams")
    write_image(folder / "native.png", np.full((PANEL.height_px, PANEL.width_px, 3), 90, np.uint8))
    PANEL.to_yaml(folder / "panel.yaml")
    return folder


@pytest.mark.parametrize(
    "streams, code, words",
    [
        (">&-", 0, ""),
        ("<&- >&- 2>&-", 0, ""),
        ("| head -0; exit ${PIPESTATUS[0]}", 0, ""),
        pytest.param(">/dev/full", 2, "cannot write to standard output: No space left on device", marks=needs_full),
        pytest.param(">/dev/full 2>&-", 2, "", marks=needs_full),
    ],
)
def test_work_is_done_whatever_becomes_of_what_is_said(folder, streams, code, words):
    (folder / "eye.png").unlink(missing_ok=True)
    done = shell(f"{RUN} simulate native.png --panel panel.yaml --eye 0,0,600 -o eye.png {streams}", folder)
    assert (done.returncode, done.stdout) == (code, "") and (folder / "eye.png").exists()
    assert done.stderr.count("\n") == bool(words) and words in done.stderr


@pytest.mark.parametrize("streams", [">&-", "2>&-", pytest.param("2>/dev/full", marks=needs_full)])
def test_what_is_wrong_has_its_exit_code_though_nobody_can_be_told(folder, streams):
    done = shell(f"{RUN} info nothing.png {streams}", folder)
    assert done.returncode == 2 and "Traceback" not in done.stderr


@needs_full
def test_help_that_cannot_be_written_is_said(folder):
    done = shell(f"{RUN} --help >/dev/full", folder)
    assert done.returncode == 2 and done.stderr.count("\n") == 1


def test_a_working_folder_that_is_gone_is_named(folder):
    done = shell(f"mkdir gone; cd gone; rmdir ../gone; {RUN} info {folder}/native.png", folder)
    assert done.returncode == 2 and done.stdout == ""
    assert done.stderr == (
        "lightfield-gs: error: the working folder has been removed: change to one that is there (cd)\n"
    )
