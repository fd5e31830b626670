"""The scatter between passes to a covariance.

All returns of a pass share one navigation error, so that the returns' number says little: what is found
gets better as 1/√passes (paper.md, later work 2). The jackknife leaves out one pass at a time.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from polecal.calib.geometry import Array, wrap

FEWEST_PASSES = 4
"""With fewer passes than this a scatter says nothing."""


def jackknife(left_out: Array) -> Array:
    """Give the covariances (..., n, n) of the whole, from (..., P, n) solutions each without one of P passes.

    Tukey's (P-1)/P Σ d dᵀ, d from the mean; unknowns 3 to 5 are angles in rad, compared the short way
    round.
    """
    passes = left_out.shape[-2]
    spread = left_out - left_out[..., :1, :]
    spread[..., 3:6] = wrap(spread[..., 3:6])
    spread -= spread.mean(axis=-2, keepdims=True)
    covariance: Array = (passes - 1) / passes * spread.swapaxes(-2, -1) @ spread
    return covariance


def reach(passes: int, unknowns: int = 1, level: float = 0.95) -> float:
    """Give how many σ of `jackknife` the truth is within, with probability ``level``.

    So few passes know their own scatter badly: of one unknown Student's t of P-1, of n together, whose
    √(dᵀ C⁻¹ d) it bounds, Hotelling's T² (n at most P-1, else there is no such region, and it is infinite).
    """
    from scipy.special import fdtri  # noqa: PLC0415 - 17 MB, and the daemon does not ask for it

    left = passes - unknowns
    if left < 1:
        return np.inf
    return float(np.sqrt((passes - 1) * unknowns / left * fdtri(unknowns, left, level)))


def from_model(information: Array, cost: float, observations: int, free: NDArray[np.bool_]) -> Array:
    """Give the covariance (n, n) that so many independent observations of variance ``cost`` (m²) allow.

    Of the ``free`` parameters only, ``information`` (n, n) is half the Hessian of the cost. What the data say
    nothing about comes out with a huge variance, where a scatter would come out as nothing.
    """
    covariance = np.zeros_like(information)
    values, vectors = np.linalg.eigh(information[np.ix_(free, free)])
    floor = max(values.max(initial=0.0), 1e-12) * 1e-12
    inverse = vectors @ np.diag(1.0 / np.maximum(values, floor)) @ vectors.T
    covariance[np.ix_(free, free)] = cost / max(1, observations) * inverse
    return covariance
