"""The hand-over to Looking Glass Bridge, against a server that answers as Bridge does (Bridge.js, schemas)."""

import json
import threading
import time
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import pytest

from lightfield_gs import InputError
from lightfield_gs.show.bridge import cast, check_bridge


class Stub(ThreadingHTTPServer):
    """Keeps the requests; `answers` has what is said in place of success, by request."""

    daemon_threads = True

    def __init__(self):
        super().__init__(("127.0.0.1", 0), Handler)
        self.asked: list[tuple[str, dict]] = []
        self.answers: dict[str, object] = {}

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.server_port}"


class Handler(BaseHTTPRequestHandler):
    server: Stub

    def do_PUT(self):
        what = self.path.strip("/")
        body = json.loads(self.rfile.read(int(self.headers["Content-Length"])))
        self.server.asked.append((what, body))
        value = {"enter_orchestration": "token-7", "available_output_devices": {"0": {}}}.get(what, {})
        answer = {"name": what, "payload": {"value": value}, "status": {"value": "Completion"}}
        answer = self.server.answers.get(what, answer)
        if answer == "sleep":
            time.sleep(1)
        self.send_response(500 if answer == "fail" else 200)
        self.end_headers()
        self.wfile.write(answer.encode() if isinstance(answer, str) else json.dumps(answer).encode())

    def log_message(self, *_):
        pass


@pytest.fixture
def bridge():
    with Stub() as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield server
        server.shutdown()


@pytest.fixture
def quilt(tmp_path):
    path = tmp_path / "a b_qs4x3a0.75.png"
    path.write_bytes(b"any")
    return path


def test_a_quilt_is_played(bridge, quilt):
    cast(quilt, 4, 3, 0.75, url=bridge.url)
    names = [name for name, _ in bridge.asked]
    order = ["enter_orchestration", "instance_playlist", "insert_playlist_entry", "play_playlist"]
    assert [name for name in names if name in order] == order
    asked = dict(bridge.asked)
    assert all(body["orchestration"] == "token-7" for name, body in bridge.asked if name != "enter_orchestration")
    entry = asked["insert_playlist_entry"]
    assert entry["uri"] == str(quilt) and entry["isRGBD"] == 0 and entry["index"] == 0
    assert (entry["cols"], entry["rows"], entry["aspect"], entry["view_count"]) == (4, 3, 0.75, 12)
    assert entry["name"] == asked["instance_playlist"]["name"] == asked["play_playlist"]["name"]
    assert asked["instance_playlist"]["loop"] is True and asked["play_playlist"]["head_index"] == -1


def test_the_playlist_of_the_time_before_may_be_absent(bridge, quilt):
    bridge.answers["delete_playlist"] = {"status": {"value": "Failure"}}
    cast(quilt, 4, 3, 0.75, url=bridge.url)
    assert bridge.asked[-1][0] == "play_playlist"


@pytest.mark.parametrize(
    "what, answer, words",
    [
        ("play_playlist", "fail", "refuses play_playlist: HTTP 500"),
        ("insert_playlist_entry", {"status": {"value": "Failure"}}, "refuses insert_playlist_entry: Failure"),
        (
            "play_playlist",
            {"status": {"value": "Failure"}, "payload": {"value": {"message": {"value": "no window"}}}},
            "Failure, 'no window'",
        ),
        ("enter_orchestration", {"status": {"value": "Completion"}}, "gave no session"),
        ("enter_orchestration", "<html>", "another program's port"),
        ("enter_orchestration", "[1]", "another program's port"),
        ("enter_orchestration", "[" * 100_000, "another program's port"),
        ("available_output_devices", {"status": {"value": "Completion"}, "payload": {"value": {}}}, "no display"),
        ("show_window", "sleep", "within 0.2 s"),
    ],
)
def test_what_bridge_refuses_is_said_in_one_line(bridge, quilt, what, answer, words):
    bridge.answers[what] = answer
    with pytest.raises(InputError, match=words) as raised:
        cast(quilt, 4, 3, 0.75, url=bridge.url, timeout_s=0.2)
    assert "\n" not in str(raised.value)


def test_whether_bridge_runs_is_looked_at_first(bridge):
    check_bridge(bridge.url)
    bridge.answers["bridge_version"] = "<html>"
    with pytest.raises(InputError, match="another program's port"):
        check_bridge(bridge.url)
    assert [name for name, _ in bridge.asked] == ["bridge_version"] * 2


def test_bridge_that_does_not_run(quilt):
    with Stub() as server:
        url = server.url
    with pytest.raises(InputError, match="does not answer at .*start it"):
        cast(quilt, 4, 3, 0.75, url=url)
    with pytest.raises(InputError, match="expected one like http://localhost:33334"):
        cast(quilt, 4, 3, 0.75, url="localhost")


def test_files_and_numbers_are_looked_at_first(quilt):
    with pytest.raises(InputError, match="no such file"):
        cast(quilt.with_name("other.png"), 4, 3, 0.75)
    with pytest.raises(InputError, match="columns must be"):
        cast(quilt, 0, 3, 0.75)
