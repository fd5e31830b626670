r"""A stream of bytes from a NovAtel receiver to whole, checked frames (sheet section 1).

What one serial line mixes::

    AA 44 12 | header, 28 bytes or as byte 3 says | body | CRC-32        BINARY
    AA 44 13 | header, 12 bytes                   | body | CRC-32        SHORT_BINARY
    #NAMEA,port,...;field,field*crc32 CR LF                              ASCII
    %NAMESA,week,seconds;field,field*crc32 CR LF                         SHORT_ASCII
    CR LF <OK CR LF      CR LF <ERROR:text CR LF                         REPLY
    [COM1]                                                               PROMPT, no line end
    <NAME fields CR LF   <     fields CR LF                              ABBREVIATED, one frame a line
    $GPxxx,...*hh CR LF                                                  NMEA

Whether a frame starts at a byte, and where it ends, is a function of the bytes from there on alone, and
never of what follows its last byte; so the way in which reads cut the stream changes nothing. A candidate
that fails drops one byte, and the search goes on at the next: a false start, a flipped bit or a cut-off
frame costs no frame behind it.
"""

from __future__ import annotations

import re
import struct
import zlib
from bisect import bisect_left, bisect_right
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from enum import Enum
from typing import NamedTuple

from polecal.drivers.novatel_span.enums import MessageId, TimeStatus, named

LONG_HEADER_BYTES = 28  # today's; a frame says its own (sheet 1.2)
SHORT_HEADER_BYTES = 12
CRC_BYTES = 4
MAX_FRAME_BYTES = 8192  # a longer one is a corrupt length, not a log (sheet 1.7)

RESPONSE_BIT = 0x80  # of the message type
SOURCE_MASK = 0x1F  # of the message type: which antenna measured


class Kind(Enum):
    """How a frame is written."""

    BINARY = "binary"
    SHORT_BINARY = "short binary"
    PROPRIETARY = "proprietary binary"
    ASCII = "ascii"
    SHORT_ASCII = "short ascii"
    ABBREVIATED = "abbreviated ascii"
    REPLY = "reply"
    PROMPT = "prompt"
    NMEA = "nmea"

    __hash__ = object.__hash__  # of itself, as it is equal to nothing else: it is looked up often

    @property
    def checked(self) -> bool:
        """Whether such a frame carries a checksum."""
        return self not in _UNCHECKED_KINDS


class Fault(Enum):
    """Why bytes are not a frame."""

    NOISE = "no frame starts here"
    CRC = "wrong checksum"
    LENGTH = "impossible length"
    CUT = "cut off"
    END = "the stream ended"


# An enum's members take four times as long to look up in it as here, and each frame does so a dozen times.
_BINARY, _SHORT_BINARY, _ASCII, _NOISE = Kind.BINARY, Kind.SHORT_BINARY, Kind.ASCII, Fault.NOISE


@dataclass(frozen=True, slots=True)
class Skip:
    """Bytes that belong to no frame: where in the stream, and why."""

    offset: int
    data: bytes
    reason: Fault


class Frame(NamedTuple):  # as `NavState` is
    """One whole frame, as it was on the wire.

    offset: of its first byte in the stream. t_first_ns, t_last_ns: stamps (CLOCK_MONOTONIC) of the chunks
    with its first and its last byte. lead_bytes: how many bytes of the first of them came at or after the
    frame's first byte, so that their time on the line can be taken off the stamp.
    """

    offset: int
    data: bytes
    t_first_ns: int
    t_last_ns: int
    lead_bytes: int
    kind: Kind

    @property
    def message_id(self) -> int | None:
        """The log's id; None where the kind has none or the name is not in `MessageId`."""
        if self.kind in BINARY_KINDS:
            return int.from_bytes(self.data[4:6], "little")
        return MessageId.__members__.get(self.name or "")

    @property
    def name(self) -> str | None:
        """The log's name without its format letter ("INSPVAX"); None for replies, prompts and NMEA."""
        if self.kind in BINARY_KINDS:
            number = named(MessageId, int.from_bytes(self.data[4:6], "little"))
            return number.name if isinstance(number, MessageId) else f"MESSAGE_{number}"
        if self.kind in _ASCII_KINDS:
            return self._ascii_name[0]
        if self.kind is Kind.ABBREVIATED:
            return self.text.removeprefix("<").partition(" ")[0] or None
        return None

    @property
    def week(self) -> int | None:
        """GPS week of the header (full, since 1980-01-06), where there is one."""
        if self.kind in _LONG_KINDS:
            return int.from_bytes(self.data[14:16], "little")
        if self.kind is _SHORT_BINARY:
            return int.from_bytes(self.data[6:8], "little")
        if self.kind in _ASCII_KINDS:
            return int(self._ascii_header[-5 if self.kind is _ASCII else 1])
        return None

    @property
    def ms(self) -> int | None:
        """Milliseconds of the GPS week of the header, where there is one."""
        if self.kind in _LONG_KINDS:
            return int.from_bytes(self.data[16:20], "little")
        if self.kind is _SHORT_BINARY:
            return int.from_bytes(self.data[8:12], "little")
        if self.kind in _ASCII_KINDS:
            return round(float(self._ascii_header[-4 if self.kind is _ASCII else 2]) * 1000)
        return None

    @property
    def time_status(self) -> TimeStatus | int | None:
        """Quality of the header's time; None for kinds without it (short headers have none)."""
        if self.kind in _LONG_KINDS:
            return named(TimeStatus, self.data[13])
        if self.kind is _ASCII:
            return TimeStatus.__members__.get(self._ascii_header[4])
        return None

    @property
    def receiver_status(self) -> int | None:
        """The header's receiver status word (sheet 3.5), where there is one."""
        if self.kind in _LONG_KINDS:
            return int.from_bytes(self.data[20:24], "little")
        return int(self._ascii_header[-3], 16) if self.kind is _ASCII else None

    @property
    def port_address(self) -> int | None:
        """Low byte of the id of the port that it was sent on, of a long binary header."""
        return self.data[7] if self.kind in _LONG_KINDS else None

    @property
    def is_response(self) -> bool:
        """Whether it answers a binary or ASCII command, rather than being a log."""
        if self.kind is _BINARY:
            return bool(self.data[6] & RESPONSE_BIT)
        return self.kind is _ASCII and self._ascii_name[1] == "R"

    @property
    def body(self) -> bytes:
        """What lies between header and checksum; empty for kinds without a header."""
        if self.kind in _LONG_KINDS:
            return self.data[self.data[3] : -CRC_BYTES]
        if self.kind is _SHORT_BINARY:
            return self.data[SHORT_HEADER_BYTES:-CRC_BYTES]
        if self.kind in _ASCII_KINDS:
            return self.data[self.data.index(b";") + 1 : self.data.rindex(b"*")]
        return b""

    @property
    def text(self) -> str:
        """A text frame's line without its end; "OK" or "ERROR:..." of a reply, of a prompt its port."""
        if self.kind in BINARY_KINDS:
            return ""
        line = self.data.decode("ascii", "replace").strip("\r\n")
        return line.strip("<[]") if self.kind in (Kind.REPLY, Kind.PROMPT) else line

    @property
    def key(self) -> tuple[int | None, int, int, int | None, int | None]:
        """What two frames share that are the same log of the same moment, sent on two (virtual) ports.

        Message id, measurement source, sequence number, week, ms.
        """
        source = sequence = 0
        if self.kind is _SHORT_BINARY:  # as below, in half the time
            message, week, ms = _SHORT_KEY.unpack_from(self.data, 4)
            return message, source, sequence, week, ms
        if self.kind is _BINARY:
            source, sequence = self.data[6] & SOURCE_MASK, int.from_bytes(self.data[10:12], "little")
        elif self.kind is _ASCII:
            source, sequence = self._ascii_name[2], int(self._ascii_header[2])
        return self.message_id, source, sequence, self.week, self.ms

    @property
    def _ascii_name(self) -> tuple[str, str, int]:
        """Name, format letter (A a log, R a response), measurement source, as of "BESTPOSA_1"."""
        name, _, source = self._ascii_header[0].partition("_")
        return name[:-1], name[-1], int(source) if source.isdecimal() else 0

    @property
    def _ascii_header(self) -> list[str]:
        return self.data[1 : self.data.index(b";")].decode("ascii").split(",")


_LONG_KINDS = frozenset({Kind.BINARY, Kind.PROPRIETARY})  # with the long header
BINARY_KINDS = _LONG_KINDS | {Kind.SHORT_BINARY}
_ASCII_KINDS = frozenset({Kind.ASCII, Kind.SHORT_ASCII})
_UNCHECKED_KINDS = frozenset({Kind.ABBREVIATED, Kind.REPLY, Kind.PROMPT})
_SHORT_KEY = struct.Struct("<HHI")  # id, week, ms of a short header, from its fifth byte on


def crc32(data: bytes) -> int:
    """NovAtel's CRC-32: zlib's polynomial, starting at 0, without the final xor (sheet 1.4)."""
    return zlib.crc32(data, 0xFFFFFFFF) ^ 0xFFFFFFFF


_START = re.compile(rb"[\xaa#%$<\[\r]")
_LINE = re.compile(rb"[\t\x20-\x7e]*")
_PROMPT = re.compile(rb"\[[A-Z]{2,8}[0-9]{0,2}(?:_[0-9]{1,2})?\]")
_PROMPT_BYTES = 16
_SHORT_TEXT_BYTES = 512  # of a reply or an abbreviated line

# the ten header fields of ASCII, the three of short ASCII (sheet 1.5)
_ASCII_LINE = re.compile(
    rb"#[A-Z][A-Z0-9_]{1,40},[A-Z0-9_]+,\d+,[\d.]+,[A-Z]+,\d+,\d+\.?\d*,[0-9A-Fa-f]{8},[0-9A-Fa-f]+,\d+;.*\*([0-9A-Fa-f]{8})"
)
_SHORT_ASCII_LINE = re.compile(rb"%[A-Z][A-Z0-9_]{1,40},\d+,\d+\.?\d*;.*\*([0-9A-Fa-f]{8})")
_NMEA = re.compile(rb"\$[A-Z][A-Z0-9]{2,},.*\*([0-9A-Fa-f]{2})")
_LOOKS_ASCII = re.compile(rb"[#%$][A-Z][A-Z0-9_]+,")

_Match = tuple[Kind, int] | Fault | int | None
"""A frame and where it ends, or not a frame; or too little to tell: then how far it will reach, if known."""


_SYNCS = {
    b"\xaa\x44\x12": Kind.BINARY,
    b"\xaa\x44\x13": Kind.SHORT_BINARY,
    b"\xaa\x45\x12": Kind.PROPRIETARY,
}


def _extent(buffer: bytes, at: int) -> _Match:
    """Tell the kind of the binary frame at ``at``, and where it will end by its header."""
    have = len(buffer) - at
    sync = buffer[at : at + 3]
    kind = _SYNCS.get(sync)
    if kind is None:
        return None if any(whole.startswith(sync) for whole in _SYNCS) else _NOISE
    if kind is _SHORT_BINARY:
        if have < 4:
            return None
        header_bytes, body_bytes = SHORT_HEADER_BYTES, buffer[at + 3]
    else:
        if have < 10:
            return None
        header_bytes, body_bytes = buffer[at + 3], int.from_bytes(buffer[at + 8 : at + 10], "little")
        if header_bytes < LONG_HEADER_BYTES:
            return Fault.LENGTH
    end = at + header_bytes + body_bytes + CRC_BYTES
    return (kind, end) if end - at <= MAX_FRAME_BYTES else Fault.LENGTH


def _binary(buffer: bytes, at: int) -> _Match:
    match = _extent(buffer, at)
    if not isinstance(match, tuple):
        return match
    end = match[1]
    if end > len(buffer):
        return end
    return match if crc32(buffer[at:end]) == 0 else Fault.CRC  # over its own CRC too it is 0


def _line(buffer: bytes, at: int, most: int) -> tuple[int, int] | Fault | None:
    """Where the text of the line at ``at`` ends, and where its line end does."""
    found = _LINE.match(buffer, at, at + most + 1)
    end = found.end() if found else at
    if end - at > most:
        return Fault.LENGTH
    tail = buffer[end : end + 2]
    if tail[:1] == b"\n":
        return end, end + 1
    if tail == b"\r\n":
        return end, end + 2
    return None if tail in (b"", b"\r") else Fault.CUT


def _ascii(buffer: bytes, at: int) -> _Match:
    if at + 1 == len(buffer):
        return None
    if not buffer[at + 1 : at + 2].isupper():
        return Fault.NOISE
    line = _line(buffer, at, MAX_FRAME_BYTES)
    if line is None:
        return None
    if isinstance(line, Fault):
        return line if _LOOKS_ASCII.match(buffer, at) else Fault.NOISE
    text = buffer[at : line[0]]
    kind, pattern = _TEXT_KINDS[text[:1]]
    if not (found := pattern.fullmatch(text)):
        return Fault.CUT if _LOOKS_ASCII.match(text) else Fault.NOISE
    covered, told = text[1 : text.rindex(b"*")], int(found[1], 16)
    sum_of = _xor if kind is Kind.NMEA else crc32
    return (kind, line[1]) if sum_of(covered) == told else Fault.CRC


def _xor(data: bytes) -> int:
    result = 0
    for byte in data:
        result ^= byte
    return result


_TEXT_KINDS = {
    b"#": (Kind.ASCII, _ASCII_LINE),
    b"%": (Kind.SHORT_ASCII, _SHORT_ASCII_LINE),
    b"$": (Kind.NMEA, _NMEA),
}


def _angle(buffer: bytes, at: int) -> _Match:
    line = _line(buffer, at, _SHORT_TEXT_BYTES)
    if line is None:
        return None
    if isinstance(line, Fault):
        return Fault.NOISE
    text = buffer[at : line[0]]
    if text == b"<OK" or text.startswith(b"<ERROR:"):
        return Kind.REPLY, line[1]
    if re.match(rb"<(?:[A-Z][A-Z0-9_]+ | +[^ ])", text):
        return Kind.ABBREVIATED, line[1]
    return Fault.NOISE


def _prompt(buffer: bytes, at: int) -> _Match:
    if found := _PROMPT.match(buffer, at):
        return Kind.PROMPT, found.end()
    shown = buffer[at + 1 : at + _PROMPT_BYTES]
    if len(buffer) - at < _PROMPT_BYTES and re.fullmatch(rb"[A-Z0-9_]*", shown):
        return None
    return Fault.NOISE


def _after_line_end(buffer: bytes, at: int) -> _Match:
    """Match the CR LF that comes before a reply or a prompt, with it."""
    head = buffer[at : at + 3]
    if head in (b"\r", b"\r\n"):
        return None
    if head not in (b"\r\n<", b"\r\n["):
        return Fault.NOISE
    match = (_angle if head[2:] == b"<" else _prompt)(buffer, at + 2)
    if match is None or (isinstance(match, tuple) and match[0] is not Kind.ABBREVIATED):
        return match
    return Fault.NOISE


_MATCHERS: dict[int, Callable[[bytes, int], _Match]] = {
    0xAA: _binary,
    ord("#"): _ascii,
    ord("%"): _ascii,
    ord("$"): _ascii,
    ord("<"): _angle,
    ord("["): _prompt,
    ord("\r"): _after_line_end,
}


class Framer:
    """Turns chunks of a receiver's stream into frames; keeps at most one unfinished frame.

    on_skip: called with every stretch of bytes that belongs to no frame. Frames and skips, joined in order
    of their offsets, are the stream.
    """

    def __init__(self, on_skip: Callable[[Skip], None] | None = None) -> None:
        self.frames = 0
        self.bad_frames = 0
        """Candidates that looked like a frame and failed: wrong checksum or length, cut off."""
        self._on_skip = on_skip
        self._rest = b""
        self._announced = 0  # how long the frame will be that _rest is the beginning of, where that is known
        self._offset = 0  # of the first byte of _rest in the stream
        self._ends: list[int] = []  # of each chunk that _rest has bytes of, the offset behind its last byte,
        self._stamps: list[int] = []  # and its stamp

    @property
    def lacking(self) -> int:
        """How many bytes must come at least before there is another frame."""
        return max(1, self._announced - len(self._rest))

    def feed(self, data: bytes, t_ns: int) -> list[Frame]:
        """Take a chunk with its stamp (CLOCK_MONOTONIC, ns); return the frames that ended in it."""
        return self.feed_all(((data, t_ns),))

    def feed_all(self, chunks: Iterable[tuple[bytes, int]]) -> list[Frame]:
        """Take some chunks at once."""
        buffer, before = self._rest, self._offset
        for data, t_ns in chunks:
            buffer += data
            self._ends.append(before + len(buffer))
            self._stamps.append(t_ns)
        if len(buffer) < self._announced:
            self._rest = buffer
            return []
        frames: list[Frame] = []
        junk_at, reason = 0, _NOISE  # where the bytes begin that belong to no frame, and why
        at = self._announced = 0
        while start := _START.search(buffer, at):
            at = start.start()
            match = _MATCHERS[buffer[at]](buffer, at)
            if isinstance(match, tuple):
                kind, end = match
                if junk_at < at:
                    self._skip(buffer, junk_at, at, reason)
                frames.append(self._frame(buffer[at:end], self._offset + at, kind))
                at = junk_at = end
                reason = _NOISE
            elif isinstance(match, Fault):
                if match is not _NOISE:
                    self.bad_frames += 1
                    if reason is _NOISE:
                        reason = match
                at += 1
            else:
                self._announced = 0 if match is None else match - at
                break
        else:
            at = len(buffer)
        if junk_at < at:
            self._skip(buffer, junk_at, at, reason)
        self._rest = buffer[at:]
        self._offset += at
        done = bisect_right(self._ends, self._offset)
        del self._ends[:done], self._stamps[:done]
        return frames

    def close(self) -> None:
        """Say that the stream has ended: what is left goes to on_skip."""
        if self._rest:
            self._skip(self._rest, 0, len(self._rest), Fault.END)
        self._offset += len(self._rest)
        self._rest = b""
        self._announced = 0
        self._ends.clear()
        self._stamps.clear()

    def _frame(self, data: bytes, offset: int, kind: Kind) -> Frame:
        self.frames += 1
        first, last = bisect_right(self._ends, offset), bisect_left(self._ends, offset + len(data))
        stamps = self._stamps
        return Frame(offset, data, stamps[first], stamps[last], self._ends[first] - offset, kind)

    def _skip(self, buffer: bytes, start: int, end: int, reason: Fault) -> None:
        if self._on_skip:
            self._on_skip(Skip(self._offset + start, buffer[start:end], reason))
