"""Moving the numbers of a plan to the device that works on them."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from typing import Any, TypeVar

import torch
from torch import Tensor

Record = TypeVar("Record")
_ALIGNMENT = 64  # bytes, more than any kernel asks for


def on_device(record: Record, device: torch.device) -> Record:
    """Move the tensors of a dataclass, and of dataclasses in it, to a device; other values stay.

    All go in one copy, which the host does not wait for.
    """
    return record if device.type == "cpu" else packed(record, device)


def packed(record: Record, device: torch.device) -> Record:
    """on_device by way of one buffer, for any device: a copy whose tensors share their memory."""
    tensors = [tensor.contiguous() for tensor in _tensors(record)]
    starts = [0]
    for tensor in tensors:
        starts.append(starts[-1] + -(-tensor.nbytes // _ALIGNMENT) * _ALIGNMENT)
    buffer = torch.empty(starts[-1], dtype=torch.uint8, pin_memory=device.type == "cuda")
    for tensor, part in zip(tensors, _parts(buffer, tensors, starts)):
        part.copy_(tensor)
    return _replaced(record, _parts(buffer.to(device, non_blocking=True), tensors, starts))


def _parts(buffer: Tensor, like: list[Tensor], starts: list[int]) -> Iterator[Tensor]:
    """Contiguous tensors in a buffer from these bytes on; views of it would tie a compiled function to its size."""
    for tensor, start in zip(like, starts):
        part = torch.empty(0, dtype=tensor.dtype, device=buffer.device)
        place = start // tensor.element_size(), tensor.shape, tensor.stride()
        yield part.set_(buffer.untyped_storage(), *place)


def _tensors(record: Any) -> Iterator[Tensor]:
    """The tensors of a dataclass, in the order that _replaced takes them in."""
    for field in dataclasses.fields(record):
        value = getattr(record, field.name)
        if isinstance(value, Tensor):
            yield value
        elif dataclasses.is_dataclass(value):
            yield from _tensors(value)


def _replaced(record: Any, tensors: Iterator[Tensor]) -> Any:
    """The dataclass with the next of `tensors` in place of each of its own."""

    def replacement(value: Any) -> Any:
        if isinstance(value, Tensor):
            return next(tensors)
        return _replaced(value, tensors) if dataclasses.is_dataclass(value) else value

    return dataclasses.replace(
        record, **{field.name: replacement(getattr(record, field.name)) for field in dataclasses.fields(record)}
    )
