"""The native sheet of a photo's texels against PyTorch's."""

import pytest
import torch
from cuda_on_cpu import sheet_cases, surface_cases
from photo_cases import photo, tiny_net

from lightfield_gs.models import sheet
from lightfield_gs.models.detail import DetailLevel


@pytest.mark.parametrize("case", surface_cases.CASES)
def test_the_surface_is_that_of_pytorch(case):
    surface_cases.compare(case, surface_cases.found(case))


@pytest.mark.parametrize("case", sheet_cases.CASES)
def test_texels_are_those_of_pytorch(case):
    sheet_cases.compare(case, sheet_cases.laid(case))


def test_bits_do_not_depend_on_threads():
    case, before = sheet_cases.CASES[2], torch.get_num_threads()
    found = []
    try:
        for threads in (1, 3):
            torch.set_num_threads(threads)
            found.append(sheet_cases.laid(case))
    finally:
        torch.set_num_threads(before)
    for name, field in found[0].items():
        assert torch.equal(field[:, : -sheet_cases.OTHERS], found[1][name][:, : -sheet_cases.OTHERS]), name


@pytest.mark.parametrize("factor", [1, 4])
def test_the_network_lays_it_natively_as_it_does_with_gradients(factor, monkeypatch):
    net, level = tiny_net(), DetailLevel(factor, 2.0)
    crops = net.crops(torch.from_numpy(photo(60, 50)), level)
    found = net.all_gaussians(crops[0], net.photo_intrinsics(), crops[1], level)
    monkeypatch.setattr("lightfield_gs.models.splatter_net.is_native", lambda photo: False)
    expected = net.all_gaussians(crops[0], net.photo_intrinsics(), crops[1], level)
    assert sheet.is_native(crops[1]) is not torch.is_grad_enabled()
    # PyTorch's spread of a fog is a difference of squares, of which float32 leaves little in an untrained network's
    torch.testing.assert_close(found.opacities, expected.opacities, rtol=0, atol=0.03)
    visible = expected.opacities > 1e-3
    for name in ("means", "sh", "scales"):
        mine, right = (gaussians.fields()[name][visible] for gaussians in (found, expected))
        torch.testing.assert_close(mine, right, rtol=0.02, atol=1e-4)
    torch.testing.assert_close(found.quaternions.norm(dim=1), torch.ones_like(found.opacities))
