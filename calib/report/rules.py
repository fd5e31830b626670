"""A verdict to the rules behind it: what is wanted, what is, and whether that is met."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from polecal.calib.estimate import Setup
from polecal.calib.geometry import wrap
from polecal.calib.observations import PARAMETERS, Mount
from polecal.calib.uncertainty import FEWEST_PASSES


@dataclass(frozen=True, slots=True)
class Rule:
    """One line of what a result is judged by."""

    what: str
    wanted: str
    found: str
    met: bool


def rules(entry: Mapping[str, Any], setup: Setup) -> list[Rule]:
    """Give the rules that a laser's part of ``calibration.yaml`` was judged by, in words."""
    need, criteria = setup.need, setup.criteria
    done = sum(part["done"] for part in entry["coverage"])
    cost_m, gain = entry["cost_m"], entry["improvement"]
    either = ", or the other of the two" if criteria.mode == "any" else ""
    cheap = cost_m is not None and cost_m <= criteria.cost_m
    settled = gain is not None and gain <= criteria.improvement
    one_will_do = criteria.mode == "any" and (cheap or settled)
    told = [
        Rule(
            f"slices with at least {need.min_pole_returns} pole returns"
            + (f" from {need.min_passes} passes" if need.min_passes > 1 else ""),
            f"≥ {need.slices_needed}",
            f"{done} of {len(entry['coverage'])}",
            done >= need.slices_needed,
        ),
        Rule("passes", f"≥ {FEWEST_PASSES}", f"{entry['passes']}", entry["passes"] >= FEWEST_PASSES),
        Rule(
            f"cost √c{either}",
            f"≤ {1000 * criteria.cost_m:.1f} mm",
            "unknown" if cost_m is None else f"{1000 * cost_m:.1f} mm",
            cheap or one_will_do,
        ),
        Rule(
            f"improvement of √c by the last passes{either}",
            f"≤ {criteria.improvement:.1%}",
            "unknown" if gain is None else f"{gain:.2%}",
            settled or one_will_do,
        ),
    ]
    if entry["estimate"] is None:
        return told
    sigma, shift = Mount(**entry["sigma"]).vector, Mount(**entry["estimate"]).vector - setup.measured.vector
    shift[3:] = wrap(shift[3:])
    most_off = criteria.max_shift_sigmas * setup.measured_sigma.vector
    free = [(index, name) for index, name in enumerate(PARAMETERS) if name not in entry["held"]]
    for what, values, bounds in (
        ("σ of {}", sigma, criteria.max_sigma),
        ("change of {}", np.abs(shift), most_off),
    ):
        told += [
            Rule(
                what.format(name),
                f"≤ {in_words(index, bounds[index])}",
                in_words(index, values[index]),
                bool(values[index] <= bounds[index]),
            )
            for index, name in free
        ]
    return told


def in_words(index: int, value: float) -> str:
    """Write an unknown's value (m or rad) in mm or degrees."""
    return f"{1000 * value:.1f} mm" if index < 3 else f"{np.degrees(value):.3f}°"
