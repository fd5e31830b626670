import numpy as np
import pytest

from polecal.drivers.clock import Clock

MS = 1_000_000
START_NS = 9_000_000_000_000


def run(clock, *, seconds, latency_ms, ppm=30.0, period_ms=13.32, skip=0.0, start=0, seed=0):
    """Feed stamps of a device whose clock is ``ppm`` off; give |error| of the map at each, in ms."""
    rng = np.random.default_rng(seed)
    errors = []
    for index in range(start, start + int(seconds * 1000 / period_ms)):
        device_ns = round(index * period_ms * MS)
        true_ns = START_NS + device_ns * (1 + ppm * 1e-6)
        if rng.random() < skip:
            continue
        clock.update(device_ns, round(true_ns + latency_ms(rng) * MS))
        errors.append(abs(clock.to_host(device_ns) - true_ns) / MS)
    return np.array(errors)


@pytest.mark.parametrize(
    "latency", [lambda r: r.uniform(0, 16), lambda r: r.uniform(0, 1), lambda r: r.exponential(0.1)]
)
def test_late_stamps_come_out_within_a_fifth_of_a_millisecond(latency):
    errors = run(Clock(max_drift=5e-3), seconds=120, latency_ms=latency, skip=0.01)
    assert np.quantile(errors[len(errors) // 2 :], 0.99) < 0.2


def test_a_motor_a_thousandth_off_is_learnt():
    errors = run(Clock(max_drift=5e-3), seconds=60, latency_ms=lambda r: r.uniform(0, 1), ppm=1000)
    assert errors[-1] < 0.1


def test_it_is_locked_once_it_has_heard_for_long_enough():
    clock = Clock(max_drift=5e-3, settle_s=3.0)
    run(clock, seconds=2.5, latency_ms=lambda r: 0.0)
    assert not clock.locked
    run(clock, seconds=1.0, latency_ms=lambda r: 0.0, start=190)
    assert clock.locked


def test_there_and_back_is_the_same_time():
    clock = Clock(max_drift=5e-3)
    run(clock, seconds=20, latency_ms=lambda r: r.uniform(0, 1), ppm=200)
    for device_ns in (0, 10**10, 10**12):
        assert clock.to_device(clock.to_host(device_ns)) == pytest.approx(device_ns, abs=1)


def test_gps_time_keeps_its_nanoseconds():
    """10^18 ns does not fit a float: what is near must stay near."""
    clock = Clock(max_drift=2e-4)
    gps_ns = 2400 * 604_800 * 10**9
    for index in range(1000):
        clock.update(gps_ns + index * 10 * MS, START_NS + index * 10 * MS)
    assert clock.to_host(gps_ns + 123_456_789) == START_NS + 123_456_789


@pytest.mark.parametrize("jump_ns", [-3_600 * 10**9, 10**9, -(10**8)])
def test_a_clock_that_jumps_is_learnt_anew(jump_ns):
    clock = Clock(max_drift=5e-3)
    run(clock, seconds=20, latency_ms=lambda r: 0.0, ppm=0)
    last_ns = round(1500 * 13.32 * MS)
    for index in range(1, 400):
        clock.update(
            last_ns + round(index * 13.32 * MS), START_NS + jump_ns + last_ns + round(index * 13.32 * MS)
        )
    assert clock.resets == 1
    assert clock.locked
    assert clock.to_host(last_ns) == pytest.approx(START_NS + jump_ns + last_ns, abs=1000)


def test_a_device_that_counts_from_zero_again_is_learnt_anew():
    clock = Clock(max_drift=5e-3)
    run(clock, seconds=20, latency_ms=lambda r: 0.0)
    clock.update(0, START_NS + 25 * 10**9)
    assert clock.resets == 1
    assert not clock.locked


@pytest.mark.parametrize("period_ms", [10.0, 53.28])
@pytest.mark.parametrize("held_s", [2.0, 5.0, 30.0])
def test_of_what_nobody_read_for_seconds_and_comes_at_once_nothing_is_learnt(held_s, period_ms):
    clock = Clock(max_drift=5e-3)
    run(clock, seconds=20, latency_ms=lambda r: 0.0, ppm=0)
    ended_ns = 20 * 10**9 + round(held_s * 1e9)
    for index in range(1, round((held_s + 10) * 1e3 / period_ms)):
        device_ns = 20 * 10**9 + round(index * period_ms * MS)
        clock.update(device_ns, START_NS + max(device_ns, ended_ns))
        if clock.locked and device_ns > ended_ns:
            assert clock.to_host(device_ns) == pytest.approx(START_NS + device_ns, abs=MS)
        elif clock.locked:  # it has not seen that anything is wrong, or all is late by little
            assert clock.to_host(device_ns) == pytest.approx(START_NS + device_ns, abs=50 * MS)
    assert clock.locked


def test_first_stamps_that_are_all_late_do_not_tilt_the_clock():
    clock = Clock(max_drift=5e-3)
    for index in range(1000):
        device_ns = index * 10 * MS
        late_ns = max(0, 40 * MS - index * MS // 4)  # over after 1.6 s
        clock.update(device_ns, START_NS + device_ns + late_ns)
        if clock.locked:
            assert clock.to_host(device_ns) == pytest.approx(START_NS + device_ns, abs=MS)


def test_the_same_device_time_twice_changes_nothing():
    clock = Clock(max_drift=5e-3)
    run(clock, seconds=20, latency_ms=lambda r: 0.0)
    device_ns = round(1500 * 13.32 * MS)
    before = clock.to_host(device_ns)
    clock.update(round(1500 * 13.32 * MS), START_NS + 30 * 10**9)
    clock.update(round(1500 * 13.32 * MS), START_NS + 31 * 10**9)
    assert clock.resets <= 1
    assert before == pytest.approx(START_NS + device_ns, abs=10**6)


def test_memory_stays_bounded():
    clock = Clock(max_drift=5e-3, window_s=10)
    run(clock, seconds=200, latency_ms=lambda r: r.uniform(0, 1))
    assert len(clock._old.x) < 100
