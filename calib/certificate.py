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
from dataclasses import dataclass
from itertools import combinations_with_replacement

import numpy as np

from polecal.calib.geometry import Array, rotation
from polecal.calib.observations import PARAMETERS
from polecal.calib.solve import CLEARLY, Form, cost_m

_NOTHING_M = 1e-4
_FAINTEST = 1e-9  # of its best told direction: where the position is told less, rounding says where it is
_ROUNDING = 1e-13  # of the largest number, for each of them that the sums went through
_LOWEST_M2 = 1e-5  # of a sensor's squared height over its ground: far above where `Form.cost` ends the law
_CLOSER = 0.1  # to the cost than is needed to prove it: the bound is shown
_LESS, _STEPS, _NEAR = 0.1, 30, 0.25
_LEAST_WEIGHT = 1e-13
_ANGLES = frozenset({"roll", "pitch", "yaw"})


@dataclass(frozen=True, slots=True)
class Certificate:
    """By how much of itself √c could at most be lower at another mount; weights, roughness and extras given.

    1 where no bound is known. ``proven`` says that it is no more than 0.5 %, or 0.1 mm: of minima that are as
    near to one another as that, each is.
    """

    lower_by: float
    proven: bool


_UNKNOWN = Certificate(1.0, False)


def certify(form: Form, vector: Array, held: Collection[str] = ()) -> Certificate:
    """Bound what ``form`` costs at any mount with the same ``held`` unknowns and extras as ``vector`` (12,).

    What rough ground adds is -σ² ln s of the sensor's height squared s. That is nowhere below its tangent
    at ``vector``, a form too, which is bounded in its place. How rough it is is given, too: as it looks at
    ``vector``. No bound is given where the data do not tell a position that is not held, and where of the
    angles others are held than none, roll and pitch, or all.
    """
    form = form.of_known_roughness(vector)
    turned = _turned(vector, held)
    reduced = None if turned is None else _without_position(form, vector, held)
    if turned is None or reduced is None:
        return _UNKNOWN
    q, rounding = reduced
    here, spread_m = form.spread(vector), cost_m(form, vector)
    height = form.height_in_h(vector)
    if height is not None:
        height_m2 = float(height[:6] @ rotation(vector[3:6])[:, :2].T.ravel()) ** 2
        if height_m2 < _LOWEST_M2:
            return _UNKNOWN
        bent_m2 = form.balance * form.rough_m2
        q[:6, :6] -= bent_m2 / height_m2 * np.outer(height[:6], height[:6])
        here -= bent_m2
    least_m = min(CLEARLY * spread_m, spread_m - _NOTHING_M)
    wanted = here - _CLOSER * (spread_m**2 - max(0.0, least_m) ** 2) + rounding
    known, equations, square = turned
    lowest = _dual(known.T @ q @ known, equations, square, wanted) - rounding
    bound_m = float(np.sqrt(max(0.0, spread_m**2 - max(0.0, here - lowest))))
    return Certificate(1.0 - bound_m / spread_m if spread_m else 0.0, bound_m >= least_m)


def _without_position(form: Form, vector: Array, held: Collection[str]) -> tuple[Array, float] | None:
    """Give c with the best position for each [first column of Csb, second, 1], (7, 7), and how exact it is.

    None where the position that is not held is not told.
    """
    q = form.in_h(vector)
    free = [6 + axis for axis in range(3) if PARAMETERS[axis] not in held]
    known = np.zeros((10, 7))
    known[:6, :6] = np.eye(6)
    known[6:, 6] = [0.0 if 6 + axis in free else vector[axis] for axis in range(3)] + [1.0]
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
    at = np.linalg.lstsq(matrices.reshape(-1, size * size).T, -2.0 * np.eye(size).ravel(), rcond=None)[0]
    z = q - np.tensordot(at, matrices, 1)
    best, weight = -np.inf, 1.0
    while weight > _LEAST_WEIGHT and best < wanted:
        for _ in range(_STEPS):
            pulled = np.linalg.solve(z, matrices)
            gradient = gain / weight - np.trace(pulled, axis1=1, axis2=2)
            curved = np.einsum("iab,jba->ij", pulled, pulled)
            step = np.linalg.solve(curved, gradient)
            far = float(np.sqrt(max(0.0, gradient @ step)))
            at = at + step / (1.0 + far if far > _NEAR else 1.0)  # stays where Z > 0
            z = q - np.tensordot(at, matrices, 1)
            if far <= _NEAR:
                break
        least = float(np.linalg.eigvalsh(z)[0])
        best = max(best, scale * (float(at[-1]) + square * min(0.0, least)))
        if least <= 0.0:
            break  # no digits left
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
