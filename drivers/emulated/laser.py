"""An emulated LMS2xx: bytes from the host in, bytes to the host out, in virtual time (sheet, section 9)."""

from __future__ import annotations

import random

from polecal.drivers.emulated import laser_telegrams as lms
from polecal.drivers.emulated.laser_outputs import REQUESTS, Output
from polecal.drivers.emulated.laser_requests import REJECTED, Answer, LaserState, Quirks
from polecal.drivers.emulated.laser_scans import REVOLUTION_NS, Mirror
from polecal.drivers.emulated.laser_telegrams import Command, Health, Variant
from polecal.drivers.emulated.laser_values import IMMEDIATE, Fault, Fields, mean
from polecal.drivers.emulated.line import EmulatedDevice
from polecal.drivers.emulated.world import World

__all__ = ["REVOLUTION_NS", "EmulatedLaser", "Fault", "Fields", "Health", "Quirks"]

_GAP_NS = 6_000_000  # between a telegram's bytes; after more, it is forgotten (section 1)
_RESET_NS = 10_000_000
_FULL_RATE = 500000


class EmulatedLaser(EmulatedDevice):
    """A laser on one end of a serial line; which one, ``type_string`` says: LMS291, its S14, or LMS200.

    It powers up at ``t0_ns`` at ``baud``, and says so ``boot_s`` later. ``drift_ppm`` is how much longer
    than nominal its mirror's turn is. ``eeprom`` is the stored configuration (34 bytes, section 3.2; as it
    left the factory if None), ``own`` what B1 has of the individual device, and ``eeprom_writes`` counts
    what was written. The world's motion starts with the first stream, unless ``starts_world`` is false.
    """

    def __init__(
        self,
        world: World,
        *,
        t0_ns: int,
        seed: int = 0,
        baud: int = 9600,
        drift_ppm: float = 20.0,
        eeprom: bytes | None = None,
        type_string: str = "LMS291;S05;V02.10 ",
        address: int = 0,
        own: bytes = lms.OWN_FIELDS,
        boot_s: float = 0.5,
        ack_s: float = 0.010,
        starts_world: bool = True,
        quirks: Quirks | None = None,
    ) -> None:
        super().__init__(t0_ns=t0_ns, seed=seed, baud=baud)
        self._world = world
        self._starts_world = starts_world
        self._quirks = quirks or Quirks()
        revolution_ns = REVOLUTION_NS * (1 + drift_ppm * 1e-6)
        self._mirror = Mirror(
            world, t0_ns=t0_ns, revolution_ns=revolution_ns, no_echo=self._quirks.no_echo, seed=seed
        )
        self._state = LaserState(
            type_string=type_string,
            baud=baud,
            eeprom=eeprom,
            address=address,
            quirks=self._quirks,
            motor_us=round(revolution_ns / 90e3),
            own=own,
        )
        self._chance = random.Random(seed + 1)  # noqa: S311 - a device's moods, not secrets
        self._boot_ns = round(boot_s * 1e9)
        self._ack_ns = round(ack_s * 1e9)
        self._first_ns = t0_ns
        self._telegrams = 0
        self._heard = bytearray()
        self._heard_ns = t0_ns
        self._stream: Output | None = None
        self._busy_until_ns: float = 0.0  # deaf and not streaming until then
        self._next_end = 0  # the turn at whose beginning the next scan is complete
        self._boot(t0_ns)

    # --- what a test may know and change

    @property
    def config(self) -> bytes:
        """The stored configuration."""
        return self._state.config

    @property
    def eeprom_writes(self) -> int:
        """How often the EEPROM has been written."""
        return self._state.eeprom_writes

    @property
    def mode(self) -> int:
        """The operating mode, as B1 has it."""
        return self._state.mode

    @property
    def variant(self) -> Variant:
        """Scan angle and resolution."""
        return self._state.variant

    @property
    def streaming(self) -> bool:
        """Whether the laser sends scans unasked."""
        return self._state.stream is not None

    @property
    def health(self) -> Health:
        """Its errors, pollution and status byte."""
        return self._state.health

    @health.setter
    def health(self, health: Health) -> None:
        self._state.health = health

    @property
    def faults(self) -> dict[int, Fault]:
        """What the beams at these places of each scan, the first is 0, get instead of their range."""
        return self._mirror.faults

    @property
    def fields(self) -> dict[int, Fields]:
        """In which fields the objects at these places of each scan are."""
        return self._mirror.fields

    def force_stream(self, t_ns: int, variant: Variant | None = None) -> None:
        """Put the laser where a host's set-up would have: 500000 bit/s, levels, indices, streaming.

        Its finest variant is taken where none is given.
        """
        self._interrupt(t_ns)
        self._state.force_stream(variant, _FULL_RATE)
        self._line.send(t_ns, b"", _FULL_RATE)
        self._line.run(t_ns + _RESET_NS)
        self._line.take()
        if self._starts_world:
            self._world.start(t_ns)
        self._resume(t_ns)

    def power_cycle(self, t_ns: int, off_s: float = 1.0) -> None:
        """Take its power away for a while: it stops in mid-byte, forgets what is volatile, and boots."""
        self._interrupt(t_ns)
        on_ns = t_ns + round(off_s * 1e9)
        self._state.power_up()
        self._state.power_ons += 1
        self._mirror.t0_ns = on_ns
        self._telegrams = 0
        self._line.send(on_ns, b"", self._state.baud)
        self._boot(on_ns)

    def _interrupt(self, t_ns: int) -> None:
        self._advance(t_ns)
        self._agenda.clear()
        self._line.cut(t_ns)

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
        if telegram[1] not in (0, self._state.address) or self._happens(self._quirks.overlooked):
            return
        ack_ns = t_ns + self._ack_ns
        if lms.crc16(telegram[:-2]) != int.from_bytes(telegram[-2:], "little"):
            self._line.send(ack_ns, lms.NAK)
            return
        self._line.cut(t_ns)
        if not self._happens(self._quirks.lost_ack):
            self._line.send(ack_ns, lms.ACK)
        self._busy_until_ns = float("inf")
        self._state.running_ns = t_ns - self._first_ns
        command, data = telegram[4], telegram[5:-2]
        if command == Command.RESET and not data:
            self._at(ack_ns + _RESET_NS, self._reset)
        elif command in REQUESTS:
            output = self._state.values(command, data)
            if output is None:
                self._answer(t_ns, REJECTED)
            else:
                self._answer_values(ack_ns, output)
        else:
            self._answer(t_ns, self._state.answer(command, data))

    def _happens(self, chance: float) -> bool:
        return self._chance.random() < chance

    def _answer(self, t_ns: int, answer: Answer) -> None:
        ready_ns = t_ns + max(self._ack_ns, round(answer.delay_s * 1e9))
        reply = self._reply(answer.code, answer.data)
        if answer.then_baud and self._happens(self._quirks.lost_rate_reply):
            reply = b""
        self._line.send(ready_ns, reply, answer.then_baud)
        if self.streaming and self._starts_world:
            self._world.start(t_ns)
        self._resume(self._line.busy_until_ns)

    def _answer_values(self, t_ns: int, output: Output) -> None:
        """Answer with the scan that is complete next, or with the mean of as many as it takes."""
        turns = self._turns(output)
        end = self._mirror.end_from(t_ns, turns) + (output.scans - 1) * turns

        def send(_: int) -> None:
            self._send_paced(end, self._measure(end, output))
            self._resume(self._line.busy_until_ns)

        self._at(self._mirror.moment_ns(end), send)

    def _reply(self, code: int, data: bytes) -> bytes:
        status = self._state.health.status
        if self._happens(self._quirks.info_pending) and not self._state.health.worst:
            status |= 1
        return lms.reply(code, data, status, self._state.address)

    def _resume(self, t_ns: float) -> None:
        """Listen again from then on, and stream if that is the mode."""
        self._busy_until_ns = t_ns
        self._stream = self._state.stream
        if self._stream is not None:
            self._next_end = self._mirror.end_from(t_ns, self._turns(self._stream))

    # --- power

    def _reset(self, t_ns: int) -> None:
        self._state.power_up()
        self._line.send(t_ns, self._reply(lms.RESET_DONE, b""), self._state.baud)
        self._boot(t_ns)

    def _boot(self, t_ns: int) -> None:
        self._busy_until_ns = float("inf")
        self._at(t_ns + self._boot_ns, self._say_hello)

    def _say_hello(self, t_ns: int) -> None:
        self._line.send(t_ns, self._reply(lms.POWER_ON, self._state.type_string.encode("ascii")))
        self._resume(self._line.busy_until_ns)

    # --- scanning

    def _due_ns(self) -> int | None:
        if self._stream is None or self._busy_until_ns == float("inf"):
            return None
        return self._mirror.moment_ns(self._next_end)

    def _do_due(self, t_ns: int) -> None:
        """Send the scan that is complete now, unless the line is not done with the one before."""
        assert self._stream is not None
        end = self._next_end
        turns = self._turns(self._stream)
        if self._line.busy_until_ns <= t_ns:
            self._send_paced(end, self._measure(end, self._stream))
            turns *= self._stream.scans
        self._next_end += turns

    def _turns(self, output: Output) -> int:
        """How many turns of the mirror a scan takes."""
        return 1 if output.partial else self.variant.revolutions

    def _measure(self, end: int, output: Output) -> bytes:
        """Return a telegram of what has been measured when turn ``end`` begins."""
        config, partial = self.config, 0
        if output.partial:
            beams, quarter = self._mirror.partial_scan(end)
            partial = 1 << 13 | quarter << 11
            if not self._quirks.flags_in_partials:
                config = config[: lms.MEASURING_MODE] + bytes([IMMEDIATE]) + config[lms.UNIT :]
        else:
            turns = self.variant.revolutions
            ends = range(end - (output.scans - 1) * turns, end + 1, turns)
            beams = mean([self._mirror.scan(each, self.variant) for each in ends])
        data = output.pack(beams, config, partial)
        if config[lms.AVAILABILITY] & lms.INDICES:
            data += bytes([(end - 1) & 0xFF, self._telegrams & 0xFF])
        self._telegrams += 1
        return self._reply(output.code, data)

    def _send_paced(self, turn: int, data: bytes) -> None:
        """Queue a telegram's bytes: at the full rate so many in each turn, else as fast as the line goes."""
        if self._happens(self._quirks.cut_scan):
            data = data[: self._chance.randrange(1, len(data))]
        step = self._state.kind.turn_bytes if self.baud == _FULL_RATE else len(data)
        for i, start in enumerate(range(0, len(data), step)):
            self._line.send(self._mirror.moment_ns(turn + i), data[start : start + step])
