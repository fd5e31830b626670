"""A request to what it changes in the laser and what the laser answers (sheet, sections 3 and 7)."""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar

from polecal.drivers.emulated import laser_telegrams as lms
from polecal.drivers.emulated.laser_outputs import Output, Setting, requested, streamed
from polecal.drivers.emulated.laser_telegrams import Command, Health, Mode, Variant
from polecal.drivers.emulated.laser_types import type_of
from polecal.drivers.emulated.laser_values import ENERGY_MODES

FACTORY_BAUD = 9600
_HOURS_NS = 2 * 3600 * 10**9  # what the counter of operating hours counts
_SHORT_CONFIG, _SHORT_CONFIG_2, _CONFIG_2 = 32, 4, 84
_MAX_SENSITIVITY, _MM = 3, 1
_EVALUATIONS = range(1, 126)


@dataclass(frozen=True, slots=True)
class Quirks:
    """What real lasers do at times, as chances in 1 (section 9, item 9), and what differs by firmware."""

    info_pending: float = 0.0
    """A reply's status byte is 11h."""
    overlooked: float = 0.0
    """A request is not heard."""
    lost_ack: float = 0.0
    """A request is answered without its ACK."""
    lost_rate_reply: float = 0.0
    """The A0 of a change of rate never comes, though the rate changes (item 3)."""
    cut_scan: float = 0.0
    """A telegram of measured values loses its end."""
    no_echo: float = 0.002
    """A beam gets no echo."""
    refuse_config: bool = False
    """77h is answered by F7 00 and what is still in force."""
    accept_as_zero: bool = False
    """77h is done and answered by F7 00 and what is now in force (section 3, below its table)."""
    refuse_energy: bool = False
    """Measuring modes 0D and 0E, and so F5, do not exist (section 10)."""
    short_config: bool = False
    """Configurations have 32 and 4 bytes, as in old firmware."""
    flags_in_partials: bool = False
    """Partial scans come in the measuring mode that is set, not in 0F (section 3.3 leaves it open)."""


@dataclass(frozen=True, slots=True)
class Answer:
    """What follows the ACK."""

    code: int
    data: bytes = b""
    delay_s: float = 0.060
    then_baud: int | None = None


REJECTED = Answer(lms.REJECTED)


class LaserState:
    """What the laser is set to: some of it until the power goes, some for good.

    ``eeprom`` is the stored configuration, and ``own`` the B1 of this one device (`laser_telegrams`). A
    ``baud`` other than 9600 is one that 66h has made permanent.
    """

    def __init__(
        self,
        *,
        type_string: str,
        baud: int,
        eeprom: bytes | None,
        address: int,
        quirks: Quirks,
        motor_us: int,
        own: bytes,
    ) -> None:
        self.type_string = type_string
        self.kind = type_of(type_string)
        self.config = self.kind.config if eeprom is None else eeprom
        self.address = address
        self.quirks = quirks
        self.health = Health()
        self.eeprom_writes = 0
        self.running_ns = 0
        self.power_ons = 1
        self._motor_us = motor_us
        self._own = own
        self._field_set = 0
        self._permanent_baud = None if baud == FACTORY_BAUD else baud
        self._permanent_variant: Variant | None = None
        self.power_up()

    def power_up(self) -> None:
        """Forget what is volatile (section 7)."""
        self.baud = self._permanent_baud or FACTORY_BAUD
        self.variant = self._permanent_variant or self.kind.variants[0]
        self._mode = bytes([Mode.REQUEST])
        self.health = self.health.after_reset

    @property
    def mode(self) -> int:
        """The operating mode, as B1 has it."""
        return self._mode[0]

    @property
    def stream(self) -> Output | None:
        """What is sent unasked."""
        return streamed(self._mode, self._setting)

    def force_stream(self, variant: Variant | None, baud: int) -> None:
        """Be as after a host's whole set-up: levels, indices, all values."""
        self.baud = baud
        self.variant = variant or self.kind.variants[-1]
        self.config = self.config[: lms.AVAILABILITY] + b"\x02\x01" + self.config[lms.UNIT :]
        self._mode = bytes([Mode.STREAM])

    def values(self, command: int, data: bytes) -> Output | None:
        """Return the measured values that are asked for once, None where rejected."""
        return requested(command, data, self._setting)

    def answer(self, command: int, data: bytes) -> Answer:
        """Do what any other request says."""
        if command in self.kind.cannot or command not in self._ANSWERS:
            return REJECTED
        return self._ANSWERS[command](self, data)

    @property
    def _setting(self) -> Setting:
        return Setting(self.kind, self.variant, self.config)

    # --- what changes something

    def _set_mode(self, data: bytes) -> Answer:
        sub = data[0] if data else -1
        code = Command.MODE + lms.REPLY
        if sub in lms.BAUD_OF_SUB and len(data) == 1:
            self.baud = lms.BAUD_OF_SUB[sub]
            return Answer(code, b"\x00", then_baud=self.baud)
        if sub == Mode.INSTALLATION:
            allowed = data[1:] == lms.PASSWORD
        elif sub in (Mode.DIAGNOSTIC, Mode.REQUEST):
            allowed = len(data) == 1
        elif sub in (Mode.MIN_ON_OBJECT, Mode.VERTICAL_ON_OBJECT):  # which never comes: there are no fields
            allowed = len(data) == 1 and self.kind.monitors_fields
        else:
            allowed = bool(data) and streamed(data, self._setting) is not None
        if allowed:
            self._mode = data[:1] if sub == Mode.INSTALLATION else data
        return Answer(code, b"\x00" if allowed else b"\x01")

    def _set_variant(self, data: bytes) -> Answer:
        if len(data) != 4:
            return REJECTED
        wish = Variant(*struct.unpack("<HH", data))
        allowed = wish in self.kind.variants
        if allowed:
            self.variant = wish
        return Answer(Command.VARIANT + lms.REPLY, bytes([allowed]) + data, delay_s=0.3)

    def _set_field_set(self, data: bytes) -> Answer:
        if data not in (b"\x00", b"\x01"):
            return REJECTED
        self._field_set = data[0]
        return Answer(Command.FIELD_SET + lms.REPLY, b"\x01", delay_s=0.2)

    def _write_config(self, data: bytes) -> Answer:
        if self.mode != Mode.INSTALLATION or not data:
            return REJECTED
        wish = data[: len(self.config)] + self.config[len(data) :]  # more is ignored, less is tolerated
        accepted = (
            wish[lms.MEASURING_MODE] in self._measuring_modes
            and wish[lms.SENSITIVITY] <= _MAX_SENSITIVITY
            and wish[lms.UNIT] <= _MM
            and wish[lms.EVALUATIONS] in _EVALUATIONS
            and not self.quirks.refuse_config
        )
        if accepted:
            self.config = wish
            self.eeprom_writes += 1
        result = bytes([accepted and not self.quirks.accept_as_zero])
        return Answer(Command.WRITE_CONFIG + lms.REPLY, result + self._read_config(), delay_s=0.1)

    @property
    def _measuring_modes(self) -> frozenset[int]:
        return self.kind.measuring_modes - (ENERGY_MODES if self.quirks.refuse_energy else frozenset())

    def _set_permanent(self, data: bytes) -> Answer:
        if self.mode != Mode.INSTALLATION or data not in (b"\x00", b"\x01", b"\x02"):
            return REJECTED
        if data == b"\x02":
            self._permanent_variant = self.variant
        else:
            self._permanent_baud = self.baud if data == b"\x01" else None
        self.eeprom_writes += 1
        return Answer(Command.PERMANENT + lms.REPLY, b"\x01" + data)

    # --- what only tells

    def _read_config(self) -> bytes:
        return self.config[:_SHORT_CONFIG] if self.quirks.short_config else self.config

    def _read_config_2(self) -> bytes:
        return bytes(_SHORT_CONFIG_2 if self.quirks.short_config else _CONFIG_2)

    def _read_errors(self) -> bytes:
        return bytes(byte for error in self.health.errors for byte in error)

    def _read_hours(self) -> bytes:
        return struct.pack("<HH", self.running_ns // _HOURS_NS, self.power_ons)

    def _read_status(self) -> bytes:
        fields = lms.StatusFields(
            mode=self.mode,
            variant=self.variant,
            config=self.config,
            baud=self.baud,
            permanent_baud=self._permanent_baud is not None,
            motor_us=self._motor_us,
            version=self.type_string.split(";")[-1],
            address=self.address,
            field_set=self._field_set,
            health=self.health,
        )
        return lms.status_data(fields, self._own)

    @staticmethod
    def _told(command: Command, read: Callable[[LaserState], bytes]) -> Callable[[LaserState, bytes], Answer]:
        """Return the answerer of a request that has no data of its own."""
        return lambda state, data: REJECTED if data else Answer(command + lms.REPLY, read(state))

    _ANSWERS: ClassVar[dict[int, Callable[[LaserState, bytes], Answer]]] = {
        Command.MODE: _set_mode,
        Command.VARIANT: _set_variant,
        Command.FIELD_SET: _set_field_set,
        Command.WRITE_CONFIG: _write_config,
        Command.PERMANENT: _set_permanent,
        Command.STATUS: _told(Command.STATUS, _read_status),
        Command.ERRORS: _told(Command.ERRORS, _read_errors),
        Command.HOURS: _told(Command.HOURS, _read_hours),
        Command.TYPE: _told(Command.TYPE, lambda state: state.type_string.encode("ascii")),
        Command.OUTPUTS: _told(Command.OUTPUTS, lambda _: b"\1\1\1"),  # no object in a field
        Command.READ_CONFIG: _told(Command.READ_CONFIG, _read_config),
        Command.READ_CONFIG_2: _told(Command.READ_CONFIG_2, _read_config_2),
    }
