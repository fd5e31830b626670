"""A request for measured values to what is measured for it and how its telegram packs that (sheet, 4)."""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from polecal.drivers.emulated.laser_telegrams import (
    INTERLACED,
    MEASURING_MODE,
    REPLY,
    UNIT,
    Command,
    Mode,
    Variant,
)
from polecal.drivers.emulated.laser_types import LaserType
from polecal.drivers.emulated.laser_values import (
    ENERGY_MODES,
    IN_RANGE,
    Beams,
    Words,
    energy_words,
    reflectivity_bytes,
    value_words,
)

_MEAN_OF = range(2, 251)
_MAX_BYTES = 812  # of a telegram without its indices (section 1)
_MAX_RANGES = 5  # of energy in one telegram


@dataclass(frozen=True, slots=True)
class Setting:
    """What decides which values can be had."""

    kind: LaserType
    variant: Variant
    config: bytes


@dataclass(frozen=True, slots=True)
class Output:
    """A telegram of measured values: its code, its data of a scan without indices, what it is made of."""

    command: Command
    pack: Callable[[Beams, bytes, int], bytes]
    """Of a scan, the configuration, and the header bits of a partial scan."""
    scans: int = 1
    partial: bool = False

    @property
    def code(self) -> int:
        """The reply's code."""
        return self.command + REPLY


_Maker = Callable[[bytes, Setting], Output | None]


def requested(command: int, data: bytes, setting: Setting) -> Output | None:
    """Return what a host asks for once; None where the laser cannot or the request is malformed."""
    if command in setting.kind.cannot:
        return None
    return _MAKERS[Command(command)](data, setting)


def streamed(data: bytes, setting: Setting) -> Output | None:
    """Return what the mode of a 20h telegram's data sends unasked; None as above."""
    if data[0] == Mode.STREAM_SEGMENTS:
        return _segments(data[1:], setting)
    if data[0] == Mode.STREAM_PARTIAL and setting.variant != INTERLACED:
        return None
    same = _REQUEST_OF.get(data[0])
    return requested(same[0], same[1:] + data[1:], setting) if same else None


def _numbers(layout: str, data: bytes) -> tuple[int, ...] | None:
    fits = len(data) == struct.calcsize("<" + layout)
    return struct.unpack("<" + layout, data) if fits else None


def _header(words: Words, config: bytes, partial: int = 0) -> bytes:
    return struct.pack("<H", len(words) | config[UNIT] << 14 | partial) + words.tobytes()


def _values(data: bytes, setting: Setting) -> Output | None:
    """B0: 30h's 01 all, 06 every second, 07 every twentieth, 08 one partial scan."""
    steps = {b"\x01": 1, b"\x06": 2, b"\x07": 20, b"\x08": 1}
    partial = data == b"\x08"
    if data not in steps or (partial and INTERLACED not in setting.kind.variants):
        return None
    step = steps[data]
    return Output(
        Command.VALUES,
        lambda beams, config, bits: _header(value_words(beams, config)[::step], config, bits),
        partial=partial,
    )


def _mean(data: bytes, _: Setting) -> Output | None:
    if len(data) != 1 or data[0] not in _MEAN_OF:
        return None
    return Output(
        Command.MEAN,
        lambda beams, config, _: data + _header(value_words(beams, config), config),
        scans=data[0],
    )


def _sub_range(data: bytes, setting: Setting) -> Output | None:
    ends = _numbers("HH", data)
    if ends is None or not _within(ends, setting):
        return None
    first, last = ends
    return Output(
        Command.SUB_RANGE,
        lambda beams, config, _: data + _header(value_words(beams, config)[first - 1 : last], config),
    )


def _mean_sub_range(data: bytes, setting: Setting) -> Output | None:
    numbers = _numbers("BHH", data)
    if numbers is None or numbers[0] not in _MEAN_OF or not _within(numbers[1:], setting):
        return None
    count, first, last = numbers
    return Output(
        Command.MEAN_SUB_RANGE,
        lambda beams, config, _: data + _header(value_words(beams, config)[first - 1 : last], config),
        scans=count,
    )


def _s14_reflectivity(data: bytes, setting: Setting) -> Output | None:
    """C4: all values, then reflectivity of a sub-range."""
    ends = _numbers("HH", data)
    if ends is None or not _within(ends, setting):
        return None
    first, last = ends

    def pack(beams: Beams, config: bytes, _: int) -> bytes:
        bright = reflectivity_bytes(beams)[first - 1 : last]
        counts = struct.pack("<HHH", len(bright), first, last)
        return _header(value_words(beams, config), config) + counts + bright.tobytes()

    return Output(Command.S14_REFLECTIVITY, pack)


def _energy(data: bytes, setting: Setting) -> Output | None:
    """F5: pairs of range and energy in up to five sub-ranges."""
    if setting.config[MEASURING_MODE] not in ENERGY_MODES:
        return None
    (count,) = struct.unpack("<H", data[:2].ljust(2, b"\0"))
    numbers = _numbers(f"{2 * count}H", data[2:]) if 1 <= count <= _MAX_RANGES else None
    if numbers is None:
        return None
    ranges = tuple(zip(numbers[::2], numbers[1::2], strict=True))
    size = 10 + sum(6 + 4 * (last - first + 1) for first, last in ranges)
    if size > _MAX_BYTES or not all(_within(ends, setting) for ends in ranges):
        return None

    def pack(beams: Beams, config: bytes, _: int) -> bytes:
        pairs = np.stack([value_words(beams, config), energy_words(beams, config)], axis=1)
        out = data[:2]
        for first, last in ranges:
            out += struct.pack("<HHH", first, last, (last - first + 1) | config[UNIT] << 14)
            out += pairs[first - 1 : last].tobytes()
        return out

    return Output(Command.ENERGY, pack)


def _segments(data: bytes, setting: Setting) -> Output | None:
    """B7: the nearest value in each of so many equal parts of a sub-range."""
    numbers = _numbers("BHH", data)
    if numbers is None or not _within(numbers[1:], setting):
        return None
    count, first, last = numbers
    if not 1 <= count <= last - first + 1:
        return None

    def pack(beams: Beams, config: bytes, _: int) -> bytes:
        parts = np.array_split(np.arange(first - 1, last), count)
        range_m = np.where(beams.fault == IN_RANGE, beams.range_m, np.inf)
        nearest = [part[np.argmin(range_m[part])] for part in parts]
        return data[1:] + _header(value_words(beams, config)[nearest], config)

    return Output(Command.SUB_RANGE, pack)


def _within(ends: tuple[int, ...], setting: Setting) -> bool:
    """Whether numbers of beams, the first is 1, are in the scan and in order."""
    first, last = ends
    return 1 <= first <= last <= setting.variant.beams


_MAKERS: dict[Command, _Maker] = {
    Command.VALUES: _values,
    Command.MEAN: _mean,
    Command.SUB_RANGE: _sub_range,
    Command.MEAN_SUB_RANGE: _mean_sub_range,
    Command.S14_REFLECTIVITY: _s14_reflectivity,
    Command.ENERGY: _energy,
}
REQUESTS = frozenset(_MAKERS)
"""Commands that ask for measured values."""

_REQUEST_OF: dict[int, bytes] = {
    Mode.STREAM: bytes([Command.VALUES, 0x01]),
    Mode.STREAM_PARTIAL: bytes([Command.VALUES, 0x08]),
    Mode.STREAM_MEAN: bytes([Command.MEAN]),
    Mode.STREAM_SUB_RANGE: bytes([Command.SUB_RANGE]),
    Mode.STREAM_MEAN_SUB_RANGE: bytes([Command.MEAN_SUB_RANGE]),
    Mode.STREAM_ENERGY: bytes([Command.ENERGY]),
    Mode.STREAM_S14: bytes([Command.S14_REFLECTIVITY]),
}
"""What a mode sends again and again, as the request for it once."""
