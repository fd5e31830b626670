"""From one pose over the ground to another: ways of arcs and straights that a vehicle can drive forward.

A pose is (north m, east m, heading rad). The six ways are those of Dubins, On curves of minimal length
with a constraint on average curvature (1957): turn, straight, turn, or three turns.
"""

from __future__ import annotations

from collections.abc import Iterator
from math import acos, atan2, ceil, cos, hypot, pi, sin, sqrt

import numpy as np

from polecal.calib.geometry import Array

Pose = tuple[float, float, float]

STEP_M = 0.5
"""Between the points of a way, at most."""
_TAU = 2 * pi
_LEAST = 1e-9  # of a turn or a radius: less is none


def ways(begin: Pose, end: Pose, radius_m: float) -> Iterator[Array]:
    """Give each way as points (N, 3): poses, from ``begin`` to ``end``, the heading going on over 2π."""
    for word in _words(begin, end, radius_m):
        yield _points(begin, end, word, radius_m)


def length_m(points: Array) -> float:
    """Give how long a way is."""
    return float(np.linalg.norm(np.diff(points[:, :2], axis=0), axis=1).sum())


def straight(begin: Pose, along_m: float) -> Array:
    """Give the way straight on, (N, 3); backward where ``along_m`` is negative."""
    north, east, heading = begin
    along = np.linspace(0.0, along_m, max(1, ceil(abs(along_m) / STEP_M)) + 1)
    return np.stack([north + along * cos(heading), east + along * sin(heading), 0 * along + heading], axis=1)


Word = tuple[tuple[int, float], ...]
"""Segments: 1 turns right, -1 left, 0 goes straight; and how long, in radii."""


def _words(begin: Pose, end: Pose, radius_m: float) -> Iterator[Word]:
    north, east = end[0] - begin[0], end[1] - begin[1]
    d, course = hypot(north, east) / radius_m, atan2(east, north)
    a, b = begin[2] - course, end[2] - course
    both = cos(a - b)
    for first, last in ((1, 1), (-1, -1), (1, -1), (-1, 1)):
        # In a mirror, where the first turn is to the right, the angles are those with the other sign
        sa, sb, ca, cb = first * sin(a), first * sin(b), cos(a), cos(b)
        if first == last:
            squared = 2 + d * d - 2 * both + 2 * d * (sa - sb)
            towards = atan2(cb - ca, d + sa - sb)
            p = sqrt(max(squared, 0.0))
        else:
            squared = d * d - 2 + 2 * both + 2 * d * (sa + sb)
            if squared < 0:
                continue
            p = sqrt(squared)
            towards = atan2(-ca - cb, d + sa + sb) - atan2(-2.0, p)
        turn = (towards - first * a) % _TAU
        back = (first * b - towards) % _TAU if first == last else (towards - first * b) % _TAU
        yield (first, turn), (0, p), (last, back)
    for first in (1, -1):
        sa, sb, ca, cb = first * sin(a), first * sin(b), cos(a), cos(b)
        share = (6 - d * d + 2 * both + 2 * d * (sb - sa)) / 8
        if abs(share) > 1:
            continue
        p = _TAU - acos(share)
        turn = (-first * a - atan2(ca - cb, d + sa - sb) + p / 2) % _TAU
        yield (first, turn), (-first, p), (first, (first * (b - a) - turn + p) % _TAU)


def _points(begin: Pose, end: Pose, word: Word, radius_m: float) -> Array:
    at = begin
    parts = [np.array([begin])]
    for turn, size in word:
        if size < _LEAST or (_TAU - size < _LEAST and turn):
            continue
        if turn:
            angle = np.linspace(0.0, size, ceil(size * radius_m / STEP_M) + 1)[1:]
            heading = at[2] + turn * angle
            north = at[0] + turn * radius_m * (np.sin(heading) - sin(at[2]))
            east = at[1] - turn * radius_m * (np.cos(heading) - cos(at[2]))
            part = np.stack([north, east, heading], axis=1)
        else:
            part = straight(at, size * radius_m)[1:]
        parts.append(part)
        at = (float(part[-1, 0]), float(part[-1, 1]), float(part[-1, 2]))
    points = np.concatenate(parts)
    points[-1, :2] = end[:2]
    return points
