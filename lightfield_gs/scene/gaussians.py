"""A set of 3D Gaussians."""

from __future__ import annotations

import hashlib
import math
import warnings
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

import numpy as np
import torch

import lightfield_gs
from lightfield_gs.base.arrays import is_eager
from lightfield_gs.base.assumptions import Loss, assume
from lightfield_gs.base.checks import is_row, real_number, shown, wrong_type
from lightfield_gs.base.errors import InputError
from lightfield_gs.base.harmonics import SH_COEFFICIENTS
from lightfield_gs.scene.axes import DEFAULT_UP
from lightfield_gs.scene.rotation import rotated_fields
from lightfield_gs.scene.rows import Rows

if TYPE_CHECKING:
    from lightfield_gs import NotebookPicture, Panel, Rig


@dataclass(eq=False)
class Gaussians(Rows):
    """N Gaussians, or B sets of N, in right-handed world axes (Kerbl et al., "3D Gaussian Splatting", 2023).

    All fields are floating-point tensors of one dtype on one device. `...` is empty, or the batch dimension B. A set is
    used like a tensor: `len`, `scene[mask]`, `Gaussians.cat`, `clone`, `to`, see Rows.

    Attributes:
        means: [..., N, 3] centres, scene units.
        quaternions: [..., N, 4] rotations wxyz, any length but zero; normalized where they are used.
        scales: [..., N, 3] standard deviations along the rotated axes, scene units, > 0.
        opacities: [..., N] in (0, 1].
        sh: [..., N, K, 3] spherical harmonics of red, green and blue; K = (degree + 1)^2, degree 0..3. The colour is
            max(0, 0.5 + sum), in the (sRGB-coded) colour space of the training images.
        origin: position of the means' zero in the coordinates of their file, scene units, double precision. Cameras for
            these Gaussians are relative to it too: Rig.relative_to(origin).
    """

    means: torch.Tensor
    quaternions: torch.Tensor
    scales: torch.Tensor
    opacities: torch.Tensor
    sh: torch.Tensor
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)

    _first, _row_numbers = "means", 1

    def __post_init__(self) -> None:
        self._expect_tensors()

    def __repr__(self) -> str:
        """Describe the layout in one line; values are not read, which would wait for a device."""
        try:
            self.validate_layout()
        except InputError as error:
            return f"Gaussians(not valid: {error})"
        sets = f"{len(self.means)} sets of " if self.is_batched else ""
        return f"Gaussians({sets}{self.count}, SH degree {self.sh_degree}, {self.dtype}, {self.device})"

    def _repr_html_(self) -> str:
        """Return the picture that a notebook shows."""
        return lightfield_gs.NotebookPicture.of_gaussians(self)._repr_html_()

    def show(self, panel: Panel | None = None, rig: Rig | None = None, *, up: str = DEFAULT_UP) -> NotebookPicture:
        """Return a picture that turns with the pointer, in a notebook: the scene from all around.

        Args:
            panel: show its views from the left-most to the right-most instead; of one set.
            rig: the cameras of these views; None: Rig.frame.
            up: the axis that points up, as for Rig.frame; without a panel.

        Raises:
            InputError: a rig without a panel, or Gaussians that cannot be drawn for the panel.
        """
        pictures = lightfield_gs.NotebookPicture
        if panel is None and rig is not None:
            raise InputError("rig: it has views only on a panel: give panel= too")
        if panel is None:
            return pictures.of_gaussians(self, pictures.FRAMES, up)
        return pictures.of_views(self, panel, rig or lightfield_gs.Rig.frame(self, panel, up=up))

    def _expect_tensors(self) -> None:
        for name, tensor in self.fields().items():
            if not isinstance(tensor, torch.Tensor):
                raise wrong_type(name, tensor, torch.Tensor)

    @property
    def count(self) -> int:
        """N, the number of Gaussians in each set."""
        return self.means.shape[-2]

    @property
    def sh_degree(self) -> int:
        """Degree of the spherical harmonics, 0..3."""
        return SH_COEFFICIENTS.index(self.sh.shape[-2])

    @property
    def device(self) -> torch.device:
        return self.means.device

    @property
    def dtype(self) -> torch.dtype:
        return self.means.dtype

    @property
    def is_batched(self) -> bool:
        """Whether the tensors have the leading batch dimension B."""
        return self.means.ndim == 3

    def fields(self) -> dict[str, torch.Tensor]:
        """Return the five tensors by name."""
        return {
            "means": self.means,
            "quaternions": self.quaternions,
            "scales": self.scales,
            "opacities": self.opacities,
            "sh": self.sh,
        }

    def rotated(self, rotation: Any) -> Gaussians:
        """Rotate the Gaussians about the zero of their file: centres, quaternions and harmonics.

        The image of a camera stays the same if its rotation R becomes R @ rotation^T, with the same translation. Batch,
        dtype, device and gradients are kept.

        Args:
            rotation: [3, 3], applied to column vectors, or a quaternion [4] (wxyz, any length but zero); a tensor, an
                array or numbers.

        Raises:
            InputError: `rotation` is no proper rotation.
        """
        self.validate_layout()
        means, quaternions, sh, origin = rotated_fields(self.means, self.quaternions, self.sh, self.origin, rotation)
        return replace(self, means=means, quaternions=quaternions, sh=sh, origin=origin)

    def validate(self) -> Gaussians:
        """Check layout and values, and return self.

        Raises:
            InputError: a field has a wrong shape, dtype or device, NaN or infinity. A scale is not above 0, an opacity
                is outside [0, 1] (zero is invisible, but no error), or a quaternion is zero. The message names the
                field and the first bad index.
        """
        self.validate_layout()
        if self.means.is_meta:
            raise InputError("means: expected tensors with values, got some on the device meta")
        check_values(self)
        return self

    def validate_layout(self) -> None:
        """Raise InputError for a field with a wrong type, shape, dtype or device; read no values."""
        self._expect_tensors()  # fields can be set
        means = self.means
        for name, tensor in self.fields().items():
            if tensor.layout != torch.strided:
                raise InputError(f"{name}: expected a dense tensor, got {tensor.layout}")
        if means.ndim not in (2, 3):
            raise InputError(f"means: expected shape [N, 3] or [B, N, 3], got {list(means.shape)}")
        if means.device.type not in ("cpu", "cuda", "meta"):
            raise InputError(f"means: expected a tensor on the CPU or CUDA, got {means.device}")
        if means.dtype not in (torch.float32, torch.float64):
            way_out = "; convert them with gaussians.to(torch.float32), or each field with .float()"
            raise InputError(
                f"means: expected float32 or float64, got {means.dtype}"
                f"{way_out if means.dtype in (torch.float16, torch.bfloat16) else ''}"
            )
        lead = means.shape[:-1]
        shapes = {
            "means": (*lead, 3),
            "quaternions": (*lead, 4),
            "scales": (*lead, 3),
            "opacities": lead,
            "sh": (*lead, self.sh.shape[-2] if self.sh.ndim >= 2 else 0, 3),
        }
        for name, tensor in self.fields().items():
            if tuple(tensor.shape) != tuple(shapes[name]):
                expected = [*lead, "K", 3] if name == "sh" else list(shapes[name])
                way_out = ""
                if name == "sh" and tensor.shape == means.shape:
                    way_out = "; colours [N, 3] in 0..1 are degree 0: sh = ((colours - 0.5) / 0.28209479)[..., None, :]"
                raise InputError(
                    f"{name}: expected shape {str(expected).replace(chr(39), '')} beside means {list(means.shape)}, "
                    f"got {list(tensor.shape)}{way_out}"
                )
            if tensor.dtype != means.dtype or tensor.device != means.device:
                raise InputError(
                    f"{name}: expected {means.dtype} on {means.device} as means, got {tensor.dtype} on {tensor.device}"
                )
        if self.sh.shape[-2] not in SH_COEFFICIENTS:
            raise InputError(f"sh: expected 1, 4, 9 or 16 coefficients (degree 0..3), got {self.sh.shape[-2]}")
        if not is_row(self.origin, 3):
            raise InputError(f"origin: expected three numbers, got {shown(self.origin)}")
        for value in self.origin:
            real_number("origin", value, -1e300, 1e300)

    @staticmethod
    def load(
        path: str | Path, *, skip_invalid: bool = False, time: float | None = None, lod: int | None = None
    ) -> Gaussians:
        """Read a file of Gaussians: float32 on the CPU. Suspicious contents and an origin are warnings.

        lightfield_gs.read_scene describes the formats and arguments, and returns more of the file.
        """
        scene = lightfield_gs.read_scene(path, skip_invalid=skip_invalid, time=time, lod=lod)
        for words in scene.warnings():
            warnings.warn(f"{path}: {words}", stacklevel=2)
        return scene.gaussians

    def save(self, path: str | Path, comments: Sequence[str] = ()) -> None:
        """Write one set of Gaussians as .ply, .glb, .usd, .spz or .splat. Losses by the format are warnings.

        lightfield_gs.write_scene describes the arguments.
        """
        for words in lightfield_gs.write_scene(self, path, comments):
            assume(f"{path}: {words}", Loss)


def check_values(gaussians: Gaussians) -> None:
    """Raise InputError for values that Gaussians.validate refuses; their layout is valid.

    Nothing is checked where values cannot be read, see is_eager.
    """
    if gaussians.count == 0 or not is_eager(tuple(gaussians.fields().values())):
        return
    fields, (extremes, has_rotations) = gaussians.fields(), _extremes(gaussians)
    for (name, tensor), (low, high) in zip(fields.items(), extremes):
        if not (math.isfinite(low) and math.isfinite(high)):
            _raise_for(torch.isfinite(tensor), name, tensor, "a finite number")
        if name == "scales" and low <= 0:
            _raise_for(tensor > 0, name, tensor, "a standard deviation > 0")
        if name == "opacities" and (low < 0 or high > 1):
            _raise_for((tensor >= 0) & (tensor <= 1), name, tensor, "0..1")
    if not has_rotations:
        _raise_for(gaussians.quaternions.any(-1), "quaternions", gaussians.quaternions, "not all four zero")


def _extremes(gaussians: Gaussians) -> tuple[list[tuple[float, float]], bool]:
    """Return the smallest and largest value of each field, and whether no quaternion is zero.

    NaN stands for fields with NaN. One copy brings all results from a device, since each copy waits.
    """
    found = [value for tensor in gaussians.fields().values() for value in tensor.detach().aminmax()]
    nonzero = gaussians.quaternions.detach().any(-1).all()
    *numbers, last = torch.stack([*found, nonzero.to(found[0].dtype)]).tolist()
    return list(zip(numbers[::2], numbers[1::2])), bool(last)


def check_finite(name: str, tensor: torch.Tensor) -> None:
    """Raise InputError for the first NaN or infinity, with its index; where values cannot be read, do nothing."""
    if not is_eager((tensor,)):
        return
    if math.isfinite(tensor.detach().sum()):  # one pass; the sum is not finite if any value is not
        return
    good = torch.isfinite(tensor.detach())
    if not bool(good.all()):  # finite values may have an infinite sum
        _raise_for(good, name, tensor, "a finite number")


def _raise_for(good: torch.Tensor, name: str, tensor: torch.Tensor, expected: str) -> NoReturn:
    """Raise InputError for the first index where `good` is false."""
    index = tuple(int(i) for i in (~good).nonzero()[0])
    raise InputError(f"{name}{list(index)}: expected {expected}, got {tensor[index].tolist()}")


def from_tensors(fields: Iterable[torch.Tensor]) -> Gaussians:
    """Make Gaussians of five tensors in the order of Gaussians.fields."""
    means, quaternions, scales, opacities, sh = fields
    return Gaussians(means, quaternions, scales, opacities, sh)


def from_arrays(fields: dict[str, np.ndarray], origin: tuple[float, float, float]) -> Gaussians:
    """Make Gaussians on the CPU that share the memory of arrays [N, ...], named as in Gaussians.fields."""
    return Gaussians(**{name: torch.from_numpy(array) for name, array in fields.items()}, origin=origin)


def scene_hash(gaussians: Gaussians) -> str:
    """Return the hexadecimal SHA-256 of the five fields as little-endian float32, one after the other."""
    digest = hashlib.sha256()
    for tensor in gaussians.fields().values():
        digest.update(np.ascontiguousarray(tensor.detach().cpu().numpy(), "<f4").data)
    return digest.hexdigest()


def scene_facts(gaussians: Gaussians) -> dict[str, Any]:
    """Return the count, the degree and the hash of one set, for the metadata of images."""
    return {"gaussians": gaussians.count, "sh_degree": gaussians.sh_degree, "sha256": scene_hash(gaussians)}


torch.serialization.add_safe_globals([Gaussians])  # torch.load reads them without weights_only=False
