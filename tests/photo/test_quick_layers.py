"""Two layers of a picture with depths: closed surfaces, and no hole behind a thing for cameras beside."""

import numpy as np
import torch
from panel_cases import template_panel
from scipy import ndimage

from lightfield_gs import Rig
from lightfield_gs.encoding.classic import render_views
from lightfield_gs.photo.quick_layers import QuickLayers

HEIGHT, WIDTH, FOCAL = 120, 160, 150.0
ROWS, COLUMNS = np.mgrid[:HEIGHT, :WIDTH]
THING = (ROWS - 60) ** 2 + (COLUMNS - 80) ** 2 < 30**2


def layers(z: np.ndarray, colours: np.ndarray, margin=(0, 0, 0, 0)):
    centre = WIDTH / 2, HEIGHT / 2
    make = QuickLayers((HEIGHT, WIDTH), (FOCAL, FOCAL), centre, margin, torch.device("cpu"), None)
    return make(torch.from_numpy(colours).float(), torch.from_numpy(z).float())


def view(scene, number: float) -> np.ndarray:
    """A view of a panel over a cone of 40 degrees, before green, where nothing is."""
    panel = template_panel(WIDTH, HEIGHT, 9, cone_deg=40.0)
    rig = Rig(np.eye(4), (FOCAL, FOCAL), (WIDTH / 2, HEIGHT / 2), 1.5)
    return render_views(scene, panel, rig, [number], background=(0.0, 1.0, 0.0))[0].numpy()


def test_cameras_beside_see_the_wall_behind_a_thing_and_no_hole():
    z = np.where(THING, 1.0, 1.5)
    colours = np.where(THING[..., None], (0.9, 0.1, 0.1), (0.3, 0.2, 0.8))
    scene = layers(z, colours)
    assert scene.count == HEIGHT * WIDTH * 5 // 4
    middle = view(scene, 4.5)
    away = ~(ndimage.binary_dilation(THING, iterations=2) & ~ndimage.binary_erosion(THING, iterations=2))
    away[[*range(5), *range(-5, 0)]] = away[:, [*range(5), *range(-5, 0)]] = False
    np.testing.assert_allclose(middle[away], colours[away], atol=0.06)  # a Gaussian reaches two pixels
    for number in (0, 9):
        inner = view(scene, number)[20:-20, 40:-40]
        assert inner[..., 1].max() < 0.35, number  # green is where nothing is


def test_unmeasured_pixels_are_open_and_the_margin_surrounds_the_picture():
    z = np.full((HEIGHT, WIDTH), 1.5)
    z[40:80, 60:90] = np.nan
    scene = layers(z, np.full((HEIGHT, WIDTH, 3), 0.5), margin=(8, 9, 10, 12))
    opacity = scene.opacities[: HEIGHT * WIDTH].reshape(HEIGHT, WIDTH)
    assert float(opacity[50, 70]) == 0 and float(opacity[10, 10]) > 0.9
    around = scene.means[HEIGHT * WIDTH * 5 // 4 :]
    x, y = (FOCAL * around[:, axis] / around[:, 2] for axis in (0, 1))
    low, high = -WIDTH / 2 - 8, WIDTH / 2 + 12
    assert float(x.min()) < low + 4 and float(x.max()) > high - 4 and not bool(((x.abs() < 78) & (y.abs() < 58)).any())
