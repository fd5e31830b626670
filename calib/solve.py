"""Moments to the mount that minimises Eq. 7.

All of Eq. 7 is quadratic in h⁺ (`moments`), so that a solution costs the same for a hundred returns and for
a million. Beside the six of the mount it can be solved for what else shifts the cloud: a time offset between
laser and navigation, a range offset of the reflector, a pole that leans, ground that slopes. And what rough
ground adds to Eq. 6, the more the beams graze it, can be taken off.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import NDArray

from polecal.calib.geometry import (
    ICOSAHEDRAL,
    Array,
    roll_pitch_yaw,
    rotation,
    rotation_gradient,
    skew,
    turning,
)
from polecal.calib.moments import BASE, RANGE, TIME, TIME_SQUARED, WIDTH, Moments, alike, unpacked, upper
from polecal.calib.observations import PARAMETERS

EXTRAS = ("time_s", "range_m", "lean_north", "lean_east", "slope_north", "slope_east")
"""What else can be solved for: offsets, and metres per metre of height (pole) or way (ground)."""
UNKNOWNS = (*PARAMETERS, *EXTRAS)
"""The order of every vector (12,) here: m, rad, s, m and pure numbers."""

CLEARLY = 0.995
"""Of √c: what is not lower than that is as low. On flat ground the mirror image is, but for the noise."""

FLATTEST, ROUGHEST = 1e-6, 4.0
"""Of the variance that the ground was taken for: between them `roughness` is a logarithm."""

_STEPS = 100
_EASED, _DAMPED, _GIVE_UP = 0.1, 10.0, 1e9
_NOTHING = 1e-13
_STEP = 1e-5
_DESCENTS = 40
_AGAINST = -skew(np.eye(3))  # -[e]×
_SETTLED, _SETTLED_TURNS = (
    1e-6,
    3,
)  # of c; where at its pace no descent gets that much below the lowest any more
_LEAST_HEIGHT_M = 1e-3  # of a sensor above its ground
_AT_ONCE = 16  # passes whose sums are looked at as matrices: of hundreds they would be most of the memory
_LEAST_M2 = 1e-6  # of a return's own variance: no laser is as good as 1 mm


_RAY = np.zeros(WIDTH, dtype=bool)  # what a range scales in h⁺: a beam's way from the sensor to its return
_RAY[[*range(0, 6), *range(RANGE.start, RANGE.stop)]] = True
_RAY[[*range(TIME.start, TIME.start + 6), *range(TIME_SQUARED.start, TIME_SQUARED.start + 6)]] = True


class Scatter:
    """The spread of one kind of returns: within each pass, and of the passes' means about their site's.

    Takes each pass's moments. ``shift_m`` is a range offset that is known; ``ranged`` says whether these
    returns take part in one that is not. ``across_m`` is how far to the side of their mark they are, σ.
    ``sites`` has a number a pass: of another day, where the pole and the ground are not where they were;
    else all are of one.
    """

    def __init__(
        self,
        passes: Sequence[Moments],
        *,
        shift_m: float = 0.0,
        ranged: bool = False,
        across_m: float = 0.0,
        sites: Sequence[int] | None = None,
    ) -> None:
        self.count = np.array([one.count for one in passes], dtype=np.float64)
        self.sites = np.zeros(len(passes), dtype=np.int64) if sites is None else np.array(sites)
        self._passes = alike(passes)
        features = self._passes[0].features
        along = np.flatnonzero(_of_range(features))
        moved = np.searchsorted(features, features[along] - RANGE.start)
        self._along, self._moved, self._shift_m = along, moved, shift_m
        self._aside = _aside(self._passes, along, moved, across_m) if across_m and ranged else None
        self._kept = np.arange(len(features)) if ranged else np.delete(np.arange(len(features)), along)
        self._features = features[self._kept]
        self._summed: tuple[bytes, Array] | None = None
        first = np.stack([one.first for one in self._passes])
        self._mean = self._shifted(first / np.maximum(1.0, self.count)[:, None])[:, self._kept]

    def _shifted(self, sums: Array) -> Array:
        """Give what sums (…, K) of all features are where every range is longer by what is known of it."""
        if self._shift_m:
            sums[..., self._moved] += self._shift_m * sums[..., self._along]
        return sums

    def _as_summed(self, kept: Array) -> Array:
        """Give rows (K, …) for features as they were summed up that do what ``kept`` do for those here."""
        rows = np.zeros((len(self._passes[0].features), *kept.shape[1:]))
        rows[self._kept] = kept
        if self._shift_m:
            rows[self._along] += self._shift_m * rows[self._moved]
        return rows

    def _within(self, used: NDArray[np.bool_]) -> Array:
        """Give Σ over used passes of what their features spread within each, (K, K)."""
        if self._summed is None or self._summed[0] != used.tobytes():
            numbers, width = np.flatnonzero(used), len(self._passes[0].features)
            second, first = np.zeros(width * (width + 1) // 2), np.zeros((len(numbers), width))
            for row, number in zip(first, numbers.tolist(), strict=True):
                second += self._passes[number].packed
                row[:] = self._passes[number].first
            mean = first / np.maximum(1.0, self.count[used])[:, None]
            within = second[unpacked(width)] - first.T @ mean
            within = self._shifted(self._shifted(within).T)
            self._summed = used.tobytes(), within[np.ix_(self._kept, self._kept)]
        return self._summed[1]

    def form(self, used: NDArray[np.bool_], ratio: float = np.inf) -> Array:
        """Give the covariance (108, 108) of the used passes' features, m².

        ``ratio`` is the variance within a pass over that of the error which all its returns share: a pass
        of n returns says no more of where its mean should be than n / (1 + n / ratio) independent ones.
        Infinite: no error is shared, and the variances are those of Eqs. 5 and 6 to the letter. Else what is
        seen within a pass counts for more, and there the returns to the side of a thick pole do harm
        (`_aside`), which is taken off.
        """
        total = max(1.0, self.count[used].sum())
        weight = self.weight(ratio)[used]
        apart = self._mean[used]
        for site in _each(self.sites[used]):
            apart[site] -= weight[site] / (weight[site].sum() or 1.0) @ apart[site]
        summed = self._within(used) + (weight[:, None] * apart).T @ apart
        if self._aside is not None and np.isfinite(ratio):
            aside = self._aside[used].sum(axis=0)
            summed[np.ix_(self._moved, self._along)] -= aside
            summed[np.ix_(self._along, self._moved)] -= aside
        return self._whole(summed / total)

    def within_form(self, used: NDArray[np.bool_]) -> Array:
        """Give the part (108, 108) of `form` that is within the used passes, m²."""
        return self._whole(self._within(used) / max(1.0, self.count[used].sum()))

    def _whole(self, matrix: Array) -> Array:
        """Give a matrix (K, K) of the features that there are as one of all, (108, 108)."""
        whole = np.zeros((3 * WIDTH, 3 * WIDTH))
        whole[self._features[:, None], self._features] = matrix
        return whole

    def ray(self, used: NDArray[np.bool_]) -> Array:
        """Give the mean (108,) of the used passes' features, all but those of the beams' way left out."""
        ray = np.zeros(3 * WIDTH)
        mean: Array = self.count[used] @ self._mean[used] / max(1.0, self.count[used].sum())
        ray[self._features] = mean * np.tile(_RAY, 3)[self._features]
        return ray

    def weight(self, ratio: float = np.inf) -> Array:
        """Give what each pass's mean weighs, (P,), in returns: see `form`."""
        weight: Array = self.count / (1.0 + self.count / ratio)
        return weight

    def along(self, basis: Array, ratio: float) -> Along:
        """Give these sums along rows (A, 108, M) of A axes: all that is to be known of their mixtures."""
        there = np.ascontiguousarray(basis[:, self._features].swapaxes(0, 1))  # (K, A, M)
        mean = np.tensordot(self._mean, there, 1)
        within = self._each_along(self._as_summed(there))
        within -= (self.count[:, None, None] * mean.swapaxes(1, 2)) @ mean
        taken = within
        if self._aside is not None and np.isfinite(ratio):
            aside = _squares(self._aside, there[self._along], there[self._moved])
            taken = within - aside - aside.swapaxes(1, 2)
        return Along(
            self.count,
            self.weight(ratio),
            self.sites,
            mean,
            within,
            taken,
            (self._mean * np.tile(_RAY, 3)[self._features]) @ there[:, 0],
        )

    def _each_along(self, rows: Array) -> Array:
        """Give Σ over axes of rowsᵀ Σ f fᵀ rows of each pass, (P, M, M), of (K, A, M); few at a time."""
        width, squares = len(rows), []
        second = np.empty((min(_AT_ONCE, len(self._passes)), width, width))
        for start in range(0, len(self._passes), _AT_ONCE):
            some = self._passes[start : start + _AT_ONCE]
            for one, of in zip(some, second, strict=False):
                np.take(one.packed, unpacked(width), out=of, mode="clip")  # several times as fast as "raise"
            squares.append(_squares(second[: len(some)], rows, rows))
        return np.concatenate(squares)

    def means(self, rows: Array) -> Array:
        """Give each pass's mean (P, k) in the given rows (k, 108): `_rows` of a vector."""
        means: Array = self._mean @ rows[:, self._features].T
        return means

    def yaw_rad(self) -> Array:
        """Give each pass's platform yaw (P,), rad, in the mean over its returns."""
        first_of_c = np.zeros((2, 3 * WIDTH))
        first_of_c[[0, 1], [6, WIDTH + 6]] = 1.0
        forward = self.means(first_of_c)
        yaw: Array = np.arctan2(forward[:, 1], forward[:, 0])
        return yaw

    def within(self, rows: Array) -> Array:
        """Give each pass's variance within, (P,), m², the mean over the given rows (k, 108)."""
        there = self._as_summed(rows[:, self._features].T)
        square = (2.0 * (there @ there.T)).ravel()
        square[:: len(there) + 1] /= 2.0
        packed = square[upper(len(there))]
        summed = np.array([one.packed @ packed for one in self._passes])
        summed -= self.count * (self.means(rows) ** 2).sum(axis=1)
        within: Array = np.maximum(0.0, summed) / np.maximum(1.0, self.count) / len(rows)
        return within

    def mean_within(self, rows: Array, used: NDArray[np.bool_]) -> float:
        """Give `within` of the used passes together, each counted by its returns, m²."""
        there = rows[:, self._features]
        summed = float((there @ self._within(used) * there).sum())
        return max(0.0, summed) / max(1.0, float(self.count[used].sum())) / len(rows)

    def ratio(self, rows: Array, used: NDArray[np.bool_]) -> float:
        """Estimate `form`'s ratio from the used passes themselves."""
        there = used & (self.count > 0)
        count, means = self.count[there], self.means(rows)[there]
        sites = _each(self.sites[there])
        free = len(count) - len(sites)
        if free < 1:
            return np.inf
        within = self.mean_within(rows, used)
        spread = np.zeros(len(rows))
        for site in sites:
            if (more := int(site.sum()) - 1) > 0:
                spread += means[site].var(axis=0, ddof=1) * (more / free)
        apart = float(spread.mean()) - within * float((1 / count).mean())
        return within / apart if apart > 0 else np.inf

    def off(self, rows: Array, used: NDArray[np.int64]) -> Array:
        """Give how far passes' means (U, k), in the rows (k, 108), are from their site's median."""
        off = self.means(rows)[used]
        for site in _each(self.sites[used]):
            off[site] -= np.median(off[site], axis=0)
        return off


@dataclass(frozen=True, slots=True)
class Along:
    """A `Scatter` of P passes along M rows of each of A axes; a mixture of the rows is the same one of these.

    ``count``, ``weight`` and ``sites`` are (P,), `Scatter`'s; ``mean`` is (P, A, M), ``within`` (P, M, M) the
    sum about it over all axes, ``taken`` what `Scatter.form` takes of that, and ``ray`` (P, M) that of
    `Scatter.ray`, along the first axis.
    """

    count: Array
    weight: Array
    sites: NDArray[np.int64]
    mean: Array
    within: Array
    taken: Array
    ray: Array

    def joined(self, more: Along) -> Along:
        """Give these passes and more."""
        return _joined([self, more])

    def paper(self) -> Along:
        """Give these passes as they count in Eq. 7."""
        return replace(self, weight=self.count, taken=self.within)

    def merged(self) -> Along:
        """Give those of each site as one: they are the same in a form of all, and no more is known of any.

        By how much their means are apart, as they weigh, is in what the form takes.
        """
        merged = []
        for of in _each(self.sites):
            count, weight, mean = self.count[of], self.weight[of], self.mean[of]
            middle = np.tensordot(weight, mean, 1) / (weight.sum() or 1.0)
            apart = np.sqrt(weight)[:, None, None] * (mean - middle)
            taken = self.taken[of].sum(axis=0) + np.tensordot(apart, apart, ([0, 1], [0, 1]))
            ray = count @ self.ray[of] / (count.sum() or 1.0)
            sums = (
                count.sum(),
                weight.sum(),
                self.sites[of][0],
                middle,
                self.within[of].sum(axis=0),
                taken,
                ray,
            )
            merged.append(Along(*(np.array([one]) for one in sums)))
        return _joined(merged)


def _joined(parts: Sequence[Along]) -> Along:
    return Along(*(np.concatenate([getattr(of, part.name) for of in parts]) for part in fields(Along)))


def _squares(matrices: Array, rows: Array, others: Array) -> Array:
    """Give Σ over axes of othersᵀ M rows, (P, M, M), of (P, K, K) and (K, A, M) twice."""
    passes, width = len(matrices), len(rows)
    flat = rows.reshape(width, rows.shape[1] * rows.shape[2])
    pulled = (matrices.reshape(passes * width, width) @ flat).reshape(passes, *rows.shape)
    squares: Array = np.sum([others[:, axis].T @ pulled[:, :, axis] for axis in range(rows.shape[1])], axis=0)
    return squares


def _each(sites: NDArray[np.int64]) -> list[NDArray[np.bool_]]:
    """Give, site by site, which are of it."""
    return [sites == site for site in np.unique(sites)]


def _of_range(features: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Say which features (K,) a range offset scales."""
    of: NDArray[np.bool_] = (features % WIDTH >= RANGE.start) & (features % WIDTH < RANGE.stop)
    return of


def _aside(
    passes: Sequence[Moments], along: NDArray[np.int64], moved: NDArray[np.int64], across_m: float
) -> Array | None:
    """Give what returns ``across_m`` to the side of their mark, σ, add to P passes' Σ f fᵀ, (P, 18, 18).

    It is added between the features ``along`` the beam and those which they move, both ways. A return m to
    the side is at a bearing m / r off. A range offset b moves it along its own beam, not its mark's, and so
    makes the spread (1 + b / r)² as wide: too short ranges look good. That it does is no news of b. 1 / r on
    average is told by the means of r and r², as if ln r were normal. All of that takes all three axes; None
    where there are fewer.
    """
    if len(along) != 3 * 6:
        return None
    where = unpacked(len(passes[0].features))
    wanted = np.concatenate([where[np.ix_(along, along)].ravel(), where[moved, along], where[moved, moved]])
    picked = np.stack([one.packed[wanted] for one in passes])
    # The axis of n, [x or y], the axis of b: of [cos θ C | sin θ C] to [-sin θ C | cos θ C], but for signs.
    across = picked[:, : 18 * 18].reshape(-1, 3, 2, 3, 3, 2, 3)[:, :, ::-1, :, :, ::-1].copy()
    across[:, :, 0, :, :, 1] *= -1.0
    across[:, :, 1, :, :, 0] *= -1.0
    # Each of the three axes of C is of length 1.
    returns = np.maximum(1.0, np.array([one.count for one in passes]))
    r_m, r_m2 = (picked[:, -36:-18].sum(axis=1) / returns / 3, picked[:, -18:].sum(axis=1) / returns / 3)
    per_m = np.divide(r_m2, r_m**3, out=np.zeros_like(r_m), where=r_m > 0)
    added: Array = across_m**2 * per_m[:, None, None] * across.reshape(-1, 18, 18)
    return added


@dataclass(frozen=True, slots=True)
class Weights:
    """What returns count, fixed before a solution: as in Eq. 7 to the letter, or as they tell themselves."""

    pole_ratio: float = np.inf
    ground_ratio: float = np.inf
    """`Scatter.form`'s."""
    ground_return: float | None = None
    """What the square of a ground return counts against a pole return's; None: Eq. 7, mean against mean."""
    rough_m2: float = 0.0
    """`Form.rough_m2`."""

    @classmethod
    def told(
        cls,
        pole: Scatter,
        ground: Scatter,
        used: NDArray[np.bool_],
        about: Array,
        *,
        pass_error: bool,
        rough: bool,
        by_kind: bool,
    ) -> Weights:
        """Estimate them from the used passes at a vector (12,) about the minimum.

        By ``pass_error`` passes count by how their means scatter, ``by_kind`` kinds by how their returns
        scatter within the passes: there are many more returns of the ground, and were they independent, each
        would be as good as one of a pole, or better, whose own width scatters it. `balance.balance` says
        what of that is so. ``rough`` ground is what scatters within the passes.
        """
        north_east, down = pole_rows(about), ground_rows(about)
        ground_m2 = ground.mean_within(down, used)
        ratios = (pole.ratio(north_east, used), ground.ratio(down, used)) if pass_error else (np.inf, np.inf)
        pole_m2 = pole.mean_within(north_east, used)
        return cls(
            *ratios,
            max(pole_m2, _LEAST_M2) / max(ground_m2, _LEAST_M2) if by_kind else None,
            ground_m2 if rough and ground_m2 > _LEAST_M2 else 0.0,
        )

    def balance(self, pole_returns: float, ground_returns: float) -> float:
        """Give `Form.balance` of so many returns."""
        if self.ground_return is None or not pole_returns or not ground_returns:
            return 1.0
        return self.ground_return * ground_returns / pole_returns


PAPER = Weights()
"""Eq. 7 to the letter."""


@dataclass(frozen=True, slots=True)
class Form:
    """Eq. 7 as a function of the unknowns: the covariances of both kinds' features, (108, 108) each."""

    pole: Array
    ground: Array
    rough_m2: float = 0.0
    """Variance of the ground's own heights and of the ranges to it, down; 0 is Eq. 7 to the letter.

    A beam meets a bump the nearer, the more it grazes: an error e of height shifts the return along the beam,
    by e / d for a beam that goes down by d a metre. What Eq. 6 takes for its derivative holds e twice, and so
    is wrong by σ² ∂ ln d on average, that is, rough ground looks flattest to a mount that sees it less
    steeply than the true one. In words of likelihood: the density of what is measured, the range, is that of
    the height times d, and Eq. 6 leaves out the factor. As d is the sensor's height over the ground by the
    range, the missing term is -2 σ² ln of that height but for what no mount changes. And σ² itself is only
    told by the same returns: with ``bumps``, Eq. 6 / σ² within the passes becomes its `roughness`. Taken as
    known, what a first solution took the roughness for would hold the beams to the slant of that solution:
    to that of Eq. 6, by a degree or more where the ground has waves.
    """
    ray: Array | None = None
    """(108,) `Scatter.ray` of the ground, where it is rough."""
    bumps: Array | None = None
    """(108, 108) `Scatter.within_form`, a part of ``ground``, where how rough it is is not taken as known."""
    balance: float = 1.0
    """What the variance of the ground counts against that of the pole; 1 is Eq. 7 to the letter."""

    @classmethod
    def of(cls, pole: Scatter, ground: Scatter, used: NDArray[np.bool_], weights: Weights = PAPER) -> Form:
        """Take the used passes, weighed."""
        return cls(
            pole.form(used, weights.pole_ratio),
            ground.form(used, weights.ground_ratio),
            weights.rough_m2,
            ground.ray(used) if weights.rough_m2 else None,
            ground.within_form(used) if weights.rough_m2 else None,
            weights.balance(pole.count[used].sum(), ground.count[used].sum()),
        )

    def spread(self, vector: Array) -> float:
        """Give the quadratic part of c in m² at ``vector`` (12,), the variances of Eq. 7 in balance."""
        h = _h(vector)
        return self._spread(_rows(_pole_weights(vector)[0], h), _rows(_ground_weights(vector)[0], h))

    def _spread(self, pole: Array, ground: Array) -> float:
        return float((pole @ self.pole * pole).sum() + self.balance * (ground @ self.ground * ground).sum())

    def cost(self, vector: Array) -> float:
        """Give what is minimised, c in m² at ``vector`` (12,); on rough ground it may be negative."""
        h = _h(vector)
        pole, ground = _rows(_pole_weights(vector)[0], h), _rows(_ground_weights(vector)[0], h)
        spread, down = self._spread(pole, ground), ground[0]
        if self.ray is None:
            return spread
        grazed = -2.0 * np.log(max(float(abs(down @ self.ray)), _LEAST_HEIGHT_M))
        if self.bumps is None:
            return spread + self.balance * self.rough_m2 * float(grazed)
        bumps_m2 = float(down @ self.bumps @ down)
        rough, _ = roughness(np.array(bumps_m2 / self.rough_m2))
        return spread + self.balance * float(self.rough_m2 * (float(rough) + 1.0 + grazed) - bumps_m2)

    def slope(self, vector: Array) -> tuple[Array, Array]:
        """Give half the gradient (12,) of c, and what comes near half its Hessian (12, 12) about a minimum.

        That is Gauss's and Newton's; only on rough ground it need not be positive definite.
        """
        pole, (gradient, hessian), steeper = self._half_slopes(vector, bumps=True)
        if steeper is not None:
            gradient = gradient - self.rough_m2 * steeper
        if steeper is not None and self.bumps is not None:
            hessian = hessian - self.rough_m2 * np.outer(steeper, steeper)
        return pole[0] + self.balance * gradient, pole[1] + self.balance * hessian

    def information(self, vector: Array) -> Array:
        """Give half the Hessian (12, 12) that c has on average where ``vector`` is true.

        How steeply the beams meet rough ground is not told by how rough it looks.
        """
        pole, (_, told), steeper = self._half_slopes(vector, bumps=False)
        if steeper is not None and self.bumps is not None:
            down = ground_rows(vector)[0]
            told = told - min(self.rough_m2, float(down @ self.bumps @ down)) * np.outer(steeper, steeper)
        return pole[1] + self.balance * told

    def in_h(self, vector: Array) -> Array:
        """Give the form (10, 10) of h that `spread` is at the extras of ``vector`` (12,)."""
        base, q = _h_base(vector), np.zeros((10, 10))
        rows = [(self.pole, 1.0, weight) for weight in _pole_weights(vector)[0]]
        rows += [(self.ground, self.balance, weight) for weight in _ground_weights(vector)[0]]
        for matrix, counts, weight in rows:
            part = np.kron(weight[:, None], base)
            q += counts * (part.T @ matrix @ part)
        return q

    def height_in_h(self, vector: Array) -> Array | None:
        """Give what of h (10,) is the sensor's height over rough ground at the extras of ``vector`` (12,)."""
        if self.ray is None:
            return None
        height: Array = self.ray @ np.kron(_ground_weights(vector)[0].T, _h_base(vector))
        return height

    def bend(self, vector: Array) -> Array:
        """Give what half the Hessian (12, 12) has beyond `slope`'s: of how the rows themselves bend."""
        h = _h(vector)
        dh = _h_gradient(vector, h)
        bending = range(3, 8)  # h⁺ is bent by the angles and by what scales it
        bent = np.zeros((WIDTH, len(UNKNOWNS), len(UNKNOWNS)))
        for index in bending:
            step = _STEP * (np.arange(len(UNKNOWNS)) == index)
            ends = [_h_gradient(end, _h(end)) for end in (vector + step, vector - step)]
            bent[:, :, index] = (ends[0] - ends[1]) / (2 * _STEP)
        bent[:, bending, :3] = bent[:, :3, bending].swapaxes(1, 2)
        down = ground_rows(vector)[0]
        pull = self.ground @ down
        if self.ray is not None:
            pull = pull - self.rough_m2 * self.ray / (self.ray @ down)
        if self.bumps is not None:
            bumps = self.bumps @ down
            pull = pull + (float(roughness(down @ bumps / self.rough_m2)[1]) - 1.0) * bumps
        pulls = [self.pole @ row for row in pole_rows(vector)] + [self.balance * pull]
        every = (
            np.concatenate(of) for of in zip(_pole_weights(vector), _ground_weights(vector), strict=True)
        )
        added = np.zeros((len(UNKNOWNS), len(UNKNOWNS)))
        for of_axis, weight, dweight in zip(pulls, *every, strict=True):
            of = of_axis.reshape(3, WIDTH)
            both = dweight.T @ of @ dh
            added += np.tensordot(weight @ of, bent, 1) + both + both.T
        return added

    def _half_slopes(
        self, vector: Array, *, bumps: bool
    ) -> tuple[tuple[Array, Array], tuple[Array, Array], Array | None]:
        """Give `_half_slope` of both kinds, and on rough ground the derivative (12,) of ln of its height.

        With what its roughness adds to the ground's if ``bumps``.
        """
        h = _h(vector)
        dh = _h_gradient(vector, h)
        weights, dweights = _ground_weights(vector)
        down, ground, steeper = _rows(weights, h)[0], self.ground, None
        if self.ray is not None:
            steeper = self.ray @ _jacobians(weights, dweights, h, dh)[0] / (down @ self.ray)
        if bumps and self.bumps is not None:
            less = float(roughness(down @ self.bumps @ down / self.rough_m2)[1]) - 1.0
            ground = ground + less * self.bumps
        pole = _half_slope(self.pole, *_pole_weights(vector), h, dh)
        return pole, _half_slope(ground, weights, dweights, h, dh), steeper


def roughness(rough: Array) -> tuple[Array, Array]:
    """Give ln of how much rougher ground looks than it was taken for, and its derivative, each shaped alike.

    From four times as rough on the logarithm goes on straight: else it would hardly mind a mount that tilts
    all of the ground.
    """
    near = np.clip(rough, FLATTEST, ROUGHEST)
    return np.log(near) + np.maximum(rough - ROUGHEST, 0.0) / ROUGHEST, 1.0 / near


def _jacobians(weights: Array, dweights: Array, h: Array, dh: Array) -> Array:
    """Give the derivatives (k, 108, 12) of k axes' rows, so weighted."""
    slopes = weights[:, :, None, None] * dh + dweights[:, :, None] * h[:, None]
    jacobians: Array = slopes.reshape(len(weights), 3 * WIDTH, -1)
    return jacobians


def _half_slope(matrix: Array, weights: Array, dweights: Array, h: Array, dh: Array) -> tuple[Array, Array]:
    """Give half the gradient (12,) and half the Gauss-Newton Hessian (12, 12) of one kind's variances."""
    jacobians = _jacobians(weights, dweights, h, dh)
    pulled = (matrix @ jacobians).reshape(-1, len(UNKNOWNS))
    return _rows(weights, h).ravel() @ pulled, jacobians.reshape(-1, len(UNKNOWNS)).T @ pulled


def cost_m(form: Form, vector: Array) -> float:
    """Give √ of what a form spreads, in m at ``vector`` (12,): of one without weights √c of Eq. 7."""
    return float(np.sqrt(max(0.0, form.spread(vector))))


def pole_rows(vector: Array) -> Array:
    """Give what turns features into north and east of the pole, its lean taken off: (2, 108)."""
    return _rows(_pole_weights(vector)[0], _h(vector))


def ground_rows(vector: Array) -> Array:
    """Give what turns features into down of the ground, its slope taken off: (1, 108)."""
    return _rows(_ground_weights(vector)[0], _h(vector))


def pole_basis(vector: Array) -> Array:
    """Give `pole_rows`, and their derivatives by the unknowns: (2, 108, 1 + 12)."""
    return _basis(*_pole_weights(vector), vector)


def ground_basis(vector: Array) -> Array:
    """Give `ground_rows`, and their derivatives by the unknowns: (1, 108, 1 + 12)."""
    return _basis(*_ground_weights(vector), vector)


def _basis(weights: Array, dweights: Array, vector: Array) -> Array:
    h = _h(vector)
    dh = _h_gradient(vector, h)
    return np.concatenate([_rows(weights, h)[:, :, None], _jacobians(weights, dweights, h, dh)], axis=2)


def _rows(weights: Array, h: Array) -> Array:
    """Give what turns features into so weighted axes of n: (k, 108) of (k, 3) and (36,)."""
    return (weights[:, :, None] * h).reshape(-1, 3 * WIDTH)


def minimise(form: Form, start: Array, held: Collection[str] = ()) -> Array:
    """Give the (12,) vector that minimises c from ``start``, the ``held`` ones of `UNKNOWNS` kept.

    Levenberg-Marquardt on the numbers themselves; ends where no step lowers the cost any more.
    """
    free = np.array([name not in held for name in UNKNOWNS])
    vector = start.astype(np.float64)
    if not free.any():
        return vector
    cost, damping = form.cost(vector), 1e-6
    for _ in range(_STEPS):
        gradient, hessian = form.slope(vector)
        gradient, hessian = gradient[free], hessian[np.ix_(free, free)]
        if form.bumps is not None:
            hessian = _upward(hessian)
        while damping < _GIVE_UP:
            step = np.zeros(len(UNKNOWNS))
            step[free] = -np.linalg.lstsq(_damped(hessian, damping), gradient, rcond=1e-15)[0]
            if -gradient @ step[free] <= _NOTHING * abs(cost):  # what the step promises
                return vector
            lower = form.cost(vector + step)
            if lower < cost:
                break
            damping *= _DAMPED
        else:
            return vector
        vector = vector + step
        cost, damping = lower, max(damping * _EASED, 1e-12)
    return vector


def minimise_globally(form: Form, start: Array, held: Collection[str] = ()) -> Array:
    """Give the lowest minimum there is, as far as sixty rotations spread evenly from ``start`` lead to it.

    The cost has false minima (paper.md, later work 6). Only rotations need be tried: for each the best
    position follows at once, as the cost is a parabola in r_b. What is held is never turned. Of minima
    that are equal, or nearly so, the one next to ``start`` is taken.
    """
    near = minimise(form, start, held)
    if set(held) & {"roll", "pitch", "yaw"}:
        return near
    lowest = minimise(form, _lowest_rotation(form, start, held), held)
    if cost_m(form, lowest) > CLEARLY * cost_m(form, near):
        return near
    lowest[3:6] = roll_pitch_yaw(rotation(lowest[3:6]))  # one of the two triples that mean the same rotation
    return lowest


def without_position(vector: Array, held: Collection[str]) -> tuple[list[int], Array]:
    """Give which of h (10,) are of a position that is sought, and the rest of h of [two columns, 1], (10, 7).

    What is held of it is as in ``vector`` (12,).
    """
    free = [6 + axis for axis in range(3) if UNKNOWNS[axis] not in held]
    known = np.zeros((10, 7))
    known[:6, :6] = np.eye(6)
    known[6:, 6] = [0.0 if 6 + axis in free else vector[axis] for axis in range(3)] + [1.0]
    return free, known


def _lowest_rotation(form: Form, start: Array, held: Collection[str]) -> Array:
    """Descend from many rotations at once, the extras as in ``start``; give the lowest end, (12,).

    With the position eliminated c is a form in u = [first column of Csb, second, 1] alone, (7, 7): Newton's
    way on SO(3), damped, R exp([δ]×), for all rotations in one array.
    """
    q = form.in_h(start)
    free, known = without_position(start, held)
    to_position = -np.linalg.pinv(q[np.ix_(free, free)], rcond=1e-9, hermitian=True) @ q[free] @ known
    whole = known.copy()
    whole[free] += to_position
    q7 = whole.T @ q @ whole
    turns = rotation(start[3:6]) @ ICOSAHEDRAL
    cost, damping, settled = _cost7(q7, turns), np.full(len(turns), 1e-3), 0
    for left in reversed(range(_DESCENTS)):
        u = _u(turns)
        jacobian = np.zeros((len(turns), 7, 3))  # of R exp([δ]×): d(R e) = -R [e]× δ
        jacobian[:, :3], jacobian[:, 3:6] = turns @ _AGAINST[0], turns @ _AGAINST[1]
        pulled = q7 @ jacobian
        gradient = np.einsum("bik,bi->bk", pulled, u)
        hessian = np.einsum("bik,bil->bkl", jacobian, pulled)
        scale = np.trace(hessian, axis1=1, axis2=2) + 1e-300
        step = -np.linalg.solve(hessian + (damping * scale)[:, None, None] * np.eye(3), gradient[:, :, None])
        turned = turns @ turning(step[:, :, 0])
        lower = _cost7(q7, turned)
        better = lower < cost
        before, cost = cost, np.minimum(cost, lower)
        pace, lead = (
            np.log(np.maximum(of, _NOTHING) / np.maximum(least, _NOTHING))
            for of, least in ((before, cost), (cost, cost.min()))
        )
        settled = 0 if (left * pace > lead + _SETTLED).any() else settled + 1
        turns[better] = turned[better]
        if settled == _SETTLED_TURNS:
            break
        damping = np.clip(np.where(better, damping * _EASED, damping * _DAMPED), 1e-12, _GIVE_UP)
    best = turns[int(np.argmin(cost))]
    vector = start.copy()
    vector[3:6] = roll_pitch_yaw(best)
    vector[[index - 6 for index in free]] = to_position @ _u(best[None])[0]
    return vector


def _u(turns: Array) -> Array:
    """Give [first column, second column, 1] of rotations (B, 3, 3): (B, 7)."""
    columns = turns[:, :, :2].transpose(0, 2, 1).reshape(len(turns), 6)
    return np.concatenate([columns, np.ones((len(turns), 1))], axis=1)


def _cost7(q7: Array, turns: Array) -> Array:
    u = _u(turns)
    costs: Array = ((u @ q7) * u).sum(axis=1)
    return costs


def _h(vector: Array) -> Array:
    """Give h⁺ (36,)."""
    values = vector.tolist()  # of so few numbers lists take a third of arrays' time
    time_s, range_m = values[6:8]
    rows = rotation(vector[3:6]).tolist()
    columns = [row[column] for column in range(2) for row in rows]
    base = [*columns, *values[:3], 1.0]
    scaled = [scale * each for scale in (time_s, time_s**2) for each in base]
    return np.array([*base, *(range_m * each for each in columns), *scaled])


def _h_base(vector: Array) -> Array:
    """Give what turns h into h⁺ at the extras of ``vector`` (12,): (36, 10)."""
    base = np.zeros((WIDTH, 10))
    base[BASE] = np.eye(10)
    base[RANGE, :6] = vector[7] * np.eye(6)
    base[TIME], base[TIME_SQUARED] = vector[6] * np.eye(10), vector[6] ** 2 * np.eye(10)
    return base


def _h_gradient(vector: Array, h: Array) -> Array:
    """Give the derivative of h⁺ by the unknowns, (36, 12)."""
    time_s, range_m = vector[6:8]
    gradient = np.zeros((WIDTH, len(UNKNOWNS)))
    turned = rotation_gradient(vector[3:6])[:, :, :2].transpose(0, 2, 1).reshape(3, 6).T
    gradient[6:9, :3] = np.eye(3)
    gradient[:6, 3:6] = turned
    gradient[RANGE, 3:6] = range_m * turned
    gradient[TIME, :6] = time_s * gradient[BASE, :6]
    gradient[TIME_SQUARED, :6] = time_s**2 * gradient[BASE, :6]
    gradient[TIME, 6] = h[BASE]
    gradient[TIME_SQUARED, 6] = 2 * time_s * h[BASE]
    gradient[RANGE, 7] = h[:6]
    return gradient


def _pole_weights(vector: Array) -> tuple[Array, Array]:
    """Give the weights of n's axes in north and east of the pole (2, 3), and their derivative (2, 3, 12)."""
    return np.array([[1.0, 0.0, vector[8]], [0.0, 1.0, vector[9]]]), _POLE_SLOPES


def _ground_weights(vector: Array) -> tuple[Array, Array]:
    """Give the weights of n's axes in down of the ground (1, 3), and their derivative (1, 3, 12)."""
    return np.array([[vector[10], vector[11], 1.0]]), _GROUND_SLOPES


_POLE_SLOPES, _GROUND_SLOPES = np.zeros((2, 3, len(UNKNOWNS))), np.zeros((1, 3, len(UNKNOWNS)))
_POLE_SLOPES[[0, 1], 2, [8, 9]] = 1.0
_GROUND_SLOPES[0, [0, 1], [10, 11]] = 1.0


def _upward(hessian: Array) -> Array:
    """Give a Hessian as curved, but upward everywhere: each unknown in its own scale."""
    scale = np.sqrt(np.abs(np.diag(hessian))) + 1e-150
    values, vectors = np.linalg.eigh(hessian / np.outer(scale, scale))
    upward: Array = (vectors * np.abs(values)) @ vectors.T * np.outer(scale, scale)
    return upward


def _damped(hessian: Array, damping: float) -> Array:
    diagonal = np.diag(hessian)
    damped: Array = hessian + damping * np.diag(diagonal + 1e-12 * diagonal.max())
    return damped
