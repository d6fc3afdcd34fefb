"""A browser of its own on the display: full screen, pixel for pixel, and started again where it ends."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
import webbrowser
from pathlib import Path

# By what they are called on Linux, where they lie on macOS, and below which folders on Windows
_NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "microsoft-edge", "brave-browser")
_APPS = ("Google Chrome", "Chromium", "Microsoft Edge", "Brave Browser")
_PROGRAMS = (
    r"Google\Chrome\Application\chrome.exe",
    r"Microsoft\Edge\Application\msedge.exe",
    r"BraveSoftware\Brave-Browser\Application\brave.exe",
)
_FOLDERS = ("PROGRAMFILES", "PROGRAMFILES(X86)", "LOCALAPPDATA")


def find_browser() -> str | None:
    """Return a browser that can be told where to stand, one of Chromium's kin; None without one."""
    if sys.platform == "darwin":
        paths = [Path("/Applications") / f"{name}.app" / "Contents" / "MacOS" / name for name in _APPS]
        return next((str(path) for path in paths if path.is_file()), None)
    if sys.platform == "win32":
        folders = [Path(os.environ[name]) for name in _FOLDERS if os.environ.get(name)]
        return next((str(root / name) for name in _PROGRAMS for root in folders if (root / name).is_file()), None)
    return next(filter(None, map(shutil.which, _NAMES)), None)


def browser_command(
    browser: str,
    url: str,
    profile: str,
    position: tuple[int, int] | None,
    size_px: tuple[int, int] | None,
    is_kiosk: bool,
) -> list[str]:
    """Return the command by which a browser shows an address full screen on the screen at this place.

    One pixel of the page is one of the screen, whatever the scaling of the system.

    Args:
        browser: The program.
        url: The address.
        profile: A folder for its settings, so that it is not another window of a running browser.
        position: Left and top edge of the screen on the desktop; None: the usual screen.
        size_px: Of the screen, for systems without a window manager; None: not known.
        is_kiosk: Whether it has no way out but its end.
    """
    command = [browser, f"--app={url}", f"--user-data-dir={profile}", "--no-first-run", "--no-default-browser-check"]
    command += ["--kiosk"] if is_kiosk else ["--start-fullscreen"]
    command += ["--force-device-scale-factor=1", "--force-color-profile=srgb", "--noerrdialogs", "--disable-infobars"]
    command += ["--autoplay-policy=no-user-gesture-required", "--disable-session-crashed-bubble"]
    if position is not None or is_kiosk:
        command.append("--window-position={},{}".format(*(position or (0, 0))))
    if size_px is not None:
        # Without a window manager, Chromium takes a pixel off a window that is as large as the screen
        command.append(f"--window-size={size_px[0] + 1},{size_px[1] + 1}")
    if hasattr(os, "geteuid") and os.geteuid() == 0:
        command.append("--no-sandbox")  # else it refuses to run as root
    return command


class DisplayBrowser:
    """A browser on the display.

    Args:
        position: See browser_command, also for the others.
        size_px: Likewise.
        is_kiosk: Likewise.

    Attributes:
        program: None where none is found: then the usual browser is asked.
    """

    def __init__(
        self, position: tuple[int, int] | None, size_px: tuple[int, int] | None = None, is_kiosk: bool = False
    ):
        self.program = find_browser()
        self._place, self._is_kiosk = (position, size_px), is_kiosk
        self._process: subprocess.Popen | None = None
        self._profile: tempfile.TemporaryDirectory | None = None

    def open(self, url: str) -> None:
        """Open the browser at an address."""
        if self.program is None:
            webbrowser.open(url)
            return
        if self._profile is None:
            self._profile = tempfile.TemporaryDirectory(prefix="lightfield-gs-", ignore_cleanup_errors=True)
        command = browser_command(self.program, url, self._profile.name, *self._place, self._is_kiosk)
        nowhere = subprocess.DEVNULL
        self._process = subprocess.Popen(command, stdin=nowhere, stdout=nowhere, stderr=nowhere)

    def is_open(self) -> bool:
        """Return whether it was opened, and runs."""
        return self._process is not None and self._process.poll() is None

    def has_ended(self) -> bool:
        """Return whether it was opened, and is closed or has crashed."""
        return self._process is not None and self._process.poll() is not None

    def close(self) -> None:
        """End the browser, and remove its settings."""
        if self._process is not None and self.is_open():
            self._process.terminate()
            try:
                self._process.wait(5)
            except subprocess.TimeoutExpired:
                self._process.kill()
                self._process.wait(5)
        if self._profile is not None:
            self._profile.cleanup()
            self._profile = None
