"""Passes near the minimum of all of them to the minima of any of their subsets, many at once.

What is left out moves a minimum little, and so few numbers say all of it: along the residuals' rows at the
minimum of all and the rows' derivatives there, to first order, each pass is a matrix as small as the unknowns
are many. What is of second order is, at 0.1° and 20 m, 0.03 mm.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from polecal.calib.geometry import Array
from polecal.calib.solve import Along, Scatter, Weights, ground_basis, pole_basis, roughness

_STEPS = 30
_DAMPING, _EASED, _STIFFER, _GIVE_UP = 1e-12, 0.1, 100.0, 1e6
_NOTHING = 1e-12
_FLAT = 1e-9  # of the largest: an unknown that nothing tells
_LEAST = 1e-6  # of a height in m


@dataclass(frozen=True, slots=True)
class Subsets:
    """P passes as they are near a ``vector`` (12,), of whose unknowns some are ``free`` (12,).

    The weights stay what they are for all passes.
    """

    pole: Along
    ground: Along
    weights: Weights
    vector: Array
    free: NDArray[np.bool_]
    bases: tuple[Array, Array]
    """(A, 108, M) of pole and ground: what they are looked along."""

    @classmethod
    def near(
        cls,
        pole: Scatter,
        ground: Scatter,
        weights: Weights,
        vector: Array,
        free: NDArray[np.bool_],
    ) -> Subsets:
        """Look at passes from a vector."""
        rows = np.concatenate([[True], free])
        bases = pole_basis(vector)[:, :, rows], ground_basis(vector)[:, :, rows]
        alongs = _along((pole, ground), bases, weights)
        return cls(*alongs, weights, vector, free, bases)

    def __len__(self) -> int:
        return len(self.pole.count)

    def others(self, pole: Scatter, ground: Scatter) -> Subsets:
        """Look at other passes alike."""
        return self._with(*_along((pole, ground), self.bases, self.weights))

    def joined(self, more: Subsets) -> Subsets:
        """Give these passes and `others`."""
        return self._with(self.pole.joined(more.pole), self.ground.joined(more.ground))

    def paper(self) -> Subsets:
        """Give these passes as they count in Eq. 7."""
        return self._with(self.pole.paper(), self.ground.paper())

    def merged(self) -> Subsets:
        """Give those of each site as one, of which there are no subsets but all: the same, and sooner."""
        return self._with(self.pole.merged(), self.ground.merged())

    def _with(self, pole: Along, ground: Along) -> Subsets:
        return replace(self, pole=pole, ground=ground)

    def minima(self, subsets: NDArray[np.bool_], bend: Array) -> Array:
        """Give the minimum (B, 12) of each of B subsets (B, P); ``bend`` (12, 12) is `solve.Form.bend`."""
        found = np.tile(self.vector, (len(subsets), 1))
        found[:, self.free] += self._steps(subsets.astype(np.float64), bend[np.ix_(self.free, self.free)])
        return found

    def spread_m(self, vector: Array) -> float:
        """Give √ of what all passes spread, in m at a vector (12,) that is near: of `paper` √c of Eq. 7."""
        row, total = np.concatenate([[1.0], (vector - self.vector)[self.free]]), 0.0
        for along in (self.pole, self.ground):
            off = along.mean @ row
            for site in np.unique(along.sites):
                of = along.sites == site
                off[of] -= along.weight[of] / (along.weight[of].sum() or 1.0) @ off[of]
            squares = row @ along.taken.sum(axis=0) @ row + along.weight @ (off**2).sum(axis=1)
            total += float(squares) / max(1.0, float(along.count.sum()))
        return float(np.sqrt(max(0.0, total)))  # of passes of one return each rounding is all there is

    def sides(self, subsets: NDArray[np.bool_]) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
        """Give what pole and ground, each by itself, say of B subsets at the vector.

        Half the gradients and, as `solve.Form.information`, half the Hessians: (B, M) and (B, M, M), M the
        free unknowns.
        """
        parts = subsets.astype(np.float64)
        pole, ground = (_form(along, parts)[:, 1:] for along in (self.pole, self.ground))
        gradient, information = ground[:, :, 0], ground[:, :, 1:]
        if self.weights.rough_m2:
            count = parts * self.ground.count
            steeper = _steeper(count @ self.ground.ray, np.eye(1, pole.shape[2]))
            gradient = gradient - self.weights.rough_m2 * steeper
            bumps = _mixed(parts, self.ground.within) / np.maximum(1.0, count.sum(axis=1))[:, None, None]
            rough_m2 = bumps[:, :1, 0]
            less = roughness(rough_m2 / self.weights.rough_m2)[1] - 1.0
            gradient = gradient + less * bumps[:, 1:, 0]
            known_m2 = np.minimum(rough_m2, self.weights.rough_m2)
            information = information - known_m2[:, :, None] * _outer(steeper)
        return (pole[:, :, 0], pole[:, :, 1:]), (gradient, information)

    def _steps(self, subsets: Array, bend: Array) -> Array:
        """Give how far from the vector (B, M) the minima are: Levenberg-Marquardt, all at once."""
        cost = _Cost(self.pole, self.ground, self.weights, subsets, bend)
        step = np.zeros((len(subsets), int(self.free.sum())))
        value, damping = cost.at(step), np.full(len(subsets), _DAMPING)
        for _ in range(_STEPS):
            gradient, hessian = cost.slopes(step)
            curved = np.sqrt(np.abs(np.einsum("bii->bi", hessian)))
            scale = np.maximum(curved, _FLAT * curved.max(axis=1, initial=0.0, keepdims=True)) + 1e-150
            scaled = hessian / scale[:, :, None] / scale[:, None]
            scaled += damping[:, None, None] * np.eye(step.shape[1])
            way = -np.linalg.solve(scaled, (gradient / scale)[:, :, None])[:, :, 0] / scale
            lower = cost.at(step + way)
            better = lower < value
            promised = -(gradient * way).sum(axis=1)
            step[better] += way[better]
            value = np.where(better, lower, value)
            damping = np.where(better, damping * _EASED, np.maximum(damping, 1e-9) * _STIFFER)
            if (~better & (damping > _GIVE_UP) | (np.abs(promised) <= _NOTHING * np.abs(value))).all():
                break
        return step

    def left_out_m(self, used: NDArray[np.bool_], left_out: Array) -> float:
        """Give √c in m of all used passes, each at the (U, 12) without it, about the others' means."""
        rows = np.zeros((len(used), 1 + int(self.free.sum())))
        rows[used, 0], rows[used, 1:] = 1.0, (left_out - self.vector)[:, self.free]
        total = 0.0
        for along in (self.pole, self.ground):
            weight = along.weight * used
            others = (along.sites[:, None] == along.sites) * weight
            np.fill_diagonal(others, 0.0)
            weighed = others.sum(axis=1)
            mean = np.einsum("pq,qam->pam", others / np.maximum(weighed, 1e-300)[:, None], along.mean)
            off = np.einsum("pam,pm->pa", along.mean - mean, rows) * (weighed > 0)[:, None]
            squares = np.einsum("pi,pij,pj->p", rows, along.within, rows) + along.count * (off**2).sum(axis=1)
            total += float(squares[used].sum()) / max(1.0, float(along.count[used].sum()))
        return float(np.sqrt(max(0.0, total)))  # of passes of one return each rounding is all there is


def _along(
    scatters: tuple[Scatter, Scatter], bases: tuple[Array, Array], weights: Weights
) -> tuple[Along, Along]:
    """Look at pole and ground along their bases, weighed."""
    (pole, ground), (of_pole, of_ground) = scatters, bases
    return pole.along(of_pole, weights.pole_ratio), ground.along(of_ground, weights.ground_ratio)


class _Cost:
    """What `solve.Form` is of each of B subsets, (B, P) of 0 and 1, as a function of the step (B, M)."""

    def __init__(self, pole: Along, ground: Along, weights: Weights, subsets: Array, bend: Array) -> None:
        on_pole, on_ground = subsets @ pole.count, subsets @ ground.count
        self._balance = np.array([weights.balance(*each) for each in zip(on_pole, on_ground, strict=True)])
        self._square = _form(pole, subsets) + self._balance[:, None, None] * _form(ground, subsets)
        self._square[:, 1:, 1:] += bend
        self._rough_m2 = weights.rough_m2
        per_return = 1.0 / np.maximum(1.0, on_ground)[:, None]
        self._ray = (subsets * ground.count) @ ground.ray * per_return
        self._bumps = _mixed(subsets, ground.within) * per_return[:, :, None]

    def at(self, step: Array) -> Array:
        """Give c (B,), m²."""
        row = _row(step)
        value: Array = _dot(row, _times(self._square, row))
        if self._rough_m2:
            rough = -2.0 * np.log(np.maximum(np.abs(_dot(self._ray, row)), _LEAST))
            bumps = _dot(row, _times(self._bumps, row)) / self._rough_m2
            rough += roughness(bumps)[0] + 1.0 - bumps
            value = value + self._balance * self._rough_m2 * rough
        return value

    def slopes(self, step: Array) -> tuple[Array, Array]:
        """Give half the gradient (B, M) and half the Hessian (B, M, M) of c."""
        row = _row(step)
        gradient, hessian = _times(self._square, row)[:, 1:], self._square[:, 1:, 1:].copy()
        if not self._rough_m2:
            return gradient, hessian
        rough = (self._balance * self._rough_m2)[:, None]
        steeper = _steeper(self._ray, row)
        gradient = gradient - rough * steeper
        hessian += rough[:, :, None] * _outer(steeper)
        pulled = _times(self._bumps, row)
        bumps = (_dot(row, pulled) / self._rough_m2)[:, None]
        per = roughness(bumps)[1]
        less, way = self._balance[:, None] * (per - 1.0), per * pulled[:, 1:] / self._rough_m2
        gradient = gradient + less * pulled[:, 1:]
        bent = 2.0 * rough * (per * bumps < 1.0 + 1e-9)  # beyond, `roughness` is straight
        hessian += less[:, :, None] * self._bumps[:, 1:, 1:] - bent[:, :, None] * _outer(way)
        return gradient, hessian


def _form(along: Along, subsets: Array) -> Array:
    """Give `Scatter.form` of each subset, (B, M, M)."""
    mean = along.mean - along.mean[:1]  # else the digits are lost to how far off n's origin is
    squares = along.taken + along.weight[:, None, None] * (mean.swapaxes(1, 2) @ mean)
    form = _mixed(subsets, squares)
    for site in np.unique(along.sites):
        weight = subsets * along.weight * (along.sites == site)
        summed = _mixed(weight, mean)
        form -= summed.swapaxes(1, 2) @ summed / np.maximum(weight.sum(axis=1), 1e-300)[:, None, None]
    form /= np.maximum(1.0, subsets @ along.count)[:, None, None]
    return form


def _mixed(weights: Array, matrices: Array) -> Array:
    """Give Σ of P matrices (P, …) by weights (B, P): (B, …)."""
    mixed: Array = (weights @ matrices.reshape(len(matrices), -1)).reshape(-1, *matrices.shape[1:])
    return mixed


def _steeper(ray: Array, row: Array) -> Array:
    """Give the derivative (B, M) of ln of the sensor's height; 0 where a subset has no ground."""
    height = _dot(ray, row)[:, None]
    steeper: Array = ray[:, 1:] / np.where(height == 0.0, np.inf, height)
    return steeper


def _row(step: Array) -> Array:
    return np.concatenate([np.ones((len(step), 1)), step], axis=1)


def _times(matrices: Array, vectors: Array) -> Array:
    times: Array = (matrices @ vectors[:, :, None])[:, :, 0]
    return times


def _dot(one: Array, other: Array) -> Array:
    dot: Array = (one * other).sum(axis=1)
    return dot


def _outer(vectors: Array) -> Array:
    return vectors[:, :, None] * vectors[:, None]
