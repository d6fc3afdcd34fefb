"""A contact sheet: the views of objects, with a tint over the parts that training leaves out."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw

from lightfield_gs.base.errors import InputError
from lightfield_gs.io.atomic import atomic_path, check_output_path
from lightfield_gs.io.captures.objects import ObjectImages
from training.data.images import Cutout, read_colours, read_view

_THUMB_PX, _VIEWS, _OBJECTS, _TITLE_PX, _GAP_PX = 128, 8, 40, 14, 4
_TINT, _TINT_SHARE = np.array([255, 0, 255]), 0.65  # magenta: few objects have it
_PAPER, _INK, _FAULT = (32, 32, 32), (230, 230, 230), (255, 90, 90)


@dataclass
class Sheet:
    """Rows of views, each under a title, of up to 40 of `count` objects, evenly spread; the pictures are small."""

    count: int
    _rows: list[tuple[str, list[Image.Image]]] = field(default_factory=list)
    _seen: int = 0

    def add(self, title: str, views: ObjectImages | None, cutout: Cutout | None) -> None:
        """The next of the objects, with up to 8 of its views, evenly spread; None: it could not be read."""
        shown = min(_OBJECTS, self.count)
        chosen = {number * self.count // shown for number in range(shown)}
        if self._seen in chosen:
            count = 0 if views is None or cutout is None else len(views.image_paths)
            numbers = [index * count // min(_VIEWS, count) for index in range(min(_VIEWS, count))]
            self._rows.append((title, [_thumb(views, number, cutout) for number in numbers]))
        self._seen += 1

    def write(self, path: Path) -> str:
        """Write the PNG, complete or not at all; return a description for people."""
        height = max((picture.height for _, pictures in self._rows for picture in pictures), default=0)
        row_px = height + _TITLE_PX + _GAP_PX
        sheet = Image.new("RGB", (_GAP_PX + _VIEWS * (_THUMB_PX + _GAP_PX), max(1, row_px * len(self._rows))), _PAPER)
        pen = ImageDraw.Draw(sheet)
        for number, (title, pictures) in enumerate(self._rows):
            top = number * row_px
            pen.text((_GAP_PX, top), title.encode("ascii", "replace").decode()[:170], fill=_INK if pictures else _FAULT)
            for column, picture in enumerate(pictures):
                sheet.paste(picture, (_GAP_PX + column * (_THUMB_PX + _GAP_PX), top + _TITLE_PX))
        with atomic_path(path) as temporary:
            sheet.save(temporary, format="PNG")
        return (
            f"{path}: {len(self._rows)} of {self.count} objects, at most {_VIEWS} views each; what training leaves "
            "out is magenta"
        )


def check_sheet_path(path: Path) -> Path:
    """`path`, if a sheet can be written there; raises InputError."""
    if path.suffix.lower() != ".png":
        raise InputError(f"cannot write {path}: expected a contact sheet's name to end in .png")
    return check_output_path(path)


def _thumb(views: ObjectImages, index: int, cutout: Cutout) -> Image.Image:
    """A view, reduced, its background under the tint; all of it red where it cannot be read."""
    scale = _THUMB_PX / max(views.width_px, views.height_px)
    size = tuple(max(1, round(side * scale)) for side in (views.width_px, views.height_px))
    try:
        frame = read_view(views, index, cutout).astype(np.float32)
        left_out = (1 - frame[..., 3:] / 255) * (_TINT_SHARE * _TINT + (1 - _TINT_SHARE) * read_colours(views, index))
    except InputError:
        return Image.new("RGB", size, _FAULT)
    picture = np.clip(frame[..., :3] + left_out, 0, 255).astype(np.uint8)
    return Image.fromarray(picture).resize(size, Image.Resampling.BOX if scale < 1 else Image.Resampling.NEAREST)
