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

from dataclasses import dataclass

import numpy as np

from polecal.calib.blas import one_thread
from polecal.calib.geometry import Array, rotation, skew
from polecal.calib.observations import Returns

BASE = slice(0, 10)
RANGE = slice(10, 16)
TIME = slice(16, 26)
TIME_SQUARED = slice(26, 36)
"""Where in h⁺ are h, and the parts that a range offset, a time offset and its square scale."""
WIDTH = 36
_BLOCK = 2048  # returns at once: 1.8 MB of features, which stay in the cache


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


@one_thread
def of(returns: Returns) -> Moments:
    """Sum up returns, whatever their kind."""
    total = zero()
    for start in range(0, len(returns), _BLOCK):
        block = returns[start : start + _BLOCK]
        features = _features(block).reshape(len(block), 3 * WIDTH)
        total += Moments(len(block), features.sum(axis=0), features.T @ features)
    return total


def _features(returns: Returns) -> Array:
    """Give [G | cos θ C | sin θ C | Ġ | G̈/2], (N, 3, 36)."""
    n = len(returns)
    c = rotation(returns.rpy_rad)
    cos = np.cos(returns.bearing_rad)[:, None, None]
    sin = np.sin(returns.bearing_rad)[:, None, None]
    r = returns.range_m[:, None, None]
    features = np.zeros((n, 3, WIDTH))
    base, ranged = features[:, :, BASE], features[:, :, RANGE]
    ranged[:, :, :3], ranged[:, :, 3:] = cos * c, sin * c
    base[:, :, :6] = r * ranged
    base[:, :, 6:9], base[:, :, 9] = c, returns.position_m
    if returns.motion is not None:
        velocity, rate, acceleration, angular_acceleration = returns.motion
        turn = c @ skew(rate)  # Ċ
        twist = (turn @ skew(rate) + c @ skew(angular_acceleration)) / 2  # C̈/2
        for part, matrix, vector in ((TIME, turn, velocity), (TIME_SQUARED, twist, acceleration / 2)):
            timed = features[:, :, part]
            timed[:, :, :3], timed[:, :, 3:6] = r * cos * matrix, r * sin * matrix
            timed[:, :, 6:9], timed[:, :, 9] = matrix, vector
    return features
