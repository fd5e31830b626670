"""A clock that stood still while devices went on, and bytes that waited for seconds: in virtual time."""

import numpy as np
import pytest

from polecal.drivers.emulated.laser_scans import REVOLUTION_NS

CYCLE_S = 256 * REVOLUTION_NS * 1e-9
"""A laser's revolutions are counted mod 256."""


@pytest.fixture(scope="module")
def heard(fast_world, streaming):
    """What a host hears of the fast drive; the devices are not exactly in step with it."""
    world = fast_world()
    laser = {"drift_ppm": 40.0}
    return world, streaming(world, 50.0, laser=laser)


@pytest.fixture
def holds(begun, settings, held_against, tell):
    """Plays chunks, and holds every pass against the world; tells how many there are."""

    def hold(world, chunks, say):
        played = begun(settings(routine={"min_passes": 99}))
        played.feed(chunks).finish()
        origin = played.pipeline._navigation.trajectory.origin
        worst_m = [held_against(world, origin, stored.returns) for _, stored in played.passes]
        tell(f"{say}: {len(worst_m)} passes, worst pole return off by {max(worst_m) * 100:.0f} cm")
        return played

    return hold


@pytest.mark.parametrize("gap_s", [2 * CYCLE_S - 0.04, 3 * CYCLE_S + 0.02, 12.0])
def test_a_host_that_was_suspended_misplaces_nothing(heard, holds, t0_ns, gap_s):
    """Its clock goes on from where it was; the devices' have gone on. The laser may seem to fit."""
    world, chunks = heard
    begin_ns, gap_ns = t0_ns + 16 * 10**9, round(gap_s * 1e9)
    before = [chunk for chunk in chunks if chunk[1] < begin_ns]
    after = [(name, t_ns - gap_ns, data) for name, t_ns, data in chunks if t_ns >= begin_ns + gap_ns]
    played = holds(world, before + after, f"suspended for {gap_s:.2f} s")
    assert len(played.passes) > 8


@pytest.mark.parametrize(("held_s", "first"), [(0.3, "span"), (2.0, "front"), (8.0, "span")])
def test_what_a_kernel_kept_while_nobody_read_is_not_misplaced(heard, holds, t0_ns, held_s, first):
    """A tty keeps far more than a pseudo-terminal: all of it then comes at once, one line after the other."""
    world, chunks = heard
    begin_ns = t0_ns + 16 * 10**9
    end_ns = begin_ns + round(held_s * 1e9)
    held = [chunk for chunk in chunks if begin_ns <= chunk[1] < end_ns]
    late = []
    for line in sorted({"front", "span"}, key=lambda name: name != first):
        kept = b"".join(data for name, _, data in held if name == line)
        late += [(line, kept[i : i + 4096]) for i in range(0, len(kept), 4096)]
    at_once = [(name, end_ns + i * 50_000, data) for i, (name, data) in enumerate(late)]
    rest = [(name, max(t_ns, at_once[-1][1]), data) for name, t_ns, data in chunks if t_ns >= end_ns]
    played = holds(
        world,
        [chunk for chunk in chunks if chunk[1] < begin_ns] + at_once + rest,
        f"held back for {held_s} s, {first} first",
    )
    assert len(played.passes) > 8
    assert np.isfinite(played.laser()["cost_m"])
