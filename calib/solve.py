"""Moments to the mount that minimises Eq. 7.

With the offsets put in, all of Eq. 7 is one quadratic form c = hᵀ Q h in h = [first two columns of Csb,
r_b, 1], so that a solution costs the same for a hundred returns and for a million.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator
from functools import partial
from itertools import product

import numpy as np

from polecal.calib.geometry import Array, roll_pitch_yaw, rotation, rotation_gradient
from polecal.calib.moments import Moments
from polecal.calib.observations import PARAMETERS

_STEPS = 100
_EASED, _DAMPED, _GIVE_UP = 0.1, 10.0, 1e9
_SAME = 1 - 1e-6
_TURNS_RAD = (0.0, np.pi / 2, np.pi, -np.pi / 2)


def form(pole: Moments, ground: Moments) -> Array:
    """Give Q (10, 10) with c = hᵀ Q h in m², of moments that `Moments.at` has folded (Eqs. 5, 6, 7)."""
    return pole.covariance(0) + pole.covariance(1) + ground.covariance(2)


def cost_m(q: Array, vector: Array) -> float:
    """Give √c in m at (6,) x y z (m) roll pitch yaw (rad)."""
    h = _h(vector)
    return float(np.sqrt(max(0.0, float(h @ q @ h))))


def minimise(q: Array, start: Array, held: Collection[str] = ()) -> Array:
    """Give the (6,) vector that minimises hᵀ Q h from ``start``, the ``held`` ones of `PARAMETERS` kept.

    Levenberg-Marquardt on the six numbers themselves; ends where no step lowers the cost any more.
    """
    free = np.array([name not in held for name in PARAMETERS])
    vector = start.astype(np.float64)
    if not free.any():
        return vector
    h = _h(vector)
    cost, damping = h @ q @ h, 1e-6
    for _ in range(_STEPS):
        jacobian = _h_gradient(vector)[:, free]
        hessian = jacobian.T @ q @ jacobian
        gradient = jacobian.T @ (q @ h)
        while damping < _GIVE_UP:
            step = np.zeros(6)
            step[free] = -np.linalg.lstsq(_damped(hessian, damping), gradient, rcond=1e-15)[0]
            candidate = _h(vector + step)
            lower = candidate @ q @ candidate
            if lower < cost:
                break
            damping *= _DAMPED
        else:
            return vector
        vector, h = vector + step, candidate
        settled = np.abs(step).max() < 1e-11 and cost - lower <= 1e-14 * cost
        cost, damping = lower, max(damping * _EASED, 1e-12)
        if settled:
            break
    return vector


def minimise_globally(q: Array, start: Array, held: Collection[str] = ()) -> Array:
    """Give the lowest of the minima found from ``start`` and from it turned by right angles.

    The cost has false minima (paper.md, later work 6). Only rotations need be tried: for each the best
    position follows at once, as the cost is a parabola in r_b. What is held is never turned. Of equal
    minima the one next to ``start`` is taken.
    """
    near = minimise(q, start, held)
    if set(held) & {"roll", "pitch", "yaw"}:
        return near
    lowest = min((minimise(q, turned, held) for turned in _turned(q, start, held)), key=partial(cost_m, q))
    if cost_m(q, lowest) > _SAME * cost_m(q, near):
        return near
    lowest[3:] = roll_pitch_yaw(rotation(lowest[3:]))  # one of the two triples that mean the same rotation
    return lowest


def information(q: Array, vector: Array) -> Array:
    """Give half the Gauss-Newton Hessian of c, (6, 6): m² per m², m·rad, rad²."""
    jacobian = _h_gradient(vector)
    return jacobian.T @ q @ jacobian


def _turned(q: Array, start: Array, held: Collection[str]) -> Iterator[Array]:
    free = [axis for axis in range(3) if PARAMETERS[axis] not in held]
    for turn in list(product((0.0, np.pi), (0.0, np.pi / 2, -np.pi / 2), _TURNS_RAD))[1:]:
        vector = start.copy()
        vector[3:] = roll_pitch_yaw(rotation(start[3:]) @ rotation(np.array(turn)))
        if free:
            jacobian = np.eye(10)[:, [6 + axis for axis in free]]
            curvature, slope = jacobian.T @ q @ jacobian, jacobian.T @ q @ _h(vector)
            vector[free] -= np.linalg.lstsq(curvature, slope, rcond=1e-9)[0]
        yield vector


def _h(vector: Array) -> Array:
    """Give h (10,)."""
    return np.concatenate([rotation(vector[3:])[:, :2].T.ravel(), vector[:3], [1.0]])


def _h_gradient(vector: Array) -> Array:
    """Give dh/d(x y z roll pitch yaw), (10, 6)."""
    gradient = np.zeros((10, 6))
    gradient[6:9, :3] = np.eye(3)
    gradient[:6, 3:] = rotation_gradient(vector[3:])[:, :, :2].transpose(0, 2, 1).reshape(3, 6).T
    return gradient


def _damped(hessian: Array, damping: float) -> Array:
    diagonal = np.diag(hessian)
    damped: Array = hessian + damping * np.diag(diagonal + 1e-12 * diagonal.max())
    return damped
