"""A window over the whole of the panel's screen, at the screen's own rate."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from types import ModuleType
from typing import Any

from torch import Tensor

from lightfield_gs.base.errors import InputError
from lightfield_gs.show.window.gl_picture import GlPicture
from lightfield_gs.show.window.monitors import Monitor, choose_monitor, misfit

_TITLE = "lightfield-gs"
_INSTALL = "pip install 'lightfield-gs[window]'"


class NativeWindow:
    """A window that shows pictures pixel for pixel, without scaling, tearing or a change of colours.

    All calls but `wake` are of the main thread, as systems demand.

    Args:
        size_px: Width and height of the panel.
        position: Of the panel's display on the desktop; None where not known.
        say: Called with lines on what was settled, and on what does not fit.

    Raises:
        InputError: The extra is not installed, or there is no screen.
    """

    def __init__(self, size_px: tuple[int, int], position: tuple[int, int] | None, say: Callable[[str], None]):
        self._size_px, self._position, self._say = size_px, position, say
        self._picture: GlPicture | None = None
        self._gl, self._glfw = _libraries()
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # the error is told below
            if self._glfw.init():
                return
        raise InputError(
            f"--window: there is no screen to open it on ({_last_error(self._glfw)}); start it on the desktop, or "
            "leave it out for the page in a browser"
        )

    def open(self) -> None:
        """Open it. Raises InputError where the desktop has no screen, or no OpenGL 3.3."""
        glfw = self._glfw
        there = glfw.get_monitors()
        monitors = [_monitor(glfw, one) for one in there]
        number, line = choose_monitor(monitors, self._position, self._size_px)
        mode = glfw.get_video_mode(there[number])
        for hint, value in (
            (glfw.CONTEXT_VERSION_MAJOR, 3),
            (glfw.CONTEXT_VERSION_MINOR, 3),
            (glfw.OPENGL_PROFILE, glfw.OPENGL_CORE_PROFILE),
            (glfw.OPENGL_FORWARD_COMPAT, True),  # macOS has no other
            (glfw.DEPTH_BITS, 0),
            (glfw.STENCIL_BITS, 0),
            (glfw.SRGB_CAPABLE, False),
            (glfw.AUTO_ICONIFY, False),  # the owner works on another screen meanwhile
            # Those of the desktop: the screen keeps its mode
            (glfw.RED_BITS, mode.bits.red),
            (glfw.GREEN_BITS, mode.bits.green),
            (glfw.BLUE_BITS, mode.bits.blue),
            (glfw.REFRESH_RATE, mode.refresh_rate or glfw.DONT_CARE),
        ):
            glfw.window_hint(hint, value)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            self._window = glfw.create_window(*mode.size, _TITLE, there[number], None)
        if not self._window:
            raise InputError(
                f"--window: no window of OpenGL 3.3 can be opened on {monitors[number].name} ({_last_error(glfw)}); "
                "update the graphics driver, or leave it out for the page in a browser"
            )
        glfw.make_context_current(self._window)
        glfw.swap_interval(1)  # a picture is taken between two of the screen's own, so that it never tears
        glfw.set_input_mode(self._window, glfw.CURSOR, glfw.CURSOR_HIDDEN)
        glfw.set_key_callback(self._window, self._heed_key)
        glfw.set_window_refresh_callback(self._window, lambda window: self._present())
        self._context = self._gl.create_context(context=_Functions(glfw))
        self._say(line)
        if (words := misfit(glfw.get_framebuffer_size(self._window), self._size_px)) is not None:
            self._say(words)
        self._present()

    def handle_events(self, longest_s: float) -> bool:
        """Handle keys and the like, or wait for them or for `wake`; return False once the user has ended it."""
        self._glfw.wait_events_timeout(longest_s)
        return not self._glfw.window_should_close(self._window)

    def wake(self) -> None:
        """End the wait of handle_events; from any thread."""
        self._glfw.post_empty_event()

    def show(self, image: Tensor) -> None:
        """Show a picture, uint8 [H, W, 3] of any device; return when the screen has it."""
        if self._picture is None:
            self._picture = GlPicture(self._context, self._size_px, image.device, self._say)
        self._picture.take(image)
        self._present()

    def close(self) -> None:
        """Close the window."""
        if self._picture is not None:
            self._picture.release()
        self._glfw.terminate()

    def _present(self) -> None:
        width, height = self._glfw.get_framebuffer_size(self._window)
        self._context.screen.use()
        self._context.viewport = 0, 0, width, height
        self._context.clear()
        if self._picture is not None:
            self._picture.draw(height)
        self._glfw.swap_buffers(self._window)
        self._context.finish()  # else drivers would queue pictures, each of them late

    def _heed_key(self, window: Any, key: int, code: int, action: int, modifiers: int) -> None:
        # A key has the name of its letter, and the number of its place
        if action == self._glfw.PRESS and (
            key == self._glfw.KEY_ESCAPE or _text(self._glfw.get_key_name(key, code)) == "q"
        ):
            self._glfw.set_window_should_close(window, True)


class _Functions:
    """Finds the functions of OpenGL for ModernGL by GLFW, which knows the kind of the context, GLX, EGL or another."""

    def __init__(self, glfw: ModuleType):
        self._glfw = glfw

    def load_opengl_function(self, name: str) -> int:
        """Return the address of a function; 0 without one."""
        return self._glfw.get_proc_address(name) or 0

    def __enter__(self) -> _Functions:
        return self

    def __exit__(self, *error: object) -> None:
        pass

    def release(self) -> None:
        """Do nothing: the window owns the context."""


def _libraries() -> tuple[ModuleType, ModuleType]:
    """Return ModernGL and GLFW. Raises InputError where they are not installed, or their library is not there."""
    try:
        import glfw
        import moderngl
    except ImportError as error:  # also GLFW's own, where its library cannot be loaded
        raise InputError(f"--window needs GLFW and ModernGL ({error}): {_INSTALL}") from None
    return moderngl, glfw


def _last_error(glfw: ModuleType) -> str:
    """Return what the library said last."""
    return _text(glfw.get_error()[1]) or "no reason given"


def _monitor(glfw: ModuleType, handle: Any) -> Monitor:
    mode = glfw.get_video_mode(handle)
    return Monitor(
        _text(glfw.get_monitor_name(handle)), tuple(glfw.get_monitor_pos(handle)), tuple(mode.size), mode.refresh_rate
    )


def _text(words: bytes | str | None) -> str:
    """Return words of the library, "" for none: some versions give them as bytes."""
    return words.decode(errors="replace") if isinstance(words, bytes) else words or ""
