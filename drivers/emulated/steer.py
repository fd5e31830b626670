"""A drive laid out by somebody else to a vehicle that follows it: GeoJSON in, motion as time goes on out.

The vehicle knows nothing but the lines that it is given: each has a ``direction`` (forward or reverse) and
a ``speed_mps``. It steers by pure pursuit, with a steering that lags and a hand that is not quite steady.
"""

from __future__ import annotations

import json
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import groupby
from math import atan2, cos, exp, hypot, pi, sin, sqrt

import numpy as np
from numpy.typing import ArrayLike

from polecal.drivers.emulated.drive import Floats, Uneven

_TICK_S = 0.01
_ACCELERATION_MPS2 = 1.0
_LAG_S = 0.25  # of the steering, and of the pedals
_AHEAD_M, _AHEAD_S = 1.0, 0.35  # how far along its line the vehicle looks: so far, and what it drives in that
_UNSTEADY = 0.006  # of the curvature, 1/m: 1 σ, over about a second
_UNSTEADY_S = 1.0
_THERE_M = 0.03
_STANDS_MPS = 0.02
_WINDOW_M = 3.0  # within which a line is looked for: farther on it may cross itself
_MORE = 4096  # ticks that room is made for at once


@dataclass(frozen=True, slots=True)
class Line:
    """A line over the ground (N, 2) north and east in m, and how to drive it: 1 forward, -1 in reverse."""

    points_m: Floats
    way: int
    speed_mps: float


def lines(text: str, local: Callable[[Floats, Floats], Floats]) -> list[Line]:
    """Read a route's lines from GeoJSON; ``local`` turns latitudes and longitudes into north and east."""
    found = []
    for feature in json.loads(text)["features"]:
        if feature["geometry"]["type"] == "LineString":
            lon, lat = np.array(feature["geometry"]["coordinates"], np.float64)[:, :2].T
            about = feature["properties"]
            way = -1 if about["direction"] == "reverse" else 1
            found.append(Line(local(lat, lon), way, float(about["speed_mps"])))
    return found


class _Run:
    """Lines in one direction, joined; it ends where the vehicle must stop."""

    def __init__(self, joined: Sequence[Line]) -> None:
        self.way = joined[0].way
        points = np.concatenate([line.points_m for line in joined])
        speed = np.concatenate([np.full(len(line.points_m), line.speed_mps) for line in joined])
        moved = np.concatenate([[True], np.linalg.norm(np.diff(points, axis=0), axis=1) > 1e-3])
        points, speed = points[moved], speed[moved]
        along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
        speed[-1] = 0.0
        for k in range(len(speed) - 2, -1, -1):  # so that it can brake in time
            room = 2 * 0.8 * _ACCELERATION_MPS2 * (along[k + 1] - along[k])
            speed[k] = min(speed[k], sqrt(speed[k + 1] ** 2 + room))
        self.length_m = float(along[-1])
        self.along_m = 0.0
        """How far the vehicle has come."""
        self._along, self._speed = along, speed
        self._north, self._east = points.T
        end = points[-1] - points[-2] if len(points) > 1 else np.array([1.0, 0.0])
        self._last = end / np.linalg.norm(end)

    def nearest_m(self, north: float, east: float, from_m: float) -> float:
        """Return how far along the run is nearest, no farther on than 3 m from where that was."""
        along = np.linspace(from_m, min(self.length_m, from_m + _WINDOW_M), 61)
        off = np.hypot(
            np.interp(along, self._along, self._north) - north,
            np.interp(along, self._along, self._east) - east,
        )
        return float(along[int(np.argmin(off))])

    def at(self, along_m: float) -> tuple[float, float]:
        """Return a point of the run, straight on beyond its end."""
        over = max(0.0, along_m - self.length_m)
        return (
            float(np.interp(along_m, self._along, self._north)) + over * float(self._last[0]),
            float(np.interp(along_m, self._along, self._east)) + over * float(self._last[1]),
        )

    def speed_mps(self, along_m: float) -> float:
        return float(np.interp(along_m, self._along, self._speed))


class Steered:
    """A vehicle that stands until it is told lines to follow, and once it has followed them.

    ``begin`` is north, east (m) and heading (rad). What it was asked about has happened: whatever it is told
    takes effect from the latest moment on that `pose` was asked for.
    """

    def __init__(
        self,
        begin: tuple[float, float, float],
        *,
        seed: int = 0,
        turn_radius_m: float = 3.0,
        clearance_m: float = 0.1,
    ) -> None:
        rng = np.random.default_rng([seed, 4])
        self._ground = Uneven(rng, clearance_m)
        self._rng = rng
        self._sharpest = 1 / (0.85 * turn_radius_m)  # so that it can come back to a line
        self._state = np.zeros((_MORE, 4))  # north, east, heading, speed along it, tick by tick
        self._state[0, :3] = begin
        self._count = 1
        self._runs: deque[_Run] = deque()
        self._curvature = self._unsteady = self._speed = 0.0

    @property
    def idle(self) -> bool:
        """Whether it has nothing to follow any more, and stands."""
        return not self._runs and abs(self._speed) < _STANDS_MPS

    @property
    def path_m(self) -> Floats:
        """Where it has been: (N, 2) m, north and east, every 10 ms."""
        return self._state[: self._count, :2].copy()

    def follow(self, orders: Sequence[Line]) -> None:
        """Follow these lines instead of any others; may be called from another thread than `pose`."""
        self._runs = deque(_Run(list(group)) for _, group in groupby(orders, key=lambda line: line.way))

    def pose(self, t_s: ArrayLike) -> tuple[Floats, Floats, Floats]:
        """Return position, roll pitch yaw (yaw not wrapped) and velocity, as `Trajectory` says."""
        tick = np.maximum(np.atleast_1d(np.asarray(t_s, np.float64)), 0.0) / _TICK_S
        while self._count < tick.max() + 2:
            self._step()
        before = tick.astype(np.int64)
        share = (tick - before)[:, None]
        north, east, yaw, speed = ((1 - share) * self._state[before] + share * self._state[before + 1]).T
        return self._ground.body(north, east, yaw, speed)

    def _step(self) -> None:
        if self._count == len(self._state):
            self._state = np.concatenate([self._state, np.zeros((max(_MORE, self._count), 4))])
        north, east, heading, _ = self._state[self._count - 1].tolist()
        keep = exp(-_TICK_S / _UNSTEADY_S)
        self._unsteady = keep * self._unsteady + sqrt(1 - keep**2) * _UNSTEADY * float(self._rng.normal())
        wish_mps, curvature = self._wish(north, east, heading)
        share = _TICK_S / _LAG_S
        most = _ACCELERATION_MPS2 * _TICK_S
        self._speed += max(-most, min(most, wish_mps - self._speed))
        self._curvature += share * (curvature + self._unsteady - self._curvature)
        moved = self._speed * _TICK_S
        middle = heading + abs(moved) * self._curvature / 2
        self._state[self._count] = (
            north + moved * cos(middle),
            east + moved * sin(middle),
            heading + abs(moved) * self._curvature,
            self._speed,
        )
        self._count += 1

    def _wish(self, north: float, east: float, heading: float) -> tuple[float, float]:
        """Return the speed that it wants, and the curvature of where it goes (to the right), 1/m."""
        runs = self._runs
        if not runs:
            return 0.0, 0.0
        run = runs[0]
        run.along_m = run.nearest_m(north, east, run.along_m)
        if run.length_m - run.along_m < _THERE_M:
            if abs(self._speed) < _STANDS_MPS:
                runs.popleft()
            return 0.0, self._curvature
        ahead_m = _AHEAD_M + _AHEAD_S * abs(self._speed)
        to_north, to_east = run.at(run.along_m + ahead_m)
        away_m = max(hypot(to_north - north, to_east - east), 0.3)
        course = heading if run.way > 0 else heading + pi
        aside = sin(atan2(to_east - east, to_north - north) - course)
        curvature = max(-self._sharpest, min(self._sharpest, 2 * aside / away_m))
        creep = max(run.speed_mps(run.along_m), 0.1)
        if self._speed * run.way < -_STANDS_MPS:
            return 0.0, curvature
        return run.way * creep, curvature
