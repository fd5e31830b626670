"""The LMS-291's telegrams, as the device builds them: state in, bytes out.

Numbers are those of the protocol sheet; section numbers refer to it.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

STX = 0x02
ACK = b"\x06"
NAK = b"\x15"
REPLY = 0x80  # added to the host's address and to its command
MAX_LENGTH = 812
"""Of command and data. Section 1."""


class Command(IntEnum):
    """Host to laser (section 3); the reply's code is 80h more."""

    RESET = 0x10
    MODE = 0x20
    VALUES = 0x30
    STATUS = 0x31
    ERRORS = 0x32
    HOURS = 0x35
    TYPE = 0x3A
    VARIANT = 0x3B
    OUTPUTS = 0x4A
    PERMANENT = 0x66
    READ_CONFIG = 0x74
    WRITE_CONFIG = 0x77
    READ_CONFIG_2 = 0x7B


POWER_ON = 0x90
RESET_DONE = 0x91
REJECTED = 0x92
MODE_REPLY = 0xA0
VALUES_REPLY = 0xB0


class Mode(IntEnum):
    """Operating modes, the byte after 20h."""

    INSTALLATION = 0x00
    DIAGNOSTIC = 0x10
    STREAM = 0x24
    REQUEST = 0x25
    STREAM_PARTIAL = 0x2A


BAUD_OF_SUB = {0x40: 38400, 0x41: 19200, 0x42: 9600, 0x48: 500000}
_BAUD_WORD = {500000: 0x8001, 38400: 0x8019, 19200: 0x8033, 9600: 0x8067}  # Section 3.1, offset 116
PASSWORD = b"SICK_LMS"

STATUS_OK = 0x10
"""Type 6, no error (section 1)."""

DEFAULT_CONFIG = bytes.fromhex(
    "0000 46 00 00 00 00 00 00 02 02 02 00 000A0A5064 000A0A5064 000A0A5064 00 00 0000 0200"
)
"""An LMS-291 as it left the factory: measuring mode 00, cm (section 3.2)."""

STREAM_CONFIG = DEFAULT_CONFIG[:4] + b"\x02\x01" + DEFAULT_CONFIG[6:]
"""Real-time indices on, measuring mode 01: reflectivity in bits 13 to 15."""

INDICES = 0x02  # availability bit 1
_AVAILABILITY, _MEASURING_MODE, _UNIT = 4, 5, 6

_DISTANCE_BITS = {0x00: 13, 0x01: 13, 0x02: 13, 0x03: 14, 0x04: 14, 0x05: 15, 0x06: 15, 0x0F: 15}
_LEVEL_BITS = {0x01: 3, 0x03: 2, 0x05: 1}
MEASURING_MODES = frozenset(_DISTANCE_BITS)

_NO_ECHO, _OVER_MAXIMUM = 0, 8  # below the largest number of the distance bits (overflow codes, 3.3)


@dataclass(frozen=True, slots=True)
class Variant:
    """Scan angle in degrees and resolution in 1/100 degree."""

    angle_deg: int
    resolution_cdeg: int

    @property
    def beams(self) -> int:
        """How many values a scan has."""
        return self.angle_deg * 100 // self.resolution_cdeg + 1

    @property
    def revolutions(self) -> int:
        """How many turns of the mirror a scan takes: each fires a 1° raster."""
        return 100 // self.resolution_cdeg

    @property
    def angles_deg(self) -> NDArray[np.float64]:
        """Return each beam's angle in the laser's own half circle: 0 right, 90 ahead."""
        return (180 - self.angle_deg) / 2 + np.arange(self.beams) * self.resolution_cdeg / 100


POWER_ON_VARIANT = Variant(180, 50)
VARIANTS = frozenset(Variant(a, r) for a, r in ((180, 100), (180, 50), (100, 100), (100, 50), (100, 25)))
"""Section 7."""


def crc16(data: bytes) -> int:
    """Return the telegram's CRC: one shift a byte, not eight (section 1)."""
    crc = previous = 0
    for byte in data:
        crc = ((crc << 1) & 0xFFFF) ^ (0x8005 if crc & 0x8000 else 0) ^ (byte | previous << 8)
        previous = byte
    return crc


def telegram(address: int, payload: bytes) -> bytes:
    """Frame a command and its data."""
    body = struct.pack("<BBH", STX, address, len(payload)) + payload
    return body + struct.pack("<H", crc16(body))


def reply(code: int, data: bytes, status: int = STATUS_OK, address: int = 0) -> bytes:
    """Frame a reply from a laser of an address."""
    return telegram(REPLY + address, bytes([code]) + data + bytes([status]))


def value_words(range_m: NDArray[np.float64], level: NDArray[np.int64], config: bytes) -> NDArray[np.uint16]:
    """Return ranges (N,) m, inf for no echo, and reflectivity levels 0 to 7 as value words (section 3.3)."""
    mode, per_metre = config[_MEASURING_MODE], 1000 if config[_UNIT] else 100
    bits = _DISTANCE_BITS[mode]
    top = (1 << bits) - 1
    seen = np.isfinite(range_m)
    distance = np.rint(np.where(seen, range_m, 0.0) * per_metre).clip(0, top - _OVER_MAXIMUM)
    distance = np.where(seen, distance, top - _NO_ECHO).astype(np.uint16)
    level_bits = _LEVEL_BITS.get(mode, 0)
    if level_bits:
        distance |= np.where(seen, level >> (3 - level_bits), 0).astype(np.uint16) << np.uint16(bits)
    return distance


def values(
    words: NDArray[np.uint16],
    config: bytes,
    indices: tuple[int, int],
    *,
    partial: int | None = None,
    address: int = 0,
    status: int = STATUS_OK,
) -> bytes:
    """Return B0 of value words in ascending angle.

    ``indices`` are the mirror's revolution and the telegram, put in if the configuration says so;
    ``partial`` is the quarter degree of an interlaced partial scan (section 4).
    """
    header = len(words) | config[_UNIT] << 14
    if partial is not None:
        header |= 1 << 13 | partial << 11
    data = struct.pack("<H", header) + words.astype("<u2").tobytes()
    if config[_AVAILABILITY] & INDICES:
        data += bytes(index & 0xFF for index in indices)
    return reply(VALUES_REPLY, data, status, address)


@dataclass(frozen=True, slots=True)
class StatusFields:
    """What of the status reply changes with the device's state."""

    mode: int
    variant: Variant
    config: bytes
    baud: int
    permanent_baud: bool
    motor_us: int
    """Microseconds for 1/90 of a revolution."""
    version: str = "V02.10 "
    serial: str = "00291291"
    address: int = 0


_POLLUTION = (402, 282, 479, 667, 375, 273, 449, 326)
_REFERENCE_POLLUTION = (432, 338, 421, 402)


def status_data(f: StatusFields) -> bytes:
    """Return the 152 data bytes of B1, without the status byte that ends them (section 3.1)."""
    out = bytearray(153)  # from the command byte on, so that offsets are the sheet's

    def put(offset: int, layout: str, *numbers: int) -> None:
        struct.pack_into("<" + layout, out, offset, *numbers)

    out[1:8] = f.version.encode("ascii").ljust(7)[:7]
    put(8, "BB", f.mode, 0)
    out[10:18] = f.serial.encode("ascii").ljust(8)[:8]
    put(19, "8H4H8H4H", *(2 * (_POLLUTION + _REFERENCE_POLLUTION)))
    put(67, "H", f.motor_us)
    put(71, "H", 62)
    put(75, "3H", 59, 54, 51)
    put(83, "HHHHH", 100, 90, 120, 105, 240)
    put(93, "4H", 70, 160, 71, 162)
    put(102, "B", f.config[_MEASURING_MODE])
    put(103, "HH", 0x0A64, 0x0A62)
    put(107, "HH", f.variant.angle_deg, f.variant.resolution_cdeg)
    put(111, "BH", f.config[10], f.config[11])
    put(116, "H", _BAUD_WORD[f.baud])
    put(118, "6B", f.config[9], f.permanent_baud, f.address, 0, f.config[_UNIT], 1)
    out[124:131] = b"V01.20 "
    put(131, "4I3H", 1, 1, 1, 1, 5000, 5100, 950)
    return bytes(out[1:])
