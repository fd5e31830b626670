from dataclasses import astuple, replace

import numpy as np
import pytest
from scipy.optimize import minimize

from polecal.calib import (
    CalibrationError,
    Criteria,
    Kind,
    Mount,
    Need,
    Returns,
    Setup,
    calibrate,
    cost,
    estimate,
    points_nav,
)
from polecal.calib.estimate import passes_of
from polecal.calib.geometry import rotation
from polecal.calib.observations import PARAMETERS
from polecal.calib.report.rig import Rig, drive


def errors(found, true):
    return np.abs(np.array(astuple(found)) - astuple(true))


def test_without_noise_the_true_mount_is_found_exactly(rig):
    exact = rig.drive(passes=12)
    result = calibrate(exact, rig.measured)
    assert errors(result.mount, rig.true).max() < 5e-3
    assert result.cost_m < 1e-3
    assert result.measured_cost_m > 10 * result.cost_m


def test_pole_of_a_radius_is_calibrated_without_bias_only_when_it_is_told(rig):
    returns = rig.drive(noise_m=0.01, nav_m=0.012, radius_m=0.06, seed=5)
    with_radius = calibrate(returns, rig.measured, pole_radius_m=0.06)
    without = calibrate(returns, rig.measured)
    assert abs(with_radius.mount.x_m - rig.true.x_m) < 0.012
    assert abs(without.mount.x_m - rig.true.x_m) > 0.025


def test_result_is_the_minimum_that_sqp_on_the_cloud_finds(rig):
    """The paper's way: SQP, the cloud recomputed at every evaluation; noise and all."""
    returns = rig.drive(noise_m=0.02, nav_m=0.02, passes=12, seed=2)
    anything = Mount(9, 9, 9, 900, 900, 900)
    result = calibrate(
        returns, rig.measured, measured_sigma=anything, criteria=Criteria(max_sigma=(9.0,) * 6)
    )
    scale = np.array([1, 1, 1, 10, 10, 10.0])

    def of(values):
        return 1e3 * cost(returns, Mount(*(values * scale))) ** 2

    start = np.add(astuple(result.mount), [0.01, -0.01, 0.01, 0.3, 0.2, -0.3])
    slsqp = minimize(of, start / scale, method="SLSQP", options={"ftol": 1e-13, "maxiter": 300})
    assert result.cost_m <= np.sqrt(slsqp.fun / 1e3) + 1e-9
    assert result.cost_m == pytest.approx(cost(returns, result.mount), abs=1e-12)


def test_errors_stay_within_three_claimed_sigma(rig):
    worst = []
    for seed in range(6):
        returns = rig.drive(noise_m=0.01, nav_m=0.012, radius_m=0.04, seed=seed)
        result = calibrate(returns, rig.measured, pole_radius_m=0.04)
        worst.append((errors(result.mount, rig.true) / astuple(result.sigma)).max())
    assert np.median(worst) < 3.0


def test_on_a_flat_pad_z_is_held_as_measured_and_said_to_be(rig):
    returns = rig.drive(noise_m=0.01, nav_m=0.012, tilt_deg=0.1, seed=3)
    result = calibrate(returns, rig.measured)
    assert "z" in result.held
    assert result.mount.z_m == rig.measured.z_m
    assert result.sigma.z_m == pytest.approx(0.1), "what is held is as good as the tape"
    assert result.covariance[2, 2] == pytest.approx(0.01)


def test_a_level_sensor_has_roll_and_pitch_held(rig):
    level = Mount(0.0, -0.3, -1.0, 0.0, 0.0, 2.0)
    returns = rig.drive(mount=level, noise_m=0.01, nav_m=0.01, tilt_deg=0.0)
    returns = returns[returns.kind == Kind.POLE]
    result = calibrate(returns, replace(level, yaw_deg=0.0))
    assert {"roll", "pitch"} <= set(result.held)
    assert result.mount.yaw_deg == pytest.approx(2.0, abs=0.15)


def test_what_is_asked_to_be_held_stays(rig):
    result = calibrate(rig.drive(passes=12), rig.measured, hold=["roll", "x"])
    assert result.mount.roll_deg == rig.measured.roll_deg
    assert result.mount.x_m == rig.measured.x_m
    assert {"x", "roll"} <= set(result.held)


def test_a_mount_that_is_half_a_turn_off_is_found_all_the_same(rig):
    wrong = replace(rig.measured, yaw_deg=180.0)
    result = calibrate(rig.drive(noise_m=0.005, passes=12), wrong)
    assert errors(result.mount, rig.true)[3:].max() < 0.3
    assert any("from the hand measurement" in reason for reason in result.verdict.reasons)
    assert not result.verdict.accepted


def test_the_same_rotation_is_never_shown_by_its_other_three_angles(rig):
    for seed in range(4):
        result = calibrate(rig.drive(noise_m=0.01, nav_m=0.01, tilt_deg=0.2, seed=seed), rig.measured)
        assert abs(result.mount.roll_deg) < 10


def test_verdict_names_slices_without_a_pass(rig):
    returns = rig.drive(passes=12, noise_m=0.01)
    seen = returns[~np.isin(returns.pass_id, (3, 4))]
    result = calibrate(seen, rig.measured, need=Need(min_pole_returns=20))
    assert not result.verdict.accepted
    assert any("slices 3, 4 have no pass" in reason for reason in result.verdict.reasons)
    assert not result.verdict.hopeless


def test_verdict_accepts_a_good_drive_and_gives_up_on_a_hopeless_one(rig):
    good = calibrate(rig.drive(noise_m=0.01, nav_m=0.012), rig.measured, need=Need(min_pole_returns=20))
    assert good.verdict.accepted
    assert good.verdict.reasons == ()
    bad = calibrate(
        rig.drive(noise_m=0.01, nav_m=0.2),
        rig.measured,
        need=Need(min_pole_returns=20),
        criteria=Criteria(improvement=0.5),
    )
    assert not bad.verdict.accepted
    assert bad.verdict.hopeless
    assert any("cost" in reason for reason in bad.verdict.reasons)


def test_either_criterion_is_enough_where_any_is_asked_for(rig):
    drive = rig.drive(noise_m=0.05, nav_m=0.05)
    loose = (0.1, 0.1, 0.1, 0.1, 0.1, 0.1)
    criteria = Criteria(cost_m=0.001, improvement=0.9, mode="any", max_sigma=loose)
    assert calibrate(drive, rig.measured, criteria=criteria, need=Need(min_pole_returns=20)).verdict.accepted
    strict = replace(criteria, mode="all")
    verdict = calibrate(drive, rig.measured, criteria=strict, need=Need(min_pole_returns=20)).verdict
    assert not verdict.accepted


def test_too_little_is_refused_with_what_to_do(rig):
    drive = rig.drive(passes=12)
    with pytest.raises(CalibrationError, match="pole returns are too few") as caught:
        calibrate(drive[drive.kind == Kind.GROUND], rig.measured)
    assert "tape" in caught.value.hint


def test_arrays_that_do_not_fit_are_refused():
    one, three = np.ones(2), np.ones((2, 3))
    kind, number = np.zeros(2, np.uint8), np.zeros(2, np.int64)
    with pytest.raises(CalibrationError, match="rpy_rad has shape"):
        Returns(one, one, three, one, kind, number)
    with pytest.raises(CalibrationError, match="range_m holds"):
        Returns(one * np.nan, one, three, three, kind, number)


def test_covariance_is_in_the_order_of_the_parameters(rig):
    result = calibrate(rig.drive(noise_m=0.01, nav_m=0.01), rig.measured)
    sigma = np.sqrt(np.diag(result.covariance))
    assert sigma[0] == pytest.approx(result.sigma.x_m)
    assert np.degrees(sigma[5]) == pytest.approx(result.sigma.yaw_deg)
    assert PARAMETERS == ("x", "y", "z", "roll", "pitch", "yaw")


def at_speeds(returns, speeds_mps):
    """Each pass at a speed of its own, by a laser whose stamps are 20 ms early.

    A vehicle goes where it points, up and down, too: else x would lift the ground, and time would not.
    """
    speed = np.asarray(speeds_mps)[returns.pass_id % len(speeds_mps)]
    velocity = speed[:, None] * rotation(returns.rpy_rad)[:, :, 0]
    still = np.zeros((len(returns), 3))
    return replace(
        returns,
        position_m=returns.position_m - 0.02 * velocity,
        velocity_mps=velocity,
        rate_radps=still,
        acceleration_mps2=still,
        angular_acceleration_radps2=still,
    )


def test_a_time_offset_is_held_at_zero_where_every_pass_is_driven_forward_at_one_speed(rig):
    returns = at_speeds(rig.drive(noise_m=0.01, nav_m=0.005), [3.0])
    result = calibrate(returns, rig.measured, pass_error=True, extras=["time_s"])
    assert result.extras == {}
    assert result.mount.x_m == pytest.approx(rig.true.x_m + 0.06, abs=0.01), "it looks like x"
    assert result.sigma.x_m == pytest.approx(0.03, abs=0.005), "10 ms are 3 cm at 3 m/s"
    assert any(reason.startswith("x is known to ±") for reason in result.verdict.reasons)


def test_a_time_offset_is_told_from_x_by_passes_in_reverse(rig):
    returns = at_speeds(rig.drive(noise_m=0.01, nav_m=0.005), [3.0, -2.0, 1.0])
    result = calibrate(returns, rig.measured, pass_error=True, extras=["time_s"])
    assert result.extras["time_s"] == pytest.approx(0.02, abs=0.002)
    assert result.extra_sigma["time_s"] < 0.002
    assert result.mount.x_m == pytest.approx(rig.true.x_m, abs=0.01)


def test_a_pass_that_disagrees_is_set_aside_and_named(rig):
    good = rig.drive(noise_m=0.01, nav_m=0.01, seed=7)
    jumped = good.position_m + np.where(good.pass_id == 5, 0.3, 0.0)[:, None] * [1.0, 0.5, 0.0]
    result = calibrate(replace(good, position_m=jumped), rig.measured, pass_error=True)
    assert list(result.set_aside) == [5]
    assert "its pole is 0.3" in result.set_aside[5]
    assert result.passes == 23
    assert errors(result.mount, rig.true)[:2].max() < 0.01
    assert calibrate(good, rig.measured, pass_error=True).set_aside == {}


def test_passes_are_not_set_aside_where_half_of_them_disagree(rig):
    good = rig.drive(noise_m=0.01, nav_m=0.01, seed=7)
    halves = good.position_m + np.where(good.pass_id % 2, 0.3, 0.0)[:, None] * [1.0, 0.0, 0.0]
    result = calibrate(replace(good, position_m=halves), rig.measured, pass_error=True)
    assert len(result.set_aside) <= 6
    assert not result.verdict.accepted


def with_extra(returns, rig, **extra):
    """The same returns of a pole that leans, ground that slopes, or a reflector that shortens ranges."""
    points = points_nav(returns, rig.true)
    pole = (returns.kind == Kind.POLE)[:, None]
    lean, slope, range_m = extra.get("lean", 0.0), extra.get("slope", 0.0), extra.get("range_m", 0.0)
    shift = np.where(pole, [-lean, 0, 0] * points[:, 2:], [0, 0, -slope] * points[:, :1])
    shifted = replace(returns, position_m=returns.position_m + shift)
    return replace(shifted, range_m=returns.range_m - np.where(pole[:, 0], range_m, 0.0))


@pytest.mark.parametrize(
    ("name", "made", "sigma"),
    [
        ("lean_north", {"lean": 0.03}, 0.004),
        ("slope_north", {"slope": 0.01}, 0.001),
        ("range_m", {"range_m": 0.03}, 0.004),
    ],
)
def test_what_else_shifts_the_cloud_is_found_and_leaves_the_mount_better(rig, name, made, sigma):
    """Each extra on data that has it: found, the cost lower, and the mount no further from the truth."""
    returns = with_extra(rig.drive(noise_m=0.01, nav_m=0.008, tilt_deg=3.0, seed=4), rig, **made)
    (true,) = made.values()
    with_it = calibrate(returns, rig.measured, pass_error=True, extras=[name])
    without = calibrate(returns, rig.measured, pass_error=True)
    assert with_it.extras[name] == pytest.approx(true, abs=3 * sigma)
    assert with_it.cost_m < without.cost_m
    bad = errors(without.mount, rig.true)
    assert (errors(with_it.mount, rig.true) / [1, 1, 5, 57, 57, 57]).max() < max(
        0.01, (bad / [1, 1, 5, 57, 57, 57]).max()
    )


SETUP = Setup(
    Mount(0.0, -0.35, -1.0, 0.0, -8.0, 0.0),
    pole_radius_m=0.04,
    extras=frozenset(),
    criteria=Criteria(max_sigma=(1.0,) * 6),  # so that z is not held
)


def errors_of_many_drives(rig, *setups, seeds=20, passes=12, grounds=120, **of_rig):
    """The six unknowns' errors in drives with the same pole, but other ground, ways and noise: mm and °."""
    drives = Rig(rig.true, passes=passes, speeds_mps=(1.5, 2.5, -1.0), **of_rig)
    errors = []
    for seed in range(seeds):
        returns = drive(drives, np.random.default_rng(seed), 60 * passes, grounds * passes)
        results = [estimate(passes_of(returns, 30), setup) for setup in setups]
        errors.append([result.mount.vector - rig.true.vector for result in results])
    return np.moveaxis(errors, 1, 0) * [1e3, 1e3, 1e3, *np.degrees([1, 1, 1])]


def rms(errors):
    return np.sqrt((errors**2).mean(axis=0))


def test_rough_ground_is_seen_as_steeply_as_it_is_where_its_bias_is_taken_off(rig):
    plain = replace(SETUP, rough_ground=False)
    without, with_it = errors_of_many_drives(rig, plain, SETUP, rough_m=0.03)
    pitch = PARAMETERS.index("pitch")
    assert without[:, pitch].mean() > 0.025
    assert abs(with_it[:, pitch].mean()) < 0.01
    assert rms(with_it)[pitch] < 0.6 * rms(without)[pitch]
    assert (rms(with_it) < 1.2 * rms(without)).all()


def test_taking_rough_grounds_bias_off_changes_nothing_on_smooth_ground(rig):
    rough, plain = (replace(SETUP, by_kind=False, rough_ground=on) for on in (True, False))
    without, with_it = errors_of_many_drives(rig, plain, rough, rough_m=0.0, seeds=8)
    assert np.abs(with_it - without).max() < 0.1
    assert np.abs(with_it - without)[:, 3:].max() < 0.001


def test_roughness_that_is_sought_does_no_harm_on_smooth_ground(rig):
    plain = replace(SETUP, rough_ground=False)
    without, with_it = errors_of_many_drives(rig, plain, SETUP, rough_m=0.0)
    assert (rms(with_it) < 1.1 * rms(without)).all()
    assert (rms(with_it - without) < 0.25 * rms(without)).all()


def test_passes_with_errors_of_their_own_are_weighed_down_to_the_good_of_all_unknowns(rig):
    """Navigation off by 3 cm a pass: Eq. 7 as it is takes each pass for as many independent returns."""
    as_eq7 = replace(SETUP, pass_error=False)
    off = {"position_sigma_m": (0.03, 0.03, 0.03)}
    without, with_it = errors_of_many_drives(rig, as_eq7, SETUP, seeds=40, **off)
    assert (rms(with_it) < rms(without)).all()
    assert (rms(with_it)[2:] < 0.7 * rms(without)[2:]).all()


def test_passes_without_errors_of_their_own_are_as_good_as_by_eq7(rig):
    as_eq7 = replace(SETUP, pass_error=False)
    exact = {"position_sigma_m": (0.0, 0.0, 0.0), "rpy_sigma_deg": (0.0, 0.0, 0.0)}
    without, with_it = errors_of_many_drives(rig, as_eq7, SETUP, **exact)
    assert (rms(with_it) < 1.2 * rms(without)).all()


def test_a_thick_pole_does_not_look_nearer_where_passes_have_errors_of_their_own(rig):
    """Its returns to the side lie off at a bearing, which a range offset would narrow."""
    setup = replace(SETUP, pole_radius_m=0.06, extras=frozenset({"range_m"}))
    drives = Rig(rig.true, passes=36, pole_radius_m=0.06, rough_m=0.0, speeds_mps=(1.5, 2.5, -1.0))
    ranges_m = []
    for seed in range(12):
        returns = drive(drives, np.random.default_rng(seed), 3600, 1200)
        result = estimate(passes_of(returns, 30), setup)
        ranges_m.append(result.extras["range_m"])
    assert np.mean(ranges_m) == pytest.approx(0.0, abs=0.0025)


AS_EQ7 = replace(SETUP, by_kind=False)


def test_kinds_that_count_as_passes_agree_best_tell_yaw_and_position_better(rig):
    without, with_it = (rms(of) for of in errors_of_many_drives(rig, AS_EQ7, SETUP, grounds=1500))
    assert (with_it < 1.2 * without).all()
    assert np.linalg.norm(with_it[:2]) < 0.95 * np.linalg.norm(without[:2])
    assert with_it[5] < 0.7 * without[5]
