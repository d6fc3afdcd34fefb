"""Measure the grain of a checkout: `python benchmarks/structure.py [CHECKOUT] [--scene SCENE.ply]`.

Print the number and length of its files, the modules with one importer, the longest functions, the words of the
glossary and the long sentences. With a scene, trace the functions and files that `lightfield-gs encode SCENE.ply` uses.
"""

from __future__ import annotations

import argparse
import ast
import io
import os
import re
import runpy
import statistics
import subprocess
import sys
import tempfile
import tokenize
from collections import Counter
from pathlib import Path
from types import FrameType
from typing import Any

SUFFIXES = {"Python": (".py",), "C++ and CUDA": (".h", ".cpp", ".cu", ".cuh")}
FOLDERS = ("lightfield_gs", "training", "benchmarks", "csrc", "tests")
LONGEST_FUNCTIONS, LONGEST_SENTENCES, LONG_SENTENCE_WORDS = 10, 100, 25


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("checkout", type=Path, nargs="?", default=Path(__file__).resolve().parents[1])
    parser.add_argument("--scene", type=Path, help="trace `encode` of this scene too")
    parser.add_argument("--sentences", action="store_true", help="list the long sentences")
    parser.add_argument("--trace", action="store_true", help=argparse.SUPPRESS)  # in a process of its own
    args = parser.parse_args()
    if args.trace:
        return trace_encode(args.checkout, args.scene)
    print_files(args.checkout)
    print_importers(args.checkout)
    print_functions(args.checkout)
    print_words(args.checkout)
    print_sentences(args.checkout, args.sentences)
    if args.scene is not None:
        command = (sys.executable, __file__, args.checkout, "--scene", args.scene, "--trace")
        subprocess.run(command, check=True, env={**os.environ, "PYTHONPATH": str(args.checkout)})
    return None


def sources(checkout: Path, folder: str, suffixes: tuple[str, ...]) -> list[Path]:
    """Return the files of a folder that end in one of `suffixes`."""
    return [path for path in sorted((checkout / folder).rglob("*")) if path.suffix in suffixes]


def print_files(checkout: Path) -> None:
    """Print the number of files, their lines, the median and the longest, a folder a line."""
    for language, suffixes in SUFFIXES.items():
        for folder in FOLDERS:
            lines = [len(path.read_text().splitlines()) for path in sources(checkout, folder, suffixes)]
            if lines:
                print(
                    f"{folder}, {language}: {len(lines)} files, {sum(lines)} lines, median "
                    f"{statistics.median(lines):g}, longest {max(lines)}"
                )


def print_importers(checkout: Path) -> None:
    """Print how many modules of the package have exactly one importer within it, and how many packages there are."""
    paths = [path for path in sources(checkout, "lightfield_gs", (".py",)) if path.name != "__init__.py"]
    names = {".".join(path.relative_to(checkout).with_suffix("").parts) for path in paths}
    importers: Counter[str] = Counter()
    for path in sources(checkout, "lightfield_gs", (".py",)):
        imported = set()
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.ImportFrom) and node.module:
                imported |= {node.module, *(f"{node.module}.{alias.name}" for alias in node.names)}
            elif isinstance(node, ast.Import):
                imported |= {alias.name for alias in node.names}
        importers.update(imported & names)
    folders = {path.parent for path in paths}
    print(
        f"modules with one importer: {sum(count == 1 for count in importers.values())} of {len(names)}; "
        f"{len(folders)} packages"
    )


def print_functions(checkout: Path) -> None:
    """Print the longest functions of the package and of training."""
    found = []
    for folder in ("lightfield_gs", "training"):
        for path in sources(checkout, folder, (".py",)):
            for node in ast.walk(ast.parse(path.read_text())):
                if isinstance(node, ast.FunctionDef) and node.end_lineno is not None:
                    found.append((node.end_lineno - node.lineno + 1, f"{path.relative_to(checkout)}:{node.name}"))
    print(f"functions: {len(found)}, median {statistics.median(length for length, _ in found):g} lines; longest:")
    for length, name in sorted(found, reverse=True)[:LONGEST_FUNCTIONS]:
        print(f"  {length:3} {name}")


def print_words(checkout: Path) -> None:
    """Print the words of the glossary."""
    _, _, glossary = (checkout / "docs" / "design.md").read_text().partition("## Glossary")
    words = re.findall(r"^\*\*(.+?)\*\*", glossary, flags=re.MULTILINE)
    print(f"glossary: {len(words)} words: {', '.join(words)}")


def print_sentences(checkout: Path, listed: bool) -> None:
    """Print how many sentences of docstrings and comments are too long; list them if asked to."""
    lengths = []
    for suffixes in SUFFIXES.values():
        for folder in FOLDERS:
            for path in sources(checkout, folder, suffixes):
                texts = python_texts(path) if path.suffix == ".py" else comment_blocks(path.read_text(), "//")
                for sentence in (sentence for text in texts for sentence in split_sentences(text)):
                    words = len(re.findall(r"\S*[A-Za-z0-9]\S*", sentence))
                    lengths.append((words, f"{path.relative_to(checkout)}: {' '.join(sentence.split())}"))
    lengths.sort(reverse=True)
    long = [length for length in lengths if length[0] > LONG_SENTENCE_WORDS]
    mean = statistics.mean(words for words, _ in lengths[:LONGEST_SENTENCES])
    print(
        f"sentences of docstrings and comments: {len(lengths)}, {len(long)} of them over {LONG_SENTENCE_WORDS} words; "
        f"the longest hundred have {mean:.0f} on average"
    )
    for words, sentence in long if listed else ():
        print(f"  {words:3} {sentence}")


def split_sentences(text: str) -> list[str]:
    """Return the sentences of a docstring or of a comment.

    A sentence ends at a full stop and at a blank line. The next item of `Args:` or of a list begins a new one, as does
    the next cell of a table. These count as one word: code in backticks, a title in quotes, a citation in parentheses,
    a shape in brackets, a formula up to its next space without an operator.
    """
    operator = r"(?:[-+*/=<>|]|<=|>=|->)"
    for whole in (r"`[^`]*`", r"\"[A-Z][^\"]*\"", r"\([^()]*(?:19|20)\d\d[^()]*\)", r"\[[^\][]*\]"):
        text = re.sub(whole, lambda found: "X" + "\n" * found[0].count("\n"), text)
    text = re.sub(rf"\S+(?: {operator}\s\S+)+", lambda found: found[0].replace(" ", ""), text)
    return re.split(r"(?<=[.!?])\s+|\n\s*\n|\n\s*(?=[\w, ]+: )|\n\s*[-*] |(?<=\S)  +", text)


def python_texts(path: Path) -> list[str]:
    """Return the docstrings and the comments of a Python file."""
    text = path.read_text()
    documented = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)
    docstrings = [ast.get_docstring(node) for node in ast.walk(ast.parse(text)) if isinstance(node, documented)]
    lines = text.splitlines()
    comments = [""] * (len(lines) + 1)
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type == tokenize.COMMENT:
            row, column = token.start
            comments[row] = ("code " if lines[row - 1][:column].strip() else "") + token.string
    return [text for text in docstrings if text] + comment_blocks("\n".join(comments), "#")


def comment_blocks(text: str, mark: str) -> list[str]:
    """Return the comments that begin with `mark`.

    Comments on lines of their own that follow each other are one; a comment beside code ends with its line.
    """
    beside, own = rf"^[^\n]*?\S[^\n]*?(?<!:){mark}[^\n]*$", rf"(?:^[^\S\n]*{mark}[^\n]*\n?)+"
    blocks = re.findall(rf"{own}|{beside}", text, flags=re.MULTILINE)
    return [re.sub(rf"^.*?{mark}+<?\s?", "", block, flags=re.MULTILINE) for block in blocks]


def trace_encode(checkout: Path, scene: Path) -> None:
    """Run `encode` of a scene with default options; print its functions, files and changes of file.

    Counted are calls of functions and methods of the package in the main thread; comprehensions, class bodies and
    modules' own lines are not. A change of file is a call whose function is in another file than the last one's.
    """
    package = f"{checkout.resolve() / 'lightfield_gs'}/"
    calls: list[tuple[str, str, int]] = []

    def record(frame: FrameType, event: str, _: Any) -> None:
        code = frame.f_code
        if event == "call" and code.co_filename.startswith(package) and code.co_flags & 0x2:  # CO_NEWLOCALS
            if not code.co_name.startswith("<") and "__qualname__" not in code.co_names:
                calls.append((code.co_filename.removeprefix(package), code.co_name, code.co_firstlineno))

    with tempfile.TemporaryDirectory() as folder:
        sys.argv = ["lightfield-gs", "encode", str(scene), "-o", f"{folder}/image.png"]
        sys.setprofile(record)
        try:
            runpy.run_module("lightfield_gs", run_name="__main__", alter_sys=True)
        except SystemExit as end:
            if end.code:
                raise
        finally:
            sys.setprofile(None)
    files = [file for file, _, _ in calls]
    changes = sum(one != other for one, other in zip(files, files[1:], strict=False))
    print(f"encode {scene.name}: {len(set(calls))} functions in {len(set(files))} files, {changes} changes of file")
    print("  " + ", ".join(f"{file} {count}" for file, count in Counter(files).most_common()))


if __name__ == "__main__":
    main()
