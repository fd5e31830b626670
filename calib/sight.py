"""A laser's mount to where along a straight way past the pole it sees that, and how often."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from polecal.calib.estimate import Pass, sum_of
from polecal.calib.geometry import Array
from polecal.calib.moments import BASE, DOWN
from polecal.calib.observations import Kind, Mount

STEP_M = 0.1
_FARTHEST_M = 7.0  # beyond it few beams meet a pole
_NEAREST_M = 0.5
_EDGE_RAD = np.radians(4.0)  # of the field of view: a heading is held so well
_END_M = 0.15  # of the pole, above the ground and below its top
_FEWEST_BEAMS = 1.0
_GROUND_M = (0.0, 1.0)  # where no ground was seen: how far it may be below the body's origin
_LEAST_HEIGHT_M = 0.4  # of a laser above the ground


@dataclass(frozen=True, slots=True)
class Sensor:
    """A laser, as far as what it can see goes.

    ``ground_m`` is how far below the body's origin the ground is: at least, and at most.
    """

    name: str
    mount: Mount
    fov_deg: float
    resolution_deg: float
    pole_radius_m: float
    pole_height_m: float
    ground_m: tuple[float, float]
    scans_hz: float


@dataclass(frozen=True, slots=True)
class Sight:
    """Where along a way the pole is seen, from and to, m past it.

    ``returns`` is how many returns a metre that is driven at 1 m/s gives there on average.
    """

    begin_m: float
    end_m: float
    returns: float

    def expected(self, speed_mps: float) -> float:
        """Give how many pole returns a pass at this speed brings."""
        return self.returns * (self.end_m - self.begin_m) / speed_mps


def ground_of(mount: Mount, passes: Sequence[Pass]) -> tuple[float, float]:
    """Give how far the ground is below the body's origin, at least and at most, from the passes if any."""
    ground = sum_of(one.totals[Kind.GROUND] for one in passes)
    if not ground.count:
        lowest = max(_GROUND_M[0], mount.z_m + _LEAST_HEIGHT_M)
        return lowest, lowest + _GROUND_M[1]
    down = ground.mean()[DOWN, BASE]
    below = float(down[:9] @ _lever(mount))
    return below, below


def pole_at(mount: Mount, passes: Sequence[Pass]) -> tuple[float, float]:
    """Give where in n the passes of one day saw the pole: north and east, m."""
    pole = sum_of(one.totals[Kind.POLE] for one in passes)
    place = pole.mean()[:DOWN, BASE] @ np.append(_lever(mount), 1.0)
    return float(place[0]), float(place[1])


def _lever(mount: Mount) -> Array:
    """Give h of a mount, without its 1."""
    return np.concatenate([mount.rotation[:, 0], mount.rotation[:, 1], mount.vector[:3]])


def sight(sensor: Sensor, right_m: float) -> Sight | None:
    """Say where the pole is seen from a way that leaves it ``right_m`` to the right; None if nowhere.

    The way is level and straight, and the body heads along it, whichever way it moves.
    """
    turn, (x, y, z) = sensor.mount.rotation, sensor.mount.vector[:3]
    along = np.arange(-_FARTHEST_M - 3.0, _FARTHEST_M + 3.0, STEP_M)
    ahead, aside = -along - x, right_m - y
    level_m = np.hypot(ahead, aside)
    if abs(turn[2, 2]) < _EDGE_RAD:  # a laser that scans upright sees a pole by chance only
        return None
    north, east = ahead / level_m, aside / level_m
    down = -(turn[0, 2] * north + turn[1, 2] * east) / turn[2, 2]  # so that the ray lies in the scan's plane
    ray = np.stack([north, east, down], axis=1)
    bearing = np.arctan2(ray @ turn[:, 1], ray @ turn[:, 0])
    range_m = level_m * np.linalg.norm(ray, axis=1)
    height_z = z + level_m * down
    beams = 2 * sensor.pole_radius_m / (range_m * np.radians(sensor.resolution_deg))
    seen = (
        (np.abs(bearing) <= np.radians(sensor.fov_deg) / 2 - _EDGE_RAD)
        & (range_m >= _NEAREST_M)
        & (range_m <= _FARTHEST_M)
        & (height_z <= sensor.ground_m[0] - _END_M)
        & (height_z >= sensor.ground_m[1] - sensor.pole_height_m + _END_M)
        & (beams >= _FEWEST_BEAMS)
    )
    stretch = _longest(seen)
    if stretch is None:
        return None
    returns = float(beams[stretch].mean()) * sensor.scans_hz
    return Sight(float(along[stretch][0]), float(along[stretch][-1]) + STEP_M, returns)


def _longest(seen: NDArray[np.bool_]) -> slice | None:
    """Give the longest stretch of a way in which the pole is seen throughout."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], seen, [False]]).astype(np.int8)))
    if not len(edges):
        return None
    begins, ends = edges[::2], edges[1::2]
    best = int(np.argmax(ends - begins))
    return slice(int(begins[best]), int(ends[best]))
