"""JSON objects, a line each, over a Unix socket: the daemon's side of it and the operator's.

Who may connect is what the socket's mode and access list say: root, the daemon's own user and the group, and
whom the administrator lets in besides. All of them may look; to change what runs takes one of the former.
"""

from __future__ import annotations

import contextlib
import grp
import json
import math
import os
import pwd
import select
import socket
import stat
import struct
import threading
from collections.abc import Iterator
from contextvars import ContextVar
from dataclasses import dataclass
from enum import IntEnum
from pathlib import Path
from typing import Any, Protocol, Self

import structlog

from polecal import PolecalError, __version__
from polecal.drivers.errors import DeviceError, DeviceNotPermitted

Message = dict[str, Any]

PROTO = (1, 0)
GROUP = "polecal"
MAX_LINE_BYTES = 64 * 1024
REQUESTS = (
    "START",
    "STATUS",
    "WATCH",
    "STOP",
    "RESULT",
    "PASSES",
    "DROP",
    "KEEP",
    "SESSIONS",
    "REPORT",
    "ROUTE",
)
LOOKING = frozenset({"STATUS", "WATCH", "RESULT", "PASSES", "SESSIONS", "ROUTE"})
"""What whoever may connect may ask; the rest is for root, the daemon's own user and the group."""

_WATCH_S = 1.0
_MAX_CLIENTS = 32
_SEND_S = 5.0  # a client that takes nothing for so long is dropped
_PEERCRED = struct.Struct("iII")  # struct ucred: pid, uid, gid
_SO_PEERGROUPS = 59  # socket(7) has it since Linux 4.13, Python has no name for it
_GROUPS_BYTES = 1024  # as many as Python's getsockopt can give, 256
_LOGGED = 200  # characters
_peer_uid: ContextVar[int | None] = ContextVar("peer_uid", default=None)


def asker() -> str:
    """Give the user whose request is being answered; this process's own where it came by no socket."""
    uid = _peer_uid.get()
    uid = os.getuid() if uid is None else uid
    try:
        return pwd.getpwuid(uid).pw_name
    except KeyError:
        return f"uid {uid}"


class Code(IntEnum):
    """What an error means to a script: the exit code of the command that met it."""

    DEGRADED = 1
    USAGE = 2
    NO_DAEMON = 3
    DEVICE = 4
    REJECTED = 5
    BUSY = 75
    NOT_PERMITTED = 77
    CONFIG = 78


class Refused(PolecalError):
    """A request that was not done; ``code`` says of what kind the reason is."""

    def __init__(self, message: str, hint: str = "", code: int = Code.DEGRADED) -> None:
        super().__init__(message, hint)
        self.code = code


class NoDaemon(Refused):
    """Nobody serves the socket."""

    def __init__(self, message: str) -> None:
        super().__init__(
            message, "start it: `systemctl start polecal`, or `polecald --config FILE`", Code.NO_DAEMON
        )


class Handler(Protocol):
    """Who answers."""

    def handle(self, request: Message) -> Message:
        """Answer a request; called from many threads at once.

        WATCH comes as a STATUS a second. Raises PolecalError, which the client gets as an ERROR.
        """
        ...


@dataclass(frozen=True, slots=True)
class Peer:
    """The process at the other end of a Unix socket, as it was when it connected."""

    pid: int
    uid: int
    gids: frozenset[int]

    @classmethod
    def of(cls, connection: socket.socket) -> Self:
        """Ask the kernel. Raises OSError."""
        ucred = connection.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, _PEERCRED.size)
        pid, uid, gid = _PEERCRED.unpack(ucred)
        more = b""
        with contextlib.suppress(OSError):  # an older kernel, or more groups: the first one counts
            more = connection.getsockopt(socket.SOL_SOCKET, _SO_PEERGROUPS, _GROUPS_BYTES)
        return cls(pid, uid, frozenset({gid, *memoryview(more).cast("I")}))

    @property
    def may_change(self) -> bool:
        """Whether it is root, the daemon's own user or a member of the group."""
        if self.uid in (0, os.geteuid()):
            return True
        try:
            return grp.getgrnam(GROUP).gr_gid in self.gids
        except KeyError:
            return False


def code_of(error: PolecalError) -> int:
    """Give the exit code for an error."""
    if isinstance(error, DeviceNotPermitted):
        return Code.NOT_PERMITTED
    if isinstance(error, DeviceError):
        return Code.DEVICE
    return int(getattr(error, "code", Code.DEGRADED))


def encode(message: Message) -> bytes:
    """Write an object as a line of strict JSON; what is not finite becomes null."""
    return json.dumps(_finite(message), allow_nan=False, separators=(",", ":")).encode() + b"\n"


def _finite(value: object) -> object:
    if isinstance(value, dict):
        return {key: _finite(each) for key, each in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(each) for each in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def as_message(error: PolecalError) -> Message:
    """Write an error as the protocol's object."""
    return {"class": "ERROR", "code": code_of(error), "message": str(error), "hint": error.hint}


class _Lines:
    """A socket as lines in, objects out; never holds more than one line's bytes."""

    def __init__(self, connection: socket.socket, max_bytes: int) -> None:
        self.socket = connection
        self._max_bytes = max_bytes
        self._held = b""
        self._skipping = False

    def read(self) -> bytes | None:
        """Return the next line, None at the end. Raises Refused for one too long, OSError."""
        while True:
            line, newline, rest = self._held.partition(b"\n")
            if newline:
                self._held = rest
                if not self._skipping:
                    return line
                self._skipping = False
            elif len(self._held) > self._max_bytes:
                already, self._skipping, self._held = self._skipping, True, b""
                if not already:
                    raise Refused(f"a line of more than {self._max_bytes} bytes", code=Code.USAGE)
            else:
                data = self.socket.recv(16384)
                if not data:
                    return None
                self._held = data if self._skipping else self._held + data

    def waiting(self, timeout_s: float) -> bool:
        """Say whether the other side sent something, or left, within the time."""
        return bool(self._held or select.select([self.socket], [], [], timeout_s)[0])

    def write(self, message: Message) -> None:
        """Send an object. Raises OSError."""
        line = encode(message)
        if len(line) > MAX_LINE_BYTES:
            line = encode(as_message(Refused(f"the reply has {len(line)} bytes, too many")))
        self.socket.sendall(line)


class ControlServer:
    """Serves a handler on a socket, a thread a client, from `start` to `close`."""

    def __init__(self, path: Path, handler: Handler, watch_s: float = _WATCH_S) -> None:
        self.path = path
        self._handler = handler
        self._watch_s = watch_s
        self._clients: dict[socket.socket, threading.Thread] = {}
        self._lock = threading.Lock()
        self._closing = threading.Event()
        self._log = structlog.get_logger().bind(socket=str(path))

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def start(self) -> None:
        """Open the socket and answer in the background. Raises Refused, if another daemon is there too."""
        self._listener = socket.socket(socket.AF_UNIX)
        try:
            self._bind()
            self._listener.listen()
        except Refused:
            self._listener.close()
            raise
        except OSError as error:
            self._listener.close()
            raise Refused(
                f"{self.path}: no control socket can be made: {error.strerror or error}",
                "see runtime_dir in the configuration: a short path that this user may write to",
                Code.NOT_PERMITTED if isinstance(error, PermissionError) else Code.CONFIG,
            ) from error
        self._inode = os.stat(self.path).st_ino
        self._acceptor = threading.Thread(target=self._accept, name="control", daemon=True)
        self._acceptor.start()

    def close(self) -> None:
        """Stop answering, drop every client, and take the socket away."""
        self._closing.set()
        with contextlib.suppress(OSError):
            self._listener.shutdown(socket.SHUT_RDWR)
        self._acceptor.join()
        self._listener.close()
        with contextlib.suppress(OSError):
            if os.stat(self.path).st_ino == self._inode:  # another daemon's may be there by now
                os.unlink(self.path)
        with self._lock:
            clients = dict(self._clients)
        for connection, thread in clients.items():
            with contextlib.suppress(OSError):
                connection.shutdown(socket.SHUT_RDWR)
            if thread is not threading.current_thread():
                thread.join(timeout=_SEND_S)

    def _bind(self) -> None:
        self.path.parent.mkdir(parents=True, exist_ok=True)
        if self.path.exists():
            self._clear_away()
        os.fchmod(self._listener.fileno(), 0o660)  # before bind: nobody else gets in even at first
        self._listener.bind(str(self.path))
        os.chmod(self.path, 0o660)  # what the umask took
        with contextlib.suppress(KeyError, PermissionError):
            os.chown(self.path, -1, grp.getgrnam(GROUP).gr_gid)

    def _clear_away(self) -> None:
        """Remove what a daemon that was killed left. Raises Refused if it is not that."""
        if not stat.S_ISSOCK(os.stat(self.path).st_mode):
            raise Refused(f"{self.path}: is there already and is no socket", "move it away", Code.CONFIG)
        with socket.socket(socket.AF_UNIX) as probe:
            try:
                probe.connect(str(self.path))
            except ConnectionRefusedError:
                os.unlink(self.path)
            else:
                raise Refused(
                    f"{self.path}: another polecald is running",
                    "stop it first (`systemctl stop polecal`), or give this one another runtime_dir",
                    Code.BUSY,
                )

    def _accept(self) -> None:
        while not self._closing.is_set():
            try:
                connection, _ = self._listener.accept()
            except OSError:
                if not self._closing.wait(0.1):  # out of descriptors, say: try again
                    continue
                break
            connection.setsockopt(socket.SOL_SOCKET, socket.SO_SNDTIMEO, struct.pack("ll", int(_SEND_S), 0))
            thread = threading.Thread(target=self._serve, args=(connection,), name="client", daemon=True)
            with self._lock:
                full = len(self._clients) >= _MAX_CLIENTS
                if not full:
                    self._clients[connection] = thread
            if full:
                with contextlib.suppress(OSError), connection:
                    _Lines(connection, MAX_LINE_BYTES).write(
                        as_message(Refused(f"{_MAX_CLIENTS} clients are connected already", code=Code.BUSY))
                    )
            else:
                thread.start()

    def _serve(self, connection: socket.socket) -> None:
        log = self._log
        lines = _Lines(connection, MAX_LINE_BYTES)
        seen: set[str] = set()
        try:
            peer = Peer.of(connection)
            _peer_uid.set(peer.uid)  # this thread serves nobody else
            log = log.bind(pid=peer.pid, uid=peer.uid)
            log.debug("client connected")
            lines.write({"class": "VERSION", "release": __version__, "proto": list(PROTO)})
            while not self._closing.is_set():
                try:
                    line = lines.read()
                    if line is None:
                        break
                    request = _parse(line)
                except Refused as error:
                    lines.write(as_message(error))
                    continue
                name = request["class"]
                again = name in LOOKING and name in seen  # who polls is in the log once
                (log.debug if again else log.info)("asked", **_told(request))
                seen.add(name)
                if name not in LOOKING and not peer.may_change:
                    refused = _not_permitted(peer, name)
                    log.warning("refused", request=name, problem=str(refused), code=refused.code)
                    lines.write(as_message(refused))
                elif name == "WATCH":
                    self._watch(lines, log)
                else:
                    lines.write(self._answer(request, log))
        except OSError as error:
            log.debug("client lost", problem=str(error))
        finally:
            with self._lock:
                del self._clients[connection]
            connection.close()

    def _watch(self, lines: _Lines, log: structlog.typing.FilteringBoundLogger) -> None:
        """Send STATUS after STATUS, until the client says something else or leaves."""
        while not self._closing.is_set():
            lines.write(self._answer({"class": "STATUS"}, log))
            if lines.waiting(self._watch_s):
                return

    def _answer(self, request: Message, log: structlog.typing.FilteringBoundLogger) -> Message:
        try:
            reply = self._handler.handle(request)
            encode(reply)
        except PolecalError as error:
            log.info("refused", request=request["class"], problem=str(error), code=code_of(error))
            return as_message(error)
        except Exception as error:
            log.exception("a request failed", request=request)
            hint = "its log has more (`journalctl -u polecal`): please report it"
            return as_message(Refused(f"polecald failed at it: {error!r}", hint))
        return reply


def _told(request: Message) -> dict[str, str]:
    """Give what the log shall have of a request: not more than fits on a line, whatever the client sent."""
    more = {
        key: value
        for key, value in request.items()
        if key != "class" and value is not None and value is not False
    }
    return {"request": request["class"]} | ({"with": f"{more}"[:_LOGGED]} if more else {})


def _not_permitted(peer: Peer, name: str) -> Refused:
    return Refused(
        f"uid {peer.uid} may look, but {name} is only for root and members of group {GROUP}",
        f"add the user to the group (`sudo usermod -aG {GROUP} $USER`), then log in again",
        Code.NOT_PERMITTED,
    )


def _parse(line: bytes) -> Message:
    """Read a request. Raises Refused."""
    try:
        request = json.loads(line, parse_constant=_no_constant)
    except (ValueError, RecursionError) as error:
        raise Refused(f"not JSON: {error}", "send one JSON object a line", Code.USAGE) from error
    if not isinstance(request, dict) or not isinstance(request.get("class"), str):
        raise Refused('not an object with a "class"', 'send for example {"class":"STATUS"}', Code.USAGE)
    if request["class"] not in REQUESTS:
        raise Refused(f"no such class: {request['class']}", f"one of {' '.join(REQUESTS)}", Code.USAGE)
    return request


def _no_constant(name: str) -> None:
    raise ValueError(f"{name} is no JSON number")


class Client:
    """A connection to the daemon; ``timeout_s`` is how long it may take to answer, None for ever."""

    def __init__(self, path: Path, timeout_s: float | None = 5.0) -> None:
        """Connect. Raises NoDaemon, and Refused where this user may not."""
        self.path = path
        self._socket = socket.socket(socket.AF_UNIX)
        self._socket.settimeout(timeout_s)
        self._lines = _Lines(self._socket, 16 * MAX_LINE_BYTES)
        try:
            self._connect()
        except BaseException:
            self._socket.close()
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Leave."""
        self._socket.close()

    def patience(self, timeout_s: float | None) -> None:
        """Set how long an answer may take from now on."""
        self._socket.settimeout(timeout_s)

    def request(self, request: Message) -> Message:
        """Ask, and return the answer. Raises Refused for an ERROR, NoDaemon if the daemon goes away."""
        try:
            self._socket.sendall(encode(request))
        except OSError as error:
            raise self._gone(error) from error
        return self._reply()

    def watch(self) -> Iterator[Message]:
        """Yield a STATUS a second, for as long as it is iterated. Raises as `request` does."""
        yield self.request({"class": "WATCH"})
        while True:
            yield self._reply()

    def _connect(self) -> None:
        try:
            self._socket.connect(str(self.path))
        except PermissionError as error:
            raise Refused(
                f"{self.path}: this user may not talk to the daemon",
                f"add the user to group {GROUP} (`sudo usermod -aG {GROUP} $USER`), then log in again",
                Code.NOT_PERMITTED,
            ) from error
        except OSError as error:
            raise NoDaemon(f"no daemon on {self.path}: {error.strerror or error}") from error
        banner = self._reply()
        proto = banner.get("proto")
        if banner.get("class") != "VERSION" or not isinstance(proto, list) or proto[:1] != [PROTO[0]]:
            raise Refused(
                f"{self.path}: the daemon speaks protocol {proto}, this command {list(PROTO)}",
                "install the same version of both, and restart the daemon",
            )

    def _reply(self) -> Message:
        try:
            line = self._lines.read()
        except OSError as error:
            raise self._gone(error) from error
        if line is None:
            raise NoDaemon(f"the daemon on {self.path} went away")
        try:
            reply = json.loads(line)
        except ValueError as error:
            raise Refused(f"{self.path}: not a polecald's reply: {error}") from error
        if not isinstance(reply, dict):
            raise Refused(f"{self.path}: not a polecald's reply: {reply!r}")
        if reply.get("class") == "ERROR":
            raise Refused(
                str(reply.get("message")), str(reply.get("hint", "")), int(reply.get("code", Code.DEGRADED))
            )
        return reply

    def _gone(self, error: OSError) -> Refused:
        if isinstance(error, TimeoutError):
            return Refused(
                f"the daemon on {self.path} does not answer within {self._socket.gettimeout():g} s",
                "see its log (`journalctl -u polecal`)",
            )
        return NoDaemon(f"the daemon on {self.path} went away: {error.strerror or error}")
