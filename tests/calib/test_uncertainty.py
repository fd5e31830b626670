import numpy as np
import pytest
from scipy.stats import chi2, norm, t

from polecal.calib.uncertainty import from_model, jackknife, reach

RUNS = 4000


def test_jackknife_of_a_mean_is_its_standard_error():
    values = np.random.default_rng(0).normal(size=(15, 7)) * 1e-3
    left_out = (values.sum(axis=0) - values) / 14
    assert jackknife(left_out) == pytest.approx(np.cov(values.T) / 15)


def test_jackknife_goes_the_short_way_round_half_a_turn():
    values = np.random.default_rng(0).normal(size=(15, 7)) * 1e-3
    turned = values + np.pi * (np.arange(7) == 5)
    turned[:, 5] = (turned[:, 5] + np.pi) % (2 * np.pi) - np.pi
    assert np.ptp(turned[:, 5]) > 6
    assert jackknife(turned) == pytest.approx(jackknife(values))


def test_what_the_data_say_nothing_about_has_a_huge_variance_and_what_is_held_none():
    information = np.diag([4.0, 0.0, 1.0])
    covariance = from_model(information, 0.01, 100, np.array([True, True, False]))
    assert covariance[0, 0] == pytest.approx(0.01 / 100 / 4)
    assert covariance[1, 1] > 1e6
    assert covariance[2, 2] == 0.0


def test_reach_of_one_unknown_is_students_and_of_many_passes_the_normal_laws():
    for passes in (4, 12, 36):
        assert reach(passes) == pytest.approx(t.ppf(0.975, passes - 1))
        assert reach(passes, level=0.5) == pytest.approx(t.ppf(0.75, passes - 1))
    assert reach(10**6) == pytest.approx(norm.ppf(0.975), rel=1e-5)
    assert reach(10**6, 6) == pytest.approx(np.sqrt(chi2.ppf(0.95, 6)), rel=1e-4)


def test_passes_no_more_than_unknowns_bound_nothing():
    assert reach(6, 6) == np.inf
    assert np.isfinite(reach(7, 6))


@pytest.mark.parametrize(("passes", "unknowns"), [(5, 1), (8, 3), (12, 6), (36, 11)])
def test_regions_of_reach_hold_the_truth_as_often_as_they_say(passes, unknowns):
    rng = np.random.default_rng(passes)
    mixed = rng.normal(size=(unknowns, unknowns)) * 1e-3
    held = 0
    for _ in range(RUNS):
        values = rng.normal(size=(passes, unknowns)) @ mixed
        mean = values.mean(axis=0)
        covariance = jackknife((values.sum(axis=0) - values) / (passes - 1))
        held += mean @ np.linalg.solve(covariance, mean) < reach(passes, unknowns) ** 2
    assert held / RUNS == pytest.approx(0.95, abs=3 * np.sqrt(0.95 * 0.05 / RUNS))
