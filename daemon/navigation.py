"""The receiver's bytes to poses that can be trusted, or to why they are not, in plain words.

A pose is used while the receiver calls its solution good, and what it says beside it stays in bounds: time
status, position type, standard deviations; and while its azimuth agrees with the course over ground. One
fault costs the pose (or, from a log that comes once a second, that second) and nothing else. A stretch of
faults is over only once there has been none for a while.
"""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from polecal.daemon.config import Navigation as Settings
from polecal.daemon.pulse import Pulse
from polecal.daemon.quality import QualityLog
from polecal.daemon.trajectory import Trajectory
from polecal.drivers.clock import Clock
from polecal.drivers.novatel_span import (
    Accuracy,
    Deduplicator,
    Frame,
    Framer,
    InsConfig,
    InsStatus,
    MessageId,
    NavState,
    PositionType,
    Time,
    TimeStatus,
    UtcStatus,
    accuracy,
    nav_state,
    parse,
    position_type,
    reference_point,
)
from polecal.drivers.port import BITS_PER_BYTE

OnPose = Callable[[NavState, bool], None]
"""Takes every pose that came, and whether it is used."""

_RECEIVER_DRIFT = 200e-6
_LOST_NS = 2_000_000_000  # without a pose to use for so long, it is back to aligning
_TOLD_AFTER_NS = 200_000_000  # a shorter stretch of faults is only counted
_LONG_NS = 1_500_000_000  # of two readings of a log that comes once a second; a longer one must settle
_SETTLE_NS = 1_000_000_000
_STALE_NS = 5_000_000_000  # what comes once a second has ceased
_SILENT_NS = 1_000_000_000
_EVER_NS = 1 << 63
_INSPVAX = MessageId.INSPVAX.name

_LOGS_BESIDE = frozenset(
    {
        *(MessageId.BESTPOS, MessageId.BESTGPSPOS, MessageId.INSCONFIG, MessageId.TIME),
        *(MessageId.INSPVAX, MessageId.INSSTDEV, MessageId.INSSTDEVS, MessageId.INSCOV, MessageId.INSCOVS),
    }
)

TIME, TYPE, SIGMA, COURSE = "time status", "position type", "standard deviations", "azimuth off the course"
_CEASED = {
    TIME: "the receiver has ceased to tell how well it knows the time",
    TYPE: "the receiver has ceased to tell what its position rests on",
    SIGMA: "the receiver has ceased to tell its standard deviations",
}
_UNKNOWN = {
    SIGMA: "the receiver tells no standard deviations: they are not checked",
    TYPE: "the receiver does not tell what its position rests on: it is not checked",
    TIME: "the receiver does not tell how well it knows the time: it is not checked",
}

_STRAIGHT_NS = 1_000_000_000
_STEP_NS = 50_000_000
_GAP_NS = 1_500_000_000
_SLOW_MPS = 0.5
_SIGMAS = 20  # the speed is so many times its uncertainty: the course is known to 3 degrees
_TURN_DEG, _SWING_DEG = 5.0, 10.0  # by which azimuth and course change at most over a straight


@dataclass(frozen=True, slots=True)
class Fault:
    """Why a pose is not used: what kind of reason (for counting), and in an operator's words."""

    kind: str
    words: str


class Trust:
    """Each pose's faults to whether it is used: neither one bad epoch nor one good one decides."""

    def __init__(self) -> None:
        self.unused: Counter[str] = Counter()
        """Poses that were not used, by the first reason."""
        self._faults: list[Fault] = []
        self._since_ns: int | None = None
        self._last_ns = 0
        self._long = False

    @property
    def why_not(self) -> list[str]:
        """What is wrong in a stretch of faults that is more than a blink, and for a while after it."""
        told = self._since_ns is not None and self._last_ns - self._since_ns > _TOLD_AFTER_NS
        return [fault.words for fault in self._faults] if told else []

    def judge(self, t_ns: int, faults: list[Fault]) -> bool:
        """Take one pose's faults at host time ``t_ns``; say whether it is used."""
        if faults:
            if self._since_ns is None:
                self._since_ns = t_ns
            self._faults, self._last_ns = faults, t_ns
            self._long = self._long or t_ns - self._since_ns > _LONG_NS
        elif self._since_ns is not None and t_ns - self._last_ns >= _SETTLE_NS:
            self._since_ns, self._long = None, False
        if faults or self._long:
            self.unused[self._faults[0].kind] += 1
        return not faults and not self._long


class CourseWatch:
    """Poses to how far the azimuth is off the course over ground, wherever the vehicle drove straight."""

    def __init__(self) -> None:
        self.off_deg: float | None = None
        """Azimuth less course, -90 to 90, on the last straight; in reverse, less the course's reverse."""
        self._seen: deque[tuple[int, float, float, bool]] = deque()  # angles go on, over 360

    def forget(self) -> None:
        """Begin anew: the solution did."""
        self.off_deg = None
        self._seen.clear()

    def add(self, pose: NavState, sigma_mps: float) -> None:
        """Take a pose, whose velocity is uncertain by ``sigma_mps``."""
        seen = self._seen
        if seen and not 0 < pose.gps_ns - seen[-1][0] < _GAP_NS:
            seen.clear()
        if seen and pose.gps_ns - seen[-1][0] < _STEP_NS:
            return
        north, east, _ = pose.velocity_ned_mps
        fast = math.hypot(north, east) >= max(_SLOW_MPS, _SIGMAS * sigma_mps)
        azimuth_deg, course_deg = pose.azimuth_deg, math.degrees(math.atan2(east, north))
        if seen:
            _, azimuth_before_deg, course_before_deg, _ = seen[-1]
            azimuth_deg = azimuth_before_deg + _wrapped(azimuth_deg - azimuth_before_deg)
            course_deg = course_before_deg + _wrapped(course_deg - course_before_deg)
        seen.append((pose.gps_ns, azimuth_deg, course_deg, fast))
        while pose.gps_ns - seen[0][0] > _STRAIGHT_NS + _STEP_NS:
            seen.popleft()
        if pose.gps_ns - seen[0][0] < _STRAIGHT_NS:
            return
        _, azimuths_deg, courses_deg, fasts = zip(*seen, strict=True)
        if not all(fasts) or max(azimuths_deg) - min(azimuths_deg) > _TURN_DEG:
            return
        if max(courses_deg) - min(courses_deg) > _SWING_DEG:
            return
        off_deg = _wrapped((sum(azimuths_deg) - sum(courses_deg)) / len(seen))
        self.off_deg = off_deg if abs(off_deg) <= 90 else off_deg - math.copysign(180.0, off_deg)


class Navigation:
    """All that happens between the receiver's bytes and poses: deterministic, without I/O.

    Only trusted poses come into ``trajectory``, and only stamps with a known time into ``clock``.
    """

    def __init__(self, settings: Settings, on_pose: OnPose | None = None) -> None:
        self._on_pose = on_pose
        self.framer = Framer()
        self.pulse = Pulse()
        """Of the poses, used or not."""
        self.clock = Clock(max_drift=_RECEIVER_DRIFT)
        self.trajectory = Trajectory(1.0 / settings.rate_hz)
        self.quality = QualityLog()
        self.ins_status: InsStatus | int | None = None
        self.position_type: PositionType | int | None = None
        self.reference_point = reference_point(None)
        """Which point of the vehicle the poses speak of, as far as the receiver has said."""
        self._settings = settings
        self._byte_ns = BITS_PER_BYTE * 1e9 / settings.baud
        self._types = {PositionType[name] for name in settings.position_types}
        self._time_statuses = {TimeStatus[name] for name in settings.time_status}
        self._copies = Deduplicator()
        self._trust = Trust()
        self._course = CourseWatch()
        self._now_ns = self._used_ns = self._pose_ns = self._plain_ns = 0
        self._told: dict[
            str, tuple[int, Fault | None]
        ] = {}  # when it last said so, and what is wrong with it
        self._sound_until_ns = _EVER_NS  # nothing that was told is wrong, or too old by then
        self._time_status: TimeStatus | int | None = None
        self._inertial_type = False  # position_type is that of the inertial solution itself
        self._accuracy: Accuracy | None = None

    def feed(self, chunks: Sequence[tuple[bytes, int]]) -> bool:
        """Take chunks, each with the host time (CLOCK_MONOTONIC ns) of its reading; say if a frame ended."""
        self._now_ns = chunks[-1][1]
        frames = self.framer.feed_all(chunks)
        for frame in frames:
            if frame.kind.checked and not frame.is_response and self._copies.is_new(frame):
                self._take(frame)
        return bool(frames)

    def tick(self, t_ns: int) -> None:
        """Let time go on to host time ``t_ns``, whether or not anything came."""
        self._now_ns = t_ns

    @property
    def lost(self) -> bool:
        """Whether there has been no pose to use for 2 s, or none ever."""
        return not self._used_ns or self._now_ns > self.lost_ns

    @property
    def lost_ns(self) -> int:
        """From when on it is `lost`, if there is no other pose to use."""
        return self._used_ns + _LOST_NS

    @property
    def ready(self) -> bool:
        """Whether beams can be placed."""
        return self.clock.locked and not self.lost

    @property
    def why_not(self) -> list[str]:
        """Why poses are not being used, in plain words; empty while they are."""
        if not self.pulse.count:
            return ["no pose has come from the receiver yet"]
        if self._now_ns - self._pose_ns > max(_SILENT_NS, 3e9 / self._settings.rate_hz):
            return ["no poses come from the receiver any more"]
        if reasons := self._trust.why_not:
            return reasons
        return [] if self.clock.locked else ["the receiver's clock is being learnt"]

    @property
    def notes(self) -> list[str]:
        """What cannot be checked, though poses are used."""
        if self.why_not:
            return []
        notes = [words for kind, words in _UNKNOWN.items() if kind not in self._told]
        if self._course.off_deg is None:
            notes.append("azimuth and course over ground are not compared yet: drive straight for a second")
        return notes

    def device(self) -> dict[str, Any]:
        """Give the part of the receiver's STATUS that follows from its data."""
        return {
            "rate_hz": round(self.pulse.rate_hz, 2),
            "ins_status": name_of(self.ins_status),
            "position_type": name_of(self.position_type),
            "frames": self.framer.frames,
            "bad_frames": self.framer.bad_frames,
            "unused": dict(self._trust.unused),
            "reference_point": self.reference_point,
        }

    def _take(self, frame: Frame) -> None:
        t_ns = frame.t_first_ns
        if (status := frame.time_status) is not None and status != TimeStatus.SATTIME:
            self._time(t_ns, status)
        pose = nav_state(frame)
        if pose is not None and pose.log != _INSPVAX:  # as with most frames: it says nothing else
            self._plain_ns = t_ns
        else:
            if frame.message_id in _LOGS_BESIDE:
                self._note(t_ns, parse(frame))
            if pose is None or (self._plain_ns and t_ns - self._plain_ns < _SILENT_NS):
                return  # INSPVAX came for its standard deviations
        self._use(pose, t_ns, round(t_ns - frame.lead_bytes * self._byte_ns))

    def _note(self, t_ns: int, said: object) -> None:
        if isinstance(said, InsConfig):
            self.reference_point = reference_point(said)
        if isinstance(said, Time) and said.utc_status == UtcStatus.VALID:
            self.quality.utc_offset_s = said.utc_offset_s
        if (told := accuracy(said)) is not None:
            self._accuracy = told
            self._tell(SIGMA, t_ns, self._uncertain(told))
        if (rests_on := position_type(said)) is not None:
            inertial = told is not None  # INSPVAX, which is what the poses rest on; BESTPOS may be another
            if inertial or not self._inertial_type or t_ns - self._told[TYPE][0] > _STALE_NS:
                self.position_type, self._inertial_type = rests_on, inertial
                words = f"the position is only {name_of(rests_on)}: check that corrections reach the receiver"
                self._tell(TYPE, t_ns, None if rests_on in self._types else Fault(TYPE, words))

    def _time(self, t_ns: int, status: TimeStatus | int) -> None:
        if status == self._time_status:  # as with each pose that has a long header
            wrong = self._told[TIME][1]
        else:
            words = f"the receiver's time is only {name_of(status)}: wait for more satellites"
            wrong = None if status in self._time_statuses else Fault(TIME, words)
            self._time_status = status
        self._tell(TIME, t_ns, wrong)

    def _tell(self, kind: str, t_ns: int, wrong: Fault | None) -> None:
        """Note what the receiver says of itself, so that as a rule a pose need not be held against it."""
        self._told[kind] = t_ns, wrong
        self._sound_until_ns = min(0 if fault else at_ns + _STALE_NS for at_ns, fault in self._told.values())

    def _use(self, pose: NavState, t_ns: int, left_ns: int) -> None:
        """Use a pose, or not, that came at ``t_ns`` and whose first byte left the receiver at ``left_ns``."""
        self.pulse.beat(t_ns)
        self._pose_ns = t_ns
        self.ins_status = pose.ins_status
        if pose.good:
            self._course.add(pose, max(self._accuracy.velocity_mps) if self._accuracy else 0.0)
            faults = self._faults(t_ns)
            if not faults or faults[0].kind != TIME:
                self.clock.update(pose.gps_ns, left_ns)
        else:
            self._course.forget()
            name = str(name_of(pose.ins_status))
            meaning = getattr(pose.ins_status, "meaning", "nothing is used before it is good")
            faults = [Fault(name, f"navigation says {name}: {meaning}")]
        used = self._trust.judge(t_ns, faults)
        self.quality.add(pose.gps_ns, used, pose.ins_status, self.position_type, self._accuracy)
        if used:
            self._used_ns = t_ns
            self.trajectory.add(pose)
        if self._on_pose is not None:
            self._on_pose(pose, used)

    def _faults(self, t_ns: int) -> list[Fault]:
        """Say what is wrong with a pose that the receiver calls good: its time first."""
        faults: list[Fault] = []
        if t_ns > self._sound_until_ns:
            for kind, words in _CEASED.items():
                told_ns, wrong = self._told.get(kind, (t_ns, None))
                if t_ns - told_ns > _STALE_NS:
                    faults.append(Fault(kind, words))
                elif wrong is not None:
                    faults.append(wrong)
        off_deg = self._course.off_deg
        if off_deg is not None and abs(off_deg) > self._settings.max_off_course_deg:
            cause = (
                "the IMU's axes are not the vehicle's: set the receiver's rotation from one to the other"
                if abs(off_deg) > 45
                else "it has aligned badly, or its IMU is mounted askew: drive turns, or align it again"
            )
            faults.append(Fault(COURSE, f"azimuth is {abs(off_deg):.0f}° off the course: {cause}"))
        return faults

    def _uncertain(self, told: Accuracy) -> Fault | None:
        most = self._settings.max_sigma
        north, east, down = told.position_m
        roll, pitch, azimuth = told.attitude_deg
        checks = (
            ("position", max(north, east), most.position_m, "m"),
            ("height", down, most.height_m, "m"),
            ("velocity", max(told.velocity_mps), most.velocity_mps, "m/s"),
            ("roll or pitch", max(roll, pitch), most.roll_pitch_deg, "°"),
            ("azimuth", azimuth, most.azimuth_deg, "°"),
        )
        over = [
            f"{what} by {sigma:.2f} {unit} (at most {bound:g})"
            for what, sigma, bound, unit in checks
            if sigma > bound
        ]
        return Fault(SIGMA, f"the receiver is uncertain of its {', '.join(over)}") if over else None


def name_of(value: InsStatus | PositionType | TimeStatus | int | None) -> str | None:
    """Give NovAtel's name of a status or type; the number where it has none."""
    if value is None or isinstance(value, InsStatus | PositionType | TimeStatus):
        return None if value is None else value.name
    return f"unknown ({value})"


def _wrapped(angle_deg: float) -> float:
    return (angle_deg + 180.0) % 360.0 - 180.0
