"""Anything at all as an argument of the public API: InputError that names it, or a right result; nothing else."""

import dataclasses
import inspect
import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from rasterizer_cases import CELLS
from stress_cases import CASES

import lightfield_gs as lf
from lightfield_gs import (
    Cameras,
    Encoder,
    Gaussians,
    InputError,
    Panel,
    PhotoEncoder,
    Quality,
    Rig,
    SortedPlan,
    SplatterNet,
    encode,
    render,
)
from lightfield_gs.models.config import ModelConfig
from lightfield_gs.models.unet import UNetConfig

PANEL, RIG = CASES["panel 2 x 1"].view()
SCENE = CASES["single"].scene().to(dtype=torch.float32)
CAMERAS = RIG.cameras(PANEL)
MEASURED = dataclasses.replace(PANEL, viewing_distance_mm=2000.0, pixel_pitch_mm=0.2)
EYES = ((-31.5, 0.0, 2000.0), (31.5, 0.0, 2000.0))
VIEWS = torch.zeros(PANEL.views, 1, 2, 3)
NET = SplatterNet(ModelConfig(image_size_px=16, layers=1, unet=UNetConfig(4, (1, 2), 1, (), 1)))
PHOTO, DEPTH = np.ones((3, 4, 4), np.float32), np.ones((3, 4), np.float32)

# What every public name takes when all is well
CALLS = {
    "Cameras": (
        Cameras,
        {
            name: getattr(CAMERAS, name)
            for name in (
                "world_to_camera",
                "focal_px",
                "principal_point_px",
                "width_px",
                "height_px",
                "jacobian_limits",
            )
        },
    ),
    "Encoder": (
        Encoder,
        dict(
            panel=PANEL, rig=RIG, views="integer", background=(1, 1, 1), output="uint8", quality="fast", versioned=False
        ),
    ),
    "Encoder.__call__": (Encoder(PANEL, RIG), dict(gaussians=SCENE)),
    "FitResult": (lf.FitResult, dict(gaussians=SCENE, settings=None, steps=1, scores=None, history=[], stopped=False)),
    "Gaussians": (lambda **fields: Gaussians(**fields).validate(), SCENE.fields()),
    "Gaussians.load": (Gaussians.load, dict(path="nowhere.ply")),
    "Gaussians.save": (SCENE.save, dict(path="/nowhere/a.ply")),
    "read_scene": (lf.read_scene, dict(path="nowhere.ply", skip_invalid=True, time=0.5)),
    "write_scene": (lf.write_scene, dict(gaussians=SCENE, path="/nowhere/a.ply", comments=["a"])),
    "Panel": (
        Panel,
        {
            **PANEL.to_dict(),
            "viewing_distance_mm": 2000.0,
            "pixel_pitch_mm": 0.2,
            "subpixel_cells": CELLS,
            "cell_pattern": 2,
            "cell_rule": "unity",
            "cell_rows": "bottom",
        },
    ),
    "Panel.from_physical": (
        Panel.from_physical,
        dict(
            width_px=2,
            height_px=1,
            views=8,
            lens_pitch_mm=0.6,
            slant_tan=1 / 6,
            viewing_distance_mm=1000,
            lens_gap_mm=2,
            pixel_pitch_mm=0.18,
            phase=0.0,
            subpixel_order="RGB",
            invert_views=False,
            cone_deg=40,
            name="a",
        ),
    ),
    "Panel.from_looking_glass": (
        Panel.from_looking_glass,
        dict(source={"pitch": 42, "slope": -6, "center": 0.3, "DPI": 136, "screenW": 20, "screenH": 10}, views=9),
    ),
    "Panel.load": (Panel.load, dict(source="65in-8k-96v")),
    "Rig": (Rig, dict(RIG.to_dict(), cone_deg=20.0)),
    "Rig.frame": (Rig.frame, dict(gaussians=SCENE, panel=PANEL, world_to_camera=np.eye(4))),
    "Rig.cameras": (RIG.cameras, dict(panel=PANEL, views=[0, 1])),
    "PhotoEncoder": (PhotoEncoder, dict(net=NET, panel=PANEL, views="integer", background=(1, 1, 1), output="uint8")),
    "PhotoEncoder.__call__": (PhotoEncoder(NET, PANEL), dict(rgba=np.ones((9, 7, 4), np.float32), stats=None)),
    "Quality": (Quality, dataclasses.asdict(Quality())),
    "SortedPlan": (SortedPlan, dict(panel=PANEL, view_map=PANEL.view_map(), views=PANEL.views, device="cpu")),
    "SplatterNet": (SplatterNet, dict(config=NET.config)),
    "SplatterNet.from_pretrained": (SplatterNet.from_pretrained, dict(path="nowhere.safetensors")),
    "encode": (
        encode,
        dict(
            gaussians=SCENE,
            panel=PANEL,
            rig=RIG,
            method="direct",
            views="integer",
            background=(1, 1, 1),
            output="uint8",
            quality="high",
            threads=1,
            stats={},
        ),
    ),
    "encode sorted": (
        encode,
        dict(
            gaussians=SCENE,
            panel=PANEL,
            rig=None,
            method="sorted",
            cameras=CAMERAS,
            view_map=PANEL.view_map(),
            memory_budget=1 << 24,
        ),
    ),
    "fit": (
        lf.fit,
        dict(
            capture="/nowhere",
            steps=3,
            cap_max=9,
            density="mcmc",
            test_every=8,
            test_names=["a.png"],
            device="cpu",
            folder="/nowhere/run",
            checkpoint_every=1,
            stop_early=False,
            stop=lambda: False,
            background=(0, 0, 0),
            antialiased=True,
            means_lr=1e-4,
            seed=1,
            dropout=0.1,
        ),
    ),
    "depth_from_network": (
        lf.depth_from_network,
        dict(image=PHOTO, model="/nowhere/at/all", device="cpu", kind="disparity", limits=(1.0, 2.0)),
    ),
    "from_depth": (
        lf.from_depth,
        dict(image=PHOTO, depth=DEPTH, focal_px=(4.0, 4.0), principal_point_px=(2.0, 1.5), margin_px=(1, 0, 2, 0)),
    ),
    "interlace": (lf.interlace, dict(views=VIEWS, panel=PANEL)),
    "Look": (lf.Look, dict(focus=2.0, depth_amount=0.5, cone_deg=20.0, zoom=1.5, pan=(0.1, -0.2))),
    "Look.applied": (lf.Look(focus=2.0).applied, dict(rig=RIG, panel=PANEL, gaussians=SCENE)),
    "QuiltLayout": (lf.QuiltLayout, dict(columns=2, rows=3, aspect=1.5, width_px=16, height_px=12)),
    "Optics": (lf.Optics, lf.Optics.of(PANEL, RIG).given()),
    "Optics.of": (lf.Optics.of, dict(panel=PANEL, rig=RIG, names=["phase", "zero_depth"])),
    "simulate_with_gradients": (
        lf.simulate_with_gradients,
        dict(
            image=torch.zeros(MEASURED.height_px, MEASURED.width_px, 3),
            panel=MEASURED,
            eye_mm=(0, 0, 2000),
            spread_subpixels=1.0,
            optics=lf.Optics.of(MEASURED, names=["phase"]),
        ),
    ),
    "depth_report": (lf.depth_report, dict(gaussians=SCENE, panel=PANEL, rig=RIG)),
    "load_photo": (lf.load_photo, dict(path="nowhere.png", mask="nowhere.png", remove_background=False, whole=True)),
    "prune": (lf.prune, dict(gaussians=SCENE, panel=PANEL, rig=RIG, contribution_cut=0.01)),
    "simplify": (
        lf.simplify,
        dict(
            gaussians=SCENE,
            panel=PANEL,
            rig=RIG,
            psnr_db=40.0,
            count=30,
            background=(1, 1, 1),
            antialiased=False,
            view_filter=0.5,
        ),
    ),
    "quilt": (
        lf.quilt,
        dict(
            gaussians=SCENE,
            layout=lf.QuiltLayout(2, 1, 1.0, 16, 8),
            rig=RIG,
            panel=PANEL,
            background=(1, 1, 1),
            antialiased=False,
            view_filter=0.0,
        ),
    ),
    "weave": (
        lf.weave,
        dict(
            views=VIEWS,
            panel=PANEL,
            interpolation="nearest",
            place="integer",
            view_filter=2.0,
            view_map=PANEL.view_map(),
            aspect=2.0,
            fit="contain",
            crop=(0.1, 0.0, 0.0, 0.1),
            shift=0.1,
            background=(0, 0, 0),
            device="cpu",
        ),
    ),
    "weave_eyes": (lf.weave_eyes, dict(left=VIEWS[0], right=VIEWS[1], panel=MEASURED, eyes_mm=EYES)),
    "encode_eyes": (
        lf.encode_eyes,
        dict(
            gaussians=SCENE, panel=MEASURED, rig=RIG, eyes_mm=EYES, background=(1, 1, 1), antialiased=False, device=None
        ),
    ),
    "render": (
        render,
        dict(
            gaussians=SCENE,
            cameras=CAMERAS.to(torch.float32),
            background=(1, 1, 1),
            alpha=True,
            depth=True,
            render_mode="RGB+ED",
            sh_degree=0,
            normals=True,
            conics=True,
        ),
    ),
    "render with tensors": (
        render,
        dict(
            gaussians=SCENE,
            cameras=CAMERAS.to(torch.float32),
            features=torch.zeros(1, 5),
            colors=torch.zeros(1, 3),
            masks=torch.ones(1, dtype=torch.bool),
            near_plane=0.1,
            far_plane=9.0,
            radius_clip=0.1,
            covars=torch.eye(3)[None],
            eps2d=0.5,
        ),
    ),
}
FLOATS = st.floats(allow_nan=True, allow_infinity=True, width=64)
JUNK = st.one_of(
    st.none(),
    st.booleans(),
    st.integers(),
    st.integers(-5, 5),
    FLOATS,
    st.text(max_size=5),
    st.binary(max_size=5),
    st.lists(FLOATS, max_size=4),
    st.dictionaries(st.text(max_size=3), FLOATS, max_size=2),
    st.just(object()),
    st.sampled_from(
        [
            10**400,
            1j,
            (),
            [[]],
            {},
            float,
            SCENE,
            PANEL,
            RIG,
            CAMERAS,
            np.zeros(0),
            np.zeros((4, 4)),
            np.array([["a"]]),
            np.array([object()]),
            torch.zeros(()),
            torch.zeros(2, 3),
            torch.zeros(1, 1, 4, 4),
            torch.full((1, 3), math.nan),
            torch.zeros(1, 3, dtype=torch.int64),
            torch.zeros(3, device="meta"),
            torch.zeros(1, 3, dtype=torch.complex64),
            torch.zeros(1, 3).to_sparse(),
        ]
    ),
)


def outcome(call, arguments):
    """Return the result of a call, or None where it refuses in one line."""
    try:
        return call(**arguments)
    except InputError as error:
        assert "\n" not in str(error)


def test_every_public_name_is_tried():
    tried = {name.split(".")[0].split()[0] for name in CALLS}
    assert tried == set(lf.__all__) - {
        "DepthReport",
        "InputError",
        "NotebookPicture",
        "RenderedImages",
        "build_info",
    }  # results, an error, and no arguments


@pytest.mark.parametrize("name", CALLS)
@settings(deadline=None, max_examples=60, derandomize=True)
@given(data=st.data())
def test_junk_is_refused(name, data):
    call, arguments = CALLS[name]
    changed = data.draw(st.sampled_from(sorted(arguments)))
    value = data.draw(JUNK)
    if isinstance(value, str) and changed in ("path", "source", "mask", "model"):
        value = f"/nowhere/at/all/{value}"
    result = outcome(call, {**arguments, changed: value})
    if isinstance(result, torch.Tensor):
        assert torch.isfinite(result.float()).all()


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("field", SCENE.fields())
@pytest.mark.parametrize("how", ["direct", "sorted", "classic", "high", "fast", "encoder", "render", "frame", "save"])
def test_numbers_that_are_none_are_named_with_their_index(how, field, bad):
    scene = CASES["needles end-on"].scene().to(dtype=torch.float32)
    scene.fields()[field].view(40, -1)[17, -1] = bad
    calls = {
        "render": lambda: render(scene, CAMERAS.to(torch.float32)).image,
        "frame": lambda: Rig.frame(scene, PANEL),
        "save": lambda: scene.save("/nowhere/a.ply"),
        "high": lambda: encode(scene, PANEL, RIG, quality="high"),
        "fast": lambda: encode(scene, PANEL, RIG, quality="fast"),
        "encoder": lambda: Encoder(PANEL, RIG, quality="fast")(scene),
    }
    with pytest.raises(InputError, match=rf"{field}\[17.*got -?(nan|inf)"):
        calls.get(how, lambda: encode(scene, PANEL, RIG, how))()


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("field", ["world_to_camera", "focal_px", "principal_point_px", "jacobian_limits"])
def test_cameras_that_are_none_are_named_with_their_index(field, bad):
    fields = dict(CALLS["Cameras"][1])
    fields[field] = fields[field].clone()
    fields[field].view(PANEL.views, -1)[7, 1] = bad
    with pytest.raises(InputError, match=rf"{field}\[7, .*got -?(nan|inf)"):
        Cameras(**fields)


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("made", [Panel, Rig])
def test_numbers_of_panel_and_rig_are_named(made, bad):
    _, arguments = CALLS[made.__name__]
    for name, value in arguments.items():
        if isinstance(value, (float, int)) and not isinstance(value, bool):
            with pytest.raises(InputError, match=name):
                made(**{**arguments, name: bad})
    assert inspect.signature(made).parameters.keys() == arguments.keys()
