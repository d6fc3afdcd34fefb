"""The tests of the GPU under a tool of compute-sanitizer: a few at a time, in processes side by side.

python tests/sanitize_cuda.py racecheck [--seconds 500]

What passed is not run again while package and tests are the same: a run that was cut off goes on where it was. Prints
what was reported, by kernel, and ends with 0 when all tests passed and nothing was.
"""

from __future__ import annotations

import argparse
import hashlib
import importlib.util
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path

from tqdm import tqdm

from lightfield_gs import _core

TESTS = Path(__file__).resolve().parent
GROUP = 5  # tests of a process: it starts in some 6 s under a tool
NETWORK = "test_cuda_(photo|training)"
LONG = re.compile(f"{NETWORK}|budget")  # minutes each under racecheck
# Our kernels, and CUB's, with mangled and plain names. That finds all of our hazards: a hazard is within a kernel, and
# initcheck also sees the stores of other kernels. Kernels of libraries would take most of the time. Racecheck takes
# some of their asynchronous copies for hazards. Initcheck does not know all of their stores (tensormap instructions, by
# its release notes).
OURS = ["--kernel-name", "regex=lfgs|cub::|3cub"]
OPTIONS = {"memcheck": ["--report-api-errors", "explicit"], "racecheck": [], "initcheck": []}
# Tests that capture CUDA graphs or count torch's memory need its caching allocator. Other tests run without it: within
# its blocks the tools see no bounds, and take freed memory for written.
CACHING = re.compile(f"{NETWORK}|test_cuda_encoder|captured|budget")
# Tests whose copies initcheck does not check. While other processes use the GPU, it reports some results of torch's
# kernels as never written, which is no fault of the test.
COPIES_OF_TORCH = re.compile(NETWORK)
LEFT_OUT = {"racecheck": "not 31_bits"}  # 2^31 intersections take over nine minutes; other tests run the same kernels
LEAST_VERSION = (2026, 4)  # earlier versions miss stores of kernels that are left out, or crash with torch's


# A line that begins a report, and the indented ones below it
REPORT = re.compile(
    r"^={9} (?! |COMPUTE-SANITIZER|.*SUMMARY|Target application returned)(.+(?:\n={9}  .*)*)", re.MULTILINE
)
KERNEL = re.compile(r"\bat (.+?)\+0x")


class Log:
    """The output of one process: pytest's lines, and beside them the tool's.

    broken: file with the names of its tests if it ended badly, by a failure or a crash that may have disturbed others.
    """

    def __init__(self, path: Path):
        self.tests, self.tool, self.broken = path, path.with_suffix(".tool"), path.with_suffix(".broken")

    def outcomes(self) -> dict[str, str]:
        """Of all tests, once the tool has summed up: until then reports may be missing."""
        if not self._summed_up():
            return {}
        text = self.tests.read_text(errors="replace")
        return dict(re.findall(r"^(\S+\.py::.+?) (PASSED|SKIPPED|FAILED|ERROR)\b", text, re.MULTILINE))

    def _summed_up(self) -> bool:
        """By its last line; what stands before may be hundreds of megabytes."""
        if not self.tool.exists():
            return False
        with self.tool.open("rb") as said:
            said.seek(max(0, self.tool.stat().st_size - 200))
            return b"SUMMARY" in said.read()

    def reports(self) -> list[str]:
        """Return the first line of each report, and the kernel if one is named."""
        text = self.tool.read_text(errors="replace") if self.tool.exists() else ""
        found = [(re.split("\n| at ", report)[0], KERNEL.search(report)) for report in REPORT.findall(text)]
        return [f"{said} in {kernel[1]}" if kernel else said for said, kernel in found]


def take_broken(folder: Path) -> set[str]:
    """Takes away the logs of processes that ended badly; returns their tests."""
    tests = set()
    for path in folder.glob("*.broken"):
        tests.update(path.read_text().splitlines())
        for file in folder.glob(f"{path.stem}.*"):
            file.unlink()
    return tests


def grouped(tests: list[str], apart: set[str]) -> list[list[str]]:
    """The tests of each process. Those that are to run apart do so, and the long ones: these begin, lest the last ends
    late."""
    alone = [test for test in tests if test in apart or LONG.search(test)]
    groups = [[test] for test in alone]
    for caching in (True, False):
        others = [test for test in tests if test not in alone and bool(CACHING.search(test)) == caching]
        count = -(-len(others) // GROUP)
        groups += [others[k::count] for k in range(count)]  # not of one kind, which take alike
    return groups


def left(tests: list[str], folder: Path) -> dict[str, str]:
    """Of tests that have neither passed nor been skipped: how they ended the last time that they ran."""
    found = {test: outcome for log in sorted(folder.glob("*.log")) for test, outcome in Log(log).outcomes().items()}
    return {test: found.get(test, "NOT RUN") for test in tests if found.get(test) not in ("PASSED", "SKIPPED")}


def collected(expression: str) -> list[str]:
    """The tests that -k EXPRESSION chooses; exits where there are none."""
    files = [path for path in sorted(TESTS.rglob("test_cuda*.py")) if not path.name.startswith("test_cuda_on_cpu")]
    listed = subprocess.run(
        [sys.executable, "-m", "pytest", "--collect-only", "-q", "-k", expression, *files],
        cwd=TESTS.parent,
        capture_output=True,
        text=True,
        check=False,
    )
    found = [line for line in listed.stdout.splitlines() if "::" in line]
    if listed.returncode or not found:
        sys.exit(f"sanitize_cuda: no tests: they need a GPU and a build with LFGS_CUDA=ON\n{listed.stdout[-2000:]}")
    return found


def folder_of(tool: str) -> Path:
    """Of the logs of the tool over this very package and these tests."""
    digest = hashlib.sha256(Path(_core.__file__).read_bytes())
    for package in (Path(_core.__file__).parent, TESTS.parent / "training", TESTS):
        for path in sorted(package.rglob("*.py")):
            digest.update(path.read_bytes())
    return TESTS.parent / "build" / "sanitize-cuda" / f"{tool}-{digest.hexdigest()[:12]}"


def compute_sanitizer() -> str:
    """Its path: on the PATH, or from the package index. Exits where there is none that is new enough."""
    package = importlib.util.find_spec("nvidia")
    folders = package.submodule_search_locations if package else []
    paths = [
        shutil.which("compute-sanitizer"),
        *(path for folder in folders for path in Path(folder).glob("cu*/bin/compute-sanitizer")),
    ]
    versions = []
    for path in filter(None, paths):
        said = subprocess.run([path, "--version"], capture_output=True, text=True, check=False).stdout
        versions += re.findall(r"Version (\d+)\.(\d+)", said)
        if versions and tuple(map(int, versions[-1])) >= LEAST_VERSION:
            return str(path)
    sys.exit(
        f"sanitize_cuda: needs compute-sanitizer {'.'.join(map(str, LEAST_VERSION))} or newer, found "
        f"{', '.join(map('.'.join, versions)) or 'none'}: pip install nvidia-cuda-sanitizer-api"
    )


def start(sanitizer: str, tool: str, log: Log, tests: list[str]) -> subprocess.Popen:
    """Of tests that are all of CACHING or none. --show-backtrace device: for the host's the tool visits Python's frames
    at every launch, and keeps them, and with them the tensors that they hold. One thread of torch.compile: its others
    are processes, which the tool would run as well."""
    options = OURS + OPTIONS[tool]
    if tool == "initcheck" and COPIES_OF_TORCH.search(tests[0]):
        options += ["--check-api-memory-access", "no"]
    variables = {"TORCHINDUCTOR_COMPILE_THREADS": "1"}
    if not CACHING.search(tests[0]):
        variables["PYTORCH_NO_CUDA_MEMORY_CACHING"] = "1"
    with log.tests.open("w") as out:
        return subprocess.Popen(
            [
                sanitizer,
                "--tool",
                tool,
                "--show-backtrace",
                "device",
                "--print-limit",
                "0",
                "--log-file",
                str(log.tool),
                *options,
                sys.executable,
                "-m",
                "pytest",
                "-v",
                "--tb=short",
                *tests,
            ],
            cwd=TESTS.parent,
            env=os.environ | variables,
            stdout=out,
            stderr=subprocess.STDOUT,
            start_new_session=True,
        )


def stop(process: subprocess.Popen) -> None:
    """Ends the process, before the tool reports that its tests ended early, and all that it started."""
    process.kill()
    process.wait()
    for entry in Path("/proc").glob("[0-9]*"):
        try:
            if os.getsid(int(entry.name)) == process.pid:
                os.kill(int(entry.name), signal.SIGKILL)
        except ProcessLookupError:
            pass


def run(sanitizer: str, tool: str, groups: list[list[str]], folder: Path, processes: int, seconds: float) -> None:
    """Until all have run, or for so many seconds."""
    end, running = time.monotonic() + seconds, {}
    bar = tqdm(total=sum(map(len, groups)), desc=tool, unit="test")

    def take_ended() -> None:
        for process in [p for p in running if p.poll() is not None]:
            log, group = running.pop(process)
            if process.returncode:
                log.broken.write_text("\n".join(group))
            bar.update(len(group))

    try:
        while (groups or running) and time.monotonic() < end:
            take_ended()
            while groups and len(running) < processes:
                log, group = Log(folder / f"{time.time_ns()}.log"), groups.pop(0)
                running[start(sanitizer, tool, log, group)] = log, group
            time.sleep(0.1)
    finally:
        take_ended()
        bar.close()
        for process in running:
            stop(process)


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("tool", choices=OPTIONS)
    parser.add_argument(
        "--processes",
        type=int,
        default=max(1, 3 * os.cpu_count() // 4),
        help="side by side on the GPU (default: three for four cores)",
    )
    parser.add_argument("--seconds", type=float, default=float("inf"), help="stop what runs after so many")
    options = parser.parse_args(arguments)

    sanitizer = compute_sanitizer()
    tests, folder = collected(LEFT_OUT.get(options.tool, "")), folder_of(options.tool)
    folder.mkdir(parents=True, exist_ok=True)
    apart = take_broken(folder)
    run(sanitizer, options.tool, grouped(list(left(tests, folder)), apart), folder, options.processes, options.seconds)

    reports = Counter(report for path in folder.glob("*.log") for report in Log(path).reports())
    for report, times in reports.most_common():
        print(f"{times} x {report}")
    wrong = left(tests, folder)
    for test, outcome in wrong.items():
        print(f"{outcome} {test}")
    print(
        f"{options.tool}: {len(tests) - len(wrong)} of {len(tests)} tests passed, {reports.total()} reports; logs in "
        f"{folder}"
    )
    return int(bool(wrong or reports))


if __name__ == "__main__":
    sys.exit(main())
