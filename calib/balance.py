"""Solutions each without one pass to what the ground's variance should count against the pole's.

How good the returns of a kind are, their scatter within a pass alone cannot tell: an error of the vehicle's
tilt, or a wave of the ground, is the same for thousands of them. How the solution scatters with the passes
that it is made from does tell.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from polecal.calib.geometry import Array
from polecal.calib.observations import PARAMETERS
from polecal.calib.solve import UNKNOWNS
from polecal.calib.subsets import Subsets
from polecal.calib.uncertainty import jackknife

_TRIED = 13
_NEARLY = 0.1  # of the variances' product
_NOTHING = 1e-18


def balance(near: Subsets, without: NDArray[np.bool_], known: Array, most: float) -> float:
    """Give the `Form.balance` at which the solutions ``without`` each of the passes (U, P) scatter least.

    Tried are some from that of Eq. 7, 1, to ``most``: that of returns which are all independent. For each,
    every solution is one step of Newton's from where the passes are looked at, ``near`` the minimum.
    ``known`` (12,) is what is known of each unknown beforehand, as half of a Hessian's diagonal. The scatters
    of the mount's free unknowns count alike: their product is to be the least. Of balances that are nearly
    as good the one next to ``most`` is taken: which is the best is in part their own scatter.
    """
    pole, ground = near.sides(without)
    beforehand = np.diag(known[near.free])
    tried = most ** np.linspace(0.0, 1.0, _TRIED)
    gradient, information = (np.multiply.outer(tried, of) for of in ground)
    gradient += pole[0]
    information += pole[1] + beforehand
    steps = np.zeros((_TRIED, len(without), len(UNKNOWNS)))
    steps[..., near.free] = -np.linalg.solve(information, gradient[..., None])[..., 0]
    scatter = np.diagonal(jackknife(steps), axis1=1, axis2=2)[:, : len(PARAMETERS)]
    logs = np.log(np.maximum(scatter, _NOTHING)).sum(axis=1)
    return float(tried[np.flatnonzero(logs <= logs.min() + _NEARLY)[-1]])
