from dataclasses import astuple, replace

import numpy as np
import pytest

from polecal.calib import CalibrationError, Kind, cost
from polecal.calib.report import paper
from polecal.calib.report.rig import drive

SIZES = (215, 1056, 4072, 9000)
SMALL = replace(paper.RIG, passes=48)


@pytest.fixture(scope="module")
def returns():
    return drive(SMALL, np.random.default_rng(1), 1000, 17000)


@pytest.fixture(scope="module")
def done(returns):
    return paper.study(returns, 1, pole_radius_m=SMALL.pole_radius_m, sizes=SIZES, draws=6)


def costs_m(done, way):
    return np.array([[one.cost_m for one in some] for some in done.draws[way].values()]).mean(axis=1)


def test_rig_gives_exactly_the_papers_numbers_or_says_that_it_cannot(returns):
    assert np.bincount(returns.kind).tolist() == [1000, 17000]
    with pytest.raises(CalibrationError, match="pole returns, not 90000"):
        drive(replace(SMALL, passes=12), np.random.default_rng(0), 90000, 0)


def test_table_4_in_kind(done, returns):
    assert done.hand.cost_m > 3 * done.whole.cost_m
    assert done.hand.cost_m == pytest.approx(cost(returns, paper.HAND))
    assert done.pole_only.cost_m > done.whole.cost_m, "costed on all data, as the paper's is"
    off = np.abs(np.subtract(astuple(done.whole.mount), astuple(paper.TRUE)))
    radius_m = SMALL.pole_radius_m
    assert off[0] < radius_m, "the pole's radius goes into x"
    assert off[1] < 0.01
    assert off[5] < 0.2
    assert off[3:5].max() < 0.05
    told = np.abs(np.subtract(astuple(done.with_radius.mount), astuple(paper.TRUE)))
    assert told[0] < 0.006


@pytest.mark.parametrize("way", paper.DRAWS)
def test_cost_falls_with_the_returns_then_flattens_and_never_reaches_nothing(done, way):
    fewest, *_, more, most = costs_m(done, way)
    assert fewest > 1.02 * done.whole.cost_m
    assert fewest > most >= done.whole.cost_m
    assert more - most < 0.3 * (fewest - most), "little is gained by the last doubling"
    assert done.whole.cost_m > 0.02


@pytest.mark.parametrize("draw", paper.DRAWS.values(), ids=paper.DRAWS)
def test_subset_has_as_many_as_asked_for_from_every_slice_and_none_twice(returns, draw):
    some = draw(returns, 428, np.random.default_rng(0))
    assert len(np.unique(some)) == 428
    drawn = returns[some]
    assert (drawn.kind == Kind.POLE).sum() == round(428 / 18)
    for kind in Kind:
        slices = np.degrees(drawn.rpy_rad[drawn.kind == kind, 2]) % 360 // 30
        counts = np.bincount(slices.astype(int), minlength=12)
        assert counts.max() - counts.min() <= 1


def test_a_slice_that_has_too_few_gives_all_and_the_others_more(returns):
    slices = np.degrees(returns.rpy_rad[:, 2]) % 360 // 30
    first = np.flatnonzero((slices == 0) & (returns.kind == Kind.POLE))
    thin = returns[np.setdiff1d(np.arange(len(returns)), first[2:])]
    drawn = thin[paper.one_by_one(thin, 2000, np.random.default_rng(0))]
    assert len(drawn) == 2000
    of_first = np.degrees(drawn.rpy_rad[:, 2]) % 360 < 30
    assert (of_first & (drawn.kind == Kind.POLE)).sum() == 2


def test_tables_and_plot_stand_the_paper_beside_what_was_found(done, tmp_path):
    text = paper.tables(done)
    assert "0.1161" in text
    assert f"{done.whole.cost_m:.4f}" in text
    assert "-8.973" in text
    path = tmp_path / "fig7.png"
    paper.plot(done, SMALL.mount, path)
    assert path.read_bytes().startswith(b"\x89PNG")
