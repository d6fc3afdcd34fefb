"""The titles of groups of options in --help-all, and how the options of a function come to stand under one."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from functools import partial
from typing import Any

Add = Callable[..., argparse.Action]

OWN = "input and output"
DISPLAY = "display"
VIEWPOINT = "viewpoint and cameras"
LOOK = "depth and framing"
EYES = "pictures for two eyes"
TRACKING = "eyes that are tracked"
PHOTO = "photo of an object"
DEPTH = "photo with depth"
SCENE = "file of Gaussians"
DRAWING = "drawing"
STORAGE = "file of the picture"
MOTION = "motion"
PAGE = "page in the browser"
MESSAGES = "messages"


def in_group(add: Add, group: str) -> Add:
    """Return a function that adds options as `add` does, under the title of a group."""
    return partial(add, group=group)


def rarely(add: Add) -> Add:
    """Return a function that adds options as `add` does, but leaves them out of the short --help."""

    def add_rare(*names: str, short: str | None = None, **arguments: Any) -> argparse.Action:
        return add(*names, **arguments)

    return add_rare
