import numpy as np
import pytest

from polecal.calib.segment import Ground, Places, even_ground, reflectors

BEARING = np.radians(50 - 0.25 * np.arange(401))


def scan(*objects):
    """Dull soil at 8 m, and (first beam, beams, range, reflectivity) in front of it."""
    ranges, reflectivity = np.full(401, 8.0), np.zeros(401)
    for first, count, range_m, level in objects:
        ranges[first : first + count] = range_m
        reflectivity[first : first + count] = level
    return ranges, BEARING, reflectivity


def found(*objects, radius_m=0.04):
    return reflectors(*scan(*objects), pole_radius_m=radius_m)


def ground_beams(*scan):
    (ground,) = Ground().beams(*(part[None] for part in scan))
    return np.flatnonzero(ground)


def test_bright_beams_as_narrow_as_the_pole_are_a_reflector():
    (pole,) = found((100, 5, 4.0, 1.0))
    assert pole.beams.tolist() == [100, 101, 102, 103, 104]
    assert pole.range_m == pytest.approx(4.0)
    assert pole.thin


def test_what_is_wider_than_the_pole_is_not_it():
    assert [one.thin for one in found((100, 18, 4.0, 1.0))] == [False]


def test_dull_things_are_no_reflectors():
    assert found((100, 5, 4.0, 0.3)) == []
    assert found() == []


def test_two_reflectors_side_by_side_at_different_ranges_are_two():
    assert [one.range_m for one in found((100, 3, 4.0, 1.0), (103, 3, 6.0, 1.0))] == pytest.approx([4.0, 6.0])


def test_beams_without_a_range_are_passed_over():
    ranges, bearing, reflectivity = scan((100, 5, np.nan, 1.0))
    assert reflectors(ranges, bearing, reflectivity, pole_radius_m=0.04) == []


@pytest.mark.parametrize("behind_m", [0.12, 0.2, 0.29])
@pytest.mark.parametrize("core", [1, 2, 5])
def test_bright_beams_on_the_poles_edges_that_mix_it_with_what_is_behind_are_no_part_of_it(core, behind_m):
    """Between pole and background in range, and still as bright as tape: level 5 beside 7."""
    edges = ((99, 1, 4.0 + behind_m, 0.72), (100 + core, 1, 4.0 + behind_m, 0.72))
    (pole,) = found((100, core, 4.0, 1.0), *(edges if core > 1 else edges[:1]))
    assert pole.beams.tolist() == list(range(100, 100 + core))
    assert pole.range_m == pytest.approx(4.0)
    assert pole.thin


def test_mixed_beams_that_are_no_longer_bright_are_neither_pole_nor_ground():
    ranges, bearing, reflectivity = scan((100, 3, 4.0, 1.0), (99, 1, 5.5, 0.5), (103, 1, 6.5, 0.2))
    (pole,) = reflectors(ranges, bearing, reflectivity, pole_radius_m=0.04)
    assert pole.beams.tolist() == [100, 101, 102]
    ground = ground_beams(ranges, reflectivity, np.zeros(401))
    assert not set(ground) & {99, 103}


def test_a_thick_poles_round_face_is_kept_whole():
    across = np.linspace(-0.95, 0.95, 9)
    ranges, bearing, reflectivity = scan((100, 9, 4.0, 1.0))
    ranges[100:109] = 4.0 + 0.1 * (1 - np.sqrt(1 - across**2))
    (pole,) = reflectors(ranges, bearing, reflectivity, pole_radius_m=0.1)
    assert pole.beams.tolist() == list(range(100, 109))


def test_what_the_field_of_view_cuts_off_is_not_seen_where_it_is():
    assert found((0, 3, 4.0, 1.0)) == []
    assert found((398, 3, 4.0, 1.0)) == []
    assert len(found((1, 3, 4.0, 1.0), (397, 3, 4.0, 1.0))) == 2


def test_sightings_go_to_the_nearest_place_or_make_one():
    places = Places()
    assert places.sight(np.array([3.0, 1.0]), 1.0, thin=True) == 0
    assert places.sight(np.array([9.0, 1.0]), 1.0, thin=True) == 1
    assert places.sight(np.array([3.4, 1.2]), 1.0, thin=True) == 0
    assert places.at(0) == pytest.approx((3.2, 1.1))


def test_a_plate_that_is_thin_from_its_edge_alone_could_not_be_the_pole():
    places = Places()
    for number in range(100):
        places.sight(np.array([0.0, 0.0]), 1.0, thin=True)
        places.sight(np.array([5.0, 0.0]), 1.0, thin=number % 4 == 0)
    assert places.could_be_pole(0)
    assert not places.could_be_pole(1)


def test_places_are_bounded():
    places = Places()
    numbers = [places.sight(np.array([10.0 * k, 0.0]), 1.0, thin=True) for k in range(40)]
    assert numbers[31] == 31
    assert numbers[32:] == [None] * 8


def test_ground_is_dull_near_its_level_and_not_beside_a_reflector():
    ranges, _, reflectivity = scan((100, 5, 4.0, 1.0))
    down = np.full(401, 0.02)
    down[200:210] = -1.4  # a fence
    ranges[300] = np.nan
    beams = set(ground_beams(ranges, reflectivity, down).tolist())
    assert beams == set(range(401)) - set(range(98, 107)) - set(range(200, 210)) - {300}


def test_a_scan_of_nothing_has_no_ground():
    assert not len(ground_beams(np.full(9, np.nan), np.zeros(9), np.full(9, np.nan)))


def test_people_and_tufts_are_left_out_of_the_ground_though_the_mount_is_off():
    rng = np.random.default_rng(0)
    bearing, range_m = rng.uniform(-0.8, 0.8, 3000), rng.uniform(5, 12, 3000)
    off_by_two_degrees = 0.035 * range_m * np.cos(bearing) - 0.02 * range_m * np.sin(bearing)
    down = 1.1 + off_by_two_degrees + 0.005 * rng.normal(size=3000)
    standing = rng.random(3000) < 0.15
    down[standing] -= rng.uniform(0.08, 0.45, np.count_nonzero(standing))
    kept = even_ground(range_m, bearing, down)
    assert np.count_nonzero(kept[standing]) < 0.02 * np.count_nonzero(standing)
    assert np.count_nonzero(kept[~standing]) > 0.98 * np.count_nonzero(~standing)


def test_too_few_ground_returns_are_all_kept():
    assert even_ground(np.full(9, 5.0), np.zeros(9), np.arange(9.0)).all()
