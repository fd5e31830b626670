"""Solutions each without one pass to what the ground's variance should count against the pole's.

How good the returns of a kind are, their scatter within a pass alone cannot tell: an error of the vehicle's
tilt, or a wave of the ground, is the same for thousands of them. How the solution scatters with the passes
that it is made from does tell.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from polecal.calib.geometry import Array
from polecal.calib.observations import PARAMETERS
from polecal.calib.solve import UNKNOWNS, Form
from polecal.calib.uncertainty import jackknife

_TRIED = 13
_NOTHING = 1e-18


def balance(
    without: Sequence[Form], about: Array, free: NDArray[np.bool_], known: Array, most: float
) -> float:
    """Give the `Form.balance` at which the solutions ``without`` each of the passes scatter least.

    Tried are some from that of Eq. 7, 1, to ``most``: that of returns which are all independent. For each,
    every solution for the ``free`` (12,) unknowns is one step of Newton's from a vector (12,) ``about`` the
    minimum. ``known`` (12,) is what is known of each beforehand, as half of a Hessian's diagonal. The
    scatters of the mount's free unknowns count alike: their product is to be the least.
    """
    pole = _slopes([replace(form, balance=0.0) for form in without], about, free)
    both = _slopes([replace(form, balance=1.0) for form in without], about, free)
    tried = most ** np.linspace(0.0, 1.0, _TRIED)
    products = []
    for one in tried:
        gradient, information = (of + one * (of_both - of) for of, of_both in zip(pole, both, strict=True))
        steps = np.zeros((len(without), len(UNKNOWNS)))
        steps[:, free] = -np.linalg.solve(information + np.diag(known[free]), gradient[:, :, None])[:, :, 0]
        scatter = np.diag(jackknife(steps))[: len(PARAMETERS)]
        products.append(np.log(np.maximum(scatter, _NOTHING)).sum())
    return float(tried[np.argmin(products)])


def _slopes(forms: Sequence[Form], about: Array, free: NDArray[np.bool_]) -> tuple[Array, Array]:
    """Give all forms' half gradients (P, F) and halves of what their Hessians are on average (P, F, F)."""
    gradients = np.stack([form.slope(about)[0][free] for form in forms])
    return gradients, np.stack([form.information(about)[np.ix_(free, free)] for form in forms])
