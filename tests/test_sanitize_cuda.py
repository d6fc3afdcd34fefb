"""Running the tests of the GPU under compute-sanitizer, with a tool that only writes what it is told."""

from __future__ import annotations

import os
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import pytest
import sanitize_cuda

TOOL = """#!{python}
import os, sys
with open(sys.argv[sys.argv.index("--log-file") + 1], "w") as log:
    log.write(os.environ["REPORTS"])
os.execv(sys.executable, sys.argv[sys.argv.index(sys.executable):])
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
CLEAN = "========= COMPUTE-SANITIZER\n========= ERROR SUMMARY: 0 errors\n"
OURS = """========= Invalid __global__ read of size 4 bytes
=========     at void lfgs::cuda::fill_kernel(int)+0x10 in bin.cu:60
=========     by thread (0,0,0) in block (1,0,0)
"""
TORCHS = """========= Uninitialized __global__ memory read of size 2 bytes
=========     at void at::native::elementwise_kernel<(int)128>(int)+0x1730
=========     by thread (32,0,0) in block (16,0,0)
"""
RACE = """========= Error: Race reported between Write access at lfgs::cuda::rank(int)+0x90 in order.cu:7
=========     and Read access at lfgs::cuda::rank(int)+0xa0 in order.cu:8 [4 hazards]
"""
CALL = """========= Program hit cudaErrorInvalidValue (error 1) due to "invalid argument" on CUDA API call to cudaFree.
"""


@pytest.fixture
def tool(tmp_path, monkeypatch, capsys):
    """Runs main with reports of the tool; returns exit code, output and the number of tests that ran."""
    (tmp_path / "tests").mkdir()
    (tmp_path / "tests/test_cuda_small.py").write_text(SMALL)
    (tmp_path / "pytest.ini").write_text("[pytest]\n")
    (tmp_path / "compute-sanitizer").write_text(TOOL.format(python=sys.executable))
    (tmp_path / "compute-sanitizer").chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}:{os.environ['PATH']}")
    monkeypatch.setenv("PYTEST_DISABLE_PLUGIN_AUTOLOAD", "1")  # starts faster
    monkeypatch.setattr(sanitize_cuda, "TESTS", tmp_path / "tests")

    def run(name: str = "memcheck", reports: str = CLEAN, wrong: str = "", slow: str = "", *options: str,
            crash: str = ""):
        runs = tmp_path / "runs"
        runs.write_text("")
        for key, value in {"REPORTS": reports, "WRONG": wrong, "CRASH": crash, "SLOW": slow,
                           "RUNS": str(runs)}.items():
            monkeypatch.setenv(key, value)
        code = sanitize_cuda.main([name, "--processes", "2", *options])
        return code, capsys.readouterr().out, len(runs.read_text().split())

    return run


def test_what_passed_is_not_run_again_until_something_changes(tool, tmp_path):
    code, text, ran = tool()
    assert code == 0 and ran == 11 and "12 of 12 tests passed, 0 reports" in text
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
    assert "3 reports of our own" in tool("memcheck", CLEAN + CALL, **{how: "one,two words,0"})[1]
    code, text, ran = tool()
    assert code == 0 and ran == 11 and "12 of 12 tests passed, 0 reports" in text


def test_a_crash_does_not_keep_the_tests_behind_it_from_running(tool):
    assert "8 of 12 tests passed" in tool(crash="one")[1]
    code, text, _ = tool(crash="one")
    assert code == 1 and "NOT RUN tests/test_cuda_small.py::test_case[one]\n" in text and "11 of 12" in text


@pytest.mark.parametrize("reports, line", [(OURS, "Invalid __global__ read of size 4 bytes in void lfgs::cuda::fill"),
                                           (RACE, "Error: Race reported between Write access in lfgs::cuda::rank(int)"),
                                           (CALL, "Program hit cudaErrorInvalidValue"), (TORCHS + OURS, "3 x Invalid")])
def test_reports_of_our_kernels_and_of_calls_fail(tool, reports, line):
    code, text, _ = tool(reports=CLEAN[:28] + reports + CLEAN[28:])
    assert code == 1 and line in text and "12 of 12 tests passed, 3 reports of our own" in text


def test_reports_of_libraries_are_counted_apart(tool):
    code, text, _ = tool(reports=2 * TORCHS)
    assert code == 0 and "6 x Uninitialized __global__ memory read of size 2 bytes in void at::native" in text
    assert "0 reports of our own, 6 of libraries' kernels" in text


def test_a_run_that_is_cut_off_ends_all_and_goes_on(tool, tmp_path, monkeypatch):
    begun = SimpleNamespace(monotonic=lambda: len((tmp_path / "runs").read_text().split()), sleep=time.sleep,
                            time_ns=time.time_ns)  # a second a test, however fast the machine
    monkeypatch.setattr(sanitize_cuda, "time", begun)
    code, text, _ = tool("memcheck", CLEAN, "", "one", "--seconds", "8")
    assert code == 1 and "NOT RUN tests/test_cuda_small.py::test_case[one]\n" in text
    assert not any(Path(f"/proc/{process}").exists() for process in (tmp_path / "runs").read_text().split())
    code, text, ran = tool()
    assert code == 0 and 4 <= ran <= 6


def test_no_gpu_is_said(tool, tmp_path):
    (tmp_path / "tests/test_cuda_small.py").write_text("import pytest\npytest.skip('no', allow_module_level=True)")
    with pytest.raises(SystemExit, match="need a GPU and a build with LFGS_CUDA"):
        tool()


def test_no_tool_is_said(tool, monkeypatch):
    monkeypatch.setenv("PATH", "")
    with pytest.raises(SystemExit, match="no compute-sanitizer on the PATH"):
        sanitize_cuda.main(["memcheck"])
