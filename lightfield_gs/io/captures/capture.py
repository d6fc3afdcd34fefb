"""Captures: posed photographs of a static scene, and points on its surfaces where they are known."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from lightfield_gs.base.assumptions import assume
from lightfield_gs.base.checks import counted, real_number, whole_number
from lightfield_gs.base.errors import InputError, reading
from lightfield_gs.base.paths import checked_path
from lightfield_gs.io.captures.app_captures import app_shots
from lightfield_gs.io.captures.camera_models import Lens
from lightfield_gs.io.captures.colmap import colmap_shots, model_folder
from lightfield_gs.io.captures.masks import masks_for
from lightfield_gs.io.captures.photo_files import first_names
from lightfield_gs.io.captures.photograph import Photograph, Shot, Shots
from lightfield_gs.io.captures.transforms import has_frames, transforms_file, transforms_shots
from lightfield_gs.io.captures.undistortion import LARGEST_FOLDED_FRACTION, folded_fraction
from lightfield_gs.io.images import read_info

EVERY = 8  # one of so many photographs is held out where nothing says which
TestEvery = int | Literal["own"] | None  # see Capture.split
_ONE_PLACE = 1e-12  # of places' distance from the origin: cameras less far apart differ by rounding alone
_SMALLEST_PX = 16  # of a photograph's longer side that is asked for
_ARCHIVES = (b"PK\x03\x04", b"\x1f\x8b", b"7z\xbc\xaf\x27\x1c", b"Rar!", b"\xfd7zXZ", b"BZh")
_TAR = 257, b"ustar"
_FARTHEST = 1e4  # times the points' median distance from their median place: no structure from motion is that sure
_STRETCH = 0.01  # by which the two axes of a resized photograph may differ, beside the rounding of its size
_MARGIN = 1.1  # Kerbl et al.
_OUTLIER = 3.0  # times the median distance: from there on a camera does not count


@dataclass(frozen=True)
class Capture:
    """C photographs with their cameras, and P points.

    folder: where it is. names: sorted, relative to the folder of images, with / between folders. world_to_camera:
    [C,4,4] float64, OpenCV axes. intrinsics: [C,4] float64, (fx, fy, cx, cy), and sizes_px: [C,2] int, width and
    height, of what image(i) gives: undistorted, scaled, in pixels from the outer corner of the first. points: [P,3]
    float64, may be none; colours: [P,3] uint8. photographs: C, where image and mask come from. held_out: names of
    those that the capture itself keeps for tests; held_by: what says so.
    """

    folder: Path
    names: list[str]
    world_to_camera: np.ndarray
    intrinsics: np.ndarray
    sizes_px: np.ndarray
    points: np.ndarray
    colours: np.ndarray
    photographs: list[Photograph]
    held_out: tuple[str, ...] = ()
    held_by: str = ""

    def image(self, index: int) -> np.ndarray:
        """Photograph `index`, uint8 [H,W,3], sRGB, undistorted and scaled; decoded now. Raises InputError."""
        return self.photographs[index].image()

    def mask(self, index: int) -> np.ndarray | None:
        """What of photograph `index` counts, uint8 [H,W]: 255 does, 0 does not; None where all does. The least of its
        mask's file, its alpha, and what lies within the distorted frame. Raises InputError."""
        return self.photographs[index].mask()

    def opacity(self, index: int) -> np.ndarray | None:
        """As mask, of the mask's file and the alpha alone: where they are the target of the scene's alpha."""
        return self.photographs[index].opacity()

    def frame(self, index: int) -> np.ndarray | None:
        """As mask, of the distorted frame alone: nothing is known beyond it."""
        return self.photographs[index].frame()

    @property
    def centres(self) -> np.ndarray:
        """Where the cameras stand, [C,3] float64."""
        rotations, translations = self.world_to_camera[:, :3, :3], self.world_to_camera[:, :3, 3]
        return -(rotations.swapaxes(1, 2) @ translations[..., None])[..., 0]

    @property
    def extent(self) -> float:
        """The length that steps of positions are measured by, scene units, > 0; see spread.extent_of."""
        return scene_extent(self.centres, self.points)

    def split(self, test_every: TestEvery = "own", names: list[str] | None = None) -> tuple[list[int], list[int]]:
        """Indices of the photographs to fit to and of those held out to test, in order.

        test_every: k holds out index % k == k // 2, the middle of every k, so that the ends of an arc are never
        extrapolated; None: none; "own": those that the capture itself keeps for tests, which is said, or the middle of
        every EVERY. names: those to hold out instead, as in `names` or by their last part. Raises InputError for names
        that there are not, and where nothing is left to fit to.
        """
        if names is not None:
            test = sorted({self.index_of(name, "test photograph") for name in names})
        elif test_every == "own" and self.held_out:
            test = sorted(self.names.index(name) for name in self.held_out)
            assume(
                f"{counted(len(test), 'photograph', len(self.names), 'are held out')}, as {self.held_by} says: "
                f"{first_names(self.held_out)}; --test-every N holds out others"
            )
        elif test_every is None:
            test = []
        else:
            every = EVERY if test_every == "own" else whole_number("test_every", test_every, 2, 1 << 30)
            test = [index for index in range(len(self.names)) if index % every == every // 2]
        train = sorted(set(range(len(self.names))) - set(test))
        if not train:
            raise InputError(f"expected photographs to fit to, but all {len(self.names)} are held out to test")
        return train, test

    def index_of(self, name: str, what: str = "photograph") -> int:
        """The index of a photograph by its name, or the last part of it; `what` it is for. Raises InputError."""
        if name in self.names:
            return self.names.index(name)
        found = [index for index, known in enumerate(self.names) if known.rsplit("/", 1)[-1] == name]
        if len(found) != 1:
            raise InputError(
                f"{what} {name}: expected the name of one of the {len(self.names)} photographs, as "
                f"{self.names[0]}, got one that {len(found) or 'none'} of them has"
            )
        return found[0]


def read_capture(
    folder: str | Path,
    *,
    images: str | Path | None = None,
    masks: str | Path | None = None,
    scale: float | None = None,
    longest_px: int | None = None,
) -> Capture:
    """The capture in a folder: photographs that COLMAP posed (sparse/0, sparse, or the files of a model in the folder),
    or those of a transforms.json, which may be given itself, or of transforms_train.json with its tests beside it; what
    Polycam and Record3D keep, and a cameras.json beside photographs. Photographs that are missing or damaged are left
    out, as long as enough are left.

    images: the folder of the photographs, absolute or below `folder`; None: images, or what else has them. The size of
    the files is what counts: intrinsics are scaled by its ratio to the model's cameras, for each axis. masks: the
    folder of masks; None: masks, where there is one. scale: 0..1, shrinks the photographs in memory by an area filter;
    longest_px: shrinks those whose longer side is longer. What is assumed is said (base/assumptions.py). Raises
    InputError that names what is missing or wrong.
    """
    folder = checked_path(folder)
    if scale is not None and longest_px is not None:
        raise InputError("expected scale or longest_px, got both")
    share = 1.0 if scale is None else real_number("scale", scale, 1e-3, 1)
    longest = None if longest_px is None else whole_number("longest_px", longest_px, _SMALLEST_PX, 1 << 20)
    root = folder.parent if folder.is_file() else folder
    masks_at = None if masks is None else folder_in("masks", root, masks)
    found = _read_layout(folder, None if images is None else folder_in("images", root, images), masks_at)
    shots = sorted(found.shots, key=lambda shot: shot.name)
    photographs = _photographs(found, shots, root, masks_at, share, longest)
    points, colours = _usable_points(found)
    if not len(points):
        assume(f"{found.source} has no points of the scene: a fit begins at random ones")
    _say_one_place([shot.world_to_camera for shot in shots])
    sizes = np.array([photograph.size_px for photograph in photographs])
    stored = np.array([photograph.stored_px for photograph in photographs])
    return Capture(
        root,
        [shot.name for shot in shots],
        np.stack([shot.world_to_camera for shot in shots]),
        np.array([photograph.intrinsics for photograph in photographs]) * np.tile(sizes / stored, 2),
        sizes,
        points,
        colours,
        photographs,
        found.held_out,
        found.held_by,
    )


def _say_one_place(world_to_camera: Sequence[np.ndarray]) -> None:
    """Says where no two cameras [4,4] are apart."""
    centres = [-pose[:3, :3].T @ pose[:3, 3] for pose in world_to_camera]
    if len(centres) > 1 and float(np.ptp(centres, axis=0).max()) <= _ONE_PLACE * float(np.abs(centres).max()):
        assume(f"all {len(centres)} photographs are from one place: nothing says how far away what they show is")


def _read_layout(folder: Path, images: Path | None, masks: Path | None) -> Shots:
    """What the capture says, by what is in its folder; raises InputError."""
    if not folder.exists():
        raise InputError(f"{folder}: no such folder: expected a capture, with sparse/0 or transforms.json")
    file = transforms_file(folder)
    model = model_folder(folder, inner=file is None)
    if model is not None:
        if file is not None:
            assume(f"the COLMAP model {model} is read, not {file}: give that file itself to read it")
        return colmap_shots(folder, images, masks)
    if (file is None or file == folder) and (found := app_shots(folder, images)) is not None:
        return found
    if file is not None:
        return transforms_shots(file, images, file == folder)
    if folder.is_file():
        raise InputError(f"{folder}: {_what_to_give(folder)}")
    if (above := _capture_above(folder)) is not None:
        raise InputError(f"{folder}: is one folder of a capture: give the folder above, {above}")
    if below := _captures_below(folder):
        which = f"one of {len(below)} that it holds" if len(below) > 1 else "the one that it holds"
        raise InputError(f"{folder}: is no capture: give {which}, {', '.join(map(str, below[:3]))}")
    raise InputError(
        f"{folder}: expected a capture: a COLMAP model (images.bin or images.txt, cameras, points3D) in sparse/0, "
        "sparse or the folder itself, or a transforms.json (one of another name is given itself); photographs alone "
        "need --sfm first, which poses them"
    )


def _capture_above(folder: Path) -> Path | None:
    """The nearest of the two folders above that is a capture; None where neither is."""
    above = folder.absolute().parents[:2]
    return next((path for path in above if model_folder(path) is not None or transforms_file(path) is not None), None)


def _captures_below(folder: Path) -> list[Path]:
    """What is a capture in a folder that is none: files of frames by other names than usual, or else the folders that
    are, as deep as COLMAP's dense/0."""
    with reading(folder):
        if files := [path for path in sorted(folder.glob("*.json")) if has_frames(path)]:
            return files
        folders = [path for depth in ("*/", "*/*/") for path in sorted(folder.glob(depth))]
    found = [path for path in folders if model_folder(path) is not None or transforms_file(path) is not None]
    return [path for path in found if not any(other in path.parents for other in found)]


def _what_to_give(file: Path) -> str:
    """What a file is that is no capture, and the way out."""
    with reading(file), file.open("rb") as opened:
        start = opened.read(512)
    if start.startswith(_ARCHIVES) or start[_TAR[0] :].startswith(_TAR[1]):
        return "is an archive: unpack it, and give the folder that comes out of it"
    if file.stem in ("images", "cameras", "points3D", "frames", "rigs"):
        return f"is one file of a COLMAP model: give the folder {file.parent}"
    return (
        "expected a capture, got a file of another kind: give the folder that has the photographs and COLMAP's "
        "sparse/0 or a transforms.json, or such a .json itself"
    )


def folder_in(what: str, capture: Path, given: str | Path) -> Path:
    """A folder that was given by its path, or by its name below the capture; raises InputError."""
    below = capture / checked_path(given)
    for path in (below, Path(given)):
        if path.is_dir():
            return path
    raise InputError(f"{what}: expected a folder, got {given}: there is none at {below}")


def _photographs(
    found: Shots, shots: Sequence[Shot], folder: Path, masks: Path | None, share: float, longest_px: int | None
) -> list[Photograph]:
    """The photographs of these shots, made smaller by `share`, and to `longest_px` where they are longer."""
    infos = [read_info(shot.path) for shot in shots]
    alphas = [info.has_alpha for info in infos]
    mask_paths = masks_for(found, shots, folder, masks, alphas)
    photographs, checked = [], set()
    for shot, info, mask, alpha in zip(shots, infos, mask_paths, alphas):
        stored = info.width_px, info.height_px
        _check_size(shot, stored, info.orientation)
        ratio = np.array(stored) / shot.camera_px
        intrinsics = tuple((shot.intrinsics * np.tile(ratio, 2)).tolist())
        if shot.lens is not None and (key := (shot.lens, intrinsics, stored)) not in checked:
            checked.add(key)
            _check_lens(shot, shot.lens, np.array(intrinsics), stored)
        size = _size(stored, share, longest_px)
        photographs.append(Photograph(shot.path, stored, size, intrinsics, shot.lens, mask, alpha, info.orientation))
    _say_sizes(shots, photographs)
    return photographs


def _usable_points(found: Shots) -> tuple[np.ndarray, np.ndarray]:
    """Points [P,3] and colours [P,3] without those that are not finite or absurdly far away."""
    points = found.points
    good = np.isfinite(points).all(1) & (np.abs(points).max(1, initial=0) < 1e12)
    if good.any():
        away = np.full(len(points), np.inf)
        away[good] = np.linalg.norm(points[good] - np.median(points[good], 0), axis=1)
        good &= away <= max(_FARTHEST * float(np.median(away[good])), 1e-9)
    if not good.all():
        words = counted(int((~good).sum()), "point", len(good), "are not finite or absurdly far, and left out")
        assume(f"{found.source}: {words}")
    return points[good], found.colours[good]


def _size(stored: tuple[int, int], share: float, longest_px: int | None) -> tuple[int, int]:
    if longest_px is not None:
        share = min(1.0, longest_px / max(stored))
    width, height = (max(1, round(side * share)) for side in stored)
    return width, height


def _check_size(shot: Shot, stored: tuple[int, int], orientation: int) -> None:
    """Raises InputError for a file whose shape is not that of its camera's pictures, up to rounding."""
    (width, height), (camera_width, camera_height) = stored, shot.camera_px
    # The size was rounded up or down by less than a pixel, each way
    slack = 1 / min(width, height) + 1 / min(camera_width, camera_height) + _STRETCH
    if abs(width * camera_height / (height * camera_width) - 1) <= slack:
        return
    turned = orientation >= 5 and abs(height * camera_height / (width * camera_width) - 1) <= slack
    way_out = (
        f": as stored it lies on its side (Exif orientation {orientation}): store photographs turned (ImageMagick: "
        "mogrify -auto-orient), or find the poses with the orientation left alone"
        if turned
        else ": a photograph may be resized, but not cropped or turned, after it was posed"
    )
    raise InputError(
        f"{shot.path}: expected the shape of its camera's pictures, {camera_width} x {camera_height}, got "
        f"{width} x {height}{way_out}"
    )


def _check_lens(shot: Shot, lens: Lens, intrinsics: np.ndarray, stored: tuple[int, int]) -> None:
    """Raises InputError for a lens that makes no picture; says what of a fisheye's is seen."""
    if (lost := folded_fraction(lens, intrinsics, *stored)) > LARGEST_FOLDED_FRACTION:
        raise InputError(
            f"{shot.path}: the lens {lens.words} folds {lost:.0%} of the picture onto the rest: expected "
            "coefficients that straighten it; pose the photographs again with a simpler camera model"
        )
    if lens.fisheye:
        before, after = intrinsics[2:] / intrinsics[:2], (stored - intrinsics[2:]) / intrinsics[:2]
        wide, high = np.degrees(np.arctan(before) + np.arctan(after))
        assume(
            f"fisheye photographs as {shot.name} are seen as a pinhole of their focal length sees the scene, "
            f"{wide:.0f} x {high:.0f} degrees; what they show beyond is not used"
        )


def _say_sizes(shots: Sequence[Shot], photographs: Sequence[Photograph]) -> None:
    resized = [photo for shot, photo in zip(shots, photographs) if photo.stored_px != shot.camera_px]
    if resized:
        first = resized[0]
        was = next(shot.camera_px for shot, photo in zip(shots, photographs) if photo is first)
        assume(
            f"{counted(len(resized), 'photograph', len(shots), 'are not of the posed size and were resized')}: "
            f"{first.path.name} is {first.stored_px[0]} x {first.stored_px[1]}, its camera {was[0]} x {was[1]}; "
            "intrinsics are scaled by the ratio of each axis"
        )


def scene_extent(centres: np.ndarray, points: np.ndarray) -> float:
    """The extent of a scene, scene units, > 0, from where cameras stand [C,3] and points [P,3].

    As Kerbl et al., "3D Gaussian Splatting" (2023), have it: 1.1 times the largest distance of a camera from the mean
    of all; but of those cameras alone that stand within 3 times the median distance from the median place (of each
    coordinate), so that one pose that is wrong does not blow it up. For a ring of cameras it is 1.1 times the radius.
    Where all cameras stand at one place: the median distance of the points from it; without points, 1.
    """
    away = np.linalg.norm(centres - np.median(centres, 0), axis=1)
    kept = centres[away <= max(_OUTLIER * float(np.median(away)), 1e-12 * float(np.abs(centres).max()))]
    radius = _MARGIN * float(np.linalg.norm(kept - kept.mean(0), axis=1).max()) if len(kept) else 0.0
    if radius > 1e-9 * (1 + float(np.abs(centres).max())):
        return radius
    distance = float(np.median(np.linalg.norm(points - centres.mean(0), axis=1))) if len(points) else 0.0
    return distance if distance > 0 else 1.0
