from dataclasses import astuple, replace

import numpy as np
import pytest

from polecal.calib import Setup, estimate
from polecal.calib.estimate import passes_of
from polecal.calib.report.rig import Rig, drive
from polecal.calib.running import Running


@pytest.mark.parametrize("extras", [frozenset(), frozenset({"range_m", "slope_north"})])
def test_scan_by_scan_the_estimate_comes_to_that_of_all_passes(rig, extras):
    """To Eq. 7 of all of them, but for what is of second order; the estimate without the last pass is not."""
    returns = rig.drive(noise_m=0.01, nav_m=0.02, passes=12, seed=3)
    setup = Setup(rig.measured, pass_error=False, rough_ground=False, extras=extras)
    last = returns.pass_id == 11
    before = estimate(passes_of(returns[~last], 30), setup)
    running = Running(passes_of(returns[~last], 30), setup, before)
    driven = returns[last]
    order = np.random.default_rng(0).permutation(len(driven))
    for start in range(0, len(order), 401):
        current = running.add(driven[order[start : start + 401]])
    whole = estimate(passes_of(returns, 30), setup)
    assert (before.held, set(before.extras)) == (whole.held, set(whole.extras))
    assert astuple(current.mount) == pytest.approx(astuple(whole.mount), abs=5e-5)
    assert current.cost_m == pytest.approx(whole.cost_m, rel=1e-5)
    assert astuple(running.sigma()) == pytest.approx(astuple(whole.sigma), rel=0.01)
    assert astuple(before.sigma) != pytest.approx(astuple(whole.sigma), rel=0.01)
    assert abs(before.mount.x_m - whole.mount.x_m) > 1e-4


def test_the_first_pass_of_another_day_is_not_held_against_the_pole_of_the_day_before(rig):
    """The pole stands elsewhere in n on that day, which must not move what is found."""
    returns = rig.drive(noise_m=0.01, nav_m=0.01, passes=12)
    setup, last = Setup(rig.measured, extras=frozenset()), returns.pass_id == 11
    passes = passes_of(returns[~last], 30)
    before = estimate(passes, setup)
    elsewhere = replace(returns[last], position_m=returns[last].position_m + np.array([3.0, -2.0, 1.0]))
    apart, mistaken = (
        Running(passes, setup, before, site).add(elsewhere).cost_m - before.cost_m for site in (1, None)
    )
    assert abs(apart) < 0.002
    assert mistaken > 0.1


def test_rough_ground_is_taken_off_scan_by_scan_too(rig):
    """To what the closed passes say of how rough it is."""
    rough = Rig(rig.true, passes=12, rough_m=0.03)
    returns = drive(rough, np.random.default_rng(0), 1200, 4800)
    setup = Setup(rig.measured, pass_error=False, extras=frozenset())
    last = returns.pass_id == 11
    before = estimate(passes_of(returns[~last], 30), setup)
    current = Running(passes_of(returns[~last], 30), setup, before).add(returns[last])
    whole = estimate(passes_of(returns, 30), setup)
    plain = estimate(passes_of(returns, 30), replace(setup, rough_ground=False))
    assert current.mount.pitch_deg == pytest.approx(whole.mount.pitch_deg, abs=1e-3)
    assert abs(plain.mount.pitch_deg - whole.mount.pitch_deg) > 1e-2
