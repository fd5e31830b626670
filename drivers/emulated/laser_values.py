"""What the beams of a scan met, to value words: bits, flags, overflow codes, reflectivity (sheet, 3.3)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum, IntFlag

import numpy as np
from numpy.typing import NDArray

from polecal.drivers.emulated.drive import Floats
from polecal.drivers.emulated.laser_telegrams import MEASURING_MODE, UNIT

Words = NDArray[np.uint16]


class Fault(IntEnum):
    """Why a beam has no range: how far below the largest number of the distance bits its code is."""

    NO_ECHO = 0
    DAZZLE = 1
    OPERATION_OVERFLOW = 2
    LOW_SIGNAL = 4
    READ_ERROR = 5
    TOO_FAR = 8


class Fields(IntFlag):
    """In which monitored fields a beam's object is."""

    A = 1
    B = 2
    C = 4


IN_RANGE = -1
"""In place of a fault: the beam has a range."""


@dataclass(frozen=True, slots=True)
class Beams:
    """One scan's beams in ascending angle, (N,) each."""

    range_m: Floats
    level: NDArray[np.int64]
    """Reflectivity, 0 to 7."""
    fault: NDArray[np.int64]
    """`Fault`, or `IN_RANGE`."""
    fields: NDArray[np.int64]
    """`Fields`."""


@dataclass(frozen=True, slots=True)
class _Layout:
    """How a measuring mode uses a word: distance in the lowest bits, above it a level or fields."""

    distance_bits: int
    level_bits: int = 0
    field_bits: int = 0
    dazzle_flag: bool = False  # in bit 15


IMMEDIATE, NORMALISED, UNNORMALISED, ENERGY_ONLY = 0x0F, 0x0D, 0x0E, 0x3F
ENERGY_MODES = frozenset({NORMALISED, UNNORMALISED})
_LAYOUTS = {
    0x00: _Layout(13, field_bits=2, dazzle_flag=True),
    0x01: _Layout(13, level_bits=3),
    0x02: _Layout(13, field_bits=3),
    0x03: _Layout(14, level_bits=2),
    0x04: _Layout(14, field_bits=2),
    0x05: _Layout(15, level_bits=1),
    0x06: _Layout(15, field_bits=1),
    IMMEDIATE: _Layout(15),
    NORMALISED: _Layout(15),
    UNNORMALISED: _Layout(15),
}
MEASURING_MODES = frozenset(_LAYOUTS) | {ENERGY_ONLY}
_LEVEL_BITS = 3
_TOP_LEVEL = 7
_ENERGY_MAX = 13000  # sections 3.3, 5: about 7000 to 13000 as received, 0 to 13000 normalised
_ENERGY_MIN = 7000
_BYTE_MAX = 255


def value_words(beams: Beams, config: bytes) -> Words:
    """Return a scan's value words (N,) in the configuration's measuring mode and unit."""
    if config[MEASURING_MODE] == ENERGY_ONLY:
        return energy_words(beams, config)
    layout = _LAYOUTS[config[MEASURING_MODE]]
    bits, top = layout.distance_bits, (1 << layout.distance_bits) - 1
    seen = beams.fault == IN_RANGE
    distance = np.rint(np.where(seen, beams.range_m, 0.0) * (1000 if config[UNIT] else 100))
    word = np.where(seen, distance.clip(0, top - Fault.TOO_FAR), top - beams.fault).astype(np.int64)
    if layout.level_bits:
        word |= np.where(seen, beams.level >> (_LEVEL_BITS - layout.level_bits), 0) << bits
    word |= (beams.fields & ((1 << layout.field_bits) - 1)) << bits
    if layout.dazzle_flag:
        word |= (beams.fault == Fault.DAZZLE).astype(np.int64) << 15
    return word.astype(np.uint16)


def energy_words(beams: Beams, config: bytes) -> Words:
    """Return the received energy of each beam (N,), 0 without an echo."""
    least = 0 if config[MEASURING_MODE] == NORMALISED else _ENERGY_MIN
    energy = np.rint(least + beams.level * (_ENERGY_MAX - least) / _TOP_LEVEL)
    return np.where(beams.fault == IN_RANGE, energy, 0).astype(np.uint16)


def reflectivity_bytes(beams: Beams) -> NDArray[np.uint8]:
    """Return the S14's reflectivity of each beam (N,), 0 to 255."""
    bright = np.rint(beams.level * _BYTE_MAX / _TOP_LEVEL)
    return np.where(beams.fault == IN_RANGE, bright, 0).astype(np.uint8)


def mean(scans: Sequence[Beams]) -> Beams:
    """Return the mean of scans: of those that saw something at a beam, else what the last one says of it."""
    if len(scans) == 1:
        return scans[0]
    last = scans[-1]
    seen = np.array([scan.fault == IN_RANGE for scan in scans])
    count = np.maximum(seen.sum(axis=0), 1)

    def of(values: NDArray[np.float64]) -> Floats:
        return np.asarray(np.where(seen, values, 0.0).sum(axis=0) / count)

    level = np.rint(of(np.array([scan.level for scan in scans], np.float64))).astype(np.int64)
    fault = np.where(seen.any(axis=0), IN_RANGE, last.fault)
    return Beams(of(np.array([scan.range_m for scan in scans])), level, fault, last.fields)
