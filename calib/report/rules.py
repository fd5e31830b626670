"""A verdict to the rules behind it: what is wanted, what is, and whether that is met."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from polecal.calib.estimate import Setup
from polecal.calib.geometry import wrap
from polecal.calib.observations import PARAMETERS, Mount
from polecal.calib.uncertainty import FEWEST_PASSES

_CHANGED = ("different after the first", "the last pass disagrees")
"""In `acceptance.judge`'s reasons, of what the numbers alone do not show."""


@dataclass(frozen=True, slots=True)
class Rule:
    """One line of what a result is judged by."""

    what: str
    wanted: str
    found: str
    met: bool


def rules(entry: Mapping[str, Any], setup: Setup) -> list[Rule]:
    """Give the rules that a laser's part of ``calibration.yaml`` was judged by, in words.

    A rule of which an older version wrote nothing is not among them.
    """
    need, criteria = setup.need, setup.criteria
    done = sum(part["done"] for part in entry["coverage"])
    costs = [
        Rule(what, f"≤ {1000 * most:.1f} mm", _known(entry[key], 1000, "mm", 1), (entry[key] or 0.0) <= most)
        for key, what, most in (
            ("cost_m", "cost √c", criteria.cost_m),
            ("left_out_m", "cost √c of passes left out of the fit", criteria.left_out_m),
        )
        if key in entry
    ]
    rates = [
        Rule(
            what,
            f"≤ {most:.1%}",
            _known(entry[key], 100, "%", 2),
            entry[key] is not None and entry[key] <= most,
        )
        for key, what, most in (
            ("improvement", "√c improved by the last passes by", criteria.improvement),
            ("doubling", "√c improved by twice the passes by", criteria.doubling),
        )
        if key in entry
    ]
    if criteria.mode == "any" and any(all(one.met for one in some) for some in (costs, rates)):
        costs, rates = ([replace(one, met=True) for one in some] for some in (costs, rates))
    told = [
        Rule(
            f"slices with at least {need.min_pole_returns} pole returns"
            + (f" from {need.min_passes} passes" if need.min_passes > 1 else ""),
            f"≥ {need.slices_needed}",
            f"{done} of {len(entry['coverage'])}",
            done >= need.slices_needed,
        ),
        Rule("passes", f"≥ {FEWEST_PASSES}", f"{entry['passes']}", entry["passes"] >= FEWEST_PASSES),
        *costs,
        *rates,
    ]
    if entry["estimate"] is None:
        return told
    sigma, shift = Mount(**entry["sigma"]).vector, Mount(**entry["estimate"]).vector - setup.measured.vector
    shift[3:] = wrap(shift[3:])
    told += [
        Rule(
            f"σ of {name}",
            f"≤ {in_words(index, criteria.max_sigma[index])}",
            in_words(index, sigma[index]),
            bool(sigma[index] <= criteria.max_sigma[index]),
        )
        for index, name in enumerate(PARAMETERS)
        if name not in entry["held"]
    ]
    most = criteria.max_shift_sigmas
    for part in (slice(0, 3), slice(3, 6)):
        off = float(np.linalg.norm(shift[part] / setup.measured_sigma.vector[part]))
        what = f"{', '.join(PARAMETERS[part])}: off the hand measurement, in its σ"
        told.append(Rule(what, f"≤ {most:.1f}", f"{off:.1f}", off <= most))
    changed = [why for why in entry["verdict"]["reasons"] if any(part in why for part in _CHANGED)]
    told.append(Rule("the passes agree from first to last", "yes", "no" if changed else "yes", not changed))
    return told


def _known(value: float | None, scale: float, unit: str, digits: int) -> str:
    return "unknown" if value is None else f"{scale * value:.{digits}f} {unit}"


def in_words(index: int, value: float) -> str:
    """Write an unknown's value (m or rad) in mm or degrees."""
    return f"{1000 * value:.1f} mm" if index < 3 else f"{np.degrees(value):.3f}°"
