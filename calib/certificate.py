"""A minimum to whether it is proven that no other mount anywhere has a lower cost.

With the position eliminated c is a form Q in u = [the three columns of Csb, 1], and that these are a
rotation's is a number of equations uᵀ A_i u = 0: columns and rows of length 1 and square to each other, each
column the cross product of the other two. For any λ and γ, where Z = Q - Σ λ_i A_i - γ e eᵀ has no negative
eigenvalue (e = [0 … 0, 1]), c is at least γ for every rotation; where one is negative, less by 4 of it, as
uᵀu is 4. The largest such γ is sought by a barrier and Newton's steps, and all of them are true bounds.
Columns of length 1 and square alone would do, but for noisy rigs do not suffice to close the gap.
Source: Briales, Gonzalez-Jimenez, Convex global 3D registration with Lagrangian duality, CVPR 2017.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, replace
from itertools import combinations_with_replacement

import numpy as np

from polecal.calib.geometry import Array, rotation
from polecal.calib.solve import (
    CLEARLY,
    FLATTEST,
    ROUGHEST,
    Form,
    cost_m,
    ground_rows,
    roughness,
    without_position,
)

_NOTHING_M = 1e-4
_FAINTEST = 1e-9  # of its best told direction: where the position is told less, rounding says where it is
_ROUNDING = 1e-13  # of the largest number, for each of them that the sums went through
_LOWEST_M2 = 1e-5  # of a sensor's squared height over its ground: far above where `Form.cost` ends the law
_AWAY = np.array([0.1, 0.3, 0.7, 1.5])  # in the logarithm
_CLOSER = 0.1  # to the cost than is needed to prove it: the bound is shown
_LESS, _STEPS, _NEAR = 0.01, 50, 0.25
_LEAST_WEIGHT = 1e-13
_ANGLES = frozenset({"roll", "pitch", "yaw"})


@dataclass(frozen=True, slots=True)
class Certificate:
    """By how much of itself √c could at most be lower at another mount, the weights and extras given.

    1 where no bound is known. ``proven`` says that it is no more than 0.5 %, or 0.1 mm: of minima that are as
    near to one another as that, each is.
    """

    lower_by: float
    proven: bool


_UNKNOWN = Certificate(1.0, False)


def certify(form: Form, vector: Array, held: Collection[str] = ()) -> Certificate:
    """Bound what ``form`` costs at any mount with the same ``held`` unknowns and extras as ``vector`` (12,).

    What rough ground adds, -σ² ln s of the sensor's height squared s, is nowhere below its tangent at
    ``vector``, and what its roughness adds not below its chords (`_chords`): these are forms, too, which are
    bounded in its place. No bound is given where the data do not tell a position that is not held, and where
    of the angles others are held than none, roll and pitch, or all.
    """
    turned = _turned(vector, held)
    if turned is None:
        return _UNKNOWN
    here, spread_m, bent = form.spread(vector), cost_m(form, vector), np.zeros((6, 6))
    if (height := form.height_in_h(vector)) is not None:
        height_m2 = float(height[:6] @ rotation(vector[3:6])[:, :2].T.ravel()) ** 2
        if height_m2 < _LOWEST_M2:
            return _UNKNOWN
        bent_m2 = form.balance * form.rough_m2
        bent = bent_m2 / height_m2 * np.outer(height[:6], height[:6])
        here -= bent_m2
    parts = [(form, 0.0)]
    if form.bumps is not None:
        down = ground_rows(vector)[0]
        bumps_m2 = float(down @ form.bumps @ down)
        here += form.balance * (
            form.rough_m2 * float(roughness(np.array(bumps_m2 / form.rough_m2))[0]) - bumps_m2
        )
        parts = _chords(form, bumps_m2 / form.rough_m2)
    least_m = min(CLEARLY * spread_m, spread_m - _NOTHING_M)
    wanted = here - _CLOSER * (spread_m**2 - max(0.0, least_m) ** 2)
    known, equations, square = turned
    lowest = np.inf
    for part, more in parts:
        reduced = _eliminated(part, vector, held)
        if reduced is None:
            return _UNKNOWN
        q, rounding = reduced
        q[:6, :6] -= bent
        bound = _dual(known.T @ q @ known, equations, square, wanted - more + rounding)
        lowest = min(lowest, bound - rounding + more)
    bound_m = float(np.sqrt(max(0.0, spread_m**2 - max(0.0, here - lowest))))
    return Certificate(1.0 - bound_m / spread_m if spread_m else 0.0, bound_m >= least_m)


def _chords(form: Form, at: float) -> list[tuple[Form, float]]:
    """Give forms without bumps, and what to add to each, of which one at least is nowhere above ``form``.

    Each is so where what the ground's roughness looks like, over what it was taken for, is between two
    numbers: there the chord of `roughness` is not above it. They are the closer, the nearer to ``at``.
    """
    middle = min(at, ROUGHEST)
    knots = middle * np.exp(np.concatenate([-_AWAY[::-1], [0.0], _AWAY]))
    knots = np.array([FLATTEST, *knots[(knots > FLATTEST) & (knots < ROUGHEST)], ROUGHEST, 2.0 * ROUGHEST])
    logarithms = roughness(knots)[0]
    slopes = np.diff(logarithms) / np.diff(knots)
    added = form.balance * form.rough_m2 * (logarithms[:-1] - slopes * knots[:-1])
    return [
        (replace(form, ground=form.ground + (slope - 1.0) * form.bumps, bumps=None), float(more))
        for slope, more in zip(slopes, added, strict=True)
    ]


def _eliminated(form: Form, vector: Array, held: Collection[str]) -> tuple[Array, float] | None:
    """Give c with the best position for each [first column of Csb, second, 1], (7, 7), and how exact it is.

    None where the position that is not held is not told.
    """
    q = form.in_h(vector)
    free, known = without_position(vector, held)
    whole, worse = known, 1.0
    if free:
        values = np.linalg.eigvalsh(q[np.ix_(free, free)])
        if values[0] <= _FAINTEST * values[-1]:
            return None
        worse = values[-1] / values[0]
        whole = known.copy()
        whole[free] -= np.linalg.solve(q[np.ix_(free, free)], q[free] @ known)
    return whole.T @ q @ whole, float(_ROUNDING * worse * np.linalg.norm(q))


def _turned(vector: Array, held: Collection[str]) -> tuple[Array, Array, float] | None:
    """Give what turns what is sought into [first column, second, 1], (7, n); its equations; its square.

    With roll and pitch held Csb is Rz(yaw) M: what is sought is [cos yaw, sin yaw, 1].
    """
    fixed = _ANGLES & set(held)
    if not fixed:
        return np.eye(10)[[0, 1, 2, 3, 4, 5, 9]], _OF_ROTATIONS, 4.0
    known = np.zeros((7, 3))
    known[6, 2] = 1.0
    if fixed == _ANGLES:
        known[:6, 2] = rotation(vector[3:6])[:, :2].T.ravel()
        return known[:, 2:], np.zeros((0, 1, 1)), 1.0
    if fixed != {"roll", "pitch"}:
        return None
    for column in range(2):
        x, y, z = rotation(np.array([*vector[3:5], 0.0]))[:, column]
        known[3 * column : 3 * column + 3] = [[x, -y, 0.0], [y, x, 0.0], [0.0, 0.0, z]]
    return known, np.diag([1.0, 1.0, -1.0])[None], 2.0


def _dual(q: Array, equations: Array, square: float, wanted: float) -> float:
    """Give a γ that q is nowhere below: one above ``wanted``, or the largest that was found.

    ``equations`` (m, n, n) are 0 of all u that are sought, and uᵀu is ``square``.
    """
    size = len(q)
    one = np.zeros((1, size, size))
    one[0, -1, -1] = 1.0
    matrices = np.concatenate([equations, one])
    scale = float(np.abs(np.linalg.eigvalsh(q)).max()) or 1.0
    q, gain = q / scale, np.eye(len(matrices))[-1]
    # All u are on a sphere, so that some sum of the equations is 1 but for the last: there Z > 0 begins.
    rows = matrices.reshape(-1, size * size)
    at = np.linalg.lstsq(rows.T, -2.0 * np.eye(size).ravel(), rcond=None)[0]
    z = q - (at @ rows).reshape(size, size)
    best, weight = -np.inf, 1.0
    while weight > _LEAST_WEIGHT and best < wanted:
        for _ in range(_STEPS):
            try:
                inverse = np.linalg.inv(z)
                gradient = gain / weight - rows @ inverse.ravel()
                curved = rows @ (inverse @ matrices @ inverse).reshape(rows.shape).T
                step = np.linalg.solve(curved, gradient)
            except np.linalg.LinAlgError:  # no digits left
                return best
            far = float(np.sqrt(max(0.0, gradient @ step)))
            at = at + step / (1.0 + far if far > _NEAR else 1.0)  # stays where Z > 0
            z = q - (at @ rows).reshape(size, size)
            if far <= _NEAR:
                break
        least = float(np.linalg.eigvalsh(z)[0])
        best = max(best, scale * (float(at[-1]) + square * min(0.0, least)))
        if least <= 0.0:
            break
        weight *= _LESS
    return best


def _of_rotations() -> Array:
    """Give all equations of second degree (20, 10, 10) that [three columns of a rotation, 1] keeps."""
    number = np.arange(9).reshape(3, 3)  # of a column's entry
    found = []

    def equation(*products: tuple[int, int, float]) -> None:
        matrix = np.zeros((10, 10))
        for one, other, factor in products:
            matrix[one, other] += factor / 2
            matrix[other, one] += factor / 2
        found.append(matrix)

    for lines in (number, number.T):
        for i, j in combinations_with_replacement(range(3), 2):
            dot = [(int(one), int(other), 1.0) for one, other in zip(lines[i], lines[j], strict=True)]
            equation(*dot, (9, 9, -float(i == j)))
    found.pop()  # columns of length 1, and two rows: the third is, too
    for i in range(3):
        first, second, third = number[[i, i - 2, i - 1]]
        for axis in range(3):
            one, two = axis - 2, axis - 1
            cross = (first[one], second[two], 1.0), (first[two], second[one], -1.0)
            equation(*cross, (third[axis], 9, -1.0))
    return np.array(found)


_OF_ROTATIONS = _of_rotations()
