"""An emulated LMS-291: bytes from the host in, bytes to the host out, in virtual time (sheet, section 9)."""

from __future__ import annotations

import random
from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from polecal.drivers.emulated import laser_telegrams as lms
from polecal.drivers.emulated.drive import Floats
from polecal.drivers.emulated.laser_telegrams import Command, Mode, Variant
from polecal.drivers.emulated.line import EmulatedDevice
from polecal.drivers.emulated.world import World

REVOLUTION_NS = 13_320_000.0
"""A turn of the mirror at 75 Hz (section 6)."""
_REVOLUTION_BYTES = 508  # leave in one turn at 500000 bit/s (section 6)
_GAP_NS = 6_000_000  # between a telegram's bytes; after more, it is forgotten (section 1)
_RESET_NS = 10_000_000
_FULL_RATE = 500000
_ALL_ONCE, _PARTIAL_ONCE = b"\x01", b"\x08"  # what 30h may ask for
_PARTIALS = 4  # quarter degrees that an interlaced scan goes through


@dataclass(frozen=True, slots=True)
class Quirks:
    """What real lasers do at times, as chances in 1 (section 9, item 9) and firmware ways."""

    info_pending: float = 0.0
    """A reply's status byte is 11h."""
    lost_ack: float = 0.0
    """A request is overlooked."""
    cut_scan: float = 0.0
    """A B0 loses its end."""
    refuse_config: bool = False
    """77h is answered by F7 00."""
    short_config: bool = False
    """The configuration has 32 bytes, as in old firmware."""
    no_echo: float = 0.002
    """A beam gets no echo."""


@dataclass(frozen=True, slots=True)
class _Answer:
    """What follows the ACK."""

    code: int
    data: bytes = b""
    delay_s: float = 0.060
    then_baud: int | None = None


_REJECTED = _Answer(lms.REJECTED)


class EmulatedLaser(EmulatedDevice):
    """An LMS-291-S05 on one end of a serial line.

    It powers up at ``t0_ns`` at ``baud``, and says so ``boot_s`` later. ``drift_ppm`` is how much longer
    than nominal its mirror's turn is. ``eeprom`` is the stored configuration (34 bytes, section 3.2), and
    ``eeprom_writes`` counts what was written to it. The world's motion starts with the first stream, unless
    ``starts_world`` is false.
    """

    def __init__(
        self,
        world: World,
        *,
        t0_ns: int,
        seed: int = 0,
        baud: int = 9600,
        drift_ppm: float = 20.0,
        eeprom: bytes = lms.DEFAULT_CONFIG,
        type_string: str = "LMS291;S05;V02.10 ",
        address: int = 0,
        boot_s: float = 0.5,
        ack_s: float = 0.010,
        starts_world: bool = True,
        quirks: Quirks | None = None,
    ) -> None:
        super().__init__(t0_ns=t0_ns, seed=seed, baud=baud)
        self._world = world
        self._starts_world = starts_world
        self._t0_ns = t0_ns
        self._revolution_ns = REVOLUTION_NS * (1 + drift_ppm * 1e-6)
        self.config = eeprom
        self.type_string = type_string
        self.quirks = quirks or Quirks()
        self._noise_seed = seed
        self._chance = random.Random(seed + 1)  # noqa: S311 - a device's moods, not secrets
        self._address = address
        self._boot_ns = round(boot_s * 1e9)
        self._ack_ns = round(ack_s * 1e9)
        self.eeprom_writes = 0
        self.mode: int = Mode.REQUEST
        self.variant = lms.POWER_ON_VARIANT
        self._permanent_baud: int | None = None
        self._permanent_variant: Variant | None = None
        self._telegrams = 0
        self._heard = bytearray()
        self._heard_ns = t0_ns
        self._busy_until_ns: float = 0.0  # deaf and not streaming until then
        self._next_end = 0  # the revolution at whose beginning the next scan is complete
        self._boot(t0_ns)

    @property
    def streaming(self) -> bool:
        """Whether the laser sends scans unasked."""
        return self.mode in (Mode.STREAM, Mode.STREAM_PARTIAL)

    def force_stream(self, t_ns: int, variant: Variant = Variant(100, 25)) -> None:  # noqa: B008 - frozen
        """Put the laser where a host's set-up would have: 500000 bit/s, levels, indices, streaming."""
        self._advance(t_ns)
        self._agenda.clear()
        self._line.cut(t_ns)
        self._line.run(t_ns + _RESET_NS)
        self._line.take()
        self._line.baud = _FULL_RATE
        self.variant = variant
        self.config = lms.STREAM_CONFIG
        self.mode = Mode.STREAM
        if self._starts_world:
            self._world.start(t_ns)
        self._resume(t_ns)

    # --- hearing

    def _hear(self, t_ns: int, byte: int) -> None:
        if t_ns < self._busy_until_ns:
            self._heard.clear()
            return
        if t_ns - self._heard_ns > _GAP_NS:
            self._heard.clear()
        self._heard_ns = t_ns
        self._heard.append(byte)
        while self._heard:
            if self._heard[0] != lms.STX:
                del self._heard[0]
                continue
            if len(self._heard) < 4:
                return
            length = int.from_bytes(self._heard[2:4], "little")
            if not 0 < length <= lms.MAX_LENGTH:
                del self._heard[0]
                continue
            if len(self._heard) < length + 6:
                return
            telegram = bytes(self._heard)
            self._heard.clear()
            self._take(t_ns, telegram)

    def _take(self, t_ns: int, telegram: bytes) -> None:
        """Answer a whole telegram: silence, NAK, or ACK and what follows."""
        if telegram[1] not in (0, self._address) or self._chance.random() < self.quirks.lost_ack:
            return
        if lms.crc16(telegram[:-2]) != int.from_bytes(telegram[-2:], "little"):
            self._line.send(t_ns + self._ack_ns, lms.NAK)
            return
        self._line.cut(t_ns)
        self._line.send(t_ns + self._ack_ns, lms.ACK)
        self._busy_until_ns = float("inf")
        code, data = telegram[4], telegram[5:-2]
        if code == Command.RESET and not data:
            self._at(t_ns + self._ack_ns + _RESET_NS, self._reset)
            return
        if code == Command.VALUES and data in (_ALL_ONCE, _PARTIAL_ONCE):
            partial = data == _PARTIAL_ONCE
            end = self._end_from(t_ns + self._ack_ns, 1 if partial else self.variant.revolutions)
            self._at(self._moment_ns(end), lambda _: self._reply_values(end, partial=partial))
            return
        answer = self._ANSWERS[code](self, data) if code in self._ANSWERS else _REJECTED
        ready_ns = t_ns + max(self._ack_ns, round(answer.delay_s * 1e9))
        self._line.send(
            ready_ns, lms.reply(answer.code, answer.data, self._status(), self._address), answer.then_baud
        )
        if self.streaming and self._starts_world:
            self._world.start(t_ns)
        self._resume(self._line.busy_until_ns)

    def _status(self) -> int:
        return lms.STATUS_OK | (self._chance.random() < self.quirks.info_pending)

    def _resume(self, t_ns: float) -> None:
        """Listen again from then on, and stream if that is the mode."""
        self._busy_until_ns = t_ns
        self._next_end = self._end_from(t_ns, self._scan_revolutions)

    # --- requests

    def _set_mode(self, data: bytes) -> _Answer:
        sub = data[0] if data else -1
        done, refused = _Answer(lms.MODE_REPLY, b"\x00"), _Answer(lms.MODE_REPLY, b"\x01")
        if sub == Mode.INSTALLATION:
            if data[1:] != lms.PASSWORD:
                return refused
        elif len(data) != 1:
            return refused
        elif sub in lms.BAUD_OF_SUB:
            return _Answer(lms.MODE_REPLY, b"\x00", then_baud=lms.BAUD_OF_SUB[sub])
        elif sub == Mode.STREAM_PARTIAL:
            if self.variant != Variant(100, 25):
                return refused
        elif sub not in (Mode.DIAGNOSTIC, Mode.STREAM, Mode.REQUEST):
            return refused
        self.mode = sub
        return done

    def _set_variant(self, data: bytes) -> _Answer:
        if len(data) != 4:
            return _REJECTED
        wish = Variant(int.from_bytes(data[:2], "little"), int.from_bytes(data[2:], "little"))
        allowed = wish in lms.VARIANTS
        if allowed:
            self.variant = wish
        return _Answer(Command.VARIANT + lms.REPLY, bytes([allowed]) + data, delay_s=0.3)

    def _write_config(self, data: bytes) -> _Answer:
        if self.mode != Mode.INSTALLATION or not data:
            return _REJECTED
        wish = data[: len(self.config)] + self.config[len(data) :]  # more is ignored, less is tolerated
        accepted = wish[5] in lms.MEASURING_MODES and wish[6] <= 1 and not self.quirks.refuse_config
        if accepted:
            self.config = wish
            self.eeprom_writes += 1
        return _Answer(
            Command.WRITE_CONFIG + lms.REPLY, bytes([accepted]) + self._config_read(), delay_s=0.120
        )

    def _config_read(self) -> bytes:
        return self.config[:32] if self.quirks.short_config else self.config

    def _set_permanent(self, data: bytes) -> _Answer:
        if self.mode != Mode.INSTALLATION or len(data) != 1 or data[0] > 2:
            return _REJECTED
        if data[0] == 0:
            self._permanent_baud = None
        elif data[0] == 1:
            self._permanent_baud = self.baud
        else:
            self._permanent_variant = self.variant
        self.eeprom_writes += 1
        return _Answer(Command.PERMANENT + lms.REPLY, b"\x01" + data)

    def _read_status(self) -> bytes:
        fields = lms.StatusFields(
            mode=self.mode,
            variant=self.variant,
            config=self.config,
            baud=self.baud,
            permanent_baud=self._permanent_baud is not None,
            motor_us=round(self._revolution_ns / 90e3),
            version=self.type_string.split(";")[-1],
            address=self._address,
        )
        return lms.status_data(fields)

    def _plain(
        self, code: Command, data: bytes, read: Callable[[], bytes], delay_s: float = 0.060
    ) -> _Answer:
        """Answer a request that has no data of its own."""
        return _REJECTED if data else _Answer(code + lms.REPLY, read(), delay_s)

    _ANSWERS: ClassVar[dict[int, Callable[[EmulatedLaser, bytes], _Answer]]] = {
        Command.MODE: _set_mode,
        Command.VARIANT: _set_variant,
        Command.WRITE_CONFIG: _write_config,
        Command.PERMANENT: _set_permanent,
        Command.STATUS: lambda self, d: self._plain(Command.STATUS, d, self._read_status, 0.065),
        Command.ERRORS: lambda self, d: self._plain(Command.ERRORS, d, bytes),
        Command.HOURS: lambda self, d: self._plain(Command.HOURS, d, lambda: bytes.fromhex("2A01 1700")),
        Command.TYPE: lambda self, d: self._plain(Command.TYPE, d, self.type_string.encode),
        Command.OUTPUTS: lambda self, d: self._plain(Command.OUTPUTS, d, lambda: b"\1\1\1"),
        Command.READ_CONFIG: lambda self, d: self._plain(Command.READ_CONFIG, d, self._config_read),
        Command.READ_CONFIG_2: lambda self, d: self._plain(Command.READ_CONFIG_2, d, lambda: bytes(84)),
    }

    # --- power

    def _reset(self, t_ns: int) -> None:
        baud = self._permanent_baud or 9600
        self._line.send(t_ns, lms.reply(lms.RESET_DONE, b"", address=self._address), baud)
        self.mode = Mode.REQUEST
        self.variant = self._permanent_variant or lms.POWER_ON_VARIANT
        self._boot(t_ns)

    def _boot(self, t_ns: int) -> None:
        self._busy_until_ns = float("inf")
        self._at(t_ns + self._boot_ns, self._say_hello)

    def _say_hello(self, t_ns: int) -> None:
        self._line.send(t_ns, lms.reply(lms.POWER_ON, self.type_string.encode(), address=self._address))
        self._resume(self._line.busy_until_ns)

    # --- scanning

    @property
    def _scan_revolutions(self) -> int:
        return 1 if self.mode == Mode.STREAM_PARTIAL else self.variant.revolutions

    def _moment_ns(self, revolution: int) -> int:
        """When a turn of the mirror begins."""
        return self._t0_ns + round(revolution * self._revolution_ns)

    def _end_from(self, t_ns: float, revolutions: int) -> int:
        """Return the first turn that begins at or after a moment and ends a scan of so many turns."""
        turns = (t_ns - self._t0_ns) / self._revolution_ns
        return int(-(-turns // revolutions)) * revolutions

    def _due_ns(self) -> int | None:
        if not self.streaming or self._busy_until_ns == float("inf"):
            return None
        return self._moment_ns(self._next_end)

    def _do_due(self, t_ns: int) -> None:
        """Send the scan that is complete now, unless the line is not done with the one before."""
        end, self._next_end = self._next_end, self._next_end + self._scan_revolutions
        if self._line.busy_until_ns <= t_ns:
            self._send_paced(end, self._scan(end, partial=self.mode == Mode.STREAM_PARTIAL))

    def _reply_values(self, end: int, *, partial: bool) -> None:
        self._send_paced(end, self._scan(end, partial=partial))
        self._resume(self._line.busy_until_ns)

    def _send_paced(self, revolution: int, data: bytes) -> None:
        """Queue a scan's bytes: at the full rate so many in each turn, else as fast as the line goes."""
        if self._chance.random() < self.quirks.cut_scan:
            data = data[: self._chance.randrange(1, len(data))]
        step = _REVOLUTION_BYTES if self.baud == _FULL_RATE else len(data)
        for i, start in enumerate(range(0, len(data), step)):
            self._line.send(self._moment_ns(revolution + i), data[start : start + step])

    def _scan(self, end: int, *, partial: bool) -> bytes:
        """Return the B0 of the scan that is complete when turn ``end`` begins.

        A partial one is that turn's 1° raster alone, over the whole half circle whatever the variant.
        """
        turns = 1 if partial else self.variant.revolutions
        first = end - turns
        quarter = first % _PARTIALS if partial else None
        angle_deg: Floats
        if quarter is None:
            angle_deg = self.variant.angles_deg
        else:
            angle_deg = np.arange(181.0 if quarter == 0 else 180.0) + quarter / _PARTIALS
        # Beam i is measured in turn i mod the scan's turns, when the mirror is at its angle (section 6)
        turn = first + np.arange(len(angle_deg)) % turns
        fired_ns = self._t0_ns + np.rint((turn + angle_deg / 360) * self._revolution_ns).astype(np.int64)
        bearing_rad = np.deg2rad(90 - angle_deg)  # the laser's 0 is its right
        range_m, level = self._world.range_scan(self._world.seconds(fired_ns), bearing_rad, key=end)
        if self.quirks.no_echo:
            lost = np.random.default_rng([self._noise_seed, end]).random(len(range_m)) < self.quirks.no_echo
            range_m = np.where(lost, np.inf, range_m)
        self._telegrams += 1
        return lms.values(
            lms.value_words(range_m, level, self.config),
            self.config,
            (end, self._telegrams),
            partial=quarter,
            address=self._address,
            status=self._status(),
        )
