"""Pose logs to navigation states: the one thing of the receiver that the pipeline takes."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

from polecal.drivers.novatel_span.enums import (
    InsOffset,
    InsStatus,
    MessageId,
    OffsetFrame,
    PositionType,
)
from polecal.drivers.novatel_span.framer import Frame
from polecal.drivers.novatel_span.logs import InsConfig, InsPva, InsPvax, parse

WEEK_NS = 604_800 * 10**9
Triple = tuple[float, float, float]

POSE_LOGS = frozenset(
    {
        MessageId.INSPVA,
        MessageId.INSPVAS,
        MessageId.IMURATEPVA,
        MessageId.IMURATEPVAS,
        MessageId.INSPVAX,
    }
)


@dataclass(frozen=True, slots=True)
class NavState:
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
        return self.ins_status == InsStatus.INS_SOLUTION_GOOD


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
    if frame.message_id not in POSE_LOGS or frame.is_response:
        return None
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
        self._seen: deque[tuple[int | None, ...]] = deque(maxlen=self._REMEMBERED)

    def is_new(self, frame: Frame) -> bool:
        """Whether the frame is not a copy of one that came shortly before; to be asked once for each."""
        key = frame.key
        if key in self._seen:
            return False
        self._seen.append(key)
        return True
