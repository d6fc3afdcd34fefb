"""The motion of cameras while their rolling shutters read photographs, as a transforms.json has it.

Source: the fields of Seiskari et al., "Gaussian Splatting on the Move", 2024 (3dgs-deblur), also of nerfstudio's forks.
    rolling_shutter_time: seconds from the top of a photograph to its bottom. The pose is that of the middle.
    camera_linear_velocity: of the camera's centre, scene units a second, in the camera axes of transform_matrix.
    camera_angular_velocity: of the camera, radians a second, in the same axes.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from lightfield_gs.base.assumptions import assume
from lightfield_gs.base.checks import counted, real_number, shown
from lightfield_gs.base.errors import InputError
from lightfield_gs.io.captures.photograph import PosedPhotograph
from lightfield_gs.io.captures.pinhole import TO_OPENCV

_TIME, _LINEAR, _ANGULAR = "rolling_shutter_time", "camera_linear_velocity", "camera_angular_velocity"
_LONGEST_S = 1.0  # readouts take a thirtieth of a second or less
_MOST_TURN = np.radians(60)  # during one


def read_readout(where: str, fields: dict[str, Any]) -> np.ndarray | None:
    """Return the turn and the way of a frame's camera during the readout, float64 [2,3]; None without a readout.

    The turn is the rotation vector of world to camera, radians. The way is of the camera's centre, scene units. Both
    are in OpenCV's camera axes at the pose.

    Args:
        where: file and frame, for messages.
        fields: of the frame, and at the top of its file.

    Raises:
        InputError: names the field.
    """
    if fields.get(_TIME) is None or (fields.get(_LINEAR) is None and fields.get(_ANGULAR) is None):
        return None
    seconds = real_number(f"{where}.{_TIME}, seconds,", fields[_TIME], 0, _LONGEST_S)
    linear, angular = (_vector(f"{where}.{key}", fields.get(key)) for key in (_LINEAR, _ANGULAR))
    motion = seconds * np.stack([-angular, linear]) @ TO_OPENCV[:3, :3]
    if (turn := float(np.linalg.norm(motion[0]))) > _MOST_TURN:
        raise InputError(
            f"{where}.{_ANGULAR}: expected a turn of {np.degrees(_MOST_TURN):.0f} degrees at most in {seconds:g} s, "
            f"got {np.degrees(turn):.4g}: velocities are in radians a second"
        )
    return motion if motion.any() else None


def _vector(where: str, value: Any) -> np.ndarray:
    """Return a vector of a frame, zeros where there is none."""
    if value is None:
        return np.zeros(3)
    if not isinstance(value, list) or len(value) != 3:
        raise InputError(f"{where}: expected 3 numbers, got {shown(value)}")
    return np.array([real_number(f"{where}[{axis}]", number, -1e9, 1e9) for axis, number in enumerate(value)])


def note_readouts(path: Path, fields: Sequence[dict[str, Any]], posed: Sequence[PosedPhotograph]) -> None:
    """Note what is taken of the rolling shutters of photographs, and what their files do not tell."""
    times = [frame[_TIME] for frame in fields if frame.get(_TIME)]
    rolling = [one for one in posed if one.readout is not None]
    if not rolling:
        if times and not any(key in frame for frame in fields for key in (_LINEAR, _ANGULAR)):
            assume(
                f"{path} has {_TIME}, but no {_LINEAR} or {_ANGULAR}: photographs count as taken at one instant: "
                "give the velocities to draw rolling shutters"
            )
        return
    words = counted(len(rolling), "photograph", len(posed), "are drawn by rolling shutters")
    bent = any(one.distortion is not None and any(one.distortion.coefficients) for one in rolling)
    lens = "; rows count as straight, though the lens bends them" if bent else ""
    assume(
        f"{path}: {words}, read from top to bottom in {1000 * float(times[0]):.3g} ms with the pose in the middle "
        f"({_TIME}); leave that field out to draw them still{lens}"
    )
