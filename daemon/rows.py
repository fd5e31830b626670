"""Passes and choices to what PASSES, DROP and KEEP answer."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import Any

from polecal.calib import Kind, Residual
from polecal.daemon import facts
from polecal.daemon.choices import Choice, name_of
from polecal.daemon.passes import Kept

USED, ASIDE, DROPPED, OTHER = "used", "set aside", "dropped", "other reflector"
_SHOWN = ("state", "passes", "estimate", "sigma", "held", "cost_m", "verdict")


def use_of(
    one: Kept, poles: Collection[tuple[int, int]], dropped: Mapping[int, Choice], aside: Mapping[int, str]
) -> tuple[str, str]:
    """Say whether a pass is used, and why not."""
    if one.id in dropped:
        choice = dropped[one.id]
        return DROPPED, f"by {choice.by}, {choice.at}"
    if one.where not in poles:
        return OTHER, "it is not of the reflector that is taken for the pole"
    return (ASIDE, aside[one.id]) if one.id in aside else (USED, "")


def row(laser: str, one: Kept, use: str, why: str, residual: Residual | None) -> dict[str, Any]:
    """Give a pass as PASSES tells it."""
    count = one.moments.counts
    slices = sorted({part for part, _ in count})
    about, quality = one.facts, one.quality
    return {
        "name": name_of(laser, one.id),
        "laser": laser,
        "pass": one.id,
        "site": one.moments.site,
        "place": one.place,
        "use": use,
        "why": why,
        "start": facts.utc(about.gps_ns[0], quality.utc_offset_s),
        "end": facts.utc(about.gps_ns[1], quality.utc_offset_s),
        "gps_ns": list(about.gps_ns),
        "t_ns": list(one.t_ns),
        "heading_deg": round(about.heading_deg, 1),
        "span_deg": round(about.span_deg, 1),
        "slices": [
            {"slice": part, **{kind.name.lower(): count.get((part, kind), 0) for kind in Kind}}
            for part in slices
        ],
        "speed_mps": round(about.speed_mps, 2),
        "direction": about.direction,
        "nearest_m": round(about.nearest_m, 2),
        "mean_m": round(about.mean_m, 2),
        "ins_status": quality.ins_status,
        "position_type": quality.position_type,
        "position_sigma_m": quality.position_sigma_m,
        "azimuth_sigma_deg": quality.azimuth_sigma_deg,
        "unused_poses": quality.unused_poses,
        "cost_m": None if residual is None else round(residual.cost_m, 4),
        "offset_m": None if residual is None else round(residual.offset_m, 4),
        "spread_m": None if residual is None else round(residual.spread_m, 4),
    }


def change(choice: Choice, before: Mapping[str, Any], after: Mapping[str, Any]) -> dict[str, Any]:
    """Give what a choice changed of a laser: before, after, and slices that are no longer done or now are."""
    done = [{part["slice"] for part in each["coverage"] if part["done"]} for each in (before, after)]
    return {
        "name": choice.name,
        "laser": choice.laser,
        "pass": choice.number,
        "dropped": choice.drop,
        "before": {key: before[key] for key in _SHOWN},
        "after": {key: after[key] for key in _SHOWN},
        "slices_lost": sorted(done[0] - done[1]),
        "slices_won": sorted(done[1] - done[0]),
    }


def reflectors(
    every: Mapping[tuple[int, int], Sequence[Kept]], poles: Collection[tuple[int, int]]
) -> list[dict[str, Any]]:
    """Give the reflectors that could be the pole, as ``calibration.yaml`` lists them."""
    return [
        {"site": where[0], "place": where[1], "passes": [one.id for one in passes], "is_pole": where in poles}
        for where, passes in sorted(every.items())
    ]
