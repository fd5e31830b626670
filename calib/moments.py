"""Returns to additive sums, from which every cost, solution and uncertainty follows without the returns.

A planar scanner has z_s = 0, so a return in n is linear in what is sought (paper.md, later work 1):

    p_n = G h,  G = [x C | y C | C | p],  h = [first column of Csb, second column, r_b, 1]

with C = Cbn, p the body's position, (x, y) the return in s. Two more things that shift a return are as
linear: a range offset b moves (x, y) by b (cos θ, sin θ), and a time offset τ moves C and p along their path,
by τ Ċ + τ²/2 C̈ and likewise p (at 5 m/s in a turn the square is 2 cm for 40 ms):

    p_n = [G | cos θ C | sin θ C | Ġ | G̈/2] h⁺,  h⁺ = [h, b columns, τ h, τ² h]

The row of n's three axes, 3 × 36 features long, is what is summed: n, Σ f, Σ f fᵀ. Any variance of the
cloud, at any mount, range offset and time offset, is a quadratic form of these sums; and sums of passes
add and subtract.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from polecal.calib.blas import one_thread
from polecal.calib.geometry import Array, rotation_entries
from polecal.calib.observations import Returns

BASE = slice(0, 10)
RANGE = slice(10, 16)
TIME = slice(16, 26)
TIME_SQUARED = slice(26, 36)
"""Where in h⁺ are h, and the parts that a range offset, a time offset and its square scale."""
WIDTH = 36
_BLOCK = 2048  # returns at once: 1.8 MB of features at most, which stay in the cache


@dataclass(frozen=True, slots=True)
class Moments:
    """Sums over returns of one kind: how many, Σ f (108,) and Σ f fᵀ (108, 108), f axis by axis of n (m)."""

    count: int
    first: Array
    second: Array

    def __add__(self, other: Moments) -> Moments:
        return Moments(self.count + other.count, self.first + other.first, self.second + other.second)

    def __sub__(self, other: Moments) -> Moments:
        return Moments(self.count - other.count, self.first - other.first, self.second - other.second)

    def covariance(self) -> Array:
        """Give the covariance (108, 108) of the features, m²; of no returns, nothing."""
        mean = self.first / max(1, self.count)
        covariance = self.second / max(1, self.count) - np.outer(mean, mean)
        return (covariance + covariance.T) / 2


def zero() -> Moments:
    """Give the moments of no returns."""
    return Moments(0, np.zeros(3 * WIDTH), np.zeros((3 * WIDTH, 3 * WIDTH)))


def of(returns: Returns) -> Moments:
    """Sum up returns, whatever their kind."""
    everything = np.arange(len(returns))
    return by_group(returns, everything, np.zeros_like(everything)).get(0, zero())


@one_thread
def by_group(
    returns: Returns,
    index: NDArray[np.int64],
    group: NDArray[np.int64],
    *,
    ranged: bool = True,
    timed: bool = True,
) -> dict[int, Moments]:
    """Sum up those returns (K,) that ``index`` picks, by the number (K,) of their ``group``.

    What a range offset or a time offset scales is left at 0 where it is not ``ranged`` or ``timed``: that
    saves half of the work, or more.
    """
    order = np.argsort(group, kind="stable")
    index, group = index[order], group[order]
    parts = [BASE, *[RANGE] * ranged, *[TIME, TIME_SQUARED] * (timed and returns.motion is not None)]
    of_axis = np.concatenate([np.arange(WIDTH)[part] for part in parts])
    summed = (WIDTH * np.arange(3)[:, None] + of_axis).ravel()
    sums: dict[int, tuple[int, Array | float, Array | float]] = {}
    for start in range(0, len(index), _BLOCK):
        block = group[start : start + _BLOCK]
        features = _features(returns, index[start : start + _BLOCK], parts)
        for begin, end in pairwise([0, *(np.flatnonzero(np.diff(block)) + 1).tolist(), len(block)]):
            some, number = features[:, begin:end], int(block[begin])
            count, first, second = sums.get(number, (0, 0.0, 0.0))
            sums[number] = count + end - begin, first + some.sum(axis=1), second + some @ some.T
    totals = {}
    for number, (count, first, second) in sums.items():
        total = totals[number] = replace(zero(), count=count)
        total.first[summed], total.second[np.ix_(summed, summed)] = first, second
    return totals


def _features(returns: Returns, index: NDArray[np.int64], parts: Sequence[slice]) -> Array:
    """Give the ``parts`` of [G | cos θ C | sin θ C | Ġ | G̈/2], each feature a row: (3 × features, N)."""
    bearing = returns.bearing_rad[index]
    across = np.stack([np.cos(bearing), np.sin(bearing)])
    flat = returns.range_m[index] * across
    c = np.stack(rotation_entries(returns.rpy_rad[index])).reshape(3, 3, -1)  # axis of n, of b, return
    position = returns.position_m[index].T
    rows = []
    for part in parts:
        if part is BASE:
            rows.append(_moved(c, position, flat))
        elif part is RANGE:
            rows.append((across[:, None, None] * c).swapaxes(0, 1).reshape(3, 6, -1))
    if TIME in parts and returns.motion is not None:
        velocity, rate, acceleration, angular_acceleration = (of[index].T for of in returns.motion)
        turn = _crossed(c, rate)  # Ċ
        twist = (_crossed(turn, rate) + _crossed(c, angular_acceleration)) / 2  # C̈/2
        rows += [_moved(turn, velocity, flat), _moved(twist, acceleration / 2, flat)]
    features = np.concatenate(rows, axis=1)
    return features.reshape(-1, len(index))


def _moved(matrix: Array, vector: Array, flat: Array) -> Array:
    """Give [x M | y M | M | v], (3, 10, N), of (3, 3, N), (3, N) and (x, y) in s, (2, N)."""
    moved = np.empty((3, 10, matrix.shape[-1]))
    np.multiply(flat[0], matrix, out=moved[:, 0:3])
    np.multiply(flat[1], matrix, out=moved[:, 3:6])
    moved[:, 6:9], moved[:, 9] = matrix, vector
    return moved


def _crossed(matrix: Array, vector: Array) -> Array:
    """Give M [v]× of (3, 3, N) and (3, N): each row crossed with v."""
    crossed = np.empty_like(matrix)
    for axis in range(3):
        one, two = (axis + 1) % 3, (axis + 2) % 3
        crossed[:, axis] = matrix[:, one] * vector[two] - matrix[:, two] * vector[one]
    return crossed
