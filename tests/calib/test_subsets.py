from dataclasses import replace

import numpy as np
import pytest

from polecal.calib import Setup, estimate, solve
from polecal.calib.estimate import passes_of, scatters_of
from polecal.calib.geometry import wrap
from polecal.calib.observations import Kind
from polecal.calib.report.rig import Rig, drive
from polecal.calib.solve import EXTRAS, UNKNOWNS, Form, Weights
from polecal.calib.subsets import Subsets

P = 12


@pytest.fixture(scope="module")
def passes(rig):
    rough = Rig(rig.true, passes=P, rough_m=0.03, pole_radius_m=0.04, speeds_mps=(1.0, 2.0, -1.5))
    return passes_of(drive(rough, np.random.default_rng(0), 100 * P, 500 * P), 30)


@pytest.fixture(scope="module", params=["eq7", "as told", "by kind"])
def problem(request, rig, passes):
    """Scatters, weights, the minimum of all, what is held and free, and the form."""
    pole, ground = scatters_of(passes, 0.04)
    every, held = np.ones(P, dtype=bool), {"lean_north", "lean_east"}
    start = np.concatenate([rig.measured.vector, np.zeros(len(EXTRAS))])
    about = solve.minimise(Form.of(pole, ground, every), start, held)
    weights = solve.PAPER
    if request.param != "eq7":
        by_kind = request.param == "by kind"
        weights = Weights.told(pole, ground, every, about, pass_error=True, rough=True, by_kind=by_kind)
    form = Form.of(pole, ground, every, weights)
    vector = solve.minimise(form, about, held)
    free = np.array([name not in held for name in UNKNOWNS])
    return pole, ground, weights, vector, held, free, form


def off_sigmas(found, exact, scatter):
    off = found - exact
    off[:, 3:6] = wrap(off[:, 3:6])
    return np.abs(off)[:, scatter > 0] / scatter[scatter > 0]


def test_minima_of_subsets_are_those_of_their_own_forms(problem):
    """To a hundredth of what leaving out a pass scatters them, from six passes on."""
    pole, ground, weights, vector, held, free, form = problem
    rng = np.random.default_rng(1)
    left_out = ~np.eye(P, dtype=bool)
    halves = np.stack([rng.permutation(P) < P // 2 for _ in range(4)])
    subsets = np.concatenate([left_out, halves])
    found = Subsets.near(pole, ground, weights, vector, free).minima(subsets, form.bend(vector))
    exact = np.stack([solve.minimise(Form.of(pole, ground, some, weights), vector, held) for some in subsets])
    scatter = np.sqrt(P - 1) * exact[:P].std(axis=0)
    assert off_sigmas(found[:P], exact[:P], scatter).max() < 0.01
    assert off_sigmas(found[P:], exact[P:], scatter).max() < 0.2
    assert np.array_equal(found[:, ~free], np.tile(vector[~free], (len(found), 1)))


def test_the_minimum_of_all_stays_where_it_is(problem):
    pole, ground, weights, vector, _, free, form = problem
    near = Subsets.near(pole, ground, weights, vector, free)
    (found,) = near.minima(np.ones((1, P), dtype=bool), form.bend(vector))
    assert found == pytest.approx(vector, abs=1e-8)
    eq7 = Form.of(pole, ground, np.ones(P, dtype=bool))
    assert near.paper().spread_m(found) == pytest.approx(solve.cost_m(eq7, vector), rel=1e-8)


def test_how_rows_bend_makes_half_the_hessian_whole(problem):
    *_, vector, _, _, form = problem
    steps = 1e-5 * np.eye(len(UNKNOWNS))
    slopes = [form.slope(vector + step)[0] - form.slope(vector - step)[0] for step in steps]
    hessian = np.stack(slopes, axis=1) / 2e-5
    told = form.slope(vector)[1] + form.bend(vector)
    if form.ray is not None:  # how steeply the ray meets the ground is no square: `slope` leaves some out
        down = solve.ground_basis(vector)[0]
        ray = form.ray @ down
        missing = np.outer(ray[1:], ray[1:]) / ray[0] ** 2
        if form.bumps is not None:
            rough = down.T @ form.bumps @ down
            missing = 2 * missing - 2 * np.outer(rough[0, 1:], rough[0, 1:]) / rough[0, 0] ** 2
        told = told + form.balance * form.rough_m2 * missing
    scale = np.sqrt(np.abs(np.diag(hessian)))
    assert told / np.outer(scale, scale) == pytest.approx(hessian / np.outer(scale, scale), abs=1e-5)


def test_a_pass_that_comes_later_counts_as_if_it_had_been_there(problem, passes):
    *scatters, weights, vector, _, free, form = problem
    whole = Subsets.near(*scatters, weights, vector, free)
    early, late = (scatters_of(some, 0.04) for some in (passes[:-1], passes[-1:]))
    before = Subsets.near(*early, weights, vector, free)
    subsets = ~np.eye(P + 1, P, -1, dtype=bool)
    one, other = (
        of.minima(subsets, form.bend(vector)) for of in (before.joined(before.others(*late)), whole)
    )
    assert one == pytest.approx(other, abs=1e-8)


def test_what_all_passes_say_does_not_change_where_those_of_a_site_are_taken_for_one(problem):
    pole, ground, weights, vector, _, free, form = problem
    sites = np.arange(P) // 8
    near = Subsets.near(pole, ground, weights, vector, free)
    near = replace(near, pole=replace(near.pole, sites=sites), ground=replace(near.ground, sites=sites))
    merged = near.merged()
    assert len(merged) == 2
    one, other = (of.minima(np.ones((1, len(of)), dtype=bool), form.bend(vector)) for of in (near, merged))
    assert not np.allclose(one[0, free], vector[free], rtol=0, atol=1e-6)
    assert other == pytest.approx(one, abs=1e-9)
    assert merged.spread_m(one[0]) == pytest.approx(near.spread_m(one[0]), rel=1e-9)
    eq7 = near.paper()
    assert eq7.merged().spread_m(one[0]) == pytest.approx(eq7.spread_m(one[0]), rel=1e-9)


@pytest.mark.parametrize("only", [0, 3])
def test_ground_that_one_pass_alone_has_seen_is_not_believed(rig, only):
    """Without that pass nothing is known of it: no number may come of nothing."""
    rough = Rig(rig.true, passes=8, rough_m=0.03)
    returns = drive(rough, np.random.default_rng(1), 800, 4000)
    once = returns[(returns.kind == Kind.POLE) | (returns.pass_id == only)]
    result = estimate(passes_of(once, 30), Setup(rig.measured, extras=frozenset()))
    assert "z" in result.held
    assert np.isfinite(result.covariance).all()
    assert not result.verdict.accepted


def test_a_pass_without_ground_is_left_out_like_any_other(rig):
    returns = rig.drive(noise_m=0.01, nav_m=0.01, passes=8)
    bare = returns[(returns.pass_id != 3) | (returns.kind == Kind.POLE)]
    result = estimate(passes_of(bare, 30), Setup(rig.measured, extras=frozenset()))
    assert np.isfinite(result.covariance).all()
    assert result.left_out_m == pytest.approx(result.cost_m, rel=0.3)
