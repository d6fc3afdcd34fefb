"""The pixels of slides, read when their turn comes."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from pathlib import Path

import numpy as np

from lightfield_gs.base.options import StereoLayout
from lightfield_gs.io.images import as_floats, read_image
from lightfield_gs.io.stereo_names import PairLayout
from lightfield_gs.panels.panel import Panel
from lightfield_gs.show.playlist import Playlist, Slide
from lightfield_gs.show.preview import to_integers


def read_slide(slide: Slide, playlist: Playlist) -> np.ndarray:
    """Return the picture of a slide as the screen takes it, uint8 [H, W, 3]. Raises InputError."""
    if slide.pair is not None:
        assert playlist.layout is not None
        return _pair_pixels(slide.path, slide.pair, playlist.layout)
    if slide.quilt is not None:
        return _woven(slide, playlist.panel)
    return _bytes(read_image(slide.path, as_stored=True))


def _bytes(image: np.ndarray) -> np.ndarray:
    return image[..., :3] if image.dtype == "uint8" else to_integers(as_floats(image[..., :3]), 8)


def _woven(slide: Slide, panel: Panel) -> np.ndarray:
    """Return the picture of a quilt on a panel, as `weave` makes it."""
    from lightfield_gs.encoding.weave import weave
    from lightfield_gs.view_sets.view_set import ViewSet, open_views

    found = open_views(slide.path)
    assert isinstance(found, ViewSet)
    return _bytes(weave(found.views, panel, aspect=found.aspect or panel.width_px / panel.height_px).numpy())


def _pair_pixels(path: Path, pair: PairLayout, layout: StereoLayout) -> np.ndarray:
    import torch

    from lightfield_gs.encoding.stereo import join_eyes
    from lightfield_gs.photo.stereo_pair import read_pair

    read = read_pair(path, pair)
    width = read.left.pixels.shape[1] // 2 * 2  # even, as halves take it
    eyes = [_bytes(eye.pixels[:, :width]) for eye in (read.left, read.right)]
    return join_eyes(torch.from_numpy(np.stack(eyes)), layout).numpy()


def native_frames(slide: Slide) -> Iterator[np.ndarray]:
    """Yield the frames of a film of native frames, uint8 [H, W, 3], as it shows them. Raises InputError."""
    from lightfield_gs.video.sequence import open_sequence

    frames = open_sequence(slide.path)
    if frames.files:
        yield from map(_bytes, map(partial(read_image, as_stored=True), frames.files))
        return
    for _, pixels in frames.frames(range(frames.count)):
        yield _bytes(pixels)
