"""The loss of filled holes: colours, gradients, the strength of textures, depths, and a second network's verdict."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torch.nn.utils.parametrizations import spectral_norm

from training.hidden.config import HiddenLossWeights

_SCALES = 3
_WINDOW_PX = 9  # over which the strength of a texture is a mean
_FILTERS, _FILTER_PX = 16, 5
_JUDGED = 0.3  # fraction of a place of the verdict that is hole, from which on it counts


class HiddenLoss(nn.Module):
    """Sum of the terms.

    Args:
        weights: Of the terms.
    """

    def __init__(self, weights: HiddenLossWeights) -> None:
        super().__init__()
        self._weights = weights
        # Zero-mean filters of one strength; orthogonal, so that no two see the same
        random = torch.randn(_FILTER_PX**2 - 1, _FILTERS, generator=torch.Generator().manual_seed(0))
        mean = torch.full((_FILTER_PX**2, 1), _FILTER_PX**-1.0)
        plane = torch.linalg.qr(torch.cat([mean, torch.eye(_FILTER_PX**2)[:, 1:]], 1))[0][:, 1:]
        filters = (plane @ torch.linalg.qr(random)[0]).T.reshape(_FILTERS, 1, _FILTER_PX, _FILTER_PX)
        self.register_buffer("filters", filters)

    def forward(self, colours: Tensor, log_disparity: Tensor, truth: Tensor, depth: Tensor, known: Tensor) -> dict:
        """Return the terms by their names, tensors.

        Args:
            colours: [B,3,S,S], predicted.
            log_disparity: [B,S,S], predicted.
            truth, depth: What both should be.
            known: bool [B,S,S], where that is known.
        """
        weight = known[:, None].float()
        total = weight.sum().clamp_min(1)
        # Where nothing is known, the truth: it neither counts nor lets borders appear
        drawn = torch.where(known[:, None], colours, truth)
        terms = {
            "colour": (drawn - truth).abs().sum() / total / 3,
            "depth": torch.where(known, log_disparity - depth, 0).abs().sum() / total,
        }
        gradient = texture = colours.new_zeros(())
        one, other = drawn, truth
        for scale in range(_SCALES):
            steps = sum((a.diff(dim=d) - b.diff(dim=d)).abs().sum() for a, b in [(one, other)] for d in (2, 3))
            gradient = gradient + steps * 4**scale / total / 6 / _SCALES
            if scale < _SCALES - 1:
                apart = (self._strength(one) - self._strength(other)).abs() * F.avg_pool2d(weight, 2**scale)
                texture = texture + apart.sum() * 4**scale / total / apart.shape[1] / (_SCALES - 1)
            one, other = F.avg_pool2d(one, 2), F.avg_pool2d(other, 2)
        return terms | {"gradient": gradient, "texture": texture}

    def weighted(self, terms: dict[str, Tensor]) -> Tensor:
        """Return the sum of the terms by their weights."""
        return sum((getattr(self._weights, name) * value for name, value in terms.items()), torch.zeros(()))

    def _strength(self, images: Tensor) -> Tensor:
        """Return mean magnitudes of the filters' responses around each pixel, of all channels."""
        grey = images.mean(1, keepdim=True)
        channels = torch.cat([grey, images - grey], 1).flatten(0, 1)[:, None]
        answers = F.conv2d(channels, self.filters, padding=_FILTER_PX // 2)
        answers = (answers.square() + 1e-6).sqrt()
        means = F.avg_pool2d(answers, _WINDOW_PX, 1, _WINDOW_PX // 2, count_include_pad=False)
        return means.unflatten(0, (len(images), -1)).flatten(1, 2)


class Judge(nn.Module):
    """Tell true holes from filled ones, piece by piece of the picture."""

    def __init__(self, channels: int = 48) -> None:
        super().__init__()
        widths = (4, channels, 2 * channels, 4 * channels, 4 * channels)
        layers: list[nn.Module] = []
        for before, after in zip(widths, widths[1:]):
            layers += [spectral_norm(nn.Conv2d(before, after, 4, stride=2, padding=1)), nn.LeakyReLU(0.2)]
        layers[-2] = spectral_norm(nn.Conv2d(widths[-2], widths[-1], 3, padding=1))
        self.layers = nn.Sequential(*layers, spectral_norm(nn.Conv2d(widths[-1], 1, 3, padding=1)))

    def forward(self, image: Tensor, known: Tensor) -> tuple[Tensor, Tensor]:
        """Return verdicts [B,1,h,w], positive for true ones, and their weights, 0 or 1."""
        mask = known[:, None].float()
        verdict = self.layers(torch.cat([2 * image - 1, mask], 1))
        return verdict, (F.interpolate(mask, size=verdict.shape[2:], mode="area") > _JUDGED).float()

    def loss(self, drawn: Tensor, truth: Tensor, known: Tensor) -> Tensor:
        """Return the loss of the verdicts themselves, hinges."""
        false, weight = self(drawn.detach(), known)
        true, _ = self(truth, known)
        return ((F.relu(1 + false) + F.relu(1 - true)) * weight).sum() / weight.sum().clamp_min(1)

    def approval(self, drawn: Tensor, known: Tensor) -> Tensor:
        """Return the mean verdict of what was drawn."""
        verdict, weight = self(drawn, known)
        return (verdict * weight).sum() / weight.sum().clamp_min(1)
