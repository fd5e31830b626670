from dataclasses import astuple, replace
from itertools import product

import numpy as np
import pytest

from polecal.calib import PARAMETERS, Kind, Mount, Returns, points_nav, solve
from polecal.calib import moments as m
from polecal.calib.blas import one_thread
from polecal.calib.observability import can_be_found, information, sensitivity, weak_directions
from polecal.calib.report.rig import Rig, drive

HAND_SIGMA = np.array([0.1, 0.1, 0.1, *np.radians([5.0, 5.0, 5.0]), 0.02, 0.02, *[0.02] * 4])
SLANTED = Mount(0.0, -0.35, -1.0, 0.0, -8.0, 0.0)
ROLL, PITCH, YAW = 3, 4, 5


def on_flat_ground(mount: Mount, *, tilt_deg=0.0, headings=360.0, n=300) -> Returns:
    """Pole returns at any range and bearing, and what of the ground the sensor sees from where it sits."""
    rng = np.random.default_rng(0)
    rpy = np.radians(rng.normal(size=(2 * n, 3)) * [tilt_deg, tilt_deg, 0])
    rpy[:, 2] = np.radians(rng.uniform(0, headings, 2 * n)) if headings else 1.0
    bearing = np.radians(rng.uniform(-50, 50, 2 * n))
    kind = np.repeat(np.array(list(Kind), np.uint8), n)
    returns = Returns(
        np.ones(2 * n), bearing, np.zeros((2 * n, 3)), rpy, kind, np.zeros(2 * n, np.int64), None, None
    )
    down = points_nav(returns, replace(mount, x_m=0, y_m=0, z_m=0))[:, 2]
    ranges = np.where(kind == Kind.POLE, rng.uniform(1, 10, 2 * n), 1.5 / np.maximum(down, 1e-9))
    return replace(returns, range_m=ranges)[(kind == Kind.POLE) | (ranges < 80.0)]


def found(returns, mount):
    return dict(zip(PARAMETERS, can_be_found(information(returns, mount)), strict=True))


@one_thread
def from_moments(returns, mount, unknowns, *, cost_m=0.03):
    """Inverse covariance of the first so many unknowns, were all returns independent."""
    pole = returns.kind == Kind.POLE
    every = np.array([True])
    form = solve.Form(
        solve.Scatter([m.of(returns[pole])], ranged=True).form(every),
        solve.Scatter([m.of(returns[~pole])]).form(every),
    )
    vector = np.concatenate([mount.vector, np.zeros(len(solve.EXTRAS))])
    return form.slope(vector)[1][:unknowns, :unknowns] * len(returns) / cost_m**2


def weakest(returns, mount, unknowns=6):
    told = from_moments(returns, mount, unknowns)
    return weak_directions(told, HAND_SIGMA[:unknowns], solve.UNKNOWNS[:unknowns])


@pytest.mark.parametrize("mount", [SLANTED, Mount(0.4, 0.2, -0.7, 25, 140, -100), Mount(0, 0, 0, 90, -90, 9)])
def test_sensitivity_is_that_of_finite_differences(mount):
    returns = on_flat_ground(mount, tilt_deg=5.0)
    told = sensitivity(returns, mount)
    for axis, size in enumerate([1e-3] * 3 + [1e-3] * 3):  # m, degrees
        step = np.eye(6)[axis] * size
        ahead, back = (Mount(*(astuple(mount) + sign * step)) for sign in (1, -1))
        unit = size if axis < 3 else np.radians(size)
        difference = (points_nav(returns, ahead) - points_nav(returns, back)) / (2 * unit)
        np.testing.assert_allclose(told[:, :, axis], difference, atol=1e-6)


def test_pitch_moves_a_return_as_equation_11_says():
    mount = Mount(0.1, -0.3, -1.0, 20.0, -35.0, 70.0)
    returns = on_flat_ground(mount)
    roll, pitch, yaw = np.radians(astuple(mount)[3:])
    heading = returns.rpy_rad[:, 2]
    c, s = np.cos, np.sin
    r, bearing = returns.range_m, returns.bearing_rad
    north = r * c(bearing) * (-c(heading) * c(yaw) * s(pitch) + s(heading) * s(yaw) * s(pitch)) + r * s(
        bearing
    ) * (c(heading) * c(yaw) * c(pitch) * s(roll) - s(heading) * s(yaw) * c(pitch) * s(roll))
    np.testing.assert_allclose(sensitivity(returns, mount)[:, 0, PITCH], north, atol=1e-12)


def test_position_moves_a_return_by_the_columns_of_the_attitude():
    """Eq. 10: whatever the mount."""
    returns = on_flat_ground(SLANTED)
    told = sensitivity(returns, SLANTED)[:, :, :3]
    np.testing.assert_allclose(told[:, 2], np.tile([0.0, 0.0, 1.0], (len(returns), 1)), atol=1e-15)
    np.testing.assert_allclose(told[:, 0, 0], np.cos(returns.rpy_rad[:, 2]))


@pytest.mark.parametrize("pole_only", [True, False])
def test_tables_1_to_3_over_all_ways_to_mount_the_sensor(pole_only):
    """Roll and pitch cannot be found of a sensor parallel to the ground, upside down or not; else they can.

    Half a turn of pitch is upside down as half a turn of roll is.
    """
    turns = range(-180, 181, 30)
    for roll, pitch, yaw in product(turns, turns, range(-180, 181, 60)):
        mount = Mount(0.0, -0.35, -1.0, roll, pitch, yaw)
        returns = on_flat_ground(mount, n=60)
        if pole_only:
            returns = returns[returns.kind == Kind.POLE]
        level = roll % 180 == 0 and pitch % 180 == 0
        told = found(returns, mount)
        where = (roll, pitch, yaw)
        assert (told["roll"], told["pitch"]) == (not level, not level), where
        assert told["yaw"], where
        assert told["x"], where
        assert told["y"], where
        assert not told["z"], where


def test_z_is_found_once_the_platform_rolls_or_pitches():
    assert not found(on_flat_ground(SLANTED), SLANTED)["z"]
    assert found(on_flat_ground(SLANTED, tilt_deg=0.2), SLANTED)["z"]


def test_x_and_y_are_found_from_pole_returns_once_the_heading_varies():
    for headings, expected in ((0.0, False), (30.0, True)):
        returns = on_flat_ground(SLANTED, headings=headings)
        told = found(returns[returns.kind == Kind.POLE], SLANTED)
        assert (told["x"], told["y"]) == (expected, expected)


def test_information_is_half_the_curvature_of_the_cost_in_moments(rig):
    returns = rig.drive(passes=6, noise_m=0.01)
    told = information(returns, rig.true)
    q = from_moments(returns, rig.true, 6, cost_m=1.0) / len(returns)
    np.testing.assert_allclose(told, q, rtol=1e-9, atol=1e-9)


def test_directions_are_one_sigma_steps_of_the_covariance():
    returns = drive(Rig(SLANTED, passes=12), np.random.default_rng(0), 500, 500)
    inverse = from_moments(returns, SLANTED, 6)
    directions = weak_directions(inverse, HAND_SIGMA[:6])
    assert [one.sigma for one in directions] == sorted((one.sigma for one in directions), reverse=True)
    steps = np.stack([one.step for one in directions])
    np.testing.assert_allclose(steps.T @ steps, np.linalg.inv(inverse), rtol=1e-6, atol=1e-12)


def test_on_flat_ground_z_is_named_and_uneven_ground_advised():
    returns = drive(Rig(SLANTED, tilt_deg=0.1), np.random.default_rng(0), 2000, 2000)
    first, second = weakest(returns, SLANTED)[:2]
    assert first.name == "z"
    assert first.sigma > 1.0 > second.sigma
    assert "planks" in first.drive


def test_one_speed_forward_leaves_x_together_with_the_time_offset_and_another_speed_frees_them():
    still = Rig(SLANTED, tilt_deg=0.0, speeds_mps=(2.0,))
    rng = np.random.default_rng(0)
    hidden = [one for one in weakest(drive(still, rng, 2000, 2000), SLANTED, 7) if "time" in one.name]
    mixed = replace(still, speeds_mps=(2.0, -1.0))
    freed = [one for one in weakest(drive(mixed, rng, 2000, 2000), SLANTED, 7) if "time" in one.name]
    assert hidden[0].name == "x together with the time offset"
    assert "reverse" in hidden[0].drive
    assert freed[0].sigma < hidden[0].sigma / 3


def test_a_level_sensor_is_to_be_tilted():
    level = Mount(0.0, -0.35, -1.0, 0.0, 0.0, 0.0)
    returns = drive(Rig(level, tilt_deg=0.02), np.random.default_rng(0), 2000, 0)
    weak = [one for one in weakest(returns, level) if one.sigma > 1.0]
    assert {"z", "roll", "pitch"} == set(" ".join(one.name for one in weak).split()) - {"and", "together"}
    assert any("tilt the laser" in one.drive for one in weak)


def test_passes_all_one_way_are_to_be_turned_round():
    returns = on_flat_ground(SLANTED, headings=0.5)
    told = weakest(returns, SLANTED)
    assert any({"x", "y"} & set(one.name.replace(",", "").split()) for one in told if one.sigma > 1.0)
    assert any("the other way" in one.drive for one in told if one.sigma > 1.0)


def test_roll_and_yaw_of_a_sensor_that_looks_straight_down_are_one_turn():
    down = Mount(0.0, -0.35, -1.0, 0.0, -90.0, 0.0)
    (first, *_) = weakest(on_flat_ground(down, tilt_deg=2.0), down)
    assert first.name == "roll and yaw together"
    assert first.drive.startswith("take one of the two as measured")
    assert abs(first.step[ROLL]) == pytest.approx(abs(first.step[YAW]))


def test_a_leaning_pole_and_sloping_ground_have_names_and_a_drive():
    names = ("lean_north", "slope_east")
    lean, slope = weak_directions(np.diag([1.0, 100.0]), np.ones(2), names)
    assert lean.name == "the pole's lean north"
    assert "low and high" in lean.drive
    assert slope.name == "the ground's slope east"
    both = weak_directions(np.array([[1.0, 0.99], [0.99, 1.0]]), np.ones(2), ("y", "lean_east"))
    assert both[0].name == "y together with the pole's lean east"
