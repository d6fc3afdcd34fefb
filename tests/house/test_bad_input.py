"""Tensors that make no sense: one line that names the field, from every entry into the library."""

import math
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from photo_cases import photo, tiny_net

import lightfield_gs
from lightfield_gs import Cameras, Encoder, PhotoEncoder, Quality, SortedPlan, from_depth, load_photo, prune
from lightfield_gs.base.errors import InputError
from lightfield_gs.encoding.classic import interlace
from lightfield_gs.encoding.encode import encode
from lightfield_gs.panels.panel import Panel
from lightfield_gs.panels.rig import Rig
from lightfield_gs.panels.simulate import simulate
from lightfield_gs.rasterizer.images import render
from lightfield_gs.scene.gaussians import Gaussians

CAT = Path(lightfield_gs.__file__).parent / "data/cat.png"
PANEL = Panel(width_px=24, height_px=16, views=4, line_number=7.3, slant_tan=0.2)
RIG = Rig(np.eye(4), (24, 24), (12, 8), 2.0)


def scene(**changes) -> Gaussians:
    fields = dict(
        means=torch.tensor([[0.0, 0, 2], [0.1, 0, 3]]),
        quaternions=torch.ones(2, 4),
        scales=torch.full((2, 3), 0.1),
        opacities=torch.full((2,), 0.5),
        sh=torch.zeros(2, 1, 3),
    )
    return Gaussians(**{**fields, **changes})


BAD_SCENES = {
    "nan mean": (dict(means=torch.tensor([[0.0, 0, 2], [math.nan, 0, 3]])), "means"),
    "infinite scale": (dict(scales=torch.full((2, 3), math.inf)), "scales"),
    "zero scale": (dict(scales=torch.zeros(2, 3)), "scales"),
    "opacity": (dict(opacities=torch.tensor([0.5, 1.5])), "opacities"),
    "zero quaternion": (dict(quaternions=torch.zeros(2, 4)), "quaternions"),
    "nan sh": (dict(sh=torch.full((2, 1, 3), math.nan)), "sh"),
    "shape": (dict(opacities=torch.ones(3)), "opacities"),
    "sh count": (dict(sh=torch.zeros(2, 7, 3)), "sh"),
    "dtype": (dict(scales=torch.ones(2, 3, dtype=torch.float64)), "scales"),
    "integers": (dict(means=torch.zeros(2, 3, dtype=torch.int64)), "means"),
    "device": (dict(scales=torch.ones(2, 3, device="meta")), "scales"),
}


@pytest.mark.parametrize("case", BAD_SCENES)
@pytest.mark.parametrize("method", ["direct", "sorted", "classic"])
def test_encode_refuses(case, method):
    change, field = BAD_SCENES[case]
    with pytest.raises(InputError, match=field) as caught:
        encode(scene(**change), PANEL, RIG, method)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("case", ["shape", "sh count", "dtype", "integers", "device"])
def test_render_refuses(case):
    change, field = BAD_SCENES[case]
    with pytest.raises(InputError, match=field):
        render(scene(**change), RIG.cameras(PANEL, [0]).to(torch.float32))


@pytest.mark.parametrize(
    "options, words",
    [
        (dict(method="guess"), "method"),
        (dict(views="all"), "views"),
        (dict(output="int7"), "output"),
        (dict(background=(1, 2)), "background"),
        (dict(background=(math.nan, 0, 0)), "background"),
        (dict(background=(30, 30, 30)), "divide bytes by 255"),
        (dict(background=[-1.0, 0, 0]), r"0\.\.1"),
        (dict(background=(np.float32(2), 0, 0)), r"0\.\.1"),
    ],
)
def test_encode_options(options, words):
    with pytest.raises(InputError, match=words):
        encode(scene(), PANEL, RIG, **options)


def test_a_background_that_is_optimized_may_leave_the_range():
    for background in (torch.tensor([1.5, -0.5, 0]), np.array([1.5, -0.5, 0])):
        image = encode(
            Gaussians(*(t[:0] for t in scene().fields().values())), PANEL, RIG, background=background, output="float32"
        )
        assert image[0, 0].tolist() == [1.5, -0.5, 0]


@pytest.mark.parametrize(
    "out, options, words",
    [
        (torch.empty(16, 24, 3), {}, "uint8"),
        (torch.empty(24, 16, 3, dtype=torch.uint8), {}, r"\[16, 24, 3\]"),
        (torch.empty(16, 3, 24, dtype=torch.uint8).transpose(1, 2), {}, "strides"),
        (np.empty((16, 24, 3)), {}, "out"),
        (torch.empty(16, 24, 3, dtype=torch.uint8, device="meta"), {}, "meta"),
        (torch.empty(16, 24, 3, dtype=torch.uint8), dict(method="sorted"), "direct"),
        (torch.empty(16, 24, 3, requires_grad=True), dict(output="float32"), "gradients"),
    ],
)
def test_images_that_cannot_be_drawn_over(out, options, words):
    with pytest.raises(InputError, match=words):
        encode(scene(), PANEL, RIG, out=out, **options)


@pytest.mark.parametrize(
    "option",
    [dict(out=torch.empty(16, 24, 3)), dict(quality="fast"), dict(stats={}), dict(threads=1)],
    ids=lambda option: next(iter(option)),
)
def test_what_images_with_gradients_do_not_have_is_refused(option):
    drawn = scene(means=torch.tensor([[0.0, 0, 2], [0.1, 0, 3]], requires_grad=True))
    with pytest.raises(InputError, match=f"{next(iter(option))}= .*no_grad"):
        encode(drawn, PANEL, RIG, output="float32", **option)
    with torch.no_grad():
        encode(drawn, PANEL, RIG, output="float32", **option)
    encode(drawn, PANEL, RIG, **option | ({"out": None} if "out" in option else {}))  # bytes have no gradients


def test_a_batch_with_a_bad_set_is_refused():
    sets = [torch.stack([tensor, tensor]) for tensor in scene().fields().values()]
    sets[0][1, 0] = math.nan
    with pytest.raises(InputError, match="means"):
        encode(Gaussians(*sets), PANEL, RIG)


def test_no_gaussians_give_the_background():
    empty = Gaussians(*(tensor[:0] for tensor in scene().fields().values()))
    for method in ("direct", "sorted", "classic"):
        image = encode(empty, PANEL, RIG, method, background=(1, 0.5, 0), output="float32")
        assert image.tolist() == torch.tensor([1, 0.5, 0]).expand(16, 24, 3).tolist()


@pytest.mark.parametrize(
    "views", [torch.zeros(3, 16, 24, 3), torch.zeros(4, 15, 24, 3), torch.zeros(4, 16, 24), torch.zeros(4, 16, 24, 1)]
)
def test_interlace_refuses(views):
    with pytest.raises(InputError):
        interlace(views, PANEL)


STRANGE = (
    None,
    True,
    0,
    -1,
    10**30,
    math.nan,
    -math.inf,
    "x",
    "",
    b"a",
    (1, 2),
    [],
    {},
    object(),
    Path("nowhere"),
    np.zeros(0),
    np.full((4, 4), np.nan),
    np.array("s"),
    np.array([object()]),
    torch.zeros(3),
    torch.zeros(40, 40, dtype=torch.complex64),
    torch.empty(0, dtype=torch.bool),
)


def entries() -> dict:
    """The functions of the library, each with valid arguments."""
    place = dict(gaussians=scene(), panel=PANEL, rig=RIG)
    cameras = dict(
        world_to_camera=torch.eye(4)[None].repeat(4, 1, 1),
        focal_px=torch.full((4, 2), 24.0),
        principal_point_px=torch.full((4, 2), 8.0),
        width_px=24,
        height_px=16,
    )
    seen = replace(PANEL, viewing_distance_mm=500, pixel_pitch_mm=0.2)
    options = dict(views="integer", background=(1, 1, 1), output="uint8", quality="exact")
    return {
        "encode": (encode, place | options | dict(method="direct", stats=None, out=None)),
        "sorted": (
            encode,
            dict(
                gaussians=scene(),
                panel=PANEL,
                method="sorted",
                cameras=Cameras(**cameras),
                view_map=np.zeros((16, 24, 3), np.int32),
                memory_budget=10**9,
            ),
        ),
        "SortedPlan": (SortedPlan, dict(panel=PANEL, view_map=np.zeros((16, 24, 3), np.int32), views=4, device="cpu")),
        "Encoder": (Encoder, dict(panel=PANEL, rig=RIG) | options),
        "an Encoder": (Encoder(PANEL, RIG), dict(gaussians=scene())),
        "render": (render, dict(gaussians=scene(), cameras=Cameras(**cameras), background=(1, 1, 1), alpha=False)),
        "interlace": (interlace, dict(views=torch.zeros(4, 16, 24, 3), panel=PANEL)),
        "simulate": (
            simulate,
            dict(
                image=np.zeros((16, 24, 3), np.uint8), panel=seen, eye_mm=(0, 0, 500), spread_subpixels=1.0, threads=1
            ),
        ),
        "Gaussians": (Gaussians, scene().fields()),
        "Cameras": (Cameras, cameras),
        "Panel": (Panel, vars(PANEL)),
        "Rig": (Rig, dict(world_to_camera=np.eye(4), focal_px=(24, 24), principal_point_px=(12, 8), zero_depth=2.0)),
        "Rig.frame": (Rig.frame, dict(gaussians=scene(), panel=PANEL, world_to_camera=np.eye(4))),
        "Rig.cameras": (RIG.cameras, dict(panel=PANEL, views=[0, 3])),
        "Rig.cameras_at": (RIG.cameras_at, dict(panel=PANEL, x=[0.5, 3.5])),
        "Quality": (Quality, vars(Quality())),
        "prune": (prune, place | dict(contribution_cut=0.01)),
        "from_depth": (
            from_depth,
            dict(
                image=np.ones((8, 9, 3), np.float32),
                depth=np.ones((8, 9)),
                focal_px=(9.0, 9.0),
                principal_point_px=(4.5, 4.0),
            ),
        ),
        "load_photo": (load_photo, dict(path=CAT, mask=None, remove_background=False, whole=False)),
        "Panel.load": (Panel.load, dict(source="toy-8v")),
        "load": (Gaussians.load, dict(path=Path(__file__).parents[1] / "fuzzing/corpus/ply/degree0.ply")),
        "predict": (tiny_net().predict, dict(rgba=photo(30, 40))),
        "PhotoEncoder": (PhotoEncoder, dict(net=tiny_net(), panel=PANEL) | options),
        "a PhotoEncoder": (PhotoEncoder(tiny_net(), PANEL), dict(rgba=photo(30, 40), stats=None)),
    }


@pytest.mark.parametrize("name", entries())
def test_values_of_any_kind_are_taken_or_refused_in_one_line(name):
    call, good = entries()[name]
    call(**good)
    for argument in good:
        for value in STRANGE:
            try:
                with warnings.catch_warnings():
                    warnings.simplefilter("error")
                    call(**good | {argument: value})
            except InputError as error:
                assert 0 < len(str(error)) < 400 and "\n" not in str(error)
