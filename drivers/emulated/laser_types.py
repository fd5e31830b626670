"""A laser's type string to what that type can and cannot do (sheet, sections 3, 3.3, 5, 7)."""

from __future__ import annotations

from dataclasses import dataclass

from polecal.drivers.emulated.laser_telegrams import DEFAULT_CONFIG, S14_VARIANT, Command, Variant
from polecal.drivers.emulated.laser_values import ENERGY_MODES, ENERGY_ONLY, MEASURING_MODES

_VARIANTS = tuple(Variant(a, r) for a, r in ((180, 50), (180, 100), (100, 100), (100, 50), (100, 25)))


@dataclass(frozen=True, slots=True)
class LaserType:
    """A type of laser."""

    cannot: frozenset[Command]
    """Commands that this type rejects."""
    variants: tuple[Variant, ...] = _VARIANTS
    """The first is the one after power-up."""
    measuring_modes: frozenset[int] = MEASURING_MODES
    config: bytes = DEFAULT_CONFIG
    """As it left the factory."""
    monitors_fields: bool = True
    turn_bytes: int = 508
    """How many leave in one turn of the mirror at 500000 bit/s (section 6)."""


LMS291 = LaserType(cannot=frozenset({Command.S14_REFLECTIVITY}))
S14 = LaserType(
    cannot=frozenset({Command.ENERGY, Command.FIELD_SET}),
    variants=(S14_VARIANT,),
    measuring_modes=MEASURING_MODES - ENERGY_MODES - {ENERGY_ONLY},
    monitors_fields=False,
    turn_bytes=559,
)
LMS200 = LaserType(
    cannot=frozenset({Command.S14_REFLECTIVITY, Command.HOURS}),
    config=bytes.fromhex("0000 70 00 00 00 01 00 00 02 02 00") + bytes(20) + b"\x02\x00",
)
"""Telegram Listing, Tbl 6-8: 8 m in mm."""


def type_of(type_string: str) -> LaserType:
    """Return what a type string such as ``LMS291;S14;V02.10`` speaks of."""
    if ";S14" in type_string:
        return S14
    return LMS200 if type_string.startswith("LMS200") else LMS291
