"""Nav states to the pose, and its rate of change, at any beam's time."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import pymap3d
from numpy.typing import NDArray

from polecal.drivers.novatel_span import NavState

Array = NDArray[np.float64]
Times = NDArray[np.int64]

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

    def at(self, gps_ns: Times) -> Poses:
        """Interpolate at (N,) GPS times that are not newer than the newest pose."""
        self._settle()
        if self._count < 2 or not len(gps_ns):
            nothing = np.zeros((len(gps_ns), 3))
            return Poses(np.zeros(len(gps_ns), dtype=bool), *[nothing] * 6)
        times, states = self._between(int(gps_ns.min()) - _ASIDE_NS, int(gps_ns.max()) + _ASIDE_NS)
        # straight lines between poses: each stretch has one rate of change, that of b as in its middle
        spans_ns = np.diff(times)
        rates = np.diff(states, axis=0) / (spans_ns * 1e-9)[:, None]
        turning = _body_rate((states[:-1, 3:] + states[1:, 3:]) / 2, rates[:, 3:])
        changes = np.concatenate([rates[:, :3], turning], axis=1)

        def stretch_of(at_ns: Times) -> NDArray[np.intp]:
            return np.clip(np.searchsorted(times, at_ns), 1, len(spans_ns)) - 1

        before = stretch_of(gps_ns)
        span_ns, part_ns = spans_ns.take(before), gps_ns - times.take(before)
        state = states.take(before, axis=0) + rates.take(before, axis=0) * (part_ns * 1e-9)[:, None]
        change = changes.take(before, axis=0)
        early_ns, late_ns = (np.clip(gps_ns + side, times[0], times[-1]) for side in (-_ASIDE_NS, _ASIDE_NS))
        changed = changes.take(stretch_of(late_ns), axis=0) - changes.take(stretch_of(early_ns), axis=0)
        changed /= np.maximum(late_ns - early_ns, 1)[:, None] * 1e-9
        return Poses(
            known=(span_ns <= self._gap_ns) & (part_ns >= 0) & (part_ns <= span_ns),
            position_m=state[:, :3],
            rpy_rad=state[:, 3:],
            velocity_mps=change[:, :3],
            rate_radps=change[:, 3:],
            acceleration_mps2=changed[:, :3],
            angular_acceleration_radps2=changed[:, 3:],
        )

    def _between(self, first_ns: int, last_ns: int) -> tuple[Times, Array]:
        """Give the times and states of the poses from before one time to behind another, two at least."""
        first, last = np.searchsorted(self._gps_ns[: self._count], (first_ns, last_ns)).tolist()
        start = max(0, min(first, self._count - 1) - 1)
        rows = slice(start, min(max(last + 1, start + 2), self._count))
        return self._gps_ns[rows], self._state[rows]


def _body_rate(rpy_rad: Array, rpy_rate_radps: Array) -> Array:
    """Give the angular velocity in b of Euler angles and their rates, (N, 3) rad/s."""
    sr, cr = np.sin(rpy_rad[:, 0]), np.cos(rpy_rad[:, 0])
    sp, cp = np.sin(rpy_rad[:, 1]), np.cos(rpy_rad[:, 1])
    roll, pitch, yaw = rpy_rate_radps.T
    return np.stack([roll - yaw * sp, pitch * cr + yaw * sr * cp, -pitch * sr + yaw * cr * cp], axis=1)
