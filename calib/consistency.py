"""Solutions each without one pass to what the passes say of one another.

They are solved for the jackknife anyway. A pass by the solution without it is a pass that the fit did not
see; and what leaving it out changes is its say, which should not depend on when it was driven.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from polecal.calib.acceptance import Jump
from polecal.calib.geometry import Array, wrap
from polecal.calib.observations import PARAMETERS
from polecal.calib.student import exceeded

_FEWEST = 8
_FEWEST_BEFORE = 3  # what came just before the end is what is true now: there a single pass counts
_FALSE_ALARMS = 1e-2
"""In so many of drives in which nothing jumps one is said to."""


def jump(left_out: Array, matters: Sequence[float]) -> Jump | None:
    """Find where in the drive an unknown became another, from (P, n) solutions in the order of the passes.

    Tukey's pseudo-values, P θ - (P - 1) θ without the pass, scatter about the same mean before and after any
    pass; where the two means differ by more than Student's t allows, for all splits and unknowns together,
    they are not of one mount, one pole and one navigation. What is no more than ``matters`` (6,), m and rad,
    is let be. None where there are too few passes to tell.
    """
    passes = len(left_out)
    if passes < _FEWEST:
        return None
    spread = left_out[:, : len(PARAMETERS)] - left_out[0, : len(PARAMETERS)]
    spread[:, 3:6] = wrap(spread[:, 3:6])
    say = (1 - passes) * (spread - spread.mean(axis=0))
    before = np.arange(_FEWEST_BEFORE, passes)[:, None]  # a row a split
    after = passes - before
    most = exceeded(_FALSE_ALARMS / len(before) / len(PARAMETERS), passes - 2)
    summed = np.cumsum(say, axis=0)[_FEWEST_BEFORE - 1 : -1]
    means = summed / before, (say.sum(axis=0) - summed) / after
    about = ((say**2).sum(axis=0) - before * means[0] ** 2 - after * means[1] ** 2) / (passes - 2)
    by = means[1] - means[0]
    sigma = np.sqrt(np.maximum(0.0, about) * (1 / before + 1 / after))
    ratio = np.where(np.abs(by) > matters, np.abs(by) / np.maximum(sigma, 1e-12), 0.0)
    split, index = divmod(int(np.argmax(ratio)), len(PARAMETERS))
    return (
        Jump(index, float(by[split, index]), _FEWEST_BEFORE + split) if ratio[split, index] > most else None
    )
