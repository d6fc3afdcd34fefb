"""The projected Gaussian in exact arithmetic, where its covariance has more digits than float64: fractions, no roots.

By the textbook (Zwicker et al. 2002): Sigma' = J W R S S R^T W^T J^T + 0.3 I, its inverse by the determinant. The
oracle and the native code both write these as sums of squares; here every difference of products is exact instead.
"""

import math
from fractions import Fraction

import numpy as np
import pytest
from rasterizer_cases import all_subpixels
from stress_cases import BACKGROUND, CASES, EXACT

from lightfield_gs import encode, reference
from lightfield_gs.reference.blend import ALPHA_MAX, ALPHA_MIN, LOW_PASS_PX2

EXTREMES = [
    "blades of 1",
    "blades of 1000",
    "blades of 1e+06",
    "needles end-on",
    "ratio 1e8 at 1",
    "ratio 1e8 at 1e+06",
    "ratio 1e8 the other way",
    "scales 1e-12",
    "scales 1e+06",
]


def exact(values):
    """Fractions of a number, or of nested lists of them."""
    return [exact(v) for v in values] if isinstance(values, list) else Fraction(values)


def product(a, b):
    return [[sum(x * y for x, y in zip(row, column)) for column in zip(*b)] for row in a]


def rotation(quaternion):
    """Of a quaternion of any length: its square divides, so that no root is taken."""
    w, x, y, z = quaternion
    rows = [
        [w * w + x * x - y * y - z * z, 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), w * w - x * x + y * y - z * z, 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), w * w - x * x - y * y + z * z],
    ]
    return [[entry / (w * w + x * x + y * y + z * z) for entry in row] for row in rows]


def exponent(scene, index, eye, column, row, offset) -> float:
    """(p - mu)^T Sigma'^-1 (p - mu) of Gaussian `index` at a sample, rounded only at the end."""
    pose, (fx, fy, cx, cy) = exact(eye.world_to_camera.tolist()), exact(eye.intrinsics.tolist())
    low_x, high_x, low_y, high_y = exact(eye.limits.tolist())
    mean, quaternion, scale = (exact(t[index].tolist()) for t in (scene.means, scene.quaternions, scene.scales))
    offset, blur = Fraction(offset), Fraction(LOW_PASS_PX2)
    X, Y, Z = (sum(a * m for a, m in zip(line, mean)) + line[3] for line in pose[:3])
    tx, ty = Z * min(max(X / Z, low_x), high_x) - offset, Z * min(max(Y / Z, low_y), high_y)
    jacobian = [[fx / Z, 0, -fx * tx / Z**2], [0, fy / Z, -fy * ty / Z**2]]
    spread = product(product(jacobian, [line[:3] for line in pose[:3]]), rotation(quaternion))
    spread = [[entry * s for entry, s in zip(line, scale)] for line in spread]
    (xx, xy), (_, yy) = product(spread, list(zip(*spread)))
    xx, yy = xx + blur, yy + blur
    dx = Fraction(column) - (fx * (X - offset) / Z + cx + Fraction(eye.shift_px) * offset)
    dy = Fraction(row) - (fy * Y / Z + cy)
    return float((yy * dx * dx - 2 * xy * dx * dy + xx * dy * dy) / (xx * yy - xy * xy))


@pytest.mark.parametrize("name", EXTREMES)
def test_one_gaussian_is_what_exact_arithmetic_makes_of_it(name):
    case = CASES[name]
    scene, (shown, fan) = case.scene(), case.view()
    eye = reference.rig_eye(shown, fan)
    random, tried = np.random.default_rng(5), 0
    for index in (0, 7, 19, 26):
        alone = type(scene)(*(field[index : index + 1].clone() for field in scene.fields().values()))
        alone.sh[:], alone.opacities[:] = 0, 0.9  # grey
        image = encode(alone, shown, fan, background=BACKGROUND, output="float64").numpy().ravel()
        rows, columns, channels = all_subpixels(shown)
        # Half of them where something is seen, half anywhere
        seen = np.flatnonzero(np.abs(image - np.tile(BACKGROUND, image.size // 3)) > 1e-6)
        chosen = np.concatenate([random.permutation(seen)[:12], random.integers(0, image.size, 12)])
        offsets = reference.lens_offsets(
            shown, fan, reference.lens_views(shown, *(part[chosen] for part in (rows, columns, channels)))
        )
        for at, offset in zip(chosen, offsets):
            power = exponent(alone, 0, eye, columns[at] + 0.5, rows[at] + 0.5, offset)
            alpha = min(0.9 * math.exp(-power / 2), ALPHA_MAX)
            if abs(alpha / ALPHA_MIN - 1) < 1e-6:
                continue  # on the threshold
            alpha = alpha if alpha >= ALPHA_MIN else 0.0
            background = BACKGROUND[channels[at]]
            assert image[at] == pytest.approx(background + alpha * (0.5 - background), abs=EXACT)
            tried += alpha > 0
    assert tried >= 20
