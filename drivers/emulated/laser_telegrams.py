"""The LMS2xx's telegrams as the device frames them, and its status reply: state in, bytes out.

Numbers are those of the protocol sheet; section numbers refer to it.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass, field, replace
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
    MEAN = 0x36
    SUB_RANGE = 0x37
    TYPE = 0x3A
    VARIANT = 0x3B
    MEAN_SUB_RANGE = 0x3F
    FIELD_SET = 0x41
    S14_REFLECTIVITY = 0x44
    OUTPUTS = 0x4A
    PERMANENT = 0x66
    READ_CONFIG = 0x74
    ENERGY = 0x75
    WRITE_CONFIG = 0x77
    READ_CONFIG_2 = 0x7B


POWER_ON = 0x90
RESET_DONE = 0x91
REJECTED = 0x92


class Mode(IntEnum):
    """Operating modes, the byte after 20h (section 3, 20h sub-modes)."""

    INSTALLATION = 0x00
    DIAGNOSTIC = 0x10
    MIN_ON_OBJECT = 0x21
    VERTICAL_ON_OBJECT = 0x23
    STREAM = 0x24
    REQUEST = 0x25
    STREAM_MEAN = 0x26
    STREAM_SUB_RANGE = 0x27
    STREAM_MEAN_SUB_RANGE = 0x28
    STREAM_PARTIAL = 0x2A
    STREAM_ENERGY = 0x2B
    STREAM_SEGMENTS = 0x2C
    STREAM_S14 = 0x50


BAUD_OF_SUB = {0x40: 38400, 0x41: 19200, 0x42: 9600, 0x48: 500000}
_BAUD_WORD = {500000: 0x8001, 38400: 0x8019, 19200: 0x8033, 9600: 0x8067}  # Section 3.1, offset 116
PASSWORD = b"SICK_LMS"

STATUS_OK = 0x10
"""Type 6, no error (section 1)."""
_RESTART, _IMPLAUSIBLE, _POLLUTED = 1 << 5, 1 << 6, 1 << 7
_PAST = 0x80  # added to an error's type

DEFAULT_CONFIG = bytes.fromhex(
    "0000 46 00 00 00 00 00 00 02 02 02 00 000A0A5064 000A0A5064 000A0A5064 00 00 0000 0200"
)
"""An LMS-291 as it left the factory: measuring mode 00, cm (section 3.2)."""

STREAM_CONFIG = DEFAULT_CONFIG[:4] + b"\x02\x01" + DEFAULT_CONFIG[6:]
"""Real-time indices on, measuring mode 01: reflectivity in bits 13 to 15."""

SENSITIVITY, AVAILABILITY, MEASURING_MODE, UNIT = 3, 4, 5, 6
EVALUATIONS, RESTART_MODE, RESTART_TIME = 9, 10, 11
"""Offsets in the configuration (section 3.2)."""
INDICES = 0x02  # availability bit 1


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
        """How many turns of the mirror a scan takes: each fires a 1° raster, the S14's a 0.5° one."""
        return 1 if self == S14_VARIANT else 100 // self.resolution_cdeg

    @property
    def angles_deg(self) -> NDArray[np.float64]:
        """Return each beam's angle in the laser's own half circle: 0 right, 90 ahead."""
        return (180 - self.angle_deg) / 2 + np.arange(self.beams) * self.resolution_cdeg / 100


S14_VARIANT = Variant(90, 50)
INTERLACED = Variant(100, 25)
"""To which a laser must be set before it streams partial scans (section 7)."""


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


_POLLUTION = (402, 282, 479, 667, 375, 273, 449, 326)
_REFERENCE_POLLUTION = (432, 338, 421, 402)


@dataclass(frozen=True, slots=True)
class Health:
    """How the device is, which no telegram of the host's changes; all of it is the emulation's to say."""

    errors: tuple[tuple[int, int], ...] = ()
    """(type, number): type 1 info to 4 fatal, 80h more once it is past (section 3.4)."""
    pollution: tuple[int, ...] = _POLLUTION
    """Eight channels; and four of reference."""
    reference_pollution: tuple[int, ...] = _REFERENCE_POLLUTION
    polluted: bool = False
    implausible: bool = False
    restart: bool = False

    @property
    def worst(self) -> int:
        """The gravest error that is not past: 0 none, 4 fatal."""
        return max((kind for kind, _ in self.errors if kind < _PAST), default=0)

    @property
    def status(self) -> int:
        """The status byte of every reply (section 1)."""
        return (
            STATUS_OK
            | self.worst
            | self.restart * _RESTART
            | self.implausible * _IMPLAUSIBLE
            | self.polluted * _POLLUTED
        )

    @property
    def after_reset(self) -> Health:
        """The same with every error past."""
        return replace(self, errors=tuple((kind | _PAST, number) for kind, number in self.errors))


def _put(out: bytearray, offset: int, layout: str, *numbers: int) -> None:
    struct.pack_into("<" + layout, out, offset, *numbers)


def _own_fields() -> bytes:
    out = bytearray(153)  # from the command byte on, so that offsets are the sheet's
    out[10:18] = b"00291291"
    _put(out, 43, "8H4H", *_POLLUTION, *_REFERENCE_POLLUTION)  # as calibrated
    _put(out, 71, "H", 62)
    _put(out, 75, "3H", 59, 54, 51)
    _put(out, 83, "9H", 100, 90, 120, 105, 240, 70, 160, 71, 162)
    _put(out, 103, "HH", 0x0A64, 0x0A62)
    _put(out, 123, "B", 1)
    out[124:131] = b"V01.20 "
    _put(out, 131, "4I3H", 1, 1, 1, 1, 5000, 5100, 950)
    return bytes(out[1:])


OWN_FIELDS = _own_fields()
"""What is one device's own in the 152 data bytes of B1: serial number, optics, calibration, boot PROM."""


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
    address: int = 0
    field_set: int = 0
    health: Health = field(default_factory=Health)


def status_data(f: StatusFields, own: bytes = OWN_FIELDS) -> bytes:
    """Return the 152 data bytes of B1, without the status byte that ends them (section 3.1).

    ``own`` is the same of the individual device; what follows from the state is written over it.
    """
    out = bytearray(b"\xb1" + own)
    out[1:8] = f.version.encode("ascii").ljust(7)[:7]
    _put(out, 8, "BB", f.mode, f.health.worst)
    _put(out, 19, "8H4H", *f.health.pollution, *f.health.reference_pollution)
    _put(out, 67, "H", f.motor_us)
    _put(out, 102, "B", f.config[MEASURING_MODE])
    _put(out, 107, "HH", f.variant.angle_deg, f.variant.resolution_cdeg)
    _put(out, 111, "BH", f.config[RESTART_MODE], f.config[RESTART_TIME])
    _put(out, 116, "H", _BAUD_WORD[f.baud])
    _put(out, 118, "5B", f.config[EVALUATIONS], f.permanent_baud, f.address, f.field_set, f.config[UNIT])
    return bytes(out[1:])
