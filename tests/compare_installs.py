"""Compare two installs of lightfield_gs bit by bit: `python tests/compare_installs.py BEFORE AFTER`.

Each is a folder for PYTHONPATH: made by `pip install --target FOLDER`, or a checkout with the native module in
lightfield_gs/. Where it has training/, the training commands are compared too. The
cases in tests/installs compare images, gradients, files, messages, refusals, schemas and signatures. It prints a line a
case, and exits with 1 if a case differs or fails.
"""

from __future__ import annotations

import argparse
import os
import pickle
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from installs.record import Value

_LINES_SHOWN, _TEXT_SHOWN = 8, 80
Found = dict[str, "dict[str, Value] | str"]  # of each case its values, or why it failed


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("installs", type=Path, nargs=2, metavar="PATH", help="a folder for PYTHONPATH")
    parser.add_argument("--device", choices=("cpu", "cuda"), default="cpu", help="where to draw (default cpu)")
    parser.add_argument("--only", default="", metavar="NAME", help="cases whose names contain this")
    parser.add_argument("--record", type=Path, help=argparse.SUPPRESS)  # in a process of its own, for each install
    args = parser.parse_args()
    if args.record is not None:
        return _record(args.installs[0], args.device, args.only, args.record)
    before, after = _recorded(args.installs, args.device, args.only)
    equal = [_compare(name, before.get(name, "missing"), after.get(name, "missing")) for name in {**before, **after}]
    print(f"{sum(equal)} of {len(equal)} cases equal")
    return 0 if equal and all(equal) else 1


def _recorded(installs: list[Path], device: str, only: str) -> list[Found]:
    """Return the results of the cases with each install; both run side by side."""
    with tempfile.TemporaryDirectory() as folder:
        files = [Path(folder, name) for name in ("before", "after")]
        processes = []
        for path, file in zip(installs, files):
            command = [sys.executable, __file__, str(path.resolve()), str(path.resolve()), "--device", device]
            work = file.with_suffix(".work")
            work.mkdir()
            # Nothing else may be on the way to the modules, and no cache of bytes may be written into an install
            environment = {**os.environ, "PYTHONPATH": str(path.resolve()), "PYTHONDONTWRITEBYTECODE": "1"}
            environment["OMP_NUM_THREADS"] = "1"  # each has one of two cores
            command += ["--only", only, "--record", str(file)]
            processes.append(subprocess.Popen(command, cwd=work, env=environment))
        codes = [process.wait() for process in processes]
        if any(codes):
            sys.exit(f"the cases ended with the exit codes {codes}")
        return [pickle.loads(file.read_bytes()) for file in files]


def _record(install: Path, device: str, only: str, file: Path) -> int:
    """Runs the cases with the install that is on the path, and writes what they find."""
    import torch
    from installs import commands, drawing, files  # noqa: F401
    from installs.record import CASES, run_case

    import lightfield_gs

    home = Path(lightfield_gs.__file__).resolve().parents[1]
    if home != install:
        sys.exit(f"lightfield_gs comes from {home}, not from {install}")
    torch.use_deterministic_algorithms(device == "cpu")  # and torch.empty gives NaN: what nothing has written shows
    found: Found = {}
    for name in CASES:
        if only not in name:
            continue
        began = time.process_time()
        try:
            found[name] = run_case(name, torch.device(device))
        except Exception as error:
            found[name] = f"{type(error).__name__}: {error}"
        if os.environ.get("COMPARE_TIMES"):
            print(f"{install}: {name} {time.process_time() - began:.1f} s", file=sys.stderr)
    file.write_bytes(pickle.dumps(found))
    return 0


def _compare(name: str, before: dict[str, Value] | str, after: dict[str, Value] | str) -> bool:
    """Prints how a case compares; whether it ran with both installs and found the same."""
    if isinstance(before, str) or isinstance(after, str):
        failed = [f"{which}: {case}" for which, case in (("before", before), ("after", after)) if isinstance(case, str)]
        print(f"{name}: failed\n  " + "\n  ".join(failed))
        return False
    names = list({**before, **after})
    lines = [line for what in names if (line := _difference(what, before.get(what), after.get(what)))]
    print(f"{name}: " + (f"{len(lines)} of {len(names)} values differ" if lines else f"{len(names)} values, equal"))
    print("".join(f"  {line}\n" for line in lines[:_LINES_SHOWN]), end="")
    if len(lines) > _LINES_SHOWN:
        print(f"  and {len(lines) - _LINES_SHOWN} more")
    return not lines


def _difference(what: str, before: Value | None, after: Value | None) -> str:
    """How two values differ; nothing where they do not."""
    import numpy as np

    if before is None or after is None:
        return f"{what}: only {'before' if after is None else 'after'}"
    if before.digest == after.digest:
        return ""
    a, b = before.data, after.data
    if isinstance(a, str) or isinstance(b, str):
        if type(a) is not type(b):
            return f"{what}: an array in one, text in the other"
        pairs = zip([*a.splitlines(), ""], [*b.splitlines(), ""])
        x, y = next(((x, y) for x, y in pairs if x != y), ("", "more lines"))
        start = max(0, len(os.path.commonprefix([x, y])) - _TEXT_SHOWN // 4)
        return f"{what}: {x[start : start + _TEXT_SHOWN]!r} became {y[start : start + _TEXT_SHOWN]!r}"
    if a.dtype != b.dtype or a.shape != b.shape:
        return f"{what}: {a.dtype} {list(a.shape)} became {b.dtype} {list(b.shape)}"
    differ = a.view(f"V{a.itemsize}") != b.view(f"V{b.itemsize}")
    with np.errstate(invalid="ignore"):
        most = np.abs(a.astype(np.float64) - b.astype(np.float64)).max()
    return f"{what}: {int(differ.sum())} of {a.size} numbers differ, by {most:.3g} at most"


if __name__ == "__main__":
    sys.exit(main())
