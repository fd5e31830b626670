from itertools import pairwise

import pytest

from polecal.calib import KEYS


@pytest.fixture(scope="module")
def asked(begun, settings, drive):
    """A drive that is asked each second how it stands: what it said, and what it came to."""
    played = begun(settings(routine={"min_passes": 99}))
    told, next_ns = [], 0
    for chunk in drive.until(60.0):
        played.feed([chunk])
        if chunk[1] >= next_ns:
            next_ns = chunk[1] + 1_000_000_000
            told.append(played.laser())
    return played, told


def test_a_pass_is_told_of_while_it_is_driven_and_no_longer_once_it_is_over(asked):
    _, told = asked
    assert all(one["passing"] is None for one in told if one["estimate"] is None)
    during = [one for one in told if one["passing"]]
    assert len(during) > 3
    assert any(one["passing"] is None for one in told if one["estimate"])
    for one, later in pairwise(told):
        if one["passing"] and later["passing"] and one["passes"] == later["passes"]:
            assert later["passing"]["pole_returns"] >= one["passing"]["pole_returns"]


def test_what_an_open_pass_says_comes_near_what_it_says_once_it_is_closed(asked):
    """Within what the pass still brings: σ of the closed ones."""
    _, told = asked
    last = [
        (one["passing"], later)
        for one, later in pairwise(told)
        if one["passing"] and later["passes"] == one["passes"] + 1 and later["held"] == one["held"]
    ]
    assert last
    for passing, later in last:
        assert passing["cost_m"] == pytest.approx(later["cost_m"], rel=0.25)
        for key in KEYS:
            off = abs(passing["estimate"][key] - later["estimate"][key])
            assert off <= 2 * max(passing["sigma"][key], later["sigma"][key]), key


def test_to_ask_changes_nothing(asked, begun, settings, drive):
    played, _ = asked
    unasked = begun(settings(routine={"min_passes": 99})).feed(drive.until(60.0))
    assert unasked.finish().pipeline.calibration() == played.finish().pipeline.calibration()
    assert played.laser()["passing"] is None


def test_where_nobody_looks_on_it_is_not_worked_out(asked):
    played, _ = asked
    assert "passing" not in played.pipeline.status(passing=False)["lasers"][0]
