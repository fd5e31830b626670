"""A telegram to the words and numbers that a technician wants to read, ready for JSON."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import fields
from typing import Any

from polecal.drivers.errors import DeviceProtocolError
from polecal.drivers.sick_lms.configuration import (
    Configuration,
    ConfigurationRead,
    ConfigurationWritten,
    WriteConfiguration,
)
from polecal.drivers.sick_lms.framer import REPLY, Frame
from polecal.drivers.sick_lms.health import Errors, Status
from polecal.drivers.sick_lms.scans import MEASURING_MODES, SCAN_CODES, NoRange, Scan
from polecal.drivers.sick_lms.telegrams import (
    Configuration2,
    Counters,
    ModeSwitched,
    OperatingMode,
    Outputs,
    PermanentSet,
    PowerOn,
    Refused,
    RequestConfiguration,
    RequestConfiguration2,
    RequestCounters,
    RequestEnergy,
    RequestErrors,
    RequestMean,
    RequestOutputs,
    RequestS14,
    RequestStatus,
    RequestSubRange,
    RequestType,
    RequestValues,
    Reset,
    ResetBegun,
    SetPermanent,
    SwitchMode,
    SwitchVariant,
    Telegram,
    TypeText,
    VariantSwitched,
)

_CLASSES: dict[int, type[Telegram]] = {
    telegram.code: telegram
    for telegram in (
        Configuration2, ConfigurationRead, ConfigurationWritten, Counters, Errors, ModeSwitched, Outputs,
        PermanentSet, PowerOn, Refused, RequestConfiguration, RequestConfiguration2, RequestCounters,
        RequestEnergy, RequestErrors, RequestMean, RequestOutputs, RequestS14, RequestStatus,
        RequestSubRange, RequestType, RequestValues, Reset, ResetBegun, SetPermanent, Status, SwitchMode,
        SwitchVariant, TypeText, VariantSwitched, WriteConfiguration,
    )
}  # fmt: skip

# Sheet section 3: what is asked for, and with 80h added what the answer carries.
_SUBJECTS = {
    0x10: "reset",
    0x20: "operating mode",
    0x30: "measured values",
    0x31: "status",
    0x32: "error list",
    0x35: "operating data counters",
    0x36: "mean of measured values",
    0x37: "sub-range of measured values",
    0x3A: "type",
    0x3B: "variant",
    0x3E: "measured values with field values",
    0x3F: "mean of a sub-range of measured values",
    0x40: "write field",
    0x41: "switch field set",
    0x42: "change password",
    0x44: "measured values and reflectivity (S14)",
    0x45: "read field",
    0x46: "teach field",
    0x4A: "switching outputs",
    0x66: "permanent settings",
    0x69: "positioning aid",
    0x74: "read configuration part 1",
    0x75: "measured values and energy",
    0x76: "cartesian values",
    0x77: "write configuration part 1",
    0x7B: "read configuration part 2",
    0x7C: "write configuration part 2",
}
_MEANINGS = {0x90: "power-on string", 0x91: "reset begun", 0x92: "refused: not allowed in this mode"}


class Describer:
    """Describes telegrams in the order in which they came.

    How a value word is to be read, no measurement says: the measuring mode is learnt from the status and
    the configurations seen before, and is 01 (reflector levels) until then.
    """

    def __init__(self) -> None:
        self.measuring_mode = 0x01
        self.fov_deg: int | None = None
        self.resolution_deg: float | None = None

    def describe(self, frame: Frame) -> dict[str, Any]:
        """Return name, meaning and values, in SI units and degrees, of types that JSON has.

        What does not fit its layout has ``error`` in place of values.
        """
        code = frame.command
        described: dict[str, Any] = {
            "name": f"{code:02X}",
            "meaning": _MEANINGS.get(code) or _meaning(code),
            "from": "laser" if frame.address & REPLY else "host",
            "address": frame.address & ~REPLY,
            "crc_ok": True,
        }
        try:
            if code in SCAN_CODES:
                described |= self._scan(Scan.parse(frame))
            elif code in _CLASSES:
                telegram = _CLASSES[code].parse(frame)
                self._learn(telegram)
                described |= _values(telegram)
            else:
                described["data"] = frame.body[1:].hex(" ")
        except DeviceProtocolError as error:
            described["error"] = str(error)
            described["data"] = frame.body[1:].hex(" ")
        return described

    def _learn(self, telegram: Telegram) -> None:
        if isinstance(telegram, Status):
            self.measuring_mode = telegram.measuring_mode
            self.fov_deg, self.resolution_deg = telegram.fov_deg, telegram.resolution_cdeg / 100
        elif isinstance(telegram, ConfigurationRead) or (
            isinstance(telegram, ConfigurationWritten) and telegram.accepted
        ):
            self.measuring_mode = telegram.configuration.measuring_mode
        elif isinstance(telegram, VariantSwitched):
            self.fov_deg, self.resolution_deg = telegram.fov_deg, telegram.resolution_cdeg / 100

    def _scan(self, scan: Scan) -> dict[str, Any]:
        ranges_m, kind, reflectivity, flags = scan.decode(self.measuring_mode)
        kinds = kind.tolist()
        described: dict[str, Any] = {
            "count": scan.count,
            "unit_m": scan.unit_m,
            "measuring_mode": f"{self.measuring_mode:02X}",
            "partial": scan.partial,
            "scan_index": scan.scan_index,
            "telegram_index": scan.telegram_index,
            "status": f"{scan.status:02X}",
            "ranges_m": [None if math.isnan(r) else round(r, 3) for r in ranges_m.tolist()],
            "no_range": {
                NoRange(kind).name.lower(): kinds.count(kind) for kind in sorted(set(kinds)) if kind
            },
            "reflectivity": [None if math.isnan(r) else round(r, 6) for r in reflectivity.tolist()],
        }
        for bit, name in enumerate(() if scan.energy is not None else self._flags()):
            described[name] = [bool(flag >> bit & 1) for flag in flags.tolist()]
        if self.fov_deg and self.resolution_deg and self.fov_deg == (scan.count - 1) * self.resolution_deg:
            described |= {"fov_deg": self.fov_deg, "resolution_deg": self.resolution_deg}
        if scan.energy is not None:
            described["energy"] = scan.energy.tolist()
        if scan.spans:
            described["beams"] = [list(span) for span in scan.spans]
        if scan.mean_of is not None:
            described["mean_of"] = scan.mean_of
        return described

    def _flags(self) -> tuple[str, ...]:
        return MEASURING_MODES[self.measuring_mode].flags


def _meaning(code: int) -> str:
    if code & REPLY:
        subject = _SUBJECTS.get(code & ~REPLY)
        return subject or "unknown reply"
    subject = _SUBJECTS.get(code)
    return f"request: {subject}" if subject else "unknown request"


def _configuration(configuration: Configuration) -> dict[str, Any]:
    return {
        "configuration": configuration.data.hex(" "),
        "measuring_mode": f"{configuration.measuring_mode:02X}",
        "unit": ("cm", "mm")[configuration.unit] if configuration.unit < 2 else "reserved",
        "availability": configuration.availability,
        "sensitivity": configuration.sensitivity,
    }


# how a field's own type is shown
_SHOWN: tuple[tuple[type, Callable[[Any], Any]], ...] = (
    (OperatingMode, lambda mode: f"{mode:02X} {mode.name.lower()}"),
    (bytes, lambda data: data.hex(" ")),
    (tuple, list),
)


def _values(telegram: Telegram) -> dict[str, Any]:
    values: dict[str, Any] = {}
    for field in fields(telegram):  # type: ignore[arg-type]
        value = getattr(telegram, field.name)
        if isinstance(value, Configuration):
            values |= _configuration(value)
            continue
        if isinstance(telegram, Errors) and field.name == "faults":
            value = [fault.text for fault in telegram.faults]
        elif field.name in ("status", "measuring_mode"):
            value = f"{value:02X}"
        elif field.name == "resolution_cdeg":
            values["resolution_deg"] = value / 100
            continue
        for kind, shown in _SHOWN:
            if isinstance(value, kind):
                value = shown(value)
        values[field.name] = value
    if isinstance(telegram, Status):
        values |= {"baud": telegram.baud, "revolution_s": round(telegram.revolution_s, 6)}
    return values
