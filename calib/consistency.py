"""Solutions each without one pass to what the passes say of one another.

They are solved for the jackknife anyway. A pass by the solution without it is a pass that the fit did not
see; and what leaving it out changes is its say, which should not depend on when it was driven.
"""

from __future__ import annotations

import numpy as np

from polecal.calib.acceptance import Jump
from polecal.calib.geometry import Array, wrap
from polecal.calib.observations import PARAMETERS
from polecal.calib.student import exceeded

_FEWEST = 8
_FEWEST_BEFORE = 3  # what came just before the end is what is true now: there a single pass counts
_FALSE_ALARMS = 1e-3
"""In so many of drives in which nothing jumps one is said to."""


def jump(left_out: Array) -> Jump | None:
    """Find where in the drive an unknown became another, from (P, n) solutions in the order of the passes.

    Tukey's pseudo-values, P θ - (P - 1) θ without the pass, scatter about the same mean before and after any
    pass; where the two means differ by more than Student's t allows, for all splits and unknowns together,
    they are not of one mount, one pole and one navigation. None where there are too few passes to tell.
    """
    passes = len(left_out)
    if passes < _FEWEST:
        return None
    spread = left_out[:, : len(PARAMETERS)] - left_out[0, : len(PARAMETERS)]
    spread[:, 3:6] = wrap(spread[:, 3:6])
    say = (1 - passes) * (spread - spread.mean(axis=0))
    splits = range(_FEWEST_BEFORE, passes)
    most = exceeded(_FALSE_ALARMS / len(splits) / len(PARAMETERS), passes - 2)
    found, worst = None, most
    for split in splits:
        before, after = say[:split], say[split:]
        by = after.mean(axis=0) - before.mean(axis=0)
        about = (before.var(axis=0) * split + after.var(axis=0) * (passes - split)) / (passes - 2)
        sigma = np.sqrt(about * (1 / split + 1 / (passes - split)))
        ratio = np.abs(by) / np.maximum(sigma, 1e-12)
        index = int(np.argmax(ratio))
        if ratio[index] > worst:
            found, worst = Jump(index, float(by[index]), split), float(ratio[index])
    return found
