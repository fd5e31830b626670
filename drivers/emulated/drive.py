"""Where the vehicle is at each moment: world time in, body pose and velocity out.

All positions are north, east, down (NED) in metres about the world's reference; angles are roll, pitch,
yaw in radians of the body (forward, right, down), C = Rz(yaw) Ry(pitch) Rx(roll); time is world time in s.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import CubicSpline

Floats = NDArray[np.float64]

PASSES = 22
HEADING_STEP_RAD = np.deg2rad(360.0 * 12 / 19)
"""Each pass heads so much further: 19 passes are 19 evenly spaced headings, and meet every 30° slice."""

_FIRST_M = -8.0  # along the first line: where the vehicle stands at first, the pole being at 0
_LAST_M = 6.5  # along the last line: where it stops and begins to reverse
_STAND_S = 6.0
_PAUSE_S = 2.0
_RADIUS_M = (2.7, 2.9)  # of a turn: with the heading step, the vehicle comes 6 to 7 m beyond the pole
_OFFSET_M = (0.9, 1.5)  # of a line from the pole, to either side by turns
_BLEND_M = 2.0  # of path in which the curvature grows from none to a turn's
_ACCELERATION_MPS2 = 1.0
_FORWARD_MPS = 2.85
_REVERSE_MPS = 2.0
_STEP_M = 0.05
_TICK_S = 0.02


class Trajectory(Protocol):
    """A vehicle's motion as a function of world time."""

    def pose(self, t_s: ArrayLike) -> tuple[Floats, Floats, Floats]:
        """Return position (N, 3) m, roll pitch yaw (N, 3) rad and velocity (N, 3) m/s at times (N,) s."""
        ...


class SampledTrajectory:
    """A motion known at some moments: straight lines between them, and at rest outside them.

    Takes times (N,) s, ascending; positions (N, 3) m; roll, pitch, yaw (N, 3) rad, yaw in any turn;
    velocities (N, 3) m/s. Straight lines, since a recording's noise makes a spline swing.
    """

    def __init__(self, t_s: ArrayLike, position_m: ArrayLike, rpy_rad: ArrayLike, velocity_mps: ArrayLike):
        self.t_s = np.asarray(t_s, np.float64)
        self._columns = np.hstack(
            [
                np.asarray(position_m, np.float64),
                np.unwrap(np.asarray(rpy_rad, np.float64), axis=0),
                np.asarray(velocity_mps, np.float64),
            ]
        )

    def pose(self, t_s: ArrayLike) -> tuple[Floats, Floats, Floats]:
        """Return position, roll pitch yaw and velocity, as `Trajectory` says."""
        t = np.atleast_1d(np.asarray(t_s, np.float64))
        values = np.column_stack([np.interp(t, self.t_s, column) for column in self._columns.T])
        moving = (t >= self.t_s[0]) & (t <= self.t_s[-1])
        return values[:, 0:3], values[:, 3:6], values[:, 6:9] * moving[:, None]


@dataclass(frozen=True, slots=True)
class _Path:
    """A path over the ground: where it is after so many metres."""

    spline: CubicSpline  # metres along -> north, east, heading
    length_m: float
    pole_m: Floats  # (passes,) metres along, nearest to the pole


class Uneven:
    """Gently uneven ground: roll and pitch up to 2.5° and the height by 3 cm are functions of the place.

    ``clearance_m`` is the height of the body's origin above the mean ground, which is at down = 0.
    """

    def __init__(self, rng: np.random.Generator, clearance_m: float = 0.1) -> None:
        self._height_m = -clearance_m
        wavelength_m = rng.uniform(5.0, 12.0, (3, 3))
        bearing_rad = rng.uniform(0, 2 * np.pi, (3, 3))
        self._wave_k = (
            2
            * np.pi
            / wavelength_m[..., None]
            * np.stack([np.cos(bearing_rad), np.sin(bearing_rad)], axis=-1)
        )  # (3 fields, 3 waves, 2)
        self._wave_phase = rng.uniform(0, 2 * np.pi, (3, 3))
        shares = np.array([0.5, 0.3, 0.2])
        # Two slopes whose largest sum is 2.5°, and a height
        self._wave_size = np.outer([np.deg2rad(1.75), np.deg2rad(1.75), 0.03], shares)

    def body(self, north: Floats, east: Floats, yaw: Floats, speed: Floats) -> tuple[Floats, Floats, Floats]:
        """Return the pose and velocity, as `Trajectory` says, of a body at (N,) places in m.

        ``speed`` (N,) m/s is along its heading ``yaw`` (N,) rad.
        """
        cos, sin = np.cos(yaw), np.sin(yaw)
        phase = (
            np.multiply.outer(north, self._wave_k[..., 0]) + np.multiply.outer(east, self._wave_k[..., 1])
        ) + self._wave_phase
        slope_n, slope_e, height = np.sum(self._wave_size * np.sin(phase), axis=-1).T
        rate = (self._wave_size * np.cos(phase))[:, 2]  # d height / d phase, of each wave
        climb = speed * np.sum(
            rate * (np.outer(cos, self._wave_k[2, :, 0]) + np.outer(sin, self._wave_k[2, :, 1])), axis=-1
        )
        position = np.column_stack([north, east, self._height_m - height])
        rpy = np.column_stack([slope_n * sin - slope_e * cos, slope_n * cos + slope_e * sin, yaw])
        return position, rpy, np.column_stack([speed * cos, speed * sin, -climb])


class Drive:
    """A car-like vehicle that drives teardrop loops past a pole, then reverses along its own path.

    It stands for 6 s, about 8 m before the pole. Each pass is a straight line at a distance from the
    pole, on alternating sides, and ends in a turn of 227.4° onto the line of the next. The curvature is
    smooth, and the velocity is always along the heading. The ground is gently uneven: roll and pitch up to
    2.5° and the height by 3 cm are functions of the place.

    ``clearance_m`` is the height of the body's origin above the mean ground, which is at down = 0.
    """

    def __init__(self, *, pole_ne_m: tuple[float, float], seed: int = 0, clearance_m: float = 0.1) -> None:
        rng = np.random.default_rng([seed, 1])
        self._path = _loops(pole_ne_m, rng)
        t_s, along_m = _schedule(self._path.length_m, rng)
        self._along = CubicSpline(t_s, along_m)
        self._end_s = float(t_s[-1])
        self._ground = Uneven(rng, clearance_m)
        turning = int(np.argmax(along_m))
        there, back = along_m[:turning], along_m[turning:]
        back_s = np.interp(-self._path.pole_m[::-1], -back, t_s[turning:])
        self.pass_times_s = np.concatenate([np.interp(self._path.pole_m, there, t_s[:turning]), back_s])
        """(passes,) s of the moments nearest to the pole, forward ones and then reverse ones."""
        self.reverse_from_s = float(t_s[turning])
        """When the vehicle has stopped and begins to reverse, s."""

    def path(self, step_m: float = 0.25) -> Floats:
        """Return the path over the ground as (N, 2) m, north and east."""
        return np.asarray(self._path.spline(np.arange(0.0, self._path.length_m, step_m)))[:, :2]

    def pose(self, t_s: ArrayLike) -> tuple[Floats, Floats, Floats]:
        """Return position, roll pitch yaw (yaw not wrapped) and velocity, as `Trajectory` says."""
        t = np.clip(np.atleast_1d(np.asarray(t_s, np.float64)), 0.0, self._end_s)
        along, speed = np.asarray(self._along(t)), np.asarray(self._along(t, 1))
        north, east, yaw = np.asarray(self._path.spline(along)).T
        return self._ground.body(north, east, yaw, speed)


class ThereAndBack:
    """A part of a motion, from ``begin_s`` to ``end_s``, gone through forwards and backwards for ever."""

    def __init__(self, trajectory: Trajectory, begin_s: float, end_s: float) -> None:
        self._trajectory, self._begin_s, self._span_s = trajectory, begin_s, end_s - begin_s

    def pose(self, t_s: ArrayLike) -> tuple[Floats, Floats, Floats]:
        """Return position (N, 3) m, roll pitch yaw (N, 3) rad and velocity (N, 3) m/s at times (N,) s."""
        times, part_s = np.divmod(np.asarray(t_s, np.float64), self._span_s)
        back = times % 2 == 1
        position_m, rpy_rad, velocity_mps = self._trajectory.pose(
            self._begin_s + np.where(back, self._span_s - part_s, part_s)
        )
        return position_m, rpy_rad, np.where(back[:, None], -velocity_mps, velocity_mps)


def _turn(radius_m: float) -> Floats:
    """Return a turn to the right by the heading step, from the origin northward, as (N, 4): s, n, e, heading.

    The curvature grows as a raised cosine over the blend, so that the yaw rate has no kink.
    """
    arc_m = HEADING_STEP_RAD * radius_m - _BLEND_M  # the two blends turn as much as one blend's arc
    count = int(np.ceil((arc_m + 2 * _BLEND_M) / _STEP_M))
    s = np.linspace(0.0, arc_m + 2 * _BLEND_M, count * 16 + 1)
    into = np.clip(np.minimum(s, s[-1] - s) / _BLEND_M, 0.0, 1.0)
    curvature = (1 - np.cos(np.pi * into)) / (2 * radius_m)
    heading = _integral(curvature, s)
    heading *= HEADING_STEP_RAD / heading[-1]
    columns = np.column_stack([s, _integral(np.cos(heading), s), _integral(np.sin(heading), s), heading])
    return columns[::16]


def _integral(y: Floats, x: Floats) -> Floats:
    return np.concatenate([[0.0], np.cumsum((y[1:] + y[:-1]) / 2 * np.diff(x))])


def _loops(pole_ne_m: tuple[float, float], rng: np.random.Generator) -> _Path:
    """Lay straight passes and turns end to end."""
    headings = rng.uniform(0, 2 * np.pi) + HEADING_STEP_RAD * np.arange(PASSES)
    offsets = rng.uniform(*_OFFSET_M, PASSES) * np.where(np.arange(PASSES) % 2, 1.0, -1.0)
    ahead = np.column_stack([np.cos(headings), np.sin(headings)])
    right = np.column_stack([-np.sin(headings), np.cos(headings)])
    parts: list[Floats] = []  # rows of s, north, east, heading
    pole_m = np.empty(PASSES)
    s, begin_m = 0.0, _FIRST_M
    for k in range(PASSES):
        last = k == PASSES - 1
        turn = _turn(rng.uniform(*_RADIUS_M))
        line = offsets[k] * right[k]
        if last:
            end_m = _LAST_M
        else:  # so far along this line that the turn ends on the next
            shape = turn[-1, 1] * ahead[k] + turn[-1, 2] * right[k]
            end_m = (offsets[k + 1] - right[k + 1] @ (line + shape)) / (right[k + 1] @ ahead[k])
        along = np.linspace(begin_m, end_m, int(np.ceil((end_m - begin_m) / _STEP_M)) + 1)[:-1]
        straight = line + along[:, None] * ahead[k]
        parts.append(np.column_stack([s + along - begin_m, straight, np.full(len(along), headings[k])]))
        pole_m[k] = s - begin_m
        s += end_m - begin_m
        if not last:
            bend = line + end_m * ahead[k] + turn[:, 1:2] * ahead[k] + turn[:, 2:3] * right[k]
            parts.append(np.column_stack([s + turn[:, 0], bend, headings[k] + turn[:, 3]])[:-1])
            s += turn[-1, 0]
            begin_m = float(bend[-1] @ ahead[k + 1])
    table = np.vstack(parts)
    table[:, 1:3] += pole_ne_m
    return _Path(CubicSpline(table[:, 0], table[:, 1:]), float(table[-1, 0]), pole_m)


def _schedule(length_m: float, rng: np.random.Generator) -> tuple[Floats, Floats]:
    """Return times (N,) s and metres along the path (N,): stand, drive to the end, pause, reverse."""
    phase_1, phase_2 = rng.uniform(0, 2 * np.pi, 2)
    speeds: list[float] = [0.0] * int(_STAND_S / _TICK_S)
    for cruise, sway in ((_FORWARD_MPS, 1.0), (_REVERSE_MPS, 0.7)):
        left, speed, direction = length_m, 0.0, 1.0 if cruise == _FORWARD_MPS else -1.0
        while left > 1e-3:
            t = len(speeds) * _TICK_S
            wish = cruise + sway * (
                0.2 * np.sin(2 * np.pi * t / 23 + phase_1) + 0.12 * np.sin(2 * np.pi * t / 9.7 + phase_2)
            )
            braking = np.sqrt(2 * _ACCELERATION_MPS2 * left) + 1e-2
            speed = float(min(wish, braking, speed + _ACCELERATION_MPS2 * _TICK_S, left / _TICK_S))
            left -= speed * _TICK_S
            speeds.append(direction * speed)
        speeds += [0.0] * int(_PAUSE_S / _TICK_S)
    window = np.hanning(int(0.8 / _TICK_S) + 1)
    smooth = np.convolve(np.array(speeds), window / window.sum())
    along = np.concatenate([[0.0], np.cumsum(smooth) * _TICK_S])
    return np.arange(len(along), dtype=np.float64) * _TICK_S, along.astype(np.float64)
