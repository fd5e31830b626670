"""Ways from pose to pose: where they end, how they turn, and that none is missed."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from polecal.calib import dubins

POSE = st.tuples(*[st.floats(-15, 15)] * 2, st.floats(-7, 7))
RADIUS_M = 3.0


def driven(begin, word, radius_m):
    """Where a vehicle comes that drives the segments of a word, in small steps."""
    north, east, heading = begin
    for turn, size in word:
        step = size * radius_m / 500
        headings = heading + turn * (np.arange(500) + 0.5) * step / radius_m
        north, east = north + np.cos(headings).sum() * step, east + np.sin(headings).sum() * step
        heading += turn * size
    return north, east, heading


@given(POSE, POSE)
def test_every_word_ends_where_it_should(begin, end):
    words = list(dubins._words(begin, end, RADIUS_M))
    assert len(words) >= 2  # both that turn one way are always there
    for word in words:
        north, east, heading = driven(begin, word, RADIUS_M)
        assert np.hypot(north - end[0], east - end[1]) < 1e-3
        assert abs(np.sin((heading - end[2]) / 2)) < 1e-6


@given(POSE, POSE)
def test_no_way_turns_sharper_than_it_may_or_heads_elsewhere_than_it_goes(begin, end):
    for way in dubins.ways(begin, end, RADIUS_M):
        assert np.allclose(way[0], begin)
        step = np.diff(way, axis=0)
        length = np.linalg.norm(step[:, :2], axis=1)
        assert (length <= dubins.STEP_M + 1e-6).all()
        moved = length > 1e-3
        assert (np.abs(step[moved, 2]) <= length[moved] / RADIUS_M * 1.01 + 1e-6).all()
        course = np.arctan2(step[moved, 1], step[moved, 0])
        middle = (way[1:, 2] + way[:-1, 2])[moved] / 2
        assert (np.cos(course - middle) > 0.999).all()


def test_the_shortest_way_is_known_where_it_is_plain():
    ahead = min(map(dubins.length_m, dubins.ways((0, 0, 0), (10, 0, 0), RADIUS_M)))
    assert ahead == np.float64(10.0)
    about = min(map(dubins.length_m, dubins.ways((0, 0, 0), (0, 2 * RADIUS_M, np.pi), RADIUS_M)))
    assert abs(about - np.pi * RADIUS_M) < 0.02  # chords


def test_straight_back_keeps_its_heading():
    way = dubins.straight((1.0, 2.0, 0.5), -3.0)
    assert np.allclose(way[-1, :2], [1 - 3 * np.cos(0.5), 2 - 3 * np.sin(0.5)])
    assert (way[:, 2] == 0.5).all()
