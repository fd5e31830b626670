"""A SPAN receiver's command line: what the host sends to replies and to a list of wanted logs."""

from __future__ import annotations

import re
import struct
from abc import abstractmethod
from collections.abc import Iterable

from polecal.drivers.emulated import span_frames as span
from polecal.drivers.emulated.line import EmulatedDevice
from polecal.drivers.emulated.span_frames import LOGS, Stamp

FACTORY_BAUD = 9600
BAUDS = frozenset(
    (300, 600, 900, 1200, 2400, 4800, 9600, 19200, 38400, 57600, 115200, 230400, 460800, 921600)
)
INVALID_MESSAGE = (7, "Invalid Message. Field = 2")
INVALID_RATE = (21, "Invalid rate requested")
_UNKNOWN_COMMAND = (6, "Invalid Message ID")
_OK = (1, "OK")
_INVALID_BAUD = (35, "Invalid baud rate")
_MISSING_FIELD = (9, "Missing field")

_LONGEST_LINE = 1024
_LONGEST_FRAME = 512  # that a host may send: no command is longer
_PORT = re.compile(r"(COM\d|USB\d|I?NCOM\d|ICOM\d|AUX|ETH1|FILE|SPECIAL|THISPORT|ALL_PORTS)(_ALL)?")
_OURS = ("COM1", "COM1_ALL", "THISPORT", "THISPORT_ALL", "ALL_PORTS")
_TAKEN_AS_SAID = re.compile(
    "SAVECONFIG|ECHO|STATUSCONFIG|SETIMU(TYPE|ORIENTATION|TOANTOFFSET)|CONNECTIMU|SETINS(OFFSET|TRANSLATION|"
    "ROTATION|PROFILE)|(APPLY)?VEHICLEBODYROTATION|INSCOMMAND|ALIGNMENTMODE|SETALIGNMENTVEL|SETINITAZIMUTH|"
    "INSTHRESHOLDS|(PPS|MARK)CONTROL"
)
"""Commands without an effect here."""
_LOG, _UNLOG, _UNLOGALL, _SERIALCONFIG, _INTERFACEMODE = 1, 36, 38, 1246, 3  # Section 5
_TRIGGERS = ("ONNEW", "ONCHANGED", "ONTIME", "ONNEXT", "ONCE", "ONMARK", "ONALL")
_NAME_OF_ID = {log.message_id: name for name, log in LOGS.items()}
_NOVATEL, _NOVATELBINARY = 1, 15  # interface modes
_THIS_PORTS = (0x20, 0xC0, 1, 6, 8)  # COM1, THISPORT, and their and all ports' _ALL

Result = tuple[int, str]
"""A response's number and text."""


class SpanPort(EmulatedDevice):
    """The part of a receiver that talks: its port COM1."""

    def __init__(self, *, t0_ns: int, seed: int, baud: int, reply_s: float = 0.006) -> None:
        super().__init__(t0_ns=t0_ns, seed=seed, baud=baud)
        self._reply_ns = round(reply_s * 1e9)
        self._heard = bytearray()
        self._replies = True
        self._takes_ascii = True

    def force_logs(self, t_ns: int, logs: Iterable[tuple[str, float]], baud: int = 230400) -> None:
        """Want logs as (name with suffix, period in s) at a rate, as though the host had asked.

        Raises ValueError for a log that would be refused.
        """
        self._advance(t_ns)
        self._line.baud = baud
        for message, period_s in logs:
            number, text = self._wanted(t_ns, message, "ONTIME", period_s, 0.0)
            if number != _OK[0]:
                raise ValueError(f"{message}: {text}")

    # --- hearing

    def _hear(self, t_ns: int, byte: int) -> None:
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
                if line.strip() and self._takes_ascii:
                    self._line_command(t_ns, line.decode("ascii", "replace"))
            elif size is None or size > len(self._heard):
                return
            else:
                found = span.parse_frame(bytes(self._heard[:size]))
                del self._heard[: size if found else 1]
                if found:
                    self._binary_command(t_ns, *found)

    def _line_command(self, t_ns: int, line: str) -> None:
        words = line.replace(",", " ").upper().split()
        result, then_baud = self._command(t_ns, words)
        number, text = result
        if self._replies:
            reply = "<OK" if number == _OK[0] else f"<ERROR:{text}"
            self._line.send(t_ns + self._reply_ns, f"\r\n{reply}\r\n[COM1]".encode(), then_baud)
        elif then_baud:
            self._line.send(t_ns + self._reply_ns, b"", then_baud)

    def _binary_command(self, t_ns: int, message_id: int, body: bytes, stamp: Stamp) -> None:
        """Do what a binary command says, and answer in kind (section 1.6)."""
        result, then_baud = self._command(t_ns, _words(message_id, body))
        number, text = result
        if self._replies:
            now = self._stamp(t_ns)
            answer = Stamp(now.week, now.ms, now.status, span.COM1, stamp.source)
            reply = struct.pack("<I", number) + text.encode()
            frame = span.long_frame(message_id, reply, answer, definition=0xFFFF, response=True)
            self._line.send(t_ns + self._reply_ns, frame, then_baud)
        elif then_baud:
            self._line.send(t_ns + self._reply_ns, b"", then_baud)

    # --- commands

    def _command(self, t_ns: int, words: list[str]) -> tuple[Result, int | None]:
        """Return a command's result and the rate to change to after the reply, if any."""
        name, rest = (words[0], words[1:]) if words else ("", [])
        here = True
        if name in ("LOG", "UNLOG", "UNLOGALL", "SERIALCONFIG", "COM", "INTERFACEMODE", "FRESET"):
            if rest and _PORT.fullmatch(rest[0]):
                here = rest[0] in _OURS
                rest = rest[1:]
        elif _TAKEN_AS_SAID.fullmatch(name):
            return _OK, None
        else:
            return _UNKNOWN_COMMAND, None
        if name == "LOG":
            return self._log(t_ns, rest, here), None
        if name == "UNLOG":
            return (self._unlog(rest[0]) if here else _OK) if rest else _MISSING_FIELD, None
        if name == "UNLOGALL":
            if here:
                self._unlog_all()
            return _OK, None
        if name == "INTERFACEMODE":
            if here and len(rest) > 1:
                self._takes_ascii = rest[0] != "NOVATELBINARY"
                self._replies = rest[2:] != ["OFF"]
            return _OK, None
        if name == "FRESET":
            self._unlog_all()
            self._takes_ascii = self._replies = True
            return _OK, FACTORY_BAUD
        if not rest or not rest[0].isdigit() or int(rest[0]) not in BAUDS:
            return _INVALID_BAUD if rest else _MISSING_FIELD, None
        return _OK, int(rest[0]) if here else None

    def _log(self, t_ns: int, words: list[str], here: bool) -> Result:
        """Take LOG's words after the port: message, trigger, period, offset, hold."""
        if not words:
            return _MISSING_FIELD
        trigger = words[1] if len(words) > 1 else "ONCE"
        if trigger not in _TRIGGERS:
            return (7, "Invalid Message. Field = 3")
        try:
            period_s = float(words[2]) if len(words) > 2 else 0.0
            offset_s = float(words[3]) if len(words) > 3 else 0.0
        except ValueError:
            return INVALID_RATE
        return self._wanted(t_ns, words[0], trigger, period_s, offset_s) if here else _OK

    @abstractmethod
    def _wanted(self, t_ns: int, message: str, trigger: str, period_s: float, offset_s: float) -> Result:
        """Take a log into the list, or refuse it."""

    @abstractmethod
    def _unlog(self, message: str) -> Result:
        """Take a log off the list."""

    @abstractmethod
    def _unlog_all(self) -> None:
        """Clear the list."""

    @abstractmethod
    def _stamp(self, t_ns: int) -> Stamp:
        """Return the header's time at a moment."""


def _words(message_id: int, body: bytes) -> list[str]:
    """Return a binary command as the words of its ASCII form (section 5); none if it is not known."""
    if message_id == _LOG and len(body) >= 32:
        port, log, _, _, trigger, period_s, offset_s, _ = struct.unpack_from("<IHBBIddI", body)
        name = _NAME_OF_ID.get(log, "UNKNOWN") + "B"
        words = [name, _TRIGGERS[trigger] if trigger < len(_TRIGGERS) else "?", str(period_s), str(offset_s)]
        return ["LOG", _port_word(port), *words]
    if message_id == _UNLOG and len(body) >= 8:
        port, log = struct.unpack_from("<IH", body)
        return ["UNLOG", _port_word(port), _NAME_OF_ID.get(log, "UNKNOWN") + "B"]
    if message_id == _UNLOGALL and len(body) >= 4:
        return ["UNLOGALL", _port_word(int.from_bytes(body[:4], "little"))]
    if message_id == _SERIALCONFIG and len(body) >= 8:
        port, baud = struct.unpack_from("<II", body)
        return ["SERIALCONFIG", f"COM{port}", str(baud)]
    if message_id == _INTERFACEMODE and len(body) >= 16:
        port, receive, send, responses = struct.unpack_from("<4I", body)
        modes = {_NOVATEL: "NOVATEL", _NOVATELBINARY: "NOVATELBINARY"}
        said = [modes.get(receive, "NONE"), modes.get(send, "NONE"), "ON" if responses else "OFF"]
        return ["INTERFACEMODE", f"COM{port}" if port else "THISPORT", *said]
    return []


def _port_word(port: int) -> str:
    return "THISPORT" if port in _THIS_PORTS else "COM2"
