"""What a photo needs, of the CUDA sources compiled for the CPU: the network's norms, the sheet, crops, and the
compression of its image."""

from __future__ import annotations

import pytest
import torch
from cuda_on_cpu import cases, crop_cases, png_cases, sheet_cases, surface_cases
from cuda_on_cpu.drawings import EMULATED

pytestmark = EMULATED

DRAWN = ("norms", "surface", "sheet", "crops", "png")


def test_group_norm_and_silu(drawn):
    for case, found in zip(cases.NORMS, drawn("norms"), strict=True):
        expected = cases.norm_expected(*cases.norm_case(*case))
        assert found.dtype == torch.bfloat16 and found.is_contiguous(memory_format=torch.channels_last)
        torch.testing.assert_close(found.double(), expected, rtol=2**-8, atol=2e-5)


def test_the_surface_of_a_photos_sheet_is_that_of_pytorch(drawn):
    for case, found in zip(surface_cases.CASES, drawn("surface"), strict=True):
        surface_cases.compare(case, found)


def test_the_sheet_over_a_photo_is_that_of_pytorch(drawn):
    for case, found in zip(sheet_cases.CASES, drawn("sheet"), strict=True):
        sheet_cases.compare(case, found)


def test_photos_are_cropped_as_on_the_host(drawn):
    crop_cases.compare(*drawn("crops"))


@pytest.mark.parametrize("name", png_cases.IMAGES)
def test_images_are_compressed_for_png(drawn, name, tmp_path):
    png_cases.compare(name, drawn("png")[name], tmp_path)
