"""Fixtures shared by the tests."""

from pathlib import Path

import pytest

from srn_scene import write_object


@pytest.fixture(scope="session")
def shared_dir() -> Path:
    """The folder of test data beside the checkout; the tests that need it are skipped where it is absent."""
    path = Path(__file__).resolve().parents[2] / "shared"
    if not (path / "data").is_dir():
        pytest.skip(f"no test data at {path}")
    return path


@pytest.fixture(scope="session")
def small_set(tmp_path_factory) -> Path:
    """A folder whose subfolder "set" holds three small objects of four views each, with room beside it for runs."""
    folder = tmp_path_factory.mktemp("data")
    for index in range(3):
        write_object(folder / "set" / f"object-{index}", seed=index)
    return folder
