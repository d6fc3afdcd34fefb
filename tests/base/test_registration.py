"""The operators of a fresh process: there as soon as the package and torch are, and not loaded before."""

import subprocess
import sys

import pytest
import torch
from rasterizer_cases import dense_views, panel, random_scene, rig

from lightfield_gs.panels.rig import lenticular_camera

LOAD = """
import sys
{imports}
assert "lightfield_gs.rasterizer" not in sys.modules
images = [torch.export.load(path).module()(*torch.load("fields")) for path in ("direct.pt2", "images.pt2")]
torch.save(images, "images-loaded")
"""


class Operator(torch.nn.Module):
    def __init__(self, name, *others):
        super().__init__()
        self.name, self.others = name, others

    def forward(self, *fields):
        given = fields if self.name == "render_direct" else (field[None] for field in fields)
        return getattr(torch.ops.lightfield_gs, self.name)(*given, *self.others)


@pytest.mark.parametrize("imports", ["import lightfield_gs, torch", "import torch, lightfield_gs"])
def test_exported_operators_load_after_import_of_the_package_alone(imports, tmp_path):
    fields = tuple(random_scene(5, 1, seed=3, dtype=torch.float32).fields().values())
    shown = panel("default lens", width_px=9, height_px=5)
    numbers = lenticular_camera(shown, rig(shown, 0.1, -0.15, (0.53, 0.44))).numbers()
    views = [view.float() for view in dense_views(1, 1, 9, 5)]
    operators = {
        "direct.pt2": Operator("render_direct", torch.ones(3), *numbers),
        "images.pt2": Operator("render_images", torch.ones(1, 1, 3), *views, 9, 5),
    }
    for path, operator in operators.items():
        torch.export.save(torch.export.export(operator, fields), tmp_path / path)
    torch.save(fields, tmp_path / "fields")
    subprocess.run([sys.executable, "-c", LOAD.format(imports=imports)], cwd=tmp_path, check=True)
    loaded = torch.load(tmp_path / "images-loaded")
    want = [operator(*fields) for operator in operators.values()]
    assert torch.equal(loaded[0], want[0])
    assert all(torch.equal(have, true) for have, true in zip(loaded[1], want[1]))


def test_the_package_imports_no_torch_and_leaves_its_import_as_it_is():
    found = """
import sys, lightfield_gs
assert "torch" not in sys.modules
import importlib.util
assert importlib.util.find_spec("torch").origin and "torch" not in sys.modules  # a look, as others take
import torch
assert torch.__spec__.loader.get_filename("torch") == torch.__file__
assert not any(type(finder).__module__.startswith("lightfield_gs") for finder in sys.meta_path)
assert torch.ops.lightfield_gs.render_images_with_state and not hasattr(torch.ops.lightfield_gs, "other")
"""
    subprocess.run([sys.executable, "-c", found], check=True)
