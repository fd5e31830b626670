"""An estimate to a verdict, by the cost's threshold and by its rate of improvement, with reasons in words."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from polecal.calib.coverage import Need, Slice, headings, is_whole
from polecal.calib.geometry import Array, wrap
from polecal.calib.observations import PARAMETERS
from polecal.calib.uncertainty import FEWEST_PASSES


@dataclass(frozen=True, slots=True)
class Criteria:
    """When a result is good: bounds on √c (m), its relative improvement, and σ (m, rad)."""

    cost_m: float = 0.05
    improvement: float = 0.02
    mode: Literal["all", "any"] = "all"
    max_sigma: tuple[float, ...] = (0.02, 0.02, 0.02, *(float(np.radians(0.1)),) * 3)
    max_shift_sigmas: float = 4.0
    """A result further than this from the hand measurement, in its σ, is not believed."""


@dataclass(frozen=True, slots=True)
class Verdict:
    """Accepted or not, why not, and whether more driving can change that."""

    accepted: bool
    reasons: tuple[str, ...]
    hopeless: bool = False


def judge(
    *,
    criteria: Criteria,
    need: Need,
    slices: Sequence[Slice],
    passes: int,
    cost_m: float,
    improvement: float | None,
    sigma: Array,
    held: Sequence[str],
    shift: Array,
    measured_sigma: Array,
) -> Verdict:
    """Judge an estimate. ``sigma``, ``shift`` (from the measured mount), ``measured_sigma``: (6,), m and rad.

    It is hopeless, not merely early, where all that was asked for has been driven, the cost no longer
    improves and is still too high, or where the result is too far from the hand measurement to be so.
    """
    missing = []
    if not is_whole(slices, need):
        empty = [part.slice for part in slices if not part.passes]
        thin = [part.slice for part in slices if part.passes and not part.done]
        if empty:
            missing.append(f"{_slices(empty)} no pass (heading {headings(empty, need.slice_deg)})")
        if thin:
            missing.append(f"{_slices(thin)} too few passes or pole returns")
    if passes < FEWEST_PASSES:
        missing.append(f"{passes} passes of the pole are too few to tell how good the result is")
    cheap = cost_m <= criteria.cost_m
    settled = improvement is not None and improvement <= criteria.improvement
    grounds = []
    if not cheap:
        grounds.append(f"cost {cost_m:.3f} m is above {criteria.cost_m:.3f} m")
    if not settled:
        grounds.append(
            "the cost's improvement is not known yet"
            if improvement is None
            else f"the cost still improves by {improvement:.1%}, above {criteria.improvement:.1%}"
        )
    if criteria.mode == "any" and (cheap or settled):
        grounds = []
    vague = [
        f"{name} is known to ±{_shown(index, sigma[index])}, not ±{_shown(index, criteria.max_sigma[index])}"
        for index, name in enumerate(PARAMETERS)
        if name not in held and sigma[index] > criteria.max_sigma[index]
    ]
    shift = np.concatenate([shift[:3], wrap(shift[3:])])
    far = [
        f"{name} comes out {_shown(index, abs(shift[index]))} from the hand measurement: measure again, "
        "or check that the pole was the only one"
        for index, name in enumerate(PARAMETERS)
        if abs(shift[index]) > criteria.max_shift_sigmas * measured_sigma[index]
    ]
    reasons = (*missing, *grounds, *vague, *far)
    hopeless = not missing and settled and (bool(far) or (bool(grounds) and not cheap))
    return Verdict(not reasons, reasons, hopeless)


def _slices(slices: Sequence[int]) -> str:
    names = ", ".join(map(str, slices))
    return f"slices {names} have" if len(slices) > 1 else f"slice {names} has"


def _shown(index: int, value: float) -> str:
    return f"{1000 * value:.0f} mm" if index < 3 else f"{np.degrees(value):.2f}°"
