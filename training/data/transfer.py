"""Moving the numbers of a plan to the device that works on them."""
from __future__ import annotations

import dataclasses
from typing import Any, TypeVar

import torch
from torch import Tensor

Record = TypeVar("Record")


def on_device(record: Record, device: torch.device) -> Record:
    """A dataclass with its tensors, and those of dataclasses in it, on a device; the host does not wait for copies."""
    if device.type == "cpu":
        return record

    def moved(value: Any) -> Any:
        if isinstance(value, Tensor):
            return value.pin_memory().to(device, non_blocking=True)
        return on_device(value, device) if dataclasses.is_dataclass(value) else value

    fields = {field.name: moved(getattr(record, field.name)) for field in dataclasses.fields(record)}
    return dataclasses.replace(record, **fields)
