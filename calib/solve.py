"""Moments to the mount that minimises Eq. 7.

All of Eq. 7 is one quadratic form c = h⁺ᵀ Q h⁺ (`moments`), so that a solution costs the same for a hundred
returns and for a million. The unknowns are the six of the mount, a time offset and a range offset.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from functools import partial
from itertools import product

import numpy as np
from numpy.typing import NDArray

from polecal.calib.geometry import Array, roll_pitch_yaw, rotation, rotation_gradient
from polecal.calib.moments import BASE, RANGE, TIME, TIME_SQUARED, WIDTH, Moments
from polecal.calib.observations import PARAMETERS

UNKNOWNS = (*PARAMETERS, "time", "range")
"""What can be solved for, in the order of every vector (8,) here: m, rad, s, m."""

_STEPS = 100
_EASED, _DAMPED, _GIVE_UP = 0.1, 10.0, 1e9
_SAME = 1 - 1e-6
_TURNS_RAD = (0.0, np.pi / 2, np.pi, -np.pi / 2)


class Scatter:
    """The spread of one kind of returns: within each pass, and of the passes' means.

    Takes each pass's moments, and the axes of n whose variance counts (north and east of the pole, Eq. 5;
    down of the ground, Eq. 6). ``shift_m`` is a range offset that is known; ``ranged`` says whether these
    returns take part in one that is not.
    """

    def __init__(
        self, passes: Sequence[Moments], axes: Sequence[int], *, shift_m: float = 0.0, ranged: bool = False
    ) -> None:
        fold = np.eye(WIDTH)
        fold[RANGE, RANGE] *= ranged
        fold[RANGE, 0:6] = shift_m * np.eye(6)
        self.count = np.array([one.count for one in passes], dtype=np.float64)
        self._axes = len(axes)
        spread = [one.count * sum(one.covariance(axis) for axis in axes) for one in passes]
        self._within = fold.T @ np.stack(spread) @ fold  # (P, 36, 36)
        self._mean = np.stack([[one.mean(axis) for axis in axes] for one in passes]) @ fold  # (P, axes, 36)

    def form(self, used: NDArray[np.bool_], ratio: float = np.inf) -> Array:
        """Give the quadratic form (36, 36) of the used passes' variance in m².

        ``ratio`` is the variance within a pass over that of the error which all its returns share: a pass
        of n returns says no more of where its mean should be than n / (1 + n / ratio) independent ones.
        Infinite: no error is shared, and the form is the variance of Eqs. 5 and 6 to the letter.
        """
        total = self.count[used].sum()
        if not total:
            return np.zeros((WIDTH, WIDTH))
        weight = self.count[used] / (1.0 + self.count[used] / ratio)
        mean = self._mean[used]
        apart = mean - np.tensordot(weight / weight.sum(), mean, axes=1)
        between = np.tensordot(weight[:, None, None] * apart, apart, axes=((0, 1), (0, 1)))
        form: Array = (self._within[used].sum(axis=0) + between) / total
        return form

    def ratio(self, vector: Array) -> float:
        """Estimate that ratio from the passes themselves, at ``vector`` (8,)."""
        there = self.count > 0
        h = _h(vector)
        count, mean = self.count[there], self._mean[there] @ h
        if len(count) < 2:
            return np.inf
        within = float(np.einsum("i,pij,j->", h, self._within[there], h)) / (count.sum() * self._axes)
        apart = float(mean.var(axis=0, ddof=1).mean()) - within * float((1.0 / count).mean())
        return within / apart if apart > 0 else np.inf


def cost_m(q: Array, vector: Array) -> float:
    """Give √c in m at ``vector`` (8,)."""
    h = _h(vector)
    return float(np.sqrt(max(0.0, float(h @ q @ h))))


def minimise(q: Array, start: Array, held: Collection[str] = ()) -> Array:
    """Give the (8,) vector that minimises c from ``start``, the ``held`` ones of `UNKNOWNS` kept.

    Levenberg-Marquardt on the numbers themselves; ends where no step lowers the cost any more.
    """
    free = np.array([name not in held for name in UNKNOWNS])
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
            step = np.zeros(len(UNKNOWNS))
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
    lowest[3:6] = roll_pitch_yaw(rotation(lowest[3:6]))  # one of the two triples that mean the same rotation
    return lowest


def information(q: Array, vector: Array) -> Array:
    """Give half the Gauss-Newton Hessian of c, (8, 8): m² per the unknowns' units."""
    jacobian = _h_gradient(vector)
    return jacobian.T @ q @ jacobian


def _turned(q: Array, start: Array, held: Collection[str]) -> Iterator[Array]:
    free = [axis for axis in range(3) if UNKNOWNS[axis] not in held]
    for turn in list(product((0.0, np.pi), (0.0, np.pi / 2, -np.pi / 2), _TURNS_RAD))[1:]:
        vector = start.copy()
        vector[3:6] = roll_pitch_yaw(rotation(start[3:6]) @ rotation(np.array(turn)))
        if free:
            jacobian = _h_gradient(vector)[:, free]
            curvature, slope = jacobian.T @ q @ jacobian, jacobian.T @ q @ _h(vector)
            vector[free] -= np.linalg.lstsq(curvature, slope, rcond=1e-9)[0]
        yield vector


def _h(vector: Array) -> Array:
    """Give h⁺ (36,)."""
    time_s, range_m = vector[6:]
    columns = rotation(vector[3:6])[:, :2].T.ravel()
    h = np.concatenate([columns, vector[:3], [1.0]])
    return np.concatenate([h, range_m * columns, time_s * h, time_s**2 * h])


def _h_gradient(vector: Array) -> Array:
    """Give dh⁺/d(x y z roll pitch yaw time range), (36, 8)."""
    time_s, range_m = vector[6:]
    gradient = np.zeros((WIDTH, len(UNKNOWNS)))
    turned = rotation_gradient(vector[3:6])[:, :, :2].transpose(0, 2, 1).reshape(3, 6).T
    gradient[6:9, :3] = np.eye(3)
    gradient[:6, 3:6] = turned
    gradient[RANGE, 3:6] = range_m * turned
    gradient[TIME, :6] = time_s * gradient[BASE, :6]
    gradient[TIME_SQUARED, :6] = time_s**2 * gradient[BASE, :6]
    h = _h(vector)
    gradient[TIME, 6] = h[BASE]
    gradient[TIME_SQUARED, 6] = 2 * time_s * h[BASE]
    gradient[RANGE, 7] = h[:6]
    return gradient


def _damped(hessian: Array, damping: float) -> Array:
    diagonal = np.diag(hessian)
    damped: Array = hessian + damping * np.diag(diagonal + 1e-12 * diagonal.max())
    return damped
