"""What --help says, on one screen, and that it and refusals of arguments do not wait for torch."""

import subprocess
import sys

import pytest
from command_line import complaint

from lightfield_gs import cli
from lightfield_gs.commands.arguments.calibrate import ACTIONS
from lightfield_gs.commands.options.parser import Parser

pytestmark = pytest.mark.not_sanitized
COMMANDS = [*cli.COMMANDS, *(f"calibrate {action}" for action in ACTIONS)]
# Runs each line of the command line where numpy and torch cannot be imported
RUN = """
import sys
class Refuse:
    def find_spec(self, name, *_):
        assert name not in ("torch", "numpy"), name + " is imported"
sys.meta_path.insert(0, Refuse())
from lightfield_gs import cli
for line in sys.argv[1:]:
    try:
        code = cli.main(line.split())
    except SystemExit as end:
        code = end.code or 0
    print(code, file=sys.stderr)
"""


def text(capsys, line: str) -> str:
    with pytest.raises(SystemExit):
        cli.main(line.split())
    return capsys.readouterr().out


@pytest.mark.parametrize("command", ["", *COMMANDS])
def test_help_is_a_screen_with_examples_first(command, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    lines = text(capsys, f"{command} --help").splitlines()
    assert len(lines) <= 40 and max(map(len, lines)) <= 100
    assert lines.index("examples:") < lines.index("actions:" if command == "calibrate" else "options:")
    assert any(line.startswith(f"  lightfield-gs {command}".rstrip()) for line in lines)


@pytest.mark.parametrize("command", [name for name in COMMANDS if name != "calibrate"])
def test_help_all_has_every_option_and_groups(command, capsys):
    parser = cli.build_parser(command.split()[0])
    for name in command.split():
        parser = next(iter(parser._subparsers._group_actions)).choices[name]
    parser.complete()
    assert isinstance(parser, Parser)
    shown = text(capsys, f"{command} --help-all")
    for action in parser._actions:
        for name in action.option_strings:
            assert name in shown or name in ("-h", "--help", "--help-all"), name
    assert list(parser.text.groups) == [title for title in parser.text.groups if f"\n{title}:\n" in shown]


def test_help_and_refusals_of_arguments_import_neither_torch_nor_numpy():
    bad = [f"{name} --no-such-option" for name in COMMANDS]
    wrong = [
        "encode a.jpg -o o.png --panel protrait",
        "video a.jpg -o o.mp4 --device gpu",
        "enocde a.jpg",
        "photo.jpg",
        "view none.jpg",
    ]
    fine = ["--help", "--version", "encode --help", "encode --help-all"]
    lines = [sys.executable, "-c", RUN, *bad, *wrong, *fine]
    done = subprocess.run(lines, capture_output=True, text=True, timeout=60)
    said = done.stderr.splitlines()
    assert done.returncode == 0, done.stderr
    assert [line for line in said if not line.startswith("lightfield-gs: error: ")] == (
        ["2"] * len(bad + wrong) + ["0"] * len(fine)
    )


def test_a_file_that_is_missing_is_said_with_one_of_its_kind(folder, capsys):
    error = complaint(capsys, f"encode {folder}/S.pyl -o o.png")
    assert f"cannot read {folder}/S.pyl: No such file or directory; did you mean `{folder}/s.ply`?" in error
    assert "did you mean" not in complaint(capsys, "show nothing-like-it")


@pytest.mark.parametrize(
    "line, words",
    [
        ("enocde photo.jpg -o out.png", "did you mean `encode`?"),
        ("photo.jpg", "did you mean `lightfield-gs encode photo.jpg -o photo-3d.png`?"),
        ("room_qs8x6a1.78.png --panel 27", "`lightfield-gs weave room_qs8x6a1.78.png -o room-3d.png --panel 27`?"),
        ("film.mov", "did you mean `lightfield-gs video film.mov -o film-3d.mp4`?"),
        ("encode photo.jpg --panle 27", "unrecognized arguments: --panle; did you mean `--panel`?"),
        ("encode photo.jpg -panel 27 -o out.png", "did you mean `--panel`?"),
        ("encode photo.jpg -o out.png --panel protrait", "did you mean 'portrait'?"),
        ("encode photo.jpg -o out.png --fit contian", "did you mean `contain`?"),
        ("encode photo.jpg -o out.png --device webgup", "did you mean `webgpu`?"),
        ("calibrate nugde visual.json", "did you mean `nudge`?"),
    ],
)
def test_slips_get_a_suggestion(capsys, line, words):
    assert words in complaint(capsys, line)
