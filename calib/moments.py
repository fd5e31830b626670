"""Returns to additive sums, from which every cost, solution and uncertainty follows without the returns.

A planar scanner has z_s = 0, so a return in n is linear in what is sought (paper.md, later work 1):

    p_n = G h,  G = [x C | y C | C | p],  h = [first column of Csb, second column, r_b, 1]

with C = Cbn, p the body's position, (x, y) the return in s. Two more things that shift a return are as
linear: a range offset b moves (x, y) by b (cos θ, sin θ), and a time offset τ moves C and p by τ (Ċ, ṗ):

    p_n = [G | cos θ C | sin θ C | Ġ] h⁺,  h⁺ = [h, b columns, τ h]

The row of n's three axes, 3 × 26 features long, is what is summed: n, Σ f, Σ f fᵀ. Any variance of the
cloud, at any mount, range offset and time offset, is a quadratic form of these sums; and sums of passes
add and subtract.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from polecal.calib.geometry import Array, rotation, skew
from polecal.calib.observations import Returns

BASE = 10
"""Length of h."""
WIDTH = 26
"""Length of h⁺."""
_BLOCK = 8192  # returns at once: 5 MB of features, which stay in the cache's reach


@dataclass(frozen=True, slots=True)
class Moments:
    """Sums over returns of one kind: how many, Σ f (3 * width,) and Σ f fᵀ, f axis by axis of n (m)."""

    count: int
    first: Array
    second: Array

    def __add__(self, other: Moments) -> Moments:
        return Moments(self.count + other.count, self.first + other.first, self.second + other.second)

    def __sub__(self, other: Moments) -> Moments:
        return Moments(self.count - other.count, self.first - other.first, self.second - other.second)

    def at(self, range_offset_m: float, time_offset_s: float) -> Moments:
        """Put in a range and a time offset: moments of 3 × 10 features are left, of h alone."""
        fold = np.zeros((WIDTH, BASE))
        fold[:BASE] = np.eye(BASE)
        fold[10:16, :6] = range_offset_m * np.eye(6)
        fold[16:] = time_offset_s * np.eye(BASE)
        three = np.kron(np.eye(3), fold)
        return Moments(self.count, self.first @ three, three.T @ self.second @ three)

    def mean(self, axis: int) -> Array:
        """Give the (width,) mean of the features of one axis of n: mean = m h, m."""
        return self.first[self._part(axis)] / max(1, self.count)

    def covariance(self, axis: int) -> Array:
        """Give the (width, width) covariance of the features of one axis of n: var = hᵀ S h, m²."""
        part = self._part(axis)
        mean = self.mean(axis)
        covariance = self.second[part, part] / max(1, self.count) - np.outer(mean, mean)
        return (covariance + covariance.T) / 2

    def _part(self, axis: int) -> slice:
        width = len(self.first) // 3
        return slice(axis * width, (axis + 1) * width)


def zero() -> Moments:
    """Give the moments of no returns."""
    return Moments(0, np.zeros(3 * WIDTH), np.zeros((3 * WIDTH, 3 * WIDTH)))


def of(returns: Returns) -> Moments:
    """Sum up returns, whatever their kind."""
    total = zero()
    for start in range(0, len(returns), _BLOCK):
        block = returns[start : start + _BLOCK]
        features = _features(block).reshape(len(block), 3 * WIDTH)
        total += Moments(len(block), features.sum(axis=0), features.T @ features)
    return total


def _features(returns: Returns) -> Array:
    """Give [G | cos θ C | sin θ C | Ġ], (N, 3, 26)."""
    n = len(returns)
    c = rotation(returns.rpy_rad)
    cos = np.cos(returns.bearing_rad)[:, None, None]
    sin = np.sin(returns.bearing_rad)[:, None, None]
    r = returns.range_m[:, None, None]
    features = np.zeros((n, 3, WIDTH))
    features[:, :, 10:13] = cos * c
    features[:, :, 13:16] = sin * c
    features[:, :, 0:6] = r * features[:, :, 10:16]
    features[:, :, 6:9] = c
    features[:, :, 9] = returns.position_m
    if returns.velocity_mps is not None and returns.rate_radps is not None:
        turn = c @ skew(returns.rate_radps)  # Ċ
        features[:, :, 16:19] = r * cos * turn
        features[:, :, 19:22] = r * sin * turn
        features[:, :, 22:25] = turn
        features[:, :, 25] = returns.velocity_mps
    return features
