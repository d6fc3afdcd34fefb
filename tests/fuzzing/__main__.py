"""python -m fuzzing [--inputs N] [READER ...], in tests/: damaged files for every reader.

The readers divide N inputs among them and run one after the other, each in a process. Coverage guides the changes if
atheris (from PyPI, built on LLVM's libFuzzer) is installed; otherwise they are random. A reader stops at the first
failure: any error but InputError, more than 10 s, more than 1 GiB, a leak, or a crash. The input is stored beside its
corpus as mishandled-*.
"""

from __future__ import annotations

import argparse
import gc
import subprocess
import sys
import tempfile
import time
import types
from pathlib import Path

from fuzzing.mutate import mutate
from fuzzing.readers import (
    BYTES_PER_INPUT,
    CORPUS,
    READERS,
    SECONDS_PER_INPUT,
    attempt,
    corpus,
    memory_limit,
    resident_bytes,
)

try:
    import atheris
except ImportError:
    atheris = None

# Instrumented modules, without YAML's scanner, whose loops would take ten times as long
_WATCHED = ("lightfield_gs.", "training.", "yaml.parser", "yaml.constructor", "json.", "numpy.lib.")
LEAK_BYTES = 64 << 20  # more resident memory at the end than after the first tenth of the inputs
LONGEST = 1 << 14


def watch(name: str, inputs: int, folder: Path):
    """Return `attempt` with a count of inputs and a check for leaks."""
    state = {"seen": 0, "read": 0, "settled": 0}

    def one(data: bytes) -> None:
        (folder / "last").write_bytes(data)
        state["read"] += attempt(name, data, folder)
        state["seen"] += 1
        if state["seen"] == max(100, inputs // 10):
            state["settled"] = resident_bytes()
        if state["seen"] >= inputs:
            grown = resident_bytes() - state["settled"] if state["settled"] else 0
            print(f"{name}: {state['seen']} inputs, {state['read']} of them read, {grown >> 20} MiB grown", flush=True)
            if grown > LEAK_BYTES:
                raise MemoryError(f"{name}: {grown} bytes not given back")

    return one


def instrument() -> None:
    """Instrument all loaded functions of the readers for atheris.

    Its hook for imports misses an editable install, and modules that a reader imports at its first call.
    """
    for function in gc.get_objects():
        if type(function) is types.FunctionType and (function.__module__ or "").startswith(_WATCHED):
            atheris.instrument_func(function)


def fuzz_one(name: str, inputs: int, folder: Path) -> None:
    one, files = watch(name, inputs, folder), corpus(name)
    for data in files:
        attempt(name, data, folder)
    with memory_limit():
        if atheris is None:
            for seed in range(inputs):
                one(mutate(files, seed))
            return
        instrument()
        (folder / "found").mkdir()
        options = {
            "runs": inputs,
            "max_len": LONGEST,
            "verbosity": 0,
            "timeout": 2 * SECONDS_PER_INPUT,
            "rss_limit_mb": 0,
            "print_final_stats": 0,
            "artifact_prefix": f"{folder}/",
        }
        folders = [str(folder / "found"), str(CORPUS / READERS[name].corpus)]

        def change(data: bytes, longest: int, seed: int) -> bytes:
            return atheris.Mutate(data, longest) if seed % 2 else mutate([data, *files], seed)[:longest]

        atheris.Setup(
            [sys.argv[0], *folders, *(f"-{key}={value}" for key, value in options.items())], one, custom_mutator=change
        )
        atheris.Fuzz()


def keep_last(name: str, folder: Path) -> str:
    """Copy the last input of a run beside the corpus, and return its path."""
    if not (folder / "last").exists():
        return "the message above: it did not start"
    target = CORPUS / READERS[name].corpus / f"mishandled-{int(time.time())}{READERS[name].suffix}"
    target.write_bytes((folder / "last").read_bytes())
    return str(target)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("readers", nargs="*", choices=[*READERS, []], help="default: all")
    parser.add_argument("--inputs", type=int, default=10_000)
    parser.add_argument("--folder", type=Path, help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.folder:
        fuzz_one(args.readers[0], args.inputs, args.folder)
        return 0
    names, failed, start = args.readers or list(READERS), 0, time.monotonic()
    share = -(-args.inputs // len(names))
    for name in names:
        with tempfile.TemporaryDirectory() as folder:
            run = subprocess.run([sys.executable, "-m", "fuzzing", name, "--inputs", str(share), "--folder", folder])
            if run.returncode:
                failed += 1
                print(f"{name}: MISHANDLED, see {keep_last(name, Path(folder))}", flush=True)
    print(
        f"{share * len(names)} inputs, {failed} of {len(names)} readers failed, {time.monotonic() - start:.0f} s, "
        f"at most {SECONDS_PER_INPUT} s and {BYTES_PER_INPUT >> 20} MiB each"
    )
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
