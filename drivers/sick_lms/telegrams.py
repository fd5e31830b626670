"""Requests to the laser and its short replies as frozen classes, each to and from its bytes (sheet 3).

Measurements are in scans.py, the status and error lists in health.py, the configuration in
configuration.py: all of them have the same `parse` and `build`.
"""

from __future__ import annotations

import struct
from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from enum import IntEnum
from typing import ClassVar, Self

from polecal.drivers.errors import DeviceProtocolError
from polecal.drivers.sick_lms.crc import crc16
from polecal.drivers.sick_lms.framer import REPLY, STX, Frame

HOST = 0x00
"""Broadcast: every laser on the line answers."""
PASSWORD = b"SICK_LMS"
STATUS_OK = 0x10  # type 6, no error: what the laser says in most replies


def build(command_and_data: bytes, address: int = HOST) -> bytes:
    """Put STX, address, length and CRC around a command (or reply) and its data."""
    head = struct.pack("<BBH", STX, address, len(command_and_data))
    return head + command_and_data + struct.pack("<H", crc16(head + command_and_data))


class Severity(IntEnum):
    """Bits 2:0 of every status byte, and the types of the error list."""

    OK = 0
    INFO = 1
    WARNING = 2
    ERROR = 3
    FATAL = 4


IMPLAUSIBLE = 0x40  # status byte, sheet section 1
POLLUTED = 0x80


class OperatingMode(IntEnum):
    """Sub byte of 20h, and what the status says is the mode (sheet section 3)."""

    INSTALLATION = 0x00
    CALIBRATION = 0x01
    PASSWORD_RESET = 0x02
    DIAGNOSTIC = 0x10
    MINIMA_PER_SEGMENT = 0x20
    MINIMA_ON_OBJECT = 0x21
    VERTICAL_MINIMUM = 0x22
    VERTICAL_MINIMUM_ON_OBJECT = 0x23
    STREAM = 0x24
    ON_REQUEST = 0x25
    STREAM_MEAN = 0x26
    STREAM_SUB_RANGE = 0x27
    STREAM_MEAN_SUB_RANGE = 0x28
    STREAM_WITH_FIELDS = 0x29
    STREAM_INTERLACED = 0x2A
    STREAM_ENERGY = 0x2B
    STREAM_MINIMA_SUB_RANGE = 0x2C
    STREAM_NAVIGATION = 0x2E
    TEST = 0x30
    BAUD_38400 = 0x40
    BAUD_19200 = 0x41
    BAUD_9600 = 0x42
    BAUD_500000 = 0x48
    STREAM_S14 = 0x50


BAUD_MODES = {
    9600: OperatingMode.BAUD_9600,
    19200: OperatingMode.BAUD_19200,
    38400: OperatingMode.BAUD_38400,
    500000: OperatingMode.BAUD_500000,
}


class Values(IntEnum):
    """Sub byte of 30h: which values are asked for."""

    ALL = 0x01
    VERTICAL = 0x02
    TAUGHT = 0x03
    EVERY_2ND = 0x06
    EVERY_20TH = 0x07
    INTERLACED = 0x08


class Permanent(IntEnum):
    """Sub byte of 66h: what the laser does at power-on; kept in its EEPROM."""

    BAUD_9600 = 0x00
    THIS_BAUD = 0x01
    THIS_VARIANT = 0x02


class Telegram(ABC):
    """What every telegram class has in common."""

    code: ClassVar[int]

    @classmethod
    def parse(cls, frame: Frame) -> Self:
        """Read the telegram. Raises DeviceProtocolError if it is another, or its data do not fit it."""
        body = frame.body
        if body[0] != cls.code:
            raise DeviceProtocolError(f"telegram {body[0]:02X} where {cls.code:02X} is wanted")
        try:
            return cls._unpack(body[1:])
        except (ValueError, IndexError, struct.error) as error:
            raise DeviceProtocolError(
                f"telegram {body[0]:02X} of {len(body)} bytes does not read as {cls.__name__}: {error}"
            ) from error

    @classmethod
    @abstractmethod
    def _unpack(cls, data: bytes) -> Self:
        """Read the data behind the command byte. Raises ValueError, IndexError or struct.error."""

    @abstractmethod
    def _pack(self) -> bytes: ...

    def build(self, address: int | None = None) -> bytes:
        """Return the whole telegram; without an address, to all lasers or from the one at address 0."""
        if address is None:
            address = HOST | self.code & REPLY
        return build(bytes((self.code,)) + self._pack(), address)


@dataclass(frozen=True, slots=True)
class Bare(Telegram):
    """A request without data."""

    @classmethod
    def _unpack(cls, data: bytes) -> Self:
        if data:
            raise ValueError(f"{len(data)} bytes of data where none belong")
        return cls()

    def _pack(self) -> bytes:
        return b""


class Reset(Bare):
    """10h: restart the laser; it answers 91h, then 90h within a minute."""

    __slots__ = ()
    code = 0x10


class RequestStatus(Bare):
    """31h, answered by B1h."""

    __slots__ = ()
    code = 0x31


class RequestErrors(Bare):
    """32h, answered by B2h."""

    __slots__ = ()
    code = 0x32


class RequestCounters(Bare):
    """35h, answered by B5h."""

    __slots__ = ()
    code = 0x35


class RequestType(Bare):
    """3Ah, answered by BAh."""

    __slots__ = ()
    code = 0x3A


class RequestOutputs(Bare):
    """4Ah, answered by CAh."""

    __slots__ = ()
    code = 0x4A


class RequestConfiguration(Bare):
    """74h, answered by F4h."""

    __slots__ = ()
    code = 0x74


class RequestConfiguration2(Bare):
    """7Bh, answered by FBh."""

    __slots__ = ()
    code = 0x7B


@dataclass(frozen=True, slots=True)
class SwitchMode(Telegram):
    """20h: change the operating mode or the baud rate; answered by A0h."""

    code = 0x20
    mode: OperatingMode
    argument: bytes = b""

    @classmethod
    def installation(cls) -> Self:
        """Return the request for installation mode, with the factory's password."""
        return cls(OperatingMode.INSTALLATION, PASSWORD)

    @classmethod
    def _unpack(cls, data: bytes) -> Self:
        return cls(OperatingMode(data[0]), data[1:])

    def _pack(self) -> bytes:
        return bytes((self.mode,)) + self.argument


@dataclass(frozen=True, slots=True)
class RequestValues(Telegram):
    """30h: one scan; answered by B0h."""

    code = 0x30
    values: Values = Values.ALL

    @classmethod
    def _unpack(cls, data: bytes) -> Self:
        (values,) = data
        return cls(Values(values))

    def _pack(self) -> bytes:
        return bytes((self.values,))


@dataclass(frozen=True, slots=True)
class RequestMean(Telegram):
    """36h: the mean of 2 to 250 scans; answered by B6h."""

    code = 0x36
    scans: int

    @classmethod
    def _unpack(cls, data: bytes) -> Self:
        (scans,) = data
        return cls(scans)

    def _pack(self) -> bytes:
        return bytes((self.scans,))


@dataclass(frozen=True, slots=True)
class RequestSubRange(Telegram):
    """37h: one scan from beam ``first`` to ``last``, counted from 1; answered by B7h."""

    code = 0x37
    first: int
    last: int

    @classmethod
    def _unpack(cls, data: bytes) -> Self:
        return cls(*struct.unpack("<2H", data))

    def _pack(self) -> bytes:
        return struct.pack("<2H", self.first, self.last)


class RequestS14(RequestSubRange):
    """44h: one scan, with the reflectivity of beams ``first`` to ``last``; answered by C4h, S14 only."""

    __slots__ = ()
    code = 0x44


@dataclass(frozen=True, slots=True)
class SwitchVariant(Telegram):
    """3Bh: field of view, degrees, and resolution, 1/100 degree; answered by BBh."""

    code = 0x3B
    fov_deg: int
    resolution_cdeg: int

    @classmethod
    def _unpack(cls, data: bytes) -> Self:
        return cls(*struct.unpack("<2H", data))

    def _pack(self) -> bytes:
        return struct.pack("<2H", self.fov_deg, self.resolution_cdeg)


@dataclass(frozen=True, slots=True)
class SetPermanent(Telegram):
    """66h: what is kept over power-off, in the EEPROM; answered by E6h."""

    code = 0x66
    what: Permanent

    @classmethod
    def _unpack(cls, data: bytes) -> Self:
        (what,) = data
        return cls(Permanent(what))

    def _pack(self) -> bytes:
        return bytes((self.what,))


@dataclass(frozen=True, slots=True)
class RequestEnergy(Telegram):
    """75h: one scan with the received energy of one to five spans of beams; answered by F5h, not S14."""

    code = 0x75
    spans: tuple[tuple[int, int], ...]

    @classmethod
    def _unpack(cls, data: bytes) -> Self:
        count, *numbers = struct.unpack(f"<{len(data) // 2}H", data)
        if len(numbers) != 2 * count:
            raise ValueError(f"{len(numbers)} beam numbers for {count} spans")
        return cls(tuple(zip(numbers[::2], numbers[1::2], strict=True)))

    def _pack(self) -> bytes:
        return energy_spans(*self.spans)


def energy_spans(*spans: tuple[int, int]) -> bytes:
    """Spans of beams as 75h and 20h 2Bh want them."""
    return struct.pack("<H", len(spans)) + b"".join(struct.pack("<2H", *span) for span in spans)


@dataclass(frozen=True, slots=True)
class Reply(Telegram):
    """A reply, which ends in the status byte."""

    status: int = field(default=STATUS_OK, kw_only=True)

    @classmethod
    def _unpack(cls, data: bytes) -> Self:
        return cls(*cls._fields(data[:-1]), status=data[-1])

    @classmethod
    def _fields(cls, data: bytes) -> tuple[object, ...]:
        if data:
            raise ValueError(f"{len(data)} bytes of data where none belong")
        return ()

    def _pack(self) -> bytes:
        return self._data() + bytes((self.status,))

    def _data(self) -> bytes:
        return b""


class ResetBegun(Reply):
    """91h: the laser restarts now."""

    __slots__ = ()
    code = 0x91


class Refused(Reply):
    """92h: well formed, but unknown or not allowed in this mode."""

    __slots__ = ()
    code = 0x92


@dataclass(frozen=True, slots=True)
class TypeText(Reply):
    """BAh: ``type;ident;version``, e.g. ``LMS291;S05;V02.30``."""

    code = 0xBA
    text: str

    @classmethod
    def _fields(cls, data: bytes) -> tuple[object, ...]:
        return (data.decode("latin-1"),)

    def _data(self) -> bytes:
        return self.text.encode("latin-1")


class PowerOn(TypeText):
    """90h: the laser has just been powered, or reset; it says its type unasked."""

    __slots__ = ()
    code = 0x90


@dataclass(frozen=True, slots=True)
class ModeSwitched(Reply):
    """A0h: 0 done, 1 refused (wrong password, or a fault), 2 fault of the interface."""

    code = 0xA0
    result: int

    @classmethod
    def _fields(cls, data: bytes) -> tuple[object, ...]:
        (result,) = data
        return (result,)

    def _data(self) -> bytes:
        return bytes((self.result,))


@dataclass(frozen=True, slots=True)
class Counters(Reply):
    """B5h: operating time and how often it was powered."""

    code = 0xB5
    hours: int
    power_ons: int

    @classmethod
    def _fields(cls, data: bytes) -> tuple[object, ...]:
        pairs_of_hours, power_ons = struct.unpack("<2H", data)
        return pairs_of_hours * 2, power_ons

    def _data(self) -> bytes:
        return struct.pack("<2H", self.hours // 2, self.power_ons)


@dataclass(frozen=True, slots=True)
class VariantSwitched(Reply):
    """BBh: whether the variant was taken, and the one now in force."""

    code = 0xBB
    accepted: bool
    fov_deg: int
    resolution_cdeg: int

    @classmethod
    def _fields(cls, data: bytes) -> tuple[object, ...]:
        result, fov_deg, resolution_cdeg = struct.unpack("<B2H", data)
        return result == 1, fov_deg, resolution_cdeg

    def _data(self) -> bytes:
        return struct.pack("<B2H", self.accepted, self.fov_deg, self.resolution_cdeg)


@dataclass(frozen=True, slots=True)
class Outputs(Reply):
    """CAh: the state of the switching outputs A, B and C."""

    code = 0xCA
    a: int
    b: int
    c: int

    @classmethod
    def _fields(cls, data: bytes) -> tuple[object, ...]:
        a, b, c = data
        return a, b, c

    def _data(self) -> bytes:
        return bytes((self.a, self.b, self.c))


@dataclass(frozen=True, slots=True)
class PermanentSet(Reply):
    """E6h: whether 66h was carried out, and what is now kept."""

    code = 0xE6
    result: int
    value: int

    @classmethod
    def _fields(cls, data: bytes) -> tuple[object, ...]:
        result, value = data
        return result, value

    def _data(self) -> bytes:
        return bytes((self.result, self.value))


@dataclass(frozen=True, slots=True)
class Configuration2(Reply):
    """FBh: configuration part 2 as the laser keeps it (84 bytes, 4 in old firmware)."""

    code = 0xFB
    data: bytes

    @classmethod
    def _fields(cls, data: bytes) -> tuple[object, ...]:
        return (data,)

    def _data(self) -> bytes:
        return self.data
