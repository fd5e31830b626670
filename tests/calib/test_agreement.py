from dataclasses import replace

import numpy as np
import pytest

from polecal.calib import Mount, Setup, estimate
from polecal.calib.agreement import View, disagreements
from polecal.calib.estimate import passes_of
from polecal.calib.report.rig import Rig, drive

PASSES = 24
FRONT, REAR = Mount(-0.029, -0.36, -0.996, -0.5, -8.2, -2.0), Mount(-0.6, 0.3, -0.95, 0.4, -7.5, 1.2)
SPANS = [(1000 * number, 1000 * number + 600) for number in range(PASSES)]


def look(name, mount, *, seed=0, change=lambda returns: returns, lag=0, hold=(), measured=None, **rig):
    """One laser's view: of one drive whatever the seed is not of, its errors shared by lasers of one seed."""
    driven = Rig(mount, passes=PASSES, speeds_mps=(1.5, 2.5, -1.0), range_sigma_m=0.01)
    returns = change(drive(replace(driven, **rig), np.random.default_rng(seed), 2400, 6000))
    hand = measured or Mount.from_vector(np.round(mount.vector, 1))
    setup = Setup(hand, pole_radius_m=0.04, hold=frozenset(hold))
    passes = passes_of(returns, 30)
    spans = [(first + lag, last + lag) for first, last in SPANS]
    return View.of(name, passes, spans, setup, estimate(passes, setup))


@pytest.fixture(scope="module")
def front():
    return look("front", FRONT)


def test_two_lasers_on_one_vehicle_agree(front, tell):
    found = [disagreements([front, look("rear", REAR, seed=seed, lag=300)]) for seed in range(4)]
    assert found == [()] * 4
    others = [look(f"laser{seed}", REAR, seed=seed) for seed in range(5, 9)]
    assert disagreements(others) == ()


def test_a_laser_whose_position_was_held_where_it_is_not_disagrees(front):
    wrong = replace(REAR, x_m=REAR.x_m + 0.15)
    rear = look("rear", REAR, hold=("x",), measured=wrong)
    rear = replace(rear, covariance=rear.covariance * np.outer(at := np.array([0.1, 1, 1, 1, 1, 1]), at))
    (reason,) = disagreements([front, rear])
    assert "front and rear disagree" in reason
    assert f"in the {PASSES} passes that both see" in reason
    assert "-0.1" in reason, "by so much, with its sign"


def test_what_is_held_disagrees_only_beyond_what_the_tape_is_good_for(front):
    wrong = replace(REAR, x_m=REAR.x_m + 0.15)
    assert disagreements([front, look("rear", REAR, hold=("x",), measured=wrong)]) == ()


def test_lasers_that_took_two_poles_for_one_disagree_though_they_share_no_pass(front):
    def elsewhere(returns):
        return replace(returns, position_m=returns.position_m + np.array([0.4, 0.0, 0.0]))

    rear = look("rear", REAR, seed=3, change=elsewhere, lag=10**9)
    (reason,) = disagreements([front, rear])
    assert "-0.4" in reason
    assert "but one reflector" in reason
    assert disagreements([front, look("rear", REAR, seed=3, lag=10**9)]) == ()


def test_one_laser_has_none_to_disagree_with(front):
    assert disagreements([front]) == disagreements([]) == ()
