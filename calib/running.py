"""An estimate, and scans of the pass that is being driven, to the estimate with those scans.

The passes that are closed are, near the estimate, a few small matrices each (`subsets`); a scan adds its own
sums, and all of it is solved again: it costs the same after a hundred returns and after a hundred million,
after ten passes and after hundreds.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from polecal.calib import moments
from polecal.calib.blas import one_thread
from polecal.calib.estimate import Pass, Result, Setup, scatters_of
from polecal.calib.observations import Kind, Mount, Returns
from polecal.calib.solve import EXTRAS, UNKNOWNS, Form
from polecal.calib.subsets import Subsets
from polecal.calib.uncertainty import jackknife


@dataclass(frozen=True, slots=True)
class Now:
    """What all passes say together with the open one: `Result`'s, of the same names."""

    mount: Mount
    cost_m: float


class Running:
    """Takes the scans of an open pass, of ``site``: else of the same as the last of the ``passes``.

    What is held, and what passes weigh, stays as it was for the ``result``.
    """

    @one_thread
    def __init__(self, passes: Sequence[Pass], setup: Setup, result: Result, site: int | None = None) -> None:
        used = [one for one in passes if one.id not in result.set_aside]
        held = {*result.held, *EXTRAS} - set(result.extras)
        self._free = np.array([name not in held for name in UNKNOWNS])
        self._result, self._radius_m = result, setup.pole_radius_m
        self._open = {kind: moments.zero() for kind in Kind}
        self._site = used[-1].site if site is None else site
        pole, ground = scatters_of(used, self._radius_m)
        self._bend = Form.of(pole, ground, np.ones(len(used), dtype=bool), result.weights).bend(result.vector)
        self._closed = Subsets.near(pole, ground, result.weights, result.vector, self._free)
        self._together, self._paper = self._closed.merged(), self._closed.paper().merged()
        self._driven: Subsets | None = None
        self._untold = np.zeros((6, 6))
        if result.left_out:
            left_out = self._closed.minima(~np.eye(len(used), dtype=bool), self._bend)
            self._untold = result.covariance - jackknife(left_out)[:6, :6]

    @one_thread
    def add(self, returns: Returns) -> Now:
        """Add returns of the open pass, and solve again."""
        for kind, before in self._open.items():
            of_kind = np.flatnonzero(returns.kind == kind)
            blocks = moments.by_group(
                returns,
                of_kind,
                np.zeros_like(of_kind),
                ranged=kind is Kind.POLE,
                timed=bool(self._free[UNKNOWNS.index("time_s")]),
            )
            self._open[kind] = sum(blocks.values(), before)
        open_pass = Pass(0, self._open, {}, self._site)
        driven = self._driven = self._closed.others(*scatters_of([open_pass], self._radius_m))
        together = self._together.joined(driven)
        (minimum,) = together.minima(np.ones((1, len(together)), dtype=bool), self._bend)
        cost_m = self._paper.joined(driven.paper()).spread_m(minimum)
        return Now(Mount.from_vector(minimum[:6]), cost_m)

    @one_thread
    def sigma(self) -> Mount:
        """Give σ of what is free, from the scatter of all passes with the open one; of the rest as it was."""
        if not self._result.left_out:
            return self._result.sigma
        every = self._closed if self._driven is None else self._closed.joined(self._driven)
        scatter = jackknife(every.minima(~np.eye(len(every), dtype=bool), self._bend))
        told = self._untold + scatter[:6, :6]
        variance = np.where(self._free[:6], np.diag(told), np.diag(self._result.covariance))
        return Mount.of_variance(np.maximum(0.0, variance))
