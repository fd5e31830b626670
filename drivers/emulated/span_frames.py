"""A SPAN receiver's binary logs, as the receiver builds them: a solution in, framed bytes out.

Layouts, ids and definition CRCs are those of the protocol sheet (sections 1 to 3).
"""

from __future__ import annotations

import math
import struct
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from datetime import datetime, timedelta
from enum import IntEnum

WEEK_MS = 604_800_000
GPS_EPOCH = datetime(1980, 1, 6)
UTC_OFFSET_S = -18.0
FINESTEERING = 180
COM1 = 0x20
LONG_HEADER = 28
SHORT_HEADER = 12
RESPONSE_BIT = 0x80
WGS84 = 61

_LONG = struct.Struct("<3sBHBBHHBBHIIHH")
_SHORT = struct.Struct("<3sBHHI")
_SOFTWARE_BUILD = 16248
_IDLE = 130  # half percents


class InsStatus(IntEnum):
    """Section 3.1, those that the emulated receiver goes through."""

    ALIGNING = 1
    SOLUTION_GOOD = 3
    ALIGNMENT_COMPLETE = 7


class PosType(IntEnum):
    """Section 3.3, likewise."""

    NONE = 0
    NARROW_INT = 50
    INS_RTKFIXED = 56


@dataclass(frozen=True, slots=True)
class Stamp:
    """What a header says: GPS week and ms, the receiver's status word, the port."""

    week: int
    ms: int
    status: int = 0x02000000
    port: int = COM1
    source: int = 0
    """Measurement source bits of the message type."""


@dataclass(frozen=True, slots=True)
class Solution:
    """What the receiver knows at an epoch; degrees, m, m/s.

    ``position`` is latitude, longitude and height above the ellipsoid of the IMU; ``antenna`` likewise of
    the antenna. ``sigma`` has latitude, longitude, height in m; north, east, up in m/s; roll, pitch,
    azimuth in degrees.
    """

    stamp: Stamp
    position: tuple[float, float, float]
    velocity: tuple[float, float, float]
    """North, east, up."""
    attitude: tuple[float, float, float]
    """Roll, pitch, azimuth."""
    antenna: tuple[float, float, float]
    ins_status: InsStatus = InsStatus.SOLUTION_GOOD
    pos_type: PosType = PosType.INS_RTKFIXED
    undulation_m: float = 22.5
    sigma: tuple[float, ...] = (0.012, 0.012, 0.015, 0.01, 0.01, 0.01, 0.015, 0.015, 0.04)

    @property
    def seconds(self) -> float:
        """Return the seconds of the week."""
        return self.stamp.ms / 1000


_PLACEHOLDER = (-90.0, 0.0, -6356752.3142)  # an unaligned OEM6's pose: the south pole's depth


def unaligned(stamp: Stamp, antenna: tuple[float, float, float]) -> Solution:
    """Return what a receiver says that has not begun to know its attitude (section 10, item 2)."""
    zero = (0.0, 0.0, 0.0)
    return Solution(
        stamp, _PLACEHOLDER, zero, zero, antenna, InsStatus.ALIGNING, PosType.NONE, sigma=(0.0,) * 9
    )


def crc32(data: bytes) -> int:
    """Return the CRC of section 1.4."""
    return zlib.crc32(data, 0xFFFFFFFF) ^ 0xFFFFFFFF


def long_frame(
    message_id: int, body: bytes, stamp: Stamp, *, definition: int = 0, response: bool = False
) -> bytes:
    """Frame a body with the long header (section 1.2)."""
    message_type = stamp.source | (RESPONSE_BIT if response else 0)
    frame = _LONG.pack(
        b"\xaa\x44\x12", LONG_HEADER, message_id, message_type, stamp.port, len(body), 0, _IDLE, FINESTEERING,
        stamp.week, stamp.ms, stamp.status, definition, _SOFTWARE_BUILD,
    )  # fmt: skip
    return frame + body + struct.pack("<I", crc32(frame + body))


def short_frame(message_id: int, body: bytes, stamp: Stamp) -> bytes:
    """Frame a body with the short header (section 1.3)."""
    frame = _SHORT.pack(b"\xaa\x44\x13", len(body), message_id, stamp.week, stamp.ms) + body
    return frame + struct.pack("<I", crc32(frame))


@dataclass(frozen=True, slots=True)
class Log:
    """A log's number, how it is framed, and its body."""

    message_id: int
    body: Callable[[Solution], bytes]
    definition: int = 0
    short: bool = False
    fastest_ms: int = 10
    natural_ms: int = 1000
    """How often there is something new, for ONNEW; 0 for what never changes."""

    def frame(self, solution: Solution) -> bytes:
        """Return the whole frame."""
        if self.short:
            return short_frame(self.message_id, self.body(solution), solution.stamp)
        return long_frame(self.message_id, self.body(solution), solution.stamp, definition=self.definition)


def _inspva(s: Solution) -> bytes:
    return struct.pack(
        "<Id9dI", s.stamp.week, s.seconds, *s.position, *s.velocity, *s.attitude, s.ins_status
    )  # ellipsoidal height


def _inspvax(s: Solution) -> bytes:
    lat, lon, height = s.position
    extended = 0x4F if s.ins_status == InsStatus.SOLUTION_GOOD else 0  # converged, with updates
    return struct.pack(
        "<II3df6d9fIH", s.ins_status, s.pos_type, lat, lon, _above_sea(height, s), s.undulation_m,
        *s.velocity, *s.attitude, *s.sigma, extended, 0,
    )  # fmt: skip


def _above_sea(height_m: float, s: Solution) -> float:
    undulation: float = struct.unpack("<f", struct.pack("<f", s.undulation_m))[0]  # as the log can say it
    return height_m - undulation


def _insatt(s: Solution) -> bytes:
    return struct.pack("<Id3dI", s.stamp.week, s.seconds, *s.attitude, s.ins_status)


def _inspos(s: Solution) -> bytes:
    return struct.pack("<Id3dI", s.stamp.week, s.seconds, *s.position, s.ins_status)


def _insvel(s: Solution) -> bytes:
    return struct.pack("<Id3dI", s.stamp.week, s.seconds, *s.velocity, s.ins_status)


def _inscov(s: Solution) -> bytes:
    def diagonal(a: float, b: float, c: float) -> list[float]:
        return [a * a, 0, 0, 0, b * b, 0, 0, 0, c * c]

    lat, lon, height, north, east, up, roll, pitch, azimuth = s.sigma
    return struct.pack(
        "<Id27d", s.stamp.week, s.seconds, *diagonal(lat, lon, height), *diagonal(pitch, roll, azimuth),
        *diagonal(north, east, up),
    )  # fmt: skip


def _insstdev(s: Solution) -> bytes:
    return struct.pack("<9fIHHII", *s.sigma, 0x4F, 0, 0, 0, 0)


def _bestpos(s: Solution) -> bytes:
    lat, lon, height = s.antenna  # always the antenna's place
    pos_type = PosType.INS_RTKFIXED if s.ins_status == InsStatus.SOLUTION_GOOD else PosType.NARROW_INT
    return struct.pack(
        "<II3dfI3f4s2f8B", 0, pos_type, lat, lon, _above_sea(height, s), s.undulation_m, WGS84,
        0.012, 0.012, 0.015, b"0001", 1.0, 0.0, 24, 21, 21, 19, 0, 0, 0x15, 0x33,
    )  # fmt: skip


def _bestvel(s: Solution) -> bytes:
    north, east, up = s.velocity
    track = math.degrees(math.atan2(east, north)) % 360
    return struct.pack("<II2f3df", 0, PosType.INS_RTKFIXED, 0.0, 0.0, math.hypot(north, east), track, up, 0.0)


def _time(s: Solution) -> bytes:
    utc = GPS_EPOCH + timedelta(weeks=s.stamp.week, milliseconds=s.stamp.ms, seconds=UTC_OFFSET_S)
    return struct.pack(
        "<I3dI4B2I", 0, -1.2e-9, 9.0e-10, UTC_OFFSET_S, utc.year, utc.month, utc.day, utc.hour, utc.minute,
        utc.second * 1000 + utc.microsecond // 1000, 1,
    )  # fmt: skip


def _timesync(s: Solution) -> bytes:
    return struct.pack("<III", s.stamp.week, s.stamp.ms, FINESTEERING)


def _rxstatus(s: Solution) -> bytes:
    words = [(s.stamp.status, 0, 0, 0)] + [(0, 0, 0, 0)] * 4
    return struct.pack("<II", 0, len(words)) + b"".join(struct.pack("<4I", *word) for word in words)


def _version(_: Solution) -> bytes:
    card = ("OEM719N", "BMGX15320028A", "OEM719N-1.00", "OM7MR0800RN0000", "OM7BR0001RB0000")
    imu = ("EPSON_G320", "E0001234", "1.00", "1.00", "1.00")
    items = [
        struct.pack(
            "<I16s16s16s16s16s12s12s", kind, *(t.encode() for t in texts), b"2020/Mar/12", b"10:31:45"
        )
        for kind, texts in ((1, card), (7, imu))
    ]
    return struct.pack("<I", len(items)) + b"".join(items)


LOGS: dict[str, Log] = {
    # In the order in which a receiver sends the logs of one epoch (section 10, item 7)
    "BESTPOS": Log(42, _bestpos, 0xCDBA, fastest_ms=50, natural_ms=200),
    "BESTGNSSPOS": Log(1429, _bestpos, fastest_ms=50, natural_ms=200),
    "BESTVEL": Log(99, _bestvel, fastest_ms=50, natural_ms=200),
    "TIME": Log(101, _time, 0x9924, fastest_ms=50),
    "TIMESYNC": Log(492, _timesync, 0xBD3F, fastest_ms=50),
    "RXSTATUS": Log(93, _rxstatus, 0x2AE1, fastest_ms=50, natural_ms=0),
    "VERSION": Log(37, _version, 0x3681, fastest_ms=1000, natural_ms=0),
    "INSCOV": Log(264, _inscov, 0x4B7B, fastest_ms=50),
    "INSCOVS": Log(320, _inscov, short=True, fastest_ms=50),
    "INSSTDEV": Log(2051, _insstdev, 0x2396, fastest_ms=50),
    "INSSTDEVS": Log(2052, _insstdev, short=True, fastest_ms=50),
    "INSPVAX": Log(1465, _inspvax, 0x46EB, natural_ms=10),
    "INSPVA": Log(507, _inspva, 0x18BC, natural_ms=10),
    "INSPVAS": Log(508, _inspva, short=True, natural_ms=10),
    "INSATT": Log(263, _insatt, 0xC6A7, natural_ms=10),
    "INSATTS": Log(319, _insatt, short=True, natural_ms=10),
    "INSPOS": Log(265, _inspos, natural_ms=10),
    "INSPOSS": Log(321, _inspos, short=True, natural_ms=10),
    "INSVEL": Log(267, _insvel, natural_ms=10),
    "INSVELS": Log(324, _insvel, short=True, natural_ms=10),
}


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
    """Return a whole frame's message id, body and stamp, or None if its CRC is wrong."""
    if crc32(frame[:-4]) != int.from_bytes(frame[-4:], "little"):
        return None
    if frame[2] == 0x13:
        _, _, message_id, week, ms = _SHORT.unpack_from(frame)
        return message_id, frame[SHORT_HEADER:-4], Stamp(week, ms)
    head = _LONG.unpack_from(frame)
    return head[2], frame[head[1] : -4], Stamp(head[9], head[10], head[11], head[4], head[3] & 0x1F)


def frames(data: bytes) -> Iterator[tuple[int, int, bytes, Stamp]]:
    """Yield (offset of the frame's end, message id, body, stamp) of each binary frame of a recording."""
    at = data.find(b"\xaa\x44")
    while at >= 0:
        size = frame_size(data, at)
        found = parse_frame(data[at : at + size]) if size and at + size <= len(data) else None
        if found and size:
            yield at + size, *found
        at = data.find(b"\xaa\x44", at + (size if found and size else 1))
