"""A port to the receiver on it, as it is found: nothing is set, and the logs that it sends go on.

Each log is asked for ONCE, as text and in binary in one go, so that it does not matter which of them the
port takes; what was to come periodically is not touched.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field

from polecal.drivers.errors import DeviceError, DeviceLost
from polecal.drivers.novatel_span.commands import log
from polecal.drivers.novatel_span.enums import FINE_TIME, MessageId, TimeStatus, Trigger
from polecal.drivers.novatel_span.framer import Frame, Framer, Kind
from polecal.drivers.novatel_span.logs import Response, Version, parse
from polecal.drivers.novatel_span.requests import FIXES, POSES, QUALITIES, generation, worth_asking
from polecal.drivers.port import Port

_ANSWER_S = 0.7  # as in `device`
_PATIENCE_S = 2.5  # behind what a busy line has still to send
_SETTLE_S = 0.3
_HEARD_BYTES = 512


@dataclass(frozen=True, slots=True)
class Probe:
    """What was found.

    ``baud``: the receiver's rate, None where none answers. ``said``: the logs that it sent, by id, and
    ``came_ns`` when (CLOCK_MONOTONIC). ``refused``: the logs that it would not send, and why. ``checked``:
    the rate at which whole logs came, though it answered nothing. ``heard``: by rate, the last bytes that
    came instead. ``cannot``: the rates that the adapter refused. ``sent``: what was sent, to tell an echo.
    """

    baud: int | None = None
    version: Version | None = None
    said: dict[int, object] = field(default_factory=dict)
    came_ns: dict[int, int] = field(default_factory=dict)
    time_status: TimeStatus | int | None = None
    refused: dict[str, str] = field(default_factory=dict)
    checked: int | None = None
    heard: dict[int, bytes] = field(default_factory=dict)
    cannot: tuple[int, ...] = ()
    sent: bytes = b"\r\n" + log(MessageId.VERSION, Trigger.ONCE).ascii


def probe(port: Port, rates: Iterable[int], rounds: int = 2) -> Probe:
    """Ask for VERSION at each rate, then for what else tells the receiver's state.

    Raises Stopped, DeviceLost.
    """
    heard: dict[int, bytes] = {}
    cannot: set[int] = set()
    for _ in range(rounds):
        for rate in rates:
            if rate in cannot:
                continue
            try:
                port.set_baud(rate)
            except DeviceLost:
                raise
            except DeviceError:
                cannot.add(rate)
                continue
            ear = _Ear(port)
            if ear.knock():
                return _examine(ear, Probe(rate, ear.version, heard=heard, cannot=tuple(sorted(cannot))))
            heard[rate] = max(heard.get(rate, b""), ear.heard, key=len)
            if ear.checked:
                return Probe(checked=rate, heard=heard, cannot=tuple(sorted(cannot)))
    return Probe(heard=heard, cannot=tuple(sorted(cannot)))


def _examine(ear: _Ear, found: Probe) -> Probe:
    """Ask the receiver that was found for one log of each kind."""
    ear.listen(_SETTLE_S, lambda: False)  # the second answer to what was asked in two forms
    of = generation(found.version)
    refused: dict[str, str] = {}
    inertial = (POSES, QUALITIES)  # which do not come before the time is known (sheet 3.4)
    for choice in ((MessageId.TIME,), (MessageId.INSCONFIG,), FIXES, *inertial):
        if choice in inertial and ear.time_status is not None and ear.time_status not in FINE_TIME:
            continue
        for message in worth_asking(choice, of):
            if message in ear.said or ear.get(message):
                break
            refused[message.name] = ear.refusal or "nothing came"
    return Probe(
        found.baud,
        found.version,
        ear.said,
        ear.came_ns,
        ear.time_status,
        refused,
        heard=found.heard,
        cannot=found.cannot,
    )


class _Ear:
    """What is heard at one rate."""

    def __init__(self, port: Port) -> None:
        self.port = port
        self.checked = False
        self.heard = b""
        self.version: Version | None = None
        self.said: dict[int, object] = {}
        self.came_ns: dict[int, int] = {}
        self.time_status: TimeStatus | int | None = None
        self.refusal = ""
        self._replies: set[Kind] = set()
        self._framer = Framer()

    def ask(self, message: MessageId) -> None:
        """Ask in the form that got a reply; in both until one has."""
        command = log(message, Trigger.ONCE)
        self.refusal = ""
        if Kind.REPLY in self._replies or not self._replies:
            self.port.write(b"\r\n" + command.ascii)
        if Kind.REPLY not in self._replies and command.binary:
            self.port.write(command.binary)

    def knock(self) -> bool:
        """Ask for VERSION, again where logs come but it does not; say whether it came."""
        for patience_s in (_ANSWER_S, _PATIENCE_S, _PATIENCE_S):
            self.ask(MessageId.VERSION)
            self.listen(patience_s, lambda: self.version is not None)
            if self.version is not None or not self.checked:
                break
        return self.version is not None

    def get(self, message: MessageId) -> bool:
        """Ask for a log, and say whether it came."""
        self.ask(message)
        self.listen(_PATIENCE_S, lambda: message in self.said or bool(self.refusal))
        return message in self.said

    def listen(self, timeout_s: float, enough: Callable[[], bool]) -> None:
        """Read until what was heard is ``enough``, or for ``timeout_s``."""
        deadline_s = time.monotonic() + timeout_s
        while not enough() and (left_s := deadline_s - time.monotonic()) > 0:
            chunk = self.port.read(left_s)
            if chunk is not None:
                self.heard = (self.heard + chunk.data)[-_HEARD_BYTES:]
                for frame in self._framer.feed(chunk.data, chunk.t_ns):
                    self._note(frame)

    def _note(self, frame: Frame) -> None:
        if frame.kind is Kind.REPLY:
            self._replies.add(Kind.REPLY)
            self.refusal = "" if frame.text == "OK" else frame.text
        elif frame.kind.checked and (frame.is_response or frame.message_id != MessageId.LOG):  # no echo
            self.checked = True
            said = parse(frame)
            if isinstance(said, Response):
                self._replies.add(Kind.BINARY)
                self.refusal = "" if said.ok else said.text
            elif frame.message_id is not None and said is not None:
                self.said[frame.message_id] = said
                self.came_ns[frame.message_id] = frame.t_first_ns
                if frame.time_status is not None and frame.time_status != TimeStatus.SATTIME:
                    self.time_status = frame.time_status
                if isinstance(said, Version):
                    self.version = said
