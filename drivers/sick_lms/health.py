"""What the laser says of itself (B1h, B2h) to fields, and to the maker's words for what is wrong."""

from __future__ import annotations

import struct
from dataclasses import dataclass

from polecal.drivers.sick_lms.telegrams import Reply, Severity

# Sheet section 3.1, offsets 1 to 152 in its order; the 146 byte form has a word where the serial number is.
_LAYOUT = """
software 7s  operating_mode B  defect B  serial 8s  variant_type B
pollution 8H  reference_pollution 4H  pollution_calibration 8H  reference_pollution_calibration 4H
motor H  reserved_a H  dark_100_scale_1 H  reserved_b H  dark_100_scale_2 H
dark_66_scale_1 H  reserved_c H  dark_66_scale_2 H
laser_power_percent H  laser_power_angle H  peak_threshold H  peak_angle H  calibration_amplitude H
stop_target H  peak_target H  stop_actual H  peak_actual H  reserved_d B  measuring_mode B
reference_single H  reference_mean H  fov_deg H  resolution_cdeg H
restart_mode B  restart_time H  evaluation_offset b  reserved_e B  baud_word H
evaluations B  permanent_baud B  address B  field_set B  unit B  laser_on B  boot_prom 7s
calibration 4I  counter_m0 2H  calibration_interval_ns H
"""
_FORMS = {
    size: [(name, struct.Struct("<" + form)) for name, form in zip(words[::2], words[1::2], strict=True)]
    for size, words in ((152, _LAYOUT.split()), (146, _LAYOUT.replace("8s", "2s").split()))
}
_BAUD_WORDS = {0x8001: 500000, 0x8019: 38400, 0x8033: 19200, 0x8067: 9600}
_MOTOR_STEPS = 90  # the motor word is the time of 1/90 revolution, us


@dataclass(frozen=True, slots=True)
class Status(Reply):
    """B1h, every field of the table; numbers as the laser has them."""

    code = 0xB1
    software: str
    operating_mode: int
    defect: int
    serial: str
    variant_type: int
    pollution: tuple[int, ...]
    reference_pollution: tuple[int, ...]
    pollution_calibration: tuple[int, ...]
    reference_pollution_calibration: tuple[int, ...]
    motor: int
    reserved_a: int
    dark_100_scale_1: int
    reserved_b: int
    dark_100_scale_2: int
    dark_66_scale_1: int
    reserved_c: int
    dark_66_scale_2: int
    laser_power_percent: int
    laser_power_angle: int
    peak_threshold: int
    peak_angle: int
    calibration_amplitude: int
    stop_target: int
    peak_target: int
    stop_actual: int
    peak_actual: int
    reserved_d: int
    measuring_mode: int
    reference_single: int
    reference_mean: int
    fov_deg: int
    resolution_cdeg: int
    restart_mode: int
    restart_time: int
    evaluation_offset: int
    reserved_e: int
    baud_word: int
    evaluations: int
    permanent_baud: int
    address: int
    field_set: int
    unit: int
    laser_on: int
    boot_prom: str
    calibration: tuple[int, ...]
    counter_m0: tuple[int, ...]
    calibration_interval_ns: int

    @property
    def baud(self) -> int | None:
        """The line's rate, bit/s; None for a word that the sheet does not have."""
        return _BAUD_WORDS.get(self.baud_word)

    @property
    def revolution_s(self) -> float:
        """How long one revolution of the mirror takes."""
        return self.motor * _MOTOR_STEPS * 1e-6

    @classmethod
    def _fields(cls, data: bytes) -> tuple[object, ...]:
        if len(data) not in _FORMS:
            raise ValueError(f"a status of {len(data)} bytes")
        values: list[object] = []
        at = 0
        for _, form in _FORMS[len(data)]:
            several = form.unpack_from(data, at)
            at += form.size
            one = several[0] if len(several) == 1 else several
            values.append(one.decode("latin-1") if isinstance(one, bytes) else one)
        return tuple(values)

    def _data(self) -> bytes:
        packed = b""
        for name, form in _FORMS[152 if len(self.serial) == 8 else 146]:
            value = getattr(self, name)
            value = value.encode("latin-1") if isinstance(value, str) else value
            packed += form.pack(*value) if isinstance(value, tuple) else form.pack(value)
        return packed


_PAST = 0x80
_TEXTS = {  # sheet section 3.4
    **dict.fromkeys(range(17, 23), "window pollution"),
    22: "reference channel pollution",
    29: "motor speed",
    45: "missing measured value",
    46: "missing scan",
    49: "laser power",
    53: "FLASH written",
    56: "watchdog",
    57: "no zero index",
    **dict.fromkeys(range(58, 62), "synchronisation"),
    62: "DIP switch",
}


@dataclass(frozen=True, slots=True)
class Fault:
    """One entry of the error list; ``past`` where it is no longer so."""

    severity: int
    number: int
    past: bool

    @property
    def text(self) -> str:
        """What it says, in the maker's words where the sheet has them."""
        words = _TEXTS.get(self.number, "not in the sheet")
        severity = next((s.name.lower() for s in Severity if s == self.severity), f"type {self.severity}")
        return f"{severity} {self.number}: {words}" + (" (past)" if self.past else "")


@dataclass(frozen=True, slots=True)
class Errors(Reply):
    """B2h: the error list, as (type, number) pairs."""

    code = 0xB2
    faults: tuple[Fault, ...]

    @classmethod
    def _fields(cls, data: bytes) -> tuple[object, ...]:
        pairs = zip(data[::2], data[1::2], strict=True)
        return (tuple(Fault(kind & ~_PAST, number, bool(kind & _PAST)) for kind, number in pairs),)

    def _data(self) -> bytes:
        return bytes(byte for f in self.faults for byte in (f.severity | f.past * _PAST, f.number))
