import numpy as np
import pytest

from polecal.drivers.emulated.drive import Drive, SampledTrajectory

POLE = (12.0, -7.0)


@pytest.fixture(scope="module", params=[0, 1, 7])
def drive(request):
    return Drive(pole_ne_m=POLE, seed=request.param)


@pytest.fixture(scope="module")
def motion(drive):
    t_s = np.arange(0.0, drive.reverse_from_s + 60.0, 0.01)
    return t_s, *drive.pose(t_s)


def test_it_stands_about_8_m_before_the_pole(motion):
    t_s, position, rpy, velocity = motion
    standing = t_s < 5.5
    assert np.all(velocity[standing] == pytest.approx(0.0, abs=1e-9))
    to_pole = np.array(POLE) - position[0, :2]
    assert np.linalg.norm(to_pole) == pytest.approx(8.1, abs=0.2)
    assert to_pole @ [np.cos(rpy[0, 2]), np.sin(rpy[0, 2])] == pytest.approx(8.0)


def test_the_velocity_is_along_the_heading(motion):
    _, _, rpy, velocity = motion
    sideways = velocity[:, 1] * np.cos(rpy[:, 2]) - velocity[:, 0] * np.sin(rpy[:, 2])
    assert np.abs(sideways).max() < 1e-9


def test_the_velocity_is_the_positions_derivative(motion):
    _, position, _, velocity = motion
    measured = (position[2:] - position[:-2]) / 0.02
    assert measured == pytest.approx(velocity[1:-1], abs=2e-3)


def test_nothing_jumps(motion):
    _, position, rpy, velocity = motion
    assert np.abs(np.diff(position, axis=0)).max() < 0.04
    assert np.abs(np.diff(velocity, axis=0)).max() < 0.05
    yaw_rate = np.diff(rpy[:, 2]) / 0.01
    assert np.abs(yaw_rate).max() < np.deg2rad(80)
    assert np.abs(np.diff(yaw_rate)).max() < 0.05  # continuous: no kink in the curvature


def test_cruising_speed_varies_within_bounds(drive, motion):
    t_s, _, _, velocity = motion
    speed = np.hypot(velocity[:, 0], velocity[:, 1])
    cruising = (t_s > 11) & (t_s < drive.reverse_from_s - 6)
    assert speed[cruising].min() > 2.5
    assert speed[cruising].max() < 3.2
    assert np.ptp(speed[cruising]) > 0.4


def test_passes_are_near_on_both_sides_and_meet_all_slices(drive):
    forward = drive.pass_times_s[:22]
    position, rpy, _ = drive.pose(forward)
    heading = rpy[:, 2]
    off = position[:, :2] - POLE
    right = off[:, 1] * np.cos(heading) - off[:, 0] * np.sin(heading)
    ahead = off[:, 0] * np.cos(heading) + off[:, 1] * np.sin(heading)
    assert ahead == pytest.approx(np.zeros(22), abs=0.01)
    assert np.all((np.abs(right) >= 0.9) & (np.abs(right) <= 1.5))
    assert np.all(np.sign(right[1:]) == -np.sign(right[:-1]))
    assert set((np.rad2deg(heading[:19]) % 360 // 30).astype(int)) == set(range(12))
    assert np.all((np.diff(forward) > 7.0) & (np.diff(forward) < 10.0))


def test_tilt_and_height_stay_gentle_and_vary(motion):
    _, position, rpy, _ = motion
    tilt = np.rad2deg(rpy[:, :2])
    assert np.abs(tilt).max() <= 2.5
    assert np.all(np.std(tilt, axis=0) > 0.4)
    assert np.abs(position[:, 2] + 0.1).max() <= 0.03


def test_it_reverses_on_its_own_path_with_the_same_heading(drive):
    there, back = drive.pass_times_s[21], drive.pass_times_s[22]
    assert there < drive.reverse_from_s < back
    (p_there, p_back), (a_there, a_back), (v_there, v_back) = drive.pose([there, back])
    assert p_back == pytest.approx(p_there, abs=0.01)
    assert a_back == pytest.approx(a_there, abs=0.01)
    assert v_there @ v_back < 0
    assert len(drive.pass_times_s) == 44


def test_the_seed_is_the_drive():
    t_s = np.linspace(0, 100, 50)
    once, again, other = (Drive(pole_ne_m=POLE, seed=seed).pose(t_s)[0] for seed in (3, 3, 4))
    assert np.array_equal(once, again)
    assert not np.allclose(once, other)


def test_samples_are_joined_by_lines_through_north():
    rpy = np.deg2rad([[0, 0, 350.0], [0, 0, 10.0]])
    path = SampledTrajectory([0.0, 1.0], [[0, 0, 0], [2, 4, 0]], rpy, [[2, 4, 0], [2, 4, 0]])
    position, attitude, velocity = path.pose([0.5, 2.0])
    assert position.tolist() == [[1, 2, 0], [2, 4, 0]]
    assert np.rad2deg(attitude[0, 2]) == pytest.approx(360.0)
    assert velocity.tolist() == [[2, 4, 0], [0, 0, 0]]
