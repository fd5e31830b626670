"""What the returns seen can tell of the mount, unknown by unknown, and what to drive for what they cannot.

A return in n moves with each unknown (Eq. 9); an unknown can be found only where its returns move by
different amounts, as moving all of them alike changes no variance.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from polecal.calib.geometry import Array, rotation, rotation_gradient
from polecal.calib.observations import PARAMETERS, Kind, Mount, Returns

_AXES = {Kind.POLE: (0, 1), Kind.GROUND: (2,)}  # Eqs. 5 and 6
_WORDS = {
    "time_s": "the time offset",
    "range_m": "the range offset",
    "lean_north": "the pole's lean north",
    "lean_east": "the pole's lean east",
    "slope_north": "the ground's slope north",
    "slope_east": "the ground's slope east",
}
"""Of `solve.EXTRAS`, as an operator reads them; the six are called by their names."""
_SHARE = 0.35  # what has less of a direction than this, of its largest part, is not named in it
_NOTHING = 1e-9


@dataclass(frozen=True, slots=True)
class Direction:
    """A combination of unknowns, and how well the data tell it.

    ``sigma`` is in units of the hand measurement's: above 1 the data say less than the tape did.
    ``step`` (n,) is one σ along it, in m and rad (s, m).
    """

    sigma: float
    step: Array
    name: str
    drive: str
    """What would make it better known."""


_OTHER_WAY = "pass the pole heading the other way"
_UNEVEN = "drive over uneven ground, or tilt the vehicle: planks under the wheels of one side"
_DRIVES: tuple[tuple[set[str], set[str] | None, str], ...] = (
    ({"time_s"}, None, "pass the pole in reverse, or at another speed"),
    ({"range_m"}, None, "pass the pole on both sides, near and far"),
    ({"lean_north"}, None, "pass the pole near and far, so that the laser meets it low and high"),
    ({"lean_east"}, None, "pass the pole near and far, so that the laser meets it low and high"),
    ({"slope_north"}, None, _OTHER_WAY),
    ({"slope_east"}, None, _OTHER_WAY),
    ({"z"}, {"z", "roll", "pitch"}, _UNEVEN),
    ({"z"}, {"x", "y", "z"}, f"{_OTHER_WAY}; {_UNEVEN}"),
    ({"roll", "yaw"}, {"roll", "yaw"}, "take one of the two as measured: they are the same turn"),
    (
        set(),
        {"roll", "pitch"},
        "tilt the laser so that it sees more of the ground, or take the measured values",
    ),
    (set(), {"x", "y"}, _OTHER_WAY),
    (set(), {"x", "y", "yaw"}, f"{_OTHER_WAY}, and on its other side, near and far"),
)
"""What a direction must have in it, what it may have in it, and the drive for it; the first that fits."""
_OTHERWISE = "pass the pole in other ways: from other sides, nearer and farther, over uneven ground"


def sensitivity(returns: Returns, mount: Mount) -> Array:
    """Give ∂p_n/∂(x, y, z, roll, pitch, yaw) of each return, (N, 3, 6): m per m and rad. Eqs. 10 to 12."""
    body = rotation(returns.rpy_rad)
    bearing = returns.bearing_rad
    flat = returns.range_m * np.stack([np.cos(bearing), np.sin(bearing)])  # Eq. 1
    turned = np.tensordot(flat.T, rotation_gradient(mount.vector[3:])[:, :, :2], axes=(1, 2))  # (N, angle, 3)
    return np.concatenate([body, body @ turned.transpose(0, 2, 1)], axis=2)


def information(returns: Returns, mount: Mount) -> Array:
    """Give how the variances of Eq. 7 curve with the unknowns at ``mount``, (6, 6): m² per m and rad.

    That is the covariance of the `sensitivity` over the returns, of north and east of the pole's and of
    down of the ground's: all that is the same for every return has dropped out.
    """
    moved = sensitivity(returns, mount)
    total = np.zeros((len(PARAMETERS), len(PARAMETERS)))
    for kind, axes in _AXES.items():
        of_kind = returns.kind == kind
        if of_kind.any():
            for axis in axes:
                total += np.cov(moved[of_kind, axis].T, bias=True)
    return total


def can_be_found(information: Array) -> NDArray[np.bool_]:
    """Say of each unknown whether the returns vary with it at all, were the others known: Tables I to III.

    ``information`` (n, n) as `information` gives it. Unknowns that vary, but only together, are for
    `weak_directions` to tell.
    """
    diagonal = np.diag(information)
    found: NDArray[np.bool_] = diagonal > _NOTHING * max(diagonal.max(initial=0.0), _NOTHING)
    return found


def weak_directions(information: Array, scale: Array, names: Sequence[str] = PARAMETERS) -> list[Direction]:
    """Give the combinations of unknowns that the data tell apart, the weakest first.

    Parameters
    ----------
    information
        (n, n) inverse of a covariance of the unknowns, in m and rad (s).
    scale
        (n,) what is known of each without the data, σ: the hand measurement's.
    names
        What they are, of `solve.UNKNOWNS`.
    """
    values, vectors = np.linalg.eigh(information * np.outer(scale, scale))
    directions = []
    for value, vector in zip(values, vectors.T, strict=True):
        size = np.abs(vector)
        parts = [name for name, part in zip(names, size, strict=True) if part > _SHARE * size.max()]
        sigma = float(1.0 / np.sqrt(max(value, _NOTHING**2)))
        step = sigma * scale * vector * np.sign(vector[size.argmax()])
        directions.append(Direction(sigma, step, _together(parts), _drive(set(parts))))
    return directions


def _together(parts: Sequence[str]) -> str:
    """Name a combination: z; roll and pitch together; x together with the time offset."""
    mount = _listed([name for name in parts if name not in _WORDS])
    extras = _listed([_WORDS[name] for name in parts if name in _WORDS])
    if mount and extras:
        return f"{mount} together with {extras}"
    return f"{mount or extras}{' together' * (len(parts) > 1)}"


def _listed(names: Sequence[str]) -> str:
    return " and ".join([", ".join(names[:-1]), names[-1]] if len(names) > 1 else names)


def _drive(parts: set[str]) -> str:
    for needed, allowed, drive in _DRIVES:
        if needed <= parts and (allowed is None or parts <= allowed):
            return drive
    return _OTHERWISE
