"""A daemon that is stopped for a while, as by a debugger, a container's freezer or a starved host."""

import os
import signal
import time

import pytest


@pytest.mark.parametrize("seconds", [1.0, 6.0])
def test_a_daemon_that_is_stopped_and_continued_goes_on_without_misplacing_anything(
    trial_apart, seconds, tell
):
    trial, pid = trial_apart
    trial.in_mid_pass()
    with trial.fault():
        os.kill(pid, signal.SIGSTOP)
        time.sleep(seconds)
    os.kill(pid, signal.SIGCONT)
    trial.recovers()
    trial.goes_on()
    assert [trial.device(name)["reconnects"] for name in ("front", "span")] == [0, 0]
    assert (trial.lost_scans() > 0) == (seconds > 2)
    tell(trial.line(f"polecald stopped for {seconds:.0f} s"))
