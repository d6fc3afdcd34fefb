"""The window on the panel's screen: every pixel, which screen, and how it ends."""

import ctypes
import importlib.util
import subprocess
import sys
import time
from contextlib import nullcontext

import numpy as np
import pytest
import torch
from command_line import complaint, run
from live_sources import clock, write_film
from screen_cases import edid
from virtual_screen import virtual_screen

from lightfield_gs.base.errors import InputError
from lightfield_gs.panels.panel import Panel
from lightfield_gs.show.window import gl_picture
from lightfield_gs.show.window.cuda_buffer import CudaBuffer, NoInterop
from lightfield_gs.show.window.gl_picture import GlPicture
from lightfield_gs.show.window.monitors import Monitor, choose_monitor, misfit
from lightfield_gs.show.window.native_window import NativeWindow
from lightfield_gs.video.decoding import decode

pytest.importorskip("av", reason="live sources need the extra `video`")
PANEL = Panel.load("toy-8v")
SIZE = PANEL.width_px, PANEL.height_px


@pytest.fixture
def screen(tmp_path, monkeypatch):
    """A screen of the panel's size, on which this process opens windows."""
    pytest.importorskip("glfw", reason="no GLFW, of the extra `window`")
    pytest.importorskip("moderngl", reason="no ModernGL, of the extra `window`")
    with virtual_screen(tmp_path, *SIZE, edid("LKG-P00671", "P00671", SIZE)) as shown:
        monkeypatch.setenv("DISPLAY", shown.display)
        for name in ("WAYLAND_DISPLAY", "XDG_SESSION_TYPE"):
            monkeypatch.delenv(name, raising=False)
        yield shown


def test_live_fills_the_screen_with_the_encoded_picture_until_escape(screen, tmp_path, capsys):
    film = write_film(tmp_path / "film.mkv", [clock(341, (40, 80))] * 5)
    run(capsys, f"video {film} -o {tmp_path}/all.mkv --depth flat --panel toy-8v")
    expected = next(decode(tmp_path / "all.mkv"))
    words = f"live {film} --loop --depth flat --panel toy-8v --window".split()
    command = [sys.executable, "-m", "lightfield_gs", *words]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        try:
            end = time.monotonic() + 60
            while not np.array_equal(screen.pixels(), expected):
                assert time.monotonic() < end and process.poll() is None, "the picture does not fill the screen"
                time.sleep(0.05)
            time.sleep(1.5)  # for a line on how it fares
            screen.press("Escape")
            said = process.communicate(timeout=30)[0]
        finally:
            process.kill()
    assert process.returncode == 0 and "the only screen of the panel's size" in said and "open http" not in said
    assert "frames a second shown" in said and " frames in " in said.splitlines()[-1]


@pytest.fixture
def window(screen):
    """An open window, and what it says."""
    said: list[str] = []
    window = NativeWindow(SIZE, None, said.append)
    window.open()
    yield window, said
    window.close()


def test_q_ends_it(window, screen):
    opened, _ = window
    assert opened.handle_events(0.01)
    screen.press("q")
    assert any(not opened.handle_events(0.1) for _ in range(50))


def check_pictures(window, screen, device: str) -> None:
    random = np.random.default_rng(0)
    for _ in range(3):
        pixels = random.integers(0, 256, (SIZE[1], SIZE[0], 3), np.uint8)
        window.show(torch.from_numpy(pixels).to(device))
        np.testing.assert_array_equal(screen.pixels(), pixels)


@pytest.mark.parametrize(
    "device", ["cpu", pytest.param("cuda", marks=pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA"))]
)
def test_pictures_are_shown_to_the_bit(window, screen, device):
    check_pictures(window[0], screen, device)


def test_pictures_of_cuda_pass_through_the_host_where_its_driver_refuses(window, screen, monkeypatch):
    """By pictures of the CPU, taken as those of CUDA: by four bytes a pixel."""
    monkeypatch.setattr(gl_picture, "cuda_driver", lambda: Driver(refuses="cuGraphicsGLRegisterBuffer"))
    monkeypatch.setattr(gl_picture, "device_guard", lambda device: nullcontext())
    monkeypatch.setattr(torch.cuda, "synchronize", lambda device: None)
    opened, said = window
    opened._picture = GlPicture(opened._context, SIZE, torch.device("cuda"), said.append)
    assert "through the host" in said[-1] and "(cuGraphicsGLRegisterBuffer: CUDA_ERROR_SO (999))" in said[-1]
    check_pictures(opened, screen, "cpu")


def test_a_window_of_another_size_shows_the_upper_left_corner(screen):
    said: list[str] = []
    window = NativeWindow((SIZE[0] - 32, SIZE[1] + 50), (0, 0), said.append)
    window.open()
    try:
        pixels = np.random.default_rng(0).integers(0, 256, (SIZE[1] + 50, SIZE[0] - 32, 3), np.uint8)
        window.show(torch.from_numpy(pixels))
        shown = screen.pixels()
    finally:
        window.close()
    np.testing.assert_array_equal(shown[:, :-32], pixels[: SIZE[1]])
    assert not shown[:, -32:].any()
    assert "where the display is" in said[0] and "it has 480 x 240 pixels and the panel 448 x 290" in said[1]


class Driver:
    """Stands in for CUDA's driver, whose memory is the host's.

    Args:
        memory: To which the buffer is mapped.
        refuses: The call that fails.
    """

    def __init__(self, memory: np.ndarray | None = None, refuses: str = ""):
        self._memory, self._refuses, self.calls = memory, refuses, list[str]()

    def __getattr__(self, name):
        def call(*values) -> int:
            self.calls.append(name)
            if name == self._refuses:
                return 999
            if name == "cuGetErrorName":
                values[1]._obj.value = b"CUDA_ERROR_SO"
            elif name == "cuGraphicsResourceGetMappedPointer_v2":
                values[0]._obj.value = self._memory.ctypes.data
            elif name == "cuMemcpyDtoDAsync_v2":
                ctypes.memmove(*(one.value for one in values[:3]))
            return 0

        return call


def test_cuda_writes_into_a_mapped_buffer():
    memory, source = np.zeros(12, np.uint8), np.arange(10, dtype=np.uint8)
    driver = Driver(memory)
    buffer = CudaBuffer(7, driver)
    buffer.write(source.ctypes.data, source.nbytes, 0)
    buffer.release()
    assert memory.tolist() == [*range(10), 0, 0]
    order = ["GLRegisterBuffer", "MapResources", "ResourceGetMappedPointer_v2", "UnmapResources", "UnregisterResource"]
    assert [name for name in driver.calls if "Graphics" in name] == [f"cuGraphics{name}" for name in order]
    broken = Driver(memory, refuses="cuMemcpyDtoDAsync_v2")
    with pytest.raises(NoInterop, match="cuMemcpyDtoDAsync_v2: CUDA_ERROR_SO"):
        CudaBuffer(7, broken).write(source.ctypes.data, source.nbytes, 0)
    assert broken.calls[-1] == "cuGraphicsUnmapResources"  # the buffer is OpenGL's again


def test_the_panels_screen_is_found_by_its_place_and_else_by_its_size():
    laptop, panel, other = (
        Monitor("a", (0, 0), (1920, 1080), 60),
        Monitor("b", (1920, 0), SIZE),
        Monitor("c", (0, 9), SIZE),
    )
    for monitors, position, number, reason in (
        ([laptop, panel, other], (0, 9), 2, "where the display is"),
        ([laptop, panel], None, 1, "only screen of the panel's size"),
        ([laptop, panel], (5, 5), 1, "only screen of the panel's size"),
        ([laptop, panel, other], None, 0, "a, 1920 x 1080 pixels at 60 Hz: the desktop's first"),
    ):
        found, line = choose_monitor(monitors, position, SIZE)
        assert found == number and reason in line
    assert misfit(SIZE, SIZE) is None
    with pytest.raises(InputError, match="no screen"):
        choose_monitor([], None, SIZE)


def test_what_a_window_needs_is_said(tmp_path, capsys, monkeypatch):
    film = write_film(tmp_path / "film.mkv", [clock(341, (40, 80))])
    line = f"live {film} --depth flat --panel toy-8v --window"
    assert "--host and --port" in complaint(capsys, f"{line} --port 8000")
    monkeypatch.setitem(sys.modules, "moderngl", None)
    assert "pip install 'lightfield-gs[window]'" in complaint(capsys, line)
    monkeypatch.undo()
    if sys.platform == "linux" and importlib.util.find_spec("glfw") and importlib.util.find_spec("moderngl"):
        for name in ("DISPLAY", "WAYLAND_DISPLAY", "XDG_SESSION_TYPE"):
            monkeypatch.delenv(name, raising=False)
        assert "leave it out for the page in a browser" in complaint(capsys, line)
