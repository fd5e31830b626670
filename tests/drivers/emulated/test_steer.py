"""A vehicle that is told where to drive: it keeps to its lines, stops, reverses, and its motion is one."""

import json

import numpy as np
import pytest

from polecal.drivers.emulated.steer import Line, Steered, lines
from polecal.drivers.emulated.virtual import Rig

BEGIN = (3.0, -6.0, 0.3)


def arc(radius_m, turn_rad, count=40):
    """From the origin northward, to the right."""
    angle = np.linspace(0, turn_rad, count)
    return np.column_stack([radius_m * np.sin(angle), radius_m * (1 - np.cos(angle))])


def driven(vehicle, seconds=120.0):
    """Let it drive until it stands; give its motion every 10 ms."""
    t_s = 0.0
    while t_s < 2.0 or not vehicle.idle:
        t_s += 0.5
        assert t_s < seconds
        vehicle.pose([t_s])
    t = np.arange(0.0, t_s, 0.01)
    return t, *vehicle.pose(t)


def off_m(path, line):
    """How far each point of a path is from a line, at most."""
    return np.linalg.norm(path[:, None] - line[None], axis=2).min(axis=1)


LINE = np.column_stack([np.linspace(0, 20, 81), np.zeros(81)])
CURVE = np.vstack([LINE, np.add(arc(4.0, np.pi)[1:], (20, 0))])


def test_it_stands_until_it_is_told_and_keeps_what_has_been():
    vehicle = Steered(BEGIN, seed=1)
    position, rpy, velocity = vehicle.pose([0.0, 5.0])
    assert np.allclose(position[:, :2], BEGIN[:2])
    assert np.allclose(rpy[:, 2], BEGIN[2])
    assert (velocity == 0).all()
    assert vehicle.idle
    vehicle.follow([Line(LINE + BEGIN[:2], 1, 2.0)])
    assert not vehicle.idle
    vehicle.pose([9.0])
    assert np.allclose(vehicle.pose([5.0])[0], position[1])
    assert np.linalg.norm(vehicle.pose([9.0])[0][0, :2] - BEGIN[:2]) > 1.0


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_it_keeps_to_its_line_and_stops_at_its_end(seed):
    vehicle = Steered((0.0, 0.0, 0.0), seed=seed)
    vehicle.follow([Line(CURVE, 1, 2.5)])
    _, position, rpy, velocity = driven(vehicle)
    assert off_m(position[:, :2], CURVE).max() < 0.35
    assert np.linalg.norm(position[-1, :2] - CURVE[-1]) < 0.3
    assert np.abs(rpy[-1, 2] - np.pi) < 0.2
    assert np.hypot(*velocity[:, :2].T).max() == pytest.approx(2.5, abs=0.1)


def test_in_reverse_it_heads_the_other_way_than_it_goes():
    vehicle = Steered((0.0, 0.0, 0.0), seed=1)
    vehicle.follow([Line(LINE, 1, 2.0), Line(LINE[::-1], -1, 1.0)])
    _, position, rpy, velocity = driven(vehicle)
    ahead = velocity[:, 0] * np.cos(rpy[:, 2]) + velocity[:, 1] * np.sin(rpy[:, 2])
    assert ahead.max() == pytest.approx(2.0, abs=0.1)
    assert ahead.min() == pytest.approx(-1.0, abs=0.1)
    assert np.abs(rpy[:, 2]).max() < 0.15
    assert position[:, 0].max() == pytest.approx(20.0, abs=0.2)
    assert np.linalg.norm(position[-1, :2]) < 0.3


def test_its_velocity_is_its_positions_derivative_and_nothing_jumps():
    vehicle = Steered((0.0, 0.0, 0.0), seed=4)
    vehicle.follow([Line(CURVE, 1, 2.5), Line(CURVE[::-1], -1, 1.5)])
    _, position, rpy, velocity = driven(vehicle)
    assert (position[2:] - position[:-2]) / 0.02 == pytest.approx(velocity[1:-1], abs=0.02)
    sideways = velocity[:, 1] * np.cos(rpy[:, 2]) - velocity[:, 0] * np.sin(rpy[:, 2])
    assert np.abs(sideways).max() < 1e-9
    assert np.abs(np.diff(velocity, axis=0)).max() < 0.05
    assert np.abs(np.diff(rpy[:, 2])).max() / 0.01 < np.deg2rad(80)


def test_a_new_order_replaces_the_old_one_where_it_is():
    vehicle = Steered((0.0, 0.0, 0.0), seed=1)
    vehicle.follow([Line(LINE, 1, 2.0)])
    north = float(vehicle.pose([5.0])[0][0, 0])
    back = np.column_stack([np.linspace(north, north + 6, 30), np.zeros(30)])
    vehicle.follow([Line(back, 1, 1.0)])
    _, position, _, _ = driven(vehicle)
    assert position[-1, 0] == pytest.approx(north + 6, abs=0.3)


def test_the_ground_is_the_same_wherever_it_comes_again():
    vehicle = Steered((0.0, 0.0, 0.0), seed=1)
    vehicle.follow([Line(LINE, 1, 2.0), Line(LINE[::-1], -1, 1.0)])
    t_s, position, rpy, _ = driven(vehicle)
    there, back = (np.flatnonzero(np.abs(position[:, 0] - 10.0) < 0.01)[k] for k in (0, -1))
    assert t_s[back] > t_s[there] + 10
    assert rpy[there, :2] == pytest.approx(rpy[back, :2], abs=np.deg2rad(0.5))
    assert np.abs(np.degrees(rpy[:, :2])).max() > 0.3


def test_lines_are_read_from_geojson_to_where_they_lie():
    world = Rig.steered(1, 0).world
    corners = np.array([[0.0, 0.0], [10.0, 5.0], [-4.0, 30.0]])
    lat, lon, _ = world.geodetic(np.column_stack([corners, np.zeros(3)]))
    line = {"type": "LineString", "coordinates": np.column_stack([lon, lat]).tolist()}
    about = {"direction": "reverse", "speed_mps": 1.5}
    point = {"type": "Feature", "geometry": {"type": "Point", "coordinates": [0, 0]}, "properties": {}}
    features = [point, {"type": "Feature", "geometry": line, "properties": about}]
    (read,) = lines(json.dumps({"type": "FeatureCollection", "features": features}), world.local)
    assert read.points_m == pytest.approx(corners, abs=0.002)
    assert (read.way, read.speed_mps) == (-1, 1.5)
