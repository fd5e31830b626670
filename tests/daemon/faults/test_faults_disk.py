"""A host whose disk is slow, or whose socket is crowded."""

import os
import socket
import threading
import time

from polecal.daemon.control import Client


def test_a_disk_that_takes_2_s_to_sync_costs_no_byte(trial, tell, monkeypatch):
    synced = []

    def slow(of):
        def sync(fd):
            time.sleep(2.0)  # what a worn SD card does
            synced.append(fd)
            of(fd)

        return sync

    trial.in_mid_pass()
    with monkeypatch.context() as patch, trial.fault(8.0):
        patch.setattr(os, "fdatasync", slow(os.fdatasync))
        patch.setattr(os, "fsync", slow(os.fsync))
    assert len(synced) > 2
    trial.recovers()
    trial.goes_on()
    trial.untouched("front")
    trial.untouched("span")
    tell(trial.line("each sync of the disk takes 2 s, for 8 s"))
    tell(f"slowest STATUS meanwhile {trial.seen.slowest_s * 1e3:.0f} ms")


def connected(path):
    client = socket.socket(socket.AF_UNIX)
    client.settimeout(20.0)
    client.connect(str(path))
    return client


def test_ten_clients_of_which_three_are_bad_cost_the_run_nothing(trial, tell):
    path = trial.bench.config.socket
    over = threading.Event()
    answers, refusals = [], []

    def ask():
        with Client(path) as client:
            while not over.wait(0.05):
                answers.append(client.request({"class": "STATUS"})["class"])

    def babble():
        with connected(path) as mad, mad.makefile("rb") as said:
            said.readline()
            while not over.wait(0.01):
                mad.sendall(os.urandom(300).replace(b"\n", b"") + b"\n")
                refusals.append(said.readline())

    def go_on():
        with connected(path) as endless, endless.makefile("rb") as said:
            said.readline()
            while not over.wait(0.05):
                endless.sendall(b"x" * 10_000_000 + b"\n")
                refusals.append(said.readline())

    clients = [threading.Thread(target=target) for target in (*[ask] * 7, babble, go_on)]
    trial.in_mid_pass()
    with connected(path) as deaf, trial.fault(6.0):
        deaf.sendall(b'{"class":"WATCH"}\n' * 50)  # and never reads what comes
        for client in clients:
            client.start()
    over.set()
    for client in clients:
        client.join(20.0)
        assert not client.is_alive()
    trial.recovers()
    trial.goes_on()
    assert len(answers) > 100
    assert set(answers) == {"STATUS"}
    assert len(refusals) > 50
    assert all(b'"class":"ERROR"' in one for one in refusals)
    trial.untouched("front")
    trial.untouched("span")
    tell(trial.line(f"ten clients, {len(answers)} answers and {len(refusals)} refusals"))
    tell(f"slowest STATUS meanwhile {trial.seen.slowest_s * 1e3:.0f} ms")
