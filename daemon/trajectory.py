"""Nav states to the pose, and its rate of change, at any beam's time."""

from __future__ import annotations

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
        self._count = 0
        self._gps_ns = np.zeros(2 * _KEPT, dtype=np.int64)
        self._state = np.zeros((2 * _KEPT, 6))

    @property
    def last_ns(self) -> int:
        """GPS time of the newest pose, ns."""
        return int(self._gps_ns[self._count - 1]) if self._count else 0

    def add(self, pose: NavState) -> None:
        """Take the next good pose; one that is not newer than the last is passed over."""
        if self.origin is None:
            self.origin = (pose.lat_deg, pose.lon_deg, pose.height_m)
        if pose.gps_ns <= self.last_ns:
            return
        if self._count == 2 * _KEPT:
            self._gps_ns[:_KEPT] = self._gps_ns[_KEPT:]
            self._state[:_KEPT] = self._state[_KEPT:]
            self._count = _KEPT
        ned = pymap3d.geodetic2ned(pose.lat_deg, pose.lon_deg, pose.height_m, *self.origin)
        rpy = np.radians((pose.roll_deg, pose.pitch_deg, pose.azimuth_deg))
        if self._count:  # yaw goes on where it was, so that it can be interpolated across north
            last = self._state[self._count - 1, 5]
            rpy[2] = last + (rpy[2] - last + np.pi) % (2 * np.pi) - np.pi
        self._gps_ns[self._count] = pose.gps_ns
        self._state[self._count] = (*(float(value) for value in ned), *rpy)
        self._count += 1

    def at(self, gps_ns: Times) -> Poses:
        """Interpolate at (N,) GPS times that are not newer than the newest pose."""
        if self._count < 2:
            nothing = np.zeros((len(gps_ns), 3))
            return Poses(np.zeros(len(gps_ns), dtype=bool), *[nothing] * 6)
        known, state, rate = self._interpolated(gps_ns)
        first_ns, last_ns = self._gps_ns[0], self._gps_ns[self._count - 1]
        early_ns, late_ns = (np.clip(gps_ns + side, first_ns, last_ns) for side in (-_ASIDE_NS, _ASIDE_NS))
        (_, early, early_rate), (_, late, late_rate) = map(self._interpolated, (early_ns, late_ns))
        apart_s = np.maximum(late_ns - early_ns, 1)[:, None] * 1e-9
        turning = _body_rate(late[:, 3:], late_rate[:, 3:]) - _body_rate(early[:, 3:], early_rate[:, 3:])
        return Poses(
            known=known,
            position_m=state[:, :3],
            rpy_rad=state[:, 3:],
            velocity_mps=rate[:, :3],
            rate_radps=_body_rate(state[:, 3:], rate[:, 3:]),
            acceleration_mps2=(late_rate[:, :3] - early_rate[:, :3]) / apart_s,
            angular_acceleration_radps2=turning / apart_s,
        )

    def _interpolated(self, gps_ns: Times) -> tuple[NDArray[np.bool_], Array, Array]:
        """Give where it is known, the state (N, 6) and its rate of change: straight lines between poses."""
        times = self._gps_ns[: self._count]
        after = np.clip(np.searchsorted(times, gps_ns), 1, self._count - 1)
        before = after - 1
        span_ns = times[after] - times[before]
        part_ns = gps_ns - times[before]
        known = (span_ns <= self._gap_ns) & (part_ns >= 0) & (part_ns <= span_ns)
        rate = (self._state[after] - self._state[before]) / (span_ns * 1e-9)[:, None]
        return known, self._state[before] + rate * (part_ns * 1e-9)[:, None], rate


def _body_rate(rpy_rad: Array, rpy_rate_radps: Array) -> Array:
    """Give the angular velocity in b of Euler angles and their rates, (N, 3) rad/s."""
    sr, cr = np.sin(rpy_rad[:, 0]), np.cos(rpy_rad[:, 0])
    sp, cp = np.sin(rpy_rad[:, 1]), np.cos(rpy_rad[:, 1])
    roll, pitch, yaw = rpy_rate_radps.T
    return np.stack([roll - yaw * sp, pitch * cr + yaw * sr * cp, -pitch * sr + yaw * cr * cp], axis=1)
