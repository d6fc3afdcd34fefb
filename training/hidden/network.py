"""The network that paints what edges of a photo with depths hide: a small U-Net over the far surfaces.

Its input is the photo, and the same with the smooth first guess in the hole; its output changes colours and disparity
of this guess. training.hidden trains it on compositions of meshes and photographs, and on nothing else.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from lightfield_gs.base.errors import InputError
from lightfield_gs.io.atomic import atomic_path
from lightfield_gs.photo.hidden import Hidden
from lightfield_gs.photo.inpainting import solve_membrane

_CHANNELS = (24, 48, 72, 96, 128)  # at a half, a quarter, ... of the picture's size
_BLOCKS = (1, 2, 2, 2)  # on the way down; the last level has its own
_BLOCKS_UP = (1, 2, 2, 1)
_DILATIONS = (1, 2, 4)  # of the blocks at the lowest level: a hole of 150 px is seen from both sides
_INPUTS, _OUTPUTS = 11, 4
_STRIDE = 2 ** len(_CHANNELS)
_MOST_PIXELS = 1 << 20  # of a picture that the network sees; half a second on two cores
_AROUND_PX = 96  # of the photo round its holes that the network sees
_DISPARITY = 0.1  # log disparity of one unit of output
_FARTHEST_LOG = 2.0  # largest difference of log disparity that the network sees


class HiddenInput(NamedTuple):
    """What the network sees of B pictures.

    Attributes:
        image: [B,3,H,W], the photo, 0..1.
        log_disparity: [B,H,W], the photo's; NaN where nothing was measured.
        guess: [B,3,H,W], the photo with smooth first colours in the hole.
        guess_log_disparity: [B,H,W], with first disparities in the hole.
        hole: bool [B,H,W].
        fringe: bool [B,H,W], the visible pixels of the hole.
    """

    image: Tensor
    log_disparity: Tensor
    guess: Tensor
    guess_log_disparity: Tensor
    hole: Tensor
    fringe: Tensor


class HiddenNet(nn.Module):
    """Predict colours and disparity of hidden surfaces."""

    def __init__(self) -> None:
        super().__init__()
        levels = len(_CHANNELS)
        self.begin = nn.Conv2d(4 * _INPUTS, _CHANNELS[0], 3, padding=1)
        self.down = nn.ModuleList(_chain(channels, count) for channels, count in zip(_CHANNELS, _BLOCKS))
        self.shrink = nn.ModuleList(
            nn.Conv2d(_CHANNELS[level], _CHANNELS[level + 1], 2, stride=2) for level in range(levels - 1)
        )
        self.lowest = nn.Sequential(*(_Block(_CHANNELS[-1], dilation) for dilation in _DILATIONS))
        self.grow = nn.ModuleList(
            nn.Conv2d(_CHANNELS[level + 1] + _CHANNELS[level], _CHANNELS[level], 3, padding=1)
            for level in range(levels - 1)
        )
        self.up = nn.ModuleList(_chain(channels, count) for channels, count in zip(_CHANNELS, _BLOCKS_UP))
        self.end = nn.Conv2d(_CHANNELS[0], 4 * _OUTPUTS, 3, padding=1)
        for parameter in self.end.parameters():
            nn.init.zeros_(parameter)

    def forward(self, seen: HiddenInput) -> tuple[Tensor, Tensor]:
        """Return colours [B,3,H,W], unbounded, and log disparity [B,H,W]; the guess's outside the hole."""
        height, width = seen.hole.shape[1:]
        planes = _planes(seen)
        planes = F.pad(planes, (0, -width % _STRIDE, 0, -height % _STRIDE), mode="replicate")
        x = self.begin(F.pixel_unshuffle(planes.contiguous(memory_format=torch.channels_last), 2))
        kept = []
        for blocks, shrink in zip(self.down, self.shrink):
            x = blocks(x)
            kept.append(x)
            x = shrink(x)
        x = self.lowest(x)
        for level in reversed(range(len(kept))):
            larger = F.interpolate(x, scale_factor=2, mode="nearest")
            x = self.up[level](F.relu(self.grow[level](torch.cat([larger, kept[level]], 1))))
        change = F.pixel_shuffle(self.end(F.relu(x)), 2)[..., :height, :width].to(seen.guess.dtype)
        change = torch.where(seen.hole[:, None], change, 0)
        return seen.guess + change[:, :3], seen.guess_log_disparity + _DISPARITY * change[:, 3]

    def save(self, path: Path) -> None:
        """Write the weights as float16 safetensors."""
        from safetensors.torch import save

        weights = {name: t.detach().to("cpu", torch.float16).contiguous() for name, t in self.state_dict().items()}
        with atomic_path(path) as temporary:
            temporary.write_bytes(save(weights))

    @classmethod
    def load(cls, path: Path) -> HiddenNet:
        """Return the network of save(), in eval mode, float32; raise InputError."""
        from safetensors import SafetensorError
        from safetensors.torch import load

        net = cls()
        try:
            net.load_state_dict({name: tensor.float() for name, tensor in load(path.read_bytes()).items()})
        except (OSError, SafetensorError, RuntimeError) as error:
            reason = " ".join(str(error).split())[:200]
            raise InputError(f"{path}: expected the weights of the network for hidden surfaces, but {reason}") from None
        return net.requires_grad_(False).eval()


@torch.no_grad()
def paint_hidden(net: HiddenNet, image: Tensor, depth: Tensor, found: Hidden) -> tuple[Hidden, Tensor]:
    """Return the hidden layer with the network's disparities, and its colours [H,W,3].

    The network sees the part of the photo round its holes. Of a large one it sees a smaller picture: its changes are
    then made larger, not the photo.

    Args:
        image: [H,W,3], the photo, 0..1.
        depth: [H,W], its z, sharp at edges.
        found: What find_hidden finds.
    """
    guess = solve_membrane(found.image, found.hole, found.linked)
    if not bool(found.hole.any()):
        return found, guess
    rows, columns = (_range_around(found.hole.any(dim)) for dim in (1, 0))
    hole, first, disparity = (part[rows, columns] for part in (found.hole, guess, found.disparity))
    height, width = hole.shape
    factor = math.ceil(math.sqrt(height * width / _MOST_PIXELS))
    colours = torch.cat([image[rows, columns], first], 2).movedim(2, 0)[None]
    depths = torch.stack([-depth[rows, columns].log(), disparity.log()])[None]
    masks = torch.stack([hole, found.fringe[rows, columns]])[None]
    if factor > 1:
        padding = (0, -width % factor, 0, -height % factor)
        colours = F.avg_pool2d(F.pad(colours, padding, mode="replicate"), factor)
        depths, masks = (F.max_pool2d(part.float(), factor, ceil_mode=True) for part in (depths, masks))
    seen = HiddenInput(colours[:, :3], depths[:, 0], colours[:, 3:], depths[:, 1], *(masks > 0).unbind(1))
    painted, log_disparity = net(seen)
    change = torch.cat([painted - seen.guess, (log_disparity - seen.guess_log_disparity)[:, None]], 1)
    if factor > 1:
        change = F.interpolate(change, scale_factor=factor, mode="bilinear", align_corners=False)
    change = change[0, :, :height, :width].movedim(0, 2)
    guess[rows, columns] = torch.where(hole[..., None], first + change[..., :3], first).clamp(0, 1)
    nearer = torch.minimum(disparity * change[..., 3].exp(), found.nearest[rows, columns])
    behind = found.disparity.clone()
    behind[rows, columns] = torch.where(hole, nearer, disparity)
    return found._replace(disparity=behind), guess


def _range_around(wanted: Tensor) -> slice:
    """Return the range of the elements [N] that are True, and _AROUND_PX on both sides."""
    places = wanted.nonzero()
    return slice(max(0, int(places[0]) - _AROUND_PX), int(places[-1]) + 1 + _AROUND_PX)


class _Block(nn.Module):
    def __init__(self, channels: int, dilation: int = 1) -> None:
        super().__init__()
        self.one = nn.Conv2d(channels, channels, 3, padding=dilation, dilation=dilation)
        self.other = nn.Conv2d(channels, channels, 3, padding=1)
        with torch.no_grad():
            self.other.weight.mul_(0.2)  # without norms: a block begins as little more than nothing

    def forward(self, x: Tensor) -> Tensor:
        return x + self.other(F.relu(self.one(F.relu(x))))


def _chain(channels: int, count: int) -> nn.Sequential:
    return nn.Sequential(*(_Block(channels) for _ in range(count)))


def _planes(seen: HiddenInput) -> Tensor:
    """Return the network's input [B,_INPUTS,H,W]: depths count from the mean of the hidden surfaces."""
    hole = seen.hole.to(seen.guess)
    known = seen.guess_log_disparity.nan_to_num(0, 0, 0)
    middle = ((known * hole).sum((1, 2)) / hole.sum((1, 2)).clamp_min(1))[:, None, None]
    depths = [
        (values - middle).nan_to_num(0).clamp(-_FARTHEST_LOG, _FARTHEST_LOG)
        for values in (seen.log_disparity, seen.guess_log_disparity)
    ]
    # What textures are made of: the same for the same size, on every device
    noise = torch.randn(hole.shape[1:], generator=torch.Generator().manual_seed(0)).to(hole).expand_as(hole)
    maps = torch.stack([hole, seen.fringe.to(hole), *depths, 0.5 * noise], 1)
    # Colours of what covers a surface say nothing of it, those of the fringe do
    visible = torch.where((seen.hole & ~seen.fringe)[:, None], seen.guess, seen.image)
    return torch.cat([visible - 0.5, seen.guess - 0.5, maps], 1)
