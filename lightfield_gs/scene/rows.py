"""Sets of tensors that are used like one tensor: indexed, joined, copied and moved row by row."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import fields, replace
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
import torch
from torch import Tensor

from lightfield_gs.base.checks import is_row, shown
from lightfield_gs.base.errors import InputError

if TYPE_CHECKING:
    from typing_extensions import Self

_KINDS = "a number, a slice, or a row of whole numbers or of True and False"


class Rows:
    """The base of dataclasses whose tensors [..., rows, *] have a row for each Gaussian or camera.

    Fields that are no tensors belong to all rows.
    """

    _first: ClassVar[str]  # name of a tensor that is always there
    _row_numbers: ClassVar[int]  # dimensions of a row of it

    def tensors(self) -> dict[str, Tensor]:
        """Return the fields that are tensors by name."""
        found = {field.name: getattr(self, field.name) for field in fields(self)}  # type: ignore[arg-type]
        return {name: value for name, value in found.items() if isinstance(value, Tensor)}

    @property
    def _axis(self) -> int:
        return getattr(self, self._first).ndim - 1 - self._row_numbers

    def mapped(self, change: Callable[[Tensor], Tensor]) -> Self:
        """Apply a function to each of the tensors."""
        changed: dict[str, Any] = {name: change(tensor) for name, tensor in self.tensors().items()}
        return replace(self, **changed)  # type: ignore[type-var]

    def __len__(self) -> int:
        """Return the number of rows in each set."""
        return int(getattr(self, self._first).shape[self._axis])

    def __getitem__(self, rows: Any) -> Self:
        """Return some rows, in the given order; a single one stays a set of one.

        Args:
            rows: a number, a slice, a list or an array or tensor [M] of whole numbers, or one [rows] of True and False.
                In a batch the same rows are taken of every set.

        Raises:
            IndexError: a row that is not there.
            InputError: anything else.
        """
        chosen = self._checked_rows(rows)
        before = (slice(None),) * self._axis
        return self.mapped(lambda tensor: tensor[(*before, chosen)])

    def _checked_rows(self, rows: Any) -> slice | Tensor:
        """Return rows as torch takes them, on the device of the tensors."""
        name, device = type(self).__name__, getattr(self, self._first).device
        if isinstance(rows, slice):
            return rows if rows.step is None or rows.step > 0 else torch.tensor(range(len(self))[rows], device=device)
        if isinstance(rows, (int, np.integer)) and not isinstance(rows, bool):
            rows = [int(rows)]
        if not (rows.ndim == 1 if isinstance(rows, Tensor) else is_row(rows)):
            raise InputError(f"{name}[...]: expected {_KINDS}, got {shown(rows)}")
        try:
            chosen = torch.as_tensor(rows, dtype=None if len(rows) else torch.int64)
        except (TypeError, ValueError, RuntimeError, OverflowError):
            raise InputError(f"{name}[...]: expected {_KINDS}, got {shown(rows)}") from None
        if chosen.ndim != 1 or chosen.is_floating_point() or chosen.is_complex():
            raise InputError(f"{name}[...]: expected {_KINDS}, got {chosen.dtype} {list(chosen.shape)}")
        if chosen.dtype == torch.bool and len(chosen) != len(self):
            raise IndexError(f"{name}: expected a mask of {len(self)} rows, got one of {len(chosen)}")
        if chosen.dtype != torch.bool:
            chosen = chosen.long()
            if chosen.device.type == "cpu" and len(wrong := chosen[(chosen < -len(self)) | (chosen >= len(self))]):
                raise IndexError(f"{name}: expected rows of {-len(self)}..{len(self) - 1}, got {int(wrong[0])}")
        return chosen.to(device)

    def to(self, *args: Any, **kwargs: Any) -> Self:
        """Apply torch.Tensor.to to every tensor."""
        return self.mapped(lambda tensor: tensor.to(*args, **kwargs))

    def cpu(self) -> Self:
        """Return the same data in the memory of the CPU."""
        return self.to("cpu")

    def cuda(self, device: int | str | torch.device | None = None) -> Self:
        """Return the same data on a GPU, by default torch's current one."""
        return self.mapped(lambda tensor: tensor.cuda(device))

    def clone(self) -> Self:
        """Return a copy; gradients pass through."""
        return self.mapped(torch.Tensor.clone)

    def detach(self) -> Self:
        """Return the same data outside the autograd graph."""
        return self.mapped(torch.Tensor.detach)

    def requires_grad_(self, requires_grad: bool = True) -> Self:
        """Ask for gradients by all tensors in place, and return self."""
        for tensor in self.tensors().values():
            tensor.requires_grad_(requires_grad)
        return self

    @classmethod
    def cat(cls, parts: Sequence[Self]) -> Self:
        """Join sets, one behind the other; all else is to be equal in them.

        Args:
            parts: at least one, of one dtype, device and batch.

        Raises:
            InputError: there are none, or something of them differs.
        """
        if not is_row(parts) or not len(parts) or not all(isinstance(part, cls) for part in parts):
            raise InputError(f"{cls.__name__}.cat: expected a row of {cls.__name__}, got {shown(parts)}")
        first, own = parts[0], list(parts[0].tensors())
        for number, part in enumerate(parts[1:], 1):
            for name in (field.name for field in fields(first)):  # type: ignore[arg-type]
                ours, theirs = getattr(first, name), getattr(part, name)
                if _kind(ours, first._axis) != _kind(theirs, part._axis):
                    raise InputError(
                        f"{cls.__name__}.cat: {name} of part {number}: expected {_words(ours)} as of part 0, got "
                        f"{_words(theirs)}"
                    )
        axis = first._axis
        joined: dict[str, Any] = {name: torch.cat([getattr(part, name) for part in parts], axis) for name in own}
        return replace(first, **joined)  # type: ignore[type-var]


def _kind(value: Any, axis: int) -> Any:
    """Return the part of a field that has to be equal in sets that are joined."""
    if not isinstance(value, Tensor):
        return value
    return value.dtype, value.device, axis, *value.shape[:axis], *value.shape[axis + 1 :]


def _words(value: Any) -> str:
    if not isinstance(value, Tensor):
        return shown(value)
    return f"{value.dtype} {list(value.shape)} on {value.device}"
