"""Running the tests of the GPU under compute-sanitizer, with a tool that only writes what it is told."""

from __future__ import annotations

import importlib.util
import os
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import pytest
import sanitize_cuda

pytestmark = [pytest.mark.long_file, pytest.mark.not_sanitized]

TOOL = """#!{python}
import os, subprocess, sys
if sys.argv[1:] == ["--version"]:
    sys.exit(print("Version {version}.0.0 (build 1) (public-release)"))
with open(os.environ["RUNS"] + ".called", "a") as called:
    print("PYTORCH_NO_CUDA_MEMORY_CACHING" in os.environ, *sys.argv, file=called)
with open(sys.argv[sys.argv.index("--log-file") + 1], "w") as log:
    print("========= COMPUTE-SANITIZER", os.environ["REPORTS"], sep="\\n", file=log, flush=True)
    code = subprocess.call(sys.argv[sys.argv.index(sys.executable):])
    print("========= ERROR SUMMARY: some errors", file=log)
sys.exit(code)
"""
SMALL = """
import os, time, pytest
@pytest.mark.parametrize("case", ["one", "two words", *range(9)])
def test_case(case):
    open(os.environ["RUNS"], "a").write(f"{os.getpid()}\\n")
    assert str(case) not in os.environ["WRONG"].split(",")
    str(case) not in os.environ["CRASH"].split(",") or os._exit(134)
    time.sleep(60 if str(case) in os.environ["SLOW"].split(",") else 0)
@pytest.mark.skip
def test_skipped(): pass
"""
OURS = """========= Invalid __global__ read of size 4 bytes
=========     at void lfgs::cuda::fill_kernel(int)+0x10 in bin.cu:60
=========     by thread (0,0,0) in block (1,0,0)
"""
COPY = """========= Host API memory access error at host access to 0x7f2d8d609a00 of size 24,576 bytes
=========     Uninitialized access to 0x7f2d8d609a20 on access by cudaMemcpy source
"""
RACE = """========= Error: Race reported between Write access at lfgs::cuda::rank(int)+0x90 in order.cu:7
=========     and Read access at lfgs::cuda::rank(int)+0xa0 in order.cu:8 [4 hazards]
"""
CALL = """========= Program hit cudaErrorInvalidValue (error 1) due to "invalid argument" on CUDA API call to cudaFree.
"""


def put_tool(folder: Path, version: str) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "compute-sanitizer").write_text(TOOL.format(python=sys.executable, version=version))
    (folder / "compute-sanitizer").chmod(0o755)


@pytest.fixture
def tool(tmp_path, monkeypatch, capsys):
    """Runs main with reports of the tool; returns exit code, output and the number of tests that ran."""
    (tmp_path / "tests").mkdir()
    (tmp_path / "tests/test_cuda_small.py").write_text(SMALL)
    (tmp_path / "pytest.ini").write_text("[pytest]\n")
    put_tool(tmp_path, "2026.4")
    monkeypatch.setenv("PATH", f"{tmp_path}:{os.environ['PATH']}")
    monkeypatch.setenv("PYTEST_DISABLE_PLUGIN_AUTOLOAD", "1")  # starts faster
    monkeypatch.setattr(sanitize_cuda, "TESTS", tmp_path / "tests")

    def run(name: str = "memcheck", *options: str, reports: str = "", wrong: str = "", crash: str = "", slow: str = ""):
        runs = tmp_path / "runs"
        runs.write_text("")
        for key, value in {"REPORTS": reports, "WRONG": wrong, "CRASH": crash, "SLOW": slow, "RUNS": str(runs)}.items():
            monkeypatch.setenv(key, value)
        code = sanitize_cuda.main([name, "--processes", "2", *options])
        return code, capsys.readouterr().out, len(runs.read_text().split())

    return run


def test_what_passed_is_not_run_again_until_something_changes(tool, tmp_path):
    code, text, ran = tool()
    assert code == 0 and ran == 11 and "12 of 12 tests passed, 0 reports;" in text
    assert tool()[::2] == (0, 0)
    assert tool("initcheck")[::2] == (0, 11)
    with (tmp_path / "tests/test_cuda_small.py").open("a") as file:
        file.write("# changed\n")
    assert tool()[::2] == (0, 11)


def test_a_test_that_fails_is_named_and_all_of_its_process_run_again(tool, tmp_path):
    code, text, _ = tool(wrong="two words,3")
    assert code == 1 and "FAILED tests/test_cuda_small.py::test_case[two words]\n" in text and "10 of 12" in text
    code, _, ran = tool()
    assert code == 0 and ran == 7  # of two processes, but for the test that is skipped
    assert len(set((tmp_path / "runs").read_text().split())) == 7


@pytest.mark.parametrize("how", ["wrong", "crash"])
def test_what_is_reported_of_a_process_that_ended_badly_is_forgotten_when_it_runs_again(tool, how):
    assert "3 reports;" in tool(reports=CALL, **{how: "one,two words,0"})[1]
    code, text, ran = tool()
    assert code == 0 and ran == 11 and "12 of 12 tests passed, 0 reports" in text


def test_a_crash_does_not_keep_the_tests_behind_it_from_running(tool):
    assert "8 of 12 tests passed" in tool(crash="one")[1]
    code, text, _ = tool(crash="one")
    assert code == 1 and "NOT RUN tests/test_cuda_small.py::test_case[one]\n" in text and "11 of 12" in text


@pytest.mark.parametrize(
    "reports, line",
    [
        (OURS, "Invalid __global__ read of size 4 bytes in void lfgs::cuda::fill"),
        (RACE, "Error: Race reported between Write access in lfgs::cuda::rank(int)"),
        (CALL, "Program hit cudaErrorInvalidValue"),
        (COPY, "Host API memory access error"),
    ],
)
def test_reports_fail(tool, reports, line):
    code, text, _ = tool(reports=reports)
    assert code == 1 and f"3 x {line}" in text and "12 of 12 tests passed, 3 reports;" in text
    assert "6 reports" in tool("racecheck", reports=2 * reports)[1]


def test_torch_keeps_no_memory_but_where_a_test_needs_that(tool, tmp_path):
    (tmp_path / "tests/test_cuda_photo.py").write_text("def test_drawn(): pass")
    (tmp_path / "tests/test_cuda_small.py").write_text("def test_captured(): pass\ndef test_drawn(): pass")
    assert tool("initcheck")[0] == tool("memcheck")[0] == 0
    calls = [line.split() for line in (tmp_path / "runs.called").read_text().splitlines()]
    assert sorted((call[3], *call[-1].split("::"), call[0], "--check-api-memory-access" in call) for call in calls) == [
        ("initcheck", "tests/test_cuda_photo.py", "test_drawn", "False", True),
        ("initcheck", "tests/test_cuda_small.py", "test_captured", "False", False),
        ("initcheck", "tests/test_cuda_small.py", "test_drawn", "True", False),
        ("memcheck", "tests/test_cuda_photo.py", "test_drawn", "False", False),
        ("memcheck", "tests/test_cuda_small.py", "test_captured", "False", False),
        ("memcheck", "tests/test_cuda_small.py", "test_drawn", "True", False),
    ]


def runs_on(process: str) -> bool:
    try:
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0] not in "ZX"
    except (FileNotFoundError, ProcessLookupError):
        return False


def test_a_run_that_is_cut_off_ends_all_and_goes_on(tool, tmp_path, monkeypatch):
    begun = SimpleNamespace(
        monotonic=lambda: len((tmp_path / "runs").read_text().split()), sleep=time.sleep, time_ns=time.time_ns
    )  # a second a test, however fast the machine
    monkeypatch.setattr(sanitize_cuda, "time", begun)
    code, text, _ = tool("memcheck", "--seconds", "8", slow="4")  # behind "one", of which the tool may have more to say
    assert code == 1 and all(f"NOT RUN tests/test_cuda_small.py::test_case[{case}]\n" in text for case in ("one", "4"))
    end = time.monotonic() + 30
    while any(map(runs_on, (tmp_path / "runs").read_text().split())):
        assert time.monotonic() < end
        time.sleep(0.01)
    code, text, ran = tool()
    assert code == 0 and 4 <= ran <= 8  # of two processes at most


def test_no_gpu_is_said(tool, tmp_path):
    (tmp_path / "tests/test_cuda_small.py").write_text("import pytest\npytest.skip('no', allow_module_level=True)")
    with pytest.raises(SystemExit, match="need a GPU and a build with LFGS_CUDA"):
        tool()


def test_a_tool_of_the_package_index_is_taken_where_that_of_the_toolkit_is_too_old(tool, tmp_path, monkeypatch):
    put_tool(tmp_path, "2025.10")
    with pytest.raises(SystemExit, match="2026.4 or newer, found 2025.10: pip install nvidia-cuda"):
        tool()
    put_tool(tmp_path / "site/nvidia/cu13/bin", "2026.10")
    monkeypatch.syspath_prepend(tmp_path / "site")
    assert tool()[0] == 0
    assert {line.split()[1] for line in (tmp_path / "runs.called").read_text().splitlines()} == {
        str(tmp_path / "site/nvidia/cu13/bin/compute-sanitizer")
    }


def test_no_tool_is_said(monkeypatch):
    monkeypatch.setenv("PATH", "")
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(SystemExit, match="needs compute-sanitizer 2026.4 or newer, found none"):
        sanitize_cuda.main(["memcheck"])
