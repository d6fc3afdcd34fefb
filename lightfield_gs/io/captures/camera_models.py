"""Lens distortion: Brown's polynomial and the camera models of COLMAP.

Source of Brown's polynomial: Brown, "Close-range camera calibration", 1971, in the form of OpenCV's calib3d. A lens
shows a point (x, y) at depth 1 at

    x (1 + k1 r^2 + k2 r^4 + k3 r^6 + k4 r^8) + 2 p1 x y + p2 (r^2 + 2 x^2)
    y (1 + k1 r^2 + k2 r^4 + k3 r^6 + k4 r^8) + p1 (r^2 + 2 y^2) + 2 p2 x y,   r^2 = x^2 + y^2,

both in units of the focal length. OpenCV's own k4 belongs to another, rational model, FULL_OPENCV.

Source of the models: COLMAP's documentation, "Camera Models", for parameters and their order. It cites:
    OPENCV, FULL_OPENCV: Brown, as above.
    FOV: Devernay and Faugeras, "Straight lines have to be straight", 2001.
    THIN_PRISM_FISHEYE: Weng et al., "Camera calibration with distortion models and accuracy evaluation", 1992.
    RAD_TAN_THIN_PRISM_FISHEYE: Project Aria's "FisheyeRadTanThinPrism".
    DIVISION: Fitzgibbon, "Simultaneous linear estimation of multiple view geometry and lens distortion", 2001.
    EUCM: Khomutenko et al., "An enhanced unified camera model", 2016.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

BROWN_COEFFICIENTS = ("k1", "k2", "k3", "k4", "p1", "p2")
Formula = Callable[..., np.ndarray]  # points [...,2] at depth 1 and coefficients -> distorted points [...,2]


def distort_brown(points: np.ndarray, coefficients: np.ndarray) -> np.ndarray:
    """Distort points by Brown's polynomial.

    Args:
        points: [...,2] float64, x/z and y/z in camera axes.
        coefficients: [6], in the order of BROWN_COEFFICIENTS.

    Returns:
        Distorted points, [...,2] float64, in units of the focal length.
    """
    x, y = points[..., 0], points[..., 1]
    k1, k2, k3, k4, p1, p2 = coefficients
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * (k3 + r2 * k4)))
    return np.stack(
        [x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x), y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y], -1
    )


def describe_coefficients(coefficients: np.ndarray) -> str:
    """Return the coefficients that are not zero as text."""
    return ", ".join(f"{name} {value:g}" for name, value in zip(BROWN_COEFFICIENTS, coefficients) if value)


@dataclass(frozen=True)
class CameraModel:
    """One camera model of COLMAP.

    Attributes:
        number: its id in binary files.
        focal_lengths: how many focal lengths precede the principal point, 1 or 2.
        coefficients: names of the distortion coefficients after the principal point.
        formula: maps points to distorted points; None: a pinhole. Of a fisheye its points are flat: their radius is the
            angle from the axis in radians, not its tangent, so that they may lie beyond 90 degrees.
        fisheye: whether the model is one.
    """

    number: int
    focal_lengths: int
    coefficients: tuple[str, ...] = ()
    formula: Formula | None = None
    fisheye: bool = False

    @property
    def parameters(self) -> int:
        """The number of parameters of a camera of this model."""
        return self.focal_lengths + 2 + len(self.coefficients)


def _squared(points: np.ndarray) -> np.ndarray:
    """Return x^2 + y^2 of points [...,2], as [...,1]. numpy's sums over two numbers are much slower."""
    return points[..., :1] ** 2 + points[..., 1:] ** 2


def _flattened(points: np.ndarray) -> np.ndarray:
    """Project points at depth 1 by an equidistant fisheye: the radius is the angle from the axis, not its tangent."""
    radius = np.sqrt(_squared(points))
    with np.errstate(invalid="ignore", divide="ignore"):
        return points * np.where(radius > 1e-12, np.arctan(radius) / radius, 1)


def _radial_tangential(points: np.ndarray, k1: float, k2: float, p1: float = 0, p2: float = 0) -> np.ndarray:
    return distort_brown(points, np.array([k1, k2, 0, 0, p1, p2]))


def _rational(
    points: np.ndarray, k1: float, k2: float, p1: float, p2: float, k3: float, k4: float, k5: float, k6: float
) -> np.ndarray:
    r2 = _squared(points)
    numerator, denominator = 1 + r2 * (k1 + r2 * (k2 + r2 * k3)), 1 + r2 * (k4 + r2 * (k5 + r2 * k6))
    # A lens shows nothing beyond the pole of the quotient
    quotient = numerator / np.where(denominator > 0, denominator, np.nan)
    return points * quotient + distort_brown(points, np.array([0, 0, 0, 0, p1, p2])) - points


def _fisheye(flat: np.ndarray, *k: float) -> np.ndarray:
    return distort_brown(flat, np.array([*k, *[0.0] * (6 - len(k))]))


def _thin_prism(
    flat: np.ndarray, k1: float, k2: float, p1: float, p2: float, k3: float, k4: float, sx1: float, sy1: float
) -> np.ndarray:
    return distort_brown(flat, np.array([k1, k2, k3, k4, p1, p2])) + _squared(flat) * (sx1, sy1)


def _rad_tan_thin_prism(flat: np.ndarray, *coefficients: float) -> np.ndarray:
    """Distort by x_r = x (1 + k0 t^2 + ... + k5 t^12) of the fisheye's x, then by a tangential and a thin-prism term.

    The result is x_r + 2 x_r (p . x_r) + p r^2 + s0 r^2 + s1 r^4.
    """
    k, p, s = coefficients[:6], np.array(coefficients[6:8]), np.array(coefficients[8:]).reshape(2, 2)
    t2 = _squared(flat)
    radial = flat * (1 + sum(factor * t2 ** (power + 1) for power, factor in enumerate(k)))
    r2 = _squared(radial)
    return radial * (1 + 2 * (radial @ p)[..., None]) + r2 * (p + s[:, 0] + s[:, 1] * r2)


def _field_of_view(points: np.ndarray, omega: float) -> np.ndarray:
    radius = np.sqrt(_squared(points))
    steepness = 2 * np.tan(omega / 2)
    with np.errstate(invalid="ignore", divide="ignore"):
        scale = np.arctan(steepness * radius) / (omega * radius)
    return points * np.where(radius > 1e-12, scale, steepness / omega)


def _division(points: np.ndarray, k: float) -> np.ndarray:
    """Invert x / (1 + k r^2)."""
    with np.errstate(invalid="ignore"):
        return points * 2 / (1 + np.sqrt(1 - 4 * k * _squared(points)))


def _enhanced_unified(points: np.ndarray, alpha: float, beta: float) -> np.ndarray:
    return points / (alpha * np.sqrt(beta * _squared(points) + 1) + 1 - alpha)


_THIN_PRISM = ("k1", "k2", "p1", "p2", "k3", "k4", "sx1", "sy1")

_ARIA = ("k0", "k1", "k2", "k3", "k4", "k5", "p0", "p1", "s0", "s1", "s2", "s3")

COLMAP_MODELS = {
    "SIMPLE_PINHOLE": CameraModel(0, 1),
    "PINHOLE": CameraModel(1, 2),
    "SIMPLE_RADIAL": CameraModel(2, 1, ("k",), lambda points, k: _radial_tangential(points, k, 0)),
    "RADIAL": CameraModel(3, 1, ("k1", "k2"), _radial_tangential),
    "OPENCV": CameraModel(4, 2, ("k1", "k2", "p1", "p2"), _radial_tangential),
    "OPENCV_FISHEYE": CameraModel(5, 2, ("k1", "k2", "k3", "k4"), _fisheye, True),
    "FULL_OPENCV": CameraModel(6, 2, ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"), _rational),
    "FOV": CameraModel(7, 2, ("omega",), _field_of_view),
    "SIMPLE_RADIAL_FISHEYE": CameraModel(8, 1, ("k",), _fisheye, True),
    "RADIAL_FISHEYE": CameraModel(9, 1, ("k1", "k2"), _fisheye, True),
    "THIN_PRISM_FISHEYE": CameraModel(10, 2, _THIN_PRISM, _thin_prism, True),
    "RAD_TAN_THIN_PRISM_FISHEYE": CameraModel(11, 2, _ARIA, _rad_tan_thin_prism, True),
    "SIMPLE_DIVISION": CameraModel(12, 1, ("k",), _division),
    "DIVISION": CameraModel(13, 2, ("k",), _division),
    "SIMPLE_FISHEYE": CameraModel(14, 1, (), _fisheye, True),
    "FISHEYE": CameraModel(15, 2, (), _fisheye, True),
    "EUCM": CameraModel(16, 2, ("alpha", "beta"), _enhanced_unified),
}


@dataclass(frozen=True)
class Distortion:
    """Distortion of a camera's lens: a formula, its coefficients, and a description for messages."""

    formula: Formula
    coefficients: tuple[float, ...]
    description: str
    fisheye: bool = False

    def distort(self, points: np.ndarray) -> np.ndarray:
        """Distort points.

        Args:
            points: [...,2], x/z and y/z in camera axes.

        Returns:
            Distorted points, [...,2] float64, in units of the focal lengths; NaN where no such lens shows them.
        """
        points = np.asarray(points, np.float64)
        return self.distort_flat(_flattened(points) if self.fisheye else points)

    def distort_flat(self, points: np.ndarray) -> np.ndarray:
        """Distort points that are flat if this is a fisheye, see CameraModel. Returns as distort does."""
        with np.errstate(over="ignore", invalid="ignore"):
            return self.formula(np.asarray(points, np.float64), *self.coefficients)


def lens_distortion(name: str, coefficients: Sequence[float]) -> Distortion | None:
    """Return the distortion of a camera of a COLMAP model.

    Args:
        name: the model's name, a key of COLMAP_MODELS.
        coefficients: in the model's order.

    Returns:
        The distortion; None for a pinhole, also where all coefficients are zero.
    """
    model = COLMAP_MODELS[name]
    # With alpha zero EUCM is a pinhole, whatever beta is
    bends = model.fisheye or any(coefficients[:1] if name == "EUCM" else coefficients)
    if model.formula is None or not bends:
        return None
    values = ", ".join(f"{key} {value:g}" for key, value in zip(model.coefficients, coefficients))
    return Distortion(model.formula, tuple(coefficients), f"{name} {values}".strip(), model.fisheye)
