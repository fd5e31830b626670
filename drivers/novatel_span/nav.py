"""Pose logs to navigation states: the one thing of the receiver that the pipeline takes."""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass
from typing import NamedTuple

from polecal.drivers.novatel_span.enums import (
    InsOffset,
    InsStatus,
    MessageId,
    OffsetFrame,
    PositionType,
    SolutionStatus,
    named,
)
from polecal.drivers.novatel_span.fields import layout
from polecal.drivers.novatel_span.framer import BINARY_KINDS, Frame
from polecal.drivers.novatel_span.logs import (
    BestPos,
    InsConfig,
    InsCov,
    InsPva,
    InsPvax,
    InsStdev,
    parse,
)

WEEK_NS = 604_800 * 10**9
Triple = tuple[float, float, float]

_INSPVA = layout(InsPva)
_GOOD = InsStatus.INS_SOLUTION_GOOD

_PLAIN_LOGS: dict[int, str] = {
    message: message.name
    for message in (MessageId.INSPVA, MessageId.INSPVAS, MessageId.IMURATEPVA, MessageId.IMURATEPVAS)
}
POSE_LOGS = frozenset({*_PLAIN_LOGS, MessageId.INSPVAX})


class NavState(NamedTuple):  # of which there are hundreds in a second: made in a fifth of a dataclass's time
    """Where the body was, how it stood and moved, at one moment of GPS time.

    gps_ns: ns since 1980-01-06 (no leap seconds). height_m: above the ellipsoid, whichever log it came
    from. velocity_ned_mps: north, east, down. Angles in degrees: NED <- FRD is
    Rz(azimuth) Ry(pitch) Rx(roll). The sigmas are north, east, down and roll, pitch, azimuth; None where
    the log has none. The point is the IMU's centre of navigation, or the offset from it that the receiver
    was given (sheet section 4).
    """

    gps_ns: int
    lat_deg: float
    lon_deg: float
    height_m: float
    velocity_ned_mps: Triple
    roll_deg: float
    pitch_deg: float
    azimuth_deg: float
    ins_status: InsStatus | int
    position_type: PositionType | int | None
    position_sigma_m: Triple | None
    velocity_sigma_mps: Triple | None
    attitude_sigma_deg: Triple | None
    log: str

    @property
    def good(self) -> bool:
        """Whether the receiver calls it INS_SOLUTION_GOOD; nothing else may be used."""
        return self.ins_status == _GOOD


@dataclass(frozen=True, slots=True)
class Accuracy:
    """Standard deviations of the inertial solution: north, east, down; roll, pitch, azimuth.

    The velocity's from INSCOV are along other axes than INSPVAX's, though of the same sum (a capture).
    """

    position_m: Triple
    velocity_mps: Triple
    attitude_deg: Triple


def accuracy(said: object) -> Accuracy | None:
    """Return the standard deviations that a parsed log tells: INSPVAX, INSSTDEV(S), INSCOV(S); else None.

    What is no number there is infinitely uncertain.
    """
    values: tuple[float, ...]
    match said:
        case InsPvax() | InsStdev():
            values = (
                said.lat_sigma_m, said.lon_sigma_m, said.height_sigma_m,
                said.vel_north_sigma_mps, said.vel_east_sigma_mps, said.vel_up_sigma_mps,
                said.roll_sigma_deg, said.pitch_sigma_deg, said.azimuth_sigma_deg,
            )  # fmt: skip
        case InsCov():
            pitch2, roll2, azimuth2 = said.attitude_cov_deg2[::4]
            variances = (
                *said.position_cov_m2[::4], *said.velocity_cov_m2ps2[::4], roll2, pitch2, azimuth2,
            )  # fmt: skip
            values = tuple(math.sqrt(value) if value >= 0 else math.inf for value in variances)
        case _:
            return None
    n, e, d, vn, ve, vd, roll, pitch, azimuth = (
        value if math.isfinite(value) else math.inf for value in values
    )
    return Accuracy((n, e, d), (vn, ve, vd), (roll, pitch, azimuth))


def position_type(said: object) -> PositionType | int | None:
    """Return what a parsed log says that the position rests on: INSPVAX, or BESTPOS and its like."""
    if isinstance(said, BestPos) and said.solution_status != SolutionStatus.SOL_COMPUTED:
        return PositionType.NONE
    return said.position_type if isinstance(said, InsPvax | BestPos) else None


def gps_ns(week: int, seconds_s: float) -> int:
    """Return GPS time in ns since 1980-01-06."""
    return week * WEEK_NS + round(seconds_s * 1e9)


def nav_state(frame: Frame) -> NavState | None:
    """Return the navigation state of a pose log's frame, good or not; None for any other frame.

    A log with a value that is no number (infinite, NaN) is None too.

    The time is the body's own for INSPVA(S) and IMURATEPVA(S), whose header is rounded to the epoch, and
    the header's for INSPVAX, which has no other (sheet section 6). A receiver that sends a log to a virtual
    port as well sends each state twice: ask a `Deduplicator` first.
    """
    message = frame.message_id
    if message not in POSE_LOGS or frame.is_response:
        return None
    if frame.kind in BINARY_KINDS and message in _PLAIN_LOGS:
        return _plain_state(frame, _PLAIN_LOGS[message])
    pose = parse(frame)
    position_type = position_sigma_m = velocity_sigma_mps = attitude_sigma_deg = None
    if isinstance(pose, InsPva):
        week, seconds_s = pose.gps_week, pose.gps_seconds_s
    elif isinstance(pose, InsPvax):
        week, seconds_s = frame.week or 0, (frame.ms or 0) / 1000
        position_type = pose.position_type
        position_sigma_m = (pose.lat_sigma_m, pose.lon_sigma_m, pose.height_sigma_m)
        velocity_sigma_mps = (pose.vel_north_sigma_mps, pose.vel_east_sigma_mps, pose.vel_up_sigma_mps)
        attitude_sigma_deg = (pose.roll_sigma_deg, pose.pitch_sigma_deg, pose.azimuth_sigma_deg)
    else:
        return None
    velocity_ned_mps = (pose.vel_north_mps, pose.vel_east_mps, -pose.vel_up_mps)
    position = (pose.lat_deg, pose.lon_deg, pose.height_ellipsoidal_m)
    angles_deg = (pose.roll_deg, pose.pitch_deg, pose.azimuth_deg)
    sigmas = (position_sigma_m or ()) + (velocity_sigma_mps or ()) + (attitude_sigma_deg or ())
    if not math.isfinite(seconds_s + sum(position + velocity_ned_mps + angles_deg + sigmas)):
        return None
    return NavState(
        gps_ns(week, seconds_s),
        *position,
        velocity_ned_mps,
        *angles_deg,
        pose.ins_status,
        position_type,
        position_sigma_m,
        velocity_sigma_mps,
        attitude_sigma_deg,
        frame.name or "",
    )


def _plain_state(frame: Frame, log: str) -> NavState | None:
    """Do the same for what comes most, a binary INSPVA or its like, in a third of the time."""
    try:
        numbers = _INSPVA.numbers(frame.body)
    except struct.error:
        return None
    week, seconds_s, lat, lon, height, north, east, up, roll, pitch, azimuth, status = numbers
    if not math.isfinite(sum(numbers[1:-1])):
        return None
    return NavState(
        gps_ns(week, seconds_s), lat, lon, height, (north, east, -up), roll, pitch, azimuth,
        named(InsStatus, status), None, None, None, None, log,
    )  # fmt: skip


def reference_point(config: InsConfig | None) -> str:
    """Say which point of the vehicle pose logs speak of, from INSCONFIG where there is one (sheet section 4).

    The laser's offset must be measured from that point.
    """
    if config is None:
        return "the IMU's centre of navigation, unless an offset was set in the receiver (it does not say)"
    for item in config.translations:
        if item.offset == InsOffset.USER and any(item.xyz):
            xyz = ", ".join(f"{value:g}" for value in item.xyz)
            frame = item.frame.name if isinstance(item.frame, OffsetFrame) else item.frame
            return f"the user's point at ({xyz}) m from the IMU's centre of navigation, {frame} axes"
    return "the IMU's centre of navigation"


class Deduplicator:
    """Tells a log from its copy on a virtual port: same id, source, sequence and header time."""

    _REMEMBERED = 32  # frames of a line between a log and its copy: far fewer

    def __init__(self) -> None:
        self._seen: dict[tuple[int | None, ...], None] = {}  # in the order in which they came

    def is_new(self, frame: Frame) -> bool:
        """Whether the frame is not a copy of one that came shortly before; to be asked once for each."""
        key = frame.key
        if key in self._seen:
            return False
        self._seen[key] = None
        if len(self._seen) > self._REMEMBERED:
            del self._seen[next(iter(self._seen))]
        return True
