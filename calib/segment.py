"""A scan to pole, ground and neither: by reflectivity first, then by place."""

from __future__ import annotations

import math
from bisect import bisect_left, insort
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import compress, pairwise

import numpy as np
from numpy.typing import NDArray

from polecal.calib.geometry import Array

Indices = NDArray[np.int64]

RETRO_REFLECTIVE = 0.6
"""From here on (scale 0 to 1) a return is from retro-reflective tape: level 5 of the LMS's 7."""
_DULL = 0.3  # up to here it is from soil, grass or walls
_STEP_M = 0.3  # along one object the range does not jump by more
_SPREAD_M = 0.03  # beam width and range noise add to what an object looks like
_SPREAD_BEAMS = 3
_BEHIND_M = 0.05  # more than range noise, and than the levels by which ranges are told
_MARGIN_BEAMS = 2  # next to a reflector a beam sees half of each
_GROUND_BAND_M = 0.5
_GROUND_RANGE_M = 30.0
_MEMORY_SCANS = 200
_TRIMS = 6
_TRIM_SIGMAS = 3.5
_EVEN_M = 0.03
_FEWEST_GROUND = 50
_MOST_PLACES = 32
_WIDE_SHARE = 0.1


@dataclass(frozen=True, slots=True)
class Reflector:
    """Neighbouring beams of a scan that met one retro-reflective object."""

    beams: Indices
    range_m: float
    thin: bool
    """Whether it looks no wider than the pole would."""


def reflectors(
    range_m: Array, bearing_rad: Array, reflectivity: Array, *, pole_radius_m: float
) -> list[Reflector]:
    """Find the retro-reflective objects in a scan that are seen from edge to edge.

    Takes (N,) arrays in the order of the beams, NaN where there is no range. What the first or the last beam
    meets may go on beyond: the part that is seen of a pole is not where the whole pole is.
    """
    bright = np.flatnonzero((reflectivity >= RETRO_REFLECTIVE) & np.isfinite(range_m))
    numbers, ranges_m = (
        bright.tolist(),
        range_m[bright].tolist(),
    )  # few: lists take less time
    step_rad = abs(float(bearing_rad[1] - bearing_rad[0]))
    found = []
    for part in _together(numbers, ranges_m):
        first, last, of_part_m = numbers[part][0], numbers[part][-1], ranges_m[part]
        if first == 0 or last == len(range_m) - 1:
            continue
        beams, distance_m = bright[part], sum(of_part_m) / len(of_part_m)
        width_m = distance_m * (abs(float(bearing_rad[last] - bearing_rad[first])) + step_rad)
        widest_m = 2 * pole_radius_m + _SPREAD_BEAMS * step_rad * distance_m + _SPREAD_M
        thin = width_m <= widest_m
        if thin:  # a beam on its edge sees half of it and half of what is behind, at a range between
            core_m = sorted(of_part_m)[(len(of_part_m) - 1) // 2]
            core = [abs(each_m - core_m) <= pole_radius_m + _BEHIND_M for each_m in of_part_m]
            if not all(core):
                beams = beams[np.array(core)]
                of_core_m = list(compress(of_part_m, core))
                distance_m = sum(of_core_m) / len(of_core_m)
        found.append(Reflector(beams, distance_m, thin))
    return found


def _together(numbers: Sequence[int], ranges_m: Sequence[float]) -> list[slice]:
    """Part bright beams, by their numbers and ranges, into those that lie beside one another."""
    starts = [
        at
        for at in range(1, len(numbers))
        if numbers[at] - numbers[at - 1] > _MARGIN_BEAMS or abs(ranges_m[at] - ranges_m[at - 1]) > _STEP_M
    ]
    return [slice(*ends) for ends in pairwise([0, *starts, len(numbers)])] if numbers else []


@dataclass(slots=True)
class _Place:
    north_m: float
    east_m: float
    sightings: int = 0
    wide: int = 0


class Places:
    """Where in n reflectors stand: each sighting goes to the nearest place known, or makes a new one."""

    def __init__(self) -> None:
        self._places: list[_Place] = []

    def sight(self, point_ne_m: Sequence[float], gate_m: float, *, thin: bool) -> int | None:
        """Give the place of a sighting at north, east; None where there are too many places already."""
        north_m, east_m = point_ne_m
        number = self._nearest(north_m, east_m, gate_m)
        if number is None:
            if len(self._places) == _MOST_PLACES:
                return None
            number = len(self._places)
            self._places.append(_Place(north_m, east_m))
        place = self._places[number]
        place.sightings += 1
        place.wide += not thin
        part = 1 / min(place.sightings, _MEMORY_SCANS)
        place.north_m += (north_m - place.north_m) * part
        place.east_m += (east_m - place.east_m) * part
        return number

    def could_be_pole(self, number: int) -> bool:
        """Say whether what stands there looks thin from all sides: a plate does so from its edge alone."""
        place = self._places[number]
        return place.wide <= _WIDE_SHARE * place.sightings

    def at(self, number: int) -> tuple[float, float]:
        """Give a place's north and east in m."""
        return self._places[number].north_m, self._places[number].east_m

    def _nearest(self, north_m: float, east_m: float, gate_m: float) -> int | None:
        if not self._places:
            return None
        away_m = [math.hypot(one.north_m - north_m, one.east_m - east_m) for one in self._places]
        nearest = min(range(len(away_m)), key=away_m.__getitem__)
        return nearest if away_m[nearest] <= gate_m else None


@dataclass(slots=True)
class Ground:
    """The level of the ground in n, from dull returns; and which returns are it."""

    _levels_m: deque[float] = field(default_factory=deque)
    _ordered_m: list[float] = field(default_factory=list)
    """The same, the lowest first."""

    def beams(
        self, range_m: Array, reflectivity: Array, down_m: Array, *, step: int = 1
    ) -> NDArray[np.bool_]:
        """Say which of K scans' (K, N) returns are it; NaN where there is none.

        It is looked for among each ``step``-th of them, whose z in n is ``down_m`` (K, N / step).
        """
        bright = reflectivity > _DULL
        dull = np.isfinite(range_m) & (range_m <= _GROUND_RANGE_M) & ~bright
        for aside in range(1, _MARGIN_BEAMS + 1):
            dull[:, aside:] &= ~bright[:, :-aside]
            dull[:, :-aside] &= ~bright[:, aside:]
        dull = dull[:, ::step]
        ordered = np.sort(np.where(dull, down_m, np.inf), axis=1)
        level_m = np.zeros(len(dull))
        for number, count in enumerate(dull.sum(axis=1).tolist()):
            if count:
                middle = ordered[number, [(count - 1) // 2, count // 2]]
                level_m[number] = self._median_m(float(middle.sum()) / 2)
        ground: NDArray[np.bool_] = dull & (np.abs(down_m - level_m[:, None]) <= _GROUND_BAND_M)
        return ground

    def _median_m(self, level_m: float) -> float:
        """Take the next scan's level; give the median over the last of them."""
        if len(self._levels_m) == _MEMORY_SCANS:
            del self._ordered_m[bisect_left(self._ordered_m, self._levels_m.popleft())]
        self._levels_m.append(level_m)
        insort(self._ordered_m, level_m)
        count = len(self._ordered_m)
        return (self._ordered_m[(count - 1) // 2] + self._ordered_m[count // 2]) / 2


def even_ground(range_m: Array, bearing_rad: Array, down_m: Array) -> NDArray[np.bool_]:
    """Say which of a pass's (N,) ground returns lie on even ground, not on people, grass or kerbs.

    ``down_m`` is their z in n by a mount that may be off: then level ground looks like a plane over the
    sensor's own x and y, whatever the heading. What stands out from that plane is left out.
    """
    plane = np.stack([np.ones(len(range_m)), range_m * np.cos(bearing_rad), range_m * np.sin(bearing_rad)])
    kept = np.ones(len(range_m), dtype=bool)
    for _ in range(_TRIMS):
        if np.count_nonzero(kept) < _FEWEST_GROUND:
            break
        part = plane.compress(kept, axis=1)  # in a quarter of the time of indexing
        flat = np.linalg.lstsq(part @ part.T, part @ down_m[kept], rcond=None)[0]
        residual = down_m - flat @ plane
        residual -= np.median(residual[kept])
        spread_m = 1.4826 * float(np.median(np.abs(residual[kept])))
        before, kept = kept, np.abs(residual) <= max(_TRIM_SIGMAS * spread_m, _EVEN_M)
        if np.array_equal(kept, before):
            break
    return kept
