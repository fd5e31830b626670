"""The daemon's STATUS to a page for a tablet's browser, which can look and nothing else.

Off unless the configuration names an address. What it serves is one static file, and twice JSON; there is no
request that changes anything. Who can reach the address can look.
"""

from __future__ import annotations

import base64
import hashlib
import ipaddress
import re
import socket
import sys
import threading
import time
from collections.abc import Callable
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any, Self, cast

import structlog

from polecal import PolecalError
from polecal.calib import Mount
from polecal.daemon.clouds import Clouds
from polecal.daemon.config import split_address
from polecal.daemon.control import as_message, encode

Message = dict[str, Any]

_FRESH_S = 1.0  # however many look, they are told the same for so long
_MAX_CLIENTS = 16
_SILENT_S = 5.0  # for which a client may neither send nor take anything
_LONGEST_S = 10.0  # after which a connection is ended, whatever it does
_LOOK_S = 0.2
_AGAIN_S = 5.0  # an address that is not there yet, as a tablet's network may come up late
_HTML = Path(__file__).with_name("page.html").read_bytes()


def _hashes(tag: str) -> str:
    """Give what of the file's own the browser may run or apply, and nothing else. CSP, hash-source."""
    inside = re.findall(rf"<{tag}>(.*?)</{tag}>".encode(), _HTML, re.DOTALL)
    return " ".join(f"'sha256-{base64.b64encode(hashlib.sha256(each).digest()).decode()}'" for each in inside)


_HEADERS = {
    "Content-Security-Policy": "; ".join(
        (
            f"default-src 'none'; script-src {_hashes('script')}; style-src {_hashes('style')}",
            "connect-src 'self'; img-src data:; base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
        )
    ),
    "Cross-Origin-Resource-Policy": "same-origin",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cache-Control": "no-store",
}


class Onlooker:
    """What the page is told, asked of the service no more than once a second."""

    def __init__(self, ask: Callable[[Message], Message], state_dir: Path) -> None:
        """``ask`` answers requests of the control protocol; passes are read from below ``state_dir``."""
        self._ask, self._state_dir = ask, state_dir
        self._looking, self._showing = threading.Lock(), threading.Lock()
        self._status: Message = {}
        self._encoded, self._until_s = b"", 0.0
        self._shown, self._shown_of = b"", ""
        self._clouds: dict[tuple[str, str], Clouds] = {}

    def status(self) -> bytes:
        """Give the STATUS object as JSON. Raises PolecalError."""
        return self._look()[1]

    def clouds(self) -> bytes:
        """Give the pole's clouds by the measured and by the present mount as JSON. Raises PolecalError."""
        with self._showing:
            status = self._look()[0]
            session, lasers = status["session"], status["lasers"]
            of = repr((session, [(one["estimate"], one["passes"], one["set_aside"]) for one in lasers]))
            if of != self._shown_of:
                self._shown = encode(self._show(session, lasers))
                self._shown_of = of
            return self._shown

    def _look(self) -> tuple[Message, bytes]:
        with self._looking:
            if time.monotonic() >= self._until_s:
                self._status = self._ask({"class": "STATUS"})
                self._encoded = encode(self._status)
                self._until_s = time.monotonic() + _FRESH_S
            return self._status, self._encoded

    def _show(self, session: str | None, lasers: list[Message]) -> Message:
        self._clouds = {key: kept for key, kept in self._clouds.items() if key[0] == session}
        shown = []
        used = self._used(session) if session is not None else {}
        for laser in lasers:
            name, found = laser["name"], laser["estimate"]
            passes = []
            if session is not None and found is not None:
                folder = self._state_dir / "sessions" / session
                clouds = self._clouds.setdefault((session, name), Clouds(folder, name))
                passes = clouds.show(used.get(name, []), Mount(**laser["measured"]), Mount(**found))
            shown.append({"name": name, "passes": passes})
        return {"class": "CLOUDS", "session": session, "lasers": shown}

    def _used(self, session: str) -> dict[str, list[int]]:
        """Ask which passes are in the estimate, by laser."""
        used: dict[str, list[int]] = {}
        first: int | None = 0
        while first is not None:
            answer = self._ask({"class": "PASSES", "session": session, "from": first})
            for row in answer["passes"]:
                if row["use"] == "used":
                    used.setdefault(row["laser"], []).append(row["pass"])
            first = answer["next"]
        return used


class Page:
    """Serves the page at an address, from `start` to `close`; also of one that comes up later."""

    def __init__(self, listen: str, ask: Callable[[Message], Message], state_dir: Path) -> None:
        """``listen`` is an IP address and a port, as 127.0.0.1:8291 or [::1]:8291."""
        self._host, self._port = split_address(listen)
        self._onlooker = Onlooker(ask, state_dir)
        self._log = structlog.get_logger().bind(listen=listen)
        self._lock = threading.Lock()
        self._closing = threading.Event()
        self._server: _Server | None = None
        self._thread = threading.Thread(target=self._run, name="page", daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._closing.set()
        with self._lock:
            if self._server is not None:
                self._server.shutdown()
        self._thread.join()

    def _run(self) -> None:
        told = ""
        while not self._closing.is_set():
            try:
                server = _Server(self._host, self._port, self._onlooker)
            except OSError as error:
                if str(error) != told:
                    told = str(error)
                    hint = "see page: in the configuration, and page.conf for what the service may do"
                    self._log.error("no page yet", problem=told, hint=hint)
                self._closing.wait(_AGAIN_S)
                continue
            with server:
                with self._lock:
                    if not self._closing.is_set():
                        self._server = server
                if self._server is not None:
                    self._log.info("page")
                    server.serve_forever(_LOOK_S)
            return


class _Server(ThreadingHTTPServer):
    """A thread a client, of whom there are few, none for long."""

    daemon_threads = True
    request_queue_size = _MAX_CLIENTS

    def __init__(self, host: str, port: int, onlooker: Onlooker) -> None:
        """Listen. Raises OSError."""
        self.onlooker = onlooker
        self._since_s: dict[socket.socket, float] = {}
        self._lock = threading.Lock()
        self.address_family = socket.AF_INET6 if ":" in host else socket.AF_INET
        super().__init__((host, port), _Handler)

    def server_bind(self) -> None:
        """Bind, without asking a name server for this machine's name."""
        self.socket.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        self.socket.bind(self.server_address)
        self.server_address = self.socket.getsockname()
        self.server_name, self.server_port = str(self.server_address[0]), int(self.server_address[1])

    def process_request(self, request: Any, client_address: Any) -> None:
        """Serve a client, unless there are too many."""
        with self._lock:
            full = len(self._since_s) >= _MAX_CLIENTS
            if not full:
                self._since_s[request] = time.monotonic()
        if full:
            request.setblocking(False)
            self.shutdown_request(request)
        else:
            super().process_request(request, client_address)

    def shutdown_request(self, request: Any) -> None:
        """End a client's connection."""
        with self._lock:
            self._since_s.pop(request, None)
        super().shutdown_request(request)

    def service_actions(self) -> None:
        """End connections that have lasted too long: each time it looks, and after each that was taken."""
        self._end(time.monotonic() - _LONGEST_S)

    def server_close(self) -> None:
        """Stop listening, and end every connection."""
        super().server_close()
        self._end(time.monotonic())

    def _end(self, before_s: float) -> None:
        with self._lock:
            for connection, since_s in self._since_s.items():
                if since_s <= before_s:
                    _shut(connection)

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Let go of a client that has gone away; of anything else, say so."""
        log = structlog.get_logger().bind(client=str(client_address[0]))
        if isinstance(sys.exception(), OSError):
            log.debug("page's client lost", exc_info=True)
        else:
            log.error("bug in the page", exc_info=True)


def _shut(connection: socket.socket) -> None:
    try:
        connection.shutdown(socket.SHUT_RDWR)
    except OSError:
        return  # it has just ended by itself


class _Handler(BaseHTTPRequestHandler):
    """One request and its answer: HTTP/1.0, as a connection that is kept would keep its thread."""

    timeout = _SILENT_S
    server_version, sys_version = "polecal", ""

    def parse_request(self) -> bool:
        """Read the request's head; answer by itself what is none to be served."""
        if not super().parse_request():
            return False
        if self.command != "GET":
            self.send_error(HTTPStatus.METHOD_NOT_ALLOWED)
        elif not _is_ours(self.headers.get_all("Host", [])):
            self.send_error(HTTPStatus.MISDIRECTED_REQUEST, "ask by the address's numbers, not by a name")
        else:
            return True
        return False

    def do_GET(self) -> None:
        """Serve the page or what it asks for."""
        onlooker = cast(_Server, self.server).onlooker
        try:
            match self.path.partition("?")[0]:
                case "/":
                    self._send(HTTPStatus.OK, "text/html; charset=utf-8", _HTML)
                case "/status":
                    self._send(HTTPStatus.OK, "application/json", onlooker.status())
                case "/clouds":
                    self._send(HTTPStatus.OK, "application/json", onlooker.clouds())
                case _:
                    self.send_error(HTTPStatus.NOT_FOUND)
        except PolecalError as error:
            self._send(HTTPStatus.SERVICE_UNAVAILABLE, "application/json", encode(as_message(error)))

    def send_error(self, code: int, message: str | None = None, explain: str | None = None) -> None:
        """Answer in a plain line why not."""
        line = f"{code} {message or HTTPStatus(code).phrase}\n"
        self._send(code, "text/plain; charset=utf-8", line.encode())

    def _send(self, code: int, kind: str, body: bytes) -> None:
        self.send_response(code)
        headers = {"Content-Type": kind, "Content-Length": str(len(body)), **_HEADERS}
        if code == HTTPStatus.METHOD_NOT_ALLOWED:
            headers["Allow"] = "GET"
        for name, value in headers.items():
            self.send_header(name, value)
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, format: str, *values: Any) -> None:
        """Log what was asked, for who looks for it: once a second it is."""
        structlog.get_logger().debug("page asked", client=self.client_address[0], said=format % values)


def _is_ours(hosts: list[str]) -> bool:
    """Say whether a browser asks by number: no name that somebody else may turn to this address is taken."""
    if len(hosts) != 1:
        return False
    bare = re.sub(r":\d*\Z", "", hosts[0].strip().lower())
    if bare == "localhost":
        return True
    if bare.startswith("[") and bare.endswith("]"):
        bare = bare[1:-1]
    try:
        ipaddress.ip_address(bare)
    except ValueError:
        return False
    return True
