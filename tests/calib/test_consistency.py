import numpy as np
import pytest

from polecal.calib import Setup, estimate, points_nav
from polecal.calib.consistency import jump
from polecal.calib.estimate import passes_of
from polecal.calib.observations import PARAMETERS, Kind, cost

ANY = (0.0,) * 6


def without_each(values):
    """Means of so many rows (P, 12) without each: what leaving a pass out does to the simplest estimate."""
    return (values.sum(axis=0) - values) / (len(values) - 1)


def test_where_an_unknown_became_another_is_found_and_by_how_much():
    rng = np.random.default_rng(0)
    for slip in (3, 12, 23):
        values = 0.01 * rng.normal(size=(24, 12))
        values[slip:, 5] += 0.2
        found = jump(without_each(values), ANY)
        assert found is not None
        assert (PARAMETERS[found.index], found.first_passes) == ("yaw", slip)
        assert found.by == pytest.approx(0.2, abs=0.03)


def test_a_jump_that_matters_is_not_hidden_by_a_clearer_one_that_does_not():
    values = np.random.default_rng(0).normal(size=(24, 12)) * ([1e-4] * 3 + [0.01] * 9)
    values[12:, 0] += 0.002
    values[12:, 5] += 0.05
    matters = (0.02, 0.02, 0.02, 1e-3, 1e-3, 1e-3)
    clearest, found = jump(without_each(values), ANY), jump(without_each(values), matters)
    assert [PARAMETERS[each.index] for each in (clearest, found) if each] == ["x", "yaw"]


def test_nothing_jumps_where_passes_but_scatter(tell):
    rng = np.random.default_rng(1)
    drives = 2000
    drawn = (rng.normal(size=(12 + n % 24, 12)) for n in range(drives))
    alarms = sum(jump(without_each(values), ANY) is not None for values in drawn)
    tell(f"{alarms} jumps found in {drives} drives without one")
    assert alarms <= 30  # one in a hundred is asked for, at most


def test_angles_on_both_sides_of_half_a_turn_are_no_jump():
    values = 0.01 * np.random.default_rng(2).normal(size=(16, 12))
    left_out = without_each(values)
    left_out[:, 5] = (left_out[:, 5] + 2 * np.pi) % (2 * np.pi) - np.pi
    assert jump(left_out, ANY) is None


def test_of_few_passes_nothing_is_said():
    values = np.zeros((7, 12))
    values[4:] = 1.0
    assert jump(without_each(values), ANY) is None


def test_passes_left_out_cost_what_the_cloud_says(rig):
    """By hand: each pass's returns at the mount found without it, about the others' mean there."""
    returns = rig.drive(noise_m=0.01, nav_m=0.02, passes=8, seed=2)
    passes = passes_of(returns, 30)
    setup = Setup(rig.measured, pass_error=False, rough_ground=False, extras=frozenset())
    whole = estimate(passes, setup)
    squares = {kind: 0.0 for kind in Kind}
    for one in passes:
        mount = estimate([other for other in passes if other is not one], setup).mount
        cloud = {kind: points_of(returns, mount, kind) for kind in Kind}
        for kind, axes in ((Kind.POLE, [0, 1]), (Kind.GROUND, [2])):
            points, number = cloud[kind]
            mean = points[number != one.id][:, axes].mean(axis=0)
            squares[kind] += ((points[number == one.id][:, axes] - mean) ** 2).sum()
    by_hand = sum(squares[kind] / np.count_nonzero(returns.kind == kind) for kind in Kind)
    assert whole.left_out_m == pytest.approx(np.sqrt(by_hand), rel=1e-4)
    assert whole.left_out_m > whole.cost_m == pytest.approx(cost(returns, whole.mount))


def points_of(returns, mount, kind):
    some = returns[returns.kind == kind]
    return points_nav(some, mount), some.pass_id
