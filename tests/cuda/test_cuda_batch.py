"""Photos of a batch on a GPU: what `encode` makes of each by itself, byte for byte. Needs a GPU."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from photo_cases import PANEL, photo, tiny_net
from PIL import Image

from lightfield_gs import Rig, _core, cli
from lightfield_gs.base.device import HostCopies
from lightfield_gs.models.splatter_net import PRETRAINED, ReplayedNet, SplatterNet
from lightfield_gs.photo.detail_level import detail_level

if not (torch.cuda.is_available() and hasattr(_core, "cuda")):
    pytest.skip("needs a CUDA device and a build with LFGS_CUDA", allow_module_level=True)
PHOTO = Path(_core.__file__).parent / "data/cat.png"


@pytest.mark.skipif(not PRETRAINED.exists(), reason="this checkout has no trained checkpoint")
def test_a_batch_is_what_encode_is(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    Path("in").mkdir()
    for number, side in enumerate((64, 300, 500, 300, 900, 64)):  # which take other levels of detail
        Image.open(PHOTO).resize((side, side + number)).rotate(9 * number).save(f"in/{number}.png")
    assert cli.main("batch in -o out --panel 65in-8k-96v --devices cuda:0 --processes 2".split()) == 0
    for number in range(6):
        assert cli.main(f"encode in/{number}.png -o {number}.png --panel 65in-8k-96v --device cuda".split()) == 0
        assert Path(f"{number}.png").read_bytes() == Path(f"out/{number}.png").read_bytes()
    # An image of nothing is noted, though nothing was counted
    capsys.readouterr()
    Rig(np.eye(4), (1000.0, 1000.0), (1e6, 0.0), 1.3).to_yaml("far.yaml")
    assert cli.main("batch in -o far --panel toy-8v --devices cuda:0 --processes 1 --rig far.yaml".split()) == 0
    lines = [json.loads(line) for line in Path("far/batch.jsonl").read_text().splitlines()]
    ended = [line for line in lines if line.get("status") == "done"]
    assert len(ended) == 6 and all("is all background" in "".join(line["said"]) for line in ended)


@pytest.mark.parametrize("detail", [None, 1, "auto"])
def test_a_replayed_network_predicts_the_same(detail):
    net = (SplatterNet.from_pretrained() if PRETRAINED.exists() else tiny_net()).cuda()
    replayed = ReplayedNet(net)
    with torch.inference_mode():
        for shape in [(40, 90), (300, 300), (40, 90), (61, 80), (300, 300)]:
            level = detail_level(detail, net.config, max(shape), PANEL)
            found, expected = (each.predict(photo(*shape), level) for each in (replayed, net))
            for one, other in zip(found.fields().values(), expected.fields().values()):
                assert torch.equal(one, other)
    assert replayed._graphs


def test_copies_hold_what_was_there_when_they_were_begun():
    copies, held = HostCopies(2), []
    for number in range(6):
        tensors = [torch.full((3, 1000 + 500 * number, 1000), number, dtype=torch.uint8, device="cuda")]
        tensors.append(torch.arange(7.0, device="cuda") + number)
        held.append((number, copies.begin(tensors)))
        if len(held) == 2:
            number, copy = held.pop(0)
            image, row = copy.wait()
            assert image.is_pinned() and (image == number).all() and image.shape[1] == 1000 + 500 * number
            assert row.tolist() == [number + part for part in range(7)]
            copy.release()
