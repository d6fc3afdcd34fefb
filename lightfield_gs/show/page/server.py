"""A small web server on this machine alone: each address is a function, and nothing else is served."""

from __future__ import annotations

import errno
import ipaddress
import json
import re
import secrets
import socket
import sys
import threading
import traceback
import webbrowser
from collections import Counter
from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field, replace
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from io import BufferedIOBase
from pathlib import Path
from urllib.parse import parse_qsl, urlsplit

from lightfield_gs.base.checks import real_number
from lightfield_gs.base.cli_messages import as_options, is_out_of_memory
from lightfield_gs.base.errors import InputError

DEFAULT_HOST = "127.0.0.1"
_FILES = Path(__file__).parent / "files"
_TYPES = {".html": "text/html", ".css": "text/css", ".js": "text/javascript"}
_LONGEST_QUERY, _MOST_VALUES = 4096, 64
_FILM_TYPES = {".webm": "video/webm", ".mkv": "video/x-matroska"}
_PART_BYTES = 4 << 20  # of a film, at most: browsers then ask for the next
_MOST_UPLOADED, _MOST_DRAINED = 2 << 30, 64 << 20  # bytes of a file, and of a refused one that are read on
_IDLE_S = 60  # after so long without a request a connection is closed
_BACKLOG = 128  # connections that wait to be taken
_MOST_LARGE, _MOST_SMALL = 4, 32  # answers at a time: of pictures at rest and files, of coarse pictures
_WAIT_S, _RETRY_S = 10.0, 2  # for a place among these, and until a client that got none asks again
TOKEN_HEADER = "X-Token"
# Addresses in other networks (RFC 5737, 1918, 3849 and 4193), by the way to which the system tells its own
_ELSEWHERE = (
    (socket.AF_INET, "192.0.2.1"),
    (socket.AF_INET, "192.168.254.254"),
    (socket.AF_INET, "172.31.254.254"),
    (socket.AF_INET, "10.254.254.254"),
    (socket.AF_INET6, "2001:db8::1"),
    (socket.AF_INET6, "fd00::1"),
)
_HEADERS = {
    "Cache-Control": "no-store",
    "X-Content-Type-Options": "nosniff",
    "Content-Security-Policy": "default-src 'self'; img-src 'self' blob: data:; frame-ancestors 'none'",
    "Cross-Origin-Resource-Policy": "same-origin",
}


@dataclass
class Answer:
    """The answer to a request: bytes of a type, with more headers.

    Attributes:
        sent: Called when the last byte of a GET is on its way.
    """

    body: bytes | memoryview
    type: str
    status: int = 200
    headers: dict[str, str] = field(default_factory=dict)
    sent: Callable[[], None] | None = None


Query = Mapping[str, str]


@dataclass(frozen=True)
class Route:
    """An address.

    Attributes:
        make: Makes the answer to a query.
        token: If given, the address is for POST alone, with the query as body and this token in a header. Else it is
            for GET and HEAD, and make changes nothing.
        place: The place in memory that the answer takes.
        file: Returns a file whose bytes are the answer, in parts as the request asks for them; in place of make.
        take: With a token, takes a file that is the body, its size in bytes, and the query of the address, before
            `make` answers that query.
    """

    make: Callable[[Query], Answer]
    token: str | None = None
    place: Callable[[Query], Reservation] | None = None
    file: Callable[[Query], Path] | None = None
    take: Callable[[Query, BufferedIOBase, int], None] | None = None


@dataclass(frozen=True)
class Reservation:
    """Memory reserved for an answer.

    Attributes:
        is_large: Whether the answer is a picture at rest or a file.
        key: Answers with one key are the same bytes, which are counted once.
    """

    is_large: bool
    key: Hashable = field(default_factory=object)


class Busy(Exception):
    """Too many answers are on their way to take one more into memory."""


class PendingAnswers:
    """Answers on their way, from before they are made until they are sent: few, for slow readers hold them in memory.

    Args:
        most: Largest number of different keys at a time.
    """

    def __init__(self, most: int):
        self._most, self._readers, self._changed = most, Counter[Hashable](), threading.Condition()

    @contextmanager
    def taken(self, key: Hashable) -> Iterator[None]:
        """Wait for a place. Raises Busy if none is free in time."""
        with self._changed:
            if not self._changed.wait_for(lambda: key in self._readers or len(self._readers) < self._most, _WAIT_S):
                raise Busy
            self._readers[key] += 1
        try:
            yield
        finally:
            with self._changed:
                self._readers[key] -= 1
                if not self._readers[key]:
                    del self._readers[key]
                self._changed.notify_all()


class Superseded(Exception):
    """A newer request makes this one pointless."""


def text(words: str, status: int = 200) -> Answer:
    return Answer(words.encode(), "text/plain; charset=utf-8", status)


def as_json(values: object) -> Answer:
    return Answer(json.dumps(values).encode(), "application/json")


def number(query: Mapping[str, str], name: str, low: float, high: float) -> float:
    """Return a number of the query in low..high. Raises InputError."""
    try:
        value = float(query[name])
    except KeyError:
        raise InputError(f"the query lacks {name}") from None
    except ValueError:
        raise InputError(f"{name} must be a number, got {query[name][:40]!r}") from None
    return real_number(name, value, low, high)


def page_file(name: str) -> Route:
    """Return the route of a file of a page, by its path in the folder `files`."""
    path = _FILES / name
    answer = Answer(path.read_bytes(), f"{_TYPES[path.suffix]}; charset=utf-8")
    return Route(lambda query: answer)


def file_route(path: Callable[[Query], Path]) -> Route:
    """Return the route of a film, which browsers read in parts."""
    return Route(lambda query: text("", 404), place=lambda query: Reservation(True), file=path)


def part_of_file(path: Path, wanted: str | None) -> Answer:
    """Return the part of a file that a header Range asks for (RFC 9110, 14.2), or its beginning if it is long.

    Args:
        path: The file.
        wanted: The header; None: not given. Of several parts the first counts.
    """
    size = path.stat().st_size
    found = re.fullmatch(r"bytes=(\d*)-(\d*)(?:,.*)?", (wanted or "bytes=0-").replace(" ", ""))
    if found is None or not (found[1] or found[2]):
        start, end = size, size  # not understood
    elif found[1]:
        start, end = int(found[1]), int(found[2] or size - 1)
    else:
        start, end = max(0, size - int(found[2])), size - 1
    if not start <= end or start >= size:
        return Answer(b"", "text/plain", 416, {"Content-Range": f"bytes */{size}"})
    end = min(end, size - 1, start + _PART_BYTES - 1)
    with path.open("rb") as file:
        file.seek(start)
        body = file.read(end + 1 - start)
    headers = {"Accept-Ranges": "bytes", "Content-Range": f"bytes {start}-{end}/{size}"}
    return Answer(body, _FILM_TYPES.get(path.suffix.lower(), "video/mp4"), 206, headers)


class Server(ThreadingHTTPServer):
    """Server of the addresses in `routes`, and no others.

    Args:
        port: 0 for any free port.
        host: An address or a name of this machine.

    Attributes:
        is_local: Whether this machine alone reaches it.
        is_name_of_itself: Whether it is local though the host is the machine's name in its network. Many systems lead
            this name to 127.0.0.1.

    Raises:
        InputError: it cannot listen there.
    """

    daemon_threads = True
    allow_reuse_address = True
    request_queue_size = _BACKLOG

    def __init__(self, routes: Mapping[str, Route], port: int = 0, host: str = DEFAULT_HOST):
        self.routes = routes
        # By whether an answer is large
        self.pending = {True: PendingAnswers(_MOST_LARGE), False: PendingAnswers(_MOST_SMALL)}
        host = host.strip("[]").rstrip(".") or "0.0.0.0"  # a name may end in the dot of the root
        try:
            self.address_family, address = _resolved(host, port)
            super().__init__(address, _Handler)
        except UnicodeError:
            raise InputError(f"host=: expected an address of this machine, got '{host}'") from None
        except OSError as error:
            if isinstance(error, socket.gaierror) or error.errno == errno.EADDRNOTAVAIL:
                raise InputError(
                    f"cannot listen on {host}: it is no address of this machine ({error.strerror or error}); give "
                    "another host="
                ) from None
            raise InputError(
                f"cannot listen on {host}:{port}: {error.strerror or error}; give another port=, or 0 for any"
            ) from None
        self._bound = ipaddress.ip_address(str(self.server_address[0]))
        self.is_local = self._bound.is_loopback
        self._names = {host.lower(), "localhost"} | (set() if self.is_local else _machine_names())
        self.is_name_of_itself = self.is_local and host.lower() in _machine_names() - {"localhost"}

    def server_bind(self) -> None:
        if self.address_family == socket.AF_INET6:
            with suppress(OSError):  # :: is for IPv4 as well, where the system can
                self.socket.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_V6ONLY, 0)
        super().server_bind()

    @property
    def url(self) -> str:
        """The address of the page for a browser on this machine."""
        if self.is_everywhere:
            return self._url("127.0.0.1" if self._bound.version == 4 else "::1")
        return self._url(str(self._bound))

    @property
    def is_everywhere(self) -> bool:
        """Whether it listens on all addresses of this machine."""
        return self._bound.is_unspecified

    @property
    def other_urls(self) -> list[str]:
        """The page's addresses for other machines, where it listens on all of this one's; as far as they are known."""
        families = [socket.AF_INET] if self._bound.version == 4 else [socket.AF_INET, socket.AF_INET6]
        return [self._url(address) for address in _addresses(families)]

    def _url(self, address: str) -> str:
        return f"http://{f'[{address}]' if ':' in address else address}:{self.server_address[1]}"

    def is_named(self, name: str | None) -> bool:
        """Return whether a request names this server: a foreign page whose name was made to lead here does not.

        Its names are the host given, this machine's, and addresses: a browser gives these only where they were asked
        for. A server on one address has only this address, and the local ones.
        """
        if name is None:
            return False
        name = name.rstrip(".")
        try:
            address = ipaddress.ip_address(name)
        except ValueError:
            return name in self._names
        return address.is_loopback or address == self._bound or self.is_everywhere

    def handle_error(self, request: object, client_address: object) -> None:
        """Ignore a broken connection: it is no fault of the program."""
        error = sys.exc_info()[1]
        if not isinstance(error, (ConnectionError, TimeoutError)):
            traceback.print_exc()

    def run(self, open_path: str | None = None, opened: Callable[[str], object] = webbrowser.open) -> None:
        """Serve until Ctrl-C.

        Args:
            open_path: The page that the browser is told to open.
            opened: Opens a browser at an address.
        """
        if open_path is not None:
            opened(self.url + open_path)
        try:
            self.serve_forever(poll_interval=0.2)
        except KeyboardInterrupt:
            print("\nended")
        finally:
            self.server_close()


def _resolved(host: str, port: int) -> tuple[socket.AddressFamily, tuple[str, int]]:
    """Return the family and the address of a host, IPv4 if it has both. Raises OSError or UnicodeError."""
    found = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)
    family, *_, address = min(found, key=lambda each: each[0] != socket.AF_INET)
    return family, (str(address[0]), port)


def _machine_names() -> set[str]:
    """Return the names of this machine in the network, in lower case."""
    name = socket.gethostname().lower()
    short = name.split(".")[0]
    return {name, short, f"{short}.local"}


def _addresses(families: Sequence[socket.AddressFamily]) -> list[str]:
    """Return the addresses of this machine that others in its networks reach, of these families."""
    found: dict[str, None] = {}  # each once, in order
    for family, target in _ELSEWHERE:
        if family in families:
            with suppress(OSError), socket.socket(family, socket.SOCK_DGRAM) as probe:
                probe.connect((target, 9))  # sends nothing: the system says from which address it would
                found[str(probe.getsockname()[0])] = None
    with suppress(OSError):
        for family, *_, address in socket.getaddrinfo(socket.gethostname(), None, type=socket.SOCK_STREAM):
            if family in families:
                found[str(address[0])] = None
    return [address for address in found if not _is_of_no_use(address)]


def _is_of_no_use(address: str) -> bool:
    """Return whether others cannot open an address, or a browser cannot (a link-local one)."""
    parsed = ipaddress.ip_address(address)
    return parsed.is_loopback or parsed.is_unspecified or parsed.is_link_local


class _Handler(BaseHTTPRequestHandler):
    server: Server
    protocol_version = "HTTP/1.1"  # the connection stays, which saves a frame its start
    timeout = _IDLE_S
    disable_nagle_algorithm = True

    def log_message(self, format: str, *args: object) -> None:
        """Print nothing: there are many requests a second."""

    def end_headers(self) -> None:
        """End the headers of any answer, also of an error, with the common headers."""
        for name, value in _HEADERS.items():
            self.send_header(name, value)
        super().end_headers()

    def _respond(self) -> None:
        with ExitStack() as held:
            self._send(self._answer(held))

    do_GET = do_HEAD = do_POST = _respond

    def _answer(self, held: ExitStack) -> Answer:
        try:
            # Unread data of a request would be taken for the next request
            body, self._is_read = b"", not (self.headers.get("Content-Length") or self.headers.get("Transfer-Encoding"))
            if refused := self._refused():
                return refused
            address = urlsplit(self.path)
            route = self.server.routes.get(address.path)
            if route is None:
                return text("there is no such page", 404)
            allowed = ("GET", "HEAD") if route.token is None else ("POST",)
            if self.command not in allowed:
                return Answer(b"", "text/plain", 405, {"Allow": ", ".join(allowed)})
            if route.token is not None:
                given = self.headers.get(TOKEN_HEADER, "")
                if not secrets.compare_digest(given.encode(), route.token.encode()):
                    return text("this page is not of this run of the program; load it again", 403)
                body = self._body() if route.take is None else b""
            query = address.query if route.token is None or route.take is not None else body.decode()
            if len(query) > _LONGEST_QUERY:
                return text("the query is too long", 414)
            values = dict(parse_qsl(query, max_num_fields=_MOST_VALUES))
            if route.place is not None:
                place = route.place(values)
                held.enter_context(self.server.pending[place.is_large].taken(place.key))
            if route.file is not None:
                return part_of_file(route.file(values), self.headers.get("Range"))
            if route.take is not None:
                self._upload(route.take, values)
            return route.make(values)
        except Superseded:
            return text("a newer request has taken the place of this one", 409)
        except Busy:
            busy = text("others are still reading their pictures; try again", 503)
            return replace(busy, headers={"Retry-After": str(_RETRY_S)})
        except (InputError, ValueError) as error:
            return text(str(error), 400)
        except Exception as error:
            if is_out_of_memory(error):
                return text("out of memory; use a smaller scene or panel", 507)
            traceback.print_exc()
            return text("the program failed; the terminal says where", 500)

    def _refused(self) -> Answer | None:
        """Return the refusal of a request from a foreign page; None for all other requests."""
        host = self.headers.get("Host", "")
        if not self.server.is_named(urlsplit(f"//{host}").hostname):
            other = as_options("start it with host= and the name")
            return text(f"this server is not named so; open {self.server.url}, or {other}", 403)
        site = self.headers.get("Sec-Fetch-Site")
        # Browsers send no Sec-Fetch-Site over plain http to other machines: there Referer tells of pictures and links
        callers = [self.headers.get(name) for name in (("Origin", "Referer") if site is None else ("Origin",))]
        is_foreign = any(caller and urlsplit(caller).netloc != host for caller in callers)
        if site not in (None, "same-origin", "none") or is_foreign:
            return text("pages from elsewhere are refused; enter the address in the browser by hand", 403)
        return None

    def _body(self) -> bytes:
        """Return the body of a request. Raises InputError where its length is missing, or too large."""
        body = self.rfile.read(self._length(_LONGEST_QUERY))
        self._is_read = True
        return body

    def _upload(self, take: Callable[[Query, BufferedIOBase, int], None], query: Query) -> None:
        """Have a file taken. A refused one is read to its end, so that the browser reads the refusal."""
        size = self._length(_MOST_UPLOADED)
        try:
            take(query, self.rfile, size)
        except InputError:
            if size <= _MOST_DRAINED:
                self.rfile.read(size)
                self._is_read = True
            raise
        self._is_read = True

    def _length(self, most: int) -> int:
        """Return the bytes of the body. Raises InputError where they are missing, or more than these."""
        length = self.headers.get("Content-Length", "")
        if self.headers.get("Transfer-Encoding") or not length.isdecimal() or int(length) > most:
            raise InputError(f"expected a body of 0..{most} bytes, and its Content-Length")
        return int(length)

    def _send(self, answer: Answer) -> None:
        self.close_connection |= not self._is_read
        self.send_response(answer.status)
        if self.close_connection:
            self.send_header("Connection", "close")
        sizes = {"Content-Type": answer.type, "Content-Length": str(len(answer.body))}
        for name, value in {**sizes, **answer.headers}.items():
            self.send_header(name, value)
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(answer.body)
            if answer.sent is not None:
                answer.sent()
