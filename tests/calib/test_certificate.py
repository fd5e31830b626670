from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from polecal.calib import Mount, Setup, estimate
from polecal.calib.certificate import _chords, certify
from polecal.calib.estimate import passes_of, scatters_of
from polecal.calib.geometry import roll_pitch_yaw
from polecal.calib.report.rig import Rig, drive
from polecal.calib.solve import EXTRAS, Form, Weights, cost_m, ground_rows, minimise, minimise_globally

TRUE = Mount(-0.029, -0.36, -0.996, -0.528, -8.182, -2.017)
START = np.concatenate([[0.0, -0.35, -1.0], np.radians([0.0, -8.0, 0.0]), np.zeros(6)])
RIG = Rig(TRUE, passes=24, speeds_mps=(1.5, 2.5, -1.0), rough_m=0.05)


@pytest.fixture(scope="module")
def passes():
    return passes_of(drive(RIG, np.random.default_rng(0), 1500, 6000), 30)


def form_of(passes, *, sought=True):
    """Of rough ground: how rough it is is sought, or known."""
    pole, ground = scatters_of(passes, 0.04)
    used = np.ones(len(passes), dtype=bool)
    weights = Weights.told(pole, ground, used, START, pass_error=True, rough=True, by_kind=True)
    form = Form.of(pole, ground, used, weights)
    return form if sought else replace(form, bumps=None)


def turned_at_random(vector, rng):
    rpy = roll_pitch_yaw(Rotation.random(random_state=rng).as_matrix())
    position = vector[:3] + rng.normal(size=3)
    return np.concatenate([position, rpy, vector[6:]])


@pytest.mark.parametrize("sought", [False, True])
def test_the_lowest_minimum_over_rough_ground_is_proven_and_no_mount_is_below_its_bound(passes, sought):
    form, rng = form_of(passes, sought=sought), np.random.default_rng(1)
    assert form.ray is not None, "and the correction for it is in what is minimised"
    assert (form.bumps is not None) == sought
    found = minimise_globally(form, START)
    told = certify(form, found)
    assert told.proven
    bound_m2 = form.cost(found) - (1 - (1 - told.lower_by) ** 2) * form.spread(found)
    higher = 0
    for _ in range(100):
        other = turned_at_random(found, rng)
        assert form.cost(other) > bound_m2
        ended = minimise(form, other, EXTRAS)
        assert form.cost(ended) > bound_m2
        if form.cost(ended) > form.cost(found) + 1e-4:
            higher += 1
            assert not certify(form, ended).proven
    assert higher > 10


def test_of_a_forms_chords_one_at_least_is_not_above_it_at_any_mount(passes):
    form, rng = form_of(passes), np.random.default_rng(3)
    found = minimise_globally(form, START)
    down = ground_rows(found)[0]
    chords = _chords(form, float(down @ form.bumps @ down) / form.rough_m2)
    same = form.balance * form.rough_m2  # that a logarithm of 1 is 0
    for far in (0.0, 1e-3, 1e-2, 0.1, 1.0, 10.0):
        for _ in range(30):
            other = found + far * np.concatenate([rng.normal(size=6), np.zeros(6)])
            below = form.cost(other) - same - np.array([part.cost(other) + more for part, more in chords])
            assert below.max() >= -1e-12 * max(1.0, form.cost(other))
            if not far:
                assert np.abs(below).min() < 1e-12, "and at the minimum one is as high"


@pytest.mark.parametrize(
    ("held", "proven"),
    [
        (("x", "z"), True),
        (("x", "y", "z"), True),
        (("roll", "pitch"), True),
        (("x", "roll", "pitch"), True),
        (("roll", "pitch", "yaw"), True),
        (("yaw",), False),
        (("roll",), False),
    ],
)
def test_what_is_held_is_held_in_the_proof_too(passes, held, proven):
    form = form_of(passes)
    found = minimise_globally(form, START, (*held, *EXTRAS))
    told = certify(form, found, (*held, *EXTRAS))
    assert told.proven == proven
    assert (told.lower_by < 0.01) == proven


def test_the_wrong_way_round_is_not_the_lowest_where_roll_and_pitch_are_held(passes):
    form, held = form_of(passes), ("roll", "pitch", *EXTRAS)
    best = minimise(form, START, held)
    turned = minimise(form, best + np.pi * np.eye(12)[5], held)
    turned_back = best + np.pi * np.eye(12)[5]  # no minimum either, but one may ask
    assert certify(form, best, held).proven
    assert not certify(form, turned_back, held).proven
    assert cost_m(form, turned) == pytest.approx(cost_m(form, best)), "there is but one"


def test_nothing_is_proven_where_the_sensor_is_in_the_ground(passes):
    form = form_of(passes)
    buried = replace(form, ray=np.zeros_like(form.ray))
    assert not certify(buried, START).proven


@pytest.mark.parametrize("scale", [1e-30, 1e-12, 1e12, 1e30])
def test_numbers_of_whatever_size_give_a_bound_or_none_but_no_error(passes, scale):
    form = form_of(passes, sought=False)
    other = replace(form, pole=scale * form.pole, rough_m2=0.0, ray=None)
    found = minimise_globally(other, START, EXTRAS)
    wrong = found + np.pi * np.eye(12)[5]
    assert 0.0 <= certify(other, found).lower_by <= 1.0
    assert not certify(other, wrong).proven or cost_m(other, wrong) < 1.005 * cost_m(other, found)


def test_a_perfect_fit_is_the_lowest(rig):
    passes = passes_of(rig.drive(), 30)
    pole, ground = scatters_of(passes, 0.0)
    every = np.ones(len(passes), dtype=bool)
    form = Form(pole.form(every), ground.form(every))
    found = minimise_globally(form, START, EXTRAS)
    assert cost_m(form, found) < 1e-3
    assert certify(form, found).proven


def test_the_proof_is_in_a_result_that_was_sought_everywhere(passes):
    setup = Setup(Mount.from_vector(START[:6]), pole_radius_m=0.04)
    assert estimate(passes, setup).certificate is None
    assert estimate(passes, setup, everywhere=True).certificate.proven
