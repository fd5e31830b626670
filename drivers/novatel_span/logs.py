"""Frames to logs: what the receiver says, in named fields with units (sheet section 2).

Heights: ``height_ellipsoidal_m`` is above the WGS84 ellipsoid, ``height_msl_m`` above sea level, and
``height_msl_m + undulation_m`` is ellipsoidal again. Angles are NovAtel's: roll right side down, pitch nose
up, azimuth clockwise from north; with them `NED <- FRD` is Rz(azimuth) Ry(pitch) Rx(roll) (sheet section 4).
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from typing import Annotated, Any, Self

from polecal.drivers.novatel_span.enums import (
    AlignmentMode,
    ClockStatus,
    Component,
    Datum,
    ImuType,
    InsOffset,
    InsProfile,
    InsStatus,
    MessageId,
    OffsetFrame,
    OffsetSource,
    PositionType,
    RelativeOutput,
    SolutionStatus,
    StatusEvent,
    StatusWord,
    Switch,
    TimeStatus,
    UtcStatus,
)
from polecal.drivers.novatel_span.fields import (
    F32,
    F64,
    I32,
    LOGS,
    U8,
    U16,
    U32,
    X8,
    X32,
    Matrix33,
    Text4,
    Text12,
    Text16,
    Text32,
    Triple32,
    Wire,
    ascii_tokens,
    layout,
    log,
)
from polecal.drivers.novatel_span.framer import Frame, Kind

InsState = Annotated[InsStatus | int, Wire("I", InsStatus)]
Position = Annotated[PositionType | int, Wire("I", PositionType)]
Solution = Annotated[SolutionStatus | int, Wire("I", SolutionStatus)]
Clock = Annotated[ClockStatus | int, Wire("I", ClockStatus)]


class Log:
    """What every log can do."""

    __slots__ = ()

    @classmethod
    def parse(cls, frame: Frame) -> Self:
        """Read a frame of this log, binary or ASCII.

        Raises ValueError where the frame is of another log, or its body is not as the sheet says.
        """
        if frame.is_response or LOGS.get(frame.message_id or 0) is not cls:
            raise ValueError(f"a frame of {frame.name or frame.kind.value} is no {cls.__name__}")
        made: Self = _read(frame)
        return made


@log(
    MessageId.INSPVA,
    MessageId.INSPVAS,
    MessageId.IMURATEPVA,
    MessageId.IMURATEPVAS,
    MessageId.MARK1PVA,
)
class InsPva(Log):
    """Position, velocity, attitude of the IMU's centre (or of the user's offset from it)."""

    gps_week: U32
    gps_seconds_s: F64
    lat_deg: F64
    lon_deg: F64
    height_ellipsoidal_m: F64
    vel_north_mps: F64
    vel_east_mps: F64
    vel_up_mps: F64
    roll_deg: F64
    pitch_deg: F64
    azimuth_deg: F64
    ins_status: InsState


@log(MessageId.INSPVAX)
class InsPvax(Log):
    """As `InsPva`, with standard deviations; its time is the header's."""

    ins_status: InsState
    position_type: Position
    lat_deg: F64
    lon_deg: F64
    height_msl_m: F64
    undulation_m: F32
    vel_north_mps: F64
    vel_east_mps: F64
    vel_up_mps: F64
    roll_deg: F64
    pitch_deg: F64
    azimuth_deg: F64
    lat_sigma_m: F32
    lon_sigma_m: F32
    height_sigma_m: F32
    vel_north_sigma_mps: F32
    vel_east_sigma_mps: F32
    vel_up_sigma_mps: F32
    roll_sigma_deg: F32
    pitch_sigma_deg: F32
    azimuth_sigma_deg: F32
    extended_status: X32
    update_age_s: U16

    @property
    def height_ellipsoidal_m(self) -> float:
        """Height above the WGS84 ellipsoid."""
        return self.height_msl_m + self.undulation_m


@log(MessageId.INSATT, MessageId.INSATTS)
class InsAtt(Log):
    """Attitude."""

    gps_week: U32
    gps_seconds_s: F64
    roll_deg: F64
    pitch_deg: F64
    azimuth_deg: F64
    ins_status: InsState


@log(MessageId.INSATTX)
class InsAttx(Log):
    """Attitude with standard deviations; its time is the header's."""

    ins_status: InsState
    position_type: Position
    roll_deg: F64
    pitch_deg: F64
    azimuth_deg: F64
    roll_sigma_deg: F32
    pitch_sigma_deg: F32
    azimuth_sigma_deg: F32
    extended_status: X32
    update_age_s: U16


@log(MessageId.INSPOS, MessageId.INSPOSS)
class InsPos(Log):
    """Position."""

    gps_week: U32
    gps_seconds_s: F64
    lat_deg: F64
    lon_deg: F64
    height_ellipsoidal_m: F64
    ins_status: InsState


@log(MessageId.INSPOSX)
class InsPosx(Log):
    """Position with standard deviations; its time is the header's."""

    ins_status: InsState
    position_type: Position
    lat_deg: F64
    lon_deg: F64
    height_msl_m: F64
    undulation_m: F32
    lat_sigma_m: F32
    lon_sigma_m: F32
    height_sigma_m: F32
    extended_status: X32
    update_age_s: U16

    @property
    def height_ellipsoidal_m(self) -> float:
        """Height above the WGS84 ellipsoid."""
        return self.height_msl_m + self.undulation_m


@log(MessageId.INSVEL, MessageId.INSVELS)
class InsVel(Log):
    """Velocity."""

    gps_week: U32
    gps_seconds_s: F64
    vel_north_mps: F64
    vel_east_mps: F64
    vel_up_mps: F64
    ins_status: InsState


@log(MessageId.INSVELX)
class InsVelx(Log):
    """Velocity with standard deviations; its time is the header's."""

    ins_status: InsState
    position_type: Position
    vel_north_mps: F64
    vel_east_mps: F64
    vel_up_mps: F64
    vel_north_sigma_mps: F32
    vel_east_sigma_mps: F32
    vel_up_sigma_mps: F32
    extended_status: X32
    update_age_s: U16


@log(MessageId.INSSPD, MessageId.INSSPDS)
class InsSpd(Log):
    """Speed over ground and its course."""

    gps_week: U32
    gps_seconds_s: F64
    course_deg: F64
    horizontal_speed_mps: F64
    vel_up_mps: F64
    ins_status: InsState


@log(MessageId.INSCOV, MessageId.INSCOVS)
class InsCov(Log):
    """Covariances, 3x3 by rows: position, velocity in the local level; attitude as pitch, roll, azimuth."""

    gps_week: U32
    gps_seconds_s: F64
    position_cov_m2: Matrix33
    attitude_cov_deg2: Matrix33
    velocity_cov_m2ps2: Matrix33


@log(MessageId.INSSTDEV, MessageId.INSSTDEVS)
class InsStdev(Log):
    """Standard deviations of the inertial solution (OEM7)."""

    lat_sigma_m: F32
    lon_sigma_m: F32
    height_sigma_m: F32
    vel_north_sigma_mps: F32
    vel_east_sigma_mps: F32
    vel_up_sigma_mps: F32
    roll_sigma_deg: F32
    pitch_sigma_deg: F32
    azimuth_sigma_deg: F32
    extended_status: X32
    update_age_s: U16
    reserved1: U16
    enabled_updates: X32
    reserved2: U32


@log(
    MessageId.BESTPOS,
    MessageId.BESTGPSPOS,
    MessageId.BESTGNSSPOS,
    MessageId.PSRPOS,
    MessageId.RTKPOS,
    MessageId.PPPPOS,
)
class BestPos(Log):
    """Satellite position, of the antenna."""

    solution_status: Solution
    position_type: Position
    lat_deg: F64
    lon_deg: F64
    height_msl_m: F64
    undulation_m: F32
    datum: Annotated[Datum | int, Wire("I", Datum)]
    lat_sigma_m: F32
    lon_sigma_m: F32
    height_sigma_m: F32
    station_id: Text4
    differential_age_s: F32
    solution_age_s: F32
    satellites_tracked: U8
    satellites_used: U8
    satellites_l1: U8
    satellites_multi: U8
    reserved: X8
    extended_solution_status: X8
    galileo_beidou_mask: X8
    gps_glonass_mask: X8

    @property
    def height_ellipsoidal_m(self) -> float:
        """Height above the WGS84 ellipsoid."""
        return self.height_msl_m + self.undulation_m


@log(MessageId.BESTVEL)
class BestVel(Log):
    """Velocity over ground; by Doppler it is ``latency_s`` old."""

    solution_status: Solution
    velocity_type: Position
    latency_s: F32
    differential_age_s: F32
    horizontal_speed_mps: F64
    course_deg: F64
    vel_up_mps: F64
    reserved: F32


@log(MessageId.TIME)
class Time(Log):
    """The receiver's clock, and UTC: UTC = GPS time + utc_offset_s."""

    clock_status: Clock
    offset_s: F64
    offset_sigma_s: F64
    utc_offset_s: F64
    utc_year: U32
    utc_month: U8
    utc_day: U8
    utc_hour: U8
    utc_minute: U8
    utc_ms: U32
    utc_status: Annotated[UtcStatus | int, Wire("I", UtcStatus)]


@log(MessageId.TIMESYNC)
class TimeSync(Log):
    """GPS time of the last pulse per second."""

    gps_week: U32
    gps_ms: U32
    time_status: Annotated[TimeStatus | int, Wire("I", TimeStatus)]


@log(
    MessageId.MARKTIME,
    MessageId.MARK1TIME,
    MessageId.MARK2TIME,
    MessageId.MARK3TIME,
    MessageId.MARK4TIME,
)
class MarkTime(Log):
    """GPS time of an edge on an event input."""

    gps_week: I32
    gps_seconds_s: F64
    offset_s: F64
    offset_sigma_s: F64
    utc_offset_s: F64
    clock_status: Clock


@log()
class StatusItem:
    """One status word of `RxStatus`, and which of its bits make events."""

    status: X32
    priority_mask: X32
    set_mask: X32
    clear_mask: X32


@log(MessageId.RXSTATUS)
class RxStatus(Log):
    """The receiver's error word and status words (sheet 3.5)."""

    error: X32
    words: tuple[StatusItem, ...]


@log(MessageId.RXSTATUSEVENT)
class RxStatusEvent(Log):
    """A bit of a status word that changed."""

    word: Annotated[StatusWord | int, Wire("I", StatusWord)]
    bit: U32
    event: Annotated[StatusEvent | int, Wire("I", StatusEvent)]
    description: Text32


@log()
class VersionItem:
    """One component of `Version`."""

    component: Annotated[Component | int, Wire("I", Component)]
    model: Text16
    serial: Text16
    hardware: Text16
    software: Text16
    boot: Text16
    compile_date: Text12
    compile_time: Text12


@log(MessageId.VERSION)
class Version(Log):
    """What the receiver is made of."""

    components: tuple[VersionItem, ...]


@log()
class InsOffsetItem:
    """A translation (m) or rotation (deg) that the receiver was given, or found."""

    offset: Annotated[InsOffset | int, Wire("I", InsOffset)]
    frame: Annotated[OffsetFrame | int, Wire("I", OffsetFrame)]
    xyz: Triple32
    xyz_sigma: Triple32
    source: Annotated[OffsetSource | int, Wire("I", OffsetSource)]


@log(MessageId.INSCONFIG)
class InsConfig(Log):
    """How the inertial filter is set up: IMU, profile, lever arms, rotations."""

    imu_type: Annotated[ImuType | int, Wire("I", ImuType)]
    mapping: U8
    alignment_speed_dmps: U8
    heave_window_s: U16
    profile: Annotated[InsProfile | int, Wire("I", InsProfile)]
    enabled_updates: X32
    alignment_mode: Annotated[AlignmentMode | int, Wire("I", AlignmentMode)]
    relative_output: Annotated[RelativeOutput | int, Wire("I", RelativeOutput)]
    relative_from_master: Annotated[Switch | int, Wire("I", Switch)]
    ins_receiver_status: X32
    seed_enabled: U8
    seed_validation: U8
    reserved1: U16
    reserved2: U32
    reserved3: X32
    reserved4: U32
    reserved5: U32
    reserved6: U32
    reserved7: U32
    translations: tuple[InsOffsetItem, ...]
    rotations: tuple[InsOffsetItem, ...]


@log(MessageId.RAWIMU, MessageId.RAWIMUS)
class RawImu(Log):
    """One sample of the IMU, in counts of its own scale; Y is reversed on the wire."""

    gps_week: U32
    gps_seconds_s: F64
    imu_status: X32
    accel_z_counts: I32
    accel_minus_y_counts: I32
    accel_x_counts: I32
    gyro_z_counts: I32
    gyro_minus_y_counts: I32
    gyro_x_counts: I32


@log(MessageId.RAWIMUX, MessageId.RAWIMUSX)
class RawImux(Log):
    """As `RawImu`, and which IMU it is."""

    imu_info: X8
    imu_type: Annotated[ImuType | int, Wire("B", ImuType)]
    gps_week: U16
    gps_seconds_s: F64
    imu_status: X32
    accel_z_counts: I32
    accel_minus_y_counts: I32
    accel_x_counts: I32
    gyro_z_counts: I32
    gyro_minus_y_counts: I32
    gyro_x_counts: I32


@log(MessageId.CORRIMUDATA, MessageId.CORRIMUDATAS, MessageId.IMURATECORRIMUS)
class CorrImuData(Log):
    """Corrected increments of angle and velocity: x right (pitch), y forward (roll), z up (yaw)."""

    gps_week: U32
    gps_seconds_s: F64
    pitch_increment_rad: F64
    roll_increment_rad: F64
    yaw_increment_rad: F64
    lateral_increment_mps: F64
    longitudinal_increment_mps: F64
    vertical_increment_mps: F64


@log(MessageId.CORRIMUS)
class CorrImus(Log):
    """As `CorrImuData`, summed over ``samples`` of the IMU; its time is the header's."""

    samples: U32
    pitch_increment_rad: F64
    roll_increment_rad: F64
    yaw_increment_rad: F64
    lateral_increment_mps: F64
    longitudinal_increment_mps: F64
    vertical_increment_mps: F64
    latency_ms: F32
    reserved: U32


@log(MessageId.VEHICLEBODYROTATION)
class VehicleBodyRotation(Log):
    """Rotation from the vehicle to the SPAN frame (OEM6)."""

    x_deg: F64
    y_deg: F64
    z_deg: F64
    x_sigma_deg: F64
    y_sigma_deg: F64
    z_sigma_deg: F64


@log(MessageId.HEADING2)
class Heading2(Log):
    """Direction of the line between two antennas; not the vehicle's azimuth."""

    solution_status: Solution
    position_type: Position
    baseline_m: F32
    heading_deg: F32
    pitch_deg: F32
    reserved1: F32
    heading_sigma_deg: F32
    pitch_sigma_deg: F32
    rover_id: Text4
    master_id: Text4
    satellites_tracked: U8
    satellites_used: U8
    satellites_l1: U8
    satellites_multi: U8
    solution_source: X8
    extended_solution_status: X8
    galileo_beidou_mask: X8
    gps_glonass_mask: X8


@dataclass(frozen=True, slots=True)
class Response:
    """The answer to a binary command (sheet 1.6): 1 is OK; the text says what is wrong."""

    response_id: int
    text: str

    @property
    def ok(self) -> bool:
        """Whether the command was carried out."""
        return self.response_id == 1

    @classmethod
    def parse(cls, frame: Frame) -> Response:
        """Read a binary response. Raises ValueError where the frame is none."""
        if frame.kind is not Kind.BINARY or not frame.is_response or len(frame.body) < 4:
            raise ValueError("not a binary response")
        body = frame.body
        return cls(int.from_bytes(body[:4], "little"), body[4:].rstrip(b"\0").decode("ascii", "replace"))


def parse(frame: Frame) -> Any:
    """Return the frame's log or `Response`; None where there is no class for it or its body does not fit."""
    try:
        if frame.is_response:
            return Response.parse(frame)
        return _read(frame) if frame.message_id in LOGS else None
    except ValueError:
        return None


def _read(frame: Frame) -> Any:
    of = layout(LOGS[frame.message_id or 0])
    try:
        if frame.kind in (Kind.BINARY, Kind.SHORT_BINARY):
            return of.unpack(frame.body)[0]
        return of.scan(iter(ascii_tokens(frame.body)))
    except (struct.error, StopIteration, RuntimeError, OverflowError) as error:
        raise ValueError(f"a {frame.name} that is not as it should be: {error!r}") from error
