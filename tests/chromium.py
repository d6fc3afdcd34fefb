"""A headless Chromium, driven through its debugging pipe (Chrome DevTools Protocol) by the standard library alone."""

import base64
import io
import json
import os
import shutil
import subprocess
import time
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

NAMES = ("chromium", "chromium-browser", "google-chrome", "chrome")
# WebGPU without a GPU, and a canvas of it on the screen
SWIFTSHADER = ("--enable-unsafe-webgpu", "--use-webgpu-adapter=swiftshader", "--enable-features=Vulkan")
SWIFTSHADER_CANVAS = (*SWIFTSHADER, "--use-vulkan=swiftshader", "--use-angle=swiftshader", "--ignore-gpu-blocklist")


def find() -> str:
    """The path of a Chromium; skips the test where there is none."""
    path = next(filter(None, map(shutil.which, NAMES)), None)
    if path is None:
        pytest.skip(f"no Chromium found (looked for {', '.join(NAMES)})")
    return path


class Browser:
    """One page of a Chromium with a window of this size (CSS pixels)."""

    def __init__(self, folder: Path, width: int, height: int, scale: float = 1.0, gpu: tuple[str, ...] = ()):
        """gpu: options of the GPU; none: it has none."""
        # The browser reads commands from its descriptor 3 and answers on 4
        (read, self._to), (self._from, write) = os.pipe(), os.pipe()
        options = [
            "--headless=new",
            "--no-sandbox",
            *(gpu or ("--disable-gpu",)),
            "--hide-scrollbars",
            "--remote-debugging-pipe",
            f"--user-data-dir={folder / 'chromium'}",
            f"--window-size={width},{height}",
            f"--screen-info={{{round(width * scale)}x{round(height * scale)} devicePixelRatio={scale}}}",
            f"--force-device-scale-factor={scale}",
        ]
        plumbing = f'exec "$@" 3<&{read} 4>&{write}'
        self._process = subprocess.Popen(
            ["bash", "-c", plumbing, "bash", find(), *options, "about:blank"],
            pass_fds=(read, write),
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        os.close(read)
        os.close(write)
        self._answers, self._count, self._session = b"", 0, None
        target = next(t for t in self.call("Target.getTargets")["targetInfos"] if t["type"] == "page")["targetId"]
        self._session = self.call("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        self.call("Page.enable")

    def call(self, method: str, **params):
        self._count += 1
        message = {"id": self._count, "method": method, "params": params}
        if self._session:
            message["sessionId"] = self._session
        os.write(self._to, json.dumps(message).encode() + b"\0")
        while True:
            answer = self._next()
            if answer.get("id") == self._count:
                assert "error" not in answer, answer
                return answer["result"]

    def _next(self):
        while b"\0" not in self._answers:
            chunk = os.read(self._from, 1 << 20)
            assert chunk, "the browser has ended"
            self._answers += chunk
        message, self._answers = self._answers.split(b"\0", 1)
        return json.loads(message)

    def open(self, url: str) -> None:
        self.call("Page.navigate", url=url)

    def run(self, script: str):
        """The value of an expression of JavaScript; promises are waited for."""
        result = self.call("Runtime.evaluate", expression=script, awaitPromise=True, returnByValue=True)
        assert "exceptionDetails" not in result, result["exceptionDetails"]
        return result["result"].get("value")

    def wait(self, condition: str, timeout_s: float = 30) -> None:
        """Until an expression of JavaScript is true."""
        end = time.monotonic() + timeout_s
        while not self.run(f"Boolean({condition})"):
            assert time.monotonic() < end, f"in vain: {condition}"
            time.sleep(0.03)

    def mouse(self, kind: str, x: float, y: float, **more) -> None:
        self.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, **more)

    def screenshot(self) -> np.ndarray:
        """Return the picture of the window, uint8 [h, w, 3], in pixels of the screen."""
        png = base64.b64decode(self.call("Page.captureScreenshot", format="png")["data"])
        return np.asarray(Image.open(io.BytesIO(png)).convert("RGB"))

    def resize(self, width: int, height: int, scale: float = 1.0) -> None:
        """Make window and screen this large, in CSS pixels."""
        size = dict(width=width, height=height, screenWidth=width, screenHeight=height)
        self.call("Emulation.setDeviceMetricsOverride", **size, deviceScaleFactor=scale, mobile=False)

    def prefer(self, **features: str) -> None:
        """Set what media queries ask for: prefer(prefers_color_scheme="dark")."""
        named = [{"name": name.replace("_", "-"), "value": value} for name, value in features.items()]
        self.call("Emulation.setEmulatedMedia", features=named)

    def close(self) -> None:
        self._process.terminate()
        self._process.wait(10)
        os.close(self._to)
        os.close(self._from)
