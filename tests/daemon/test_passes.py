"""Returns to passes: where one begins and ends, and what it holds."""

import numpy as np
import pytest

from polecal.calib import Kind, Mount, points_nav
from polecal.calib.estimate import split
from polecal.daemon.passes import PassBuilder, joined, observed
from polecal.daemon.trajectory import Poses

SECOND = 1_000_000_000
MOUNT = Mount(0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


def returns(pole, ground=0, at=0.0):
    """So many returns of pole and of ground; ``at`` tells them from others."""
    count = pole + ground
    vectors = np.arange(3 * count, dtype=float).reshape(count, 3) + at
    kind = np.array([Kind.POLE] * pole + [Kind.GROUND] * ground, dtype=np.uint8)
    poses = Poses(np.ones(count, dtype=bool), *(vectors * scale for scale in (1, 1e-3, 0.1, 0.01, 0.2, 0.02)))
    return observed(np.full(count, 5.0 + at), np.full(count, 0.1), poses, kind)


def seen(builder, place, moments_s, pole=10):
    for moment_s in moments_s:
        t_ns = round(moment_s * SECOND)
        builder.add(place, (t_ns, t_ns), np.full(pole + 5, t_ns + 7), returns(pole, 5, moment_s))


@pytest.fixture
def builder():
    return PassBuilder(30)


def test_a_pass_is_open_while_the_pole_is_in_view_and_closed_after_it(builder):
    seen(builder, 0, [1.0, 1.1, 1.2, 2.5])
    assert builder.close(MOUNT, round(3.9 * SECOND)) == []
    assert builder.counts() == (1, 60)
    (one,) = builder.close(MOUNT, round(4.1 * SECOND))
    assert builder.counts() == (0, 0)
    assert one.t_ns == (SECOND, round(2.5 * SECOND))
    assert len(one.returns) == len(one.gps_ns) == 60
    assert one.gps_ns[0] == SECOND + 7


def test_nothing_is_closed_twice_and_numbers_go_on(builder):
    for start_s in (1.0, 20.0, 40.0):
        seen(builder, 0, [start_s, start_s + 0.5])
        (one,) = builder.close(MOUNT, round((start_s + 10) * SECOND))
        assert (one.returns.pass_id == one.id).all()
        assert one.moments.id == one.id
        assert builder.close(MOUNT) == []
    assert one.id == 3


def test_places_have_passes_of_their_own(builder):
    seen(builder, 0, [1.0, 1.2, 1.4])
    seen(builder, 4, [1.3, 3.0])
    (one,) = builder.close(MOUNT, round(3.1 * SECOND))
    assert (one.place, one.t_ns[1]) == (0, round(1.4 * SECOND))
    (other,) = builder.close(MOUNT)
    assert (other.place, len(other.returns)) == (4, 30)
    assert other.id != one.id


def test_the_end_of_a_run_closes_what_is_open(builder):
    seen(builder, 0, [1.0, 1.1, 1.2])
    assert len(builder.close(MOUNT)) == 1


def test_a_vehicle_that_never_turns_away_does_not_fill_the_memory(builder):
    most, closed = 0, 0
    for tenth in range(3000):
        seen(builder, 0, [tenth / 10])
        closed += len(builder.close(MOUNT, tenth * SECOND // 10))
        most = max(most, builder.counts()[1])
    assert closed == 4
    assert most <= 15 * 602


def test_a_glimpse_is_no_pass_and_is_counted(builder):
    seen(builder, 0, [1.0], pole=19)
    assert builder.close(MOUNT) == []
    assert builder.too_short == 1
    seen(builder, 0, [9.0], pole=20)
    assert [one.id for one in builder.close(MOUNT)] == [1]


def test_a_closed_pass_has_the_moments_of_its_returns(builder):
    seen(builder, 0, [1.0, 1.1, 1.2])
    (one,) = builder.close(MOUNT)
    again = split(one.returns, 30)
    assert one.blocks.keys() == one.moments.counts.keys() == again.keys()
    assert sum(one.moments.counts.values()) == len(one.returns)
    assert sum(one.moments.pole_returns.values()) == 30
    for key, block in again.items():
        assert np.array_equal(one.blocks[key].packed, block.packed)


def test_joining_keeps_order_and_every_column():
    first, second = returns(2, 1, at=0.5), returns(1, 0, at=9.0)
    both = joined([first, second], 3)
    assert both.range_m.tolist() == [5.5, 5.5, 5.5, 14.0]
    assert both.kind.tolist() == [Kind.POLE, Kind.POLE, Kind.GROUND, Kind.POLE]
    assert both.pass_id.tolist() == [3, 3, 3, 3]
    for name in ("position_m", "rpy_rad", "velocity_mps", "rate_radps"):
        assert np.array_equal(getattr(both, name), np.vstack([getattr(first, name), getattr(second, name)]))


def test_an_observed_beam_is_placed_by_its_own_pose():
    """Eq. 2 by hand: 5 m ahead of a laser half a metre right of a body that looks east, 2 m north."""
    pose = Poses(
        np.array([True]),
        np.array([[2.0, 0.0, -1.0]]),
        np.array([[0.0, 0.0, np.pi / 2]]),
        *[np.zeros((1, 3))] * 4,
    )
    one = observed(np.array([5.0]), np.array([0.0]), pose, np.array([Kind.POLE], dtype=np.uint8))
    assert points_nav(one, Mount(0.0, 0.5, 0.0, 0.0, 0.0, 0.0))[0] == pytest.approx([1.5, 5.0, -1.0])
