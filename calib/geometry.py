"""Rotations between the paper's frames: n (north, east, down), b and s (forward, right, down).

Euler order yaw, pitch, roll: ``C = Rz(yaw) Ry(pitch) Rx(roll)``, from the turned frame to the fixed one.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def rotation(rpy_rad: Array) -> Array:
    """Give C = Rz(yaw) Ry(pitch) Rx(roll), (..., 3, 3), of (..., 3) roll, pitch, yaw in rad."""
    if rpy_rad.ndim == 1:  # each solution asks a thousand times for one: a quarter of the time
        angles = rpy_rad.tolist()
        turns = [math.cos(angle) for angle in angles], [math.sin(angle) for angle in angles]
        return np.array([_row(axis, *turns) for axis in range(3)])
    return np.ascontiguousarray(np.moveaxis(rotation_rows(rpy_rad), (0, 1), (-2, -1)))


def rotation_rows(rpy_rad: Array, axes: Sequence[int] = (0, 1, 2)) -> Array:
    """Give some rows of `rotation`, (axes, 3, ...); the lowest alone takes no yaw, and half the time."""
    turning = [rpy_rad[..., angle] for angle in range(3 if min(axes) < 2 else 2)]
    turns = [np.cos(angle) for angle in turning], [np.sin(angle) for angle in turning]
    rows = np.empty((len(axes), 3, *rpy_rad.shape[:-1]))
    for row, axis in zip(rows, axes, strict=True):
        for entry, value in zip(row, _row(axis, *turns), strict=True):
            entry[...] = value
    return rows


def _row(axis: int, cosines: Sequence[Any], sines: Sequence[Any]) -> tuple[Any, Any, Any]:
    """Give a row of `rotation` of the cosines and sines of roll, pitch and yaw: numbers, or arrays."""
    cr, cp = cosines[:2]
    sr, sp = sines[:2]
    if axis == 2:
        return -sp, cp * sr, cp * cr
    along, across = (cosines[2], sines[2]) if axis == 0 else (sines[2], -cosines[2])
    return along * cp, along * sp * sr - across * cr, along * sp * cr + across * sr


def rotation_gradient(rpy_rad: Array) -> Array:
    """Give dC/d(roll, pitch, yaw), (3, 3, 3): the first index is the angle; for one (3,) triple in rad."""
    c, gradient = rotation(rpy_rad), np.zeros((3, 3, 3))
    cy, sy = math.cos(rpy_rad[2]), math.sin(rpy_rad[2])
    gradient[0, :, 1], gradient[0, :, 2] = c[:, 2], -c[:, 1]  # C [x]×
    gradient[1, 0], gradient[1, 1], gradient[1, 2] = cy * c[2], sy * c[2], -cy * c[0] - sy * c[1]
    gradient[2, 0], gradient[2, 1] = -c[1], c[0]  # [z]× C, as that is about the axis of pitch, yawed
    return gradient


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


def turning(vector_rad: Array) -> Array:
    """Give the rotations (..., 3, 3) about vectors (..., 3) by their lengths in rad (Rodrigues)."""
    angle_rad = np.linalg.norm(vector_rad, axis=-1)[..., None, None]
    across = skew(vector_rad)
    turned: Array = (
        np.eye(3)
        + np.sinc(angle_rad / np.pi) * across
        + np.sinc(angle_rad / (2 * np.pi)) ** 2 / 2 * (across @ across)
    )
    return turned


def quaternion_xyzw(matrix: Array) -> Array:
    """Give the quaternion (4,) of a rotation (3, 3); w is not negative."""
    # Each column of 4 q qᵀ is q but for its length; the longest has the most digits.
    products = np.empty((4, 4))
    products[:3, :3] = matrix + matrix.T + (1.0 - np.trace(matrix)) * np.eye(3)
    products[:3, 3] = products[3, :3] = (matrix.T - matrix)[[1, 2, 0], [2, 0, 1]]
    products[3, 3] = 1.0 + np.trace(matrix)
    column = products[:, int(np.argmax(np.diag(products)))]
    quaternion: Array = np.copysign(1.0, column[3]) * column / np.linalg.norm(column)
    return quaternion


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


def _icosahedral() -> Array:
    """Turn the 12 ways that also turn a tetrahedron, after each of the 5 about a corner at (0, 1, φ)."""
    cycled = np.stack([np.roll(np.eye(3), by, axis=0) for by in range(3)])
    halves = np.stack([np.diag(signs) for signs in ((1, 1, 1), (1, -1, -1), (-1, 1, -1), (-1, -1, 1))])
    corner = np.array([0.0, 1.0, (1 + math.sqrt(5)) / 2])
    fifths = turning(np.arange(5)[:, None] * (math.tau / 5) * corner / np.linalg.norm(corner))
    turns: Array = (cycled[:, None, None] @ halves[:, None] @ fifths).reshape(-1, 3, 3)
    return turns


ICOSAHEDRAL = _icosahedral()
"""The 60 rotations (60, 3, 3) that leave an icosahedron as it was: evenly spread over all rotations."""
