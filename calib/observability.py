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
_NAMES = (*PARAMETERS, "time offset", "range offset")
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


_FORWARD = "pass the pole heading the other way"
_UNEVEN = "drive over uneven ground, or tilt the vehicle: planks under the wheels of one side"
_SPEED = "pass the pole in reverse, or at another speed"
_LEVEL = "tilt the laser so that it sees more of the ground, or take the measured values"
_DRIVES: tuple[tuple[frozenset[str], frozenset[str], str], ...] = (
    (frozenset({"time offset"}), frozenset(_NAMES), _SPEED),
    (frozenset({"range offset"}), frozenset(_NAMES), "pass the pole on both sides, near and far"),
    (frozenset({"z"}), frozenset({"z", "roll", "pitch"}), _UNEVEN),
    (frozenset({"z"}), frozenset({"x", "y", "z"}), f"{_FORWARD}; {_UNEVEN}"),
    (
        frozenset({"roll", "yaw"}),
        frozenset({"roll", "yaw"}),
        "take one of the two as measured: they are one turn",
    ),
    (frozenset(), frozenset({"roll", "pitch"}), _LEVEL),
    (frozenset(), frozenset({"x", "y"}), _FORWARD),
    (frozenset(), frozenset({"x", "y", "yaw"}), f"{_FORWARD}, and on its other side, near and far"),
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


def weak_directions(information: Array, scale: Array) -> list[Direction]:
    """Give the combinations of unknowns that the data tell apart, the weakest first.

    Parameters
    ----------
    information
        (n, n) inverse of a covariance: of the six unknowns, or with the time offset (s) as the seventh and
        the range offset (m) as the eighth.
    scale
        (n,) what is known of each without the data, σ: the hand measurement's, in m and rad.
    """
    values, vectors = np.linalg.eigh(information * np.outer(scale, scale))
    directions = []
    for value, vector in zip(values, vectors.T, strict=True):
        largest = np.abs(vector).max()
        parts = [name for name, part in zip(_NAMES, vector, strict=False) if abs(part) > _SHARE * largest]
        sigma = float(1.0 / np.sqrt(max(value, _NOTHING**2)))
        step = sigma * scale * vector * np.sign(vector[np.argmax(np.abs(vector))])
        directions.append(Direction(sigma, step, _together(parts), _drive(frozenset(parts))))
    return directions


def _together(parts: Sequence[str]) -> str:
    """Name a combination: z; roll and pitch together; x together with the time offset."""
    plain = [name for name in parts if name in PARAMETERS]
    offsets = [f"the {name}" for name in parts if name not in PARAMETERS]
    names, others = (
        " and ".join([", ".join(some[:-1]), some[-1]]) if len(some) > 1 else "".join(some)
        for some in (plain, offsets)
    )
    if names and others:
        return f"{names} together with {others}"
    return f"{names} together" if len(plain) > 1 else names or others


def _drive(parts: frozenset[str]) -> str:
    for needed, allowed, drive in _DRIVES:
        if needed <= parts <= allowed:
            return drive
    return _OTHERWISE
