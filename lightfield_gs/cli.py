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
from typing import NoReturn, cast

from lightfield_gs.base.cli_messages import (
    FOLDER_GONE,
    PatientStream,
    has_working_folder,
    open_closed_streams,
    print_assumptions,
    report_error,
)
from lightfield_gs.base.errors import InputError
from lightfield_gs.base.system import is_closed_pipe, stop_signals
from lightfield_gs.commands.options.parser import Parser, join_values

# Each command is a file of lightfield_gs/commands, which has its arguments and runs it
COMMANDS = {
    "fit": "fit Gaussians to photographs of a scene",
    "encode": "encode a photo or a scene as the image of a panel",
    "quilt": "render the views of a photo or a scene as a Looking Glass quilt",
    "weave": "interlace a quilt or a folder of views for a panel",
    "prune": "remove the Gaussians that hardly show on a panel",
    "video": "encode a scene with moving cameras, or a sequence of pictures",
    "batch": "encode many photos, scenes, captures and videos on all GPUs",
    "simulate": "simulate the picture that an eye sees through the lenses",
    "view": "open a page that shows and steers a scene",
    "show": "show an encoded image on the panel, full screen",
    "displays": "list the screens that are connected, and the 3D displays among them",
    "calibrate": "calibrate the profile of a panel",
    "info": "describe the contents of a file",
    "bench": "measure speed and accuracy",
}
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
        args = build_parser(*arguments[:1]).parse_args(join_values(arguments), argparse.Namespace(began=began))
        with print_assumptions():
            code = importlib.import_module(args.module).run(args) or 0
        return code
    except (Exception, KeyboardInterrupt) as error:
        remedy = _REMEDIES.get(next(iter(arguments), ""), "use a smaller scene or panel")
        return report_error("lightfield-gs", error, remedy)


def build_parser(command: str | None = None) -> argparse.ArgumentParser:
    """Return the parser with the arguments of one command only: the arguments of `bench` import torch."""
    parser = Parser(
        "lightfield-gs",
        description="One photo, or a scene of 3D Gaussians, to the image that a slanted-lenticular 3D panel shows.",
        allow_abbrev=False,
    )
    parser.add_argument("--version", action=_Version, nargs=0, help="print the version and exit")
    commands = parser.add_subparsers(title="commands", required=True, metavar="COMMAND", parser_class=Parser)
    for name, purpose in COMMANDS.items():
        subparser = commands.add_parser(name, help=purpose, allow_abbrev=False)
        subparser.set_defaults(module=f"lightfield_gs.commands.{name}")
        if name == command:
            importlib.import_module(f"lightfield_gs.commands.{name}").add_arguments(subparser)
    return parser


class _Version(argparse.Action):
    def __call__(self, parser, namespace, values, option_string=None):
        from importlib.metadata import version

        print(f"lightfield-gs {version('lightfield-gs')}")
        parser.exit()


def _terminate(number: int, frame: object) -> NoReturn:
    raise SystemExit(128 + number)  # unwinds, so that temporary files go


if __name__ == "__main__":
    sys.exit(main())
