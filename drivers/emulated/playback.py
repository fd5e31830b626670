"""A SPAN receiver that says what a real one once said, and where that one's vehicle was."""

from __future__ import annotations

import csv
from collections.abc import Callable, Collection, Sequence
from pathlib import Path

import numpy as np
import pymap3d

from polecal.drivers.emulated import span_frames as span
from polecal.drivers.emulated.drive import Floats, SampledTrajectory
from polecal.drivers.emulated.span_frames import WEEK_MS, Stamp
from polecal.drivers.emulated.span_logs import LOGS, Form
from polecal.drivers.emulated.span_port import OK, Key, Result, SpanPort, Wanted
from polecal.drivers.emulated.world import Reference

_START_NS = 20_000_000  # from the first accepted log to the first chunk


class PlaybackReceiver(SpanPort):
    """A receiver that says what a real one once said, byte for byte, when that one said it.

    Takes the recording, and where in it and when its chunks arrived (`load_recording`). It plays from the
    moment the first log is accepted, or from ``start_ns``; chunks that fall into a time without a wanted
    log are lost. Only logs in ``supported`` (names without suffix; by default those that the recording
    holds) are accepted. ``on_start`` is told the moment of the first chunk.

    A chunk is there at once at its moment: its arrival was recorded after the line. With ``speed`` so many
    recorded seconds pass in one.
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
        speed: float = 1.0,
    ) -> None:
        super().__init__(t0_ns=t0_ns, seed=seed, baud=baud)
        self._data = data
        self._offsets = [*offsets, len(data)]
        self._due = [round((arrival - arrival_s[0]) * 1e9 / speed) for arrival in arrival_s]
        held = {message_id for _, message_id, _, _ in span.frames(data)}
        self.supported = frozenset(
            (name for name, log in LOGS.items() if log.message_id in held) if supported is None else supported
        )
        self._next = 0
        self._start_ns = start_ns
        self._on_start = on_start

    @property
    def done(self) -> bool:
        """Whether the recording is at its end."""
        return self._next == len(self._due)

    def _factory_logs(self) -> dict[Key, Wanted]:
        return {}

    def _has(self, name: str, form: Form) -> bool:
        return form is Form.BINARY and name in self.supported

    def _accept(
        self, name: str, trigger: str, period_ms: int, offset_ms: int
    ) -> tuple[Result, Wanted | None]:
        return OK, Wanted(trigger)

    def _wanted(self, t_ns: int, key: Key, wanted: Wanted | None) -> None:
        if self._start_ns is None:
            self._start_ns = t_ns + _START_NS

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
