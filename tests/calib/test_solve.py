import numpy as np
import pytest

from polecal.calib.estimate import passes_of, scatters_of
from polecal.calib.geometry import wrap
from polecal.calib.solve import EXTRAS, Form, minimise, minimise_globally, roughness

EVERY = np.ones(12, dtype=bool)
ROUGH_M2 = 0.03**2


@pytest.fixture(scope="module")
def form(rig):
    passes = passes_of(rig.drive(passes=12, noise_m=0.01, nav_m=0.01, radius_m=0.04), 30)
    pole, ground = scatters_of(passes, 0.04)
    return Form(pole.form(EVERY, 3.0), ground.form(EVERY, 50.0), ROUGH_M2, ground.ray(EVERY))


@pytest.fixture
def start(rig):
    return np.concatenate([rig.measured.vector, np.zeros(len(EXTRAS))])


def test_slope_is_half_the_costs_derivative_on_rough_ground_and_by_a_thick_pole(form, start):
    rng = np.random.default_rng(0)
    for _ in range(5):
        vector = start + 0.03 * rng.normal(size=12)
        steps = 1e-6 * np.eye(12)
        differences = [(form.cost(vector + step) - form.cost(vector - step)) / 4e-6 for step in steps]
        assert form.slope(vector)[0] == pytest.approx(np.array(differences), rel=1e-5, abs=1e-8)


def test_slope_is_half_the_costs_derivative_where_roughness_is_not_known_and_kinds_are_weighed(form, start):
    unknown = Form(form.pole, form.ground, ROUGH_M2, form.ray, 0.9 * form.ground, 20.0)
    steps = 1e-6 * np.eye(12)
    differences = [(unknown.cost(start + step) - unknown.cost(start - step)) / 4e-6 for step in steps]
    assert unknown.slope(start)[0] == pytest.approx(np.array(differences), rel=1e-5, abs=1e-7)


def test_ground_that_looks_ever_rougher_costs_ever_more():
    """Past four times as rough no longer by the logarithm, but as steeply as there."""
    rough = np.array([0.5, 1.0, 3.9, 4.1, 100.0])
    value, slope = roughness(rough)
    step = 1e-7
    assert slope == pytest.approx((roughness(rough + step)[0] - roughness(rough - step)[0]) / (2 * step))
    assert value[1] == 0.0
    assert value[4] > 20


def test_how_rough_unknown_ground_was_taken_for_does_not_move_its_minimum(form, start):
    """On level ground the beams' slant would else be held to that at which the roughness was estimated."""
    once, twice = (
        Form(0 * form.pole, form.ground, times * ROUGH_M2, form.ray, form.ground) for times in (1, 2)
    )
    assert twice.slope(start)[0] == pytest.approx(2 * once.slope(start)[0], rel=1e-9)


def test_rough_ground_takes_off_the_logarithm_of_the_sensors_height(form, rig, start):
    """The body is at z = 0 like the ground, and the sensor 1 m above it."""
    eq7 = Form(form.pole, form.ground)
    assert form.cost(start) - eq7.cost(start) == pytest.approx(0.0, abs=2 * ROUGH_M2 * 0.05)
    raised = start - 1.0 * (np.arange(12) == 4) * np.radians(8.0)  # sees the ground twice as steeply
    taken = form.cost(raised) - eq7.cost(raised)
    assert taken == pytest.approx(-2 * ROUGH_M2 * np.log(2.0), rel=0.15)


def test_where_the_cost_is_negative_its_minimum_is_found_from_afar(form, start):
    """As it is with ground so rough that the logarithm outweighs all the rest."""
    steep = Form(form.pole, form.ground, 0.1, form.ray)
    near = minimise(steep, start, EXTRAS)
    assert steep.cost(near) < 0
    assert np.linalg.norm(steep.slope(near)[0][:6]) < 1e-7
    far = minimise(steep, start + 0.3 * (np.arange(12) == 5), EXTRAS)
    assert far == pytest.approx(near, abs=1e-6)


def test_half_a_turn_off_the_minimum_on_rough_ground_is_found_all_the_same(form, start):
    near = minimise(form, start, EXTRAS)
    turned = start + np.pi * (np.arange(12) == 5)
    off = minimise_globally(form, turned, EXTRAS) - near
    off[3:6] = wrap(off[3:6])
    assert off == pytest.approx(np.zeros(12), abs=1e-6)
