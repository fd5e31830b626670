"""Sums that are looked at a few passes at a time, wherever they are, against all of them at once."""

import tracemalloc
from dataclasses import replace

import numpy as np
import pytest

from polecal.calib.estimate import Setup, estimate, passes_of, scatters_of
from polecal.calib.observations import Kind
from polecal.calib.report.rig import Rig, drive
from polecal.calib.solve import Scatter, ground_basis, ground_rows, pole_basis, pole_rows

P = 40  # more than are looked at together
RADIUS_M = 0.04


@pytest.fixture(scope="module")
def passes(rig):
    driven = Rig(rig.true, passes=P, rough_m=0.03, pole_radius_m=RADIUS_M, speeds_mps=(1.0, 2.0, -1.5))
    return passes_of(drive(driven, np.random.default_rng(0), 60 * P, 300 * P), 30)


@pytest.fixture(scope="module", params=Kind)
def seen(request, passes, rig):
    """A scatter; rows to look along, and their first column; the sums it is of."""
    vector = np.array([*rig.true.vector, 0.01, 0.02, 0.1, -0.1, 0.02, 0.03])
    of_pole = request.param is Kind.POLE
    basis, rows = (pole_basis, pole_rows) if of_pole else (ground_basis, ground_rows)
    scatter = scatters_of(passes, RADIUS_M)[0 if of_pole else 1]
    return scatter, basis(vector), rows(vector), [one.totals[request.param] for one in passes]


@pytest.mark.parametrize("ratio", [np.inf, 0.3])
def test_what_is_seen_along_rows_is_what_the_whole_form_has_there(seen, ratio):
    scatter, basis, _, _ = seen
    used = np.arange(P) % 3 > 0
    along = scatter.along(basis, ratio)
    mean = along.mean[used] - np.tensordot(along.weight[used], along.mean[used], 1) / along.weight[used].sum()
    there = along.taken[used].sum(axis=0) + np.einsum("p,pai,paj->ij", along.weight[used], mean, mean)
    whole = np.einsum("aki,kl,alj->ij", basis, scatter.form(used, ratio), basis) * scatter.count[used].sum()
    assert there == pytest.approx(whole, rel=1e-8, abs=1e-8)


def test_what_is_within_passes_is_told_alike_along_rows_and_by_each_and_in_all(seen):
    scatter, basis, rows, _ = seen
    used = np.arange(P) % 3 > 0
    within = scatter.within(rows)
    assert len(rows) * scatter.count * within == pytest.approx(scatter.along(basis, 1.0).within[:, 0, 0])
    assert scatter.mean_within(rows, used) == pytest.approx(
        np.average(within[used], weights=scatter.count[used])
    )


def test_each_pass_is_as_it_is_by_itself(seen):
    _, basis, rows, sums = seen
    how = {"shift_m": 0.03, "ranged": True, "across_m": 0.02}
    every, alone = Scatter(sums, **how), [Scatter([one], **how) for one in sums]
    whole = every.along(basis, 0.3)
    for name in ("mean", "within", "taken", "ray"):
        single = np.concatenate([getattr(one.along(basis, 0.3), name) for one in alone])
        np.testing.assert_allclose(getattr(whole, name), single, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(every.within(rows), np.concatenate([one.within(rows) for one in alone]))


def test_a_solution_takes_little_memory_for_each_pass(passes, rig, tell):
    """The matrices of a pass, of its pole and its ground, are 160 kB."""
    many = [replace(one, id=one.id + P * turn) for turn in range(4) for one in passes]
    setup = Setup(rig.measured, pole_radius_m=RADIUS_M)
    peaks_kb = []
    for some in (passes, passes, many):  # what is made once is there after the first
        tracemalloc.start()
        try:
            result = estimate(some, setup)
            peaks_kb.append(tracemalloc.get_traced_memory()[1] / 1e3)
        finally:
            tracemalloc.stop()
        assert result.left_out_m is not None
    a_pass_kb = (peaks_kb[2] - peaks_kb[1]) / (len(many) - P)
    tell(f"{peaks_kb[2]:.0f} kB for {len(many)} passes, {a_pass_kb:.1f} for each more")
    assert a_pass_kb < 30


def test_sums_that_are_kept_elsewhere_are_fetched_and_count_the_same(passes):
    fetched = []

    def elsewhere(number, sums):
        def fetch():
            fetched.append(number)
            return sums.packed

        return replace(sums, held=fetch)

    away = [
        replace(one, totals={kind: elsewhere(one.id, of) for kind, of in one.totals.items()})
        for one in passes
    ]
    used = np.ones(P, dtype=bool)
    for here, there in zip(scatters_of(passes, RADIUS_M), scatters_of(away, RADIUS_M), strict=True):
        assert np.array_equal(here.form(used, 2.0), there.form(used, 2.0))
    assert set(fetched) == {one.id for one in passes}
