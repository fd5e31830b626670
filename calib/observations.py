"""What a calibration is made from: where the sensor is thought to sit, and the returns it gave."""

from __future__ import annotations

from dataclasses import astuple, dataclass, fields, replace
from enum import IntEnum
from typing import Self

import numpy as np
from numpy.typing import NDArray

from polecal import PolecalError
from polecal.calib.geometry import Array, rotation, rotation_rows

PARAMETERS = ("x", "y", "z", "roll", "pitch", "yaw")
"""The six unknowns, in the order of every vector and covariance (m and rad)."""
KEYS = ("x_m", "y_m", "z_m", "roll_deg", "pitch_deg", "yaw_deg")
"""The same as they are shown and written."""


class CalibrationError(PolecalError):
    """The returns cannot be calibrated from: too few, of one kind, or not finite."""


class Kind(IntEnum):
    """What a return came from."""

    POLE = 0
    GROUND = 1


@dataclass(frozen=True, slots=True)
class Mount:
    """The pose of the sensor on the body: origin in b (m), and Csb as roll, pitch, yaw (degrees)."""

    x_m: float
    y_m: float
    z_m: float
    roll_deg: float
    pitch_deg: float
    yaw_deg: float

    @classmethod
    def from_vector(cls, vector: Array) -> Self:
        """Take (6,) x, y, z in m and roll, pitch, yaw in rad; the angles are brought into ±180°."""
        degrees = (np.degrees(vector[3:]) + 180.0) % 360.0 - 180.0
        return cls(*(float(value) for value in (*vector[:3], *degrees)))

    @classmethod
    def of_variance(cls, variance: Array) -> Self:
        """Take the roots of variances (6,), m² and rad²: σ of a mount."""
        sigma = np.sqrt(variance)
        return cls(*(float(value) for value in (*sigma[:3], *np.degrees(sigma[3:]))))

    @property
    def vector(self) -> Array:
        """(6,) x, y, z in m and roll, pitch, yaw in rad."""
        angles_rad = np.radians((self.roll_deg, self.pitch_deg, self.yaw_deg))
        return np.array((self.x_m, self.y_m, self.z_m, *angles_rad), dtype=np.float64)

    @property
    def rotation(self) -> Array:
        """Csb, (3, 3): sensor to body."""
        return rotation(self.vector[3:])

    def as_dict(self) -> dict[str, float]:
        """Give the six values under the names of the configuration."""
        return dict(zip(KEYS, astuple(self), strict=True))


@dataclass(frozen=True, slots=True)
class Returns:
    """N returns of one sensor, each with the pose that the body had when its beam was fired.

    The last four, where they are known, say how that pose was changing: with them a constant time offset
    between laser and navigation can be told from the data.
    """

    range_m: Array
    """(N,) m."""
    bearing_rad: Array
    """(N,) rad, positive to the sensor's right (Eq. 1)."""
    position_m: Array
    """(N, 3) body origin in n, m."""
    rpy_rad: Array
    """(N, 3) roll, pitch, yaw of the body, rad."""
    kind: NDArray[np.uint8]
    """(N,) `Kind`."""
    pass_id: NDArray[np.int64]
    """(N,) which pass of the pole each belongs to."""
    velocity_mps: Array | None = None
    """(N, 3) of the body origin in n, m/s."""
    rate_radps: Array | None = None
    """(N, 3) angular velocity of the body, in b, rad/s."""
    acceleration_mps2: Array | None = None
    """(N, 3) of the body origin in n, m/s²."""
    angular_acceleration_radps2: Array | None = None
    """(N, 3) rate of change of the angular velocity, in b, rad/s²."""

    def __post_init__(self) -> None:
        """Refuse what are not arrays of numbers that fit together."""
        for part in fields(self):
            array = getattr(self, part.name)
            numbers = "iu" if part.name in ("kind", "pass_id") else "fiu"
            if array is not None and not (isinstance(array, np.ndarray) and array.dtype.kind in numbers):
                kinds = "whole numbers" if numbers == "iu" else "numbers"
                raise CalibrationError(f"{part.name} is not a NumPy array of {kinds}", "convert it first")
        n = len(np.atleast_1d(self.range_m))
        wanted = {
            "range_m": (n,),
            "bearing_rad": (n,),
            "position_m": (n, 3),
            "rpy_rad": (n, 3),
            "kind": (n,),
            "pass_id": (n,),
            "velocity_mps": (n, 3),
            "rate_radps": (n, 3),
            "acceleration_mps2": (n, 3),
            "angular_acceleration_radps2": (n, 3),
        }
        for name, shape in wanted.items():
            array = getattr(self, name)
            if array is not None and np.shape(array) != shape:
                raise CalibrationError(f"{name} has shape {np.shape(array)}, not {shape}", "one row a return")
            if array is not None and not np.isfinite(array).all():
                raise CalibrationError(
                    f"{name} holds values that are not finite", "leave out beams without a range"
                )
        if ((self.kind != Kind.POLE) & (self.kind != Kind.GROUND)).any():
            raise CalibrationError(
                "kind holds values that are neither pole (0) nor ground (1)", "leave them out"
            )

    def __len__(self) -> int:
        return len(self.range_m)

    def __getitem__(self, index: slice | NDArray[np.bool_] | NDArray[np.int64]) -> Returns:
        known = {part.name: getattr(self, part.name) for part in fields(self)}
        if isinstance(index, slice):
            return Returns(**{name: array[index] for name, array in known.items() if array is not None})
        rows = np.flatnonzero(index) if index.dtype == bool else index
        return Returns(**{name: array.take(rows, 0) for name, array in known.items() if array is not None})

    @property
    def motion(self) -> tuple[Array, Array, Array, Array] | None:
        """Velocity, rate, acceleration and angular acceleration, or None if one is not known."""
        v, w, a, alpha = (
            self.velocity_mps,
            self.rate_radps,
            self.acceleration_mps2,
            self.angular_acceleration_radps2,
        )
        return None if v is None or w is None or a is None or alpha is None else (v, w, a, alpha)


def points_body(range_m: Array, bearing_rad: Array, mount: Mount) -> Array:
    """Give (N, 3) returns in b, m: Eq. 1 through the mount."""
    flat = np.stack([range_m * np.cos(bearing_rad), range_m * np.sin(bearing_rad)], axis=-1)
    return flat @ mount.rotation[:, :2].T + mount.vector[:3]


def points_nav(returns: Returns, mount: Mount) -> Array:
    """Give (N, 3) returns in n, m: Eq. 2."""
    x, y, z = points_body(returns.range_m, returns.bearing_rad, mount).T
    turned = [row[0] * x + row[1] * y + row[2] * z for row in rotation_rows(returns.rpy_rad)]
    return np.stack(turned, axis=1) + returns.position_m


def cost(returns: Returns, mount: Mount, pole_radius_m: float = 0.0) -> float:
    """Give √c of Eq. 7 in m, from the cloud itself.

    With a pole radius each pole return is first moved along its beam to the pole's axis (`axis_shift_m`).
    A class without returns adds nothing. Raises CalibrationError where there are no returns.
    """
    if not len(returns):
        raise CalibrationError("there are no returns", "record a pass of the pole")
    pole = returns.kind == Kind.POLE
    shifted = returns.range_m + np.where(pole, axis_shift_m(pole_radius_m), 0.0)
    points = points_nav(replace(returns, range_m=shifted), mount)
    total = 0.0
    if pole.any():
        total += float(points[pole, 0].var() + points[pole, 1].var())  # Eq. 5
    if not pole.all():
        total += float(points[~pole, 2].var())  # Eq. 6
    return float(np.sqrt(total))  # Eq. 7


def axis_shift_m(pole_radius_m: float) -> float:
    """How far behind its return a pole's axis lies, on average over the beams that hit it.

    A beam that passes the axis at distance d meets the pole √(ρ² - d²) in front of it; over d even in ±ρ
    the mean is πρ/4. That is a level beam's; one that goes down by 8° has 1 % more way to go, which at a pole
    of 8 cm is 0.3 mm of range, and as it varies with the vehicle's tilt, 2 mm of z.
    """
    return np.pi / 4 * pole_radius_m
