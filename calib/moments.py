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

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from functools import cache, partial
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from polecal.calib.blas import one_thread
from polecal.calib.geometry import Array, rotation_rows
from polecal.calib.observations import Returns

BASE = slice(0, 10)
RANGE = slice(10, 16)
TIME = slice(16, 26)
TIME_SQUARED = slice(26, 36)
"""Where in h⁺ are h, and the parts that a range offset, a time offset and its square scale."""
WIDTH = 36
NORTH, EAST, DOWN = range(3)
_BLOCK = 2048 * 108  # numbers at once: 1.8 MB of features, which stay in the cache


@dataclass(frozen=True, slots=True, eq=False)
class Moments:
    """Sums over returns of one kind: how many, Σ f (K,) and Σ f fᵀ, f in m, axis by axis of n.

    ``features`` (K,) says which of the 108 were summed up, in order; of the others nothing is known.
    ``held`` is what `packed` gives, or, where that is kept elsewhere, a function that fetches it.
    """

    count: int
    features: NDArray[np.int64]
    first: Array
    held: Array | Callable[[], Array]

    def __add__(self, other: Moments) -> Moments:
        return self._with(other, 1)

    def __sub__(self, other: Moments) -> Moments:
        return self._with(other, -1)

    def _with(self, other: Moments, sign: int) -> Moments:
        one, two = self, other
        if not np.array_equal(one.features, two.features):
            both = _features_of(np.union1d(one.features, two.features).tobytes())
            one, two = one.over(both), two.over(both)
        return Moments(
            one.count + sign * two.count,
            one.features,
            one.first + sign * two.first,
            one.packed + sign * two.packed,
        )

    def over(self, features: NDArray[np.int64]) -> Moments:
        """Give the same, of more features: the sums of those that were left out are 0."""
        if features is self.features or np.array_equal(features, self.features):
            return self
        there = np.searchsorted(features, self.features)
        first = np.zeros(len(features))
        first[there] = self.first
        return Moments(self.count, features, first, partial(self._packed_over, len(features), there))

    def _packed_over(self, width: int, there: NDArray[np.int64]) -> Array:
        packed = np.zeros(width * (width + 1) // 2)
        packed[unpacked(width)[np.ix_(there, there)].ravel()[upper(len(there))]] = self.packed
        return packed

    @property
    def packed(self) -> Array:
        """Σ f fᵀ, which is symmetric: its upper triangle, row by row, (K (K + 1) / 2,)."""
        return self.held() if callable(self.held) else self.held

    @property
    def second(self) -> Array:
        """Σ f fᵀ, (K, K)."""
        return self.packed[unpacked(len(self.features))]

    def mean(self) -> Array:
        """Give the mean (3, 36) of the features, m; 0 of those that were left out."""
        mean = np.zeros(3 * WIDTH)
        mean[self.features] = self.first / max(1, self.count)
        return mean.reshape(3, WIDTH)


def zero() -> Moments:
    """Give the moments of no returns."""
    return Moments(0, np.zeros(0, dtype=np.int64), np.zeros(0), np.zeros(0))


def of_sums(count: int, features: NDArray[np.int64], first: Array, second: Array) -> Moments:
    """Pack sums over so many returns: of features (K,), (K,) and (K, K)."""
    return Moments(count, features, first, second.ravel()[upper(len(features))])


def alike(parts: Sequence[Moments]) -> list[Moments]:
    """Give parts each over the features that any of them has."""
    features = parts[0].features if parts else zero().features
    for part in parts:
        if part.features is not features and not np.array_equal(part.features, features):
            features = np.union1d(features, part.features)
    return [part.over(features) for part in parts]


@cache
def _features_of(numbers: bytes) -> NDArray[np.int64]:
    """Give features (K,) of the bytes of their numbers: for hundreds of passes that are alike one array."""
    return np.frombuffer(numbers, dtype=np.int64)


@cache
def upper(width: int) -> NDArray[np.int64]:
    """Give where the upper triangle is in a matrix (K, K), flat."""
    row, column = np.triu_indices(width)
    return row * width + column


@cache
def unpacked(width: int) -> NDArray[np.int64]:
    """Give where each entry (K, K) of a symmetric matrix is in its packed upper triangle."""
    row, column = np.indices((width, width))
    low, high = np.minimum(row, column), np.maximum(row, column)
    where: NDArray[np.int64] = low * width - low * (low - 1) // 2 + high - low
    return where


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
    axes: Collection[int] = (NORTH, EAST, DOWN),
    ranged: bool = True,
    timed: bool = True,
) -> dict[int, Moments]:
    """Sum up those returns (K,) that ``index`` picks, by the number (K,) of their ``group``.

    Of axes of n that are not asked for nothing is summed, nor what a range offset or a time offset scales
    where it is not ``ranged`` or ``timed``: that saves half of the work, or more.
    """
    if (np.diff(group) < 0).any():
        order = np.argsort(group, kind="stable")
        index, group = index[order], group[order]
    parts = [BASE, *[RANGE] * ranged, *[TIME, TIME_SQUARED] * (timed and returns.motion is not None)]
    of_axis = np.concatenate([np.arange(WIDTH)[part] for part in parts])
    summed = _features_of((WIDTH * np.array(sorted(axes))[:, None] + of_axis).tobytes())
    sums: dict[int, tuple[int, Array | float, Array | float]] = {}
    size = _BLOCK // len(summed)
    for start in range(0, len(index), size):
        block, some = group[start : start + size], index[start : start + size]
        beside = bool((np.diff(some) == 1).all())  # then they are looked at where they are
        picked = slice(int(some[0]), int(some[-1]) + 1) if beside else some
        features = _features(returns, picked, sorted(axes), parts)
        for begin, end in pairwise([0, *(np.flatnonzero(np.diff(block)) + 1).tolist(), len(block)]):
            of_group, number = features[:, begin:end], int(block[begin])
            count, first, second = sums.get(number, (0, 0.0, 0.0))
            first = first + of_group.sum(axis=1)
            sums[number] = count + end - begin, first, second + of_group @ of_group.T
    return {
        number: of_sums(count, summed, np.asarray(first), np.asarray(second))
        for number, (count, first, second) in sums.items()
    }


def _features(
    returns: Returns, index: NDArray[np.int64] | slice, axes: Sequence[int], parts: Sequence[slice]
) -> Array:
    """Give the ``parts`` of [G | cos θ C | sin θ C | Ġ | G̈/2], each feature a row: (axes × features, N)."""
    bearing = returns.bearing_rad[index]
    across = np.stack([np.cos(bearing), np.sin(bearing)])
    flat = returns.range_m[index] * across
    c = rotation_rows(returns.rpy_rad[index], axes)  # axis of n, of b, return
    position = returns.position_m[index].T[axes]
    features = np.empty((len(axes), sum(part.stop - part.start for part in parts), len(bearing)))
    _move(c, position, flat, features[:, BASE])
    if RANGE in parts:
        np.multiply(
            across[:, None, None], c, out=features[:, RANGE].reshape(len(axes), 2, 3, -1).swapaxes(0, 1)
        )
    if TIME in parts and returns.motion is not None:
        velocity, rate, acceleration, angular_acceleration = (of[index].T for of in returns.motion)
        turn = _crossed(c, rate)  # Ċ
        twist = (_crossed(turn, rate) + _crossed(c, angular_acceleration)) / 2  # C̈/2
        _move(turn, velocity[axes], flat, features[:, -20:-10])
        _move(twist, acceleration[axes] / 2, flat, features[:, -10:])
    return features.reshape(-1, len(bearing))


def _move(matrix: Array, vector: Array, flat: Array, moved: Array) -> None:
    """Put [x M | y M | M | v] into (axes, 10, N), of (axes, 3, N), (axes, N) and (x, y) in s, (2, N)."""
    np.multiply(flat[0], matrix, out=moved[:, 0:3])
    np.multiply(flat[1], matrix, out=moved[:, 3:6])
    moved[:, 6:9], moved[:, 9] = matrix, vector


def _crossed(matrix: Array, vector: Array) -> Array:
    """Give M [v]× of (axes, 3, N) and (3, N): each row crossed with v."""
    crossed = np.empty_like(matrix)
    for axis in range(3):
        one, two = (axis + 1) % 3, (axis + 2) % 3
        crossed[:, axis] = matrix[:, one] * vector[two] - matrix[:, two] * vector[one]
    return crossed
