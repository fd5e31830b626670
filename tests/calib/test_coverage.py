import numpy as np
import pytest

from polecal.calib.coverage import Need, coverage, headings, is_whole, slice_of


@pytest.mark.parametrize(
    ("yaw_deg", "index"), [(0, 0), (29.999, 0), (30.001, 1), (359.9, 11), (-0.1, 11), (360, 0), (-1e-14, 0)]
)
def test_slices_begin_at_north_and_close_the_circle(yaw_deg, index):
    assert slice_of(np.radians([yaw_deg]), 30)[0] == index


def test_a_slice_is_done_with_enough_returns_in_enough_passes():
    need = Need(min_pole_returns=100, min_passes=2, slices_needed=1)
    one_pass = coverage([{3: 150}], need)
    assert (one_pass[3].pole_returns, one_pass[3].passes, one_pass[3].done) == (150, 1, False)
    two_passes = coverage([{3: 60}, {3: 60, 4: 1}], need)
    assert two_passes[3].done
    assert not two_passes[4].done
    assert is_whole(two_passes, need)
    assert not is_whole(one_pass, need)


@pytest.mark.parametrize(
    ("slices", "words"),
    [
        ([3, 4], "90–150°"),
        ([11, 0], "330–30°"),
        ([11], "330–360°"),
        ([0, 5], "0–30°, 150–180°"),
        (range(12), "0–360°"),
    ],
)
def test_headings_join_neighbours_across_north(slices, words):
    assert headings(list(slices), 30) == words
