"""The results of a case, as arrays and text that can be compared between installs."""

from __future__ import annotations

import hashlib
import json
import re
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from safetensors import safe_open

# A case yields pairs (what it is, the value): a tensor, an array, bytes, text, or numbers in lists and dicts.
Case = Callable[[torch.device], Iterator[tuple[str, Any]]]
CASES: dict[str, Case] = {}
_SECONDS = re.compile(r"\d+\.\d\d s\b")


@dataclass(frozen=True)
class Value:
    """A value and its hash; an array where it is one, else text."""

    digest: str
    data: np.ndarray | str

    @staticmethod
    def of(found: Any) -> Value:
        if isinstance(found, bytes):
            found = np.frombuffer(found, np.uint8)
        if isinstance(found, torch.Tensor):
            found = found.detach().cpu().numpy()
        if isinstance(found, np.ndarray):
            found = np.ascontiguousarray(found)
            head = f"{found.dtype} {list(found.shape)} ".encode()
            return Value(hashlib.sha256(head + found.tobytes()).hexdigest(), found)
        text = found if isinstance(found, str) else json.dumps(found, indent=1, default=repr)
        return Value(hashlib.sha256(text.encode()).hexdigest(), text)


def case(function: Case) -> Case:
    """Registers a case by the name of its function."""
    CASES[function.__name__] = function
    return function


def run_case(name: str, device: torch.device) -> dict[str, Value]:
    """All that a case yields, by name. Raises ValueError where two have the same."""
    found: dict[str, Value] = {}
    for what, value in CASES[name](device):
        if what in found:
            raise ValueError(f"case {name} yields {what!r} twice")
        found[what] = Value.of(value)
    return found


def fields_of(what: str, gaussians: Any) -> Iterator[tuple[str, Any]]:
    """The fields of Gaussians and their origin."""
    yield from ((f"{what}: {name}", tensor) for name, tensor in gaussians.fields().items())
    yield f"{what}: origin", list(gaussians.origin)


def refusal(call: Callable[[], Any]) -> str:
    """Return the error of a call."""
    try:
        call()
    except ValueError as error:  # InputError is one
        return f"{type(error).__name__}: {error}"
    return "no complaint"


def without_times(text: str) -> str:
    """Return a command's output, without times, and without a stage that is left out where it took none."""
    return _SECONDS.sub("# s", text).replace(" image # s,", "")


def weights_of(path: str) -> Iterator[tuple[str, Any]]:
    """Tensors and notes of a .safetensors file, whose notes stand in no fixed order."""
    with safe_open(path, "pt") as file:
        yield f"{path}: notes", dict(sorted((file.metadata() or {}).items()))
        yield from ((f"{path}: {name}", file.get_tensor(name)) for name in sorted(file.keys()))


@contextmanager
def warnings_kept() -> Iterator[list[str]]:
    """The words of all warnings inside, without the place that they are from, which may move."""
    words: list[str] = []
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        yield words
    words += [str(warning.message) for warning in caught]
