"""Passes and a result to how far each one's pole is from the common one, used or not, from moments."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from polecal.calib.estimate import Pass, Result, Setup, scatter_of
from polecal.calib.observations import Kind
from polecal.calib.solve import pole_rows


@dataclass(frozen=True, slots=True)
class Residual:
    """How a pass's pole returns lie about the pole of its site: their mean's offset, their spread, in m."""

    offset_m: float
    spread_m: float

    @property
    def cost_m(self) -> float:
        """√c of the pass's pole returns about the common pole."""
        return float(np.hypot(self.offset_m, self.spread_m))


def residuals(
    passes: Sequence[Pass], used: Sequence[bool], setup: Setup, result: Result
) -> dict[int, Residual | None]:
    """Give each pass's residual by its id under a result; None where its site has no used pass.

    The common pole is the mean of the ``used`` passes' returns of the same site, as in Eq. 5.
    """
    scatter = scatter_of([one.totals[Kind.POLE] for one in passes], Kind.POLE, setup.pole_radius_m)
    rows = pole_rows(result.vector)
    means, within = scatter.means(rows), 2 * scatter.within(rows)  # of north and east together
    sites = np.array([one.site for one in passes])
    told: dict[int, Residual | None] = {}
    for number, one in enumerate(passes):
        same = np.array(used) & (sites == one.site) & (scatter.count > 0)
        if not same.any() or not scatter.count[number]:
            told[one.id] = None
            continue
        pole = scatter.count[same] @ means[same] / scatter.count[same].sum()
        offset_m = float(np.linalg.norm(means[number] - pole))
        told[one.id] = Residual(offset_m, float(np.sqrt(max(0.0, within[number]))))
    return told
