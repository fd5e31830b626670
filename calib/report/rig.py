"""A rig in numbers to the returns that it would give while driving past a pole, by geometry alone."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from polecal.calib.geometry import Array, rotation
from polecal.calib.observations import CalibrationError, Kind, Mount, Returns

_WAVES_M = (3.1, 7.9)  # wave lengths of uneven ground, as the vehicle feels it
_HEAVE_M = 0.03
_CURVATURE_PER_M = 0.02
_STEP_M = 1e-3
_FARTHEST_GROUND_M = 30.0


@dataclass(frozen=True, slots=True)
class Rig:
    """A vehicle with a laser, which passes a pole at n's origin on ground at z = 0, heading all ways in turn.

    Each pass has a navigation error of its own, the same for all its returns. Pole and ground are seen
    where the real laser would see them: at the bearings that it has, in its field of view, on the side
    of the pole that is turned to it.
    """

    mount: Mount
    passes: int = 48
    speeds_mps: tuple[float, ...] = (1.0,)
    """Of the passes in turn; where negative, the vehicle backs away from the pole, still facing it."""
    approach_m: tuple[float, float] = (9.0, 1.0)
    """From how far before the pole to how far."""
    aside_m: tuple[float, float] = (0.8, 2.0)
    tilt_deg: float = 2.0
    """What uneven ground tilts the vehicle by, in roll and pitch, root mean square."""
    body_height_m: float = 0.5
    pole_radius_m: float = 0.04
    pole_height_m: float = 2.4
    half_fov_deg: float = 50.0
    resolution_deg: float = 0.25
    scan_hz: float = 18.75
    range_sigma_m: float = 0.01
    range_step_m: float = 0.01
    rough_m: float = 0.01
    """Grass and stones: how much the ground's height scatters, σ."""
    position_sigma_m: tuple[float, float, float] = (0.01, 0.01, 0.015)
    rpy_sigma_deg: tuple[float, float, float] = (0.01, 0.01, 0.04)


@dataclass(frozen=True, slots=True)
class _Scans:
    """What is true at each of S scans."""

    number: NDArray[np.int64]
    position_m: Array
    rpy_rad: Array
    velocity_mps: Array
    rate_radps: Array
    acceleration_mps2: Array
    angular_acceleration_radps2: Array

    def sees(self, mount: Mount) -> tuple[Array, Array]:
        """Give the sensor's origin (S, 3) in n, and the first two columns of Cbn Csb, (S, 3, 2)."""
        body = rotation(self.rpy_rad)
        return self.position_m + body @ mount.vector[:3], body @ mount.rotation[:, :2]


def drive(rig: Rig, rng: np.random.Generator, pole_returns: int, ground_returns: int) -> Returns:
    """Give exactly so many returns of each kind, drawn evenly from all of a drive, in their order.

    Raises CalibrationError where it gives fewer.
    """
    scans = _scans(rig, rng)
    parts = [_pole(rig, scans), _ground(rig, scans, rng, ground_returns)]
    drawn = []
    for kind, (scan, bearing_rad, range_m), wanted in zip(
        Kind, parts, (pole_returns, ground_returns), strict=True
    ):
        if len(scan) < wanted:
            raise CalibrationError(
                f"the drive gives {len(scan)} {kind.name.lower()} returns, not {wanted}", "more passes"
            )
        some = np.sort(rng.choice(len(scan), wanted, replace=False))
        drawn.append((scan[some], bearing_rad[some], range_m[some], np.full(wanted, kind, np.uint8)))
    scan, bearing_rad, range_m, kinds = (np.concatenate(columns) for columns in zip(*drawn, strict=True))
    range_m = range_m + rig.range_sigma_m * rng.normal(size=len(range_m))
    if rig.range_step_m:
        range_m = np.round(range_m / rig.range_step_m) * rig.range_step_m
    off_m = np.array(rig.position_sigma_m) * rng.normal(size=(rig.passes, 3))
    off_rad = np.radians(rig.rpy_sigma_deg) * rng.normal(size=(rig.passes, 3))
    number = scans.number[scan]
    return Returns(
        range_m,
        bearing_rad,
        scans.position_m[scan] + off_m[number],
        scans.rpy_rad[scan] + off_rad[number],
        kinds,
        number,
        scans.velocity_mps[scan],
        scans.rate_radps[scan],
        scans.acceleration_mps2[scan],
        scans.angular_acceleration_radps2[scan],
    )


def drives(
    rig: Rig, mounts: Sequence[Mount], seed: int, pole_returns: int, ground_returns: int
) -> list[Returns]:
    """Give what `drive` does, of several lasers on one vehicle: one path, the same navigation errors."""
    rng = np.random.default_rng((seed, 1))
    off_m = np.array(rig.position_sigma_m) * rng.normal(size=(rig.passes, 3))
    off_rad = np.radians(rig.rpy_sigma_deg) * rng.normal(size=(rig.passes, 3))
    exact = replace(rig, position_sigma_m=(0.0, 0.0, 0.0), rpy_sigma_deg=(0.0, 0.0, 0.0))
    seen = []
    for mount in mounts:
        rng = np.random.default_rng(seed)  # which draws the path first
        returns = drive(replace(exact, mount=mount), rng, pole_returns, ground_returns)
        number = returns.pass_id
        position_m, rpy_rad = returns.position_m + off_m[number], returns.rpy_rad + off_rad[number]
        seen.append(replace(returns, position_m=position_m, rpy_rad=rpy_rad))
    return seen


def _scans(rig: Rig, rng: np.random.Generator) -> _Scans:
    parts = []
    for number in range(rig.passes):
        speed = rig.speeds_mps[number % len(rig.speeds_mps)]
        step = speed / rig.scan_hz
        first, last = (-far for far in rig.approach_m[:: 1 if speed > 0 else -1])
        path = _Path(
            toward_rad=2 * np.pi * (number + rng.random()) / rig.passes,
            aside_m=rng.uniform(*rig.aside_m) * rng.choice([-1, 1]),
            curvature_per_m=_CURVATURE_PER_M * rng.uniform(-1, 1),
            phases_rad=rng.uniform(0, 2 * np.pi, (3, len(_WAVES_M))),
        )
        parts.append(_motion(rig, path, np.arange(first + step * rng.random(), last, step), speed, number))
    return _Scans(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))


@dataclass(frozen=True, slots=True)
class _Path:
    """An arc past the pole, its nearest point to the pole at s = 0."""

    toward_rad: float
    aside_m: float
    curvature_per_m: float
    phases_rad: Array

    def at(self, rig: Rig, s_m: Array) -> tuple[Array, Array]:
        """Give body position (S, 3) and roll, pitch, yaw (S, 3) at so many m along the path."""
        half = self.curvature_per_m * s_m / 2
        chord = s_m * np.sinc(half / np.pi)
        waves = 2 * np.pi * s_m[:, None, None] / np.array(_WAVES_M) + self.phases_rad
        roll, pitch, heave = np.sin(waves).sum(axis=2).T  # of variance 1
        position = [
            chord * np.cos(self.toward_rad + half) - self.aside_m * np.sin(self.toward_rad),
            chord * np.sin(self.toward_rad + half) + self.aside_m * np.cos(self.toward_rad),
            _HEAVE_M * heave - rig.body_height_m,
        ]
        tilt = np.radians(rig.tilt_deg)
        return np.column_stack(position), np.column_stack(
            [tilt * roll, tilt * pitch, self.toward_rad + 2 * half]
        )


def _motion(rig: Rig, path: _Path, s_m: Array, speed_mps: float, number: int) -> tuple[Array, ...]:
    """Give the columns of `_Scans`, derivatives by differences along the path."""
    poses = [path.at(rig, s_m + step) for step in (-_STEP_M, 0.0, _STEP_M)]
    position, turned = (np.stack(of) for of in ([p for p, _ in poses], [rotation(rpy) for _, rpy in poses]))
    per_s = speed_mps / _STEP_M
    in_body = turned[1].transpose(0, 2, 1)

    def first(of: Array) -> Array:
        difference: Array = per_s / 2 * (of[2] - of[0])
        return difference

    def second(of: Array) -> Array:
        difference: Array = per_s**2 * (of[2] - 2 * of[1] + of[0])
        return difference

    return (
        np.full(len(s_m), number),
        position[1],
        poses[1][1],
        first(position),
        _axial(in_body @ first(turned)),  # Ċ = C [ω]
        second(position),
        _axial(in_body @ second(turned)),  # C̈ = C ([ω]² + [α]), the square symmetric
    )


def _axial(matrix: Array) -> Array:
    """Give the vector (S, 3) of the skew part of (S, 3, 3)."""
    skewed = (matrix - matrix.transpose(0, 2, 1)) / 2
    return np.column_stack([skewed[:, 2, 1], skewed[:, 0, 2], skewed[:, 1, 0]])


def _pole(rig: Rig, scans: _Scans) -> tuple[NDArray[np.int64], Array, Array]:
    """Give scan, bearing and true range of every beam that meets the pole, where all of it is in view."""
    origin, columns = scans.sees(rig.mount)
    to_axis = -origin[:, :2]
    ahead, right = (_cross(columns[:, :2, axis], to_axis) for axis in range(2))
    middle = np.arctan2(-ahead, right)  # the beam whose track on the ground goes through the axis
    behind = np.einsum("si,si->s", _along(columns, middle)[:, :2], to_axis) < 0
    middle = np.where(behind, middle + np.pi, middle)
    middle = (middle + np.pi) % (2 * np.pi) - np.pi
    step, half = np.radians(rig.resolution_deg), np.radians(rig.half_fov_deg)
    distance = np.linalg.norm(to_axis, axis=1)
    near = int(np.ceil(1.5 * rig.pole_radius_m / distance.min() / step)) + 1
    beam = np.round((half - middle) / step)[:, None] + np.arange(-near, near + 1)  # (S, beams)
    scan = np.repeat(np.arange(len(origin)), beam.shape[1])
    bearing = half - step * beam.ravel()
    ray = _along(columns[scan], bearing)
    flat = np.linalg.norm(ray[:, :2], axis=1)
    miss = _cross(ray[:, :2], to_axis[scan]) / flat
    closest = np.einsum("ni,ni->n", ray[:, :2], to_axis[scan]) / flat
    chord = np.sqrt(np.maximum(rig.pole_radius_m**2 - miss**2, 0.0))
    range_m = (closest - chord) / flat
    up = -(origin[scan, 2] + range_m * ray[:, 2])
    hit = np.abs(miss) < rig.pole_radius_m
    hit &= (range_m > 0) & (up > 0) & (up < rig.pole_height_m)
    cut = np.zeros(len(origin), dtype=bool)  # half a pole is not seen where the whole one is
    cut[scan[hit & (np.abs(bearing) >= half - 1e-9)]] = True
    hit &= ~cut[scan]
    return scan[hit], bearing[hit], range_m[hit]


def _ground(
    rig: Rig, scans: _Scans, rng: np.random.Generator, wanted: int
) -> tuple[NDArray[np.int64], Array, Array]:
    """Give scan, bearing and true range of beams that meet the ground: somewhat more than are wanted."""
    origin, columns = scans.sees(rig.mount)
    beams = round(2 * rig.half_fov_deg / rig.resolution_deg) + 1
    every = len(origin) * beams
    drawn = np.sort(rng.choice(every, min(every, 2 * wanted), replace=False, shuffle=False))
    scan, beam = np.divmod(drawn, beams)
    bearing = np.radians(rig.half_fov_deg - rig.resolution_deg * beam)
    down = _along(columns[scan], bearing)[:, 2]
    # how far is told by level ground: a bound on what is measured would keep the bumps and drop the hollows
    per_m = 1 / np.maximum(down, 1e-6)
    hit = (down > 0) & (-origin[scan, 2] * per_m < _FARTHEST_GROUND_M)
    range_m = (rig.rough_m * rng.normal(size=len(scan)) - origin[scan, 2]) * per_m
    hit &= range_m > 0
    return scan[hit], bearing[hit], range_m[hit]


def _along(columns: Array, bearing_rad: Array) -> Array:
    """Give the beams' directions in n, (N, 3)."""
    turned: Array = columns[:, :, 0] * np.cos(bearing_rad)[:, None]
    return turned + columns[:, :, 1] * np.sin(bearing_rad)[:, None]


def _cross(a: Array, b: Array) -> Array:
    crossed: Array = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
    return crossed
