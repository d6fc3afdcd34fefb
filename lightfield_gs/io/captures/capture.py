"""Captures: posed photographs of a static scene, and points on its surfaces where they are known."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from lightfield_gs.base.assumptions import assume
from lightfield_gs.base.checks import counted, real_number, whole_number
from lightfield_gs.base.errors import InputError, reading
from lightfield_gs.base.options import CameraModel, TestEvery
from lightfield_gs.io.atomic import checked_path
from lightfield_gs.io.captures.app_captures import read_app_capture
from lightfield_gs.io.captures.camera_models import Distortion
from lightfield_gs.io.captures.colmap import model_folder, read_colmap_capture
from lightfield_gs.io.captures.masks import find_capture_masks
from lightfield_gs.io.captures.photo_files import first_names
from lightfield_gs.io.captures.photograph import Photograph, PosedCapture, PosedPhotograph
from lightfield_gs.io.captures.transforms import has_frames, read_transforms_capture, transforms_file
from lightfield_gs.io.captures.undistortion import LARGEST_FOLDED_FRACTION, folded_fraction
from lightfield_gs.io.file_kinds import VIDEO_INPUTS
from lightfield_gs.io.images import read_info

EVERY = 8  # one in EVERY photographs is held out by default
_SAME_POSITION = 1e-12  # of the distance from the origin: closer centres differ by rounding
SMALLEST_PX = 16  # least longest_px
_ARCHIVES = (b"PK\x03\x04", b"\x1f\x8b", b"7z\xbc\xaf\x27\x1c", b"Rar!", b"\xfd7zXZ", b"BZh")
_TAR = 257, b"ustar"
_FARTHEST = 1e4  # times the points' median distance from their median: beyond, structure from motion is unreliable
_STRETCH = 0.01  # largest difference in scale of the two axes of a resized photograph, beside rounding
_MARGIN = 1.1  # Kerbl et al.
_OUTLIER = 3.0  # times the median distance: cameras beyond are outliers


@dataclass(frozen=True)
class Capture:
    """C photographs with their cameras, and P points.

    Attributes:
        folder: the capture's folder.
        names: sorted, relative to the folder of images, with / between folders.
        world_to_camera: [C,4,4] float64, OpenCV axes.
        intrinsics: [C,4] float64, (fx, fy, cx, cy) of image(i), in pixels from the outer corner of the first.
        sizes_px: [C,2] int, width and height of image(i): undistorted and reduced.
        points: [P,3] float64; P may be 0.
        colours: [P,3] uint8.
        photographs: C, the files of images and masks.
        held_out: names of the photographs that the capture itself holds out for tests.
        held_by: the file or field that holds them out.
        is_whole: whether the photographs have the size of their files, because nobody chose another.
        model: of all cameras, as in scene.Cameras; fisheyes are equidistant, equirectangular images are half rounds.
        readouts: [C,2,3] float64, of cameras that moved while their rolling shutters read from top to bottom: the turn
            of world to camera (a rotation vector, radians), and the way of the centre (scene units), both in the camera
            axes at the pose. The pose is that of the middle of the readout. None: all stood still.
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
    is_whole: bool = False
    model: CameraModel = "pinhole"
    readouts: np.ndarray | None = None

    def image(self, index: int) -> np.ndarray:
        """Decode a photograph: uint8 [H,W,3], sRGB, undistorted and reduced. Raises InputError."""
        return self.photographs[index].image()

    def mask(self, index: int) -> np.ndarray | None:
        """Return the mask of a photograph: uint8 [H,W], 255 where it counts and 0 where not; None where all counts.

        It is the least of the mask's file, the photograph's alpha and its valid area. Raises InputError.
        """
        return self.photographs[index].mask()

    def opacity(self, index: int) -> np.ndarray | None:
        """Return the mask of the mask's file and the alpha alone: the target of the scene's alpha. See `mask`."""
        return self.photographs[index].opacity()

    def valid_area(self, index: int) -> np.ndarray | None:
        """Return the mask of the distorted photograph's frame alone: nothing is known beyond it. See `mask`."""
        return self.photographs[index].valid_area()

    @property
    def may_be_masked(self) -> bool:
        """Whether a photograph may have pixels that do not count; only decoding tells for sure."""
        several = len(np.unique(self.sizes_px, axis=0)) > 1
        return several or any(photograph.may_be_masked for photograph in self.photographs)

    @property
    def centres(self) -> np.ndarray:
        """Camera centres, [C,3] float64."""
        rotations, translations = self.world_to_camera[:, :3, :3], self.world_to_camera[:, :3, 3]
        return -(rotations.swapaxes(1, 2) @ translations[..., None])[..., 0]

    @property
    def extent(self) -> float:
        """The length that steps of positions are measured by, scene units, > 0. See scene_extent."""
        return scene_extent(self.centres, self.points)

    def reduced(self, longest_px: int) -> Capture:
        """Return the capture with photographs whose longer side has `longest_px` at most, >= 16."""
        photographs = [
            replace(photograph, size_px=_reduced_size(photograph.size_px, 1.0, longest_px))
            for photograph in self.photographs
        ]
        sizes = np.array([photograph.size_px for photograph in photographs])
        intrinsics = self.intrinsics * np.tile(sizes / self.sizes_px, 2)
        return replace(self, photographs=photographs, sizes_px=sizes, intrinsics=intrinsics, is_whole=False)

    def split(self, test_every: TestEvery = "own", names: list[str] | None = None) -> tuple[list[int], list[int]]:
        """Split the photographs into photographs to fit to and held-out photographs.

        Args:
            test_every: k holds out index % k == k // 2, the middle of every k, so that the ends of an arc are never
                extrapolated. None holds out none. "own" holds out the capture's own test photographs, with a note, or
                else the middle of every EVERY.
            names: photographs to hold out instead, as in `names` or by their file names.

        Returns:
            Indices to fit to and indices to test, both in order.

        Raises:
            InputError: for unknown names, and where nothing is left to fit to.
        """
        if names is not None:
            test = sorted({self.find_index(name, "test photograph") for name in names})
        elif test_every == "own" and self.held_out:
            test = sorted(self.names.index(name) for name in self.held_out)
            assume(
                f"{counted(len(test), 'photograph', len(self.names), 'are held out')}, as {self.held_by} says: "
                f"{first_names(self.held_out)}; test_every=N holds out others"
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

    def find_index(self, name: str, what: str = "photograph") -> int:
        """Return the index of a photograph by its name or its file name.

        Args:
            name: as in `names`, or its last part.
            what: the kind of photograph, for the message.

        Raises:
            InputError: where no photograph, or several, have this name.
        """
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
    """Read a capture.

    Layouts are a COLMAP model (sparse/0, sparse, or the folder itself), a transforms.json, Polycam's or Record3D's
    data, and a cameras.json beside photographs. Missing and damaged photographs are left out as long as enough are
    left. Every assumption is noted (base/assumptions.py).

    Args:
        folder: the capture, or a transforms.json itself; transforms_train.json brings its tests along.
        images: the folder of the photographs, absolute or below `folder`; None: the layout's own. The size of the
            files counts: each axis of the intrinsics is scaled by the ratio to the model's cameras.
        masks: the folder of masks; None: a folder with a usual name, if any.
        scale: reduces the photographs by an area filter, 0.001..1.
        longest_px: reduces photographs whose longer side is longer.

    Raises:
        InputError: names the missing or wrong file or field.
    """
    folder = checked_path(folder)
    if scale is not None and longest_px is not None:
        raise InputError("expected scale or longest_px, got both")
    is_whole = scale is None and longest_px is None
    scale = 1.0 if scale is None else real_number("scale", scale, 1e-3, 1)
    longest = None if longest_px is None else whole_number("longest_px", longest_px, SMALLEST_PX, 1 << 20)
    root = folder.parent if folder.is_file() else folder
    masks_at = None if masks is None else folder_in("masks", root, masks)
    layout = _read_layout(folder, None if images is None else folder_in("images", root, images), masks_at)
    posed = sorted(layout.photographs, key=lambda photograph: photograph.name)
    photographs = _photographs(layout, posed, root, masks_at, scale, longest)
    points, colours = _usable_points(layout)
    if not len(points):
        assume(f"{layout.source} has no points of the scene: a fit begins at random ones")
    _note_single_position([photograph.world_to_camera for photograph in posed])
    sizes = np.array([photograph.size_px for photograph in photographs])
    stored = np.array([photograph.stored_px for photograph in photographs])
    return Capture(
        root,
        [photograph.name for photograph in posed],
        np.stack([photograph.world_to_camera for photograph in posed]),
        np.array([photograph.intrinsics for photograph in photographs]) * np.tile(sizes / stored, 2),
        sizes,
        points,
        colours,
        photographs,
        layout.held_out,
        layout.held_by,
        is_whole,
        photographs[0].model,
        _readouts(posed),
    )


def _readouts(posed: Sequence[PosedPhotograph]) -> np.ndarray | None:
    """Return turn and way of all cameras [C,2,3], zeros of those that stood still; None where all did."""
    if all(photograph.readout is None for photograph in posed):
        return None
    return np.stack([np.zeros((2, 3)) if one.readout is None else one.readout for one in posed])


def _note_single_position(world_to_camera: Sequence[np.ndarray]) -> None:
    """Note that all cameras [4,4] stand in one place."""
    centres = [-pose[:3, :3].T @ pose[:3, 3] for pose in world_to_camera]
    if len(centres) > 1 and float(np.ptp(centres, axis=0).max()) <= _SAME_POSITION * float(np.abs(centres).max()):
        assume(f"all {len(centres)} photographs are from one place: nothing says how far away what they show is")


def _read_layout(folder: Path, images: Path | None, masks: Path | None) -> PosedCapture:
    """Read the capture by the files in its folder. Raises InputError."""
    if not folder.exists():
        raise InputError(f"{folder}: no such folder: expected a capture, with sparse/0 or transforms.json")
    file = transforms_file(folder)
    model = model_folder(folder, inner=file is None)
    if model is not None:
        if file is not None:
            assume(f"the COLMAP model {model} is read, not {file}: give that file itself to read it")
        return read_colmap_capture(folder, images, masks)
    if (file is None or file == folder) and (found := read_app_capture(folder, images)) is not None:
        return found
    if file is not None:
        return read_transforms_capture(file, images, file == folder)
    if folder.is_file():
        raise InputError(f"{folder}: {_explain_file(folder)}")
    if (above := _capture_above(folder)) is not None:
        raise InputError(f"{folder}: is one folder of a capture: give the folder above, {above}")
    if below := _captures_below(folder):
        which = f"one of {len(below)} that it holds" if len(below) > 1 else "the one that it holds"
        raise InputError(f"{folder}: is no capture: give {which}, {', '.join(map(str, below[:3]))}")
    raise InputError(
        f"{folder}: expected a capture: a COLMAP model (images.bin or images.txt, cameras, points3D) in sparse/0, "
        "sparse or the folder itself, or a transforms.json (one of another name is given itself); photographs alone "
        "need sfm=True first, which poses them"
    )


def _capture_above(folder: Path) -> Path | None:
    """Return the nearest of the two folders above that is a capture; None where neither is."""
    above = folder.absolute().parents[:2]
    return next((path for path in above if model_folder(path) is not None or transforms_file(path) is not None), None)


def _captures_below(folder: Path) -> list[Path]:
    """Return captures in a folder that is none: JSON files with frames, or folders, as deep as COLMAP's dense/0."""
    with reading(folder):
        if files := [path for path in sorted(folder.glob("*.json")) if has_frames(path)]:
            return files
        folders = [path for depth in ("*/", "*/*/") for path in sorted(folder.glob(depth))]
    found = [path for path in folders if model_folder(path) is not None or transforms_file(path) is not None]
    return [path for path in found if not any(other in path.parents for other in found)]


def _explain_file(file: Path) -> str:
    """Tell the kind of a file that is no capture, and the way out."""
    with reading(file), file.open("rb") as opened:
        start = opened.read(512)
    if start.startswith(_ARCHIVES) or start[_TAR[0] :].startswith(_TAR[1]):
        return "is an archive: unpack it, and give the folder that comes out of it"
    if file.suffix.lower() in VIDEO_INPUTS:
        return "is a film without cameras: sfm=True chooses frames and finds their cameras"
    if file.stem in ("images", "cameras", "points3D", "frames", "rigs"):
        return f"is one file of a COLMAP model: give the folder {file.parent}"
    return (
        "expected a capture, got a file of another kind: give the folder that has the photographs and COLMAP's "
        "sparse/0 or a transforms.json, or such a .json itself"
    )


def folder_in(what: str, capture: Path, given: str | Path) -> Path:
    """Return a folder that was given by its path, or by its name below the capture. Raises InputError."""
    below = capture / checked_path(given)
    for path in (below, Path(given)):
        if path.is_dir():
            return path
    raise InputError(f"{what}: expected a folder, got {given}: there is none at {below}")


def _photographs(
    layout: PosedCapture,
    posed: Sequence[PosedPhotograph],
    folder: Path,
    masks: Path | None,
    scale: float,
    longest_px: int | None,
) -> list[Photograph]:
    """Make the photographs of a capture from its posed files.

    Args:
        layout: the capture as its layout has it, for masks and messages.
        posed: its photographs, sorted.
        folder: the capture's folder.
        masks: the folder of masks that was given.
        scale: reduces all photographs.
        longest_px: reduces images with a longer side; replaces `scale`.
    """
    infos = [read_info(photograph.path) for photograph in posed]
    alphas = [info.has_alpha for info in infos]
    mask_paths = find_capture_masks(layout, posed, folder, masks, alphas)
    photographs, checked = [], set()
    model = _common_model(layout, posed)
    for photograph, info, mask, alpha in zip(posed, infos, mask_paths, alphas):
        stored = info.width_px // (1 if photograph.half is None else 2), info.height_px
        _check_aspect(photograph, stored, info.orientation)
        ratio = np.array(stored) / photograph.camera_px
        intrinsics = tuple((photograph.intrinsics * np.tile(ratio, 2)).tolist())
        if photograph.distortion is not None and (key := (photograph.distortion, intrinsics, stored)) not in checked:
            checked.add(key)
            _check_distortion(photograph, photograph.distortion, np.array(intrinsics), stored, model == "fisheye")
        size = _reduced_size(stored, scale, longest_px)
        photographs.append(
            Photograph(
                photograph.path,
                stored,
                size,
                intrinsics,
                photograph.distortion,
                mask,
                alpha,
                info.orientation,
                photograph.border_px,
                model,
                photograph.half,
            )
        )
    _note_resized(posed, photographs)
    return photographs


def _common_model(layout: PosedCapture, posed: Sequence[PosedPhotograph]) -> CameraModel:
    """Return the model that all photographs are drawn by. Raises InputError where halves of rounds meet others."""
    halves = sum(photograph.half is not None for photograph in posed)
    if 0 < halves < len(posed):
        raise InputError(
            f"{layout.source}: expected photographs of one kind, got {halves // 2} equirectangular ones among others: "
            "put them into captures of their own"
        )
    if halves:
        return "equirectangular"
    fisheyes = all(photograph.distortion is not None and photograph.distortion.fisheye for photograph in posed)
    return "fisheye" if fisheyes else "pinhole"


def _usable_points(layout: PosedCapture) -> tuple[np.ndarray, np.ndarray]:
    """Return points [P,3] and colours [P,3] without points that are not finite or absurdly far away."""
    points = layout.points
    good = np.isfinite(points).all(1) & (np.abs(points).max(1, initial=0) < 1e12)
    if good.any():
        away = np.full(len(points), np.inf)
        away[good] = np.linalg.norm(points[good] - np.median(points[good], 0), axis=1)
        good &= away <= max(_FARTHEST * float(np.median(away[good])), 1e-9)
    if not good.all():
        words = counted(int((~good).sum()), "point", len(good), "are not finite or absurdly far, and left out")
        assume(f"{layout.source}: {words}")
    return points[good], layout.colours[good]


def _reduced_size(stored: tuple[int, int], scale: float, longest_px: int | None) -> tuple[int, int]:
    if longest_px is not None:
        scale = min(1.0, longest_px / max(stored))
    width, height = (max(1, round(side * scale)) for side in stored)
    return width, height


def _check_aspect(photograph: PosedPhotograph, stored: tuple[int, int], orientation: int) -> None:
    """Raise InputError for a file whose aspect differs from its camera's images by more than rounding."""
    (width, height), (camera_width, camera_height) = stored, photograph.camera_px
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
        f"{photograph.path}: expected the shape of its camera's pictures, {camera_width} x {camera_height}, got "
        f"{width} x {height}{way_out}"
    )


def _check_distortion(
    photograph: PosedPhotograph, distortion: Distortion, intrinsics: np.ndarray, stored: tuple[int, int], fisheye: bool
) -> None:
    """Raise InputError for a distortion that makes no image; note what is used of a fisheye among other lenses."""
    if (lost := folded_fraction(distortion, intrinsics, *stored, fisheye)) > LARGEST_FOLDED_FRACTION:
        raise InputError(
            f"{photograph.path}: the lens {distortion.description} folds {lost:.0%} of the picture onto the rest: "
            "expected coefficients that straighten it; pose the photographs again with a simpler camera model"
        )
    if distortion.fisheye and not fisheye:
        before, after = intrinsics[2:] / intrinsics[:2], (stored - intrinsics[2:]) / intrinsics[:2]
        wide, high = np.degrees(np.arctan(before) + np.arctan(after))
        assume(
            f"fisheye photographs as {photograph.name} are seen as a pinhole of their focal length sees the scene, "
            f"{wide:.0f} x {high:.0f} degrees, as other photographs are by pinholes; what they show beyond is not used"
        )


def _note_resized(posed: Sequence[PosedPhotograph], photographs: Sequence[Photograph]) -> None:
    resized = [photo for photograph, photo in zip(posed, photographs) if photo.stored_px != photograph.camera_px]
    if resized:
        first = resized[0]
        was = next(photograph.camera_px for photograph, photo in zip(posed, photographs) if photo is first)
        assume(
            f"{counted(len(resized), 'photograph', len(posed), 'are not of the posed size and were resized')}: "
            f"{first.path.name} is {first.stored_px[0]} x {first.stored_px[1]}, its camera {was[0]} x {was[1]}; "
            "intrinsics are scaled by the ratio of each axis"
        )


def scene_extent(centres: np.ndarray, points: np.ndarray) -> float:
    """Return the extent of a scene, scene units, > 0.

    As in Kerbl et al., "3D Gaussian Splatting" (2023): 1.1 times the largest distance of a camera from the mean of
    all. Only cameras within 3 times the median distance from the median centre count, so that one wrong pose does not
    blow it up. For a ring of cameras it is 1.1 times the radius. Where all cameras stand in one place, it is the
    median distance of the points from there, or 1 without points.

    Args:
        centres: camera centres, [C,3].
        points: [P,3].
    """
    away = np.linalg.norm(centres - np.median(centres, 0), axis=1)
    inliers = centres[away <= max(_OUTLIER * float(np.median(away)), 1e-12 * float(np.abs(centres).max()))]
    radius = _MARGIN * float(np.linalg.norm(inliers - inliers.mean(0), axis=1).max()) if len(inliers) else 0.0
    if radius > 1e-9 * (1 + float(np.abs(centres).max())):
        return radius
    distance = float(np.median(np.linalg.norm(points - centres.mean(0), axis=1))) if len(points) else 0.0
    return distance if distance > 0 else 1.0
