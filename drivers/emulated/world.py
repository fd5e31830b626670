"""What the devices see: beams cast from a moving laser at a pole, the ground and a plate; navigation's view.

Frames of the paper: n is north, east, down in metres about the reference point; body and sensor are
forward, right, down; C = Rz(yaw) Ry(pitch) Rx(roll). World time is seconds since the motion began.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pymap3d
from numpy.typing import ArrayLike, NDArray

from polecal.drivers.emulated.drive import Drive, Floats, SampledTrajectory, Trajectory

__all__ = [
    "HAND_MEASURED",
    "REFERENCE",
    "MountPose",
    "NavError",
    "Reference",
    "Reflector",
    "SampledTrajectory",
    "Trajectory",
    "World",
    "demo_world",
]

MAX_RANGE_M = 80.0
_EDGE = 0.9  # of the pole's half width: further out the tape may not send enough back
_EDGE_ON = 1e-9  # a beam along a plate meets it nowhere near


@dataclass(frozen=True, slots=True)
class MountPose:
    """The sensor's pose on the body: m, degrees."""

    x_m: float = 0.0
    y_m: float = 0.0
    z_m: float = 0.0
    roll_deg: float = 0.0
    pitch_deg: float = 0.0
    yaw_deg: float = 0.0

    @property
    def offset_m(self) -> Floats:
        """Return the sensor's origin in the body frame, (3,) m."""
        return np.array([self.x_m, self.y_m, self.z_m])

    @property
    def matrix(self) -> Floats:
        """Return the rotation sensor to body, (3, 3)."""
        matrix: Floats = rotation(np.deg2rad([[self.roll_deg, self.pitch_deg, self.yaw_deg]]))[0]
        return matrix


HAND_MEASURED = MountPose(0.0, -0.35, -1.0, 0.0, -8.0, 0.0)
"""Where the demonstration's laser was measured to be (paper.md, Table IV)."""


@dataclass(frozen=True, slots=True)
class Reference:
    """The point on the earth that is the world's origin: degrees, m above the ellipsoid."""

    lat_deg: float
    lon_deg: float
    height_m: float


POLE_NE_M = (12.0, -7.0)
"""Where the demonstrations' pole stands."""

REFERENCE = Reference(-33.889, 151.193, 60.0)


@dataclass(frozen=True, slots=True)
class Reflector:
    """A vertical flat plate on the ground that sends light back from both sides: m, degrees from north."""

    north_m: float
    east_m: float
    facing_deg: float
    width_m: float = 0.3
    height_m: float = 1.2


class NavError:
    """An error of the navigation that is common to a pass, and blends into the next while the pole is far.

    Takes the moments of the passes (K,) s; draws for each one error of the given standard deviations.
    """

    SIGMA = np.array([0.012, 0.012, 0.015, *np.deg2rad([0.015, 0.015, 0.04])])
    """North, east, down in m; roll, pitch, azimuth in rad."""

    def __init__(self, pass_times_s: ArrayLike, seed: int, sigma: ArrayLike = SIGMA) -> None:
        times = np.sort(np.asarray(pass_times_s, np.float64))
        rng = np.random.default_rng([seed, 2])
        self.values = rng.normal(size=(len(times), 6)) * np.asarray(sigma)
        """(K, 6): the error in each pass, in the order of SIGMA."""
        self._middle_s = (times[1:] + times[:-1]) / 2
        self._half_s = np.minimum(1.0, np.diff(times) / 5)

    def at(self, t_s: Floats) -> Floats:
        """Return the errors (N, 6) at times (N,)."""
        u = np.clip((t_s[:, None] - self._middle_s) / self._half_s, -1.0, 1.0) / 2 + 0.5
        share = u * u * (3 - 2 * u)  # of each step between passes, how much is done
        return np.asarray(self.values[0] + share @ np.diff(self.values, axis=0))


class World:
    """A vehicle with a laser on level ground with a pole and reflecting plates.

    ``pole_ne_m`` is the place of the pole's axis; ``ground_z_m`` the ground's down coordinate. Ranges get a
    Gaussian noise. The motion begins at `start`; until then the vehicle stands where it will begin.
    """

    def __init__(
        self,
        trajectory: Trajectory,
        *,
        mount: MountPose,
        pole_ne_m: tuple[float, float],
        pole_radius_m: float = 0.04,
        pole_height_m: float = 2.4,
        ground_z_m: float = 0.0,
        reflectors: Sequence[Reflector] = (),
        range_noise_m: float = 0.01,
        reference: Reference = REFERENCE,
        nav_error: NavError | None = None,
        seed: int = 0,
    ) -> None:
        self.trajectory = trajectory
        self.mount = mount
        self.pole_ne_m = pole_ne_m
        self.pole_radius_m = pole_radius_m
        self.pole_height_m = pole_height_m
        self.ground_z_m = ground_z_m
        self.reflectors = tuple(reflectors)
        self.range_noise_m = range_noise_m
        self.reference = reference
        self.nav_error = nav_error
        self.start_ns: int | None = None
        self._seed = seed
        self._mount_matrix = mount.matrix
        self._mount_offset = mount.offset_m

    def start(self, t_ns: int) -> None:
        """Begin the motion at this moment, unless it has begun."""
        if self.start_ns is None:
            self.start_ns = t_ns

    def seconds(self, t_ns: ArrayLike) -> Floats:
        """Return world time in s of host moments in ns; 0 before the motion begins."""
        t = np.atleast_1d(np.asarray(t_ns, np.int64))
        if self.start_ns is None:
            return np.zeros(len(t))
        return np.asarray(np.maximum(t - self.start_ns, 0) * 1e-9)

    def range_scan(
        self, t_s: ArrayLike, bearing_rad: ArrayLike, key: int | None = None
    ) -> tuple[Floats, NDArray[np.int64]]:
        """Cast beams, each from the pose at its own time.

        Takes times (N,) s and bearings (N,) rad, positive to the right. Returns ranges (N,) m, inf where
        nothing sends light back within 80 m, and reflectivity levels (N,), 0 to 7. The noise depends on
        ``key`` alone (a revolution's number); without it, on the first beam's time.
        """
        t = np.atleast_1d(np.asarray(t_s, np.float64))
        bearing = np.atleast_1d(np.asarray(bearing_rad, np.float64))
        rng = np.random.default_rng([self._seed, 3, round(t[0] * 1e9) if key is None else key])
        position, rpy, _ = self.trajectory.pose(t)
        body = rotation(rpy)
        origin = position + body @ self._mount_offset
        in_body = np.column_stack([np.cos(bearing), np.sin(bearing)]) @ self._mount_matrix[:, :2].T
        ray = np.einsum("nij,nj->ni", body, in_body)  # Eq. 2 of a return at 1 m

        range_m = self._ground(origin, ray)
        level = (rng.random(len(t)) < 0.1).astype(np.int64)
        bright = np.where(rng.random(len(t)) < 0.7, 7, 6)
        pole_m, across = self._pole(origin, ray)
        dim = (across > _EDGE) & (rng.random(len(t)) < 0.5)
        nearer = pole_m < range_m
        level = np.where(nearer, np.where(dim, rng.integers(0, 6, len(t)), bright), level)
        range_m = np.minimum(range_m, pole_m)
        for plate in self.reflectors:
            plate_m = self._plate(plate, origin, ray)
            level = np.where(plate_m < range_m, bright, level)
            range_m = np.minimum(range_m, plate_m)
        seen = range_m <= MAX_RANGE_M
        range_m = np.where(seen, range_m + rng.normal(0.0, self.range_noise_m, len(t)), np.inf)
        return range_m, np.where(seen, level, 0)

    def nav(self, t_s: ArrayLike) -> tuple[Floats, Floats, Floats]:
        """Return position, roll pitch yaw and velocity as navigation reports them, shaped as `Trajectory`."""
        t = np.atleast_1d(np.asarray(t_s, np.float64))
        position, rpy, velocity = self.trajectory.pose(t)
        if self.nav_error is not None:
            error = self.nav_error.at(t)
            position, rpy = position + error[:, :3], rpy + error[:, 3:]
        return position, rpy, velocity

    def geodetic(self, position_m: Floats) -> tuple[Floats, Floats, Floats]:
        """Return latitude and longitude in degrees and height above the ellipsoid in m of (N, 3) m."""
        at = self.reference
        lat, lon, height = pymap3d.ned2geodetic(*position_m.T, at.lat_deg, at.lon_deg, at.height_m)
        return np.asarray(lat), np.asarray(lon), np.asarray(height)

    def local(self, lat_deg: ArrayLike, lon_deg: ArrayLike) -> Floats:
        """Return north and east (N, 2) m of latitudes and longitudes (N,) in degrees."""
        at = self.reference
        lat, lon = np.asarray(lat_deg, np.float64), np.asarray(lon_deg, np.float64)
        north, east, _ = pymap3d.geodetic2ned(lat, lon, at.height_m, at.lat_deg, at.lon_deg, at.height_m)
        return np.column_stack([north, east])

    def _ground(self, origin: Floats, ray: Floats) -> Floats:
        with np.errstate(divide="ignore", invalid="ignore"):
            range_m = (self.ground_z_m - origin[:, 2]) / ray[:, 2]
        return np.where((ray[:, 2] > 0) & (range_m > 0), range_m, np.inf)

    def _pole(self, origin: Floats, ray: Floats) -> tuple[Floats, Floats]:
        """Return ranges to the pole, inf where missed, and how far off its axis (1 at its edge)."""
        to_pole = np.array(self.pole_ne_m) - origin[:, :2]
        level_m = np.hypot(ray[:, 0], ray[:, 1])  # horizontal way for 1 m of range
        unit = ray[:, :2] / level_m[:, None]
        ahead = np.sum(to_pole * unit, axis=1)
        across = np.abs(unit[:, 0] * to_pole[:, 1] - unit[:, 1] * to_pole[:, 0]) / self.pole_radius_m
        depth = self.pole_radius_m * np.sqrt(np.maximum(1 - across**2, 0.0))
        range_m = (ahead - depth) / level_m
        z = origin[:, 2] + range_m * ray[:, 2]
        hit = (
            (across < 1)
            & (range_m > 0)
            & (z <= self.ground_z_m)
            & (z >= self.ground_z_m - self.pole_height_m)
        )
        return np.where(hit, range_m, np.inf), across

    def _plate(self, plate: Reflector, origin: Floats, ray: Floats) -> Floats:
        facing = np.deg2rad(plate.facing_deg)
        normal, along = (
            np.array([np.cos(facing), np.sin(facing)]),
            np.array([-np.sin(facing), np.cos(facing)]),
        )
        centre = np.array([plate.north_m, plate.east_m])
        towards = ray[:, :2] @ normal
        towards = np.where(np.abs(towards) < _EDGE_ON, _EDGE_ON, towards)
        range_m = ((centre - origin[:, :2]) @ normal) / towards
        point = origin + range_m[:, None] * ray
        height = self.ground_z_m - point[:, 2]
        hit = (range_m > 0) & (height >= 0) & (height <= plate.height_m)
        hit &= np.abs((point[:, :2] - centre) @ along) <= plate.width_m / 2
        return np.where(hit, range_m, np.inf)


def rotation(rpy_rad: ArrayLike) -> Floats:
    """Return Rz(yaw) Ry(pitch) Rx(roll), (N, 3, 3), of roll, pitch, yaw (N, 3) rad."""
    roll, pitch, yaw = np.asarray(rpy_rad, np.float64).T
    cr, sr, cp, sp, cy, sy = (
        np.cos(roll), np.sin(roll), np.cos(pitch), np.sin(pitch), np.cos(yaw), np.sin(yaw)
    )  # fmt: skip
    out = np.empty((len(roll), 3, 3))
    out[:, 0] = np.column_stack([cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr])
    out[:, 1] = np.column_stack([sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr])
    out[:, 2] = np.column_stack([-sp, cp * sr, cp * cr])
    return out


def off_by_hand(hand: MountPose, seed: int) -> MountPose:
    """Return where a laser truly is that was measured to be at ``hand``.

    The error has random signs: 1.5 to 2.5° of yaw, 0.6 to 1.2° of pitch, 0.5 to 1° of roll and 2 to 6 cm
    along each axis.
    """
    rng = np.random.default_rng([seed, 0])
    size = rng.uniform([0.02, 0.02, 0.02, 0.5, 0.6, 1.5], [0.06, 0.06, 0.06, 1.0, 1.2, 2.5])
    x, y, z, roll, pitch, yaw = (size * rng.choice([-1.0, 1.0], 6)).tolist()
    return MountPose(
        hand.x_m + x,
        hand.y_m + y,
        hand.z_m + z,
        hand.roll_deg + roll,
        hand.pitch_deg + pitch,
        hand.yaw_deg + yaw,
    )


def steered_world(vehicle: Trajectory, seed: int = 0, hand: MountPose = HAND_MEASURED) -> World:
    """Return a world for a vehicle that is told where to drive, its laser measured to be at ``hand``.

    The navigation's error changes every 15 s, as nobody knows when passes will be. A reflecting plate
    stands 17 m from the pole.
    """
    north, east = POLE_NE_M
    return World(
        vehicle,
        mount=off_by_hand(hand, seed),
        pole_ne_m=POLE_NE_M,
        reflectors=(Reflector(north + 17.0, east + 3.0, 190.0),),
        nav_error=NavError(np.arange(0.0, 3600.0, 15.0), seed),
        seed=seed,
    )


def demo_world(seed: int = 0) -> World:
    """Return the demonstration's world: a laser not quite where it was measured to be (`off_by_hand`).

    A reflecting plate stands about 6 m from the pole.
    """
    mount = off_by_hand(HAND_MEASURED, seed)
    pole = POLE_NE_M
    drive = Drive(pole_ne_m=pole, seed=seed)
    return World(
        drive,
        mount=mount,
        pole_ne_m=pole,
        reflectors=(_clear_of(drive, pole),),
        nav_error=NavError(drive.pass_times_s, seed),
        seed=seed,
    )


def _clear_of(drive: Drive, pole: tuple[float, float]) -> Reflector:
    """Return a plate that faces the pole from 5 to 7 m, where the vehicle keeps furthest from it."""
    distance, bearing = (
        grid.ravel()
        for grid in np.meshgrid(np.linspace(5.2, 6.8, 9), np.linspace(0, 2 * np.pi, 180, endpoint=False))
    )
    places = np.column_stack([pole[0] + distance * np.cos(bearing), pole[1] + distance * np.sin(bearing)])
    away = np.min(np.linalg.norm(places[:, None] - drive.path(), axis=2), axis=1)
    best = int(np.argmax(away))
    return Reflector(float(places[best, 0]), float(places[best, 1]), float(np.rad2deg(bearing[best])))
