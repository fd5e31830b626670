"""Configuration part 1 (74h/F4h, 77h/F7h): 32 or 34 bytes, of which we change few and keep the rest."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

from polecal.drivers.sick_lms.telegrams import Reply, Telegram

REAL_TIME_INDICES = 0x02  # availability, bit 1
CENTIMETRES, MILLIMETRES = 0, 1
SIZES = (32, 34)  # old firmware lacks the last word
_SENSITIVITY, _AVAILABILITY, _MEASURING_MODE, _UNIT = 3, 4, 5, 6  # offsets, sheet section 3.2


@dataclass(frozen=True, slots=True)
class Configuration:
    """The data bytes as the laser has them. Raises ValueError for a size that there is not."""

    data: bytes

    def __post_init__(self) -> None:
        if len(self.data) not in SIZES:
            raise ValueError(f"a configuration of {len(self.data)} bytes")

    @property
    def sensitivity(self) -> int:
        """LMS 211/221/291: 0 standard, 1 medium, 2 low, 3 high."""
        return self.data[_SENSITIVITY]

    @property
    def availability(self) -> int:
        """Bit 0 highest availability, bit 1 real-time indices on, bit 2 dazzle does not reach the outputs."""
        return self.data[_AVAILABILITY]

    @property
    def measuring_mode(self) -> int:
        """What the bits of a value word mean (sheet section 3.3)."""
        return self.data[_MEASURING_MODE]

    @property
    def unit(self) -> int:
        """0 cm, 1 mm."""
        return self.data[_UNIT]

    def streaming(self, measuring_mode: int, unit: int = CENTIMETRES) -> Self:
        """Return this with the measuring mode, the unit, and real-time indices on; all else as it is."""
        data = bytearray(self.data)
        data[_AVAILABILITY] |= REAL_TIME_INDICES
        data[_MEASURING_MODE] = measuring_mode
        data[_UNIT] = unit
        return type(self)(bytes(data))


@dataclass(frozen=True, slots=True)
class WriteConfiguration(Telegram):
    """77h: write it to the EEPROM, in installation mode; answered by F7h."""

    code = 0x77
    configuration: Configuration

    @classmethod
    def _unpack(cls, data: bytes) -> Self:
        return cls(Configuration(data))

    def _pack(self) -> bytes:
        return self.configuration.data


@dataclass(frozen=True, slots=True)
class ConfigurationRead(Reply):
    """F4h: the configuration in force."""

    code = 0xF4
    configuration: Configuration

    @classmethod
    def _fields(cls, data: bytes) -> tuple[object, ...]:
        return (Configuration(data),)

    def _data(self) -> bytes:
        return self.configuration.data


@dataclass(frozen=True, slots=True)
class ConfigurationWritten(Reply):
    """F7h: whether 77h was carried out, and the configuration in force.

    Sheet section 3: some firmware says 0 for "accepted", so only what is read back tells.
    """

    code = 0xF7
    accepted: bool
    configuration: Configuration

    @classmethod
    def _fields(cls, data: bytes) -> tuple[object, ...]:
        return data[0] == 1, Configuration(data[1:])

    def _data(self) -> bytes:
        return bytes((self.accepted,)) + self.configuration.data
