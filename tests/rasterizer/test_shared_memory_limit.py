"""The environment variable by which frames on CUDA draw as on a device of less shared memory."""

from __future__ import annotations

import pytest

from lightfield_gs import InputError
from lightfield_gs.rasterizer.frame_cuda import SHARED_MEMORY_LIMIT, shared_memory_limit


@pytest.mark.parametrize("text, bytes_", [("", 0), ("101376", 101376), ("1", 1)])
def test_a_number_of_bytes(text, bytes_, monkeypatch):
    monkeypatch.setenv(SHARED_MEMORY_LIMIT, text)
    assert shared_memory_limit() == bytes_


@pytest.mark.parametrize("text", ["99 KB", "0", "-1", "1e5", "0x18c00", "²", str(2**31), "9" * 5000])
def test_what_is_no_number_of_bytes_is_refused(text, monkeypatch):
    monkeypatch.setenv(SHARED_MEMORY_LIMIT, text)
    with pytest.raises(InputError, match="LFGS_SHARED_MEMORY_LIMIT: expected a number of bytes from 1 on"):
        shared_memory_limit()


def test_not_set(monkeypatch):
    monkeypatch.delenv(SHARED_MEMORY_LIMIT, raising=False)
    assert shared_memory_limit() == 0
