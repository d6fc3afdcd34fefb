"""SplatterNet for photo after photo, as a CUDA graph."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from lightfield_gs.base.device import capture_graph
from lightfield_gs.models.detail import DetailLevel
from lightfield_gs.models.splatter_net import SplatterNet, checked_photo, visible
from lightfield_gs.scene.gaussians import Gaussians

_MOST_GRAPHS = 4  # each keeps its memory


class ReplayedNet:
    """SplatterNet.predict for photo after photo; on CUDA as a graph, since launches take longer than the device.

    The kernels and their precision are the same, and so are the results. A level of detail gets its graph the second
    time that it is met. The network must not change.
    """

    def __init__(self, net: SplatterNet) -> None:
        self.net, self.config = net, net.config
        self._met: set[DetailLevel | None] = set()
        self._graphs: dict[DetailLevel | None, _Graph] = {}

    @torch.no_grad()
    def predict(self, rgba: np.ndarray | Tensor, level: DetailLevel | None = None) -> Gaussians:
        """Return the Gaussians of SplatterNet.predict. Raises InputError as it does."""
        photo = checked_photo(rgba)
        cropped, fine = self.net.crops(photo, level)
        if not cropped.is_cuda or not self._is_repeated(level):
            return self.net.visible_gaussians(cropped, fine, level)
        with torch.cuda.device(cropped.device):
            if level not in self._graphs:
                self._graphs[level] = _Graph(self.net, cropped, fine, level)
            return visible(self._graphs[level].replay(cropped, fine))

    def _is_repeated(self, level: DetailLevel | None) -> bool:
        if level in self._graphs:
            return True
        if level in self._met:
            return len(self._graphs) < _MOST_GRAPHS
        self._met.add(level)
        return False


class _Graph:
    """SplatterNet.all_gaussians as a CUDA graph, for photos of one level of detail."""

    def __init__(self, net: SplatterNet, cropped: Tensor, fine: Tensor | None, level: DetailLevel | None) -> None:
        with torch.inference_mode(False), torch.no_grad():  # tensors that are writable in any mode
            self._cropped, self._fine = cropped.clone(), None if fine is None else fine.clone()
            self._intrinsics = net.photo_intrinsics()
            self._graph, self._gaussians = capture_graph(
                lambda: net.all_gaussians(self._cropped, self._intrinsics, self._fine, level), warm_up=True
            )

    def replay(self, cropped: Tensor, fine: Tensor | None) -> Gaussians:
        """Return the Gaussians, which the next call writes over."""
        self._cropped.copy_(cropped)
        if self._fine is not None and fine is not None:
            self._fine.copy_(fine)
        self._graph.replay()
        return self._gaussians
