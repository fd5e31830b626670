"""Routes: what they fill, what they keep away from, and that a vehicle can drive them."""

from itertools import pairwise

import numpy as np
import pytest

from polecal.calib import Mount
from polecal.calib.dubins import length_m
from polecal.calib.route import Lack, RouteError, Vehicle, clearances_m, nearest_m, plan
from polecal.calib.sight import Sensor, sight

VEHICLE = Vehicle(half_width_m=0.6, turn_radius_m=3.0, area_m=15.0)
EVERY = dict.fromkeys(range(12), (1, 100))
AHEAD = Mount(0.0, -0.35, -1.0, 0.0, -8.0, 0.0)
BEHIND = Mount(-0.6, 0.2, -0.9, 0.0, -8.0, 180.0)
RIGHT = Mount(0.0, 0.4, -1.0, 0.0, -8.0, 90.0)


def sensor(mount, name="front", fov_deg=100.0):
    return Sensor(name, mount, fov_deg, 0.25, 0.04, 2.4, (0.1, 0.1), 18.77)


def passes(route):
    return [leg for leg in route.legs if leg.kind == "pass"]


def right_m(leg):
    """How far to the right of a pass's line the pole is, at each point."""
    north, east, heading = leg.points.T
    return north * np.sin(heading) - east * np.cos(heading)


@pytest.mark.parametrize("start", [None, (-8.0, 2.0, 0.3), (0.9, 0.5, 1.0), (30.0, 4.0, 2.0)])
@pytest.mark.parametrize("both_ways", [False, True])
@pytest.mark.parametrize("mount", [AHEAD, BEHIND, RIGHT], ids=["ahead", "behind", "right"])
def test_a_route_can_be_driven_and_keeps_off_the_pole_within_its_area(mount, both_ways, start):
    route = plan([Lack(sensor(mount), EVERY)], 30, VEHICLE, start=start, both_ways=both_ways)
    near_m, far_m = clearances_m(VEHICLE, 0.0)
    assert {leg.slice for leg in passes(route)} == set(range(12))
    assert (route.unseen, route.left_out) == ((), 0)
    if start is not None:
        assert np.allclose(route.legs[0].points[0, :2], start[:2])
    for before, after in pairwise(route.legs):
        assert np.allclose(before.points[-1, :2], after.points[0, :2], atol=1e-6)
        assert np.cos(before.points[-1, 2] - after.points[0, 2]) > 1 - 1e-6
    for leg in route.legs:
        inside = leg is not route.legs[0] or start is None or np.hypot(*start[:2]) <= VEHICLE.area_m
        assert np.hypot(*leg.points[:, :2].T).max() <= VEHICLE.area_m or not inside
        if leg.kind == "pass":
            assert nearest_m(leg.points) == pytest.approx(abs(right_m(leg)[0]), abs=1e-6)
            assert nearest_m(leg.points) >= near_m - 1e-9
            assert nearest_m(leg.points) <= far_m + 1e-9
        elif leg is not route.legs[0]:
            assert nearest_m(leg.points) > near_m
        step = np.diff(leg.points, axis=0)
        course = np.arctan2(step[:, 1], step[:, 0]) + (np.pi if leg.direction == "reverse" else 0.0)
        assert (np.cos(course - (leg.points[1:, 2] + leg.points[:-1, 2]) / 2) > 0.999).all()
        turned = np.abs(np.diff(leg.points[:, 2]))
        assert (turned <= np.linalg.norm(step[:, :2], axis=1) / VEHICLE.turn_radius_m * 1.01 + 1e-6).all()


@pytest.mark.parametrize("mount", [AHEAD, BEHIND, RIGHT], ids=["ahead", "behind", "right"])
def test_on_every_pass_the_laser_sees_the_pole_while_the_yaw_is_in_the_slice(mount):
    of = sensor(mount)
    for leg in passes(plan([Lack(of, EVERY)], 30, VEHICLE, both_ways=True)):
        seen = sight(of, float(right_m(leg)[0]))
        along = leg.points[:, 0] * np.cos(leg.points[:, 2]) + leg.points[:, 1] * np.sin(leg.points[:, 2])
        assert along.min() < seen.begin_m
        assert along.max() > seen.end_m
        assert (np.degrees(leg.points[:, 2]) % 360 // 30 == leg.slice).all()


def test_only_what_is_missing_is_driven():
    route = plan([Lack(sensor(AHEAD), {3: (1, 100), 4: (0, 20)})], 30, VEHICLE)
    assert sorted(leg.slice for leg in passes(route)) == [3, 4]
    assert all(leg.direction == "forward" for leg in route.legs)


def test_more_passes_are_laid_where_more_are_asked_for_or_one_does_not_bring_enough_returns():
    three = plan([Lack(sensor(AHEAD), {3: (3, 1)})], 30, VEHICLE)
    assert len(passes(three)) == 3
    assert len({round(float(right_m(leg)[0]), 1) for leg in passes(three)}) > 1  # near and far, on both sides
    many = plan([Lack(sensor(AHEAD), {3: (1, 250)})], 30, VEHICLE)
    assert len(passes(many)) > 1


def test_two_lasers_share_a_pass_where_both_see_the_pole():
    lacks = [Lack(sensor(AHEAD), EVERY), Lack(sensor(BEHIND, "rear"), EVERY)]
    route = plan(lacks, 30, VEHICLE)
    assert len(passes(route)) == 12
    assert all(leg.lasers == ("front", "rear") for leg in passes(route))
    left = Lack(sensor(Mount(0.0, -0.4, -1.0, 0.0, -8.0, -90.0), "left"), EVERY)
    apart = plan([Lack(sensor(RIGHT, "right"), EVERY), left], 30, VEHICLE)
    sides = {leg.lasers: np.sign(right_m(leg)[0]) for leg in passes(apart)}
    assert sides == {("right",): 1.0, ("left",): -1.0}


def test_what_no_pass_can_show_is_told():
    route = plan([Lack(sensor(Mount(0.0, 0.0, -1.0, 0.0, 60.0, 0.0)), {2: (1, 100)})], 30, VEHICLE)
    assert (route.legs, route.unseen) == ((), (("front", 2),))


def test_where_a_time_offset_is_wanted_some_legs_are_driven_in_reverse_and_at_two_speeds():
    route = plan([Lack(sensor(AHEAD), EVERY)], 30, VEHICLE, both_ways=True)
    reverse = [leg for leg in passes(route) if leg.direction == "reverse"]
    assert 3 <= len(reverse) <= 6
    for leg in reverse:
        assert leg.slice in {other.slice for other in passes(route) if other.direction == "forward"}
    assert {leg.speed_mps for leg in passes(route) if leg.direction == "forward"} == {3.0, 1.5}
    one = plan([Lack(sensor(AHEAD), {5: (1, 100)})], 30, VEHICLE, both_ways=True)
    assert [leg.direction for leg in passes(one)] == ["forward", "reverse"]


def test_a_pole_whose_place_is_not_well_known_and_a_wider_vehicle_are_given_more_room():
    narrow = plan([Lack(sensor(AHEAD), EVERY)], 30, VEHICLE)
    unsure = plan([Lack(sensor(AHEAD), EVERY)], 30, VEHICLE, pole_sigma_m=0.5)
    wide = plan([Lack(sensor(AHEAD), EVERY)], 30, Vehicle(1.3, 3.0, 15.0))
    near_m = [min(nearest_m(leg.points) for leg in route.legs) for route in (narrow, unsure, wide)]
    assert near_m[0] >= 1.0 - 1e-9
    assert near_m[1] >= 0.6 + 2 * 0.5
    assert near_m[2] >= 1.3 + 0.4 - 1e-9


def test_the_order_makes_the_way_short():
    rng = np.random.default_rng(2)
    lacks = [Lack(sensor(AHEAD), EVERY)]
    route = plan(lacks, 30, VEHICLE)
    straight_m = sum(length_m(leg.points) for leg in passes(route))
    turns_m = route.length_m - straight_m
    from polecal.calib import route as module

    lines, _ = module._lines(lacks, 30, VEHICLE, 0.0)
    ways = module._Ways(VEHICLE, clearances_m(VEHICLE, 0.0)[0])
    shuffled = []
    for _ in range(200):
        order = rng.permutation(len(lines))
        pairs = pairwise([lines[k] for k in order])
        shuffled.append(sum(ways.cost_m(one.end, other.begin) for one, other in pairs))
    assert turns_m < min(shuffled)


def test_no_room_to_turn_is_said_and_what_to_do():
    with pytest.raises(RouteError, match="no room to turn by 12 m") as error:
        plan([Lack(sensor(AHEAD), EVERY)], 30, Vehicle(0.6, 12.0, 10.0))
    assert "--area" in error.value.hint


def test_a_session_that_lacks_nothing_has_no_legs():
    assert plan([], 30, VEHICLE).legs == ()


def test_many_approaches_are_cut_to_a_route_that_is_asked_for_again():
    route = plan([Lack(sensor(AHEAD), dict.fromkeys(range(36), (1, 100)))], 10, VEHICLE)
    assert 0 < len(passes(route)) <= 18
    assert len(passes(route)) + route.left_out == 36
