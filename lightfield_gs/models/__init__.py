"""The network that turns one picture into 3D Gaussians. Import it from here: `from lightfield_gs.models import SplatterNet`."""
from lightfield_gs.models.config import ModelConfig
from lightfield_gs.models.splatter_net import SplatterNet

__all__ = ["ModelConfig", "SplatterNet"]
