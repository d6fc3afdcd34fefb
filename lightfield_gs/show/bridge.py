"""Quilts to a Looking Glass display, through Looking Glass Bridge and its local HTTP interface.

Sources: Looking Glass documentation, "Web Application Integration", and its library Bridge.js
(github.com/Looking-Glass/bridge.js). A request is a PUT of a JSON object to the address of the request's name. An
answer holds `status`, which is "Completion" on success, and `payload`.
"""

from __future__ import annotations

import http.client
import json
import urllib.error
import urllib.request
from pathlib import Path
from typing import Any

from lightfield_gs.base.checks import real_number, whole_number
from lightfield_gs.base.errors import InputError
from lightfield_gs.base.options import BRIDGE_URL
from lightfield_gs.io.atomic import checked_path

_TIMEOUT_S = 10.0
_LIMIT_BYTES = 4 << 20
_PLAYLIST = "lightfield-gs"
_ANY_DISPLAY = -1


def cast(
    path: str | Path,
    columns: int,
    rows: int,
    aspect: float,
    *,
    url: str = BRIDGE_URL,
    display: int = _ANY_DISPLAY,
    timeout_s: float = _TIMEOUT_S,
) -> None:
    """Show a quilt, a picture or a looped video by Bridge, in place of this program's last one.

    Bridge reads the file itself: the file must stay where it is, and Bridge must run on this computer.

    Args:
        columns, rows: Numbers of views along and down the quilt.
        aspect: Width / height of a view.
        display: Number of the display by Bridge's own count; -1 is the first.
        timeout_s: Longest wait for each answer.

    Raises:
        InputError: the file is not there, or Bridge does not answer, or answers with an error.
    """
    path = checked_path(path)
    if not path.is_file():
        raise InputError(f"cannot show {path}: there is no such file")
    columns, rows = whole_number("columns", columns, 1, 1000), whole_number("rows", rows, 1, 1000)
    aspect = real_number("aspect", aspect, 1e-3, 1e3)
    bridge = _Bridge(url, timeout_s)
    session = {"orchestration": bridge.enter()}
    playlist = {**session, "name": _PLAYLIST, "loop": True}
    if bridge.ask("available_output_devices", session).get("payload", {}).get("value") == {}:
        raise InputError(f"Looking Glass Bridge at {url} finds no display; connect one and switch it on")
    bridge.ask("show_window", {**session, "show_window": True, "head_index": display})
    bridge.ask("delete_playlist", playlist, must_succeed=False)  # there is none the first time
    bridge.ask("instance_playlist", playlist)
    bridge.ask("insert_playlist_entry", {**session, **_entry(path, columns, rows, aspect)})
    bridge.ask("play_playlist", {**session, "name": _PLAYLIST, "head_index": display})


def _entry(path: Path, columns: int, rows: int, aspect: float) -> dict[str, Any]:
    file = {"name": _PLAYLIST, "id": 0, "index": 0, "uri": str(path.resolve())}
    tiles = {"rows": rows, "cols": columns, "aspect": aspect, "view_count": columns * rows}
    return {**file, **tiles, "isRGBD": 0, "focus": 0, "crop_pos_x": 0, "crop_pos_y": 0, "zoom": 1, "tag": ""}


def check_bridge(url: str = BRIDGE_URL, timeout_s: float = _TIMEOUT_S) -> None:
    """Raise InputError if no Bridge answers, before any long work."""
    _Bridge(url, timeout_s).ask("bridge_version", {})


def connected_displays(url: str = BRIDGE_URL, timeout_s: float = _TIMEOUT_S) -> dict[str, Any]:
    """Return what Bridge tells of its displays: serial numbers, calibrations, kinds and places of windows, by number.

    Raises:
        InputError: Bridge does not answer, or answers with an error.
    """
    bridge = _Bridge(url, timeout_s)
    told = bridge.ask("available_output_devices", {"orchestration": bridge.enter()})["payload"].get("value")
    return told if isinstance(told, dict) else {}


class _Bridge:
    """Requests to one Bridge. The system's proxies are not asked: they do not know this computer as Bridge does."""

    def __init__(self, url: str, timeout_s: float):
        if not url.startswith(("http://", "https://")):
            raise InputError(f"the address of Looking Glass Bridge: expected one like {BRIDGE_URL}, got '{url}'")
        self._url, self._timeout_s = url.rstrip("/"), timeout_s
        self._opener = urllib.request.build_opener(urllib.request.ProxyHandler({}))

    def enter(self) -> str:
        """Return the token of a session, which all other requests carry."""
        token = self.ask("enter_orchestration", {"name": "default"}).get("payload", {}).get("value")
        if not isinstance(token, str) or not token:
            raise InputError(f"Looking Glass Bridge at {self._url} gave no session; update Bridge to 2.2 or newer")
        return token

    def ask(self, what: str, body: dict[str, Any], must_succeed: bool = True) -> dict[str, Any]:
        """Return the answer to a request. Raises InputError."""
        answer = self._answer(what, body)
        status = answer.get("status")
        outcome = status.get("value") if isinstance(status, dict) else None
        if must_succeed and outcome != "Completion":
            raise InputError(f"Looking Glass Bridge refuses {what}: {str(outcome)[:100]}{_message(answer)}")
        payload = answer.get("payload")
        return {**answer, "payload": payload if isinstance(payload, dict) else {}}

    def _answer(self, what: str, body: dict[str, Any]) -> dict[str, Any]:
        request = urllib.request.Request(
            f"{self._url}/{what}", json.dumps(body).encode(), {"Content-Type": "application/json"}, method="PUT"
        )
        try:
            with self._opener.open(request, timeout=self._timeout_s) as response:
                text = response.read(_LIMIT_BYTES + 1)
        except urllib.error.HTTPError as error:
            raise InputError(f"Looking Glass Bridge at {self._url} refuses {what}: HTTP {error.code}") from None
        except TimeoutError:
            raise self._silent(what) from None
        except (OSError, http.client.HTTPException) as error:
            if isinstance(getattr(error, "reason", None), TimeoutError):
                raise self._silent(what) from None
            reason = getattr(error, "reason", error)
            raise InputError(
                f"Looking Glass Bridge does not answer at {self._url} ({reason}); start it on this computer, or get it "
                "at lookingglassfactory.com"
            ) from None
        try:
            answer = json.loads(text)
        except (ValueError, RecursionError):
            answer = None
        if not isinstance(answer, dict) or len(text) > _LIMIT_BYTES:
            raise InputError(f"{self._url} does not answer as Looking Glass Bridge does; is it another program's port?")
        return answer

    def _silent(self, what: str) -> InputError:
        return InputError(f"Looking Glass Bridge at {self._url} does not answer {what} within {self._timeout_s:g} s")


def _message(answer: dict[str, Any]) -> str:
    """Return Bridge's message on a failure, if any."""
    part: Any = answer
    for key in ("payload", "value", "message", "value"):
        part = part.get(key) if isinstance(part, dict) else None
    return f", '{part[:200]}'" if isinstance(part, str) else ""
