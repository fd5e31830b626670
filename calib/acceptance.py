"""An estimate to a verdict: by its cost, by whether that still improves, and by what would make it untrue."""

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
    left_out_m: float = 0.06
    """Of passes by the solutions without them: higher than `cost_m` where the fit is too good."""
    improvement: float = 0.02
    """Through the last passes."""
    doubling: float = 0.05
    """From half of the passes to all."""
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


@dataclass(frozen=True, slots=True)
class Jump:
    """From one pass to the next an unknown (its index) is another, by so much, m or rad."""

    index: int
    by: float
    first_passes: int


def judge(
    *,
    criteria: Criteria,
    need: Need,
    slices: Sequence[Slice],
    passes: int,
    cost_m: float,
    left_out_m: float | None,
    improvement: float | None,
    doubling: float | None,
    jump: Jump | None,
    last_set_aside: str | None,
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
    if last_set_aside is not None:
        missing.append(f"the last pass disagrees with those before, {last_set_aside}: drive another")
    dear = [
        f"{what} {value:.3f} m is above {most:.3f} m"
        for what, value, most in (
            ("cost", cost_m, criteria.cost_m),
            ("cost of passes left out of the fit,", left_out_m, criteria.left_out_m),
        )
        if value is not None and value > most
    ]
    rates = (("", improvement, criteria.improvement), (" with twice the passes", doubling, criteria.doubling))
    unsettled = [
        f"the cost still improves by {rate:.1%}{when}, above {most:.1%}"
        for when, rate, most in rates
        if rate is not None and rate > most
    ]
    if improvement is None or doubling is None:
        unsettled = ["the cost's improvement is not known yet"]
    grounds = [] if criteria.mode == "any" and not (dear and unsettled) else dear + unsettled
    if jump is not None:
        grounds.append(
            f"{PARAMETERS[jump.index]} is {_shown(jump.index, abs(jump.by))} different after the first "
            f"{jump.first_passes} passes: check that laser, antenna and pole are fast, and drive anew"
        )
    vague = [
        f"{name} is known to ±{_shown(index, sigma[index])}, not ±{_shown(index, criteria.max_sigma[index])}"
        for index, name in enumerate(PARAMETERS)
        if name not in held and sigma[index] > criteria.max_sigma[index]
    ]
    shift = np.concatenate([shift[:3], wrap(shift[3:])])
    shifts = np.abs(shift) / measured_sigma
    far = [
        f"{name} comes out {_shown(index, abs(shift[index]))} from the hand measurement: measure again, "
        "or check that the pole was the only one"
        for index, name in enumerate(PARAMETERS)
        if shifts[index] > criteria.max_shift_sigmas
    ]
    for part, names in ((slice(0, 3), "x, y and z"), (slice(3, 6), "roll, pitch and yaw")):
        together = float(np.linalg.norm(shifts[part]))
        if shifts[part].max() <= criteria.max_shift_sigmas < together:
            off = _shown(part.start, float(np.linalg.norm(shift[part])))
            far.append(
                f"{names} together come out {off} from the hand measurement, {together:.1f} σ: "
                "measure again, from the point whose position the navigation gives"
            )
    reasons = (*missing, *grounds, *vague, *far)
    hopeless = not missing and not unsettled and bool(far or grounds)
    return Verdict(not reasons, reasons, hopeless)


def given_up(verdict: Verdict, passes: int) -> Verdict:
    """Give the verdict on so many passes that there may be no more: if they are not enough, that is that."""
    if verdict.accepted:
        return verdict
    why = f"{passes} passes, still not good enough: more of the same will not help"
    return Verdict(False, (*verdict.reasons, why), hopeless=True)


def _slices(slices: Sequence[int]) -> str:
    names = ", ".join(map(str, slices))
    return f"slices {names} have" if len(slices) > 1 else f"slice {names} has"


def _shown(index: int, value: float) -> str:
    return f"{1000 * value:.0f} mm" if index < 3 else f"{np.degrees(value):.2f}°"
