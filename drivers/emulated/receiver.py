"""An emulated SPAN receiver: commands in, logs and replies out, in virtual time (sheet, section 10).

Either it sees a world, or it plays back what a real receiver said.
"""

from __future__ import annotations

import csv
import math
import random
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pymap3d

from polecal.drivers.emulated import span_frames as span
from polecal.drivers.emulated.drive import Floats, SampledTrajectory
from polecal.drivers.emulated.span_frames import LOGS, WEEK_MS, InsStatus, Solution, Stamp
from polecal.drivers.emulated.span_port import INVALID_MESSAGE, INVALID_RATE, Result, SpanPort
from polecal.drivers.emulated.world import Reference, World, rotation

_PERIODS_MS = frozenset((5, 10, 20, 50, 100, 200, 250, 500))  # below one second (section 5, rates)
_BUFFER_BYTES = 4096  # that a port holds; logs that do not fit are lost
_OVERRUN = 1 << 8  # of the receiver's status word
_ORDER = {name: i for i, name in enumerate(LOGS)}
_BLOCK = 64  # solutions worked out at once
_COMPLETE_S = 1.0  # of INS_ALIGNMENT_COMPLETE before INS_SOLUTION_GOOD
_ONCE_NS = 20_000_000


@dataclass(slots=True)
class _Wanted:
    period_ms: int
    offset_ms: int
    due_ms: int


class _Block(NamedTuple):
    """Solutions of evenly spaced epochs, and for which start of the motion they hold."""

    first_ms: int
    step_ms: int
    start_ns: int | None
    position: tuple[list[float], ...]
    antenna: tuple[list[float], ...]
    velocity: list[list[float]]
    attitude_deg: list[list[float]]


class EmulatedReceiver(SpanPort):
    """A SPAN receiver that rides on the world's vehicle.

    GPS time is ``gps_week`` and ``gps_s0`` at ``t0_ns``, and gains ``drift_ppm`` on the host. Each epoch's
    logs come later than the epoch by ``latency_floor_s`` and an exponential tail of mean
    ``latency_tail_s``, and at whole seconds by another of mean ``whole_second_latency_s``; never earlier.
    The INS aligns after ``aligned_after_s`` (inf: never). ``lever_arm_m`` is the antenna in the body frame.
    """

    def __init__(
        self,
        world: World,
        *,
        t0_ns: int,
        seed: int = 0,
        baud: int = 115200,
        drift_ppm: float = 12.0,
        latency_floor_s: float = 0.0005,
        latency_tail_s: float = 0.004,
        whole_second_latency_s: float = 0.02,
        gps_week: int = 2400,
        gps_s0: float = 200_000.25,
        aligned_after_s: float = 3.0,
        lever_arm_m: tuple[float, float, float] = (-0.3, 0.1, -0.6),
        refused: Collection[str] = (),
    ) -> None:
        super().__init__(t0_ns=t0_ns, seed=seed, baud=baud)
        self._world = world
        self._t0_ns = t0_ns
        self._seed = seed
        self._rate = 1 + drift_ppm * 1e-6
        self._gps0_ns = gps_week * WEEK_MS * 1_000_000 + round(gps_s0 * 1e9)
        self._floor_s, self._tail_s, self._whole_s = latency_floor_s, latency_tail_s, whole_second_latency_s
        self._aligned_s = aligned_after_s
        self._lever_arm_m = np.array(lever_arm_m)
        self._refused = frozenset(refused)
        self._logs: dict[str, _Wanted] = {}
        self._block: _Block | None = None
        self._overrun = False
        self.lost_logs = 0
        """Logs that did not fit into the port's buffer."""

    def epoch_ns(self, gps_ms: int) -> int:
        """Return the host's moment of a GPS time in ms since the GPS epoch."""
        return self._t0_ns + math.ceil((gps_ms * 1_000_000 - self._gps0_ns) / self._rate)

    def gps_ms(self, t_ns: int) -> int:
        """Return GPS time in whole ms since the GPS epoch at a host's moment."""
        return (self._gps0_ns + math.floor((t_ns - self._t0_ns) * self._rate)) // 1_000_000

    # --- commands

    def _wanted(self, t_ns: int, message: str, trigger: str, period_s: float, offset_s: float) -> Result:
        name = message.removesuffix("B")
        if name == message or name not in LOGS or name in self._refused:
            return INVALID_MESSAGE
        log = LOGS[name]
        if trigger == "ONTIME":
            period_ms, offset_ms = round(period_s * 1000), round(offset_s * 1000)
            whole = period_ms >= 1000 and period_ms % 1000 == 0
            if not (whole or period_ms in _PERIODS_MS) or period_ms < log.fastest_ms:
                return INVALID_RATE
        else:
            period_ms, offset_ms = log.natural_ms if trigger == "ONNEW" else 0, 0
        if period_ms:
            now_ms = self.gps_ms(t_ns) - offset_ms
            due_ms = (now_ms // period_ms + 1) * period_ms + offset_ms
            self._logs[name] = _Wanted(period_ms, offset_ms, due_ms)
        else:
            self._at(t_ns + _ONCE_NS, lambda now_ns: self._send(now_ns, self.gps_ms(now_ns), [name]))
        return (1, "OK")

    def _unlog(self, message: str) -> Result:
        self._logs.pop(message.removesuffix("B"), None)
        return (1, "OK")

    def _unlog_all(self) -> None:
        self._logs.clear()

    # --- logs

    def _due_ns(self) -> int | None:
        if not self._logs:
            return None
        return self.epoch_ns(min(wanted.due_ms for wanted in self._logs.values()))

    def _do_due(self, t_ns: int) -> None:
        epoch_ms = min(wanted.due_ms for wanted in self._logs.values())
        names = [name for name, wanted in self._logs.items() if wanted.due_ms == epoch_ms]
        for name in names:
            self._logs[name].due_ms += self._logs[name].period_ms
        chance = random.Random(self._seed * 1_000_003 + epoch_ms)  # noqa: S311
        late_s = self._floor_s
        late_s += chance.expovariate(1 / self._tail_s) if self._tail_s else 0.0
        if epoch_ms % 1000 == 0 and self._whole_s:
            late_s += chance.expovariate(1 / self._whole_s)
        self._send(t_ns + math.ceil(late_s * 1e9), epoch_ms, sorted(names, key=_ORDER.__getitem__))

    def _send(self, ready_ns: int, epoch_ms: int, names: Sequence[str]) -> None:
        solution = self._solution(epoch_ms)
        for name in names:
            frame = LOGS[name].frame(solution)
            waiting = max(0.0, self._line.busy_until_ns - ready_ns) / self._line.byte_ns
            self._overrun = waiting + len(frame) > _BUFFER_BYTES
            if self._overrun:
                self.lost_logs += 1
            else:
                self._line.send(ready_ns, frame)

    def _stamp(self, t_ns: int) -> Stamp:
        return self._stamp_of(self.gps_ms(t_ns))

    def _stamp_of(self, gps_ms: int) -> Stamp:
        stamp = Stamp(gps_ms // WEEK_MS, gps_ms % WEEK_MS)
        return replace(stamp, status=stamp.status | _OVERRUN) if self._overrun else stamp

    def _solution(self, epoch_ms: int) -> Solution:
        block = self._block_with(epoch_ms)
        i = (epoch_ms - block.first_ms) // block.step_ms
        stamp = self._stamp_of(epoch_ms)
        lat, lon, height = (column[i] for column in block.antenna)
        aligned_for_s = (self.epoch_ns(epoch_ms) - self._t0_ns) * 1e-9 - self._aligned_s
        if aligned_for_s < 0:
            return span.unaligned(stamp, (lat, lon, height))
        status = InsStatus.ALIGNMENT_COMPLETE if aligned_for_s < _COMPLETE_S else InsStatus.SOLUTION_GOOD
        north, east, down = block.velocity[i]
        roll, pitch, yaw = block.attitude_deg[i]
        p_lat, p_lon, p_height = (column[i] for column in block.position)
        return Solution(
            stamp,
            (p_lat, p_lon, p_height),
            (north, east, -down),
            (roll, pitch, yaw % 360),
            (lat, lon, height),
            status,
        )

    def _block_with(self, epoch_ms: int) -> _Block:
        """Return solutions that hold this epoch: many are worked out at once, since that costs the same."""
        block = self._block
        if block is not None and block.start_ns == self._world.start_ns:
            i, odd = divmod(epoch_ms - block.first_ms, block.step_ms)
            if not odd and 0 <= i < _BLOCK:
                return block
        step_ms = min((wanted.period_ms for wanted in self._logs.values()), default=1)
        moments = [self.epoch_ns(epoch_ms + i * step_ms) for i in range(_BLOCK)]
        position, rpy, velocity = self._world.nav(self._world.seconds(moments))
        antenna = position + rotation(rpy) @ self._lever_arm_m
        self._block = _Block(
            epoch_ms,
            step_ms,
            self._world.start_ns,
            tuple(column.tolist() for column in self._world.geodetic(position)),
            tuple(column.tolist() for column in self._world.geodetic(antenna)),
            velocity.tolist(),
            np.rad2deg(rpy).tolist(),
        )
        return self._block


class PlaybackReceiver(SpanPort):
    """A receiver that says what a real one once said, byte for byte, when that one said it.

    Takes the recording, and where in it and when its chunks arrived (`load_recording`). It plays from the
    moment the first log is accepted, or from ``start_ns``; chunks that fall into a time without a wanted
    log are lost. Only logs in ``supported`` (names without suffix; by default those that the recording
    holds) are accepted. ``on_start`` is told the moment of the first chunk.

    A chunk is there at once at its moment: its arrival was recorded after the line.
    """

    def __init__(
        self,
        data: bytes,
        offsets: Sequence[int],
        arrival_s: Sequence[float],
        *,
        t0_ns: int,
        seed: int = 0,
        baud: int = 115200,
        supported: Collection[str] | None = None,
        start_ns: int | None = None,
        on_start: Callable[[int], None] | None = None,
    ) -> None:
        super().__init__(t0_ns=t0_ns, seed=seed, baud=baud)
        self._data = data
        self._offsets = [*offsets, len(data)]
        self._due = [round((arrival - arrival_s[0]) * 1e9) for arrival in arrival_s]
        held = {message_id for _, message_id, _, _ in span.frames(data)}
        self.supported = frozenset(
            (name for name, log in LOGS.items() if log.message_id in held) if supported is None else supported
        )
        self._logs: set[str] = set()
        self._next = 0
        self._start_ns = start_ns
        self._on_start = on_start

    @property
    def done(self) -> bool:
        """Whether the recording is at its end."""
        return self._next == len(self._due)

    def _wanted(self, t_ns: int, message: str, trigger: str, period_s: float, offset_s: float) -> Result:
        name = message.removesuffix("B")
        if name == message or name not in self.supported:
            return INVALID_MESSAGE
        self._logs.add(name)
        if self._start_ns is None:
            self._start_ns = t_ns + _ONCE_NS
        return (1, "OK")

    def _unlog(self, message: str) -> Result:
        self._logs.discard(message.removesuffix("B"))
        return (1, "OK")

    def _unlog_all(self) -> None:
        self._logs.clear()

    def _due_ns(self) -> int | None:
        if self.done or self._start_ns is None:
            return None
        return self._start_ns + self._due[self._next]

    def _do_due(self, t_ns: int) -> None:
        if self._next == 0 and self._on_start is not None:
            self._on_start(t_ns)
        begin, end = self._offsets[self._next : self._next + 2]
        self._next += 1
        if self._logs:
            self._line.say(self._data[begin:end])

    def _stamp(self, t_ns: int) -> Stamp:
        return Stamp(0, 0)


def load_recording(path: Path) -> tuple[bytes, list[int], list[float]]:
    """Return a recording's bytes, chunk offsets and arrival times (s) from ``X.bin``, ``X.arrivals.csv``."""
    with path.with_suffix(".arrivals.csv").open(newline="") as file:
        rows = list(csv.reader(file))[1:]
    return path.read_bytes(), [int(row[0]) for row in rows], [float(row[1]) for row in rows]


def recorded_path(
    data: bytes, offsets: Sequence[int], arrival_s: Sequence[float]
) -> tuple[SampledTrajectory, Reference]:
    """Return where a recorded vehicle was, by its own INSPVAX logs: about its first pose, in host time.

    Time 0 is the first chunk's arrival, as `PlaybackReceiver` tells ``on_start``. GPS time is laid along
    the lower edge of the arrivals: none came before its epoch.
    """
    rows: list[tuple[float, ...]] = []
    for end, message_id, body, stamp in span.frames(data):
        if message_id == LOGS["INSPVAX"].message_id:
            lat, lon, height, undulation, *rest = np.frombuffer(
                body, "<f8, <f8, <f8, <f4, <f8, <f8, <f8, <f8, <f8, <f8", count=1, offset=8
            )[0].tolist()
            arrived = arrival_s[int(np.searchsorted(offsets, end - 1, side="right")) - 1] - arrival_s[0]
            gps_s = stamp.week * WEEK_MS / 1000 + stamp.ms / 1000
            rows.append((gps_s, arrived, lat, lon, height + undulation, *rest))
    table = np.array(rows)
    gps_s, arrived, lat, lon, height = table[:, :5].T
    origin = Reference(float(lat[0]), float(lon[0]), float(height[0]))
    ned = pymap3d.geodetic2ned(lat, lon, height, origin.lat_deg, origin.lon_deg, origin.height_m)
    velocity = table[:, 5:8] * [1.0, 1.0, -1.0]
    path = SampledTrajectory(
        _lower_edge(gps_s - gps_s[0], arrived), np.column_stack(ned), np.deg2rad(table[:, 8:11]), velocity
    )
    return path, origin


def _lower_edge(x: Floats, y: Floats) -> Floats:
    """Return the line under all points (x, y) that leaves the least between, at x."""
    late = y - x
    hull: list[int] = []
    for i in range(len(x)):  # the lower convex hull, left to right
        while len(hull) > 1:
            a, b = hull[-2:]
            if (late[b] - late[a]) * (x[i] - x[a]) < (late[i] - late[a]) * (x[b] - x[a]):
                break
            hull.pop()
        hull.append(i)
    middle = x.mean()
    k = int(np.searchsorted(x[hull], middle)) - 1
    a, b = hull[k], hull[k + 1]
    slope = (late[b] - late[a]) / (x[b] - x[a])
    return np.asarray(x + late[a] + slope * (x - x[a]))
