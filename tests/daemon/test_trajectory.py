"""Poses between poses: where the body was when a beam left, or that this is not known."""

import numpy as np
import pymap3d
import pytest
from scipy.spatial.transform import Rotation

from polecal.daemon.trajectory import Trajectory
from polecal.drivers.novatel_span import InsStatus, NavState

PERIOD_NS = 10_000_000
ORIGIN = (-33.889, 151.193, 60.0)
GPS_NS = 2400 * 604_800 * 10**9


def state(gps_ns, ned=(0.0, 0.0, 0.0), rpy_deg=(0.0, 0.0, 0.0)):
    lat, lon, height = pymap3d.ned2geodetic(*ned, *ORIGIN)
    return NavState(
        gps_ns,
        float(lat),
        float(lon),
        float(height),
        (0.0, 0.0, 0.0),
        *(float(angle) for angle in rpy_deg),
        InsStatus.INS_SOLUTION_GOOD,
        None,
        None,
        None,
        None,
        "INSPVAS",
    )


@pytest.fixture
def trajectory():
    return Trajectory(PERIOD_NS * 1e-9)


def at(trajectory, *periods):
    """Poses at so many periods after the first."""
    return trajectory.path(np.array([GPS_NS + round(count * PERIOD_NS) for count in periods])).poses()


def test_the_first_pose_is_the_origin(trajectory):
    trajectory.add(state(GPS_NS))
    trajectory.add(state(GPS_NS + PERIOD_NS))
    assert trajectory.origin == pytest.approx(ORIGIN, abs=1e-9)
    assert np.abs(at(trajectory, 0).position_m).max() < 1e-6


def test_a_beam_between_two_poses_is_where_its_time_says(trajectory):
    trajectory.add(state(GPS_NS))
    trajectory.add(state(GPS_NS + PERIOD_NS, (0.04, -0.02, 0.01), (1.0, -2.0, 4.0)))
    poses = at(trajectory, 0, 0.25, 1)
    assert poses.known.all()
    for row, part in enumerate((0, 0.25, 1)):
        assert poses.position_m[row] == pytest.approx(part * np.array([0.04, -0.02, 0.01]), abs=1e-6)
        assert np.degrees(poses.rpy_rad[row]) == pytest.approx(part * np.array([1.0, -2.0, 4.0]))
    assert poses.velocity_mps[1] == pytest.approx([4.0, -2.0, 1.0], abs=1e-4)


@pytest.mark.parametrize(
    ("before_deg", "after_deg"), [(359.0, 1.0), (1.0, 359.0), (-0.5, 1.5), (179.0, 181.0)]
)
def test_heading_turns_the_short_way_round(trajectory, before_deg, after_deg):
    trajectory.add(state(GPS_NS, rpy_deg=(0, 0, before_deg)))
    trajectory.add(state(GPS_NS + PERIOD_NS, rpy_deg=(0, 0, after_deg)))
    poses = at(trajectory, 0.5)
    way_deg = (after_deg - before_deg + 180) % 360 - 180
    off = np.degrees(poses.rpy_rad[0, 2]) - (before_deg + way_deg / 2)
    assert (off + 180) % 360 - 180 == pytest.approx(0, abs=1e-9)
    assert poses.rate_radps[0, 2] == pytest.approx(np.radians(way_deg) / 0.01)


def test_many_turns_do_not_add_up_to_an_error(trajectory):
    for number in range(1500):
        trajectory.add(state(GPS_NS + number * PERIOD_NS, rpy_deg=(0, 0, number * 7.0 % 360)))
    poses = at(trajectory, 1400.5)
    assert np.degrees(poses.rpy_rad[0, 2]) % 360 == pytest.approx(1400.5 * 7.0 % 360)


def test_nothing_is_said_of_times_before_the_first_and_after_the_last(trajectory):
    for number in range(3):
        trajectory.add(state(GPS_NS + number * PERIOD_NS))
    assert at(trajectory, -0.001, 0, 2, 2.001).known.tolist() == [False, True, True, False]


@pytest.mark.parametrize(("periods", "known"), [(1.0, True), (2.5, True), (2.6, False), (30.0, False)])
def test_a_gap_of_more_than_two_and_a_half_periods_is_not_bridged(trajectory, periods, known):
    for moment in (0, 1, 1 + periods, 2 + periods):
        trajectory.add(state(GPS_NS + round(moment * PERIOD_NS)))
    poses = at(trajectory, 0.5, 1 + periods / 2, 1.5 + periods)
    assert poses.known.tolist() == [True, known, True]


def test_with_one_pose_or_none_nothing_is_known(trajectory):
    assert not at(trajectory, 0, 1).known.any()
    trajectory.add(state(GPS_NS))
    assert not at(trajectory, 0, 1).known.any()


def test_no_times_give_no_poses(trajectory):
    trajectory.add(state(GPS_NS))
    trajectory.add(state(GPS_NS + PERIOD_NS))
    assert at(trajectory).position_m.shape == (0, 3)


def test_a_time_that_does_not_go_on_is_passed_over(trajectory):
    trajectory.add(state(GPS_NS))
    trajectory.add(state(GPS_NS + PERIOD_NS, (1.0, 0, 0)))
    trajectory.add(state(GPS_NS + PERIOD_NS, (9.0, 0, 0)))
    trajectory.add(state(GPS_NS + PERIOD_NS // 2, (9.0, 0, 0)))
    trajectory.add(state(GPS_NS + 2 * PERIOD_NS, (2.0, 0, 0)))
    assert at(trajectory, 0.5, 1, 1.5).position_m[:, 0] == pytest.approx([0.5, 1.0, 1.5], abs=1e-5)
    assert trajectory.last_ns == GPS_NS + 2 * PERIOD_NS


def test_velocity_and_body_rates_are_the_motions_own(trajectory):
    """Against differences of rotation matrices, not of Euler angles."""

    def motion(t_s):
        ned = np.array([12 * np.sin(0.4 * t_s), 9 * np.cos(0.5 * t_s), 0.3 * np.sin(t_s)])
        return ned, np.array([20 * np.sin(1.1 * t_s), 15 * np.cos(0.7 * t_s), 300 + 50 * t_s])

    def turned(t_s):
        return Rotation.from_euler("ZYX", motion(t_s)[1][::-1], degrees=True)

    for number in range(400):
        t_s = number * 0.01
        trajectory.add(state(GPS_NS + number * PERIOD_NS, *motion(t_s)))
    periods = np.arange(0.5, 398, 7.0)
    poses = at(trajectory, *periods)
    step_s = 1e-5
    for row, t_s in enumerate(periods * 0.01):
        body_rate = (turned(t_s - step_s).inv() * turned(t_s + step_s)).as_rotvec() / (2 * step_s)
        assert poses.rate_radps[row] == pytest.approx(body_rate, abs=2e-4)
        velocity = (motion(t_s + step_s)[0] - motion(t_s - step_s)[0]) / (2 * step_s)
        assert poses.velocity_mps[row] == pytest.approx(velocity, abs=1e-3)


def test_the_last_ten_seconds_at_200_hz_are_kept_and_no_more_than_twice_that():
    trajectory = Trajectory(0.005)
    count = 10_000
    for number in range(count):
        trajectory.add(state(GPS_NS + number * 5_000_000, (number * 0.01, 0, 0)))
    last_ns = trajectory.last_ns
    assert last_ns == GPS_NS + (count - 1) * 5_000_000
    ages_s = np.array([0.0, 0.0025, 5.0, 10.0, 25.0])
    poses = trajectory.path(last_ns - np.round(ages_s * 1e9).astype(np.int64)).poses()
    assert poses.known.tolist() == [True, True, True, True, False]
    assert poses.position_m[:4, 0] == pytest.approx((count - 1) * 0.01 - ages_s[:4] * 2.0, abs=1e-3)
