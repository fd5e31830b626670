"""How a session stands to what ROUTE answers: the drive that fills what is missing, around its pole."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from math import ceil, hypot, isfinite, radians
from typing import Any

import numpy as np
import pymap3d

from polecal.calib import Mount, Pass, Result, Setup
from polecal.calib.coverage import headings
from polecal.calib.dubins import Pose
from polecal.calib.geometry import wrap
from polecal.calib.route import Lack, Leg, Plan, Vehicle, clearances_m, plan
from polecal.calib.sight import Sensor, ground_of, pole_at
from polecal.daemon import results
from polecal.daemon.config import Config
from polecal.daemon.control import Code, Refused
from polecal.daemon.routine import State
from polecal.drivers.sick_lms import REVOLUTION_S, beam_ages_s

Place = tuple[float, float, float]
"""Latitude, longitude (degrees), height above the ellipsoid (m)."""

_GIVEN_SIGMA_M = 0.7  # of a place that an operator took from a map, or from a receiver held to the pole
_LEAST_SIGMA_M = 0.03
_SEEN_FROM_M = 4.0  # at which the laser's yaw puts the pole so far aside
_MOST_POINTS = 1800  # of a reply, which has 64 KiB
_BOUNDS = {
    "half_width_m": (0.1, 5.0, "--half-width"),
    "turn_radius_m": (0.3, 50.0, "--radius"),
    "area_m": (5.0, 500.0, "--area"),
}
_SPEEDS_MPS = (0.1, 15.0)


@dataclass(frozen=True, slots=True)
class LaserStand:
    """What a laser has: ``passes`` are those used, ``today`` those of the pole of this day."""

    name: str
    setup: Setup
    result: Result | None
    passes: Sequence[Pass]
    today: Sequence[Pass]


@dataclass(frozen=True, slots=True)
class Stand:
    """How a session stands: what a route depends on.

    ``origin`` is n's; ``here`` is where the vehicle is, and its heading in degrees.
    """

    state: State
    next: str
    missing: frozenset[int]
    lasers: Sequence[LaserStand]
    origin: Place | None
    here: tuple[Place, float] | None


def answer(config: Config, stand: Stand, request: Mapping[str, Any]) -> dict[str, Any]:
    """Give what ROUTE is answered, but for the session.

    Raises Refused, where it is not known where the pole is or the request cannot be meant; RouteError.
    """
    vehicle, given = _vehicle(request), _given(request.get("pole"))
    lacks, why = _lacking(config, stand)
    both_ways = bool(lacks) and any(map(_wants_time, stand.lasers))
    if both_ways:
        why.append("the time offset cannot be told from x yet: forward and in reverse, at two speeds")
    found = _pole(stand, given)
    if not lacks or found is None:
        if lacks:
            raise Refused(
                "it is not known yet where the pole is",
                "drive past it once, or say where it is by --pole LAT,LON (degrees, of a map say)",
                Code.USAGE,
            )
        pole, laid = found[0] if found else None, Plan(())
        told: dict[str, Any] = {}
    else:
        pole, known, sigma_m = found
        laid = plan(
            lacks,
            config.routine.slice_deg,
            vehicle,
            pole_sigma_m=sigma_m,
            start=_start(stand, pole),
            both_ways=both_ways,
        )
        told = {"known": known, "sigma_m": round(sigma_m, 2)}
    if pole is not None:
        told |= dict(zip(("lat_deg", "lon_deg", "height_m"), pole, strict=True))
    return {
        "class": "ROUTE",
        "state": str(stand.state),
        "next": stand.next,
        "why": why,
        "pole": told or None,
        "vehicle": asdict(vehicle),
        "clearance_m": round(clearances_m(vehicle, told.get("sigma_m", 0.0))[0], 2),
        "length_m": round(laid.length_m, 1),
        "legs": _legs(laid.legs),
        "unseen": [{"laser": name, "slice": part} for name, part in laid.unseen],
        "left_out": laid.left_out,
    }


def to_draw(config: Config, stand: Stand) -> Sequence[Leg]:
    """Lay the same drive about the pole, wherever that is, for a vehicle as it is by default."""
    lacks, _ = _lacking(config, stand)
    _, _, sigma_m = _pole(stand, (0.0, 0.0, 0.0)) or (None, None, _GIVEN_SIGMA_M)
    both_ways = any(map(_wants_time, stand.lasers))
    return plan(lacks, config.routine.slice_deg, Vehicle(), pole_sigma_m=sigma_m, both_ways=both_ways).legs


def _lacking(config: Config, stand: Stand) -> tuple[list[Lack], list[str]]:
    """Say what each laser lacks, and in words."""
    if stand.state is State.ACCEPTED:
        return [], ["the session is accepted: nothing is missing"]
    lacks, why = [], []
    width, need = config.routine.slice_deg, config.routine
    for laser in stand.lasers:
        coverage = results.entry(laser.name, laser.setup, laser.result)["coverage"]
        slices = {
            part["slice"]: (
                max(0, need.min_passes - part["passes"]),
                max(1, need.min_pole_returns - part["pole_returns"]),
            )
            for part in coverage
            if part["slice"] in stand.missing and not part["done"]
        }
        if slices:
            why.append(f"{laser.name}: no or too few passes heading {headings(sorted(slices), width)}")
        lacks.append(Lack(_sensor(config, laser), slices))
    if why:
        return [lack for lack in lacks if lack.slices], why
    if any(laser.result is not None and laser.result.verdict.hopeless for laser in stand.lasers):
        return [], ["more of the same driving would not help: see the verdict's reasons"]
    # Nothing is missing, but not all is known well enough: every other heading, those with fewer passes
    counts = np.zeros(360 // width)
    for laser in stand.lasers:
        counts += [part.passes for part in laser.result.slices] if laser.result is not None else 0
    few = int(counts[1::2].sum() < counts[::2].sum())
    again = dict.fromkeys(range(few, len(counts), 2), (1, 1))
    why.append("more passes are needed, from all sides")
    return [Lack(lack.sensor, again) for lack in lacks], why


def _wants_time(laser: LaserStand) -> bool:
    return (
        laser.result is None
        or "time_s" not in laser.result.extras
        or "reverse" in results.weakest(laser.setup, laser.result.covariance).drive
    )


def _sensor(config: Config, laser: LaserStand) -> Sensor:
    of = next(one for one in config.lasers if one.name == laser.name)
    mount = _mount(laser)
    count = round(of.fov_deg / of.resolution_deg) + 1
    turns = ceil(float(beam_ages_s(of.fov_deg, of.resolution_deg, count).max()) / REVOLUTION_S)
    return Sensor(
        name=laser.name,
        mount=mount,
        fov_deg=of.fov_deg,
        resolution_deg=of.resolution_deg,
        pole_radius_m=config.pole.radius_m,
        pole_height_m=config.pole.height_m,
        ground_m=ground_of(mount, laser.passes),
        scans_hz=1 / (REVOLUTION_S * turns),
    )


def _mount(laser: LaserStand) -> Mount:
    """Give the mount as found, if it is one that can be."""
    if laser.result is None:
        return laser.setup.measured
    off = laser.result.mount.vector - laser.setup.measured.vector
    off[3:] = wrap(off[3:])
    most = laser.setup.criteria.max_shift_sigmas * laser.setup.measured_sigma.vector
    return laser.result.mount if (np.abs(off) <= most).all() else laser.setup.measured


def _pole(stand: Stand, given: Place | None) -> tuple[Place, str, float] | None:
    """Give where the pole is, how that is known, and how well (σ, m); what was seen is believed first."""
    seen: list[tuple[float, tuple[float, float]]] = []
    for laser in stand.lasers:
        if not laser.today or laser.result is None:
            continue
        sigma = laser.result.sigma
        sigma_m = hypot(max(sigma.x_m, sigma.y_m), _SEEN_FROM_M * radians(sigma.yaw_deg))
        seen.append((max(_LEAST_SIGMA_M, sigma_m), pole_at(_mount(laser), laser.today)))
    if seen and stand.origin is not None:
        sigma_m, (north, east) = min(seen)
        lat, lon, height = pymap3d.ned2geodetic(north, east, 0.0, *stand.origin)
        return (float(lat), float(lon), float(height)), "seen", sigma_m
    return None if given is None else (given, "given", _GIVEN_SIGMA_M)


def _start(stand: Stand, pole: Place) -> Pose | None:
    """Give where the vehicle is from the pole."""
    if stand.here is None:
        return None
    (lat, lon, _), heading_deg = stand.here
    north, east, _ = pymap3d.geodetic2ned(lat, lon, pole[2], *pole)
    return float(north), float(east), radians(heading_deg)


def _legs(legs: Sequence[Leg]) -> list[dict[str, Any]]:
    stride = max(1, ceil(sum(len(leg.points) for leg in legs) / _MOST_POINTS))
    return [
        {
            "leg": number,
            "kind": leg.kind,
            "direction": leg.direction,
            "speed_mps": round(leg.speed_mps, 2),
            "heading_deg": _point(leg.points[0])[2],
            "slice": leg.slice,
            "lasers": list(leg.lasers),
            "points": [_point(point) for point in _thinned(leg.points, stride)],
        }
        for number, leg in enumerate(legs, start=1)
    ]


def _thinned(points: Any, stride: int) -> Iterator[Any]:
    yield from points[:-1:stride]
    yield points[-1]


def _point(point: Any) -> list[float]:
    return [
        round(float(point[0]), 2),
        round(float(point[1]), 2),
        round(float(np.degrees(point[2])) % 360, 1) % 360,
    ]


def _vehicle(request: Mapping[str, Any]) -> Vehicle:
    values: dict[str, Any] = {}
    for name, (least, most, option) in _BOUNDS.items():
        value = request.get(name)
        if value is None:
            continue
        if not _is_number(value) or not least <= value <= most:
            raise Refused(
                f"{name} cannot be {value!r}", f"give {least:g} to {most:g} m, by {option}", Code.USAGE
            )
        values[name] = float(value)
    speeds = request.get("speeds_mps")
    if speeds is not None:
        least, most = _SPEEDS_MPS
        good = isinstance(speeds, list) and len(speeds) == 2
        if not good or not all(_is_number(one) and least <= one <= most for one in speeds):
            raise Refused(
                f"speeds_mps cannot be {speeds!r}",
                f"give a fast and a slow one, {least:g} to {most:g} m/s, as --speeds 3,1.5",
                Code.USAGE,
            )
        values["speeds_mps"] = max(speeds), min(speeds)
    return Vehicle(**values)


def _given(said: Any) -> Place | None:
    if said is None:
        return None
    if not isinstance(said, list) or len(said) != 2 or not all(map(_is_number, said)):
        raise Refused(f"{said!r} is no place", "give latitude and longitude in degrees", Code.USAGE)
    if abs(said[0]) > 90 or abs(said[1]) > 180:
        raise Refused(
            f"there is no latitude {said[0]:g}° and longitude {said[1]:g}°", "latitude first", Code.USAGE
        )
    return float(said[0]), float(said[1]), 0.0


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and isfinite(value)
