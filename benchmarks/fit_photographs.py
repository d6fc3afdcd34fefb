"""The photographs of a capture as all arms of `bench fit` take them, and the panel's cone among the held-out ones."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lightfield_gs.base.errors import InputError
from lightfield_gs.bench import options
from lightfield_gs.fitting.cone import Cone, place_cone
from lightfield_gs.fitting.exposure_spread import asks_for_exposures, exposure_spread
from lightfield_gs.fitting.initialization import initialize_gaussians
from lightfield_gs.fitting.posed_images import Normalization, PosedImages
from lightfield_gs.fitting.settings import FitSettings
from lightfield_gs.io.captures.capture import Capture
from lightfield_gs.scene.gaussians import Gaussians


def hold_out(capture: Capture, every: int) -> list[int]:
    """Return the middle one of every so many photographs. Raises InputError where they are too few."""
    _, held_out = capture.split(every)
    if not held_out:
        raise InputError(
            f"{capture.folder}: {len(capture.names)} photographs are too few to hold out one of {every}; "
            "give a smaller test_every="
        )
    return held_out


@dataclass(frozen=True)
class Photographs:
    """A capture on its device, in normalised coordinates.

    Attributes:
        name: of the capture.
        train, test: photographs to fit to, and held-out ones.
        points: [P,3].
        colours: [P,3] uint8, of the points.
        centres: [C,3], of all cameras.
        cone: the panel's cone round the photograph in the middle; None where the capture has no middle.
        inside: whether each of `test` is in the cone.
        exposures_differ: whether `fit` would find an exposure for each of `train`.
    """

    name: str
    train: PosedImages
    test: PosedImages
    points: np.ndarray
    colours: np.ndarray
    centres: np.ndarray
    cone: Cone | None
    inside: list[bool]
    exposures_differ: bool

    @classmethod
    def load(
        cls,
        capture: Capture,
        held_out: list[int],
        device: str,
        cone_deg: float,
        name: str,
        exposures_differ: bool | None = None,
    ) -> Photographs:
        """Read the photographs of a capture.

        Args:
            capture: the capture.
            held_out: numbers of its held-out photographs.
            device: of the fits.
            cone_deg: full angle of the cone.
            name: of the capture in rows.
            exposures_differ: None: by the photographs, as in `fit`.

        Raises:
            InputError: a photograph cannot be read.
        """
        normalization = Normalization.from_centres(capture.centres, capture.extent)
        fitted = sorted(set(range(len(capture.names))) - set(held_out))
        train, test = (PosedImages.load(capture, some, normalization, device, some) for some in (fitted, held_out))
        points, centres = (normalization.points(places) for places in (capture.points, capture.centres))
        cone = _placed(capture, cone_deg)
        inside = [False] * len(held_out) if cone is None else cone.inside[held_out].tolist()
        if exposures_differ is None:
            exposures_differ = asks_for_exposures(exposure_spread(capture, fitted))
        return cls(name, train, test, points, capture.colours, centres, cone, inside, exposures_differ)

    def start(self, settings: FitSettings) -> Gaussians:
        """Return the initial Gaussians of a fit, on the device."""
        return initialize_gaussians(self.points, self.colours, self.centres, settings).to(self.train.device)


def _placed(capture: Capture, cone_deg: float) -> Cone | None:
    try:
        return place_cone(capture, cone_deg)
    except InputError as error:
        options.progress(f"{capture.folder}: no scores in the cone: {error}")
        return None
