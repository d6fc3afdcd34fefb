"""Rigs of frames: turntables, and smooth paths through keyframes."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from lightfield_gs.base.checks import expect, real_number, whole_number
from lightfield_gs.base.errors import InputError, named
from lightfield_gs.base.options import MOST_FRAMES
from lightfield_gs.io.text_files import check_keys, read_mapping, read_object
from lightfield_gs.panels.panel import Panel
from lightfield_gs.panels.rig import Rig

_FULL_TURN_DEG = 360.0
_LIMIT_BYTES = 16 << 20
_RIG_KEYS, _RIG_OPTIONAL = ("world_to_camera", "focal_px", "principal_point_px", "zero_depth"), ("cone_deg",)
_MOST_TURN_DEG = 150.0  # between keyframes: beyond, the direction is ambiguous
_QUATERNION = slice(3, 7)  # of a keyframe's values


def pivot_point(rig: Rig, panel: Panel) -> np.ndarray:
    """Return the point [3] in the middle of the panel on the zero plane, in camera axes, scene units."""
    (fx, fy), (cx, cy) = rig.focal_px, rig.principal_point_px
    slopes = (panel.width_px / 2 - cx) / fx, (panel.height_px / 2 - cy) / fy, 1.0
    return rig.zero_depth * np.array(slopes)


def orbit(rig: Rig, panel: Panel, degrees: float, up: np.ndarray | None = None) -> Rig:
    """Move a rig on a circle round the point in the middle of the panel on the zero plane.

    With Q the rotation about the axis (Rodrigues, 1840) and P that point, [R | t] becomes [R Q^T | t + R (P - Q^T P)].
    At 0 and at 360 degrees that is the rig itself, to the bit.

    Args:
        rig: the rig.
        panel: the panel.
        degrees: angle, to the right where positive.
        up: direction [3] of the axis, in the scene's axes; None: the camera's own vertical.

    Raises:
        InputError: for other values.
    """
    expect("rig", rig, Rig)
    expect("panel", panel, Panel)
    angle = math.radians(math.fmod(real_number("degrees", degrees, -1e9, 1e9), _FULL_TURN_DEG))
    rotation, move = rig.world_to_camera[:3, :3], rig.world_to_camera[:3, 3]
    x, y, z = _unit(-rotation[1] if up is None else up)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    back = np.eye(3) - math.sin(angle) * cross + (1 - math.cos(angle)) * (cross @ cross)
    point = rotation.T @ (pivot_point(rig, panel) - move)
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation @ back, move + rotation @ (point - back @ point)
    return replace(rig, world_to_camera=matrix)


def turntable(
    rig: Rig, panel: Panel, frames: int, degrees: float = _FULL_TURN_DEG, up: np.ndarray | None = None
) -> list[Rig]:
    """Return the rigs of a loop that begins with the rig itself.

    Args:
        rig: the rig.
        panel: the panel.
        frames: number of frames.
        degrees: a multiple of 360 for full turns; else a swing by this angle in all, right, left and back.
        up: see `orbit`.

    Raises:
        InputError: for other values.
    """
    frames = whole_number("frames", frames, 1, MOST_FRAMES)
    degrees = real_number("degrees", degrees, -1e6, 1e6)
    if degrees % _FULL_TURN_DEG == 0:
        angles = [degrees * number / frames for number in range(frames)]
    else:
        angles = [degrees / 2 * math.sin(2 * math.pi * number / frames) for number in range(frames)]
    return [orbit(rig, panel, angle, up) for angle in angles]


def _unit(direction: np.ndarray) -> np.ndarray:
    vector = np.asarray(direction, np.float64)
    length = float(np.linalg.norm(vector)) if vector.shape == (3,) else 0.0
    if not 1e-12 < length < math.inf:
        raise InputError(f"up: expected three finite numbers, not all zero, got {vector.tolist()}")
    return vector / length


class CameraPath:
    """A smooth path through rigs.

    The path interpolates the rotation, the point in the middle of the panel on the zero plane, and its distance. It
    also interpolates the focal lengths, the principal point and the cone. So a camera that looks at one point from two
    sides goes round it, and does not cut the corner.

    Between keyframes each value is a cubic with the slopes of the parabola through three neighbours, so that speeds do
    not jump. Source: Hermite; Catmull and Rom, 1974, of uneven times. A path that ends with its first rig is a loop,
    smooth there as well.

    Args:
        times_s: increasing times of the keyframes, seconds.
        rigs: one for each time, two or more.
        panel: the panel.

    Raises:
        InputError: for other values, and for large turns between keyframes.
    """

    def __init__(self, times_s: Sequence[float], rigs: Sequence[Rig], panel: Panel):
        expect("panel", panel, Panel)
        if len(times_s) != len(rigs) or len(rigs) < 2:
            raise InputError(f"a camera path needs two keyframes or more, each with a time, got {len(rigs)}")
        self.times_s = np.array([real_number("keyframe: time", time, -1e9, 1e9) for time in times_s])
        if (late := np.flatnonzero(np.diff(self.times_s) <= 0)).size:
            raise InputError(
                f"keyframes {late[0]} and {late[0] + 1} are at {self.times_s[late[0]]:g} and "
                f"{self.times_s[late[0] + 1]:g} s; their times must increase"
            )
        self.rigs, self.panel = list(rigs), panel
        self._values = _values(self.rigs, panel)
        self.is_loop = self.rigs[0].to_dict() == self.rigs[-1].to_dict()
        self._slopes = _slopes(self.times_s, self._values, self.is_loop)

    @staticmethod
    def load(path: str | Path, panel: Panel) -> CameraPath:
        """Read a path from a YAML or JSON file.

        `keyframes` is a list of `time` in seconds and `rig`. A rig is its fields, or the name of its file, relative to
        this file's folder.

        Raises:
            InputError: names the file.
        """
        path = Path(path)
        if path.suffix.lower() == ".json":
            data = read_object(path, _LIMIT_BYTES)
            check_keys(data, ("keyframes",), (), str(path))
        else:
            data = read_mapping(path, ("keyframes",), ())
        keyframes = data["keyframes"]
        if not isinstance(keyframes, list):
            raise InputError(f"{path}: keyframes: expected a list, got {type(keyframes).__name__}")
        read = [_keyframe(path, number, keyframe, panel) for number, keyframe in enumerate(keyframes)]
        with named(path):
            return CameraPath([time for time, _ in read], [rig for _, rig in read], panel)

    @property
    def seconds(self) -> float:
        """Duration from the first keyframe to the last."""
        return float(self.times_s[-1] - self.times_s[0])

    def relative_to(self, origin: Sequence[float]) -> CameraPath:
        """Return the same path in coordinates relative to `origin`; see Rig.relative_to."""
        return CameraPath(self.times_s.tolist(), [rig.relative_to(origin) for rig in self.rigs], self.panel)

    def at(self, seconds: float) -> Rig:
        """Return the rig at a time in seconds after the first keyframe.

        It stands still before the first and after the last.

        At a keyframe it is that keyframe's rig, to the bit.
        """
        time = min(max(seconds, 0.0), self.seconds) + self.times_s[0]
        number = min(int(np.searchsorted(self.times_s, time, "right")) - 1, len(self.rigs) - 1)
        if time == self.times_s[number]:
            return self.rigs[number]
        span = self.times_s[number + 1] - self.times_s[number]
        fraction = (time - self.times_s[number]) / span
        rest = 1 - fraction
        value = (
            rest * rest * (1 + 2 * fraction) * self._values[number]
            + fraction * fraction * (1 + 2 * rest) * self._values[number + 1]
            + span * fraction * rest * (rest * self._slopes[number] - fraction * self._slopes[number + 1])
        )
        return self._rig(value, number)

    def frames(self, fps: float, frames: int | None = None) -> list[Rig]:
        """Return the rigs of frames. The last keyframe is included unless the path is a loop.

        Args:
            fps: frames a second, at 0, 1 / fps, 2 / fps ... seconds.
            frames: number of frames, spread over the whole path; takes the place of fps.
        """
        if frames is None:
            # Tolerance of 1e-3 frames, since 0.1 s is not a whole number of frames in binary
            last = self.seconds * fps
            frames, step = math.ceil(last - 1e-3) if self.is_loop else math.floor(last + 1e-3) + 1, 1 / fps
        else:
            step = self.seconds / max(frames if self.is_loop else frames - 1, 1)
        return [self.at(number * step) for number in range(max(frames, 1))]

    def _rig(self, value: np.ndarray, number: int) -> Rig:
        """Return the rig of interpolated values, between the keyframe of this number and the next."""
        rotation = _matrix(value[_QUATERNION])
        zero_depth, fx, fy = np.exp(value[7:10]).tolist()
        centre = float(value[10]), float(value[11])
        cone = float(value[12]) if self.rigs[number].cone_deg is not None else None
        rig = Rig(np.eye(4), (fx, fy), centre, zero_depth, cone)
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = rotation, pivot_point(rig, self.panel) - rotation @ value[:3]
        rig.world_to_camera = matrix
        return rig


def _keyframe(path: Path, number: int, data: Any, panel: Panel) -> tuple[Any, Rig]:
    where = f"{path}: keyframe {number}"
    if not isinstance(data, dict):
        raise InputError(f"{where}: expected time and rig, got {type(data).__name__}")
    check_keys(data, ("time", "rig"), (), where)
    rig = data["rig"]
    if isinstance(rig, str):
        return data["time"], Rig.from_yaml(path.parent / rig, panel)
    if not isinstance(rig, dict):
        raise InputError(f"{where}: rig: expected a file's name or the fields of a rig, got {type(rig).__name__}")
    check_keys(rig, _RIG_KEYS, _RIG_OPTIONAL, f"{where}: rig")
    with named(where):
        return data["time"], Rig(**rig)


def _values(rigs: list[Rig], panel: Panel) -> np.ndarray:
    """Return the interpolated values, [K, 13], with the quaternions' signs for short turns. Raises InputError."""
    if len({rig.cone_deg is None for rig in rigs}) > 1:
        raise InputError("cone_deg must be in the rigs of all keyframes, or of none (the panel's cone)")
    rows: list[np.ndarray] = []
    for number, rig in enumerate(rigs):
        rotation, move = rig.world_to_camera[:3, :3], rig.world_to_camera[:3, 3]
        quaternion = _quaternion(rotation)
        if rows:
            cosine = float(quaternion @ rows[-1][_QUATERNION])
            if (turn := math.degrees(2 * math.acos(min(abs(cosine), 1.0)))) > _MOST_TURN_DEG:
                raise InputError(
                    f"the camera turns by {turn:.0f} degrees between keyframes {number - 1} and {number}; expected at "
                    f"most {_MOST_TURN_DEG:g}: add one between them"
                )
            quaternion = -quaternion if cosine < 0 else quaternion
        lengths = np.log([rig.zero_depth, *rig.focal_px])
        point = rotation.T @ (pivot_point(rig, panel) - move)
        rows.append(np.concatenate([point, quaternion, lengths, rig.principal_point_px, [rig.cone_deg or 0.0]]))
    return np.array(rows)


def _slopes(times: np.ndarray, values: np.ndarray, is_loop: bool) -> np.ndarray:
    """Return the change a second at each keyframe, of the parabola through it and its neighbours.

    One-sided at the ends.
    """
    spans = np.diff(times)[:, None]
    steep = np.diff(values, axis=0) / spans
    inner = (spans[1:] * steep[:-1] + spans[:-1] * steep[1:]) / (spans[1:] + spans[:-1])
    first, last = steep[0], steep[-1]
    if is_loop:
        # A rotation has two quaternions, and after a full turn the path may come back with the other one
        sign = np.ones(values.shape[1])
        sign[_QUATERNION] = np.sign(values[0, _QUATERNION] @ values[-1, _QUATERNION])
        both = (spans[0] * sign * steep[-1] + spans[-1] * steep[0]) / (spans[0] + spans[-1])
        first, last = both, sign * both
    return np.concatenate([first[None], inner, last[None]])


def _quaternion(rotation: np.ndarray) -> np.ndarray:
    """Return the unit quaternion [4] (wxyz) of a rotation [3, 3], as an eigenvector (Bar-Itzhack, 2000)."""
    m = rotation
    votes = np.array(
        [
            [m[0, 0] + m[1, 1] + m[2, 2], m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]],
            [m[2, 1] - m[1, 2], m[0, 0] - m[1, 1] - m[2, 2], m[0, 1] + m[1, 0], m[0, 2] + m[2, 0]],
            [m[0, 2] - m[2, 0], m[0, 1] + m[1, 0], m[1, 1] - m[0, 0] - m[2, 2], m[1, 2] + m[2, 1]],
            [m[1, 0] - m[0, 1], m[0, 2] + m[2, 0], m[1, 2] + m[2, 1], m[2, 2] - m[0, 0] - m[1, 1]],
        ]
    )
    return np.linalg.eigh(votes)[1][:, -1]


def _matrix(quaternion: np.ndarray) -> np.ndarray:
    """Return the rotation [3, 3] of a quaternion (wxyz) of any length but zero."""
    w, x, y, z = quaternion / np.linalg.norm(quaternion)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
