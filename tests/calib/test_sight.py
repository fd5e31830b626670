"""What a laser sees from a straight way, against beams cast one by one."""

import numpy as np
import pytest

from polecal.calib import Kind, Mount, Pass, Returns
from polecal.calib.estimate import split
from polecal.calib.sight import Sensor, ground_of, pole_at, sight

GROUND_M = 0.1
POLE_HEIGHT_M = 2.4


def sensor(mount, fov_deg=100.0, resolution_deg=0.25, ground_m=(GROUND_M, GROUND_M)):
    return Sensor("front", mount, fov_deg, resolution_deg, 0.04, POLE_HEIGHT_M, ground_m, 18.77)


def cast(of, right_m, along_m):
    """How many beams meet a pole ``right_m`` to the right, from a body so far along its way."""
    bearing = np.radians(np.arange(-of.fov_deg / 2, of.fov_deg / 2 + 1e-9, of.resolution_deg))
    ray = np.stack([np.cos(bearing), np.sin(bearing)], axis=1) @ of.mount.rotation[:, :2].T
    origin = of.mount.vector[:3]
    to_pole = np.array([-along_m, right_m]) - origin[:2]
    level = np.linalg.norm(ray[:, :2], axis=1)
    unit = ray[:, :2] / level[:, None]
    ahead_m, aside_m = unit @ to_pole, np.abs(unit[:, 0] * to_pole[1] - unit[:, 1] * to_pole[0])
    height_z = origin[2] + ray[:, 2] / level * ahead_m
    meets = (ahead_m > 0) & (aside_m < of.pole_radius_m)
    return np.count_nonzero(meets & (height_z < GROUND_M) & (height_z > GROUND_M - POLE_HEIGHT_M))


MOUNTS = {
    "ahead": Mount(0.0, -0.35, -1.0, 0.0, -8.0, 0.0),
    "behind": Mount(-0.6, 0.2, -0.9, 0.7, -7.0, 178.0),
    "right": Mount(0.1, 0.4, -1.0, 0.0, -6.0, 90.0),
    "left": Mount(0.1, -0.4, -1.0, 2.0, -5.0, -85.0),
    "upside down": Mount(0.3, 0.0, -1.2, 180.0, -4.0, 10.0),
    "level": Mount(0.0, 0.0, -1.0, 0.0, 0.0, 0.0),
}


@pytest.mark.parametrize("right_m", [1.2, -1.8])
@pytest.mark.parametrize("name", MOUNTS)
def test_where_a_pole_is_said_to_be_seen_beams_meet_it(name, right_m):
    of = sensor(MOUNTS[name])
    seen = sight(of, right_m)
    if seen is None:
        assert name in ("right", "left")  # it is on the laser's other side
        assert (name == "right") == (right_m < 0)
        return
    along = np.arange(seen.begin_m, seen.end_m, 0.1)
    beams = np.array([cast(of, right_m, each) for each in along])
    assert (beams > 0).mean() > 0.95
    assert beams.mean() * of.scans_hz == pytest.approx(seen.returns, rel=0.15)


def test_a_pole_is_seen_ahead_behind_or_abeam_as_the_laser_looks():
    ahead, behind, right = (sight(sensor(MOUNTS[name]), 1.2) for name in ("ahead", "behind", "right"))
    assert ahead.end_m < 0 < behind.begin_m
    assert right.begin_m < 0 < right.end_m
    assert sight(sensor(MOUNTS["right"], fov_deg=180.0), 1.2).begin_m < right.begin_m


def test_a_laser_that_looks_into_the_ground_sees_the_pole_from_near_alone():
    steep = sight(sensor(Mount(0.0, 0.0, -1.0, 0.0, -20.0, 0.0)), 1.2)
    shallow = sight(sensor(Mount(0.0, 0.0, -1.0, 0.0, -8.0, 0.0)), 1.2)
    assert shallow.begin_m < steep.begin_m - 2.0
    assert steep.begin_m > -1.1 / np.tan(np.radians(20.0))


@pytest.mark.parametrize("mount", [Mount(0, 0, -2.9, 0, 10, 0), Mount(0, 0, -1, 90, 0, 0)])
def test_a_laser_that_looks_over_it_or_scans_upright_is_not_said_to_see_it(mount):
    assert sight(sensor(mount), 1.2) is None


def test_returns_halve_at_twice_the_speed():
    seen = sight(sensor(MOUNTS["ahead"]), 1.2)
    assert seen.expected(1.5) == pytest.approx(2 * seen.expected(3.0))


def test_pole_and_ground_are_where_the_passes_saw_them():
    mount, rng = MOUNTS["ahead"], np.random.default_rng(1)
    count = 400
    rpy = np.stack([*rng.uniform(-0.03, 0.03, (2, count)), rng.uniform(0, 6, count)], axis=1)
    position = np.stack([*rng.uniform(-3, 3, (2, count)), np.full(count, -GROUND_M)], axis=1)
    bearing = rng.uniform(-0.8, 0.8, count)
    from polecal.calib.geometry import rotation  # beams that end on the ground at down = 0

    ray = np.stack([np.cos(bearing), np.sin(bearing)], axis=1) @ mount.rotation[:, :2].T
    body = rotation(rpy)
    origin = position + body @ mount.vector[:3]
    down = np.einsum("ni,ni->n", body[:, 2], ray)
    range_m = -origin[:, 2] / down
    kind = np.full(count, Kind.GROUND, dtype=np.uint8)
    returns = Returns(range_m, bearing, position, rpy, kind, np.zeros(count, dtype=np.int64))
    low, high = ground_of(mount, [Pass.of(1, split(returns, 30))])
    assert low == high == pytest.approx(GROUND_M, abs=0.002)
    # And as many that end on a pole, a level sensor's
    flat = Mount(0.0, 0.0, -1.0, 0.0, 0.0, 0.0)
    level = rpy * [0, 0, 1]
    to_pole = np.array([12.0, -7.0]) - position[:, :2]
    ranges, course = np.linalg.norm(to_pole, axis=1), np.arctan2(to_pole[:, 1], to_pole[:, 0])
    seen = Returns(ranges, course - level[:, 2], position, level, 0 * kind, returns.pass_id)
    assert pole_at(flat, [Pass.of(1, split(seen, 30))]) == pytest.approx((12.0, -7.0), abs=1e-6)


def test_without_a_pass_the_ground_may_be_anywhere_below_the_laser():
    low, high = ground_of(MOUNTS["ahead"], [])
    assert low < high
    assert low > MOUNTS["ahead"].z_m
