"""The page to send: what it holds, and how its Gaussians are packed."""

import json
import re
from pathlib import Path

import numpy as np
import pytest
import torch
from command_line import PANEL, complaint, run, scene
from rasterizer_cases import random_scene

from lightfield_gs import encode
from lightfield_gs.base.errors import InputError
from lightfield_gs.panels.rig import Rig
from lightfield_gs.scene.gaussians import Gaussians, from_arrays
from lightfield_gs.show.scene_page.packing import pack, unpack
from lightfield_gs.show.scripts import joined

GUITAR = Path(__file__).resolve().parents[3] / "shared" / "data" / "gaussians" / "guitar.ply"


def arrays(gaussians: Gaussians) -> dict[str, np.ndarray]:
    return {name: value.double().numpy() for name, value in gaussians.fields().items()}


@pytest.mark.parametrize("degree", [0, 1, 3])
def test_packed_gaussians_look_alike(degree):
    """The picture of unpacked Gaussians is that of the originals to 45 dB."""
    gaussians = random_scene(400, degree=degree, size=0.05, dtype=torch.float32)
    rig = Rig.frame(gaussians, PANEL)
    packed = pack(arrays(gaussians))
    images = [encode(one, PANEL, rig).float() for one in (gaussians, from_arrays(unpack(packed), (0.0, 0.0, 0.0)))]
    error = ((images[0] - images[1]) ** 2).mean()
    assert images[0].std() > 10 and 10 * torch.log10(255**2 / error) > 45
    assert packed.data == pack(arrays(gaussians)).data


def test_centres_far_apart_keep_their_places():
    """A far Gaussian takes bits, not the places of the others."""
    gaussians = scene()
    gaussians.means[0] = torch.tensor([3000.0, -2000.0, 1000.0])
    gaussians.scales[0] = 50.0
    packed = pack(arrays(gaussians))
    found = unpack(packed)["means"]
    nearest = np.abs(found[:, None] - arrays(gaussians)["means"]).max(-1).min(0)
    assert packed.bytes_each == 3 and nearest.max() <= packed.step / 2 + 1e-3 and packed.step < 1e-2


@pytest.mark.skipif(not GUITAR.is_file(), reason="needs ../shared/data/gaussians/guitar.ply")
def test_a_hundred_thousand_gaussians_have_two_megabytes():
    """As base64, with the rest of a page, which takes less than 250 kB."""
    packed = pack(arrays(Gaussians.load(GUITAR)))
    assert packed.degree == 0 and 1e5 / packed.count * len(packed.data) * 4 / 3 < 1.75e6


def test_a_page_is_one_file_that_loads_nothing(tmp_path, capsys):
    scene().save(tmp_path / "s.ply")
    run(capsys, f"page {tmp_path / 's.ply'} --panel toy-8v -o {tmp_path / 'p.html'} --title A</script>&B")
    page = (tmp_path / "p.html").read_text()
    assert not re.search(r"https?://|\bfetch\(|\bimport\b[^=;]*from|src=\"(?!data:)", page)
    assert page.count("</script>") == 3
    data = json.loads(re.search(r'id="scene">(.*?)</script>', page)[1])
    assert data["title"] == "A</script>&B" and data["panel"]["name"] == "toy-8v" and data["reach_deg"] is None
    assert not re.search(r"/\* (style|scene|gaussians|script) \*/", page)


def test_a_page_of_no_panel_asks_for_one(tmp_path, capsys):
    scene().save(tmp_path / "s.ply")
    run(capsys, f"page {tmp_path / 's.ply'} -o {tmp_path / 'p.html'}")
    page = (tmp_path / "p.html").read_text()
    assert json.loads(re.search(r'id="scene">(.*?)</script>', page)[1])["panel"] is None


def test_a_page_has_the_name_of_a_page(tmp_path, capsys):
    scene().save(tmp_path / "s.ply")
    assert "a page ends with .html" in complaint(capsys, f"page {tmp_path / 's.ply'} -o {tmp_path / 'p.png'}")


def test_modules_are_joined_with_names_of_their_own(tmp_path):
    (tmp_path / "a.js").write_text('import { b } from "./b.js";\nimport { c } from "./c.js";\nconst own = 1;\nb(c);\n')
    (tmp_path / "b.js").write_text("const own = 2;\nexport function b() { return own; }\n")
    (tmp_path / "c.js").write_text('import { b } from "./b.js";\nexport const c = b() + "</script>";\n')
    script = joined(tmp_path / "a.js")
    assert script.count("const own = 2;") == 1 and "export" not in script and "</script" not in script
    (tmp_path / "d.js").write_text('import * as b from "./b.js";\n')
    with pytest.raises(InputError, match="expected imports and exports of names"):
        joined(tmp_path / "d.js")
    (tmp_path / "e.js").write_text('import { b, d } from "./b.js";\n')
    with pytest.raises(InputError, match="b.js exports b, not d"):
        joined(tmp_path / "e.js")
