"""The command line `lightfield-gs`.

Each command imports what it needs when it runs, so that --help is quick.
"""

from __future__ import annotations

import argparse
import importlib
import io
import signal
import sys
import time
from collections.abc import Sequence
from contextlib import nullcontext
from functools import partial
from pathlib import Path
from typing import NoReturn, cast

from lightfield_gs.base.cli_messages import (
    FOLDER_GONE,
    PatientStream,
    closing_lines,
    has_working_folder,
    open_closed_streams,
    quiet,
    report_error,
)
from lightfield_gs.base.errors import InputError
from lightfield_gs.base.system import is_closed_pipe, stop_signals
from lightfield_gs.commands.options.parser import Parser, join_values
from lightfield_gs.commands.unknown import check_input, check_source, unknown_command

# A command has its arguments in a file of lightfield_gs/commands/arguments, and runs by one of lightfield_gs/commands
COMMAND_GROUPS = {
    "pictures": {
        "encode": "turn a photo or a 3D scene into the picture of a 3D display",
        "video": "make a video of a scene, of a photo or of pictures in a row",
        "quilt": "render many views in one picture, for Looking Glass programs",
        "weave": "turn a quilt or a folder of views into the picture of a display",
        "batch": "encode all photos, scenes and videos of a folder",
    },
    "looking": {
        "live": "show a camera or the screen on the 3D display, as it happens",
        "view": "look at a photo or a scene in the browser, and adjust it",
        "page": "make one file to send, which shows a scene in any browser",
        "show": "show pictures and films on the 3D display, full screen",
        "simulate": "see what an eye before the display sees of a picture",
    },
    "displays": {
        "displays": "list the screens that are connected, and the 3D displays",
        "calibrate": "make a calibration fit its display",
    },
    "scenes and files": {
        "fit": "make a 3D scene of photographs that show it from many sides",
        "simplify": "make a scene much smaller: merge what a display cannot show",
        "prune": "make a scene smaller: leave out what hardly shows",
        "info": "say what is in a file",
        "bench": "measure speed and accuracy",
    },
}
COMMANDS = {name: purpose for commands in COMMAND_GROUPS.values() for name, purpose in commands.items()}
_INPUTS = ("input", "image")  # arguments that are files to read
_SOURCES = ("source", "eyes")  # arguments that may name one
_EXAMPLES = (
    ("displays", "which displays are connected"),
    ("encode photo.jpg -o out.png", "a photo, for the display"),
    ("show out.png", "the picture, full screen"),
    ("view photo.jpg", "look at it, and adjust it"),
)
_REMEDIES = {"fit": "use fewer --gaussians, a smaller --scale or a lower --sh-degree"}  # where memory does not suffice


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command and return its exit code, or 2 after a line on invalid input."""
    for number in stop_signals():
        signal.signal(number, _terminate)
    # As a program, the imports before this line (torch, a second) are part of the wait.
    if argv is not None:
        return _run(list(argv), time.perf_counter())
    began = time.perf_counter() - time.process_time()
    open_closed_streams()
    # Names and contents of files may have bytes that are no text
    sys.stdout, output = PatientStream.wrap(cast(io.TextIOWrapper, sys.stdout), "backslashreplace")
    sys.stderr, _ = PatientStream.wrap(cast(io.TextIOWrapper, sys.stderr), "backslashreplace")
    try:
        code = _run(sys.argv[1:], began)
    except SystemExit as end:  # --help among others
        code = end.code if isinstance(end.code, int) else 0
    sys.stdout.flush()
    if output.failed is None or is_closed_pipe(output.failed):  # by the latter nobody wants to read on
        return code
    lost = f"cannot write to standard output: {output.failed.strerror}; what was to be read there is lost"
    return code or report_error("lightfield-gs", InputError(lost), "")


def _run(arguments: list[str], began: float) -> int:
    """Run one command and return the exit code."""
    try:
        if arguments[:1] and arguments[0] in COMMANDS and not has_working_folder():
            raise InputError(FOLDER_GONE)
        if arguments and arguments[0] not in COMMANDS and not arguments[0].startswith("-"):
            raise unknown_command(arguments, COMMANDS)
        words = join_values(arguments)
        args = build_parser(*arguments[:1]).parse_args(words, argparse.Namespace(began=began, words=words[1:]))
        for name in _INPUTS if arguments[0] != "fit" else ():  # which says what a capture is
            if isinstance(path := getattr(args, name, None), Path):
                check_input(path)
        for name in _SOURCES:
            if isinstance(words_of := getattr(args, name, None), str):
                check_source(words_of)
        with quiet() if getattr(args, "quiet", False) else nullcontext(), closing_lines():
            code = importlib.import_module(args.module).run(args) or 0
        return code
    except (Exception, KeyboardInterrupt) as error:
        remedy = _REMEDIES.get(next(iter(arguments), ""), "use a smaller scene or panel")
        return report_error("lightfield-gs", error, remedy)


def build_parser(command: str | None = None) -> Parser:
    """Return the parser of all commands; `command` has its arguments at once, the others when they are asked for."""
    parser = Parser(
        "lightfield-gs",
        description="Turn one photo, or a 3D scene, into the picture of a glasses-free 3D display.",
        allow_abbrev=False,
    )
    parser.text.examples, parser.text.sections = _EXAMPLES, COMMAND_GROUPS
    parser.text.footer = "Each command explains itself: lightfield-gs COMMAND --help"
    parser.add_argument("--version", action=_Version, nargs=0, short="print the version", help="print the version")
    commands = parser.add_subparsers(title="commands", required=True, metavar="COMMAND", parser_class=Parser)
    for name in COMMANDS:
        subparser = commands.add_parser(name, fill=partial(_fill, name), allow_abbrev=False)
        subparser.set_defaults(module=f"lightfield_gs.commands.{name}")
        if name == command:
            subparser.complete()
    return parser


def _fill(name: str, parser: Parser) -> None:
    importlib.import_module(f"lightfield_gs.commands.arguments.{name}").add_arguments(parser)


class _Version(argparse.Action):
    def __call__(self, parser, namespace, values, option_string=None):
        from importlib.metadata import version

        print(f"lightfield-gs {version('lightfield-gs')}")
        parser.exit()


def _terminate(number: int, frame: object) -> NoReturn:
    raise SystemExit(128 + number)  # unwinds, so that temporary files go


if __name__ == "__main__":
    sys.exit(main())
