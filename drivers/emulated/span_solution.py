"""What a SPAN receiver knows at an epoch, as the values that the layouts of `span_logs` name."""

from __future__ import annotations

import math
import struct
from collections.abc import Sequence
from dataclasses import dataclass, field
from datetime import datetime, timedelta

from polecal.drivers.emulated.span_enums import (
    AlignmentMode,
    Bool,
    ClockStatus,
    Datum,
    EventType,
    EventWord,
    InsStatus,
    Offset,
    OffsetFrame,
    PosType,
    Profile,
    RelIns,
    SolStatus,
    Source,
    TimeStatus,
    UtcStatus,
)
from polecal.drivers.emulated.span_frames import WEEK_MS, Stamp
from polecal.drivers.emulated.span_generations import OEM7, Generation, Version

GPS_EPOCH = datetime(1980, 1, 6)
UTC_OFFSET_S = -18.0
_UPDATES = 0x007FD1BF  # enabled, as captured
_UPDATED = 0x0F  # extended status: position, phase, ZUPT, wheel
_CONVERGED = 1 << 6

Triple = tuple[float, float, float]
ZERO: Triple = (0.0, 0.0, 0.0)
PLACEHOLDER: Triple = (-90.0, 0.0, -6356752.3142)
"""The pose of a receiver that has not aligned (section 10, item 2)."""
NO_SIGMA = (0.0,) * 9
COMPLETE_SIGMA = (1.2, 1.2, 1.5, 0.03, 0.03, 0.03, 0.07, 0.07, 8.0)
GOOD_SIGMA = (0.012, 0.012, 0.015, 0.01, 0.01, 0.01, 0.015, 0.015, 0.04)


@dataclass(frozen=True, slots=True)
class Setup:
    """How a receiver is mounted and set up: m and degrees; vehicle axes x right, y forward, z up."""

    generation: Generation = OEM7
    lever_arm: Triple = (0.1, -0.3, 0.6)
    """From the IMU to the antenna."""
    rotation: Triple = ZERO
    """What VEHICLEBODYROTATION set."""
    undulation: float = 22.5
    """Of the geoid above the ellipsoid."""


@dataclass(frozen=True, slots=True)
class Solution:
    """What the receiver knows at an epoch; degrees, m, m/s.

    ``position`` is latitude, longitude and height above the ellipsoid of the IMU; ``antenna`` likewise of
    the antenna. ``sigma`` has latitude, longitude, height in m; north, east, up in m/s; roll, pitch,
    azimuth in degrees. Inertial solutions are ``body_offset_s`` later than the header says.
    """

    stamp: Stamp
    position: Triple
    velocity: Triple
    """North, east, up."""
    attitude: Triple
    """Roll, pitch, azimuth."""
    antenna: Triple
    ins_status: InsStatus = InsStatus.INS_SOLUTION_GOOD
    sigma: tuple[float, ...] = GOOD_SIGMA
    body_offset_s: float = 0.0
    setup: Setup = field(default_factory=Setup)
    baseline: Triple = (1.2, 0.0, 0.0)
    """To the second antenna: length, heading and pitch."""
    increment: tuple[float, ...] = (0.0,) * 6
    """Of angle and velocity about and along x right, y forward, z up, as `Log.increments` says."""
    mark: tuple[int, float] = (0, 0.0)
    """An event's week and seconds."""
    event: tuple[EventWord, int, EventType, str] = (EventWord.STATUS, 0, EventType.CLEAR, "")

    @property
    def fine(self) -> bool:
        """Return whether the receiver knows the time."""
        return self.stamp.time_status == TimeStatus.FINESTEERING

    @property
    def good(self) -> bool:
        """Return whether the inertial solution is good."""
        return self.ins_status == InsStatus.INS_SOLUTION_GOOD

    # --- inertial logs

    @property
    def week(self) -> int:
        """Return the week of the inertial solution."""
        return self.stamp.week + math.floor((self.stamp.ms / 1000 + self.body_offset_s) / (WEEK_MS / 1000))

    @property
    def seconds(self) -> float:
        """Return the seconds of the week of the inertial solution."""
        return (self.stamp.ms / 1000 + self.body_offset_s) % (WEEK_MS / 1000)

    @property
    def position_msl(self) -> Triple:
        """Return the IMU's place with its height above the sea."""
        return self._above_sea(self.position)

    @property
    def ins_type(self) -> PosType:
        """Return the position type of INSPVAX."""
        if self.ins_status == InsStatus.INS_ALIGNMENT_COMPLETE:
            return PosType.INS_PSRSP
        return PosType.INS_RTKFIXED if self.good else PosType.NONE

    @property
    def extended(self) -> int:
        """Return the extended status (section 3.2)."""
        if self.good:
            return _UPDATED | _CONVERGED
        return _UPDATED if self.ins_status == InsStatus.INS_ALIGNMENT_COMPLETE else 0

    update_age = zero = 0
    updates = _UPDATES

    @property
    def sigma_attitude(self) -> tuple[float, ...]:
        """Return the deviations of roll, pitch, azimuth."""
        return self.sigma[6:]

    @property
    def cov_position(self) -> list[float]:
        """Return the matrix, row by row."""
        return _diagonal(self.sigma[:3])

    @property
    def cov_velocity(self) -> list[float]:
        """Return the matrix, row by row."""
        return _diagonal(self.sigma[3:6])

    @property
    def cov_attitude(self) -> list[float]:
        """Return the matrix, row by row: about x, y, z, which are pitch, roll, azimuth."""
        roll, pitch, azimuth = self.sigma[6:]
        return _diagonal((pitch, roll, azimuth))

    # --- the IMU

    imu_info = 0

    @property
    def imu_type(self) -> int:
        """Return the IMU's number."""
        return self.setup.generation.imu.kind

    @property
    def imu_status(self) -> int:
        """Return the IMU's own status word."""
        return self.setup.generation.imu.status

    @property
    def counts(self) -> tuple[int, ...]:
        """Return the increment as counts: accelerations z, −y, x, then angles z, −y, x."""
        imu = self.setup.generation.imu
        angle, velocity = self.increment[:3], self.increment[3:]
        signed = [(v[i] * sign, one) for v, one in ((velocity, imu.accel_mps), (angle, imu.gyro_rad))
                  for i, sign in ((2, 1), (1, -1), (0, 1))]  # fmt: skip
        return tuple(round(value / one) for value, one in signed)

    # --- satellites

    @property
    def sol_status(self) -> SolStatus:
        """Return whether there is a fix: there is one once there is time."""
        return SolStatus.SOL_COMPUTED if self.fine else SolStatus.INSUFFICIENT_OBS

    @property
    def gnss_type(self) -> PosType:
        """Return the position type without the inertial unit."""
        return PosType.NARROW_INT if self.fine else PosType.NONE

    @property
    def best_type(self) -> PosType:
        """Return the position type of BESTPOS."""
        return PosType.INS_RTKFIXED if self.good else self.gnss_type

    @property
    def antenna_msl(self) -> Triple:
        """Return the antenna's place with its height above the sea."""
        return self._above_sea(self.antenna) if self.fine else ZERO

    @property
    def undulation(self) -> float:
        """Return the geoid's height above the ellipsoid."""
        return self.setup.undulation

    datum = Datum.WGS84
    sigma_antenna = (0.012, 0.012, 0.015)
    station = "0001"
    ages = (1.0, 0.0)

    @property
    def satellites(self) -> tuple[int, ...]:
        """Return how many are tracked and used."""
        return (24, 21, 21, 19) if self.fine else (0,) * 4

    @property
    def signals(self) -> tuple[int, ...]:
        """Return the extended status and the masks of signals used."""
        return (0, 0, 0x15, 0x33) if self.fine else (0,) * 4

    sigma_baseline = (0.03, 0.06)

    @property
    def vel_type(self) -> PosType:
        """Return the velocity type."""
        return PosType.INS_RTKFIXED if self.good else PosType.DOPPLER_VELOCITY if self.fine else PosType.NONE

    @property
    def vel_latency(self) -> float:
        """Return by how much the velocity is late, s; inertial ones are not."""
        return 0.15 if self.vel_type == PosType.DOPPLER_VELOCITY else 0.0

    vel_age = 0.0

    @property
    def course(self) -> Triple:
        """Return horizontal speed, track over ground and vertical speed."""
        north, east, up = self.velocity
        return math.hypot(north, east), math.degrees(math.atan2(east, north)) % 360, up

    # --- time

    @property
    def clock(self) -> ClockStatus:
        """Return whether the clock model is valid."""
        return ClockStatus.VALID if self.fine else ClockStatus.INVALID

    @property
    def clock_offset(self) -> tuple[float, float]:
        """Return the clock's offset and its deviation, s."""
        return (-1.2e-9, 9.0e-10) if self.fine else (0.0, 3.33564e-4)

    @property
    def utc_offset(self) -> float:
        """Return UTC less GPS time, s."""
        return UTC_OFFSET_S if self.fine else 0.0

    @property
    def utc(self) -> tuple[int, ...]:
        """Return year, month, day, hour, minute and ms."""
        if not self.fine:
            return (0,) * 6
        utc = GPS_EPOCH + timedelta(weeks=self.gps_week, milliseconds=self.gps_ms, seconds=UTC_OFFSET_S)
        ms = utc.second * 1000 + utc.microsecond // 1000
        return utc.year, utc.month, utc.day, utc.hour, utc.minute, ms

    @property
    def utc_status(self) -> UtcStatus:
        """Return whether UTC is known."""
        return UtcStatus.VALID if self.fine else UtcStatus.INVALID

    @property
    def gps_week(self) -> int:
        """Return the epoch's week."""
        return self.stamp.week

    @property
    def gps_ms(self) -> int:
        """Return the epoch's ms of the week."""
        return self.stamp.ms

    @property
    def time_status(self) -> TimeStatus:
        """Return how well time is known."""
        return self.stamp.time_status

    # --- the receiver

    error = 0

    @property
    def words(self) -> list[tuple[int, int, int, int]]:
        """Return the status words, each with its masks: priority, set, clear."""
        return [(self.stamp.status, 0, 0, 0)] + [(0, 0, 0, 0)] * (self.setup.generation.status_words - 1)

    @property
    def versions(self) -> tuple[Version, ...]:
        """Return what VERSION lists."""
        return self.setup.generation.versions

    @property
    def rotation(self) -> Triple:
        """Return what VEHICLEBODYROTATION set."""
        return self.setup.rotation

    sigma_rotation = ZERO

    @property
    def config(self) -> tuple[int, ...]:
        """Return the head of INSCONFIG: orientation 5, aligns at 5 m/s."""
        imu = self.setup.generation.imu.kind
        return (
            imu, 5, 50, 20, Profile.LAND, _UPDATES, AlignmentMode.AUTOMATIC, RelIns.ROVER, Bool.FALSE, 0,
            0, 0, 20, *(0,) * 6,
        )  # fmt: skip

    @property
    def translations(self) -> list[tuple[float, ...]]:
        """Return INSCONFIG's: from the IMU to the antenna."""
        sigma = (0.01, 0.01, 0.01)
        return [(Offset.ANT1, OffsetFrame.IMUBODY, *self.setup.lever_arm, *sigma, Source.FROM_NVM)]

    @property
    def rotations(self) -> list[tuple[float, ...]]:
        """Return INSCONFIG's: from the IMU's axes to the vehicle's."""
        sigma = (3.0, 3.0, 3.0)
        return [(Offset.RBV, OffsetFrame.IMUBODY, *self.setup.rotation, *sigma, Source.FROM_COMMAND)]

    def _above_sea(self, place: Triple) -> Triple:
        lat, lon, height = place
        undulation: float = struct.unpack("<f", struct.pack("<f", self.undulation))[0]  # as logs can say it
        return lat, lon, height - undulation


def _diagonal(sigma: Sequence[float]) -> list[float]:
    a, b, c = sigma
    return [a * a, 0.0, 0.0, 0.0, b * b, 0.0, 0.0, 0.0, c * c]
