import os
import subprocess
import sys
import threading

import pytest

from polecal.drivers.urgent import urgently

WITHOUT_RIGHTS = """
import os, resource
from polecal.drivers.urgent import urgently
resource.setrlimit(resource.RLIMIT_RTPRIO, (0, 0))
if os.getuid() == 0:
    os.setgroups([])
    os.setuid(65534)
urgently(lambda: print(os.sched_getscheduler(0)))
"""


def in_a_thread(work):
    thread = threading.Thread(target=urgently, args=(work,))
    thread.start()
    thread.join()


def may_go_first():
    told = []

    def ask():
        try:
            os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(1))
            told.append(True)
        except OSError:
            told.append(False)

    thread = threading.Thread(target=ask)
    thread.start()
    thread.join()
    return told[0]


def python(code):
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return int(done.stdout)


def test_work_is_done_all_the_same_where_it_may_not_go_before_others():
    assert python(WITHOUT_RIGHTS) == os.SCHED_OTHER


def test_work_goes_before_others_and_nothing_else_does():
    if not may_go_first():
        pytest.skip("this user may run nothing before others (RLIMIT_RTPRIO)")
    found = []

    def work():
        found.append(os.sched_getscheduler(0) & ~os.SCHED_RESET_ON_FORK)
        found.append(python("import os; print(os.sched_getscheduler(0))"))
        another = threading.Thread(target=lambda: found.append(os.sched_getscheduler(0)))
        another.start()
        another.join()

    in_a_thread(work)
    assert found == [os.SCHED_RR, os.SCHED_OTHER, os.SCHED_OTHER]
    assert os.sched_getscheduler(0) == os.SCHED_OTHER
