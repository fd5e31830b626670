"""Passes to a result: the mount, what it is worth, and whether to trust it."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import reduce
from operator import add

import numpy as np
from numpy.typing import NDArray

from polecal.calib import consistency, moments, solve
from polecal.calib.acceptance import Criteria, Verdict, judge
from polecal.calib.balance import balance
from polecal.calib.blas import one_thread
from polecal.calib.certificate import Certificate, certify
from polecal.calib.coverage import Need, Slice, coverage, slice_of
from polecal.calib.geometry import Array
from polecal.calib.moments import DOWN, EAST, NORTH, Moments
from polecal.calib.observations import PARAMETERS, CalibrationError, Kind, Mount, Returns, axis_shift_m
from polecal.calib.solve import EXTRAS, PAPER, UNKNOWNS, Form, Scatter, Weights, ground_rows, pole_rows
from polecal.calib.subsets import Subsets
from polecal.calib.uncertainty import FEWEST_PASSES, from_model, jackknife

MEASURED_SIGMA = Mount(0.1, 0.1, 0.1, 5.0, 5.0, 5.0)
"""What a hand measurement is worth where nothing is said: 10 cm, 5°."""

_LAST_PASSES = 3  # the rate of improvement is what these brought
_FEWEST_POLE_RETURNS = 10
_FEWEST_TO_DISAGREE = 6
_FARTHEST_M = 1000.0  # of any range: a laser in millimetres would be beyond
_FARTHEST_ORIGIN_M = 1e5  # squares of what is farther leave no digits for the millimetre
_MOST_TURNED_RAD = 4 * np.pi
_MOST_SET_ASIDE = 0.25  # of all passes: where more disagree, it is not they that are wrong
_LEAST_M = 0.02  # of √c: what few passes fit better than their returns are is fitted too well
_FARTHEST = 20.0  # σ of the hand measurement: beyond, there is no such mount
_ODD, _ODD_M = 6.0, 0.06  # times the passes' median, and at least so far
_TELLING = (10e-3, 5e-3, 5e-3, 5e-3, 2e-3, 2e-3)
"""What an extra may be where the data know it no better: the latency of a serial adapter; 5 mm; 5 mm on a
metre; 2 cm on ten."""


Blocks = Mapping[tuple[int, Kind], Moments]
"""A pass's moments by slice of platform yaw and kind."""


@dataclass(frozen=True, slots=True)
class Pass:
    """One approach in which the pole is seen, as moments by kind."""

    id: int
    totals: dict[Kind, Moments]
    counts: dict[tuple[int, Kind], int]
    """How many returns, by slice of platform yaw and kind."""
    site: int = 0
    """Passes of another day have another: pole and ground are compared within a site only."""

    @classmethod
    def of(cls, number: int, blocks: Blocks, site: int = 0) -> Pass:
        """Add up the moments of one pass."""
        return cls(
            number,
            {kind: sum_of(block for (_, of), block in blocks.items() if of is kind) for kind in Kind},
            {key: block.count for key, block in blocks.items()},
            site,
        )

    @property
    def pole_returns(self) -> dict[int, int]:
        """How many pole returns, by slice."""
        return {part: count for (part, kind), count in self.counts.items() if kind is Kind.POLE}


@dataclass(frozen=True, slots=True)
class Setup:
    """What is known and asked for before any data: hand measurement, pole, and when a result is good."""

    measured: Mount
    measured_sigma: Mount = MEASURED_SIGMA
    pole_radius_m: float = 0.0
    pass_error: bool = True
    """Whether each pass may have a navigation error of its own, which weighs it down; else Eq. 7 as it is."""
    by_kind: bool = True
    """With ``pass_error``: whether the ground counts against the pole what makes the passes agree best.

    Else mean against mean, as in Eq. 7.
    """
    rough_ground: bool = True
    """Whether the bias that rough ground has in Eq. 6 is taken off (`solve.Form.rough_m2`)."""
    extras: frozenset[str] = frozenset(EXTRAS)
    """What of `solve.EXTRAS` to solve for, too, as far as the data can tell it."""
    hold: frozenset[str] = frozenset()
    criteria: Criteria = field(default_factory=Criteria)
    need: Need = field(default_factory=Need)

    def __post_init__(self) -> None:
        """Refuse what cannot be calibrated from. Raises CalibrationError."""
        faults = [
            (not np.isfinite(self.measured.vector).all(), "the measured mount is not finite"),
            (not (self.measured_sigma.vector > 0).all(), "the measured mount's σ is not above 0"),
            (not 0 <= self.pole_radius_m < np.inf, f"a pole's radius cannot be {self.pole_radius_m:g} m"),
            (not self.hold <= set(PARAMETERS), f"hold has names that are none of {', '.join(PARAMETERS)}"),
            (not self.extras <= set(EXTRAS), f"extras has names that are none of {', '.join(EXTRAS)}"),
        ]
        for fault, what in faults:
            if fault:
                raise CalibrationError(what, "correct what calibrate was given")


@dataclass(frozen=True, slots=True)
class Shared:
    """Which laser helped (`shared`), in how many passes of both, and which part of its σ alone is left."""

    laser: str
    passes: int
    sigma_ratio: dict[str, float]


@dataclass(frozen=True, slots=True)
class Result:
    """A mount, and how far to trust it.

    ``sigma`` has the same names and units as the mount; of what is ``held`` it is the hand measurement's.
    ``extras`` are those of `solve.EXTRAS` that the data could tell, with their σ; the others are 0. A
    ``time_s`` is by how much later than its stamps say the laser measured.
    ``covariance`` is (6, 6) in m and rad, order `PARAMETERS`. Costs are √c of Eq. 7 in m, after pole
    returns were moved to the pole's axis; ``left_out_m`` is that of the passes each by the solution without
    it. ``improvement`` is by how much of itself √c over all data fell through the last passes, ``doubling``
    from every second pass to all; they are None before there are enough passes. ``set_aside`` has the passes
    that disagree with the others and were not used, by id, and why; nothing else counts them.
    """

    mount: Mount
    extras: dict[str, float]
    extra_sigma: dict[str, float]
    cost_m: float
    measured_cost_m: float
    sigma: Mount
    covariance: Array
    held: tuple[str, ...]
    left_out_m: float | None
    improvement: float | None
    doubling: float | None
    slices: tuple[Slice, ...]
    passes: int
    set_aside: dict[int, str]
    returns: dict[Kind, int]
    verdict: Verdict
    left_out: dict[int, Array]
    """(6,) m and rad, the mount without a used pass, by its id; empty where there are too few."""
    weights: Weights
    """What the used passes and kinds counted."""
    certificate: Certificate | None = None
    """Whether the cost is proven to be the lowest; None where only the next minimum was sought."""
    shared: Shared | None = None
    """What another laser's view of the same passes has added to mount and σ; ``left_out`` is without."""

    @property
    def vector(self) -> Array:
        """The unknowns (12,) in the order of `solve.UNKNOWNS`, m and rad; 0 where an extra was not told."""
        return np.concatenate([self.mount.vector, [self.extras.get(name, 0.0) for name in EXTRAS]])


def sum_of(blocks: Iterable[Moments]) -> Moments:
    """Add up moments."""
    return reduce(add, blocks, moments.zero())


def split(returns: Returns, slice_deg: int) -> dict[tuple[int, Kind], Moments]:
    """Sum up one pass's returns by slice of platform yaw and kind."""
    part = slice_of(returns.rpy_rad[:, 2], slice_deg)
    blocks: dict[tuple[int, Kind], Moments] = {}
    for kind in Kind:
        of_kind = np.flatnonzero(returns.kind == kind)
        sums = moments.by_group(returns, of_kind, part[of_kind], ranged=kind is Kind.POLE)
        blocks |= {(number, kind): block for number, block in sums.items()}
    return blocks


def passes_of(
    returns: Returns, slice_deg: int, *, timed: bool = True, thick: bool = True, tilted: bool = True
) -> list[Pass]:
    """Sum up returns by pass and kind.

    What comes of it is ready for a time offset if ``timed``; for a range offset and a pole that is ``thick``;
    for a pole that leans and ground that slopes where they are ``tilted``.
    """
    numbers, index = _numbered(returns.pass_id)
    slices = 360 // slice_deg
    group = index * slices + slice_of(returns.rpy_rad[:, 2], slice_deg)
    passes = [Pass(int(number), {kind: moments.zero() for kind in Kind}, {}) for number in numbers]
    every, level = (NORTH, EAST, DOWN), {Kind.POLE: (NORTH, EAST), Kind.GROUND: (DOWN,)}
    for kind in Kind:
        of_kind = np.flatnonzero(returns.kind == kind)
        ranged = thick and kind is Kind.POLE
        axes = every if tilted or ranged else level[kind]
        blocks = moments.by_group(returns, of_kind, index[of_kind], axes=axes, ranged=ranged, timed=timed)
        for label, block in blocks.items():
            passes[label].totals[kind] = block
        counts = np.bincount(group[of_kind])
        for label in np.flatnonzero(counts).tolist():
            passes[label // slices].counts[label % slices, kind] = int(counts[label])
    return passes


def _numbered(pass_id: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Give the passes' ids in order, and which of them each return (N,) is of."""
    lowest = pass_id.min(initial=0)
    if pass_id.max(initial=0) - lowest > len(pass_id):  # np.unique sorts: half as long as all sums take
        numbers, index = np.unique(pass_id, return_inverse=True)
        return numbers, index
    there = np.bincount(pass_id - lowest) > 0
    index = pass_id - lowest
    return np.flatnonzero(there) + lowest, index if there.all() else (np.cumsum(there) - 1)[index]


def calibrate(
    returns: Returns,
    mount: Mount,
    pole_radius_m: float = 0.0,
    *,
    pass_error: bool = False,
    rough_ground: bool = False,
    extras: Collection[str] = (),
    measured_sigma: Mount = MEASURED_SIGMA,
    hold: Collection[str] = (),
    criteria: Criteria | None = None,
    need: Need | None = None,
) -> Result:
    """Find the mount that minimises Eq. 7, starting from the measured ``mount``.

    Parameters
    ----------
    returns
        The cloud, in passes.
    mount
        As measured by hand; also what a parameter stays at that the data cannot tell.
    pole_radius_m
        0 is the paper's cost to the letter; else pole returns are moved to the pole's axis.
    pass_error
        Let each pass have a navigation error of its own: not the paper's cost, and nearer to the truth.
    rough_ground
        Take off what bumps of the ground add to the cost: not the paper's, and nearer to the truth.
    extras
        Names of `solve.EXTRAS` to solve for, too; a time offset needs the returns' motion.
    measured_sigma
        What the hand measurement is worth: a parameter is held where the data know it no better.
    hold
        Names of `PARAMETERS` to keep as measured.
    criteria, need
        When the verdict is good.

    Raises
    ------
    CalibrationError
        Where there are not enough pole returns to speak of.
    """
    need = need or Need()
    _refuse_absurd(returns)
    passes = passes_of(
        returns,
        need.slice_deg,
        timed="time_s" in extras,
        thick=pole_radius_m > 0 or "range_m" in extras,
        tilted=not {"time_s", "range_m"}.issuperset(extras),
    )
    setup = Setup(
        measured=mount,
        measured_sigma=measured_sigma,
        pole_radius_m=pole_radius_m,
        pass_error=pass_error,
        rough_ground=rough_ground,
        extras=frozenset(extras) - (set() if returns.motion is not None else {"time_s"}),
        hold=frozenset(hold),
        criteria=criteria or Criteria(),
        need=need,
    )
    return estimate(passes, setup, everywhere=True)


def _refuse_absurd(returns: Returns) -> None:
    """Refuse what no laser and no local frame gives, units mistaken foremost. Raises CalibrationError."""
    if not len(returns):
        raise CalibrationError("there are no returns", "record a pass of the pole")
    if returns.range_m.min() <= 0 or returns.range_m.max() > _FARTHEST_M:
        raise CalibrationError(
            f"range_m goes from {returns.range_m.min():g} to {returns.range_m.max():g}",
            f"it must be above 0 and up to {_FARTHEST_M:g}, in metres; leave out beams without a range",
        )
    if _farthest(returns.position_m) > _FARTHEST_ORIGIN_M:
        raise CalibrationError(
            f"position_m goes up to {_farthest(returns.position_m):g}: no digits left for millimetres",
            "take north, east and down in metres from a point near the pole",
        )
    if max(_farthest(returns.rpy_rad), _farthest(returns.bearing_rad)) > _MOST_TURNED_RAD:
        raise CalibrationError("rpy_rad or bearing_rad goes beyond two turns", "give radians, not degrees")


def _farthest(values: Array) -> float:
    """Give how far from 0 any is, on either side."""
    return max(float(values.max()), -float(values.min()))


@one_thread
def estimate(passes: Sequence[Pass], setup: Setup, *, everywhere: bool = False) -> Result:
    """Find the mount from passes; ``everywhere`` looks for lower minima far from the hand measurement, too.

    Raises CalibrationError where there are fewer than 10 pole returns.
    """
    pole_returns = sum(sum(one.pole_returns.values()) for one in passes)
    if pole_returns < _FEWEST_POLE_RETURNS:
        raise CalibrationError(
            f"{pole_returns} pole returns are too few to calibrate from",
            "drive past the pole; if that was done, check its tape and that the laser's reflectivity is on",
        )
    problem = _Problem(passes, setup)
    used = np.ones(len(passes), dtype=bool)
    set_aside: dict[int, str] = {}
    while True:
        found = problem.solve(used, everywhere=everywhere)
        odd = problem.oddest(used, found.vector)
        if odd is None or len(set_aside) >= _MOST_SET_ASIDE * len(passes):
            break
        set_aside[passes[odd[0]].id] = odd[1]
        used[odd[0]] = False
    result = problem.result(used, found, set_aside)
    return (
        replace(result, certificate=certify(found.form, found.vector, found.held)) if everywhere else result
    )


def scatter_of(
    totals: Sequence[Moments], kind: Kind, pole_radius_m: float, sites: Sequence[int] | None = None
) -> Scatter:
    """Give the scatter of passes' returns of one kind; those of the pole at its axis, even over its width."""
    if kind is Kind.GROUND:
        return Scatter(totals, sites=sites)
    across_m = pole_radius_m / np.sqrt(3.0)
    return Scatter(totals, shift_m=axis_shift_m(pole_radius_m), ranged=True, across_m=across_m, sites=sites)


def scatters_of(passes: Sequence[Pass], pole_radius_m: float) -> tuple[Scatter, Scatter]:
    """Give the scatters of passes' returns of the pole, and of the ground."""
    sites = [one.site for one in passes]
    pole, ground = (
        scatter_of([one.totals[kind] for one in passes], kind, pole_radius_m, sites) for kind in Kind
    )
    return pole, ground


@dataclass(frozen=True, slots=True)
class _Found:
    """A minimum: the unknowns (12,), their covariance (12, 12), and which were held."""

    vector: Array
    covariance: Array
    held: frozenset[str]
    paper: Form
    """Eq. 7 of the used passes,"""
    form: Form
    """and what was minimised."""
    subsets: Subsets | None = None
    """The passes near the minimum; None where there are too few, as with all below."""
    left_out: Array | None = None
    """(U, 12) without each used pass."""
    parts: Array | None = None
    """(3, 12) of `_Problem._parts`."""


class _Problem:
    """The passes of one laser, ready to be solved without some of them."""

    def __init__(self, passes: Sequence[Pass], setup: Setup) -> None:
        self.pole, self.ground = scatters_of(passes, setup.pole_radius_m)
        self._passes, self._setup = passes, setup
        self._measured = np.concatenate([setup.measured.vector, np.zeros(len(EXTRAS))])
        self._measured_sigma = np.concatenate([setup.measured_sigma.vector, _TELLING])

    def solve(self, used: NDArray[np.bool_], *, everywhere: bool) -> _Found:
        """Find the minimum over the used passes, with what they cannot tell held as measured."""
        setup, measured = self._setup, self._measured
        numbers = np.flatnonzero(used)
        enough = len(numbers) >= FEWEST_PASSES
        held = {*setup.hold, *EXTRAS} - (setup.extras if enough else set())
        paper, weights, about = self._form(used), PAPER, measured
        if (setup.pass_error or setup.rough_ground) and enough:  # fixed from here on
            about = solve.minimise(paper, measured, held)
            weights = Weights.told(
                self.pole,
                self.ground,
                used,
                about,
                pass_error=setup.pass_error,
                rough=setup.rough_ground,
                by_kind=setup.pass_error and setup.by_kind,
            )
        whole = self._form(used, weights)
        # What the data know no better than the tape measure is not taken from them. On a flat pad z is
        # nearly free (paper.md, later work 4) and more passes hardly help: it meets its bound, or is held.
        believable = self._measured_sigma.copy()
        believable[2] = min(believable[2], setup.criteria.max_sigma[2])
        if weights.ground_return is not None:
            known = max(paper.spread(about), _LEAST_M**2) / self.pole.count[used].sum() / believable**2
            near = Subsets.near(self.pole, self.ground, weights, about, ~_mask(held))
            less = balance(near, _each_but_one(used), known, whole.balance) / whole.balance
            weights = replace(weights, ground_return=less * weights.ground_return)
            whole = replace(whole, balance=less * whole.balance)
        search = solve.minimise_globally if everywhere else solve.minimise
        at_measured = whole.information(measured)
        vector = about
        while True:
            vector = search(whole, np.where(_mask(held), measured, vector), held)
            free = ~_mask(held)
            squared = max((paper if weights.ground_return else whole).spread(vector), _LEAST_M**2)
            # A scatter cannot see what no pass tells at all; what all returns, were they independent, could
            # tell at best can. Where the minimum is may hide it: off level the cosine of a level sensor's
            # pitch stretches the ranges, and noise puts it there. So it must be told at the measured mount,
            # too.
            count, information = int(self.pole.count[used].sum()), whole.information(vector)
            best = [np.diag(from_model(of, squared, count, free)) for of in (information, at_measured)]
            variance, subsets, left_out, parts = np.maximum(*best), None, None, None
            if not enough:
                covariance = from_model(information, squared, len(numbers), free)
                variance = np.maximum(variance, np.diag(covariance))
            elif (variance <= believable**2).all():
                subsets = Subsets.near(self.pole, self.ground, weights, vector, free)
                some = np.concatenate([_each_but_one(used), self._parts(used)])
                left_out, parts = np.split(subsets.minima(some, whole.bend(vector)), [len(numbers)])
                covariance = jackknife(left_out)
                variance = np.maximum(variance, np.diag(covariance))
            doubt = np.sqrt(variance) / believable
            if not enough:  # few passes can be fitted by a mount that cannot be: it is not their noise
                far = np.abs(vector - measured) / (_FARTHEST * self._measured_sigma)
                doubt = np.maximum(doubt, far * free)
            doubt = np.where(free, np.nan_to_num(doubt, nan=np.inf), 0.0)  # what is no number is not told
            worst = int(np.argmax(doubt))
            if doubt[worst] <= 1.0:
                return _Found(vector, covariance, frozenset(held), paper, whole, subsets, left_out, parts)
            held.add(UNKNOWNS[worst])

    def _parts(self, used: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Give the used passes but the last ones, and two halves of them that have seen as much, (3, P)."""
        order = np.flatnonzero(used).tolist()
        turned = sorted(order, key=lambda number: min(self._passes[number].pole_returns, default=0))
        parts = np.zeros((3, len(used)), dtype=bool)
        for part, numbers in zip(parts, (order[:-_LAST_PASSES], turned[::2], turned[1::2]), strict=True):
            part[numbers] = True  # of the halves from every heading every other pass
        return parts

    def oddest(self, used: NDArray[np.bool_], vector: Array) -> tuple[int, str] | None:
        """Find the used pass that disagrees most with the others, if any does beyond what they scatter."""
        numbers = np.flatnonzero(used)
        if len(numbers) < _FEWEST_TO_DISAGREE:
            return None
        worst: tuple[float, int, str] = (1.0, -1, "")
        for scatter, rows, what in (
            (self.pole, pole_rows(vector), "pole"),
            (self.ground, ground_rows(vector), "ground"),
        ):
            seen = numbers[scatter.count[numbers] > 0]
            if not len(seen):
                continue
            off_m = np.linalg.norm(scatter.off(rows, seen), axis=1)
            spread_m = np.sqrt(scatter.within(rows)[seen])
            for values, words in (
                (off_m, f"its {what} is {{:.2f}} m off"),
                (spread_m, f"its {what} is smeared by {{:.2f}} m"),
            ):
                odd = values / np.maximum(_ODD * np.median(values), _ODD_M)
                index = int(np.argmax(odd))
                worst = max(worst, (float(odd[index]), int(seen[index]), words.format(values[index])))
        return None if worst[1] < 0 else worst[1:]

    def result(self, used: NDArray[np.bool_], found: _Found, set_aside: dict[int, str]) -> Result:
        """Say what was found, and judge it."""
        setup, vector, held = self._setup, found.vector, found.held
        passes = [one for one, is_used in zip(self._passes, used, strict=True) if is_used]
        mask = _mask(held)[:6]
        covariance = found.covariance[:6, :6] + self._not_told(found)
        covariance[mask, mask] = self._measured_sigma[:6][mask] ** 2
        sigma = np.sqrt(np.diag(covariance))
        spread = np.sqrt(np.diag(found.covariance))
        told = [index for index, name in enumerate(UNKNOWNS) if name in EXTRAS and name not in held]
        cost_m = solve.cost_m(found.paper, vector)
        improvement = doubling = left_out_m = None
        if found.subsets is not None and found.left_out is not None and found.parts is not None:
            left_out_m = found.subsets.left_out_m(used, found.left_out)
            costs_m = [solve.cost_m(found.paper, minimum) for minimum in found.parts]
            last, *halves = (part_m / cost_m - 1.0 if cost_m else 0.0 for part_m in costs_m)
            improvement, doubling = last, float(np.mean(halves))
        slices = coverage([one.pole_returns for one in passes], setup.need)
        verdict = judge(
            criteria=setup.criteria,
            need=setup.need,
            slices=slices,
            passes=len(passes),
            cost_m=cost_m,
            left_out_m=left_out_m,
            improvement=improvement,
            doubling=doubling,
            last_set_aside=set_aside.get(self._passes[-1].id),
            jump=None
            if found.left_out is None
            else consistency.jump(found.left_out, setup.criteria.max_sigma),
            sigma=sigma,
            held=tuple(held),
            shift=(vector - self._measured)[:6],
            measured_sigma=self._measured_sigma[:6],
        )
        return Result(
            mount=Mount.from_vector(vector[:6]),
            extras={UNKNOWNS[index]: float(vector[index]) for index in told},
            extra_sigma={UNKNOWNS[index]: float(spread[index]) for index in told},
            cost_m=cost_m,
            measured_cost_m=solve.cost_m(found.paper, self._measured),
            sigma=Mount.of_variance(np.diag(covariance)),
            covariance=covariance,
            held=tuple(name for name in PARAMETERS if name in held),
            left_out_m=left_out_m,
            improvement=improvement,
            doubling=doubling,
            slices=slices,
            passes=len(passes),
            set_aside=set_aside,
            returns={
                Kind.POLE: int(self.pole.count[used].sum()),
                Kind.GROUND: int(self.ground.count[used].sum()),
            },
            verdict=verdict,
            left_out={}
            if found.left_out is None
            else {one.id: row[:6] for one, row in zip(passes, found.left_out, strict=True)},
            weights=found.subsets.weights if found.subsets else PAPER,
        )

    def _not_told(self, found: _Found) -> Array:
        """Give what the extras that should be solved for and cannot add to the covariance (6, 6).

        They are held at 0, and may be as far from it as they need not to be told: what is found would move
        with them. A drive at one speed, forward, knows x no better than the time offset times that speed.
        """
        free = ~_mask(found.held)
        untold = np.flatnonzero(_mask(self._setup.extras & found.held))
        hessian = found.form.information(found.vector)
        moved = np.zeros((len(UNKNOWNS), len(untold)))
        moved[free] = np.linalg.pinv(hessian[np.ix_(free, free)], rcond=1e-12, hermitian=True) @ (
            -hessian[np.ix_(free, untold)] * self._measured_sigma[untold]
        )
        added: Array = moved[:6] @ moved[:6].T
        return added

    def _form(self, used: NDArray[np.bool_], weights: Weights = PAPER) -> Form:
        return Form.of(self.pole, self.ground, used, weights)


def _each_but_one(used: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Give the used passes without each of them in turn, (U, P)."""
    return used & ~np.eye(len(used), dtype=bool)[used]


def _mask(held: Collection[str]) -> NDArray[np.bool_]:
    return np.array([name in held for name in UNKNOWNS])
