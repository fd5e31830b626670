"""A SPAN receiver's port: what the host sends to replies and to a list of wanted logs (sheet, 1.6 and 5)."""

from __future__ import annotations

import re
import struct
from abc import abstractmethod
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import NamedTuple

from polecal.drivers.emulated import span_frames as span
from polecal.drivers.emulated.line import EmulatedDevice
from polecal.drivers.emulated.span_frames import PORT_IDS, VIRTUAL_PORTS, Stamp
from polecal.drivers.emulated.span_generations import OEM7, Generation
from polecal.drivers.emulated.span_logs import NAME_OF_ID, SUFFIXES, Form, named

FACTORY_BAUD = 9600
_NO_RATE_BAUD = 12_000_000  # of a port without a rate: USB
_COM_BAUDS = frozenset((300, 600, 900, 1200, 2400, 4800, 9600, 19200, 38400, 57600, 115200, 230400))
_BAUDS = {
    "COM": _COM_BAUDS,
    "SERIALCONFIG": _COM_BAUDS - {300, 600, 900, 1200, 2400, 4800} | {460800, 921600},
}

Result = tuple[int, str]
"""A response's number and text (section 1.6)."""
OK: Result = (1, "OK")
NO_RESOURCES: Result = (3, "Not Enough Resources")
INVALID_MESSAGE: Result = (7, "Invalid Message. Field = 2")
INVALID_RATE: Result = (21, "Invalid rate requested")
_INVALID_MESSAGE_ID: Result = (6, "Invalid Message ID")
_INVALID_TRIGGER: Result = (7, "Invalid Message. Field = 3")
_INVALID_CHECKSUM: Result = (8, "Invalid Checksum")
_MISSING_FIELD: Result = (9, "Missing field")
_OUT_OF_RANGE: Result = (11, "Parameter out of range")
_INVALID_PORT: Result = (25, "Invalid COM port")
_INVALID_BAUD: Result = (35, "Invalid baud rate")

_LONGEST_LINE = 1024
_LONGEST_FRAME = 512  # that a host may send: no command is longer
_PORT = re.compile(rf"({'|'.join(PORT_IDS)}|ALL_PORTS)(_ALL|_\d+)?")
_ALL_IDS = {1: "COM1_ALL", 2: "COM2_ALL", 3: "COM3_ALL", 6: "THISPORT_ALL", 8: "ALL_PORTS"}
_TAKEN_AS_SAID = re.compile(
    "ECHO|STATUSCONFIG|SETIMU(TYPE|ORIENTATION|TOANTOFFSET)|CONNECTIMU|SETINS(OFFSET|TRANSLATION|"
    "ROTATION|PROFILE)|APPLYVEHICLEBODYROTATION|INSCOMMAND|ALIGNMENTMODE|SETALIGNMENTVEL|SETINITAZIMUTH|"
    "INSTHRESHOLDS|(PPS|MARK)CONTROL"
)
"""Commands without an effect here."""
_LOG, _UNLOG, _UNLOGALL, _SERIALCONFIG, _INTERFACEMODE = 1, 36, 38, 1246, 3  # Section 5
_TRIGGERS = ("ONNEW", "ONCHANGED", "ONTIME", "ONNEXT", "ONCE", "ONMARK", "ONALL")
_MODES = {1: "NOVATEL", 15: "NOVATELBINARY"}
_BREAK_S = 0.25  # the shortest that counts, and the silence after two
_BREAKS_APART_S = 2.0  # at most
_RESTART_NS = 100_000_000  # after its command, so that the reply is through


class Key(NamedTuple):
    """What is wanted: a log, how it is written, and for which of the port's virtual ports."""

    name: str
    form: Form
    virtual: int = 0


@dataclass(slots=True)
class Wanted:
    """When a log is wanted."""

    trigger: str
    period_ms: int = 0
    """0: whenever something happens."""
    offset_ms: int = 0
    due_ms: int = 0
    held: bool = False


STATUS_EVENTS = Key("RXSTATUSEVENT", Form.ASCII)
"""Wanted ONNEW and held by the factory's configuration."""


class SpanPort(EmulatedDevice):
    """The part of a receiver that talks: one of its ports.

    ``port`` is its name; one that is no COM has no rate. Commands take effect here only where they name
    this port, and are accepted for any other.
    """

    def __init__(
        self,
        *,
        t0_ns: int,
        seed: int,
        baud: int,
        port: str = "COM1",
        generation: Generation = OEM7,
        boot_s: float = 1.0,
        reply_s: float = 0.006,
    ) -> None:
        self._serial = port.startswith("COM")
        super().__init__(t0_ns=t0_ns, seed=seed, baud=baud if self._serial else _NO_RATE_BAUD)
        self.port = port
        self._generation = generation
        self._boot_ns = round(boot_s * 1e9)
        self._reply_ns = round(reply_s * 1e9)
        self._heard = bytearray()
        self._heard_ns = self._break_ns = -(10**18)
        self._replies = self._breaks = True
        self._hears = frozenset(Form)
        self._logs: dict[Key, Wanted] = self._factory_logs()
        self._saved = (self._factory_logs(), self.baud)
        self._up_ns = t0_ns
        """Since when the receiver has been running."""

    # --- what a test or another client may do

    def force_logs(self, t_ns: int, logs: Iterable[tuple[str, float]], baud: int = 230400) -> None:
        """Want logs as (name with suffix, period in s) at a rate, as though the host had asked.

        Raises ValueError for a log that would be refused.
        """
        self._advance(t_ns)
        if self._serial:
            self._line.baud = baud
        for message, period_s in logs:
            number, text = self._log(t_ns, [message, "ONTIME", str(period_s)], range(1))
            if number != OK[0]:
                raise ValueError(f"{message}: {text}")

    def hear_break(self, t_ns: int, seconds: float = 0.3) -> None:
        """Hear a break on the line: a second one soon after, and silence, reset the port (section 5)."""
        self._advance(t_ns)
        if not (self._serial and self._breaks and seconds >= _BREAK_S):
            return
        if t_ns - self._break_ns <= _BREAKS_APART_S * 1e9:
            self._at(t_ns + round((seconds + _BREAK_S) * 1e9), lambda now_ns: self._break_over(t_ns, now_ns))
        self._break_ns = t_ns

    def restart(self, t_ns: int) -> None:
        """Lose power and come up again with what was saved: a prompt, and all else from the beginning."""
        self._advance(t_ns)
        self._restart(t_ns)

    def _restart(self, t_ns: int) -> None:
        logs, baud = self._saved
        self._line.cut(t_ns)
        self._to_defaults()
        self._logs = {key: replace(wanted) for key, wanted in logs.items()}
        self._line.baud = baud
        self._up_ns = t_ns + self._boot_ns
        self._booted()

    def _break_over(self, break_ns: int, now_ns: int) -> None:
        if self._heard_ns < break_ns:
            self._line.cut(now_ns)
            self._to_defaults()
            self._logs.clear()
            self._line.baud = FACTORY_BAUD

    def _to_defaults(self) -> None:
        self._heard.clear()
        self._replies = self._breaks = True
        self._hears = frozenset(Form)

    def _factory_logs(self) -> dict[Key, Wanted]:
        return {STATUS_EVENTS: Wanted("ONNEW", held=True)}

    # --- hearing

    def receive(self, t_ns: int, data: bytes, host_baud: int) -> None:
        """Take bytes that the host began to send at ``t_ns`` at its own rate, if the port has one."""
        super().receive(t_ns, data, host_baud if self._serial else self.baud)

    def transmit(self, t_ns: int, host_baud: int) -> bytes:
        """Return what has left the device by ``t_ns`` since the last call, as the host hears it."""
        return super().transmit(t_ns, host_baud if self._serial else self.baud)

    def _hear(self, t_ns: int, byte: int) -> None:
        self._heard_ns = t_ns
        if t_ns < self._up_ns:
            return
        self._heard.append(byte)
        while self._heard:
            size = span.frame_size(self._heard)
            if size is not None and size > _LONGEST_FRAME:
                del self._heard[0]
            elif size == 0:
                ends = [end for end in (self._heard.find(b"\r"), self._heard.find(b"\n")) if end >= 0]
                if not ends:
                    del self._heard[:-_LONGEST_LINE]
                    return
                line = bytes(self._heard[: min(ends)])
                del self._heard[: min(ends) + 1]
                if line.strip() and Form.ASCII in self._hears:
                    self._line_command(t_ns, line.decode("ascii", "replace"))
            elif size is None or size > len(self._heard):
                return
            else:
                found = span.parse_frame(bytes(self._heard[:size]))
                del self._heard[: size if found else 1]
                if found and Form.BINARY in self._hears:
                    self._binary_command(t_ns, *found)

    # Replies have the command's form, not the logs' (section 1.6)

    def _line_command(self, t_ns: int, line: str) -> None:
        if line.startswith("#"):
            words = span.parse_line(line)
            name = words[0].removesuffix("A") if words else line[1:].partition(",")[0].removesuffix("A")
            upper = [name.upper(), *(word.strip('"').upper() for word in words[1:])] if words else []
            (_, text), then_baud = self._command(t_ns, upper) if words else (_INVALID_CHECKSUM, None)
            reply = span.ascii_line(name.upper() + "R", [text], self._stamp(t_ns))
        else:
            (number, text), then_baud = self._command(t_ns, line.replace(",", " ").upper().split())
            said = "<OK" if number == OK[0] else f"<ERROR:{text}"
            reply = f"\r\n{said}\r\n{self._prompt}".encode()
        self._reply(t_ns, reply, then_baud)

    def _binary_command(self, t_ns: int, message_id: int, body: bytes, stamp: Stamp) -> None:
        (number, text), then_baud = self._command(t_ns, _words(message_id, body))
        now = replace(self._stamp(t_ns), source=stamp.source)
        reply = struct.pack("<I", number) + text.encode()
        frame = span.long_frame(message_id, reply, now, definition=0xFFFF, response=True)
        self._reply(t_ns, frame, then_baud)

    def _reply(self, t_ns: int, reply: bytes, then_baud: int | None) -> None:
        self._line.send(t_ns + self._reply_ns, reply if self._replies else b"", then_baud)

    @property
    def _prompt(self) -> str:
        return f"[{self.port}]"

    # --- commands

    def _command(self, t_ns: int, words: list[str]) -> tuple[Result, int | None]:
        """Return a command's result and the rate to change to after the reply, if any."""
        name, rest = (words[0], words[1:]) if words else ("", [])
        if _TAKEN_AS_SAID.fullmatch(name):
            return OK, None
        here, rest = self._addressed(name, rest)
        match name:
            case "LOG":
                return self._log(t_ns, rest, here), None
            case "UNLOG":
                return self._unlog(rest, here), None
            case "UNLOGALL":
                held = rest[:1] in (["TRUE"], ["1"])
                self._logs = {k: w for k, w in self._logs.items() if k.virtual not in here or w.held > held}
                return OK, None
            case "INTERFACEMODE":
                if 0 in here and len(rest) > 1:
                    self._hears = {
                        "NOVATEL": frozenset(Form),
                        "NOVATELBINARY": frozenset((Form.BINARY,)),
                    }.get(rest[0], frozenset())
                    self._replies = rest[2:] != ["OFF"]
                return OK, None
            case "SAVECONFIG":
                self._saved = ({key: replace(wanted) for key, wanted in self._logs.items()}, self.baud)
                return OK, None
            case "FRESET":
                self._saved = (self._factory_logs(), FACTORY_BAUD if self._serial else self.baud)
                self._at(t_ns + _RESTART_NS, self._restart)
                return OK, None
            case "RESET":
                self._at(t_ns + _RESTART_NS, self._restart)
                return OK, None
            case "VEHICLEBODYROTATION":
                return self._rotation(rest), None
            case "COM" | "SERIALCONFIG" if name in self._generation.rate_commands:
                return self._new_rate(name, rest, here)
        return _INVALID_MESSAGE_ID, None

    def _addressed(self, name: str, words: list[str]) -> tuple[range, list[str]]:
        """Return for which virtual ports of this port a command is, and the words after the port's name."""
        found = _PORT.fullmatch(words[0]) if words else None
        if found is None:
            return range(VIRTUAL_PORTS if name == "UNLOGALL" else 1), words
        port, part = found.groups()
        if port not in (self.port, "THISPORT", "ALL_PORTS"):
            return range(0), words[1:]
        if part == "_ALL" or port == "ALL_PORTS":
            return range(VIRTUAL_PORTS), words[1:]
        virtual = int(part[1:]) if part else 0
        return range(virtual, virtual + (virtual < VIRTUAL_PORTS)), words[1:]

    def _log(self, t_ns: int, words: list[str], here: range) -> Result:
        """Take LOG's words after the port: message, trigger, period, offset, hold."""
        if not words:
            return _MISSING_FIELD
        found = named(words[0])
        if found is None or not self._has(*found):
            return INVALID_MESSAGE
        trigger = words[1] if len(words) > 1 else "ONCE"
        if trigger not in _TRIGGERS:
            return _INVALID_TRIGGER
        try:
            period_s, offset_s = (float(word) for word in (*words[2:4], "0", "0")[:2])
            result, wanted = self._accept(found[0], trigger, round(period_s * 1000), round(offset_s * 1000))
        except (ValueError, OverflowError):  # not a number, or not a finite one
            return INVALID_RATE
        for virtual in here[:1]:
            key = Key(*found, virtual)
            if wanted is not None:
                if key not in self._logs and len(self._logs) >= self._generation.most_logs:
                    return NO_RESOURCES
                wanted.held = words[4:5] in (["HOLD"], ["1"])
                self._logs[key] = wanted
            if result == OK:
                self._wanted(t_ns, key, wanted)
        return result

    def _unlog(self, words: list[str], here: range) -> Result:
        found = named(words[0]) if words else None
        if found is None:
            return INVALID_MESSAGE if words else _MISSING_FIELD
        for virtual in here:
            self._logs.pop(Key(*found, virtual), None)
        return OK

    def _new_rate(self, name: str, words: list[str], here: range) -> tuple[Result, int | None]:
        """Take the words after the port: rate, parity, data and stop bits, handshake, (echo,) break."""
        if not words:
            return _MISSING_FIELD, None
        if not words[0].isdigit() or int(words[0]) not in _BAUDS[name]:
            return _INVALID_BAUD, None
        if words[1:4] != ["N", "8", "1"][: len(words) - 1]:  # another frame cannot be emulated
            return _OUT_OF_RANGE, None
        if 0 not in here:
            return OK, None
        if not self._serial:
            return _INVALID_PORT, None
        self._breaks = (words + ["ON"] * 7)[6 if name == "COM" else 5] != "OFF"
        return OK, int(words[0])

    # --- what the receiver behind the port does

    @abstractmethod
    def _has(self, name: str, form: Form) -> bool:
        """Whether there is such a log."""

    @abstractmethod
    def _accept(
        self, name: str, trigger: str, period_ms: int, offset_ms: int
    ) -> tuple[Result, Wanted | None]:
        """Judge a LOG command; return also what to keep of it, None if it is done with at once."""

    @abstractmethod
    def _wanted(self, t_ns: int, key: Key, wanted: Wanted | None) -> None:
        """Begin to send a log, or send it once if it has not been kept."""

    def _booted(self) -> None:
        """Begin from the beginning: the receiver will be up at ``_up_ns``."""
        self._line.send(self._up_ns, self._prompt.encode())

    def _rotation(self, words: list[str]) -> Result:
        """Take VEHICLEBODYROTATION's words."""
        return OK

    @abstractmethod
    def _stamp(self, t_ns: int) -> Stamp:
        """Return the header's content at a moment."""


def _words(message_id: int, body: bytes) -> list[str]:
    """Return a binary command as the words of its ASCII form (section 5); none if it is not known."""
    if message_id == _LOG and len(body) >= 32:
        port, log, kind, _, trigger, period_s, offset_s, hold = struct.unpack_from("<IHBBIddI", body)
        words = [_TRIGGERS[trigger] if trigger < len(_TRIGGERS) else "?", str(period_s), str(offset_s)]
        return ["LOG", _port_word(port), _log_word(log, kind), *words, str(hold)]
    if message_id == _UNLOG and len(body) >= 8:
        port, log, kind = struct.unpack_from("<IHB", body)
        return ["UNLOG", _port_word(port), _log_word(log, kind)]
    if message_id == _UNLOGALL and len(body) >= 4:
        port, held = struct.unpack_from("<II", body + bytes(4))
        return ["UNLOGALL", _port_word(port), str(held)]
    if message_id == _SERIALCONFIG and len(body) >= 28:
        port, baud, parity, data, stop, _, breaks = struct.unpack_from("<7I", body)
        words = [str(baud), "NEO"[parity % 3], str(data), str(stop), "N", "ON" if breaks else "OFF"]
        return ["SERIALCONFIG", f"COM{port}", *words]
    if message_id == _INTERFACEMODE and len(body) >= 16:
        port, receive, send, responses = struct.unpack_from("<4I", body)
        said = [_MODES.get(receive, "NONE"), _MODES.get(send, "NONE"), "ON" if responses else "OFF"]
        return ["INTERFACEMODE", f"COM{port}" if port else "THISPORT", *said]
    return []


def _log_word(message_id: int, message_type: int) -> str:
    suffixes = {form.value: suffix for suffix, form in SUFFIXES.items()}
    return NAME_OF_ID.get(message_id, "UNKNOWN") + suffixes.get(message_type >> 5 & 3, "?")


def _port_word(port: int) -> str:
    """Return a port's name of its id (section 3.6)."""
    if port in _ALL_IDS:
        return _ALL_IDS[port]
    for name, first in PORT_IDS.items():
        if first <= port < first + VIRTUAL_PORTS:
            return f"{name}_{port - first}"
    return "FILE"
