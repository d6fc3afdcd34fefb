"""Damaged files for every reader of files: InputError in time and within memory, or something read; nothing else.

The long run, guided by coverage where atheris is installed: make fuzz
"""

import pytest
from fuzzing.mutate import mutate
from fuzzing.readers import READERS, attempt, corpus, memory_limit

INPUTS = 1000
READ_EMPTY = ("model", "batch-manifest")  # whose fields all have defaults; of which nothing is known yet

pytestmark = pytest.mark.not_sanitized


@pytest.mark.parametrize("name", READERS)
def test_damaged_files_are_refused_or_read(name, tmp_path):
    files = corpus(name)
    with memory_limit():
        read = sum(attempt(name, data, tmp_path) for data in files)
        changed = sum(attempt(name, mutate(files, seed), tmp_path) for seed in range(INPUTS))
    assert read and changed < INPUTS


@pytest.mark.parametrize("name", READERS)
def test_empty_files_and_folders_are_refused(name, tmp_path):
    assert not attempt(name, b"", tmp_path) or name in READ_EMPTY
    with pytest.raises(Exception, match="input") as caught:
        (tmp_path / "input").mkdir()
        READERS[name].read(tmp_path / "input")
    assert type(caught.value).__name__ == "InputError"
