"""What is missing, where the pole is and what the vehicle can do to a drive: legs past the pole, and turns.

Places are north and east of the pole in m, headings platform yaw in rad. A leg past the pole is straight,
its heading the middle of a slice, and leaves the pole aside by a clearance; forward or in reverse, the body
heads the same way on it. Between legs the vehicle drives forward, on arcs and straights that stay away from
the pole and within the area; where none fit, it backs off first or goes round.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from math import ceil, cos, hypot, inf, pi, radians, sin, sqrt
from typing import Literal

import numpy as np

from polecal import PolecalError
from polecal.calib import dubins
from polecal.calib.dubins import Pose
from polecal.calib.geometry import Array
from polecal.calib.sight import Sensor, Sight, sight

_MARGIN_M = 0.4  # between the vehicle's side and the pole
_NEAREST_M = 1.0
_FARTHER_M = 0.6  # by which every other leg passes at more distance
_OVERHANG_M = 0.4  # in a turn what is before and behind the wheels sweeps so much more
_SURE = 2.0  # σ of the pole's place
_LEAD_M = 1.5  # in which a heading settles, before the pole is seen
_FEWEST_RETURNS = 25.0
_SHARE = 0.7  # of the returns that are expected, what is counted upon
_MOST_PASSES = 3  # of one slice, in one route
_MOST_LEGS = 18  # past the pole, in one route: then it is asked for again
_EVERY = 3  # of the legs, which is driven back in reverse where a time offset is wanted
_TURN_MPS2 = 0.8
_BACK_M = (2.0, 4.0, 7.0, 10.0)
_ROUND = 12  # poses on the way round, each in both directions
_DEAR_M = 25.0  # what a route without a way between two legs is worse by, at least


class RouteError(PolecalError):
    """No way can be laid."""


@dataclass(frozen=True, slots=True)
class Vehicle:
    """What drives, and where it may."""

    half_width_m: float = 0.6
    turn_radius_m: float = 5.0
    area_m: float = 20.0
    """How far from the pole it may go."""
    speeds_mps: tuple[float, float] = (3.0, 1.5)


@dataclass(frozen=True, slots=True)
class Lack:
    """What one laser lacks: by slice, so many passes and so many pole returns."""

    sensor: Sensor
    slices: Mapping[int, tuple[int, int]]


@dataclass(frozen=True, slots=True)
class Leg:
    """A part of the drive. ``points`` (N, 3): north and east of the pole in m, the body's heading in rad."""

    kind: Literal["pass", "turn"]
    points: Array
    direction: Literal["forward", "reverse"]
    speed_mps: float
    slice: int | None = None
    """Of platform yaw, on a pass."""
    lasers: tuple[str, ...] = ()
    """Which lack it, and see the pole."""


@dataclass(frozen=True, slots=True)
class Plan:
    """The legs in their order; which slices no leg shows to a laser; and how many passes are left out."""

    legs: tuple[Leg, ...]
    unseen: tuple[tuple[str, int], ...] = ()
    left_out: int = 0

    @property
    def length_m(self) -> float:
        """How long it is."""
        return sum(dubins.length_m(leg.points) for leg in self.legs)


@dataclass(frozen=True, slots=True)
class _Line:
    """A straight way past the pole, forward; and whether it is driven back in reverse."""

    part: int
    heading: float
    right_m: float
    begin_m: float
    end_m: float
    lasers: tuple[str, ...]
    back: bool = False

    def pose(self, along_m: float) -> Pose:
        ahead, right = (cos(self.heading), sin(self.heading)), (-sin(self.heading), cos(self.heading))
        return (
            along_m * ahead[0] - self.right_m * right[0],
            along_m * ahead[1] - self.right_m * right[1],
            self.heading,
        )

    @property
    def begin(self) -> Pose:
        return self.pose(self.begin_m)

    @property
    def end(self) -> Pose:
        """Where the vehicle stands once it is done."""
        return self.begin if self.back else self.pose(self.end_m)


def clearances_m(vehicle: Vehicle, pole_sigma_m: float) -> tuple[float, float]:
    """Give at what distances from a pole known to ± ``pole_sigma_m`` legs pass it, near and far."""
    near = max(_NEAREST_M, vehicle.half_width_m + _MARGIN_M + _SURE * pole_sigma_m)
    return near, near + _FARTHER_M


def plan(
    lacks: Sequence[Lack],
    slice_deg: int,
    vehicle: Vehicle,
    *,
    pole_sigma_m: float = 0.0,
    start: Pose | None = None,
    both_ways: bool = False,
) -> Plan:
    """Lay legs that bring what is lacking, in an order that makes the drive short.

    Parameters
    ----------
    lacks
        What each laser lacks.
    slice_deg
        How wide a slice is.
    vehicle
        What drives, and where it may.
    pole_sigma_m
        How well the pole's place is known: legs keep so much more distance.
    start
        Where the vehicle is; else it may begin with any leg.
    both_ways
        Drive some legs back in reverse, and at two speeds, so that a time offset can be told from x.

    Raises
    ------
    RouteError
        Where the area does not give the vehicle room to turn from leg to leg.
    """
    lines, unseen = _lines(lacks, slice_deg, vehicle, pole_sigma_m)
    if not lines:
        return Plan((), unseen)
    kept = lines[:: ceil(len(lines) / _MOST_LEGS)] if len(lines) > _MOST_LEGS else lines
    ways = _Ways(vehicle, clearances_m(vehicle, pole_sigma_m)[0])
    ordered = _ordered(kept, ways, start)
    if both_ways:
        turned = [
            replace(line, back=number % _EVERY == 0 or (len(ordered) < 2 * _EVERY and number % 2 == 0))
            for number, line in enumerate(ordered)
        ]
        ordered = _ordered(turned, ways, start)
    return Plan(tuple(_legs(ordered, ways, start, vehicle, both_ways)), unseen, len(lines) - len(kept))


def _lines(
    lacks: Sequence[Lack], slice_deg: int, vehicle: Vehicle, pole_sigma_m: float
) -> tuple[list[_Line], tuple[tuple[str, int], ...]]:
    """Choose for each slice the sides from which those that lack it see the pole."""
    near, far = clearances_m(vehicle, pole_sigma_m)
    sights: dict[float, list[Sight | None]] = {
        right_m: [sight(lack.sensor, right_m) for lack in lacks] for right_m in (near, -near, far, -far)
    }
    clear_m = near + _OVERHANG_M
    speed_mps = vehicle.speeds_mps[0]
    lines, unseen = [], []
    for part in range(360 // slice_deg):
        left = {
            number: lack.slices[part]
            for number, lack in enumerate(lacks)
            if lack.slices.get(part, (0, 0)) > (0, 0)
        }
        tries = 0
        while left:
            order = [near, -far, -near, far] if (part + tries) % 2 else [-near, far, near, -far]
            brings = {
                right_m: {
                    number: seen.expected(speed_mps) * _SHARE
                    for number, seen in enumerate(sights[right_m])
                    if number in left and seen is not None and seen.expected(speed_mps) >= _FEWEST_RETURNS
                }
                for right_m in order
            }
            right_m = max(order, key=lambda each: len(brings[each]))
            if not brings[right_m]:
                unseen += [(lacks[number].sensor.name, part) for number in left]
                break
            seen_by = [
                seen for number, seen in enumerate(sights[right_m]) if number in brings[right_m] and seen
            ]
            past_m = sqrt(max(0.0, clear_m**2 - right_m**2)) + 0.3  # there, a turn may begin
            lines.append(
                _Line(
                    part,
                    radians((part + 0.5) * slice_deg),
                    right_m,
                    min(-past_m, *(seen.begin_m - _LEAD_M for seen in seen_by)),
                    max(past_m, *(seen.end_m + _LEAD_M for seen in seen_by)),
                    tuple(lacks[number].sensor.name for number in brings[right_m]),
                )
            )
            tries += 1
            for number, returns in brings[right_m].items():
                passes, lacking = left.pop(number)
                passes, lacking = passes - 1, lacking - int(returns)
                if (passes > 0 or lacking > 0) and tries < _MOST_PASSES:
                    left[number] = passes, lacking
    return lines, tuple(unseen)


class _Ways:
    """Ways between poses that keep away from the pole and within the area, each laid once."""

    def __init__(self, vehicle: Vehicle, near_m: float) -> None:
        self._radius_m, self._area_m = vehicle.turn_radius_m, vehicle.area_m
        self._clear_m = near_m + _OVERHANG_M
        self._known: dict[tuple[Pose, Pose], list[Array]] = {}
        ring_m = max(self._clear_m + self._radius_m, 0.7 * vehicle.area_m)
        self._round = [
            (ring_m * cos(turn), ring_m * sin(turn), turn + side * pi / 2)
            for turn in (2 * pi * number / _ROUND for number in range(_ROUND))
            for side in (1, -1)
        ]

    def between(self, begin: Pose, end: Pose) -> list[Array]:
        """Give the way as parts, of which the first may be backward; none where there is no way."""
        key = begin, end
        if key not in self._known:
            self._known[key] = self._laid(begin, end)
        return self._known[key]

    def cost_m(self, begin: Pose, end: Pose) -> float:
        """Give a way's length; much, where there is none."""
        parts = self.between(begin, end)
        if not parts and begin != end:
            return 10 * _DEAR_M
        return sum(dubins.length_m(part) for part in parts) + _DEAR_M / 5 * (len(parts) > 1)

    def _laid(self, begin: Pose, end: Pose) -> list[Array]:
        if hypot(begin[0] - end[0], begin[1] - end[1]) < 1e-6 and cos(begin[2] - end[2]) > 1 - 1e-9:
            return []
        # The vehicle may stand nearer, or farther, than it shall go
        at_m = hypot(begin[0], begin[1])
        clear_m = min(self._clear_m, at_m - 0.01)
        area_m = max(
            self._area_m, hypot(end[0], end[1]), at_m + 2 * self._radius_m if at_m > self._area_m else 0
        )
        direct = self._shortest(begin, end, clear_m, area_m)
        if direct is not None:
            return [direct]
        found: list[list[Array]] = []
        for back_m in _BACK_M:
            back = dubins.straight(begin, -back_m)
            if not _free(back, clear_m, area_m):
                break
            at = (float(back[-1, 0]), float(back[-1, 1]), begin[2])
            way = self._shortest(at, end, clear_m, area_m)
            if way is not None:
                found.append([back, way])
                break
        for middle in self._round:
            there = self._shortest(begin, middle, clear_m, area_m)
            back_in = None if there is None else self._shortest(middle, end, self._clear_m, area_m)
            if there is not None and back_in is not None:
                found.append([np.concatenate([there, back_in[1:]])])
        return min(found, key=lambda parts: sum(map(dubins.length_m, parts)), default=[])

    def _shortest(self, begin: Pose, end: Pose, clear_m: float, area_m: float) -> Array | None:
        free = (way for way in dubins.ways(begin, end, self._radius_m) if _free(way, clear_m, area_m))
        return min(free, key=dubins.length_m, default=None)


def _free(way: Array, clear_m: float, area_m: float) -> bool:
    """Say whether a way, also between its points, keeps away from the pole, and within the area."""
    if np.hypot(way[:, 0], way[:, 1]).max() > area_m:
        return False
    return nearest_m(way) >= clear_m


def nearest_m(way: Array) -> float:
    """Give how near to the pole a way of points (N, 2 or more) comes, with straight lines between them."""
    begin, step = way[:-1, :2], np.diff(way[:, :2], axis=0)
    squared = np.maximum(np.sum(step * step, axis=1), 1e-12)
    share = np.clip(-np.sum(begin * step, axis=1) / squared, 0.0, 1.0)
    return float(np.linalg.norm(begin + share[:, None] * step, axis=1).min())


def _ordered(lines: Sequence[_Line], ways: _Ways, start: Pose | None) -> list[_Line]:
    """Order lines so that the ways between them are short: the nearest next, then by moving single ones."""

    def total_m(order: Sequence[_Line]) -> float:
        between = sum(ways.cost_m(one.end, other.begin) for one, other in pairwise(order))
        return between + (ways.cost_m(start, order[0].begin) if start is not None else 0.0)

    best, best_m = list(lines), inf
    for first in range(len(lines)) if start is None else [None]:
        left = list(lines)
        order = [] if first is None else [left.pop(first)]
        while left:
            at = order[-1].end if order else start
            assert at is not None  # one or the other is there
            order.append(left.pop(min(range(len(left)), key=lambda k: ways.cost_m(at, left[k].begin))))
        order_m = total_m(order)
        if order_m < best_m:
            best, best_m = order, order_m
    better = True
    while better:
        better = False
        for k in range(len(best)):
            for to in range(len(best)):
                order = best[:k] + best[k + 1 :]
                order.insert(to, best[k])
                order_m = total_m(order)
                if order_m < best_m - 1e-6:
                    best, best_m, better = order, order_m, True
    return best


def _legs(
    lines: Sequence[_Line], ways: _Ways, start: Pose | None, vehicle: Vehicle, both_ways: bool
) -> list[Leg]:
    fast, slow = vehicle.speeds_mps
    turning = min(fast, sqrt(_TURN_MPS2 * vehicle.turn_radius_m))
    legs: list[Leg] = []
    at = start
    for number, line in enumerate(lines):
        if at is not None:
            parts = ways.between(at, line.begin)
            if not parts and ways.cost_m(at, line.begin) > 0:
                raise RouteError(
                    f"within {vehicle.area_m:g} m of the pole there is no room to turn by "
                    f"{vehicle.turn_radius_m:g} m to the next approach",
                    "give more room by --area, or a smaller radius by --radius, if the vehicle can",
                )
            for part in parts:
                backing = len(parts) > 1 and part is parts[0]
                legs.append(
                    Leg("turn", part, "reverse" if backing else "forward", slow if backing else turning)
                )
        speed = slow if both_ways and number % 2 and not line.back else fast
        points = dubins.straight(line.begin, line.end_m - line.begin_m)
        legs.append(Leg("pass", points, "forward", speed, line.part, line.lasers))
        if line.back:
            legs.append(Leg("pass", points[::-1], "reverse", slow, line.part, line.lasers))
        at = line.end
    return legs
