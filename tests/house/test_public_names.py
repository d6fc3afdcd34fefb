"""The surface of the package as editors and type checkers see it, and what it says of itself."""

import itertools
import subprocess
import sys
import typing
from importlib import resources

import numpy as np
import pytest
import torch
from torch import Tensor

import lightfield_gs
from lightfield_gs import Cameras, Encoder, Gaussians, InputError, Panel, PhotoEncoder, RenderedImages, encode, render
from lightfield_gs.base import options
from lightfield_gs.cli import build_parser
from lightfield_gs.io import images
from lightfield_gs.panels.rig import Rig
from lightfield_gs.rasterizer.quality import QUALITIES, Quality


def fields(count=3, dtype=torch.float32) -> dict[str, Tensor]:
    return {
        "means": torch.ones(count, 3, dtype=dtype),
        "quaternions": torch.ones(count, 4, dtype=dtype),
        "scales": torch.ones(count, 3, dtype=dtype),
        "opacities": torch.ones(count, dtype=dtype),
        "sh": torch.zeros(count, 4, 3, dtype=dtype),
    }


def test_the_package_says_that_it_is_typed():
    assert resources.files("lightfield_gs").joinpath("py.typed").is_file()


def test_dir_shows_the_public_names():
    assert dir(lightfield_gs) == sorted(lightfield_gs.__all__)
    assert set(lightfield_gs.__all__) == {*lightfield_gs._HOMES, "build_info"}
    assert all(getattr(lightfield_gs, name) for name in lightfield_gs.__all__)


def test_python_m_is_the_command_line():
    ran = subprocess.run([sys.executable, "-m", "lightfield_gs", "info", "toy-8v"], capture_output=True, text=True)
    assert ran.returncode == 0 and "line_number: 10.158213425598" in ran.stdout
    ran = subprocess.run([sys.executable, "-m", "lightfield_gs", "paint"], capture_output=True, text=True)
    assert ran.returncode == 2 and ran.stderr.startswith("lightfield-gs: error: ")


def test_options_are_words_that_checkers_know():
    for call, named in (
        (encode, {"method": options.Method, "views": options.Views, "output": options.Output}),
        (Encoder.__init__, {"views": options.Views, "output": options.Output}),
        (PhotoEncoder.__init__, {"views": options.Views, "output": options.Output}),
        (
            Panel,
            {"subpixel_order": options.SubpixelOrder, "cell_rule": options.CellRule, "cell_rows": options.CellRows},
        ),
    ):
        hints = typing.get_type_hints(call)
        assert {name: hints[name] for name in named} == named
    assert typing.get_type_hints(encode)["quality"] == options.QualityName | Quality
    assert tuple(QUALITIES) == options.QUALITY_NAMES and tuple(images._SETTINGS) == options.COMPRESSIONS


@pytest.mark.parametrize(
    "option, words",
    [
        ("method", options.METHODS),
        ("views", options.VIEWS),
        ("quality", options.QUALITY_NAMES),
        ("compression", options.COMPRESSIONS),
        ("device", options.DEVICES),
        ("depth-kind", options.DEPTH_KINDS),
    ],
)
def test_the_command_line_takes_the_same_words(option, words):
    for word in words:
        args = build_parser("encode").parse_args(["encode", "s.ply", "-o", "o.png", f"--{option}", word])
        assert getattr(args, option.replace("-", "_")) == word
    with pytest.raises(InputError, match="invalid choice"):
        build_parser("encode").parse_args(["encode", "s.ply", "-o", "o.png", f"--{option}", "other"])


def test_render_returns_one_type_whatever_is_asked_for():
    assert typing.get_type_hints(render)["return"] is RenderedImages
    scene = Gaussians(**fields())
    cameras = Cameras(torch.eye(4)[None], torch.ones(1, 2), torch.ones(1, 2), 2, 2)
    for alpha, depth, radii in itertools.product((False, True), repeat=3):
        made = render(scene, cameras, alpha=alpha, depth=depth, radii=radii)
        assert type(made) is RenderedImages and made._fields == ("image", "alpha", "depth", "radii")
        assert [field is not None for field in made] == [True, alpha, depth, radii]


def test_gaussians_are_shown_in_one_line():
    assert repr(Gaussians(**fields(5))) == "Gaussians(5, SH degree 1, torch.float32, cpu)"
    batch = Gaussians(**{name: tensor.expand(2, *tensor.shape) for name, tensor in fields(dtype=torch.float64).items()})
    assert repr(batch) == "Gaussians(2 sets of 3, SH degree 1, torch.float64, cpu)"
    for change in ({"sh": torch.zeros(())}, {"means": torch.zeros(3)}, {"opacities": torch.ones(2)}):
        broken = repr(Gaussians(**{**fields(), **change}))
        assert broken.startswith("Gaussians(not valid: ") and "\n" not in broken and "tensor(" not in broken


@pytest.mark.parametrize("name", fields())
def test_arrays_are_refused_with_the_way_out(name):
    with pytest.raises(InputError, match=f"^{name}: expected torch.Tensor, got ndarray; use torch.from_numpy$"):
        Gaussians(**{**fields(), name: fields()[name].numpy()})
    changed = Gaussians(**fields())
    setattr(changed, name, np.ones(3))
    with pytest.raises(InputError, match=f"^{name}: .* torch.from_numpy$"):
        changed.validate()


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_half_precision_is_kept_but_not_drawn(dtype):
    panel, rig = Panel(4, 2, 3, 4.0, 0.1), Rig(np.eye(4), (9.0, 9.0), (2.0, 1.0), 2.0)
    half = Gaussians(**fields()).to(dtype)
    with pytest.raises(InputError, match=rf"^means: expected float32 .*, got {dtype}; .*\.float\(\)$") as caught:
        encode(half, panel, rig)
    assert "\n" not in str(caught.value)
    assert encode(half.to(torch.float32), panel, rig).shape == (2, 4, 3)
