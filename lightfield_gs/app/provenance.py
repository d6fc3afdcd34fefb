"""What a picture was made from and by, for its metadata."""

from __future__ import annotations

import hashlib
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from lightfield_gs.io.atomic import sha256

if TYPE_CHECKING:
    from lightfield_gs.scene.gaussians import Gaussians


@cache
def package_versions() -> dict[str, str]:
    """Versions of this package and of the packages that affect the result."""
    from importlib.metadata import PackageNotFoundError, version

    versions = {}
    for name in ("lightfield-gs", "torch", "numpy", "openimageio"):
        try:
            versions[name] = version(name)
        except PackageNotFoundError:
            versions[name] = "not installed"
    return versions


def software() -> str:
    return f"lightfield-gs {package_versions()['lightfield-gs']}"


def scene_hash(gaussians: Gaussians) -> str:
    """SHA-256 of the five fields as little-endian float32, one after the other, hexadecimal."""
    digest = hashlib.sha256()
    for tensor in gaussians.fields().values():
        digest.update(np.ascontiguousarray(tensor.detach().cpu().numpy(), "<f4").data)
    return digest.hexdigest()


def scene_facts(gaussians: Gaussians) -> dict[str, Any]:
    return {"gaussians": gaussians.count, "sh_degree": gaussians.sh_degree, "sha256": scene_hash(gaussians)}


def file_facts(path: Path) -> dict[str, str]:
    return {"file": path.name, "sha256": sha256(path)}
