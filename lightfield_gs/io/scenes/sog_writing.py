"""Writing of SOG, version 2, as a folder of images; sog.py describes the format.

Codebooks and the palette of harmonics are centres of clusters (Lloyd, "Least Squares Quantization in PCM", 1982).
"""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import torch
from PIL import Image

from lightfield_gs.io.scenes.scene_arrays import TINY, Fields
from lightfield_gs.io.scenes.sog import COEFFICIENTS, LEAST_MODE, ROW_ENTRIES
from lightfield_gs.io.scenes.sog_files import META

CODES = 256  # of a codebook
_CODE_ROUNDS = 16
_ALL_KEPT = 1024  # harmonics of so many Gaussians need no palette of clusters
_SHARE = 16  # Gaussians for each entry of a larger palette, about
_PALETTE_ROUNDS = 6
_BLOCK = 2048  # Gaussians at a time, for the memory of distances


def write_folder(folder: Path, fields: Fields, antialiased: bool = False) -> None:
    """Write 1..65536 valid Gaussians.

    Args:
        folder: an empty folder.
        fields: float arrays [N, ...] by name, see scene/gaussians.py; their order is kept.
        antialiased: whether the file says that they were trained with anti-aliasing.
    """
    images: dict[str, np.ndarray] = {}
    meta = {
        "version": 2,
        "count": len(fields["means"]),
        "means": _centres(images, fields["means"]),
        "scales": _scales(images, fields["scales"]),
        "quats": _rotations(images, fields["quaternions"]),
        "sh0": _colours(images, fields["sh"][:, 0], fields["opacities"]),
    }
    if antialiased:
        meta["antialias"] = True
    if fields["sh"].shape[1] > 1:
        meta["shN"] = _harmonics(images, fields["sh"][:, 1:])
    for name, pixels in images.items():
        Image.fromarray(pixels).save(folder / name, "WEBP", lossless=True, exact=True, quality=50, method=2)
    (folder / META).write_text(json.dumps(meta), encoding="utf-8")


def _image(values: np.ndarray, width: int | None = None) -> np.ndarray:
    """Return values [N,1..4] as pixels [H,W,4], row by row; alpha is 255 where it is not given."""
    count = len(values)
    width = width or 4 * math.ceil(math.sqrt(count) / 4)
    pixels = np.zeros((-(-count // width) * width, 4), np.uint8)
    pixels[:, 3] = 255
    pixels[:count, : values.shape[1]] = values
    return pixels.reshape(-1, width, 4)


def _centres(images: dict[str, np.ndarray], means: np.ndarray) -> dict:
    logs = np.sign(means) * np.log1p(np.abs(means.astype(np.float64)))
    low, high = logs.min(0), logs.max(0)
    whole = np.round((logs - low) / np.maximum(high - low, 1e-30) * 65535).astype(np.int64)
    images["means_l.webp"], images["means_u.webp"] = _image(whole & 255), _image(whole >> 8)
    return {"mins": low.tolist(), "maxs": high.tolist(), "files": ["means_l.webp", "means_u.webp"]}


def _scales(images: dict[str, np.ndarray], scales: np.ndarray) -> dict:
    codebook, codes = quantize(np.log(np.maximum(scales.astype(np.float64), TINY)))
    images["scales.webp"] = _image(codes)
    return {"codebook": codebook.tolist(), "files": ["scales.webp"]}


def _rotations(images: dict[str, np.ndarray], quaternions: np.ndarray) -> dict:
    turns = quaternions.astype(np.float64)
    turns = turns / np.linalg.norm(turns, axis=1, keepdims=True)
    largest = np.abs(turns).argmax(1)
    rows = np.arange(len(turns))
    turns = np.where(turns[rows, largest, None] < 0, -turns, turns)
    rest = turns[np.arange(4) != largest[:, None]].reshape(-1, 3)
    stored = np.round((rest / math.sqrt(2) + 0.5) * 255).clip(0, 255)
    images["quats.webp"] = _image(np.concatenate([stored, LEAST_MODE + largest[:, None]], 1))
    return {"files": ["quats.webp"]}


def _colours(images: dict[str, np.ndarray], sh0: np.ndarray, opacities: np.ndarray) -> dict:
    codebook, codes = quantize(sh0)
    alpha = np.round(255 * opacities[:, None]).clip(0, 255)
    images["sh0.webp"] = _image(np.concatenate([codes, alpha], 1))
    return {"codebook": codebook.tolist(), "files": ["sh0.webp"]}


def _harmonics(images: dict[str, np.ndarray], rest: np.ndarray) -> dict:
    count, each = rest.shape[:2]
    palette, labels = _palette(rest.reshape(count, -1))
    codebook, codes = quantize(palette)
    images["shN_centroids.webp"] = _image(codes.reshape(-1, 3), ROW_ENTRIES * each)
    images["shN_labels.webp"] = _image(np.stack([labels & 255, labels >> 8, 0 * labels], 1))
    bands = next(bands for bands, coefficients in COEFFICIENTS.items() if coefficients == each)
    files = ["shN_centroids.webp", "shN_labels.webp"]
    return {"count": len(palette), "bands": bands, "codebook": codebook.tolist(), "files": files}


def quantize(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Quantize numbers of any shape; return an ascending codebook, float64 [256], and its indices, uint8."""
    ascending = np.sort(values.astype(np.float64), None)
    sums = np.concatenate([[0.0], ascending.cumsum()])
    by_rank = ascending[np.linspace(0, len(ascending) - 1, CODES // 2).round().astype(np.int64)]
    codebook = np.sort(np.concatenate([by_rank, np.linspace(ascending[0], ascending[-1], CODES // 2)]))
    for _ in range(_CODE_ROUNDS):
        ends = np.searchsorted(ascending, (codebook[1:] + codebook[:-1]) / 2)
        ends = np.concatenate([[0], ends, [len(ascending)]])
        counts = np.diff(ends)
        means = np.diff(sums[ends]) / np.maximum(counts, 1)
        codebook = np.sort(np.where(counts > 0, means, codebook))
    return codebook, np.searchsorted((codebook[1:] + codebook[:-1]) / 2, values.astype(np.float64)).astype(np.uint8)


def _palette(rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return rows [P, D] that stand for rows [N, D], and the label of each, int64 [N]."""
    count = len(rows)
    most = max(_ALL_KEPT, count // _SHARE // ROW_ENTRIES * ROW_ENTRIES)
    found, labels = np.unique(rows, axis=0, return_inverse=True)
    if len(found) <= most:
        return found, labels.reshape(-1)
    points = torch.from_numpy(np.ascontiguousarray(found, np.float32))
    weights = torch.from_numpy(np.bincount(labels.reshape(-1), minlength=len(found)).astype(np.float32))
    order = torch.randperm(len(points), generator=torch.Generator().manual_seed(0))
    palette = points[order[:most]].clone()
    for _ in range(_PALETTE_ROUNDS):
        nearest = _nearest(points, palette)
        total = torch.zeros(most).index_add_(0, nearest, weights)
        sums = torch.zeros_like(palette).index_add_(0, nearest, weights[:, None] * points)
        palette = torch.where(total[:, None] > 0, sums / total.clamp_min(1)[:, None], palette)
    return palette.numpy(), _nearest(points, palette).numpy()[labels.reshape(-1)]


def _nearest(points: torch.Tensor, palette: torch.Tensor) -> torch.Tensor:
    """Return [N], the index of the nearest entry of a palette [P, D] to each point [N, D]."""
    half = palette.square().sum(1) / 2
    return torch.cat([torch.addmm(half, block, palette.T, alpha=-1).argmin(1) for block in points.split(_BLOCK)])
