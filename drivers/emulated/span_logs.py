"""A SPAN receiver's logs: a table of names, numbers and layouts; values to binary, ASCII or abbreviated.

A layout says of each value, in order, its name and its kinds: ``position:d11,d11,d4 velocity:3d4``. A kind is
a wire type and how ASCII prints it; several kinds take a sequence of values; kinds in brackets take any
number of such sequences, after their count. Sheet, section 2.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from enum import Enum, IntEnum
from typing import Any, NamedTuple

from polecal.drivers.emulated import span_enums as enums
from polecal.drivers.emulated import span_frames as span
from polecal.drivers.emulated.span_frames import Stamp


class Form(Enum):
    """How a log is written; the value is the format in bits 5 and 6 of a message type (section 1.2)."""

    BINARY = 0
    ASCII = 1
    ABBREVIATED = 2


SUFFIXES = {"B": Form.BINARY, "A": Form.ASCII, "": Form.ABBREVIATED}


class Paced(Enum):
    """What makes a log new."""

    EPOCH = "solutions, at their own pace or at any slower one"
    IMU = "samples of the IMU: never ONTIME"
    CHANGE = "changes of what it says"
    EVENT = "events: only ONNEW"


class Kind(NamedTuple):
    """A wire type and its text."""

    code: str
    text: Callable[[Any], str]


def _clock(value: float) -> str:
    return f"{value:.9f}" if value == 0 or abs(value) >= 1e-6 else f"{value:.9e}"  # as TIMEA prints them


def _single(digits: int) -> Kind:
    one = struct.Struct("<f")
    return Kind("f", lambda value: f"{one.unpack(one.pack(value))[0]:.{digits}f}")  # as the wire holds it


def _named(names: type[IntEnum]) -> Kind:
    return Kind("I", lambda value: names(value).name)


def _quoted(value: str) -> str:
    return f'"{value}"'


_KINDS = {
    "u": Kind("I", str),
    "i": Kind("i", str),
    "h": Kind("H", str),
    "b": Kind("B", str),
    "x2": Kind("B", "{:02x}".format),
    "x": Kind("I", "{:08x}".format),
    "e9": Kind("d", _clock),
    "ins": _named(enums.InsStatus),
    "sol": _named(enums.SolStatus),
    "pos": _named(enums.PosType),
    "time": _named(enums.TimeStatus),
    "clock": _named(enums.ClockStatus),
    "utc": _named(enums.UtcStatus),
    "datum": _named(enums.Datum),
    "component": _named(enums.Component),
    "word": _named(enums.EventWord),
    "event": _named(enums.EventType),
    "imu": _named(enums.ImuType),
    "profile": _named(enums.Profile),
    "align": _named(enums.AlignmentMode),
    "relins": _named(enums.RelIns),
    "offset": _named(enums.Offset),
    "frame": _named(enums.OffsetFrame),
    "source": _named(enums.Source),
    "bool": _named(enums.Bool),
    **{f"d{n}": Kind("d", f"{{:.{n}f}}".format) for n in (4, 6, 9, 11, 16)},
    **{f"f{n}": _single(n) for n in (1, 3, 4, 9)},
    **{f"s{n}": Kind(f"{n}s", _quoted) for n in (4, 12, 16, 32)},
}

Row = tuple[int, list[tuple[Kind, Any]]]
"""The depth of a line of abbreviated ASCII, and what is on it."""


class _Part(NamedTuple):
    name: str
    kinds: tuple[Kind, ...]
    group: bool


def _part(text: str) -> _Part:
    name, _, kinds = text.partition(":")
    group = kinds.startswith("[")
    each = [re.fullmatch(r"(\d*)(\w+)", kind) for kind in kinds.strip("[]").split(",")]
    return _Part(name, tuple(_KINDS[m[2]] for m in each if m for _ in range(int(m[1] or 1))), group)


@dataclass(frozen=True, slots=True)
class Log:
    """A log's number, its layout, the CRC of its definition (section 2.4), and when it comes."""

    message_id: int
    layout: str
    definition: int = 0
    fastest_ms: int = 50
    natural_ms: int = 1000
    """How often there is something new, for ONNEW."""
    paced: Paced = Paced.EPOCH
    of: str = "467"
    """The generations that have it (`span_generations`)."""
    ins: bool = False
    """It needs inertial data."""
    increments: bool = False
    """It says what the IMU summed up since a moment."""
    short: bool = False
    """It has the short header."""
    parts: tuple[_Part, ...] = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "parts", tuple(_part(text) for text in self.layout.split()))

    def rows(self, values: object) -> list[Row]:
        """Take the layout's values from an object's attributes."""
        rows: list[Row] = [(1, [])]
        for name, kinds, group in self.parts:
            value = getattr(values, name)
            if group:
                rows[-1][1].append((_KINDS["u"], len(value)))
                rows += [(2, list(zip(kinds, item, strict=True))) for item in value]
                rows.append((1, []))
            elif len(kinds) > 1:
                rows[-1][1].extend(zip(kinds, value, strict=True))
            else:
                rows[-1][1].append((kinds[0], value))
        return [row for row in rows if row[1]]

    def frame(
        self,
        name: str,
        values: object,
        stamp: Stamp,
        *,
        form: Form = Form.BINARY,
        definition: int | None = None,
    ) -> bytes:
        """Return the log as it goes onto the line."""
        rows = self.rows(values)
        definition = self.definition if definition is None else definition
        if form is Form.BINARY:
            body = _packed([pair for _, pairs in rows for pair in pairs])
            if self.short:
                return span.short_frame(self.message_id, body, stamp)
            return span.long_frame(self.message_id, body, stamp, definition=definition)
        said = [(depth, [kind.text(value) for kind, value in pairs]) for depth, pairs in rows]
        if form is Form.ASCII:
            fields = [text for _, texts in said for text in texts]
            return span.ascii_line(name + "A", fields, stamp, definition=definition, short=self.short)
        return span.abbreviated_lines(name, said, stamp, definition=definition, short=self.short)


def _packed(pairs: Sequence[tuple[Kind, Any]]) -> bytes:
    code = "<" + "".join(kind.code for kind, _ in pairs)
    return struct.pack(code, *(v.encode() if isinstance(v, str) else v for _, v in pairs))


_INS_TIME = "week:u seconds:d9"
_POSITION = "d11,d11,d4"
_INSPVA = f"{_INS_TIME} position:{_POSITION} velocity:3d4 attitude:3d9 ins_status:ins"
_INSPVAX = (
    f"ins_status:ins ins_type:pos position_msl:{_POSITION} undulation:f4 velocity:3d4 attitude:3d9 sigma:9f4 "
    "extended:x update_age:h"
)
_INSATT = f"{_INS_TIME} attitude:3d9 ins_status:ins"
_INSATTX = "ins_status:ins ins_type:pos attitude:3d9 sigma_attitude:3f4 extended:x update_age:h"
_INSPOS = f"{_INS_TIME} position:{_POSITION} ins_status:ins"
_INSVEL = f"{_INS_TIME} velocity:3d4 ins_status:ins"
_INSCOV = f"{_INS_TIME} cov_position:9d16 cov_attitude:9d16 cov_velocity:9d16"
_INSSTDEV = "sigma:9f4 extended:x update_age:h zero:h updates:x zero:u"
_BESTPOS = (
    f"sol_status:sol {{}}:pos antenna_msl:{_POSITION} undulation:f4 datum:datum sigma_antenna:3f4 station:s4 "
    "ages:2f3 satellites:4b signals:4x2"
)
_BESTVEL = "sol_status:sol vel_type:pos vel_latency:f3 vel_age:f3 course:d4,d6,d4 zero:u"
_TIME = "clock:clock clock_offset:2e9 utc_offset:d11 utc:u,4b,u utc_status:utc"
_MARKTIME = "mark:i,d9 clock_offset:2e9 utc_offset:d9 clock:clock"
_RAWIMU = "week:u seconds:d6 imu_status:x counts:6i"
_RAWIMUX = "imu_info:x2 imu_type:b week:h seconds:d6 imu_status:x counts:6i"
_CORRIMUDATA = f"{_INS_TIME} increment:6d16"
_HEADING2 = (
    "sol_status:sol gnss_type:pos baseline:3f9 zero:f1 sigma_baseline:2f9 station:s4 station:s4 "
    "satellites:4b signals:4x2"
)
_INSCONFIG = (
    "config:imu,2b,h,profile,x,align,relins,bool,x,2b,h,u,x,4u translations:[offset,frame,6f4,source] "
    "rotations:[offset,frame,6f4,source]"
)
_VERSION = "versions:[component,5s16,2s12]"


def _ins(
    message_id: int,
    layout: str,
    definition: int = 0,
    *,
    short: bool = False,
    of: str = "467",
    fastest_ms: int = 5,
    natural_ms: int = 10,
) -> Log:
    return Log(message_id, layout, definition, fastest_ms, natural_ms, of=of, ins=True, short=short)


def _imu(message_id: int, layout: str, *, short: bool = False, of: str = "467") -> Log:
    return Log(message_id, layout, short=short, of=of, paced=Paced.IMU, ins=True, increments=True)


def _mark(message_id: int, of: str) -> Log:
    return Log(message_id, _MARKTIME, 0x292E, paced=Paced.EVENT, of=of)


LOGS: dict[str, Log] = {
    # In the order in which a receiver sends the logs of one epoch (section 10, item 7)
    "RXSTATUSEVENT": Log(94, "event:word,u,event,s32", 0xB967, paced=Paced.EVENT),
    "MARKTIME": _mark(231, "467"),
    "MARK1TIME": _mark(1130, "67"),
    "MARK2TIME": _mark(616, "467"),
    "BESTPOS": Log(42, _BESTPOS.format("best_type"), 0xCDBA, natural_ms=200),
    "BESTGPSPOS": Log(423, _BESTPOS.format("gnss_type"), natural_ms=200, of="4"),
    "BESTGNSSPOS": Log(1429, _BESTPOS.format("gnss_type"), natural_ms=200, of="67"),
    "BESTVEL": Log(99, _BESTVEL, natural_ms=200),
    "HEADING2": Log(1335, _HEADING2, 0x1684, natural_ms=200, of="67"),
    "TIME": Log(101, _TIME, 0x9924),
    "TIMESYNC": Log(492, "gps_week:u gps_ms:u time_status:time", 0xBD3F),
    "RXSTATUS": Log(93, "error:x words:[4x]", 0x2AE1, paced=Paced.CHANGE),
    "VERSION": Log(37, _VERSION, 0x3681, paced=Paced.CHANGE),
    "INSCONFIG": Log(1945, _INSCONFIG, 0xBBA4, paced=Paced.CHANGE, of="7"),
    "VEHICLEBODYROTATION": Log(642, "rotation:3d4 sigma_rotation:3d4", paced=Paced.CHANGE, of="46"),
    "RAWIMU": _imu(268, _RAWIMU),
    "RAWIMUS": _imu(325, _RAWIMU, short=True),
    "RAWIMUX": _imu(1461, _RAWIMUX, of="67"),
    "RAWIMUSX": _imu(1462, _RAWIMUX, short=True, of="67"),
    "CORRIMUDATA": Log(812, _CORRIMUDATA, 0xBDBA, 5, 10, ins=True, increments=True),
    "CORRIMUDATAS": Log(813, _CORRIMUDATA, 0, 5, 10, ins=True, increments=True, short=True),
    "INSCOV": _ins(264, _INSCOV, 0x4B7B, fastest_ms=50, natural_ms=1000),
    "INSCOVS": _ins(320, _INSCOV, short=True, fastest_ms=50, natural_ms=1000),
    "INSSTDEV": _ins(2051, _INSSTDEV, 0x2396, of="7", fastest_ms=50, natural_ms=1000),
    "INSSTDEVS": _ins(2052, _INSSTDEV, short=True, of="7", fastest_ms=50, natural_ms=1000),
    "INSPVAX": _ins(1465, _INSPVAX, 0x46EB, of="67"),
    "INSPVA": _ins(507, _INSPVA, 0x18BC),
    "INSPVAS": _ins(508, _INSPVA, short=True),
    "INSATT": _ins(263, _INSATT, 0xC6A7),
    "INSATTS": _ins(319, _INSATT, short=True),
    "INSATTX": _ins(1457, _INSATTX, of="67"),
    "INSPOS": _ins(265, _INSPOS),
    "INSPOSS": _ins(321, _INSPOS, short=True),
    "INSVEL": _ins(267, _INSVEL),
    "INSVELS": _ins(324, _INSVEL, short=True),
}
NAME_OF_ID = {log.message_id: name for name, log in LOGS.items()}
ORDER = {name: i for i, name in enumerate(LOGS)}


def named(message: str) -> tuple[str, Form] | None:
    """Return the log and its form that a command's message name means, or None."""
    if message in LOGS:
        return message, Form.ABBREVIATED
    form = SUFFIXES.get(message[-1:])
    return (message[:-1], form) if form is not None and message[:-1] in LOGS else None
