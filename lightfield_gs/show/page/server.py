"""A small web server on this machine alone: each address is a function, and nothing else is served."""

from __future__ import annotations

import ipaddress
import json
import sys
import traceback
import webbrowser
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from urllib.parse import parse_qsl, urlsplit

from lightfield_gs.base.complaint import is_out_of_memory
from lightfield_gs.base.errors import InputError

DEFAULT_HOST = "127.0.0.1"
_FILES = Path(__file__).parent / "files"
_TYPES = {".html": "text/html", ".css": "text/css", ".js": "text/javascript"}
_LONGEST_QUERY, _MOST_VALUES = 4096, 64
_IDLE_S = 60  # after so long without a request a connection is closed
_HEADERS = {
    "Cache-Control": "no-store",
    "X-Content-Type-Options": "nosniff",
    "Content-Security-Policy": "default-src 'self'; img-src 'self' blob: data:",
}


@dataclass
class Answer:
    """What a request gets: bytes of a type, with more headers."""

    body: bytes
    type: str
    status: int = 200
    headers: dict[str, str] = field(default_factory=dict)


Route = Callable[[Mapping[str, str]], Answer]


class Superseded(Exception):
    """A newer request makes this one pointless."""


def text(words: str, status: int = 200) -> Answer:
    return Answer(words.encode(), "text/plain; charset=utf-8", status)


def as_json(values: object) -> Answer:
    return Answer(json.dumps(values).encode(), "application/json")


def page_file(name: str) -> Route:
    """The route of a file of the page, by its name in the folder `files`."""
    path = _FILES / name
    answer = Answer(path.read_bytes(), f"{_TYPES[path.suffix]}; charset=utf-8")
    return lambda query: answer


class Server(ThreadingHTTPServer):
    """Answers the addresses in `routes`, and no others. host: an address of this machine; port 0: any that is free.

    Raises InputError where it cannot listen there.
    """

    daemon_threads = True
    allow_reuse_address = True

    def __init__(self, routes: Mapping[str, Route], port: int = 0, host: str = DEFAULT_HOST):
        self.routes = routes
        self.is_local = _is_loopback(host)
        try:
            super().__init__((host, port), _Handler)
        except OSError as error:
            raise InputError(
                f"cannot listen on {host}:{port}: {error.strerror or error}; give another --port, or 0 for any"
            ) from None

    @property
    def url(self) -> str:
        host, port = self.server_address[:2]
        return f"http://{host!s}:{port}"

    def handle_error(self, request: object, client_address: object) -> None:
        """A connection that broke off is no fault of the program."""
        error = sys.exc_info()[1]
        if not isinstance(error, (ConnectionError, TimeoutError)):
            traceback.print_exc()

    def run(self, open_path: str | None = None) -> None:
        """Serves until Ctrl-C. open_path: the page that the browser is told to open."""
        if open_path is not None:
            webbrowser.open(self.url + open_path)
        try:
            self.serve_forever(poll_interval=0.2)
        except KeyboardInterrupt:
            print("\nended")
        finally:
            self.server_close()


def _is_loopback(host: str) -> bool:
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


class _Handler(BaseHTTPRequestHandler):
    server: Server
    protocol_version = "HTTP/1.1"  # the connection stays, which saves a frame its start
    timeout = _IDLE_S
    disable_nagle_algorithm = True

    def do_GET(self) -> None:
        self._send(self._answer(), with_body=True)

    def do_HEAD(self) -> None:
        self._send(self._answer(), with_body=False)

    def log_message(self, format: str, *args: object) -> None:
        """Says nothing: there are many requests a second."""

    def _answer(self) -> Answer:
        try:
            address = urlsplit(self.path)
            if self.server.is_local and not self._is_for_here():
                return text("this server answers this machine alone", 403)
            route = self.server.routes.get(address.path)
            if route is None:
                return text("there is no such page", 404)
            if len(address.query) > _LONGEST_QUERY:
                return text("the query is too long", 414)
            return route(dict(parse_qsl(address.query, max_num_fields=_MOST_VALUES)))
        except Superseded:
            return text("a newer request has taken the place of this one", 409)
        except (InputError, ValueError) as error:
            return text(str(error), 400)
        except Exception as error:
            if is_out_of_memory(error):
                return text("out of memory; use a smaller scene or panel", 507)
            traceback.print_exc()
            return text("the program failed; the terminal says where", 500)

    def _is_for_here(self) -> bool:
        """Whether the request names this machine: a page from elsewhere, whose name leads here, does not."""
        name = urlsplit(f"//{self.headers.get('Host', '')}").hostname
        return name is not None and _is_loopback(name)

    def _send(self, answer: Answer, with_body: bool) -> None:
        self.send_response(answer.status)
        sizes = {"Content-Type": answer.type, "Content-Length": str(len(answer.body))}
        for name, value in {**_HEADERS, **sizes, **answer.headers}.items():
            self.send_header(name, value)
        self.end_headers()
        if with_body:
            self.wfile.write(answer.body)
