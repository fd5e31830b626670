import numpy as np
import pytest

from polecal.drivers.emulated.drive import SampledTrajectory
from polecal.drivers.emulated.world import (
    HAND_MEASURED,
    MountPose,
    NavError,
    Reflector,
    World,
    demo_world,
    rotation,
)

LEVEL = MountPose(z_m=-1.0)


def test_rotation_is_yaw_pitch_roll_applied_right_to_left():
    ahead = np.array([1.0, 0, 0])
    nose_down = rotation(np.deg2rad([[0, -8.0, 0]]))[0] @ ahead
    assert nose_down[2] == pytest.approx(np.sin(np.deg2rad(8)))  # Z is down: negative pitch looks down
    east = rotation(np.deg2rad([[0, 0, 90.0]]))[0] @ ahead
    assert east == pytest.approx([0, 1, 0], abs=1e-12)
    right = np.array([0, 1.0, 0])
    assert (rotation(np.deg2rad([[30.0, 0, 90]]))[0] @ right) == pytest.approx([-np.cos(np.pi / 6), 0, 0.5])


def test_the_ground_ahead_at_8_degrees_down(parked):
    range_m, level = parked(pole_ne_m=(50.0, 50.0)).range_scan([0.0], [0.0])
    assert range_m == pytest.approx(1.1 / np.sin(np.deg2rad(8)))  # from 1.1 m up: 7.9 m
    assert level[0] <= 1


def test_the_pole_is_met_at_its_near_side(parked):
    range_m, level = parked(mount=LEVEL).range_scan([0.0], [0.0])
    assert range_m == pytest.approx(5.0 - 0.04)
    assert level[0] >= 6


def test_beams_past_the_pole_miss_it(parked):
    world = parked(mount=LEVEL)
    just = np.arcsin(0.04 / 5.0)
    range_m, _ = world.range_scan(np.zeros(4), np.array([-1.01, -0.99, 0.99, 1.01]) * just)
    assert np.isinf(range_m[[0, 3]]).all()
    assert range_m[[1, 2]] == pytest.approx(np.full(2, 5.0), abs=0.01)


def test_a_beam_over_or_under_the_pole_misses_it(parked):
    up = parked(mount=MountPose(z_m=-1.0, pitch_deg=20.0))  # 1.1 m + 5 m tan 20° = 2.9 m
    assert np.isinf(up.range_scan([0.0], [0.0])[0])
    down = parked(mount=MountPose(z_m=-1.0, pitch_deg=-15.0))  # the ground is at 4.1 m
    range_m, level = down.range_scan([0.0], [0.0])
    assert range_m == pytest.approx(1.1 / np.sin(np.deg2rad(15)))
    assert level[0] <= 1


def test_bearings_are_positive_to_the_right(parked):
    east = parked(mount=LEVEL, pole_ne_m=(3.0, 3.0))
    range_m, _ = east.range_scan(np.zeros(2), np.deg2rad([45.0, -45.0]))
    assert range_m[0] == pytest.approx(np.hypot(3, 3) - 0.04)
    assert np.isinf(range_m[1])


def test_the_mounts_offset_and_yaw_count(parked):
    world = parked(mount=MountPose(1.0, -0.35, -1.0, 0.0, 0.0, 10.0), pole_ne_m=(5.0, -0.35))
    range_m, _ = world.range_scan([0.0], np.deg2rad([-10.0]))
    assert range_m == pytest.approx(4.0 - 0.04)


def test_a_plate_hides_what_is_behind_it(parked):
    plate = Reflector(3.0, 0.0, facing_deg=180.0)
    world = parked(mount=LEVEL, reflectors=[plate])
    bearing = np.arctan2([0.0, 0.14, 0.16], 3.0)
    range_m, level = world.range_scan(np.zeros(3), bearing)
    assert range_m[:2] == pytest.approx([3.0, np.hypot(3.0, 0.14)])
    assert np.all(level[:2] >= 6)
    assert np.isinf(range_m[2])
    turned = parked(mount=LEVEL, reflectors=[Reflector(3.0, 0.0, facing_deg=90.0)])
    assert turned.range_scan([0.0], [0.0])[0] == pytest.approx(5.0 - 0.04)  # edge on


def test_nothing_is_seen_beyond_80_m(parked):
    far = parked(mount=LEVEL, pole_ne_m=(81.0, 0.0))
    assert np.isinf(far.range_scan([0.0], [0.0])[0])
    near = parked(mount=LEVEL, pole_ne_m=(79.0, 0.0))
    assert near.range_scan([0.0], [0.0])[0] == pytest.approx(78.96)


def test_the_poles_edges_are_dimmer_at_times(parked):
    world = parked(mount=LEVEL)
    across = np.repeat([0.0, 0.95], 2000)
    bearing = np.arcsin(across * 0.04 / 5.0)
    _, level = world.range_scan(np.zeros(4000), bearing)
    assert level[:2000].min() >= 6
    assert 0.3 < np.mean(level[2000:] < 6) < 0.7


def test_each_beam_sees_from_where_the_laser_is_at_its_own_time():
    spin = SampledTrajectory(
        [0.0, 1.0], np.tile([0, 0, -0.1], (2, 1)), [[0, 0, 0], [0, 0, 1.0]], np.zeros((2, 3))
    )
    world = World(spin, mount=LEVEL, pole_ne_m=(5.0, 0.0), range_noise_m=0.0)
    t_s = np.array([0.0, 0.2, 0.4])
    assert np.isfinite(world.range_scan(t_s, -t_s)[0]).all()  # turned right by t: the pole is t to the left
    assert np.isinf(world.range_scan(t_s, np.zeros(3))[0][1:]).all()


def test_driving_shortens_the_range_within_one_scan():
    ahead = SampledTrajectory(
        [0.0, 1.0], [[0, 0, -0.1], [3, 0, -0.1]], np.zeros((2, 3)), np.tile([3.0, 0, 0], (2, 1))
    )
    world = World(ahead, mount=LEVEL, pole_ne_m=(10.0, 0.0), range_noise_m=0.0)
    range_m, _ = world.range_scan([0.0, 0.01332, 0.05], [0.0, 0.0, 0.0])
    assert range_m == pytest.approx(9.96 - 3 * np.array([0.0, 0.01332, 0.05]))


def test_noise_is_one_centimetre_and_follows_the_key_not_the_order(parked):
    world = parked(mount=LEVEL, range_noise_m=0.01)
    beams = np.zeros(4000)
    first, _ = world.range_scan(beams, beams, key=7)
    other, _ = world.range_scan(beams, beams, key=8)
    again, _ = world.range_scan(beams, beams, key=7)
    assert np.array_equal(first, again)
    assert not np.array_equal(first, other)
    assert np.std(first) == pytest.approx(0.01, rel=0.1)
    assert np.mean(first) == pytest.approx(4.96, abs=0.001)


def test_world_time_stands_until_the_start(parked):
    world = parked()
    assert world.seconds([5, 10**9]).tolist() == [0.0, 0.0]
    world.start(10**9)
    world.start(5 * 10**9)  # only the first counts
    assert world.seconds([0, 10**9, 3 * 10**9]).tolist() == [0.0, 0.0, 2.0]


def test_the_navigation_error_is_one_value_in_a_pass():
    times = np.array([10.0, 18.0, 27.0])
    error = NavError(times, seed=5)
    for k, t_s in enumerate(times):
        around = error.at(np.linspace(t_s - 2.5, t_s + 2.5, 11))
        assert around == pytest.approx(np.tile(error.values[k], (11, 1)))
    assert error.at(np.array([0.0, 100.0])) == pytest.approx(error.values[[0, 2]])
    steps = np.diff(error.at(np.arange(0, 40, 0.01)), axis=0)
    assert np.all(np.abs(steps) < 0.02 * np.abs(np.diff(error.values, axis=0)).max(axis=0))


def test_navigation_errors_have_the_stated_size():
    values = np.vstack([NavError(np.arange(50) * 9.0, seed).values for seed in range(40)])
    assert np.std(values, axis=0) == pytest.approx(NavError.SIGMA, rel=0.1)
    assert np.abs(np.mean(values, axis=0) / NavError.SIGMA).max() < 0.1


@pytest.mark.parametrize("seed", range(6))
def test_the_demonstrations_laser_is_not_where_it_was_measured(seed):
    world = demo_world(seed)
    error = np.array(
        [getattr(world.mount, name) - getattr(HAND_MEASURED, name) for name in MountPose.__slots__]
    )
    size = np.abs(error)
    assert np.all((size[:3] >= 0.02) & (size[:3] <= 0.06))
    assert 0.5 <= size[3] <= 1.0
    assert 0.6 <= size[4] <= 1.2
    assert 1.5 <= size[5] <= 2.5


@pytest.mark.parametrize("seed", range(3))
def test_the_demonstrations_plate_is_off_the_paths(seed):
    world = demo_world(seed)
    (plate,) = world.reflectors
    off = np.array([plate.north_m, plate.east_m]) - world.pole_ne_m
    assert 5.0 <= np.linalg.norm(off) <= 7.0
    path = world.trajectory.path()
    assert np.min(np.linalg.norm(path - [plate.north_m, plate.east_m], axis=1)) > 0.9


def test_the_demonstration_sees_the_pole_in_every_slice():
    """In the forward passes alone, at least as often as a slice needs."""
    world = demo_world(0)
    bearing = np.deg2rad(50 - 0.25 * np.arange(401))
    offset_s = (np.arange(401) % 4 + (40 + np.arange(401) / 4) / 360) * 0.01332
    counts = np.zeros(12, int)
    for k in range(int(world.trajectory.reverse_from_s / 0.05328)):
        t_s = k * 0.05328 + offset_s
        range_m, level = world.range_scan(t_s, bearing, key=k)
        position, rpy, _ = world.trajectory.pose(t_s[:1])
        near = np.linalg.norm(position[0, :2] - world.pole_ne_m) + 1.0
        counts[int(np.rad2deg(rpy[0, 2]) % 360 // 30)] += np.sum((level >= 6) & (range_m < near))
    assert counts.min() >= 100
