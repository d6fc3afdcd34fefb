"""The network on photo after photo, here on the CPU, where nothing is replayed (tests/cuda/test_cuda_batch.py)."""

import torch
from photo_cases import photo, tiny_net

from lightfield_gs.models.detail import DetailLevel
from lightfield_gs.models.splatter_net import ReplayedNet


def test_it_predicts_what_the_network_does():
    net = tiny_net()
    replayed = ReplayedNet(net)
    for shape in [(40, 90), (40, 90), (61, 80)]:
        pairs = zip(*(each.predict(photo(*shape), DetailLevel(1)).fields().values() for each in (replayed, net)))
        assert all(torch.equal(one, other) for one, other in pairs)
