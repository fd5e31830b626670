"""Which poses of a receiver are used, and what is said of those that are not; on recorded bytes."""

import json
import math
import re
import struct

import pytest

from polecal.daemon.config import Navigation as Settings
from polecal.daemon.config import NavigationSigma
from polecal.daemon.navigation import Navigation
from polecal.daemon.routine import State
from polecal.drivers.emulated.receiver import load_recording
from polecal.drivers.novatel_span import Framer, InsStatus, MessageId, PositionType, TimeStatus, nav_state
from polecal.drivers.novatel_span.framer import crc32

T0_NS = 1_000_000_000_000
WEEK, MS = 2345, 100_000_000
DRIVEN = "span_driver_ins_ppp_driven_20hz.bin"
UNALIGNED = "span_driver_basic_fix_unaligned_10hz.bin"


def changed(wire, *changes):
    """A frame with other values, each as (offset in the frame, struct code, value), and a right checksum."""
    frame = bytearray(wire[:-4])
    for at, code, value in changes:
        struct.pack_into("<" + code, frame, at, value)
    return bytes(frame) + crc32(bytes(frame)).to_bytes(4, "little")


def taken(navigation):
    """How many poses the trajectory has taken, while it keeps them all."""
    return navigation.trajectory._count + len(navigation.trajectory._new)


class Receiver:
    """Says recorded logs, with other values and times, to a `Navigation`."""

    def __init__(self, messages, **settings):
        self.messages = messages
        self.navigation = Navigation(Settings(port="/dev/span", **settings))
        self.ms = 0

    def say(self, name, *changes):
        """One log now; changes as (offset in the body, struct code, value)."""
        wire = self.messages[name]
        short = wire[2] == 0x13
        week_at, ms_at = (6, 8) if short else (14, 16)
        head = [(week_at, "H", WEEK), (ms_at, "I", MS + self.ms)]
        if name == "INSPVAS":
            head += [(12, "I", WEEK), (16, "d", (MS + self.ms) / 1000)]
        start = 12 if short else 28
        data = changed(wire, *head, *((at + start, *rest) for at, *rest in changes))
        self.navigation.feed([(data, T0_NS + self.ms * 1_000_000 + 2_000_000)])

    def pose(self, *changes, name="INSPVAS", azimuth_deg=30.0, north_mps=0.0, east_mps=0.0, status=3):
        at = 84 if name == "INSPVAS" else 0
        values = [(36, "d", north_mps), (44, "d", east_mps), (76, "d", azimuth_deg), (at, "I", status)]
        self.say(name, *values, *changes)

    def poses(self, seconds, *changes, step_ms=50, beside=(), **what):
        """Poses for a while; once a second, before them, the logs in ``beside``: (name, *changes)."""
        for _ in range(round(seconds * 1000 / step_ms)):
            if self.ms % 1000 == 0:
                for name, *values in beside:
                    self.say(name, *values)
            self.pose(*changes, **what)
            self.ms += step_ms

    @property
    def used(self):
        """How many poses were used."""
        return taken(self.navigation)

    @property
    def why_not(self):
        return "; ".join(self.navigation.why_not)


@pytest.fixture(scope="module")
def messages(protocol):
    known = {v["name"]: v for v in json.loads((protocol / "novatel-vectors.json").read_text())}
    wire = {
        "INSPVAS": "INSPVASB OEM6",
        "INSPVAX": "INSPVAXB driven",
        "INSSTDEV": "INSSTDEVB",
        "INSCOV": "INSCOVB",
        "BESTPOS": "BESTPOSB INS_PPP",
        "TIME": "TIMEB OEM7",
        "INSCONFIG": "INSCONFIGB",
    }
    made = {log: bytes.fromhex(known[name]["hex"]) for log, name in wire.items()}
    return made | {"BESTGPSPOS": changed(made["BESTPOS"], (4, "H", 423))}


@pytest.fixture
def receiver(messages):
    return lambda **settings: Receiver(messages, **settings)


def heard(path, turned_deg=0.0):
    """A recording as (host time, bytes) at its arrival times, all azimuths turned."""
    data, offsets, arrival_s = load_recording(path)
    if turned_deg:
        turned = bytearray(data)
        for frame in Framer().feed(data, 0):
            if frame.message_id == MessageId.INSPVAX:
                (azimuth,) = struct.unpack_from("<d", frame.data, 28 + 76)
                new = changed(frame.data, (28 + 76, "d", (azimuth + turned_deg) % 360))
                turned[frame.offset : frame.offset + len(new)] = new
        data = bytes(turned)
    for begin, end, at in zip(offsets, [*offsets[1:], len(data)], arrival_s, strict=True):
        yield T0_NS + round((at - arrival_s[0]) * 1e9), data[begin:end]


def after(path, **how):
    navigation = Navigation(Settings(port="/dev/span", rate_hz=20))
    for t_ns, data in heard(path, **how):
        navigation.feed([(data, t_ns)])
    return navigation


# --- real receivers


def test_a_real_drive_is_used_from_its_first_pose_to_its_last(captures):
    navigation = after(captures / DRIVEN)
    assert navigation.pulse.count == taken(navigation) == 2289
    assert navigation.device() == {
        "rate_hz": pytest.approx(20, rel=0.1),
        "ins_status": "INS_SOLUTION_GOOD",
        "position_type": "INS_PPP",
        "frames": navigation.framer.frames,
        "bad_frames": 0,
        "unused": {},
        "reference_point": navigation.reference_point,
    }
    assert navigation.why_not == navigation.notes == []
    assert navigation.ready
    assert abs(navigation._course.off_deg) < 3


def test_a_receiver_that_never_aligns_is_never_used_and_the_reason_is_said(captures):
    navigation = after(captures / UNALIGNED)
    assert navigation.trajectory.origin is None
    (why,) = navigation.why_not
    assert why.startswith("navigation says INS_ALIGNING: ")
    assert InsStatus.INS_ALIGNING.meaning in why
    assert navigation.device()["unused"] == {"INS_ALIGNING": 1988}
    assert not navigation.clock.locked
    assert navigation.lost


@pytest.mark.parametrize(
    ("turned_deg", "says"),
    [
        (90.0, "azimuth is (8[7-9]|90)° off the course: the IMU's axes are not the vehicle's"),
        (-90.0, "azimuth is (8[7-9]|90)° off the course: the IMU's axes are not the vehicle's"),
        (25.0, "azimuth is 2[2-8]° off the course: it has aligned badly"),
    ],
)
def test_a_good_solution_whose_azimuth_is_off_the_course_is_refused(captures, turned_deg, says):
    navigation = after(captures / DRIVEN, turned_deg=turned_deg)
    assert navigation.ins_status is InsStatus.INS_SOLUTION_GOOD
    (why,) = navigation.why_not
    assert re.match(says, why)
    assert navigation.device()["unused"]["azimuth off the course"] > 1500
    assert navigation.lost


def test_an_azimuth_that_is_half_a_turn_off_is_a_drive_in_reverse(captures):
    navigation = after(captures / DRIVEN, turned_deg=180.0)
    assert navigation.why_not == []
    assert navigation.device()["unused"] == {}
    assert abs(navigation._course.off_deg) < 3


def test_how_the_bytes_are_cut_changes_nothing(captures):
    chunks = list(heard(captures / DRIVEN, turned_deg=90.0))[:600]
    ends = []
    for size in (1, 61, 10**6):
        navigation = Navigation(Settings(port="/dev/span", rate_hz=20))
        for t_ns, data in chunks:
            for at in range(0, len(data), size):
                navigation.feed([(data[at : at + size], t_ns)])
        ends.append((navigation.why_not, navigation.device(), navigation.trajectory.last_ns))
    assert ends[0] == ends[1] == ends[2]


def test_copies_on_a_virtual_port_count_once(captures):
    """Each chunk comes twice, as from a receiver that sends its logs to a virtual port as well."""
    navigation = Navigation(Settings(port="/dev/span", rate_hz=20))
    stream = list(heard(captures / DRIVEN))
    for t_ns, data in stream:
        for frame in Framer().feed(data, 0):
            navigation.feed([(frame.data, t_ns)])
            if frame.port_address is not None:
                navigation.feed([(changed(frame.data, (7, "B", frame.port_address + 30)), t_ns)])
    states = [nav_state(frame) for _, data in stream for frame in Framer().feed(data, 0)]
    assert navigation.pulse.count == sum(state is not None for state in states) > 2000


def test_a_run_with_a_sideways_imu_collects_nothing_and_status_says_why(begun, settings, streaming, drive):
    """An emulated one at INS_SOLUTION_GOOD, 90° off, on the demonstration's drive."""
    played = begun(settings()).feed(streaming(drive.world, 20.0, mounting_yaw_deg=90.0))
    assert played.state is State.ALIGNING
    status = played.pipeline.status()
    assert played.pipeline.device("span")["ins_status"] == "INS_SOLUTION_GOOD"
    assert any("azimuth is 90° off the course: the IMU's axes" in note for note in status["notes"])
    assert not played.passes


# --- what a pose is judged by


@pytest.mark.parametrize("status", [*range(3), *range(4, 16), 99])
def test_nothing_but_a_good_solution_is_used(receiver, status):
    span = receiver()
    span.poses(1.0, status=status)
    assert span.used == 0
    assert (
        f"navigation says {InsStatus(status).name if status < 15 else f'unknown ({status})'}: "
        in span.why_not
    )


@pytest.mark.parametrize("log", ["BESTPOS", "BESTGPSPOS", "INSPVAX"])
@pytest.mark.parametrize(
    ("kind", "good"),
    [
        ("INS_RTKFIXED", True),
        ("INS_RTKFLOAT", True),
        ("INS_PSRDIFF", True),
        ("INS_PPP", True),
        ("INS_OMNISTAR_HP", True),
        ("NARROW_INT", True),
        ("INS_PSRSP", False),
        ("INS_SBAS", False),
        ("SINGLE", False),
        ("NONE", False),
        (99, False),
    ],
)
def test_a_position_without_corrections_is_refused_whichever_log_says_so(receiver, log, kind, good):
    value = PositionType[kind] if isinstance(kind, str) else kind
    span = receiver()
    span.poses(5.0, beside=[(log, (4, "I", value))])
    assert (span.used > 0) is good
    if not good:
        assert f"the position is only {kind if isinstance(kind, str) else 'unknown (99)'}" in span.why_not
        assert set(span.navigation.device()["unused"]) == {"position type"}


def test_the_inertial_solutions_own_type_goes_before_that_of_the_satellites(receiver):
    span = receiver()
    both = [("INSPVAX", (4, "I", PositionType.INS_RTKFIXED)), ("BESTPOS", (4, "I", PositionType.SINGLE))]
    span.poses(5.0, beside=both)
    assert span.used == 100
    assert span.navigation.device()["position_type"] == "INS_RTKFIXED"


def test_which_position_types_will_do_is_configured(receiver):
    span = receiver(position_types=("INS_SBAS",))
    span.poses(5.0, beside=[("BESTPOS", (4, "I", PositionType.INS_SBAS))])
    assert span.used == 100


@pytest.mark.parametrize(
    ("at", "value", "says"),
    [
        (0, 0.3, "position by 0.30 m (at most 0.2)"),
        (4, 0.3, "position by 0.30 m (at most 0.2)"),
        (8, 0.4, "height by 0.40 m (at most 0.3)"),
        (16, 0.2, "velocity by 0.20 m/s (at most 0.1)"),
        (24, 0.15, "roll or pitch by 0.15 ° (at most 0.1)"),
        (28, 0.15, "roll or pitch by 0.15 ° (at most 0.1)"),
        (32, 0.8, "azimuth by 0.80 ° (at most 0.5)"),
        (32, float("nan"), "azimuth by inf"),
    ],
)
@pytest.mark.parametrize("log", ["INSPVAX", "INSSTDEV"])
def test_each_standard_deviation_has_a_bound(receiver, log, at, value, says):
    start = 84 if log == "INSPVAX" else 0
    fine = [(start + 4 * i, "f", 0.01) for i in range(9)]
    span = receiver()
    span.poses(2.0, beside=[(log, *fine)])
    assert span.used == 40
    span.poses(3.0, beside=[(log, *fine, (start + at, "f", value))])
    assert span.used == 40
    assert says in span.why_not
    assert span.navigation.lost


def test_covariances_will_do_where_there_are_no_standard_deviations(receiver):
    span = receiver()
    span.poses(2.0, beside=[("INSCOV",)])
    assert span.used == 40
    span.poses(2.0, beside=[("INSCOV", (84 + 64, "d", 0.64))])
    assert span.used == 40
    assert "azimuth by 0.80 °" in span.why_not


def test_the_bounds_are_configured(receiver):
    span = receiver(max_sigma=NavigationSigma(azimuth_deg=1.0))
    span.poses(2.0, beside=[("INSCOV", (84 + 64, "d", 0.64))])
    assert span.used == 40


@pytest.mark.parametrize("log", ["BESTPOS", "TIME", "INSPVAX"])
@pytest.mark.parametrize(
    ("status", "good"),
    [(20, False), (60, False), (120, False), (130, False), (160, True), (170, True), (180, True)],
)
def test_a_pose_without_a_known_time_is_refused_and_teaches_the_clock_nothing(receiver, log, status, good):
    span = receiver()
    span.poses(5.0, beside=[(log, (13 - 28, "B", status))])
    assert (span.used > 0) is good
    assert span.navigation.clock.locked is good
    if not good:
        assert f"time is only {TimeStatus(status).name}" in span.why_not


def test_the_time_status_of_satellite_logs_says_nothing_of_the_clock(receiver):
    span = receiver()
    span.poses(2.0, beside=[("TIME",), ("BESTPOS", (13 - 28, "B", TimeStatus.SATTIME))])
    assert span.used == 40


@pytest.mark.parametrize(
    ("what", "compared"),
    [
        ({"north_mps": 0.6}, True),
        ({"north_mps": 0.3}, False),  # slow
        ({"north_mps": 0.0}, False),
        ({"north_mps": -0.6}, True),
    ],
)
def test_the_course_counts_only_on_a_straight_at_speed(receiver, what, compared):
    span = receiver()
    span.poses(3.0, azimuth_deg=90.0, **what)
    assert (span.navigation._course.off_deg is not None) is compared
    assert bool(span.why_not.startswith("azimuth is 90° off the course")) is compared


@pytest.mark.parametrize("turning", ["azimuth", "course", "both"])
def test_the_course_does_not_count_in_a_turn(receiver, turning):
    span = receiver()
    for step in range(100):
        angle = 12.0 * step * 0.05
        course = math.radians(angle if turning != "azimuth" else 0.0)
        span.pose(
            azimuth_deg=90.0 + (angle if turning != "course" else 0.0),
            north_mps=3 * math.cos(course),
            east_mps=3 * math.sin(course),
        )
        span.ms += 50
    assert span.navigation._course.off_deg is None
    assert span.used == 100


def test_a_course_that_is_uncertain_does_not_count(receiver):
    span = receiver()
    sigmas = [(84 + 4 * i, "f", 0.09) for i in range(9)]
    span.poses(3.0, azimuth_deg=90.0, north_mps=1.5, beside=[("INSPVAX", *sigmas)])
    assert span.navigation._course.off_deg is None
    span.poses(3.0, azimuth_deg=90.0, north_mps=2.0, beside=[("INSPVAX", *sigmas)])
    assert span.navigation._course.off_deg == pytest.approx(90.0)


def test_the_bound_on_the_course_is_configured(receiver):
    span = receiver(max_off_course_deg=90.0)
    span.poses(3.0, azimuth_deg=90.0, north_mps=3.0)
    assert span.used == 60


def test_a_course_across_north_is_one_course(receiver):
    span = receiver()
    span.poses(3.0, azimuth_deg=359.5, north_mps=3.0, east_mps=0.02)
    assert span.navigation._course.off_deg == pytest.approx(-0.88, abs=0.01)


# --- neither one bad epoch nor one good one decides


def test_one_bad_pose_costs_itself_alone(receiver):
    span = receiver()
    span.poses(2.0)
    span.poses(0.05, status=6)
    assert span.navigation.why_not == ["the receiver's clock is being learnt"]
    span.poses(1.0)
    assert span.used == 60
    assert span.navigation.device()["unused"] == {"INS_SOLUTION_FREE": 1}


def test_one_bad_second_costs_itself_alone_and_is_told(receiver):
    span = receiver()
    for second in range(6):
        kind = PositionType.SINGLE if second == 3 else PositionType.INS_RTKFIXED
        span.poses(1.0, beside=[("BESTPOS", (4, "I", kind))])
        assert not span.navigation.lost
        assert ("the position is only SINGLE" in span.why_not) is (second == 3)
    assert span.used == 100


def test_a_bad_stretch_is_told_and_over_only_after_a_good_second(receiver):
    span = receiver()
    span.poses(2.0)
    span.poses(2.0, status=6)
    assert "INS_SOLUTION_FREE" in span.why_not
    span.poses(0.9)
    assert "INS_SOLUTION_FREE" in span.why_not
    assert span.used == 40
    span.poses(1.0)
    assert "INS_SOLUTION_FREE" not in span.why_not
    assert 55 <= span.used <= 60


def test_a_solution_that_is_bad_now_and_then_is_a_bad_stretch(receiver):
    span = receiver()
    span.poses(2.0)
    for _ in range(10):
        span.poses(0.05, status=2)
        span.poses(0.35)
    assert "INS_HIGH_VARIANCE" in span.why_not
    assert span.navigation.lost


@pytest.mark.parametrize("log", ["BESTPOS", "INSSTDEV", "TIME"])
def test_what_is_not_told_any_more_is_not_trusted_any_more(receiver, log):
    fine = [(4 * i, "f", 0.01) for i in range(9)] if log == "INSSTDEV" else []
    span = receiver()
    span.poses(2.0, beside=[(log, *fine)])
    span.poses(7.0)
    assert "has ceased to tell" in span.why_not
    assert span.navigation.lost


# --- what is said


def test_before_anything_comes_that_is_said(receiver):
    assert receiver().why_not == "no pose has come from the receiver yet"


def test_a_receiver_that_falls_silent_is_said_to(receiver):
    span = receiver()
    span.poses(5.0)
    assert span.why_not == ""
    assert span.navigation.ready
    span.navigation.tick(T0_NS + 8 * 10**9)
    assert span.why_not == "no poses come from the receiver any more"
    assert span.navigation.lost


def test_what_cannot_be_checked_is_noted_though_poses_are_used(receiver):
    span = receiver()
    span.poses(5.0)
    notes = " ".join(span.navigation.notes)
    for what in ("standard deviations", "what its position rests on", "the time", "course over ground"):
        assert what in notes
    span.poses(5.0, beside=[("INSPVAX",), ("TIME",)], north_mps=3.0, azimuth_deg=1.0)
    assert span.navigation.notes == []


def test_standard_deviations_beside_the_poses_are_no_poses(receiver):
    span = receiver()
    span.poses(5.0, beside=[("INSPVAX",)])
    assert span.navigation.pulse.rate_hz == pytest.approx(20.0, rel=0.01)
    assert span.used == 100


def test_the_extended_log_alone_gives_poses_and_all_that_they_are_judged_by(receiver):
    span = receiver(rate_hz=20)
    span.poses(5.0, name="INSPVAX")
    assert span.used == 100
    span.poses(2.0, (4, "I", PositionType.INS_PSRSP), name="INSPVAX")
    assert span.used == 100
    assert "INS_PSRSP" in span.why_not


def test_the_point_that_poses_speak_of_follows_from_the_recorded_bytes(receiver):
    span = receiver()
    assert "does not say" in span.navigation.device()["reference_point"]
    span.say("INSCONFIG")
    assert span.navigation.device()["reference_point"] == "the IMU's centre of navigation"


def test_the_result_says_from_which_point_the_laser_is_measured(recorded):
    (laser,) = recorded.played.pipeline.calibration()["lasers"]
    assert laser["reference_point"].startswith("the IMU's centre of navigation")
    assert laser["reference_point"] == recorded.played.pipeline.device("span")["reference_point"]
