"""A probability to how many of its own σ a mean is off by chance: Student's t.

scipy.special has it too, but takes 17 MB, which the daemon has no other use for.
"""

from __future__ import annotations

import math
from functools import cache

_HALVINGS = 60


@cache
def exceeded(chance: float, freedom: int) -> float:
    """Give the t that one of so many degrees of freedom exceeds, to either side, with a probability.

    ``chance`` is in (0, 1), ``freedom`` 1 at least. Chances down to 1e-9 come out to seven digits.
    """
    most = 1.0
    while _chance(most, freedom) > chance:
        most *= 2.0
    least = most / 2.0 if most > 1.0 else 0.0
    for _ in range(_HALVINGS):
        t = (least + most) / 2.0
        if _chance(t, freedom) > chance:
            least = t
        else:
            most = t
    return (least + most) / 2.0


def _chance(t: float, freedom: int) -> float:
    """Give the probability that t is exceeded (Abramowitz and Stegun, 26.7.3 and 26.7.4)."""
    angle = math.atan2(t, math.sqrt(freedom))
    sine, cosine = math.sin(angle), math.cos(angle)
    odd = freedom % 2
    term = cosine if odd else 1.0
    total = term if freedom > 1 else 0.0
    for power in range(2 + odd, freedom - 1, 2):
        term *= cosine**2 * (power - 1) / power
        total += term
    within = 2.0 / math.pi * (angle + sine * total) if odd else sine * total
    return 1.0 - within
