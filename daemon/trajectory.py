"""Nav states to the pose, and its rate of change, at any beam's time."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Self

import numpy as np
import pymap3d
from numpy.typing import NDArray

from polecal.drivers.novatel_span import NavState

Array = NDArray[np.float64]
Times = NDArray[np.int64]
Rows = slice | NDArray[np.int64]

_KEPT = 2048  # nav states: 10 s at 200 Hz; twice as many rows are held, so that trimming is rare
_ASIDE_NS = 50_000_000  # before and after, for the change of velocity: less would be the receiver's noise
_LONGEST_GAP = 2.5  # nominal periods; between poses further apart nothing is interpolated


@dataclass(frozen=True, slots=True)
class Poses:
    """The body at N times: in n (m, rad), and how that changes: of the origin in n, of the attitude in b.

    ``known`` is False where the time lies in a gap of the navigation, or before its start.
    """

    known: NDArray[np.bool_]
    position_m: Array
    rpy_rad: Array
    velocity_mps: Array
    rate_radps: Array
    acceleration_mps2: Array
    angular_acceleration_radps2: Array


@dataclass(frozen=True, slots=True)
class Path:
    """Straight lines between poses, at N times: what is asked for is worked out, and no more.

    Each stretch between two poses has one rate of change, that of b as in its middle. ``known`` (N,) is False
    where the time lies in a gap of the navigation, or before its start.
    """

    known: NDArray[np.bool_]
    _gps_ns: Times
    _stretch: NDArray[np.intp]
    """(N,) which of S stretches each time is in."""
    _times: Times
    """(S + 1,) of the poses."""
    _states: Array
    """(S + 1, 6) position and attitude."""
    _rates: Array
    """(S, 6) how they change."""
    _changes: Array
    """(S, 6) velocity in n, and angular velocity in b."""

    @classmethod
    def of(cls, gps_ns: Times, times: Times, states: Array, longest_ns: int) -> Self:
        """Join two poses at least by lines; nothing is known between those more than ``longest_ns`` apart."""
        spans_ns = np.diff(times)
        rates = np.diff(states, axis=0) / (spans_ns * 1e-9)[:, None]
        turning = _body_rate((states[:-1, 3:] + states[1:, 3:]) / 2, rates[:, 3:])
        changes = np.concatenate([rates[:, :3], turning], axis=1)
        stretch = _stretch_of(gps_ns, times)
        span_ns, part_ns = spans_ns.take(stretch), gps_ns - times.take(stretch)
        known = (span_ns <= longest_ns) & (part_ns >= 0) & (part_ns <= span_ns)
        return cls(known, gps_ns, stretch, times, states, rates, changes)

    def states(self, columns: slice = slice(6), rows: Rows = slice(None)) -> Array:
        """Give some of north, east, down (m), roll, pitch, yaw (rad) at some of the times."""
        stretch = self._stretch[rows]
        part_s = (self._gps_ns[rows] - self._times.take(stretch)) * 1e-9
        states, rates = self._states[:, columns], self._rates[:, columns]
        return states.take(stretch, axis=0) + rates.take(stretch, axis=0) * part_s[:, None]

    def speeds(self) -> tuple[Array, Array]:
        """Give how fast the body moves (N,), m/s, and turns, rad/s."""
        squares = self._changes**2
        speeds = (np.sqrt(squares[:, part].sum(axis=1)) for part in (slice(3), slice(3, 6)))
        moves_mps, turns_radps = (of.take(self._stretch) for of in speeds)
        return moves_mps, turns_radps

    def poses(self, rows: Rows = slice(None)) -> Poses:
        """Give all there is to know at some of the times."""
        gps_ns, times = self._gps_ns[rows], self._times
        state, change = self.states(rows=rows), self._changes.take(self._stretch[rows], axis=0)
        early_ns, late_ns = (np.clip(gps_ns + side, times[0], times[-1]) for side in (-_ASIDE_NS, _ASIDE_NS))
        early, late = (self._changes.take(_stretch_of(at_ns, times), axis=0) for at_ns in (early_ns, late_ns))
        changed = (late - early) / (np.maximum(late_ns - early_ns, 1)[:, None] * 1e-9)
        return Poses(
            known=self.known[rows],
            position_m=state[:, :3],
            rpy_rad=state[:, 3:],
            velocity_mps=change[:, :3],
            rate_radps=change[:, 3:],
            acceleration_mps2=changed[:, :3],
            angular_acceleration_radps2=changed[:, 3:],
        )


class Trajectory:
    """The last seconds of poses, in the local frame n about the first one."""

    def __init__(self, period_s: float) -> None:
        self.origin: tuple[float, float, float] | None = None
        """Latitude, longitude (degrees) and ellipsoidal height (m) of n's origin."""
        self._gap_ns = int(_LONGEST_GAP * period_s * 1e9)
        self._last_ns, self._last_yaw_rad = 0, 0.0
        self.newest: NavState | None = None
        """The last pose that was taken."""
        self._new: list[tuple[float, ...]] = []  # latitude, longitude, height; roll, pitch, yaw: not in n yet
        self._new_ns: list[int] = []
        self._count = 0
        self._gps_ns = np.zeros(2 * _KEPT, dtype=np.int64)
        self._state = np.zeros((2 * _KEPT, 6))

    @property
    def last_ns(self) -> int:
        """GPS time of the newest pose, ns."""
        return self._last_ns

    def add(self, pose: NavState) -> None:
        """Take the next good pose; one that is not newer than the last is passed over."""
        yaw_rad = math.radians(pose.azimuth_deg)
        if self.origin is None:
            self.origin = (pose.lat_deg, pose.lon_deg, pose.height_m)
            self._last_yaw_rad = yaw_rad
        if pose.gps_ns <= self._last_ns:
            return
        # yaw goes on where it was, so that it can be interpolated across north
        self.newest = pose
        turned_rad = (yaw_rad - self._last_yaw_rad + math.pi) % (2 * math.pi) - math.pi
        self._last_ns, self._last_yaw_rad = pose.gps_ns, self._last_yaw_rad + turned_rad
        angles_rad = math.radians(pose.roll_deg), math.radians(pose.pitch_deg), self._last_yaw_rad
        self._new_ns.append(pose.gps_ns)
        self._new.append((pose.lat_deg, pose.lon_deg, pose.height_m, *angles_rad))
        if len(self._new) == _KEPT:
            self._settle()

    def _settle(self) -> None:
        """Bring the new poses into n: of all that came since the last look at once, which is much faster."""
        if not self._new:
            return
        new = np.array(self._new)
        new[:, :3] = np.column_stack(pymap3d.geodetic2ned(*new[:, :3].T, *(self.origin or ())))
        if self._count + len(new) > 2 * _KEPT:
            kept = slice(max(0, self._count - _KEPT), self._count)
            self._count = kept.stop - kept.start
            self._gps_ns[: self._count] = self._gps_ns[kept]
            self._state[: self._count] = self._state[kept]
        rows = slice(self._count, self._count + len(new))
        self._gps_ns[rows], self._state[rows] = self._new_ns, new
        self._count = rows.stop
        self._new, self._new_ns = [], []

    def path(self, gps_ns: Times) -> Path:
        """Give the path at (N,) GPS times that are not newer than the newest pose."""
        self._settle()
        if self._count < 2 or not len(gps_ns):
            return Path.of(gps_ns, np.array([0, 1]), np.zeros((2, 6)), 0)
        between = self._between(int(gps_ns.min()) - _ASIDE_NS, int(gps_ns.max()) + _ASIDE_NS)
        return Path.of(gps_ns, *between, self._gap_ns)

    def _between(self, first_ns: int, last_ns: int) -> tuple[Times, Array]:
        """Give the times and states of the poses from before one time to behind another, two at least."""
        first, last = np.searchsorted(self._gps_ns[: self._count], (first_ns, last_ns)).tolist()
        start = max(0, min(first, self._count - 1) - 1)
        rows = slice(start, min(max(last + 1, start + 2), self._count))
        return self._gps_ns[rows], self._state[rows]


def _stretch_of(gps_ns: Times, times: Times) -> NDArray[np.intp]:
    """Give which stretch between two of S + 1 poses each time (N,) is in, or next to."""
    stretch: NDArray[np.intp] = np.clip(np.searchsorted(times, gps_ns), 1, len(times) - 1) - 1
    return stretch


def _body_rate(rpy_rad: Array, rpy_rate_radps: Array) -> Array:
    """Give the angular velocity in b of Euler angles and their rates, (N, 3) rad/s."""
    sr, cr = np.sin(rpy_rad[:, 0]), np.cos(rpy_rad[:, 0])
    sp, cp = np.sin(rpy_rad[:, 1]), np.cos(rpy_rad[:, 1])
    roll, pitch, yaw = rpy_rate_radps.T
    return np.stack([roll - yaw * sp, pitch * cr + yaw * sr * cp, -pitch * sr + yaw * cr * cp], axis=1)
