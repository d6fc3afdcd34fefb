"""Objects in a folder, each in either layout: SRN or transforms.json (see lightfield_gs.io.captures).

An object is named by a path: the folder of an SRN object, or the transforms file of the other layout. The views of an
object may come in splits of their own: transforms_train.json, transforms_val.json and transforms_test.json. A
transforms.json beside them is not read. An object without splits belongs to all of them.
"""

from __future__ import annotations

from pathlib import Path

from lightfield_gs.base.errors import InputError
from lightfield_gs.io.captures.objects import PARTS, ObjectImages, read_nerf_object, read_srn_object
from training.data.distance import at_object_distance

SPLITS = ("train", "val", "test")
_WHOLE = "transforms.json"
MAKE_SMALL = "python -m training.data.make_small --output data/small"


def find_objects(root: Path, split: str | None = None) -> list[Path]:
    """Return all objects at or below root, sorted.

    Args:
        split: "train", "val" or "test": of objects that come in splits only this one; None: all.

    Raises:
        InputError: there is no object.
    """
    root = Path(root)
    if not root.is_dir():
        raise InputError(
            f"{root}: expected a folder of objects (SRN layout or transforms.json), found no such folder. "
            f"To try with made-up objects: {MAKE_SMALL}"
        )
    wanted = {f"transforms_{name}.json" for name in (SPLITS if split is None else (split,))}
    # Renderers of SRN sets leave a transforms.json of their own in pose/.
    transforms = {path for path in root.rglob("transforms*.json") if path.parent.name not in PARTS}
    in_splits = {path for path in transforms if path.name in {f"transforms_{name}.json" for name in SPLITS}}
    whole = {path for path in transforms if path.name == _WHOLE} - {path.parent / _WHOLE for path in in_splits}
    srn = {path.parent for part in PARTS for path in root.rglob(part)} - {path.parent for path in in_splits | whole}
    found = sorted({path for path in in_splits if path.name in wanted} | whole | srn)
    if not found:
        raise InputError(
            f"{root}: found no object: expected <object>/rgb, <object>/pose and <object>/intrinsics.txt, "
            f"or <object>/{_WHOLE} or {', '.join(sorted(wanted))}. To try with made-up objects: "
            f"{MAKE_SMALL}"
        )
    return found


def read_object(path: Path) -> ObjectImages:
    """Cameras of one object, as find_objects names it, and the files of its images (not decoded here).

    Raises InputError that names the first thing wrong.
    """
    path = Path(path)
    if path.is_dir():
        return read_srn_object(path)
    both = [part for part in ("pose", "intrinsics.txt") if (path.parent / part).exists()]
    if both:
        raise InputError(f"{path}: expected one layout, found {both[0]} of the SRN layout beside it: remove one")
    return at_object_distance(path, read_nerf_object(path))


def object_folder(path: Path) -> Path:
    """The folder that holds all files of an object, as find_objects names it."""
    return path if path.is_dir() else path.parent
