"""Fixtures shared by the tests. LFGS_CORE=FILE: another build of the native module, as `make sanitize` makes one."""

import importlib.util
import os
import sys
import zlib
from pathlib import Path

import pytest
import torch

import lightfield_gs

# torch.empty gives NaN and largest numbers: what nothing has written shows. On GPUs initcheck looks for that itself,
# and what was filled would be written for it.
torch.use_deterministic_algorithms(not torch.cuda.is_available())

os.environ["LIGHTFIELD_GS_DISPLAYS"] = "off"  # a display of the developer is none of the tests'

if os.environ.get("LFGS_CORE"):
    specification = importlib.util.spec_from_file_location("lightfield_gs._core", os.environ["LFGS_CORE"])
    sys.modules["lightfield_gs._core"] = lightfield_gs._core = importlib.util.module_from_spec(specification)
    specification.loader.exec_module(lightfield_gs._core)


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Files that take longest come first, so that processes side by side end together. LFGS_STRESS_SAMPLE=WORD leaves a
    quarter of the stress cases, which the word chooses."""
    items.sort(key=lambda item: item.get_closest_marker("long_file") is None)
    if word := os.environ.get("LFGS_STRESS_SAMPLE"):
        left_out = [
            item
            for item in items
            if item.path.name.startswith("test_stress_") and zlib.crc32(f"{word} {item.nodeid}".encode()) % 4
        ]
        config.hook.pytest_deselected(items=left_out)
        items[:] = [item for item in items if item not in set(left_out)]


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """LFGS_SKIPPED=FILE: one line for each test that was skipped, its reason."""
    path = os.environ.get("LFGS_SKIPPED")
    if path and not hasattr(terminalreporter.config, "workerinput"):  # of all processes, the one that reports
        reasons = [report.longrepr[2].removeprefix("Skipped: ") for report in terminalreporter.getreports("skipped")]
        with open(path, "a", encoding="utf-8") as lines:
            lines.writelines(f"{reason}\n" for reason in reasons)


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
    from srn_scene import write_object

    folder = tmp_path_factory.mktemp("data")
    for index in range(3):
        write_object(folder / "set" / f"object-{index}", seed=index)
    return folder


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder that commands run in: a small panel, p.yaml, and a scene, s.ply."""
    from command_line import PANEL, scene

    monkeypatch.chdir(tmp_path)
    PANEL.to_yaml("p.yaml")
    scene().save("s.ply")
    return tmp_path
