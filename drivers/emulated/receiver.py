"""An emulated SPAN receiver: commands in, logs and replies out, in virtual time (sheet, section 10).

It rides on a world's vehicle; `playback` has one that plays back what a real receiver said.
"""

from __future__ import annotations

import math
import random
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from polecal.drivers.emulated import span_solution as solutions
from polecal.drivers.emulated.drive import Floats
from polecal.drivers.emulated.playback import PlaybackReceiver, load_recording, recorded_path
from polecal.drivers.emulated.span_enums import EventType, EventWord, InsStatus, TimeStatus
from polecal.drivers.emulated.span_frames import WEEK_MS, Stamp
from polecal.drivers.emulated.span_generations import OEM7, Generation
from polecal.drivers.emulated.span_logs import LOGS, ORDER, Form, Paced
from polecal.drivers.emulated.span_port import (
    INVALID_RATE,
    OK,
    STATUS_EVENTS,
    Key,
    Result,
    SpanPort,
    Wanted,
)
from polecal.drivers.emulated.span_solution import Setup, Solution, Triple
from polecal.drivers.emulated.world import World, rotation

__all__ = ["EmulatedReceiver", "Faults", "PlaybackReceiver", "load_recording", "recorded_path"]

_PERIODS_MS = frozenset((5, 10, 20, 50, 100, 200, 250, 500))  # below one second (section 5, rates)
_BUFFER_BYTES = 4096  # that a port holds; logs that do not fit are lost
_BLOCK = 64  # solutions worked out at once
_BLOCK_MS = 1000  # of them, at most: a vehicle that is steered must not be asked far ahead
_ONCE_NS = 20_000_000
_OVERRUN_S = 1.0  # for which the status word speaks of a loss
_STAGE_S = 2.0  # of aligning, at most, but for the last
_NOT_YET = {18: "Almanac/UTC Invalid", 19: "Position Invalid", 22: "Clock Model Invalid"}
"""Bits of the status word after power-up, 004c0000 (section 3.5)."""
_OVERRUN_TEXT = "Port Transmit Buffer Overrun"
_OVERRUN_BITS = {"COM1": 8, "COM2": 9, "COM3": 10}
_LINK_OVERRUN_BIT = 11
_COURSE_MPS = 0.1  # below it the course over ground is taken to be the heading
_MARKS = {1: ("MARKTIME", "MARK1TIME"), 2: ("MARK2TIME",)}
_FLIP = np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, -1]])  # forward, right, down <-> right, forward, up
_GRAVITY_MPS2 = np.array([0.0, 0.0, 9.80665])  # north, east, down
_EARTH_RATE_RADPS = 7.292115e-5
_METRES_A_DEGREE = 111e3  # of latitude


@dataclass(frozen=True, slots=True)
class Faults:
    """What share of the frames goes wrong on its way (section 10, item 4)."""

    bad_crc: float = 0.0
    """A bit flips."""
    truncated: float = 0.0
    """The tail is missing."""
    dropped: float = 0.0
    """Bytes out of the middle are missing, and the status word speaks of an overrun."""

    def apply(self, frame: bytes, chance: random.Random) -> tuple[bytes, bool]:
        """Return what is left of a frame, and whether there was an overrun."""
        fate = chance.random()
        if fate < self.bad_crc:
            i = chance.randrange(12, len(frame))
            return frame[:i] + bytes([frame[i] ^ 1 << chance.randrange(8)]) + frame[i + 1 :], False
        if fate < self.bad_crc + self.truncated:
            return frame[: chance.randrange(1, len(frame))], False
        if fate < self.bad_crc + self.truncated + self.dropped:
            begin, end = sorted(chance.sample(range(len(frame) + 1), 2))
            return frame[:begin] + frame[end:], True
        return frame, False


class _Block(NamedTuple):
    """Solutions of evenly spaced epochs, and for which start of the motion they hold."""

    first_ms: int
    step_ms: int
    start_ns: int | None
    position: list[Triple]
    antenna: list[Triple]
    velocity: list[Triple]
    heading_deg: list[float]
    attitude_deg: list[Triple]
    baseline: list[Triple]


class EmulatedReceiver(SpanPort):
    """A SPAN receiver that rides on the world's vehicle.

    GPS time is ``gps_week`` and ``gps_s0`` at ``t0_ns``, and gains ``drift_ppm`` on the host. Each epoch's
    logs come later than the epoch by ``latency_floor_s`` and an exponential tail of mean
    ``latency_tail_s``, and at whole seconds by another of mean ``whole_second_latency_s``; never earlier.

    With ``fine_after_s`` it has just been powered up: a prompt, week 0, and so long no time. Else it has
    been running and knows the time at once. The INS aligns ``aligned_after_s`` after time is known (inf:
    never); for ``complete_s`` its azimuth then slews from the course over ground to what is right. The
    IMU's forward axis points ``mounting_yaw_deg`` to the right of the vehicle's, and attitudes are the
    IMU's. Inertial solutions are of ``body_offset_s`` after their headers' time.

    ``lever_arm_m`` is the antenna, ``second_antenna_m`` the way from it to the second, in the vehicle's
    frame (forward, right, down). ``also`` are logs (name with suffix, period in s) that somebody else has
    put on the virtual port ``virtual``. ``refused`` are logs that this one lacks beyond its generation.
    """

    def __init__(
        self,
        world: World,
        *,
        t0_ns: int,
        seed: int = 0,
        baud: int = 115200,
        port: str = "COM1",
        generation: Generation = OEM7,
        drift_ppm: float = 12.0,
        latency_floor_s: float = 0.0005,
        latency_tail_s: float = 0.004,
        whole_second_latency_s: float = 0.02,
        gps_week: int = 2400,
        gps_s0: float = 200_000.25,
        fine_after_s: float = 0.0,
        aligned_after_s: float = 3.0,
        complete_s: float = 1.0,
        mounting_yaw_deg: float = 0.0,
        body_offset_s: float = 0.0,
        lever_arm_m: Triple = (-0.3, 0.1, -0.6),
        second_antenna_m: Triple = (0.0, 1.2, 0.0),
        undulation_m: float = 22.5,
        source: int = 0,
        faults: Faults = Faults(),
        also: Iterable[tuple[str, float]] = (),
        virtual: int = 30,
        refused: Collection[str] = (),
    ) -> None:
        super().__init__(t0_ns=t0_ns, seed=seed, baud=baud, port=port, generation=generation)
        self._world = world
        self._t0_ns = t0_ns
        self._seed = seed
        self._rate = 1 + drift_ppm * 1e-6
        self._gps0_ns = gps_week * WEEK_MS * 1_000_000 + round(gps_s0 * 1e9)
        self._floor_s, self._tail_s, self._whole_s = latency_floor_s, latency_tail_s, whole_second_latency_s
        self._fine_ns = round(fine_after_s * 1e9)
        self._aligned_s, self._complete_s = aligned_after_s, complete_s
        self._body_offset_s = body_offset_s
        self._mounting = rotation(np.deg2rad([[0.0, 0.0, mounting_yaw_deg]]))[0]
        self._lever_arm_m = np.array(lever_arm_m)
        self._second_m = np.array(second_antenna_m)
        x, y, z = (_FLIP @ self._mounting.T @ self._lever_arm_m).tolist()
        self._setup = Setup(generation, (x, y, z), undulation=undulation_m)
        self._source = source
        self._faults = faults
        self._fate = random.Random(seed + 1)  # noqa: S311
        self._refused = frozenset(refused)
        self._block: _Block | None = None
        self._overrun_ns: int | None = None
        self._outage: tuple[int, int, InsStatus] | None = None
        self.lost_logs = 0
        """Logs that did not fit into the port's buffer."""
        for message, period_s in also:
            self._log(t0_ns, [message, "ONTIME", str(period_s)], range(virtual, virtual + 1))
        if fine_after_s:
            self._booted()

    def epoch_ns(self, gps_ms: int) -> int:
        """Return the host's moment of a GPS time in ms since the GPS epoch."""
        return self._t0_ns + math.ceil((gps_ms * 1_000_000 - self._gps0_ns) / self._rate)

    def gps_ms(self, t_ns: int) -> int:
        """Return GPS time in whole ms since the GPS epoch at a host's moment."""
        return self._gps_ns(t_ns) // 1_000_000

    def mark(self, t_ns: int, number: int = 1) -> None:
        """Let an event come to an input, 1 or 2, at a host's moment."""
        self._advance(t_ns)
        week, ns = divmod(self._gps_ns(t_ns), WEEK_MS * 1_000_000)
        said = replace(self._solution(self.gps_ms(t_ns)), mark=(week, round(ns, -1) / 1e9))  # to 10 ns
        self._happen(t_ns, [key for key in self._logs if key.name in _MARKS[number]], [said])
        self._send(t_ns, self.gps_ms(t_ns), [key for key, w in self._logs.items() if w.trigger == "ONMARK"])

    def lose_solution(
        self, t_ns: int, seconds: float, status: InsStatus = InsStatus.INS_SOLUTION_FREE
    ) -> None:
        """Have no good solution for a while from ``t_ns`` on: it drifts to the north by 1 m a second."""
        self._outage = t_ns, t_ns + round(seconds * 1e9), status

    # --- commands

    def _has(self, name: str, form: Form) -> bool:
        return self._generation.has(name) and name not in self._refused

    def _accept(
        self, name: str, trigger: str, period_ms: int, offset_ms: int
    ) -> tuple[Result, Wanted | None]:
        log, imu_ms = LOGS[name], self._generation.imu.period_ms
        allowed = {Paced.IMU: ("ONNEW", "ONCHANGED", "ONALL"), Paced.EVENT: ("ONNEW", "ONALL")}
        if trigger not in allowed.get(log.paced, (trigger,)):
            return (14, f"Trigger {trigger} not valid for this log"), None
        if trigger == "ONTIME":
            whole = period_ms >= 1000 and period_ms % 1000 == 0
            fastest_ms = max(log.fastest_ms, imu_ms) if log.ins else log.fastest_ms
            if not (whole or period_ms in _PERIODS_MS) or period_ms < fastest_ms:
                return INVALID_RATE, None
            return OK, Wanted(trigger, period_ms, offset_ms)
        if trigger in ("ONCE", "ONNEXT"):
            return OK, None
        if trigger == "ONMARK" or log.paced in (Paced.CHANGE, Paced.EVENT):
            return OK, Wanted(trigger)
        return OK, Wanted(trigger, imu_ms if log.paced is Paced.IMU else log.natural_ms)

    def _wanted(self, t_ns: int, key: Key, wanted: Wanted | None) -> None:
        if wanted is not None and wanted.period_ms:
            self._plan(t_ns, wanted)
        elif wanted is None or (LOGS[key.name].paced is Paced.CHANGE and wanted.trigger != "ONMARK"):
            self._at(t_ns + _ONCE_NS, lambda now_ns: self._send(now_ns, self.gps_ms(now_ns), [key]))

    def _plan(self, t_ns: int, wanted: Wanted) -> None:
        now_ms = self.gps_ms(t_ns) - wanted.offset_ms
        wanted.due_ms = (now_ms // wanted.period_ms + 1) * wanted.period_ms + wanted.offset_ms

    def _rotation(self, words: list[str]) -> Result:
        try:
            x, y, z = (float(word) for word in words[:3])
        except ValueError:
            return (9, "Missing field")
        self._setup = replace(self._setup, rotation=(x, y, z))
        return OK

    def _booted(self) -> None:
        super()._booted()
        self._overrun_ns = None
        for wanted in self._logs.values():
            if wanted.period_ms:
                self._plan(self._up_ns, wanted)
        if self._fine_ns:
            self._at(self._up_ns + self._fine_ns, self._found_time)

    # --- status

    def _found_time(self, t_ns: int) -> None:
        if t_ns == self._up_ns + self._fine_ns:  # not restarted since
            self._status_changed(t_ns, _NOT_YET, EventType.CLEAR)

    def _overran(self, t_ns: int) -> None:
        first = self._overrun_ns is None
        self._overrun_ns = t_ns
        if first:
            self._status_changed(t_ns, {self._overrun_bit: _OVERRUN_TEXT}, EventType.SET)
            self._at(t_ns + round(_OVERRUN_S * 1e9), self._overrun_over)

    def _overrun_over(self, t_ns: int) -> None:
        if self._overrun_ns is None:
            return
        quiet_ns = self._overrun_ns + round(_OVERRUN_S * 1e9)
        if t_ns < quiet_ns:
            self._at(quiet_ns, self._overrun_over)
        else:
            self._overrun_ns = None
            self._status_changed(t_ns, {self._overrun_bit: _OVERRUN_TEXT}, EventType.CLEAR)

    @property
    def _overrun_bit(self) -> int:
        if not self._generation.own_overrun_bits and self._serial:
            return _OVERRUN_BITS["COM1"]
        return _OVERRUN_BITS.get(self.port, _LINK_OVERRUN_BIT)

    def _status_changed(self, t_ns: int, bits: dict[int, str], event: EventType) -> None:
        """Say it in RXSTATUSEVENT, an event a bit in a sequence that counts down, and in RXSTATUS."""
        now = self._solution(self.gps_ms(t_ns))
        said = [
            replace(
                now, stamp=replace(now.stamp, sequence=i), event=(EventWord.STATUS, bit, event, bits[bit])
            )
            for i, bit in zip(reversed(range(len(bits))), bits, strict=True)
        ]
        self._happen(t_ns, [key for key in self._logs if key.name == STATUS_EVENTS.name], said)
        changing = [
            key for key, wanted in self._logs.items() if wanted.trigger in ("ONCHANGED", "ONNEW", "ONALL")
        ]
        self._happen(t_ns, [key for key in changing if key.name == "RXSTATUS"], [now])

    def _happen(self, t_ns: int, keys: Iterable[Key], said: Sequence[Solution]) -> None:
        ready_ns = t_ns + round(self._floor_s * 1e9)
        for key in keys:
            for solution in said:
                self._put(ready_ns, key, solution)

    # --- logs

    def _due_ns(self) -> int | None:
        due_ms = [wanted.due_ms for wanted in self._logs.values() if wanted.period_ms]
        return self.epoch_ns(min(due_ms)) if due_ms else None

    def _do_due(self, t_ns: int) -> None:
        epoch_ms = min(wanted.due_ms for wanted in self._logs.values() if wanted.period_ms)
        due = {key: w for key, w in self._logs.items() if w.period_ms and w.due_ms == epoch_ms}
        for wanted in due.values():
            wanted.due_ms += wanted.period_ms
        chance = random.Random(self._seed * 1_000_003 + epoch_ms)  # noqa: S311
        late_s = self._floor_s
        late_s += chance.expovariate(1 / self._tail_s) if self._tail_s else 0.0
        if epoch_ms % 1000 == 0 and self._whole_s:
            late_s += chance.expovariate(1 / self._whole_s)
        keys = sorted(due, key=lambda key: (ORDER[key.name], key.virtual, key.form.value))
        self._send(t_ns + math.ceil(late_s * 1e9), epoch_ms, keys)

    def _send(self, ready_ns: int, epoch_ms: int, keys: Sequence[Key]) -> None:
        solution = self._solution(epoch_ms)
        for key in keys:
            log = LOGS[key.name]
            if log.ins and not solution.fine:
                continue  # inertial data starts after FINESTEERING (section 3.4)
            if log.increments:
                period_ms = self._generation.imu.period_ms
                wanted = self._logs.get(key)
                if self._generation.accumulates and wanted is not None:
                    period_ms = wanted.period_ms or period_ms
                moved = self._increment(epoch_ms, period_ms, raw=log.paced is Paced.IMU)
                self._put(ready_ns, key, replace(solution, increment=moved))
            else:
                self._put(ready_ns, key, solution)

    def _put(self, ready_ns: int, key: Key, solution: Solution) -> None:
        if ready_ns < self._up_ns:
            return
        stamp = replace(solution.stamp, virtual=key.virtual)
        definition = self._generation.definition(key.name)
        frame = LOGS[key.name].frame(key.name, solution, stamp, form=key.form, definition=definition)
        waiting = max(0.0, self._line.busy_until_ns - ready_ns) / self._line.byte_ns
        if waiting + len(frame) > _BUFFER_BYTES:
            self.lost_logs += 1
            self._overran(ready_ns)
            return
        frame, overrun = self._faults.apply(frame, self._fate)
        self._line.send(ready_ns, frame)
        if overrun:
            self._overran(ready_ns)

    def _gps_ns(self, t_ns: int) -> int:
        return self._gps0_ns + math.floor((t_ns - self._t0_ns) * self._rate)

    def _stamp(self, t_ns: int) -> Stamp:
        return self._stamp_of(self.gps_ms(t_ns))

    def _stamp_of(self, gps_ms: int) -> Stamp:
        week, ms = divmod(gps_ms, WEEK_MS)
        status, time_status = self._generation.status, TimeStatus.FINESTEERING
        if self.epoch_ns(gps_ms) < self._up_ns + self._fine_ns:
            time_status = TimeStatus.UNKNOWN
            status |= sum(1 << bit for bit in _NOT_YET)
            week, ms = 0, gps_ms - self.gps_ms(self._up_ns) // 1000 * 1000  # since power-up, about
        if self._overrun_ns is not None:
            status |= 1 << self._overrun_bit
        build = self._generation.build
        return Stamp(week, ms, status, self.port, source=self._source, time_status=time_status, build=build)

    def _solution(self, epoch_ms: int) -> Solution:
        block = self._block_with(epoch_ms)
        i = (epoch_ms - block.first_ms) // block.step_ms
        solution = Solution(
            self._stamp_of(epoch_ms), solutions.PLACEHOLDER, solutions.ZERO, solutions.ZERO, block.antenna[i],
            InsStatus.INS_ALIGNING, solutions.NO_SIGMA, self._body_offset_s, self._setup, block.baseline[i],
        )  # fmt: skip
        fine_for_s = (self.epoch_ns(epoch_ms) - self._up_ns - self._fine_ns) * 1e-9
        aligned_for_s = fine_for_s - self._aligned_s
        if aligned_for_s < 0:
            stages = self._generation.aligning
            stage = int(max(fine_for_s, 0.0) / min(self._aligned_s / len(stages), _STAGE_S))
            return replace(solution, ins_status=stages[min(stage, len(stages) - 1)])
        solution = replace(
            solution,
            position=block.position[i],
            velocity=block.velocity[i],
            attitude=block.attitude_deg[i],
            ins_status=InsStatus.INS_SOLUTION_GOOD,
            sigma=solutions.GOOD_SIGMA,
        )
        if aligned_for_s >= self._complete_s:
            return self._as_lost(solution, self.epoch_ns(epoch_ms))
        speed, course, _ = solution.course
        roll, pitch, azimuth = solution.attitude
        seed = course if speed > _COURSE_MPS else block.heading_deg[i]
        slewed = seed + ((azimuth - seed + 180) % 360 - 180) * aligned_for_s / self._complete_s
        return replace(
            solution,
            attitude=(roll, pitch, slewed % 360),
            ins_status=InsStatus.INS_ALIGNMENT_COMPLETE,
            sigma=solutions.COMPLETE_SIGMA,
        )

    def _as_lost(self, solution: Solution, t_ns: int) -> Solution:
        if self._outage is None or not self._outage[0] <= t_ns < self._outage[1]:
            return solution
        begin_ns, _, status = self._outage
        lat_deg, lon_deg, height_m = solution.position
        off_deg = (t_ns - begin_ns) * 1e-9 / _METRES_A_DEGREE
        position = (lat_deg + off_deg, lon_deg, height_m)
        return replace(solution, position=position, ins_status=status, sigma=solutions.COMPLETE_SIGMA)

    def _moments(self, first_ms: int, step_ms: int, count: int) -> list[int]:
        """Return the host's moments of inertial solutions, which their headers' time is not."""
        late_ns = round(self._body_offset_s / self._rate * 1e9)
        return [self.epoch_ns(first_ms + i * step_ms) + late_ns for i in range(count)]

    def _block_with(self, epoch_ms: int) -> _Block:
        """Return solutions that hold this epoch: many are worked out at once, since that costs the same."""
        block = self._block
        if block is not None and block.start_ns == self._world.start_ns:
            i, odd = divmod(epoch_ms - block.first_ms, block.step_ms)
            if not odd and 0 <= i < len(block.position):
                return block
        step_ms = min((wanted.period_ms for wanted in self._logs.values() if wanted.period_ms), default=1)
        count = max(1, min(_BLOCK, _BLOCK_MS // step_ms))
        position, rpy, velocity = self._world.nav(
            self._world.seconds(self._moments(epoch_ms, step_ms, count))
        )
        moments = [self.epoch_ns(epoch_ms + i * step_ms) for i in range(count)]
        at, leaning, _ = self._world.nav(self._world.seconds(moments))
        body = rotation(leaning)
        second = body @ self._second_m
        length = np.linalg.norm(second, axis=1)
        baseline = (length, _azimuth_deg(second), np.rad2deg(np.arcsin(-second[:, 2] / length)))
        self._block = _Block(
            epoch_ms,
            step_ms,
            self._world.start_ns,
            _triples(*self._world.geodetic(position)),
            _triples(*self._world.geodetic(at + body @ self._lever_arm_m)),
            _triples(*(velocity * [1.0, 1.0, -1.0]).T),
            np.rad2deg(rpy[:, 2]).tolist(),
            _triples(*_attitude_deg(rotation(rpy) @ self._mounting)),
            _triples(*baseline),
        )
        return self._block

    def _increment(self, epoch_ms: int, interval_ms: int, *, raw: bool) -> tuple[float, ...]:
        """Return what the IMU summed up before an epoch, in its axes (right, forward, up): rad, m/s.

        The earth's rate and gravity are in it if it is raw.
        """
        step_ms = self._generation.imu.period_ms
        count = max(1, round(interval_ms / step_ms))
        moments = self._moments(epoch_ms - count * step_ms, step_ms, count + 1)
        _, rpy, velocity = self._world.nav(self._world.seconds(moments))
        axes = rotation(rpy) @ self._mounting
        turned = np.swapaxes(axes[:-1], 1, 2) @ axes[1:]
        angle = np.stack([turned[:, 2, 1] - turned[:, 1, 2], turned[:, 0, 2] - turned[:, 2, 0],
                          turned[:, 1, 0] - turned[:, 0, 1]], axis=1) / 2  # fmt: skip
        pushed = np.diff(velocity, axis=0)
        if raw:
            lat = np.deg2rad(self._world.reference.lat_deg)
            earth = _EARTH_RATE_RADPS * np.array([np.cos(lat), 0.0, -np.sin(lat)])
            angle += np.einsum("nji,j->ni", axes[:-1], earth) * step_ms * 1e-3
            pushed -= _GRAVITY_MPS2 * step_ms * 1e-3
        felt = np.einsum("nji,nj->ni", (axes[:-1] + axes[1:]) / 2, pushed)
        return (*(_FLIP @ angle.sum(axis=0)).tolist(), *(_FLIP @ felt.sum(axis=0)).tolist())


def _triples(x: Floats, y: Floats, z: Floats) -> list[Triple]:
    return list(zip(x.tolist(), y.tolist(), z.tolist(), strict=True))


def _azimuth_deg(way: Floats) -> Floats:
    return np.asarray(np.rad2deg(np.arctan2(way[:, 1], way[:, 0])) % 360)


def _attitude_deg(axes: Floats) -> tuple[Floats, Floats, Floats]:
    """Return roll, pitch and azimuth of rotations (N, 3, 3) from the body to north, east, down."""
    roll = np.rad2deg(np.arctan2(axes[:, 2, 1], axes[:, 2, 2]))
    return roll, np.rad2deg(-np.arcsin(axes[:, 2, 0])), _azimuth_deg(axes[:, :, 0])
