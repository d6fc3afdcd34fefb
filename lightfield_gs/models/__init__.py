"""The network that turns one picture into 3D Gaussians."""

from lightfield_gs.models.config import ModelConfig
from lightfield_gs.models.splatter_net import SplatterNet

__all__ = ["ModelConfig", "SplatterNet"]
