"""A laser's passes and result to what a report draws: clouds, residuals, and what each pass brought."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from polecal.calib.coverage import slice_of
from polecal.calib.estimate import Pass, Setup, estimate, split
from polecal.calib.geometry import Array, roll_pitch_yaw, rotation, rotation_gradient, wrap
from polecal.calib.observations import (
    PARAMETERS,
    CalibrationError,
    Kind,
    Mount,
    Returns,
    axis_shift_m,
    cost,
    points_nav,
)
from polecal.calib.solve import EXTRAS

_NEAR_M = 2.0  # of the pole: the ground that is drawn with it
_MOST_DRAWN = 6000
_STEPS = 12  # of the cost curve


@dataclass(frozen=True, slots=True)
class Seen:
    """One stored pass: when (host's ns), its returns, and whether and why not they were used."""

    id: int
    t_ns: tuple[int, int]
    returns: Returns
    site: int = 0
    why_not: str = ""


@dataclass(frozen=True, slots=True)
class Cloud:
    """Returns on and about the pole in n, m from the pole's axis and the ground's level, by one mount.

    ``points_m`` (N, 3) north, east, up; ``heading_rad`` (N,) of the platform, for pole returns; of the
    ground no heading is told.
    """

    points_m: Array
    heading_rad: Array
    ground_m: Array


@dataclass(frozen=True, slots=True)
class Residuals:
    """How far each return lies from the pole's axis, or the ground's plane: m, with what it may depend on."""

    offset_m: Array
    """(N, 2) along and across the beam of pole returns; (N, 1) down of ground returns."""
    slice: NDArray[np.int64]
    range_m: Array
    bearing_rad: Array


@dataclass(frozen=True, slots=True)
class Weight:
    """What a pass gave: how the mount moves (6,), m and rad, without it; None where that was not solved."""

    id: int
    start_s: float
    heading_rad: float
    speed_mps: float
    """Negative in reverse."""
    pole: int
    ground: int
    off_m: float
    """How far its mean on the pole is from the mean of all."""
    shift: Array | None
    why_not: str


@dataclass(frozen=True, slots=True)
class Evidence:
    """All that a report draws of one laser."""

    before: Cloud
    after: Cloud
    pole_before: Residuals
    pole_after: Residuals
    ground_before: Residuals
    ground_after: Residuals
    curve: tuple[tuple[int, int, float], ...]
    """Passes, returns, and √c on all of them (m) of the mount that so many passes give."""
    measured_cost_m: float
    weights: tuple[Weight, ...]


def gather(
    seen: Sequence[Seen], setup: Setup, found: Mount, held: Sequence[str], extras: Mapping[str, float]
) -> Evidence:
    """Work out a report's evidence from passes, and from the mount and extras that were found.

    Raises CalibrationError where no pass was used.
    """
    used = [one for one in seen if not one.why_not]
    if not used:
        raise CalibrationError("no pass was used", "drive past the pole")
    whole = _joined([one.returns for one in used])
    sites = np.concatenate([np.full(len(one.returns), one.site) for one in used])
    timed = moved(whole, extras)
    clouds, residuals = [], []
    for returns, mount, more in ((whole, setup.measured, {}), (timed, found, extras)):
        clouds.append(_cloud(returns, sites, mount, setup))
        residuals.append(
            [
                _residuals(returns, sites, mount, setup, kind=kind, extras=more)
                for kind in (Kind.POLE, Kind.GROUND)
            ]
        )
    fixed = replace(setup, hold=frozenset({*setup.hold, *held}), extras=frozenset(extras) & frozenset(EXTRAS))
    passes = [Pass.of(one.id, split(one.returns, setup.need.slice_deg), one.site) for one in used]
    counts = np.cumsum([len(one.returns) for one in used])
    return Evidence(
        before=clouds[0],
        after=clouds[1],
        pole_before=residuals[0][0],
        pole_after=residuals[1][0],
        ground_before=residuals[0][1],
        ground_after=residuals[1][1],
        curve=_curve(passes, counts, fixed, timed),
        measured_cost_m=cost(whole, setup.measured, setup.pole_radius_m),
        weights=_weights(seen, passes, fixed, residuals[1][0]),
    )


def moved(returns: Returns, extras: Mapping[str, float]) -> Returns:
    """Take a time offset and a range offset into the returns themselves."""
    late_s, motion = extras.get("time_s", 0.0), returns.motion
    pole = returns.kind == Kind.POLE
    returns = replace(returns, range_m=returns.range_m + np.where(pole, extras.get("range_m", 0.0), 0.0))
    if not late_s or motion is None:
        return returns
    velocity, rate, acceleration, angular = motion
    turn = Rotation.from_rotvec(late_s * rate + late_s**2 / 2 * angular).as_matrix()
    return replace(
        returns,
        position_m=returns.position_m + late_s * velocity + late_s**2 / 2 * acceleration,
        rpy_rad=roll_pitch_yaw(rotation(returns.rpy_rad) @ turn),
    )


def placed_to_m(covariance: Array, mount: Mount, range_m: float) -> Array:
    """Give σ (3,) of where a return at so many m on the laser's middle beam is placed in b: x, y, z, m."""
    jacobian = np.zeros((3, 6))
    jacobian[:, :3] = np.eye(3)
    jacobian[:, 3:] = range_m * rotation_gradient(mount.vector[3:])[:, :, 0].T
    sigma: Array = np.sqrt(np.diag(jacobian @ covariance @ jacobian.T))
    return sigma


def _joined(parts: Sequence[Returns]) -> Returns:
    known = [
        one.name for one in fields(Returns) if all(getattr(part, one.name) is not None for part in parts)
    ]
    return Returns(**{name: np.concatenate([getattr(part, name) for part in parts]) for name in known})


def _on_axis(returns: Returns, radius_m: float) -> Returns:
    pole = returns.kind == Kind.POLE
    return replace(returns, range_m=returns.range_m + np.where(pole, axis_shift_m(radius_m), 0.0))


def _centred(values: Array, sites: NDArray[np.int64], about: Array | None = None) -> Array:
    """Take off each site's mean of ``about``, which has the rows of ``values``."""
    about = values if about is None else about
    off = values.copy()
    for site in np.unique(sites):
        off[sites == site] -= about[sites == site].mean(axis=0)
    return off


def _cloud(returns: Returns, sites: NDArray[np.int64], mount: Mount, setup: Setup) -> Cloud:
    """Put a laser's returns around the pole, every site's on the same spot."""
    pole = returns.kind == Kind.POLE
    points = points_nav(returns, mount)
    axis = points_nav(_on_axis(returns, setup.pole_radius_m), mount)
    for site in np.unique(sites):
        here = sites == site
        points[here, :2] -= axis[here & pole, :2].mean(axis=0)
        ground = points[here & ~pole, 2]
        level_m = np.median(ground) if len(ground) else points[here & pole, 2].max()
        points[here, 2] = level_m - points[here, 2]
    near = ~pole & (np.abs(points[:, :2]).max(axis=1) < _NEAR_M)
    shown = _thinned(np.flatnonzero(pole))
    return Cloud(points[shown], returns.rpy_rad[shown, 2], points[_thinned(np.flatnonzero(near))])


def _thinned(index: NDArray[np.int64]) -> NDArray[np.int64]:
    """Keep at most so many, evenly; in a random order that is always the same, as later ones hide earlier."""
    chance = np.random.default_rng(0)
    kept: NDArray[np.int64] = chance.permutation(index)[:_MOST_DRAWN]
    return kept


def _residuals(
    returns: Returns,
    sites: NDArray[np.int64],
    mount: Mount,
    setup: Setup,
    *,
    kind: Kind,
    extras: Mapping[str, float],
) -> Residuals:
    some = np.flatnonzero(returns.kind == kind)
    if kind is Kind.GROUND:
        some = some[:: max(1, len(some) // 50_000)]
    part, sites = returns[some], sites[some]
    points = points_nav(_on_axis(part, setup.pole_radius_m), mount)
    if kind is Kind.POLE:
        lean = np.array([extras.get("lean_north", 0.0), extras.get("lean_east", 0.0)])
        flat = _centred(points[:, :2] + points[:, 2:] * lean, sites)
        sensor = part.position_m + rotation(part.rpy_rad) @ mount.vector[:3]
        beam = (points - sensor)[:, :2]
        beam /= np.maximum(np.linalg.norm(beam, axis=1, keepdims=True), 1e-9)
        along, across = (flat * beam).sum(axis=1), beam[:, 0] * flat[:, 1] - beam[:, 1] * flat[:, 0]
        offset = np.column_stack([along, across])
    else:
        slope = np.array([extras.get("slope_north", 0.0), extras.get("slope_east", 0.0), 1.0])
        offset = _centred(points @ slope[:, None], sites)
    slices = slice_of(part.rpy_rad[:, 2], setup.need.slice_deg)
    return Residuals(offset, slices, part.range_m, part.bearing_rad)


def _curve(
    passes: Sequence[Pass], counts: NDArray[np.int64], setup: Setup, timed: Returns
) -> tuple[tuple[int, int, float], ...]:
    """Calibrate on the first 1, 2, … passes, and cost each mount on all returns: Fig. 7."""
    steps = np.unique(np.linspace(1, len(passes), min(len(passes), _STEPS)).astype(int))
    curve = []
    for number in steps.tolist():
        try:
            mount = estimate(passes[:number], setup).mount
        except CalibrationError:
            continue
        cost_m = cost(timed, mount, setup.pole_radius_m)
        curve.append((number, int(counts[number - 1]), cost_m))
    return tuple(curve)


def _weights(
    seen: Sequence[Seen], passes: Sequence[Pass], setup: Setup, residuals: Residuals
) -> tuple[Weight, ...]:
    """Say of each pass what it gave, in the order of ``seen``; ``passes`` are the used ones."""
    whole = estimate(passes, setup)
    first_ns = min(one.t_ns[0] for one in seen)
    weights, at = [], 0
    for one in seen:
        pole = one.returns.kind == Kind.POLE
        count = int(np.count_nonzero(pole))
        yaw = one.returns.rpy_rad[pole if count else slice(None), 2]
        heading = float(np.arctan2(np.sin(yaw).mean(), np.cos(yaw).mean()))
        off_m = np.nan
        if not one.why_not:
            off_m = (
                float(np.linalg.norm(residuals.offset_m[at : at + count].mean(axis=0))) if count else np.nan
            )
            at += count
        weights.append(
            Weight(
                id=one.id,
                start_s=(one.t_ns[0] - first_ns) / 1e9,
                heading_rad=heading,
                speed_mps=_speed(one.returns),
                pole=count,
                ground=len(one.returns) - count,
                off_m=off_m,
                shift=_shift(whole.left_out.get(one.id), whole.mount),
                why_not=one.why_not,
            )
        )
    return tuple(weights)


def _shift(left_out: Array | None, mount: Mount) -> Array | None:
    if left_out is None:
        return None
    shift = left_out - mount.vector
    shift[3:] = wrap(shift[3:])
    return shift


def _speed(returns: Returns) -> float:
    """Give the mean speed along the body's x; NaN where motion is not known."""
    if returns.velocity_mps is None:
        return float("nan")
    yaw = returns.rpy_rad[:, 2]
    return float((returns.velocity_mps[:, 0] * np.cos(yaw) + returns.velocity_mps[:, 1] * np.sin(yaw)).mean())


def largest(shift: Array, sigma: Array, held: Sequence[str]) -> tuple[str, float]:
    """Give the unknown that a pass moves most, and by how many of its σ."""
    free = np.array([name not in held for name in PARAMETERS])
    size = np.abs(shift) / np.where(sigma > 0, sigma, np.inf) * free
    worst = int(np.argmax(size))
    return PARAMETERS[worst], float(size[worst])
