"""Ports that go away, come back, or are somebody else's."""

import contextlib
import fcntl
import os
import select
import time

import pytest


def test_a_laser_that_is_unplugged_and_plugged_in_again_goes_on(trial, tell):
    trial.in_mid_pass()
    with trial.fault(3.0) as seen:
        trial.bench.served.unplug(trial.bench.lms)
    assert seen.devices["front"][-1] == "lost"
    trial.bench.served.plug(trial.bench.lms)
    trial.recovers()
    trial.goes_on()
    assert seen.told(str(trial.bench.lms), "there is no such port")
    assert trial.device("front")["reconnects"] == 1
    trial.untouched("span")
    tell(trial.line("laser unplugged for 3 s"))


def test_a_receiver_that_is_unplugged_and_plugged_in_again_goes_on(trial, tell):
    trial.in_mid_pass()
    with trial.fault(4.0) as seen:
        trial.bench.served.unplug(trial.bench.span)
    assert seen.devices["span"][-1] == "lost"
    assert seen.states == ["collecting", "aligning"]
    trial.bench.served.plug(trial.bench.span)
    trial.recovers()
    trial.goes_on()
    assert seen.told(str(trial.bench.span), "there is no such port")
    assert seen.told("no poses come from the receiver any more")
    assert trial.device("span")["reconnects"] == 1
    trial.untouched("front")
    tell(trial.line("receiver unplugged for 4 s"))


@pytest.fixture
def grabbed(trial):
    """Plugs a port in again, and has another program lock it before the daemon does."""

    def grab(path):
        while True:
            trial.bench.served.plug(path)
            thief = os.open(path, os.O_RDWR | os.O_NOCTTY)
            try:
                fcntl.flock(thief, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:  # the daemon was quicker
                os.close(thief)
                trial.bench.served.unplug(path)
                continue
            return thief

    return grab


def test_a_port_that_another_program_grabs_while_it_is_unplugged_is_waited_for(trial, grabbed, tell):
    with trial.fault() as seen:
        trial.bench.served.unplug(trial.bench.lms)
        trial.until(lambda: seen.devices["front"][-1] == "lost")
        thief = grabbed(trial.bench.lms)
        trial.until_seen(str(trial.bench.lms), "another program holds it")
        assert "fuser" in trial.device("front")["hint"]
    os.close(thief)
    trial.recovers()
    trial.goes_on()
    trial.untouched("span")
    tell(trial.line("laser's port grabbed"))


@contextlib.contextmanager
def _first_of_all():
    """Run before a daemon that runs before all else, where it may: it would read everything first."""
    before = os.sched_getscheduler(0), os.sched_getparam(0)
    with contextlib.suppress(PermissionError):
        os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(2))
    try:
        yield
    finally:
        os.sched_setscheduler(0, *before)


def test_a_program_that_reads_along_without_asking_costs_frames_and_nothing_else(trial, tell):
    """It takes bytes out of the midst of telegrams: on a real port, only root can."""
    trial.in_mid_pass()
    with trial.fault(), _first_of_all():
        thief = os.open(trial.bench.lms, os.O_RDONLY | os.O_NOCTTY | os.O_NONBLOCK)
        end_s, stolen = time.monotonic() + 2.0, 0
        while time.monotonic() < end_s:
            if select.select([thief], [], [], 0.1)[0]:
                try:
                    stolen += len(os.read(thief, 64))
                except BlockingIOError:  # the daemon was quicker
                    continue
        os.close(thief)
    trial.recovers()
    trial.goes_on()
    assert stolen
    assert trial.device("front")["bad_frames"]
    trial.untouched("span")
    tell(trial.line(f"another program takes {stolen} bytes of the laser's"))
