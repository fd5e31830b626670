"""Navigation states, on a receiver that really drove and on one that never aligned."""

import itertools
import math
import struct
from dataclasses import replace

import numpy as np
import pytest

from polecal.drivers.novatel_span import (
    BestPos,
    Deduplicator,
    Framer,
    InsStatus,
    MessageId,
    PositionType,
    SolutionStatus,
    accuracy,
    nav_state,
    parse,
    position_type,
    reference_point,
)
from polecal.drivers.novatel_span.enums import InsOffset, OffsetFrame, OffsetSource
from polecal.drivers.novatel_span.framer import crc32
from polecal.drivers.novatel_span.logs import InsOffsetItem
from polecal.drivers.novatel_span.nav import WEEK_NS


def frames_of(captures, name):
    return Framer().feed((captures / name).read_bytes(), 0)


@pytest.fixture(scope="module")
def driven(captures):
    """Frames of the driven capture."""
    return frames_of(captures, "span_driver_ins_ppp_driven_20hz.bin")


def state_of(vectors, name):
    (frame,) = Framer().feed(vectors[name]["wire"], 0)
    return nav_state(frame)


def test_a_short_pose_log_gives_its_own_time_and_ellipsoidal_height(vectors):
    state = state_of(vectors, "INSPVASB OEM6")
    assert state.gps_ns == 1881 * WEEK_NS + 381110_800_000_000
    assert state.height_m == pytest.approx(57.104, abs=1e-3)
    assert state.velocity_ned_mps == pytest.approx((-0.00915, -0.02729, -0.18820), abs=1e-5)
    assert (state.roll_deg, state.pitch_deg, state.azimuth_deg) == pytest.approx(
        (4.10511, 2.07637, 158.93097), abs=1e-5
    )
    assert state.good
    assert state.position_type is None
    assert state.attitude_sigma_deg is None
    assert state.log == "INSPVAS"


def test_the_extended_pose_log_gives_the_headers_time_and_sigmas(vectors):
    state = state_of(vectors, "INSPVAXB driven")
    assert state.gps_ns == 1820 * WEEK_NS + 160255_900_000_000
    assert state.height_m == pytest.approx(326.27973 - 36.5, abs=1e-4)
    assert state.position_type is PositionType.INS_PPP
    assert state.position_sigma_m == pytest.approx((0.0470, 0.0362, 0.0728), abs=1e-4)
    assert state.attitude_sigma_deg == pytest.approx((0.0249, 0.0259, 0.2209), abs=1e-4)


def test_the_bodys_time_counts_where_the_headers_is_rounded(vectors):
    state = state_of(vectors, "IMURATEPVASA")
    assert state.gps_ns == 2010 * WEEK_NS + 298810_078_576_000


def test_both_pose_logs_of_one_moment_are_at_one_height(vectors):
    short = state_of(vectors, "INSPVASB pair (ellipsoidal height)")
    extended = state_of(vectors, "INSPVAXB pair (MSL height)")
    assert short.gps_ns == extended.gps_ns
    assert short.height_m == pytest.approx(extended.height_m, abs=1e-4)


def test_other_frames_give_no_state(vectors):
    assert state_of(vectors, "BESTPOSB INS_PPP") is None
    assert state_of(vectors, "LOGB command response OK") is None


@pytest.mark.parametrize("value", [math.nan, math.inf])
@pytest.mark.parametrize("at", [4, 12, 76])
def test_what_is_no_number_gives_no_state(vectors, value, at):
    wire = bytearray(vectors["INSPVASB OEM6"]["wire"][:-4])
    struct.pack_into("<d", wire, 12 + at, value)
    (frame,) = Framer().feed(bytes(wire) + crc32(bytes(wire)).to_bytes(4, "little"), 0)
    assert nav_state(frame) is None


@pytest.mark.parametrize("status", [*range(3), *range(4, 20), 99, 0xFFFFFFFF])
def test_nothing_but_good_is_good(vectors, status):
    head = vectors["INSPVASB OEM6"]["wire"][:-8] + status.to_bytes(4, "little")
    (frame,) = Framer().feed(head + crc32(head).to_bytes(4, "little"), 0)
    assert not nav_state(frame).good


def test_azimuth_follows_the_course_over_ground(driven):
    states = [state for frame in driven if (state := nav_state(frame))]
    assert len(states) == 2289
    assert all(state.good for state in states)
    north, east, _ = np.array([state.velocity_ned_mps for state in states]).T
    azimuth = np.array([state.azimuth_deg for state in states])
    moving = np.hypot(north, east) > 0.5
    course = np.degrees(np.arctan2(east, north))
    off = (course - azimuth + 180) % 360 - 180
    assert moving.sum() > 1000
    assert abs(np.median(off[moving])) < 0.2  # the sheet measured 0.07
    turned = np.bincount((azimuth[moving] // 30).astype(int), minlength=12)
    assert (turned > 0).all()


def test_velocity_is_the_change_of_position(driven):
    states = [state for frame in driven if (state := nav_state(frame))]
    radius_m = 6_371_000.0
    for before, after in itertools.pairwise(states[::20]):
        seconds = (after.gps_ns - before.gps_ns) / 1e9
        assert seconds == pytest.approx(1.0)
    down = np.array([state.velocity_ned_mps[2] for state in states])
    north = np.array([state.velocity_ned_mps[0] for state in states])
    climbed = states[-1].height_m - states[0].height_m
    went_north = math.radians(states[-1].lat_deg - states[0].lat_deg) * radius_m
    assert -down.sum() * 0.05 == pytest.approx(climbed, abs=0.5)
    assert north.sum() * 0.05 == pytest.approx(went_north, abs=0.5)


def test_heights_of_both_logs_are_above_the_same_ellipsoid(driven):
    antenna = {
        (frame.week, frame.ms): BestPos.parse(frame).height_ellipsoidal_m
        for frame in driven
        if frame.message_id == MessageId.BESTPOS
    }
    above = [
        antenna[frame.week, frame.ms] - state.height_m
        for frame in driven
        if (state := nav_state(frame)) and (frame.week, frame.ms) in antenna
    ]
    assert len(above) > 2000
    assert np.median(above) == pytest.approx(0.36, abs=0.02)  # the antenna stands above the IMU
    assert np.std(above) < 0.05


def test_a_receiver_that_never_aligns_gives_nothing_good(captures):
    states = [
        state
        for frame in frames_of(captures, "span_driver_basic_fix_unaligned_10hz.bin")
        if (state := nav_state(frame))
    ]
    assert len(states) == 1988
    assert {state.ins_status for state in states} == {InsStatus.INS_ALIGNING}
    assert not any(state.good for state in states)


def test_copies_on_a_virtual_port_are_dropped_once(captures):
    once = Deduplicator()
    fixes = [
        frame
        for frame in frames_of(captures, "span_driver_basic_fix_unaligned_10hz.bin")
        if frame.message_id == MessageId.BESTPOS
    ]
    assert len(fixes) == 2187
    kept = [frame for frame in fixes if once.is_new(frame)]
    assert len(kept) == len({(frame.week, frame.ms) for frame in fixes}) == 1988


def test_a_week_that_ends_goes_on_in_gps_time(vectors):
    body = bytearray(vectors["INSPVASB OEM6"]["wire"][:-4])

    def at(week, seconds):
        struct.pack_into("<Id", body, 12, week, seconds)
        (frame,) = Framer().feed(bytes(body) + crc32(bytes(body)).to_bytes(4, "little"), 0)
        return nav_state(frame).gps_ns

    assert at(2101, 0.0) - at(2100, 604799.99) == 10_000_000


def test_standard_deviations_are_alike_whichever_log_tells_them(driven):
    extended = {
        (frame.week, frame.ms): accuracy(parse(frame))
        for frame in driven
        if frame.message_id == MessageId.INSPVAX
    }
    compared = 0
    for frame in driven:
        if frame.message_id == MessageId.INSCOV and (beside := extended.get((frame.week, frame.ms))):
            told = accuracy(parse(frame))
            assert told.position_m == pytest.approx(beside.position_m, rel=1e-4)
            assert told.attitude_deg == pytest.approx(beside.attitude_deg, rel=1e-4)
            assert np.linalg.norm(told.velocity_mps) == pytest.approx(
                np.linalg.norm(beside.velocity_mps), rel=1e-3
            )
            compared += 1
    assert compared > 100


def test_every_log_with_standard_deviations_tells_them_and_no_other_does(vectors):
    def told(name):
        (frame,) = Framer().feed(vectors[name]["wire"], 0)
        return accuracy(parse(frame))

    assert told("INSSTDEVB").attitude_deg[2] > 1
    assert told("INSPVAXB driven").position_m == pytest.approx((0.0470, 0.0362, 0.0728), abs=1e-4)
    assert told("INSPVASB OEM6") is None
    assert told("BESTPOSB INS_PPP") is None


def test_a_variance_that_is_none_is_infinitely_uncertain(vectors):
    (frame,) = Framer().feed(vectors["INSCOVB"]["wire"], 0)
    cov = replace(parse(frame), position_cov_m2=(-1.0, *[0.0] * 7, math.nan))
    assert accuracy(cov).position_m == (math.inf, 0.0, math.inf)


def test_what_a_position_rests_on_is_none_where_there_is_no_solution(vectors):
    (frame,) = Framer().feed(vectors["BESTPOSB INS_PPP"]["wire"], 0)
    assert position_type(parse(frame)) is PositionType.INS_PPP
    lost = replace(parse(frame), solution_status=SolutionStatus.INSUFFICIENT_OBS)
    assert position_type(lost) is PositionType.NONE


def test_the_point_that_poses_speak_of_is_named(vectors):
    (frame,) = Framer().feed(vectors["INSCONFIGB"]["wire"], 0)
    config = parse(frame)
    assert reference_point(config) == "the IMU's centre of navigation"
    item = InsOffsetItem(
        InsOffset.USER, OffsetFrame.VEHICLE, (0.5, 1.0, -0.25), (0.0, 0.0, 0.0), OffsetSource.FROM_COMMAND
    )
    told = reference_point(replace(config, translations=(item,)))
    assert told == "the user's point at (0.5, 1, -0.25) m from the IMU's centre of navigation, VEHICLE axes"
    assert "does not say" in reference_point(None)
