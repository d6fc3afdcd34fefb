"""The strip of a page: pictures that it may open, from a folder or dropped on it."""

from __future__ import annotations

import re
import shutil
import threading
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import partial
from io import BufferedIOBase
from pathlib import Path

from lightfield_gs.base.cli_messages import note
from lightfield_gs.base.errors import InputError
from lightfield_gs.base.system import check_name
from lightfield_gs.io.thumbnails import thumbnail
from lightfield_gs.show.page.lines import Lines
from lightfield_gs.show.page.server import Answer, Query, Reservation, Route, as_json, number, text
from lightfield_gs.show.page.stage import Stage, StagedScene

_THUMBNAIL_PX = 192
_MOST_DROPPED, _MOST_DROPPED_BYTES = 1000, 8 << 30  # files of one run of the program
_CHUNK_BYTES = 1 << 20


@dataclass(frozen=True)
class Item:
    """A picture of the strip.

    Attributes:
        path: The photo or the scene.
        is_scene: Whether it is a file of Gaussians, of which there is no small picture.
        is_dropped: Whether it came by the page.
    """

    path: Path
    is_scene: bool
    is_dropped: bool = False


class Gallery:
    """Pictures that the page may open, one of which is on the stage.

    Args:
        paths: The pictures at first.
        shown: The place of the one on the stage.
        read: Reads a picture for the stage, and is told whether it was dropped; raises InputError.
        find: Returns the photos and scenes of a folder, in order.
        is_scene: Whether a path is a file of Gaussians.
        suffixes: Those of the files that may be dropped, in lower case.
        folder: An empty folder for these files.
    """

    def __init__(
        self,
        paths: Iterable[Path],
        shown: int,
        read: Callable[[Path, bool], StagedScene],
        find: Callable[[Path], list[Path]],
        is_scene: Callable[[Path], bool],
        suffixes: Iterable[str],
        folder: Path,
    ):
        self._is_scene, self._read, self._find, self._folder = is_scene, read, find, folder
        self._items, self._shown = [Item(path, is_scene(path)) for path in paths], shown
        self._suffixes, self._turn, self._dropped, self._bytes = frozenset(suffixes), threading.Lock(), 0, 0

    def routes(self, stage: Stage, lines: Lines, token: str) -> dict[str, Route]:
        """Return the addresses of the strip."""
        return {
            "/gallery.json": Route(lambda query: as_json(self._facts())),
            "/thumbnail": Route(self._thumbnail, place=lambda query: Reservation(False)),
            "/open": Route(partial(self._open, stage, lines), token),
            "/drop": Route(lambda query: text("", 204), token, take=self._take),
            "/dropped": Route(self._list, token),
        }

    def _facts(self) -> dict[str, object]:
        items = [{"name": item.path.name, "is_scene": item.is_scene} for item in self._items]
        return {"items": items, "shown": self._shown, "suffixes": sorted(self._suffixes)}

    def _item(self, query: Query) -> int:
        return int(number(query, "item", 0, len(self._items) - 1))

    def _thumbnail(self, query: Query) -> Answer:
        """Return a small picture of a photo; 404 where there is none."""
        item = self._items[self._item(query)]
        try:
            return Answer(thumbnail(item.path, _THUMBNAIL_PX), "image/webp")
        except InputError:
            return text("there is no small picture of this file", 404)

    def _open(self, stage: Stage, lines: Lines, query: Query) -> Answer:
        """Show an item on the stage. Of what is wrong with it the page says the reason, the terminal all."""
        place = self._item(query)

        def read() -> None:
            item = self._items[place]
            try:
                scene = self._read(item.path, item.is_dropped)
            except InputError as error:
                note(str(error))
                raise InputError(_reason(error, item.path)) from error
            stage.place(scene)
            self._shown = place

        lines.last(read)
        return as_json(self._facts())

    def _take(self, query: Query, stream: BufferedIOBase, size: int) -> None:
        """Write a dropped file. Raises InputError before any of it is read."""
        path = self._of_drop(query) / _plain_name(query.get("name", ""))
        if path.suffix.lower() not in self._suffixes:
            raise InputError(f"{path.name} is neither a photo nor a scene")
        with self._turn:
            self._dropped, self._bytes = self._dropped + 1, self._bytes + size
            if self._dropped > _MOST_DROPPED or self._bytes > _MOST_DROPPED_BYTES:
                raise InputError("too many files were dropped; end the program and start it again")
        path.parent.mkdir(exist_ok=True)
        left = size
        with path.open("wb") as file:
            while left:
                chunk = stream.read(min(left, _CHUNK_BYTES))
                if not chunk:
                    break
                left -= file.write(chunk)
        if left:  # the browser has gone
            path.unlink()
            raise ConnectionError

    def _list(self, query: Query) -> Answer:
        """Add the files of a drop to the strip, and return it with the place of the first."""
        folder = self._of_drop(query)
        known = {item.path for item in self._items}
        found = [path for path in (self._find(folder) if folder.is_dir() else []) if path not in known]
        if not found:
            shutil.rmtree(folder, ignore_errors=True)
            raise InputError("none of the files is a photo or a scene")
        with self._turn:
            first = len(self._items)
            self._items += [Item(path, self._is_scene(path), is_dropped=True) for path in found]
        return as_json({**self._facts(), "first": first})

    def _of_drop(self, query: Query) -> Path:
        """Return the folder of the files that were dropped together."""
        return self._folder / str(int(number(query, "drop", 0, 1 << 53)))


def _reason(error: InputError, path: Path) -> str:
    """Return why a file cannot be opened, without the advice and the options that follow it."""
    return re.split(r"[;:] ", str(error).replace(str(path), path.name))[0]


def _plain_name(name: str) -> str:
    """Return the name of a file without its folders. Raises InputError for names that lead elsewhere."""
    plain = re.split(r"[/\\]", name)[-1]
    if not plain or plain.startswith(".") or len(plain.encode()) > 200 or not plain.isprintable():
        raise InputError(f"{plain[:40]!r} is no name of a file")
    check_name(Path(plain))
    return plain
