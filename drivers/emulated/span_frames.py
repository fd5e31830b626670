"""A SPAN receiver's framing, from its side: header and fields to bytes, and a host's bytes to commands.

Sheet, section 1. The logs that go into the frames are in `span_logs`.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from polecal.drivers.emulated.span_enums import TimeStatus

WEEK_MS = 604_800_000
LONG_HEADER = 28
SHORT_HEADER = 12
RESPONSE_BIT = 0x80
VIRTUAL_PORTS = 32  # of each port, its own number being the first
PORT_IDS = {
    "COM1": 0x20, "COM2": 0x40, "COM3": 0x60, "SPECIAL": 0xA0, "THISPORT": 0xC0, "FILE": 0xE0,
    "USB1": 0x5A0, "USB2": 0x6A0, "USB3": 0x7A0, "AUX": 0x8A0, "COM4": 0xBA0, "ETH1": 0xCA0, "IMU": 0xDA0,
    "ICOM1": 0xFA0, "ICOM2": 0x10A0, "ICOM3": 0x11A0, "NCOM1": 0x12A0, "COM5": 0x17A0, "COM6": 0x18A0,
}  # fmt: skip
"""Section 3.6."""

_LONG = struct.Struct("<3sBHBBHHBBHIIHH")
_SHORT = struct.Struct("<3sBHHI")


@dataclass(frozen=True, slots=True)
class Stamp:
    """What a header says of the receiver at a moment (section 1.2)."""

    week: int
    ms: int
    status: int = 0x02000000
    """The receiver's status word."""
    port: str = "COM1"
    virtual: int = 0
    """The virtual port's number, 0 for the port itself."""
    source: int = 0
    """Measurement source bits of the message type."""
    time_status: TimeStatus = TimeStatus.FINESTEERING
    idle: int = 130
    """Half percents."""
    build: int = 16248
    sequence: int = 0

    @property
    def port_name(self) -> str:
        """Return the port as ASCII headers spell it."""
        return f"{self.port}_{self.virtual}" if self.virtual else self.port


def crc32(data: bytes) -> int:
    """Return the CRC of section 1.4."""
    return zlib.crc32(data, 0xFFFFFFFF) ^ 0xFFFFFFFF


def long_frame(
    message_id: int, body: bytes, stamp: Stamp, *, definition: int = 0, response: bool = False
) -> bytes:
    """Frame a body with the long header (section 1.2)."""
    frame = _LONG.pack(
        b"\xaa\x44\x12", LONG_HEADER, message_id, stamp.source | (RESPONSE_BIT if response else 0),
        (PORT_IDS[stamp.port] & 0xFF) + stamp.virtual, len(body), stamp.sequence, stamp.idle,
        stamp.time_status, stamp.week, stamp.ms, stamp.status, definition, stamp.build,
    )  # fmt: skip
    return frame + body + struct.pack("<I", crc32(frame + body))


def short_frame(message_id: int, body: bytes, stamp: Stamp) -> bytes:
    """Frame a body with the short header (section 1.3)."""
    frame = _SHORT.pack(b"\xaa\x44\x13", len(body), message_id, stamp.week, stamp.ms) + body
    return frame + struct.pack("<I", crc32(frame))


def _said(stamp: Stamp, definition: int, short: bool) -> list[str]:
    """Return what follows the name in an ASCII header (section 1.5)."""
    seconds = f"{stamp.ms / 1000:.3f}"
    if short:
        return [str(stamp.week), seconds]
    return [
        stamp.port_name, str(stamp.sequence), f"{stamp.idle / 2:.1f}", stamp.time_status.name,
        str(stamp.week), seconds, f"{stamp.status:08x}", f"{definition:04x}", str(stamp.build),
    ]  # fmt: skip


def ascii_line(
    name: str, fields: Sequence[str], stamp: Stamp, *, definition: int = 0, short: bool = False
) -> bytes:
    """Return an ASCII log; the name comes with its A (or R, of a response)."""
    source = f"_{stamp.source}" if stamp.source and not short else ""
    text = ",".join([name + source, *_said(stamp, definition, short)]) + ";" + ",".join(fields)
    return f"{'%' if short else '#'}{text}*{crc32(text.encode()):08x}\r\n".encode()


def abbreviated_lines(
    name: str, rows: Sequence[tuple[int, Sequence[str]]], stamp: Stamp, *, definition: int, short: bool
) -> bytes:
    """Return an abbreviated ASCII log of rows (depth, fields)."""
    lines = [" ".join([f"<{name}", *_said(stamp, definition, short)])]
    lines += [f"<{' ' * 5 * depth}{' '.join(fields)}" for depth, fields in rows]
    return "".join(line + "\r\n" for line in lines).encode()


def frame_size(data: bytes | bytearray, at: int = 0) -> int | None:
    """Return how long the frame at a place is; 0 if none begins there, None if it cannot be told yet."""
    head = bytes(data[at : at + 10])
    if not (b"\xaa\x44\x12".startswith(head[:3]) or b"\xaa\x44\x13".startswith(head[:3])):
        return 0
    if len(head) < 10:
        return None
    if head[2] == 0x13:
        return SHORT_HEADER + head[3] + 4
    return head[3] + int.from_bytes(head[8:10], "little") + 4


def parse_frame(frame: bytes) -> tuple[int, bytes, Stamp] | None:
    """Return a whole frame's message id, body and stamp (but for its port), or None if its CRC is wrong."""
    if crc32(frame[:-4]) != int.from_bytes(frame[-4:], "little"):
        return None
    if frame[2] == 0x13:
        _, _, message_id, week, ms = _SHORT.unpack_from(frame)
        return message_id, frame[SHORT_HEADER:-4], Stamp(week, ms)
    head = _LONG.unpack_from(frame)
    return head[2], frame[head[1] : -4], Stamp(head[9], head[10], head[11], source=head[3] & 0x1F)


def parse_line(line: str) -> list[str] | None:
    """Return the words of an ASCII command, its name (with its A) first; None if its CRC is wrong."""
    text, _, crc = line[1:].partition("*")
    if f"{crc32(text.encode()):08x}" != crc.strip().lower():
        return None
    head, _, body = text.partition(";")
    return [head.split(",")[0], *body.split(",")]


def frames(data: bytes) -> Iterator[tuple[int, int, bytes, Stamp]]:
    """Yield (offset of the frame's end, message id, body, stamp) of each binary frame of a recording."""
    at = data.find(b"\xaa\x44")
    while at >= 0:
        size = frame_size(data, at)
        found = parse_frame(data[at : at + size]) if size and at + size <= len(data) else None
        if found and size:
            yield at + size, *found
        at = data.find(b"\xaa\x44", at + (size if found and size else 1))
