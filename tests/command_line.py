"""The command line from outside: what tests of it run on, and what they expect of every command."""

import signal

import torch
from panel_cases import template_panel

from lightfield_gs import cli
from lightfield_gs.scene.gaussians import Gaussians

PANEL = template_panel(96, 60, 12, phase=-3.5, cone_deg=30, viewing_distance_mm=600, pixel_pitch_mm=0.3, name="small")


def scene(count=60, seed=0) -> Gaussians:
    r = torch.Generator().manual_seed(seed)
    return Gaussians(
        torch.rand(count, 3, generator=r) - 0.5,
        torch.randn(count, 4, generator=r),
        torch.rand(count, 3, generator=r) * 0.05 + 0.02,
        torch.rand(count, generator=r) * 0.8 + 0.1,
        torch.randn(count, 4, 3, generator=r) * 0.4,
    )


def heed_ctrl_c() -> None:
    """The preexec_fn of a program, as from a terminal: tests in the background may have SIGINT ignored."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)


def run(capsys, line: str) -> str:
    """Output of a command that must succeed."""
    code = cli.main(line.split())
    output = capsys.readouterr()
    assert code == 0, output.err
    assert output.err == ""
    return output.out


def complaint(capsys, line: str) -> str:
    """The one line that a refused command prints."""
    try:
        code = cli.main(line.split())
    except SystemExit as stop:
        code = stop.code
    output = capsys.readouterr()
    assert code == 2, (code, output)
    assert output.err.startswith("lightfield-gs: error: ") and output.err.count("\n") == 1 and output.out == ""
    return output.err
