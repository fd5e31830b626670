"""An estimate, and scans of the pass that is being driven, to the estimate with those scans.

The passes that are closed are one sum each; a scan adds its own, and the solution goes on from the last one:
it costs the same after a hundred returns and after a hundred million.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from polecal.calib import moments, solve
from polecal.calib.blas import one_thread
from polecal.calib.estimate import Pass, Result, Setup, scatter_of, sum_of
from polecal.calib.geometry import Array
from polecal.calib.moments import Moments
from polecal.calib.observations import Kind, Mount, Returns
from polecal.calib.solve import EXTRAS, Form, Scatter


@dataclass(frozen=True, slots=True)
class _Closed:
    """Closed passes of one kind: returns, `Scatter.form` and `ray` times them; one site's weight and mean."""

    count: float
    weight: float
    mean: Array
    summed: Array
    ray: Array
    within: Array
    ratio: float

    @classmethod
    def of(cls, scatter: Scatter, ratio: float, site: int) -> _Closed:
        used = scatter.count > 0
        count = float(scatter.count.sum())
        return cls(
            count,
            *scatter.weighted_mean(used & (scatter.sites == site), ratio),
            count * scatter.form(used, ratio),
            count * scatter.ray(used),
            count * scatter.within_form(used),
            ratio,
        )

    def form(self, count: float, mean: Array, within: Array) -> Array:
        """Give what `Scatter.form` gives of all these passes and one more: its returns, mean and form."""
        weight = count / (1.0 + count / self.ratio)
        off = mean - self.mean
        shared = self.weight * weight / max(self.weight + weight, 1e-300)
        form: Array = self.summed + count * within + np.outer(shared * off, off)
        form /= max(1.0, self.count + count)
        return form


class Running:
    """Takes the scans of an open pass, of the same day as the last of the ``passes``.

    What is held, and what passes weigh, stays as it was for the ``result``.
    """

    @one_thread
    def __init__(self, passes: Sequence[Pass], setup: Setup, result: Result) -> None:
        used = [one for one in passes if one.id not in result.set_aside]
        self._held = {*result.held, *EXTRAS} - set(result.extras)
        self._vector = result.vector
        self._radius_m = setup.pole_radius_m
        self._open = {kind: moments.zero() for kind in Kind}
        sites = [one.site for one in used]
        pole, ground = (self._scatter([one.total(kind) for one in used], kind, sites) for kind in Kind)
        self._weights = result.weights
        self._closed = {
            Kind.POLE: _Closed.of(pole, self._weights.pole_ratio, sites[-1]),
            Kind.GROUND: _Closed.of(ground, self._weights.ground_ratio, sites[-1]),
        }

    @one_thread
    def add(self, returns: Returns) -> Mount:
        """Add returns of the open pass, and solve again."""
        forms: dict[Kind, Array] = {}
        ray, bumps = self._closed[Kind.GROUND].ray, self._closed[Kind.GROUND].within
        for kind, closed in self._closed.items():
            of_kind = np.flatnonzero(returns.kind == kind)
            blocks = moments.by_group(
                returns,
                of_kind,
                np.zeros_like(of_kind),
                ranged=kind is Kind.POLE,
                timed="time_s" not in self._held,
            )
            self._open[kind] = sum_of([self._open[kind], *blocks.values()])
            scatter, one = self._scatter([self._open[kind]], kind), np.array([True])
            within = scatter.form(one, closed.ratio)
            forms[kind] = closed.form(scatter.count[0], scatter.weighted_mean(one)[1], within)
            if kind is Kind.GROUND:
                count = scatter.count[0]
                ray = (ray + count * scatter.ray(one)) / max(1.0, closed.count + count)
                bumps = (bumps + count * scatter.within_form(one)) / max(1.0, closed.count + count)
        form = Form(
            forms[Kind.POLE],
            forms[Kind.GROUND],
            self._weights.rough_m2,
            ray if self._weights.rough_m2 else None,
            bumps if self._weights.rough_m2 and self._weights.ground_return else None,
            self._weights.balance(
                *(closed.count + self._open[kind].count for kind, closed in self._closed.items())
            ),
        )
        self._vector = solve.minimise(form, self._vector, self._held)
        return Mount.from_vector(self._vector[:6])

    def _scatter(
        self, of_passes: Sequence[Moments], kind: Kind, sites: Sequence[int] | None = None
    ) -> Scatter:
        return scatter_of(of_passes, kind, self._radius_m, sites)
