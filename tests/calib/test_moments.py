from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from polecal.calib import Kind, Mount, cost
from polecal.calib import moments as m
from polecal.calib.geometry import roll_pitch_yaw, rotation
from polecal.calib.solve import Form, Scatter, cost_m


@pytest.fixture(scope="module")
def returns(rig):
    return rig.drive(noise_m=0.01, nav_m=0.01, passes=8)


def cost_from_moments(pole, ground, mount, *, radius_m=0.0, time_s=0.0):
    """√c of Eq. 7 of one pass."""
    every = np.array([True])
    scatter = Scatter([pole], shift_m=np.pi / 4 * radius_m, ranged=True)
    form = Form(scatter.form(every), Scatter([ground]).form(every))
    return cost_m(form, np.array([*mount.vector, time_s, *[0.0] * 5]))


def split(returns):
    pole = returns.kind == Kind.POLE
    return m.of(returns[pole]), m.of(returns[~pole])


@pytest.mark.parametrize("mount", [Mount(0, -0.35, -1, 0, -8, 0), Mount(0.3, 0.1, -1.2, 4, -11, 170)])
@pytest.mark.parametrize("radius_m", [0.0, 0.05])
def test_cost_from_moments_is_the_cost_of_the_cloud(returns, mount, radius_m):
    pole, ground = split(returns)
    told = cost_from_moments(pole, ground, mount, radius_m=radius_m)
    assert told == pytest.approx(cost(returns, mount, radius_m), rel=1e-9)


def test_moments_of_parts_add_up_and_come_off_again(returns):
    first, rest = returns[:1000], returns[1000:]
    whole = m.of(returns)
    together = m.of(first) + m.of(rest)
    np.testing.assert_allclose(together.second, whole.second, rtol=1e-12, atol=1e-6)
    left = whole - m.of(rest)
    assert left.count == 1000
    np.testing.assert_allclose(left.first, m.of(first).first, rtol=1e-9, atol=1e-6)


def test_moments_of_groups_are_those_of_each_by_itself_however_they_are_mixed(returns):
    rng = np.random.default_rng(0)
    picked, group = rng.permutation(len(returns))[:9000], rng.integers(3, 6, 9000)
    groups = m.by_group(returns, picked, group)
    assert sorted(groups) == [3, 4, 5]
    for number, block in groups.items():
        alone = m.of(returns[picked[group == number]])
        assert block.count == alone.count
        np.testing.assert_allclose(block.first, alone.first, rtol=1e-12, atol=1e-9)
        np.testing.assert_allclose(block.second, alone.second, rtol=1e-12, atol=1e-9)


def test_what_is_not_asked_for_is_left_out_and_the_rest_the_same(returns):
    still = np.zeros((len(returns), 3))
    moving = replace(
        returns,
        velocity_mps=still + 1.0,
        rate_radps=still,
        acceleration_mps2=still,
        angular_acceleration_radps2=still,
    )
    every = np.arange(len(returns))
    whole = m.of(moving)
    least = m.by_group(moving, every, 0 * every, axes=(m.DOWN,), ranged=False, timed=False)[0]
    assert least.features.tolist() == list(range(2 * m.WIDTH, 2 * m.WIDTH + m.BASE.stop))
    np.testing.assert_allclose(least.mean()[m.DOWN, m.BASE], whole.mean()[m.DOWN, m.BASE], rtol=1e-12)
    there = np.ix_(least.features, least.features)
    np.testing.assert_allclose(least.second, whole.second[there], rtol=1e-12, atol=1e-9)
    assert whole.mean()[:, m.RANGE].all()
    assert whole.mean()[:, m.TIME].any()


def test_moments_of_unlike_features_add_up_as_if_what_is_missing_were_nothing(returns):
    every = np.arange(len(returns))
    low, flat = (
        m.by_group(returns, every, 0 * every, axes=axes, ranged=False)[0]
        for axes in ((m.DOWN,), (m.NORTH, m.EAST))
    )
    both = low + flat
    assert both.count == 2 * len(returns)
    np.testing.assert_array_equal(both.mean()[m.DOWN], low.mean()[m.DOWN] / 2)
    assert np.array_equal((both - low).second[:20, :20], flat.second)
    alike = m.alike([low, flat, m.zero()])
    assert all(np.array_equal(one.features, both.features) for one in alike)
    np.testing.assert_array_equal(sum(one.first for one in alike), both.first)
    np.testing.assert_array_equal(sum(one.second for one in alike), both.second)


def test_a_time_offset_moves_every_return_along_the_bodys_motion(returns, rig):
    """The derivatives carried in the moments against poses that really are later, to the square."""
    n, tau = len(returns), 0.04
    rng = np.random.default_rng(1)
    velocity, acceleration = 3 * rng.normal(size=(n, 3)), rng.normal(size=(n, 3))
    rate = 0.5 * rng.normal(size=(n, 3))
    moving = replace(
        returns,
        velocity_mps=velocity,
        rate_radps=rate,
        acceleration_mps2=acceleration,
        angular_acceleration_radps2=np.zeros((n, 3)),
    )
    told = cost_from_moments(*split(moving), rig.true, time_s=tau)
    turned = rotation(returns.rpy_rad) @ Rotation.from_rotvec(tau * rate).as_matrix()
    later = replace(
        returns,
        position_m=returns.position_m + tau * velocity + tau**2 / 2 * acceleration,
        rpy_rad=roll_pitch_yaw(turned),
    )
    assert told == pytest.approx(cost(later, rig.true), rel=1e-3)
    assert told != pytest.approx(cost(returns, rig.true), rel=1e-1)


def test_no_returns_cost_nothing():
    assert m.zero().count == 0
    assert not m.zero().mean().any()
