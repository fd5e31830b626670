"""Rotations between the paper's frames: n (north, east, down), b and s (forward, right, down).

Euler order yaw, pitch, roll: ``C = Rz(yaw) Ry(pitch) Rx(roll)``, from the turned frame to the fixed one.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def rotation(rpy_rad: Array) -> Array:
    """Give C = Rz(yaw) Ry(pitch) Rx(roll), (..., 3, 3), of (..., 3) roll, pitch, yaw in rad."""
    if rpy_rad.ndim == 1:  # each solution asks a thousand times for one: a quarter of the time
        angles = rpy_rad.tolist()
        return np.array(_entries(map(math.cos, angles), map(math.sin, angles))).reshape(3, 3)
    return _matrices(rotation_entries(rpy_rad))


def rotation_entries(rpy_rad: Array) -> tuple[Array, ...]:
    """Give the nine entries (...) of `rotation`, row by row, each an array of its own."""
    return _entries(np.moveaxis(np.cos(rpy_rad), -1, 0), np.moveaxis(np.sin(rpy_rad), -1, 0))


def _entries(cosines: Iterable[Any], sines: Iterable[Any]) -> tuple[Any, ...]:
    """Give `rotation_entries` of the cosines and sines of roll, pitch and yaw: numbers, or arrays."""
    cr, cp, cy = cosines
    sr, sp, sy = sines
    return (
        *(cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr),
        *(sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr),
        *(-sp, cp * sr, cp * cr),
    )


def rotation_gradient(rpy_rad: Array) -> Array:
    """Give dC/d(roll, pitch, yaw), (3, 3, 3): the first index is the angle; for one (3,) triple in rad."""
    c = rotation(rpy_rad)
    pitched = np.array([-np.sin(rpy_rad[2]), np.cos(rpy_rad[2]), 0.0])  # the axis of pitch, yawed
    return np.stack([c @ _SPIN[0], skew(pitched) @ c, _SPIN[2] @ c])


def roll_pitch_yaw(matrix: Array) -> Array:
    """Give (..., 3) roll, pitch, yaw in rad of rotations (..., 3, 3); at pitch ±90° the roll is 0 or so."""
    return np.stack(
        [
            np.arctan2(matrix[..., 2, 1], matrix[..., 2, 2]),
            np.arcsin(np.clip(-matrix[..., 2, 0], -1.0, 1.0)),
            np.arctan2(matrix[..., 1, 0], matrix[..., 0, 0]),
        ],
        axis=-1,
    )


def skew(vector: Array) -> Array:
    """Give the matrix (..., 3, 3) that crosses with ``vector`` (..., 3) from the left."""
    x, y, z = vector[..., 0], vector[..., 1], vector[..., 2]
    o = np.zeros_like(x)
    return _matrices((o, -z, y, z, o, -x, -y, x, o))


def wrap(angle_rad: Array) -> Array:
    """Bring angles in rad into [-π, π)."""
    return (angle_rad + np.pi) % (2 * np.pi) - np.pi


def _matrices(entries: tuple[Array, ...]) -> Array:
    """Put nine arrays (...) together to matrices (..., 3, 3), row by row."""
    matrices = np.empty((*np.shape(entries[0]), 9))
    for index, entry in enumerate(entries):
        matrices[..., index] = entry
    return matrices.reshape(*np.shape(entries[0]), 3, 3)


_SPIN = skew(np.eye(3))
