"""Passes of several days: pole and ground are compared within a day only."""

from dataclasses import astuple, replace

import numpy as np
import pytest

from polecal.calib import Kind, Pass, Setup, estimate, moments
from polecal.calib.estimate import split
from polecal.calib.solve import Scatter, pole_rows

ELSEWHERE_M = np.array([2.4, -1.8, 0.2])  # 3 m from there, 0.2 m lower


def passes(returns, site_of=lambda number: 0, shift_m=ELSEWHERE_M):
    """The returns' passes; those of site 1 were driven around a pole that stood elsewhere."""
    made = []
    for number in np.unique(returns.pass_id).tolist():
        part = returns[returns.pass_id == number]
        site = site_of(number)
        moved = replace(part, position_m=part.position_m + site * shift_m)
        made.append(Pass.of(number, split(moved, 30), site))
    return made


@pytest.fixture(scope="module")
def driven(rig):
    return rig.drive(noise_m=0.01, nav_m=0.012, radius_m=0.04, seed=4)


@pytest.fixture(scope="module")
def setup(rig):
    return Setup(measured=rig.measured, pole_radius_m=0.04, extras=frozenset({"range_m"}))


def test_two_days_give_the_mount_that_one_gives_though_the_pole_and_the_ground_moved(rig, driven, setup):
    one = estimate(passes(driven), setup)
    two = estimate(passes(driven, lambda number: number % 2), setup)
    unmoved = estimate(passes(driven, lambda number: number % 2, 0 * ELSEWHERE_M), setup)
    assert astuple(two.mount) == pytest.approx(astuple(unmoved.mount), abs=1e-6)
    sigma = np.array(astuple(one.sigma))
    assert (np.abs(np.subtract(astuple(two.mount), astuple(one.mount))) < sigma).all()
    assert (
        np.abs(np.subtract(astuple(two.mount), astuple(rig.true))) < 4 * np.array(astuple(two.sigma))
    ).all()
    assert two.cost_m < one.cost_m < 1.1 * two.cost_m
    assert two.set_aside == {}
    assert two.held == one.held


def test_taken_for_one_day_they_would_not_do(driven, setup):
    mixed = passes(driven, lambda number: number % 2)
    wrong = estimate([replace(one, site=0) for one in mixed], setup)
    assert wrong.cost_m > 1.0
    assert not wrong.verdict.accepted


def test_a_pass_that_disagrees_is_found_among_those_of_its_day(driven, setup):
    two = passes(driven, lambda number: number % 2)
    off = driven[driven.pass_id == 5]
    off = replace(off, position_m=off.position_m + ELSEWHERE_M + np.array([0.5, 0.0, 0.0]))
    two[5] = Pass.of(5, split(off, 30), 1)
    result = estimate(two, setup)
    assert list(result.set_aside) == [5]
    assert "pole is 0." in result.set_aside[5]


def test_of_one_day_nothing_changes(rig, driven, setup):
    of_day = [one.totals[Kind.POLE] for one in passes(driven)]
    scatter = Scatter(of_day, shift_m=0.03, ranged=True)
    rng = np.random.default_rng(0)
    rows = pole_rows(np.concatenate([rig.true.vector, np.zeros(6)]))
    for ratio in (np.inf, 0.3):
        used = rng.random(len(of_day)) < 0.8
        weight = scatter.count[used] / (1.0 + scatter.count[used] / ratio)
        mean = scatter._mean[used]
        apart = mean - weight / weight.sum() @ mean
        total = scatter.count[used].sum()
        there = np.ix_(scatter._features, scatter._features)
        form = scatter.within_form(used)[there] + (weight[:, None] * apart).T @ apart / total
        np.testing.assert_allclose(scatter.form(used, ratio)[there], form, rtol=1e-12, atol=1e-12)
        count = scatter.count[used]
        within = float((count * scatter.within(rows)[used]).sum() / count.sum())
        between = float(scatter.means(rows)[used].var(axis=0, ddof=1).mean())
        ratio_told = within / (between - within * float((1 / count).mean()))
        assert scatter.ratio(rows, used) == pytest.approx(ratio_told, rel=1e-9)
    today, another = (
        estimate(passes(driven), setup),
        estimate([replace(one, site=7) for one in passes(driven)], setup),
    )
    assert astuple(today.mount) == astuple(another.mount)
    assert np.array_equal(today.covariance, another.covariance)


def test_a_day_without_ground_or_of_a_single_pass_is_no_trouble(driven, setup):
    three = passes(driven, lambda number: 1 if number == 3 else 0)
    three[3] = replace(three[3], totals=three[3].totals | {Kind.GROUND: moments.zero()}, site=1)
    result = estimate(three, setup)
    assert np.isfinite(result.cost_m)
    assert astuple(result.mount) == pytest.approx(astuple(estimate(passes(driven), setup).mount), abs=0.1)
