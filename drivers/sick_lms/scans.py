"""Measurement telegrams (B0 B6 B7 BF C4 F5) to ranges, reflectivity, bearings and the age of each beam."""

from __future__ import annotations

import struct
from dataclasses import dataclass, replace
from enum import IntEnum
from functools import cache
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from polecal.drivers.errors import DeviceProtocolError
from polecal.drivers.sick_lms.framer import Frame
from polecal.drivers.sick_lms.telegrams import build

REVOLUTION_S = 0.01332  # sheet section 6: 75 Hz nominal
MAX_RANGE_M = 81.83  # the largest value word of the 80 m laser, in cm
FULL_ENERGY = 13000  # sheet section 5: the most that an F5 reflectivity word is known to say
DULL_ENERGY = 7000  # section 3.3: what the dullest surface sends back, in words that are not normalised
_MAX_ENERGY = 32759  # beyond it the word is a code (sheet section 5, FAIR)

_COUNT = 0x03FF  # header word, sheet section 4
_PARTIAL = 0x2000
_PARTIAL_SHIFT = 11
_UNIT_SHIFT = 14
_UNITS_M = (0.01, 0.001)
_F5_COUNT = 0x3FFF

VALUES, MEAN, SUB_RANGE, MEAN_SUB_RANGE, S14, ENERGY = 0xB0, 0xB6, 0xB7, 0xBF, 0xC4, 0xF5
SCAN_CODES = frozenset((VALUES, MEAN, SUB_RANGE, MEAN_SUB_RANGE, S14, ENERGY))


class NoRange(IntEnum):
    """Why a beam has no range (sheet section 3.3, overflow codes); RANGE is none of them."""

    RANGE = 0
    NO_STOP_PULSE = 1
    DAZZLE = 2
    OPERATION_OVERFLOW = 3
    SIGNAL_TOO_WEAK = 4
    CHANNEL_1_READ_ERROR = 5
    BEYOND_MAXIMUM = 6
    UNLISTED = 7
    ENERGY_ONLY = 8


# the nine largest value words of each width, the smallest first
_CODES = np.array(
    [
        NoRange.BEYOND_MAXIMUM,
        NoRange.UNLISTED,
        NoRange.UNLISTED,
        NoRange.CHANNEL_1_READ_ERROR,
        NoRange.SIGNAL_TOO_WEAK,
        NoRange.UNLISTED,
        NoRange.OPERATION_OVERFLOW,
        NoRange.DAZZLE,
        NoRange.NO_STOP_PULSE,
    ],
    np.uint8,
)


class MeasuringMode(NamedTuple):
    """What the bits of a value word are: the range below, reflector levels or named flags above it."""

    range_bits: int
    levels: bool
    flags: tuple[str, ...] = ()


MEASURING_MODES = {  # sheet section 3.3
    0x00: MeasuringMode(13, False, ("field_a", "field_b", "dazzle")),
    0x01: MeasuringMode(13, True),
    0x02: MeasuringMode(13, False, ("field_a", "field_b", "field_c")),
    0x03: MeasuringMode(14, True),
    0x04: MeasuringMode(14, False, ("field_a", "field_b")),
    0x05: MeasuringMode(15, True),
    0x06: MeasuringMode(15, False, ("field_a",)),
    0x0D: MeasuringMode(15, False),
    0x0E: MeasuringMode(15, False),
    0x0F: MeasuringMode(15, False),
    0x3F: MeasuringMode(0, False),
}
_NORMALISED, _UNNORMALISED, _IMMEDIATE, _ENERGY_WORDS = 0x0D, 0x0E, 0x0F, 0x3F


class Decoded(NamedTuple):
    """What the beams of a scan say, each (N,).

    ``ranges_m`` float64, NaN for every beam without a range; ``kinds`` uint8 of `NoRange`;
    ``reflectivity`` float64, 0 to 1, NaN where the telegram has none; ``flags`` uint8, the bits above the
    range, lowest first.
    """

    ranges_m: NDArray[np.float64]
    kinds: NDArray[np.uint8]
    reflectivity: NDArray[np.float64]
    flags: NDArray[np.uint8]


@dataclass(frozen=True, slots=True, eq=False)
class Scan:
    """One measurement telegram, undecoded.

    ``values`` are the (N,) uint16 value words in the order sent, ``energy`` the device's own (N,) uint16
    reflectivity numbers where the telegram has them (F5 words, C4 bytes). ``partial`` is 0 to 3 for an
    interlaced partial scan at .00, .25, .50, .75 degrees. ``spans`` are the first and last beam number
    (from 1) of each part, of the reflectivity bytes in C4; empty for a whole scan. ``mean_of`` is the
    number of scans averaged. ``interlaced`` is true of a partial scan and of the whole one made of four.
    """

    code: int
    unit_m: float
    partial: int | None
    values: NDArray[np.uint16]
    scan_index: int | None
    telegram_index: int | None
    status: int
    energy: NDArray[np.uint16] | None = None
    spans: tuple[tuple[int, int], ...] = ()
    mean_of: int | None = None
    interlaced: bool = False

    @property
    def count(self) -> int:
        """How many beams there are."""
        return len(self.values)

    @classmethod
    def parse(cls, frame: Frame) -> Self:
        """Read any of the measurement telegrams. Raises DeviceProtocolError if its parts do not fit it."""
        body = frame.body
        try:
            if body[0] == ENERGY:
                return cls._parse_energy(body)
            return cls._parse_values(body)
        except (KeyError, ValueError, IndexError, struct.error) as error:
            raise DeviceProtocolError(
                f"telegram {body[0]:02X} of {len(body)} bytes at {frame.offset} is no measurement: {error}"
            ) from error

    @classmethod
    def _parse_values(cls, body: bytes) -> Self:
        code = body[0]
        # what stands between the command and the header word, sheet section 4
        prefix = {VALUES: "<", MEAN: "<B", SUB_RANGE: "<2H", MEAN_SUB_RANGE: "<B2H", S14: "<"}[code]
        before = struct.unpack_from(prefix, body, 1)
        at = 1 + struct.calcsize(prefix)
        (header,) = struct.unpack_from("<H", body, at)
        at += 2
        count = header & _COUNT
        values = np.frombuffer(body, "<u2", count, at)
        at += 2 * count
        spans = (before[-2:],) if len(before) >= 2 else ()
        energy = None
        if code == S14:
            several, first, last = struct.unpack_from("<3H", body, at)
            if not 1 <= first <= last <= count or several != last - first + 1:
                raise ValueError(f"reflectivity of beams {first} to {last}, {several} in all, of {count}")
            energy = np.zeros(count, np.uint16)
            energy[first - 1 : last] = np.frombuffer(body, np.uint8, several, at + 6)
            at += 6 + several
            spans = ((first, last),)
        scan_index, telegram_index = _indices(body, at)
        return cls(
            code,
            _UNITS_M[header >> _UNIT_SHIFT],
            header >> _PARTIAL_SHIFT & 3 if header & _PARTIAL else None,
            values,
            scan_index,
            telegram_index,
            body[-1],
            energy,
            spans,
            before[0] if len(before) % 2 else None,
            bool(header & _PARTIAL),
        )

    @classmethod
    def _parse_energy(cls, body: bytes) -> Self:
        (parts,) = struct.unpack_from("<H", body, 1)
        at, spans, units, pairs = 3, [], set(), []
        for _ in range(parts):
            first, last, count = struct.unpack_from("<3H", body, at)
            units.add(count >> _UNIT_SHIFT)
            count &= _F5_COUNT
            spans.append((first, last))
            pairs.append(np.frombuffer(body, "<u2", 2 * count, at + 6).reshape(count, 2))
            at += 6 + 4 * count
        (unit,) = units
        both = np.concatenate(pairs)
        scan_index, telegram_index = _indices(body, at)
        return cls(
            ENERGY,
            _UNITS_M[unit],
            None,
            both[:, 0],
            scan_index,
            telegram_index,
            body[-1],
            both[:, 1],
            tuple(spans),
        )

    def build(self, address: int = 0x80) -> bytes:
        """Return the telegram that says this."""
        unit = _UNITS_M.index(self.unit_m) << _UNIT_SHIFT
        if self.code == ENERGY:
            body = struct.pack("<H", len(self.spans))
            assert self.energy is not None
            pairs = np.column_stack((self.values, self.energy)).astype("<u2")
            at = 0
            for first, last in self.spans:
                count = last - first + 1
                body += struct.pack("<3H", first, last, count | unit) + pairs[at : at + count].tobytes()
                at += count
        else:
            header = self.count | unit
            if self.partial is not None:
                header |= _PARTIAL | self.partial << _PARTIAL_SHIFT
            body = b"" if self.mean_of is None else bytes((self.mean_of,))
            if self.code in (SUB_RANGE, MEAN_SUB_RANGE):
                body += struct.pack("<2H", *self.spans[0])
            body += struct.pack("<H", header) + self.values.astype("<u2").tobytes()
            if self.code == S14:
                assert self.energy is not None
                ((first, last),) = self.spans
                body += struct.pack("<3H", last - first + 1, first, last)
                body += self.energy[first - 1 : last].astype(np.uint8).tobytes()
        if self.scan_index is not None and self.telegram_index is not None:
            body += bytes((self.scan_index, self.telegram_index))
        return build(bytes((self.code,)) + body + bytes((self.status,)), address)

    def decode(self, measuring_mode: int) -> Decoded:
        """See `decode`."""
        return decode(self, measuring_mode)


def _indices(body: bytes, at: int) -> tuple[int, int] | tuple[None, None]:
    left = len(body) - at - 1  # less the status byte
    if left == 2:
        return body[at], body[at + 1]
    if left == 0:
        return None, None
    raise ValueError(f"{left} bytes between the values and the status")


def decode(scan: Scan, measuring_mode: int) -> Decoded:
    """Split the value words as the measuring mode (configuration byte D) says; sheet section 3.3.

    F5 words are split as in mode 0Eh unless the mode is 0Dh, and those of interlaced scans as in 0Fh,
    whatever the mode: so the laser sends them. Raises DeviceProtocolError for a mode that the sheet does
    not have.
    """
    if scan.code == ENERGY:
        mode = _NORMALISED if measuring_mode == _NORMALISED else _UNNORMALISED
    else:
        mode = _IMMEDIATE if scan.interlaced else measuring_mode
    if mode not in MEASURING_MODES:
        raise DeviceProtocolError(f"measuring mode {mode:02X} is unknown: value words cannot be read")
    every = _decoded_words(mode, scan.unit_m)
    words = scan.values.astype(np.intp)
    reflectivity: NDArray[np.float64]
    if scan.code == S14:
        assert scan.energy is not None
        ((first, last),) = scan.spans
        reflectivity = np.full(scan.count, np.nan)
        reflectivity[first - 1 : last] = scan.energy[first - 1 : last] / 0xFF
    elif scan.energy is not None:
        reflectivity = _scaled(scan.energy, DULL_ENERGY if mode == _UNNORMALISED else 0)
    else:
        reflectivity = every.reflectivity[words]
    return Decoded(every.ranges_m[words], every.kinds[words], reflectivity, every.flags[words])


@cache
def _decoded_words(measuring_mode: int, unit_m: float) -> Decoded:
    """Read each of the 65536 value words, once; scans look theirs up."""
    mode = MEASURING_MODES[measuring_mode]
    words: NDArray[np.uint16] = np.arange(1 << 16, dtype=np.uint16)
    if measuring_mode == _ENERGY_WORDS:
        kinds = np.full(words.size, NoRange.ENERGY_ONLY, np.uint8)
        nowhere, no_flags = np.full(words.size, np.nan), np.zeros(words.size, np.uint8)
        return Decoded(nowhere, kinds, _scaled(words, 0), no_flags)
    top = (1 << mode.range_bits) - 1
    numbers = (words & top).astype(np.int32)
    flags = (words >> mode.range_bits).astype(np.uint8)
    ranges_m: NDArray[np.float64] = numbers.astype(np.float64) * unit_m
    # in 15 bits and cm the word could say more than the laser can see
    kinds = np.where(ranges_m >= MAX_RANGE_M, NoRange.BEYOND_MAXIMUM, NoRange.RANGE).astype(np.uint8)
    code = numbers - (top + 1 - len(_CODES))
    coded = code >= 0
    kinds[coded] = _CODES[code[coded]]
    ranges_m[kinds != NoRange.RANGE] = np.nan
    reflectivity: NDArray[np.float64] = np.full(words.size, np.nan)
    if mode.levels:
        reflectivity = flags.astype(np.float64) / ((1 << 16 - mode.range_bits) - 1)
    return Decoded(ranges_m, kinds, reflectivity, flags)


def _scaled(energy: NDArray[np.uint16], dullest: int) -> NDArray[np.float64]:
    """Energy words to 0 to 1; NaN for what is a code and no energy."""
    scaled: NDArray[np.float64] = (energy.astype(np.float64) - dullest) / (FULL_ENERGY - dullest)
    scaled = scaled.clip(0.0, 1.0)
    scaled[energy > _MAX_ENERGY] = np.nan
    return scaled


def _angles_deg(
    count: int, fov_deg: float, resolution_deg: float, partial: int | None
) -> NDArray[np.float64]:
    """Angle of each beam in the 180 degree frame, in which 0 is at the right; (N,)."""
    if partial is not None:  # always 180 degrees at 1 degree, whatever the variant (sheet section 6)
        return partial * 0.25 + np.arange(count, dtype=np.float64)
    return 90 - fov_deg / 2 + np.arange(count, dtype=np.float64) * resolution_deg


def bearings_rad(
    count: int, fov_deg: float, resolution_deg: float, partial: int | None = None
) -> NDArray[np.float64]:
    """Bearing of each beam, (N,) float64, rad, positive to the right: the first is half the field of view."""
    return np.deg2rad(90 - _angles_deg(count, fov_deg, resolution_deg, partial))


def beam_ages_s(
    fov_deg: float,
    resolution_deg: float,
    count: int,
    revolution_s: float = REVOLUTION_S,
    partial: int | None = None,
) -> NDArray[np.float64]:
    """How long before the telegram's first byte left the laser each beam was fired; (N,) float64, s.

    The first byte leaves at the end of the scan's last revolution (sheet section 6). A revolution
    measures every whole degree: at 0.5 degrees a scan has two, at 0.25 four, and their beams interleave.
    """
    raster_deg = 0.5 if fov_deg == 90 else 1.0  # S14: 0.5 degrees in one revolution
    revolutions = 1 if partial is not None else round(raster_deg / resolution_deg)
    angle_deg = _angles_deg(count, fov_deg, resolution_deg, partial)
    before = revolutions - np.arange(count) % revolutions
    ages_s: NDArray[np.float64] = (before - angle_deg / 360) * revolution_s
    return ages_s


class Interlace:
    """Partial scans (20 2A) to whole ones of 180 degrees at 0.25.

    A whole scan counts as sent with its last part, so `beam_ages_s` holds for it as for any other.
    """

    def __init__(self) -> None:
        self.lost = 0
        self._parts: list[Scan] = []

    def feed(self, scan: Scan) -> Scan | None:
        """Take the next partial scan; return the whole one that it ends, if it ends one."""
        parts = self._parts
        if parts and not _follows(scan, parts[-1]):
            self.lost += len(parts)
            parts.clear()
        if scan.partial != len(parts):
            self.lost += 1
            return None
        parts.append(scan)
        if len(parts) < 4:
            return None
        values = np.empty(sum(part.count for part in parts), np.uint16)
        for k, part in enumerate(parts):
            values[k::4] = part.values
        self._parts = []
        return replace(scan, partial=None, values=values)


def _follows(scan: Scan, last: Scan) -> bool:
    assert last.partial is not None
    indexed = scan.scan_index is not None and last.scan_index is not None
    next_revolution = not indexed or scan.scan_index == ((last.scan_index or 0) + 1) % 256
    return scan.partial == last.partial + 1 and scan.unit_m == last.unit_m and next_revolution
