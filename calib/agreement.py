"""Several lasers' results, and the passes they come from, to whether they are of one pole.

Each laser puts the pole somewhere, in every pass. In a pass that two of them see the navigation's error is
the same for both, and what is left, turned to the vehicle's own forward and right, is how far the one's
mount is off the other's. Over all passes the pole must be in one place, too: else they are of two poles.
What a mount has taken into itself to make its passes agree, as x does a late stamp, is not seen here.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from polecal.calib.estimate import Pass, Result, Setup, scatter_of
from polecal.calib.geometry import Array, wrap
from polecal.calib.observations import Kind
from polecal.calib.solve import pole_rows

_FLOOR_M = 0.01  # two lasers see the pole at two heights, and no pole is quite straight
_FALSE_ALARMS = 1e-4
_FEWEST_TOGETHER = 3
_STEP = 1e-6


@dataclass(frozen=True, slots=True)
class View:
    """Where a laser's result puts the pole in each of its passes.

    ``spans_ns`` are the passes' first and last times, of one clock for all lasers. ``place_m`` (P, 2) is
    north and east; ``moved`` (P, 2, 6) is its derivative by the mount's unknowns, m and rad.
    """

    name: str
    spans_ns: tuple[tuple[int, int], ...]
    site: NDArray[np.int64]
    yaw_rad: Array
    place_m: Array
    moved: Array
    covariance: Array

    @classmethod
    def of(
        cls,
        name: str,
        passes: Sequence[Pass],
        spans_ns: Sequence[tuple[int, int]],
        setup: Setup,
        result: Result,
    ) -> View:
        """Look at the pole from all passes that the result was found from."""
        used = [
            (one, span)
            for one, span in zip(passes, spans_ns, strict=True)
            if one.id not in result.set_aside and one.pole_returns
        ]
        scatter = scatter_of([one.totals[Kind.POLE] for one, _ in used], Kind.POLE, setup.pole_radius_m)
        vector = result.vector
        place_m = scatter.means(pole_rows(vector))
        steps = _STEP * np.eye(len(vector))[:6]
        moved = [(scatter.means(pole_rows(vector + step)) - place_m) / _STEP for step in steps]
        return cls(
            name,
            tuple(span for _, span in used),
            np.array([one.site for one, _ in used]),
            scatter.yaw_rad(),
            place_m,
            np.stack(moved, axis=2),
            result.covariance,
        )


def disagreements(views: Sequence[View]) -> tuple[str, ...]:
    """Say of each two lasers that cannot both be right by how much, and what their σ would allow."""
    return tuple(reason for one, other in combinations(views, 2) for reason in _between(one, other) if reason)


def _between(one: View, other: View) -> list[str]:
    pairs = [
        (i, j)
        for i, (first, last) in enumerate(one.spans_ns)
        for j, (other_first, other_last) in enumerate(other.spans_ns)
        if first <= other_last and other_first <= last
    ]
    both = f"{one.name} and {other.name} disagree: {one.name} has the pole"
    if len(pairs) >= _FEWEST_TOGETHER:
        i, j = np.array(pairs).T
        to_body = _turn(one.yaw_rad[i] + wrap(other.yaw_rad[j] - one.yaw_rad[i]) / 2)
        apart_m = np.einsum("pab,pb->pa", to_body, one.place_m[i] - other.place_m[j])
        moved = [np.einsum("pab,pbk->ak", to_body, of) / len(pairs) for of in (one.moved[i], other.moved[j])]
        allowed = _allowed(apart_m.mean(axis=0), _scatter(apart_m), moved, (one, other))
        if allowed:
            forward, right = apart_m.mean(axis=0)
            return [
                f"{both} {forward:+.3f} m forward and {right:+.3f} m right of where {other.name} has it, in "
                f"the {len(pairs)} passes that both see; {allowed}"
            ]
    for site in np.intersect1d(one.site, other.site):
        of = [view.site == site for view in (one, other)]
        if min(map(np.count_nonzero, of)) < _FEWEST_TOGETHER:
            continue
        places = [view.place_m[of_site] for view, of_site in zip((one, other), of, strict=True)]
        apart = places[0].mean(axis=0) - places[1].mean(axis=0)
        moved = [view.moved[of_site].mean(axis=0) for view, of_site in zip((one, other), of, strict=True)]
        allowed = _allowed(apart, _scatter(places[0]) + _scatter(places[1]), moved, (one, other))
        if allowed:
            return [
                f"{both} {apart[0]:+.3f} m north and {apart[1]:+.3f} m east of where {other.name} has it; "
                f"{allowed}: check that there is but one reflector"
            ]
    return []


def _allowed(apart_m: Array, scatter: Array, moved: Sequence[Array], views: Sequence[View]) -> str:
    """Give what is allowed, in words, if it is less than (2,) m; else nothing.

    Errors that both share make the difference smaller than the sum of covariances says: the sum allows more.
    """
    allowed = scatter + _FLOOR_M**2 * np.eye(2)
    for of, view in zip(moved, views, strict=True):
        allowed += of @ view.covariance @ of.T
    square = float(apart_m @ np.linalg.solve(allowed, apart_m))
    most = -2.0 * math.log(_FALSE_ALARMS)  # χ² of two unknowns
    if square <= most:
        return ""
    return f"their σ allow {np.linalg.norm(apart_m) * np.sqrt(most / square):.3f} m"


def _scatter(values: Array) -> Array:
    """Give the covariance (2, 2) of a mean of (P, 2)."""
    covariance: Array = np.cov(values.T) / len(values)
    return covariance


def _turn(yaw_rad: Array) -> Array:
    """Give (P, 2, 2) from north and east to forward and right."""
    c, s = np.cos(yaw_rad), np.sin(yaw_rad)
    return np.stack([np.stack([c, s], axis=1), np.stack([-s, c], axis=1)], axis=1)
