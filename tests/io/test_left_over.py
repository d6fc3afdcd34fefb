"""Half-written files of killed processes, and files of running ones."""

import signal
import subprocess
import sys
from pathlib import Path

import pytest
import windows

from lightfield_gs.io.atomic import atomic_folder, atomic_path, remove_left_over, scratch_folder

WRITING = """
import sys, time
from pathlib import Path
from lightfield_gs.io import atomic
with getattr(atomic, sys.argv[1])(Path(sys.argv[2])) as path:
    (path / "part" if path.is_dir() else path).write_bytes(b"half")
    print(path.name, flush=True)
    time.sleep(60)
"""


@pytest.fixture
def writing():
    """Starts processes that write and do not end: what they are told, and the name of what they write."""
    started = []

    def begin(how: str, path: Path, before: str = "") -> tuple[subprocess.Popen, str]:
        program = [sys.executable, "-c", before + WRITING, how, str(path)]
        process = subprocess.Popen(program, stdout=subprocess.PIPE, text=True)
        started.append(process)
        return process, process.stdout.readline().strip()

    yield begin
    for process in started:
        process.kill()
        process.wait()


def names(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()}


def parts(folder: Path) -> list[Path]:
    return [path for path in folder.rglob("*") if path.name == "part"]


@pytest.mark.parametrize("how", ["atomic_path", "atomic_folder", "scratch_folder"])
def test_what_a_kill_leaves_goes_with_the_next_of_the_same_name_and_what_lives_stays(tmp_path, writing, how):
    target = tmp_path / "out.png"
    (dead, left), (alive, kept) = (writing(how, target) for _ in range(2))
    other, others = writing(how, tmp_path / "other.png")
    for process in (dead, other):
        process.send_signal(signal.SIGKILL)
        process.wait()
    assert names(tmp_path) == {left, kept, others}
    with {"atomic_path": atomic_path, "atomic_folder": atomic_folder, "scratch_folder": scratch_folder}[how](target):
        assert alive.poll() is None and len(names(tmp_path)) == 3 and {kept, others} < names(tmp_path)
        assert len(parts(tmp_path)) == (0 if how == "atomic_path" else 2)
    assert names(tmp_path) == {kept, others} | ({target.name} if how != "scratch_folder" else set())
    remove_left_over(tmp_path)  # of all names
    assert names(tmp_path) - {target.name} == {kept}


@pytest.mark.skipif(sys.platform != "linux", reason="the stand-in for Windows asks /proc for open files")
@pytest.mark.parametrize("how", ["atomic_path", "atomic_folder", "scratch_folder"])
def test_the_same_where_open_files_cannot_be_renamed_as_on_windows(tmp_path, writing, monkeypatch, how):
    target = tmp_path / "out.png"
    (dead, left), (alive, kept) = (writing(how, target, windows.PRELUDE) for _ in range(2))
    dead.kill(), dead.wait()
    assert names(tmp_path) == {left, kept, f"~{left}", f"~{kept}"}
    windows.stand_in(monkeypatch)
    with {"atomic_path": atomic_path, "atomic_folder": atomic_folder, "scratch_folder": scratch_folder}[how](target):
        assert alive.poll() is None and {kept, f"~{kept}"} < names(tmp_path) and len(names(tmp_path)) == 4
        assert len(parts(tmp_path)) == (0 if how == "atomic_path" else 1)
    made = {target.name} if how != "scratch_folder" else set()
    assert names(tmp_path) == {kept, f"~{kept}"} | made
    alive.kill(), alive.wait()
    remove_left_over(tmp_path)
    assert names(tmp_path) == made


def test_names_that_only_look_left_over_are_not_followed(tmp_path):
    secret = tmp_path / "secret"
    secret.write_bytes(b"kept")
    (tmp_path / ".out.partial-0.png").symlink_to(secret)
    with atomic_path(tmp_path / "out.png") as temporary:
        temporary.write_bytes(b"new")
    assert secret.read_bytes() == b"kept" and (tmp_path / "out.png").read_bytes() == b"new"
