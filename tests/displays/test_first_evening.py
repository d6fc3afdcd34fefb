"""The first evening with a display: from a telephone's photo to the whole screen, on a screen of X with an EDID."""

import io
import json
import os
import signal
import subprocess
import sys
import time
import urllib.request
from contextlib import contextmanager

import chromium
import numpy as np
import pytest
from command_line import heed_ctrl_c
from PIL import Image
from plain_photos import picture, save
from screen_cases import calibration, edid
from virtual_screen import VirtualScreen, virtual_screen

from lightfield_gs import Panel
from lightfield_gs.io.images import read_info

pytestmark = [pytest.mark.slow, pytest.mark.not_sanitized]
SIZE = (768, 1024)
PROGRAM = [sys.executable, "-m", "lightfield_gs"]
_PATIENCE_S = 120


@pytest.fixture
def evening(tmp_path):
    """The screen, and how an owner runs programs: beside a photo, with a calibration where Bridge keeps it."""
    exif = Image.Exif()
    exif[0x0112] = 6  # held upright
    save(tmp_path / "photo.jpg", picture(), exif=exif)
    folder, programs, screen = (tmp_path / name for name in (".config/Looking Glass", "bin", "screen"))
    for made in (folder, programs, screen):
        made.mkdir(parents=True)
    (folder / "visual.json").write_text(json.dumps(calibration("LKG-P00671", SIZE)))
    browser = programs / "chromium"
    browser.write_text(f'#!/bin/sh\nexec {chromium.find()} --test-type "$@"\n')  # no bar that warns of root
    browser.chmod(0o755)
    own = {name: value for name, value in os.environ.items() if name != "LIGHTFIELD_GS_DISPLAYS"}
    own |= {"HOME": str(tmp_path), "PATH": f"{programs}{os.pathsep}{os.environ['PATH']}", "BROWSER": "true"}
    with virtual_screen(screen, *SIZE, edid("LKG-P00671", "P00671", SIZE)) as shown:
        yield shown, dict(cwd=tmp_path, env={**own, "DISPLAY": shown.display}, text=True, stdout=subprocess.PIPE)


@contextmanager
def running(*words: str, how: dict):
    """A command that runs until Ctrl-C, and the address of its page."""
    with subprocess.Popen([*PROGRAM, *words], preexec_fn=heed_ctrl_c, **how) as process:
        try:
            yield next(line for line in process.stdout if line.startswith("open ")).split()[1]
            assert process.poll() is None
            process.send_signal(signal.SIGINT)
            process.communicate(timeout=_PATIENCE_S)
        finally:
            process.kill()


def wait_for(screen: VirtualScreen, expected: np.ndarray) -> None:
    end = time.monotonic() + _PATIENCE_S
    while not np.array_equal(screen.pixels(), expected):
        assert time.monotonic() < end, "the picture does not fill the screen"
        time.sleep(0.1)


def test_from_a_photo_to_the_whole_screen_in_two_commands(evening, tmp_path):
    screen, how = evening
    said = subprocess.run([*PROGRAM, "encode", "photo.jpg", "-o", "out.png"], check=True, **how).stdout
    assert "Looking Glass Portrait LKG-P00671, which is connected" in said
    assert said.splitlines()[-1] == "next: lightfield-gs show out.png"
    panel = json.loads(read_info(tmp_path / "out.png").metadata["panel"])
    assert panel == Panel.from_looking_glass(calibration("LKG-P00671", SIZE)).to_dict()
    expected = np.asarray(Image.open(tmp_path / "out.png").convert("RGB"))
    assert np.ptp(expected) > 100
    with running("show", "out.png", how=how):
        wait_for(screen, expected)


def test_the_button_of_the_page_brings_its_picture_to_the_display(evening):
    screen, how = evening
    with running("view", "photo.jpg", how=how) as url:
        scene = json.loads(urllib.request.urlopen(f"{url}scene.json").read())
        request = urllib.request.Request(f"{url}display", b"", {"X-Token": scene["token"]})
        assert scene["displays"] and urllib.request.urlopen(request).status == 204
        native = urllib.request.urlopen(f"{url}export/native.png").read()
        wait_for(screen, np.asarray(Image.open(io.BytesIO(native)).convert("RGB")))
