"""Poses of photographs by COLMAP's incremental mapping, tried again where it poses few: its own settings want a pair of
photographs 16 degrees apart to begin with, and a focal length that the photographs determine."""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from lightfield_gs.base.assumptions import assume

Progress = Callable[[str], None]
_ENOUGH = 0.9  # of the photographs: nothing else is tried then
# Focal lengths of the photographs' longer side that cameras have: from 9 mm to 144 mm, as of 35 mm film
_SHORTEST, _LONGEST = 0.25, 4.0
# The most degrees between directions that tell little of a focal length, which then is within _LARGEST_CHANGE of what
# COLMAP guesses, of the longer side
_NARROW_DEG, _GUESS = 10.0, 1.2
_LARGEST_CHANGE = 2.0  # of a focal length by the last refinement: beyond, the photographs do not determine it


@dataclass(frozen=True)
class Try:
    """Settings of a try: least angle at a point between the two photographs that a model begins with, degrees, and
    between any others; focal length to begin with, of the photographs' longer side, where Exif has none. It stands
    still until all are posed. None: COLMAP's own settings."""

    first_deg: float | None = None
    other_deg: float | None = None
    focal: float | None = None

    @property
    def words(self) -> str:
        if self.focal is None:
            return "by COLMAP's own settings"
        return (
            f"from photographs {self.first_deg:g} degrees apart or more, and a focal length of {self.focal:g} x the "
            "longer side where Exif has none"
        )


# Phones' wide cameras have a focal length of 0.72 of the longer side, their telephotos and most others one above 1
TRIES = (Try(), Try(4, 1.5, 1.2), Try(4, 1.5, 0.75), Try(1.5, 0.5, 1.2))


def best_model(pycolmap: ModuleType, database: Path, photographs: Path, count: int, progress: Progress) -> Any:
    """The reconstruction with the most of `count` photographs, whose features match in a database; None where no try
    finds one. Tries again, each said, until nearly all are posed with focal lengths that may be; of such models those
    with half of the photographs or more go before others. Raises what pycolmap raises."""
    best, chosen, guessed, rank = None, TRIES[0], _without_focal(pycolmap, database), (False, 0)
    for number, settings in enumerate(TRIES, 1):
        if settings.focal not in (None, TRIES[1].focal) and not guessed:
            continue  # Exif has all focal lengths, and nothing else differs
        if settings.focal is not None:
            _begin_with(pycolmap, database, guessed, settings.focal)
        model = _mapped(pycolmap, database, photographs, settings, progress)
        posed = 0 if model is None else model.num_reg_images()
        wrong = None if model is None else _doubtful_focal(model, guessed)
        found = f"{posed} of {count} photographs" if posed else "none posed"
        progress(f"poses, try {number}, {settings.words}: {found}{'' if wrong is None else f', {wrong}'}")
        if posed and (own := (wrong is None and 2 * posed >= count, posed)) > rank:
            best, chosen, rank = model, settings, own
        if rank >= (True, _ENOUGH * count):
            break
    if best is not None and (wrong := _doubtful_focal(best, guessed)) is not None:
        assume(
            f"COLMAP finds {wrong}, which the photographs hardly determine: depths and angles may be wrong; "
            "photographs that keep their Exif, or from farther apart, are surer"
        )
    if best is None or chosen.focal is None:
        return best
    best = _refined(pycolmap, best)
    lengths = ", ".join(f"{camera.mean_focal_length():.0f}" for camera in list(best.cameras.values())[:3])
    assume(
        f"the photographs' directions hardly differ: poses are {chosen.words}, refined to {lengths} px; depths are "
        "less sure than of photographs from farther apart"
    )
    return best


def _mapped(pycolmap: ModuleType, database: Path, photographs: Path, settings: Try, progress: Progress) -> Any:
    """The largest reconstruction by these settings; None where there is none."""
    options = pycolmap.IncrementalPipelineOptions()
    if settings.focal is not None:
        options.mapper.init_min_tri_angle = settings.first_deg
        options.mapper.filter_min_tri_angle = options.triangulation.min_angle = settings.other_deg
        options.ba_refine_focal_length = options.ba_refine_extra_params = False
        options.mapper.abs_pose_refine_focal_length = options.mapper.abs_pose_refine_extra_params = False
    models = database.with_name("models")
    models.mkdir(exist_ok=True)
    begun, posed = _counted(progress)
    found = pycolmap.incremental_mapping(
        str(database),
        str(photographs),
        str(models),
        options=options,
        initial_image_pair_callback=begun,
        next_image_callback=posed,
    )
    return max(found.values(), key=lambda model: model.num_reg_images(), default=None)


def _without_focal(pycolmap: ModuleType, database: Path) -> list[int]:
    """The cameras whose focal length is COLMAP's guess, for Exif has none."""
    with pycolmap.Database.open(str(database)) as opened:
        return [camera.camera_id for camera in opened.read_all_cameras() if not camera.has_prior_focal_length]


def _doubtful_focal(model: Any, guessed: Sequence[int]) -> str | None:
    """A focal length of a reconstruction, in words, that hardly is the camera's: that of one of the cameras `guessed`,
    of which nothing is known beforehand; None where all may be."""
    directions = np.array([image.viewing_direction() for image in model.images.values() if image.has_pose])
    least = float((directions @ directions.T).min(initial=1.0)) if len(directions) else 1.0
    low, high = _SHORTEST, _LONGEST
    if least > np.cos(np.radians(_NARROW_DEG)):
        low, high = _GUESS / _LARGEST_CHANGE, _GUESS * _LARGEST_CHANGE
    for number, camera in model.cameras.items():
        length, side = camera.mean_focal_length(), max(camera.width, camera.height)
        if number in guessed and not low <= length / side <= high:
            return f"a focal length of {length:.0f} px, {length / side:.2g} x the longer side"
    return None


def _begin_with(pycolmap: ModuleType, database: Path, cameras: Sequence[int], focal: float) -> None:
    """Takes the focal lengths of these cameras as known, of their longer side, and verifies the matches anew by it."""
    with pycolmap.Database.open(str(database)) as opened:
        for camera in opened.read_all_cameras():
            if camera.camera_id in cameras:
                camera.focal_length = focal * max(camera.width, camera.height)
                camera.has_prior_focal_length = True
                opened.update_camera(camera)
        opened.clear_two_view_geometries()
    pycolmap.geometric_verification(str(database))


def _refined(pycolmap: ModuleType, model: Any) -> Any:
    """A reconstruction with its focal lengths refined; as it was where the photographs do not determine them."""
    refined = copy.deepcopy(model)
    options = pycolmap.BundleAdjustmentOptions()
    options.refine_extra_params = options.print_summary = False
    pycolmap.bundle_adjustment(refined, options)
    pairs = (
        (model.cameras[key].mean_focal_length(), camera.mean_focal_length()) for key, camera in refined.cameras.items()
    )
    sane = all(before / _LARGEST_CHANGE < after < before * _LARGEST_CHANGE for before, after in pairs)
    return refined if sane else model


def _counted(progress: Progress) -> tuple[Callable[[], None], Callable[[], None]]:
    """What tells of a model that is begun with two photographs, and of each that is posed after them."""
    count = 0

    def begun() -> None:
        nonlocal count
        count = 2

    def posed() -> None:
        nonlocal count
        count += 1
        progress(f"posed {count} photographs")

    return begun, posed
