"""A run's calibration, its evidence and its drawings to one page that needs nothing else."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from polecal.calib.coverage import headings
from polecal.calib.estimate import Setup
from polecal.calib.geometry import wrap
from polecal.calib.observations import KEYS, PARAMETERS, Mount
from polecal.calib.report import drive, figures
from polecal.calib.report.evidence import Evidence, Weight, largest, placed_to_m
from polecal.calib.report.figures import Drawing, Quality
from polecal.calib.report.rules import in_words, rules
from polecal.calib.route import Leg

_RANGES_M = (5, 10, 20, 40, 80)
_EXTRAS = {
    "time_s": ("time offset: how much later than its stamps the laser measured", 1e3, "ms"),
    "range_m": ("range offset: what is missing from ranges to the tape", 1e3, "mm"),
    "lean_north": ("pole leans north, per metre of height", 1e3, "mm"),
    "lean_east": ("pole leans east, per metre of height", 1e3, "mm"),
    "slope_north": ("ground slopes north, per metre", 1e3, "mm"),
    "slope_east": ("ground slopes east, per metre", 1e3, "mm"),
}


@dataclass(frozen=True, slots=True)
class LaserReport:
    """What is known of one laser: its part of ``calibration.yaml``, and its evidence if it has any."""

    name: str
    setup: Setup
    entry: Mapping[str, Any]
    evidence: Evidence | None
    held_why: Mapping[str, str]
    """Why each held unknown is held, in words."""
    to_know_more: str
    """What to drive to know better what is known worst; empty where that is not known."""


@dataclass(frozen=True, slots=True)
class Report:
    """What is known of a run. ``facts`` are lines of (what, value) on where it comes from."""

    title: str
    state: str
    why: str
    """What ended the run, in words; empty if it is not known."""
    lasers: Sequence[LaserReport]
    quality: Quality | None
    facts: Sequence[tuple[str, str]]
    notes: Sequence[str]
    history: Sequence[tuple[float, str, str]]
    """(s since the first record, state entered, why)."""
    configuration: str
    route: Sequence[Leg] = ()
    """What is still to be driven, if anything is."""


@dataclass(frozen=True, slots=True)
class Page:
    """The page, and its drawings by themselves."""

    html: str
    drawings: Sequence[Drawing]


def render(report: Report) -> Page:
    """Write a report as HTML."""
    environment = Environment(
        loader=PackageLoader("polecal.calib.report", "."),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["svg"] = lambda drawing: Markup(drawing.svg)  # noqa: S704 - matplotlib's own
    lasers = [_laser(laser) for laser in report.lasers]
    navigation = figures.navigation("navigation", report.quality) if report.quality else None
    drawings = [drawing for laser in lasers for drawing in laser["drawings"]]
    drawings += [navigation] if navigation else []
    route = drive.route(report.route) if report.route else None
    drawings += [route] if route else []
    environment.filters["minus"] = lambda text: str(text).replace("-", "−")
    html = environment.get_template("page.html.j2").render(
        report=report,
        accepted=report.state == "accepted" and all(laser["accepted"] for laser in lasers),
        lasers=lasers,
        navigation=navigation,
        route=route,
    )
    return Page(html, drawings)


def _laser(laser: LaserReport) -> dict[str, Any]:
    """Work out all that the template says of a laser."""
    entry, evidence = laser.entry, laser.evidence
    told: dict[str, Any] = {
        "name": laser.name,
        "entry": entry,
        "accepted": bool(entry["verdict"]["accepted"]),
        "reasons": list(entry["verdict"]["reasons"]),
        "rules": rules(entry, laser.setup),
        "advice": list(_advice(laser)),
        "rose": figures.rose(laser.name, entry["coverage"], laser.setup.need),
        "unknowns": [],
        "extras": [],
        "effects": [],
        "passes": [],
        "held_why": laser.held_why,
        "ranges": [f"{range_m} m" for range_m in _RANGES_M],
    }
    drawings = [told["rose"]]
    if entry["estimate"] is not None:
        told["unknowns"] = _unknowns(entry)
        told["effects"] = _effects(entry)
        told["extras"] = [
            (words, f"{value['value'] * scale:+.1f} ± {value['sigma'] * scale:.1f} {unit}")
            for name, (words, scale, unit) in _EXTRAS.items()
            if (value := entry["extras"].get(name))
        ]
    if evidence is not None and entry["estimate"] is not None:
        sigma = Mount(**entry["sigma"]).vector
        free = [name not in entry["held"] for name in PARAMETERS]
        told["pole"] = figures.pole(laser.name, evidence, laser.setup.pole_radius_m)
        told["curve"] = figures.curve(laser.name, evidence, laser.setup.criteria.cost_m)
        told["residuals"] = figures.residuals(laser.name, evidence, laser.setup.need.slice_deg)
        told["influence"] = figures.influence(laser.name, evidence.weights, sigma, free)
        told["passes"] = [_pass(one, sigma, entry["held"]) for one in evidence.weights]
        drawings += [
            told[key] for key in ("pole", "curve", "residuals", "influence") if told[key] is not None
        ]
    return told | {"drawings": drawings}


def _unknowns(entry: Mapping[str, Any]) -> list[dict[str, str]]:
    rows = []
    for name, key in zip(PARAMETERS, KEYS, strict=True):
        unit, digits = ("m", 3) if key.endswith("_m") else ("°", 2)
        found, hand, sigma = (entry[part][key] for part in ("estimate", "measured", "sigma"))
        change = found - hand if unit == "m" else float(np.degrees(wrap(np.radians(found - hand))))
        held = name in entry["held"]
        rows.append(
            {
                "name": name,
                "found": f"{found:.{digits + 1}f} {unit}",
                "sigma": "held" if held else f"± {sigma:.{digits + 1}f} {unit}",
                "hand": f"{hand:.{digits}f} {unit}",
                "change": "–" if held else f"{change:+.{digits + 1}f} {unit}",
            }
        )
    return rows


def _effects(entry: Mapping[str, Any]) -> list[tuple[str, list[str]]]:
    """Say what correction and uncertainty come to at `_RANGES_M`."""
    before, after = Mount(**entry["measured"]), Mount(**entry["estimate"])
    shift_m = after.vector[:3] - before.vector[:3]
    turn = after.rotation[:, 0] - before.rotation[:, 0]
    moved = [float(np.linalg.norm(shift_m + range_m * turn)) for range_m in _RANGES_M]
    rows = [("is moved by the calibration, against the hand measurement, by", moved)]
    if "covariance" in entry:
        sigma = [placed_to_m(np.array(entry["covariance"]), after, range_m) for range_m in _RANGES_M]
        for axis, words in ((1, "sideways"), (2, "up and down")):
            held = " (z is held)" if axis == 2 and "z" in entry["held"] else ""
            rows.append(
                (f"is placed on the body to ± 1 σ, {words}{held}", [float(one[axis]) for one in sigma])
            )
    return [(words, [f"{1000 * value:,.0f} mm" for value in values]) for words, values in rows]


def in_millimetres(angle_deg: float, range_m: float) -> str:
    """Say what an angle comes to at a range: 0.02° is 7 mm at 20 m."""
    return f"{angle_deg:.2g}° is {1000 * range_m * np.tan(np.radians(angle_deg)):.0f} mm at {range_m:g} m"


def _advice(laser: LaserReport) -> Iterator[str]:
    """Say what to do now, the most pressing first."""
    entry, setup = laser.entry, laser.setup
    if entry["verdict"]["accepted"]:
        yield "Use it: `polecal-field result` prints it, for other systems too."
    else:
        if entry["estimate"] is not None:
            yield "Do not use these numbers."
        empty = [part["slice"] for part in entry["coverage"] if not part["done"]]
        if len(empty) == len(entry["coverage"]):
            yield "Drive past the pole from every side, 1 to 2 m aside."
        elif empty:
            yield f"Drive past the pole heading {headings(empty, setup.need.slice_deg)}."
        if entry["cost_m"] is not None and entry["cost_m"] > setup.criteria.cost_m:
            yield (
                "The cost is too high: see below whether single passes stand out, or one heading, range or "
                "bearing. Check that the pole stood firm and upright, that it was the only one, that the "
                "laser is screwed tight, and that corrections reached the receiver."
            )
    if entry["estimate"] is not None:
        sigma = entry["sigma"]
        free = [name for name in ("roll", "pitch", "yaw") if name not in entry["held"]]
        if free:
            worst = max(free, key=lambda name: float(sigma[f"{name}_deg"]))
            told = in_millimetres(sigma[f"{worst}_deg"], 20)
            yield f"The least known angle is {worst}: its σ of {told}."
    if laser.to_know_more:
        yield f"To know more: {laser.to_know_more}."


def _pass(one: Weight, sigma: Any, held: Sequence[str]) -> dict[str, str]:
    way = "" if np.isnan(one.speed_mps) else f"{abs(one.speed_mps):.1f} m/s"
    weighs = "–"
    if one.shift is not None:
        name, size = largest(one.shift, sigma, held)
        index = PARAMETERS.index(name)
        weighs = f"{name} by {in_words(index, abs(float(one.shift[index])))} ({size:.1f} σ)"
    return {
        "id": str(one.id),
        "start": f"{one.start_s:.0f} s",
        "heading": f"{np.degrees(one.heading_rad) % 360:.0f}°",
        "speed": way + (" in reverse" if one.speed_mps < 0 else ""),
        "pole": f"{one.pole:,}",
        "ground": f"{one.ground:,}",
        "off": "–" if np.isnan(one.off_m) else f"{1000 * one.off_m:.0f} mm",
        "weighs": weighs,
        "why_not": one.why_not,
    }
