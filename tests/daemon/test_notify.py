"""What the service manager is told, and that it is told nothing more once a thread is stuck."""

import contextlib
import os
import socket
import threading
import time

import pytest
from structlog.testing import capture_logs

from polecal.daemon import service as service_module
from polecal.daemon.notify import Manager, summary
from polecal.daemon.service import Service


class Listener:
    """A service manager's socket."""

    def __init__(self, address):
        self.socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self.socket.bind(address)
        self.socket.setblocking(False)

    def heard(self):
        """Give what has come since the last time."""
        said = []
        try:
            while True:
                said.append(self.socket.recv(4096).decode())
        except BlockingIOError:
            return said


@pytest.fixture
def listener(tmp_path):
    made = Listener(str(tmp_path / "notify"))
    yield made
    made.socket.close()


@pytest.fixture
def manager(tmp_path, listener):
    return Manager({"NOTIFY_SOCKET": str(tmp_path / "notify"), "WATCHDOG_USEC": "1500000"})


def test_each_state_is_a_datagram_in_systemds_words(manager, listener):
    manager.ready()
    manager.reloading()
    manager.ready()
    manager.stopping()
    manager.extend(5.0)
    ready, reloading, *rest = listener.heard()
    assert ready == "READY=1"
    first, second = reloading.split("\n")
    assert first == "RELOADING=1"
    name, _, value = second.partition("=")
    assert name == "MONOTONIC_USEC"
    assert 0 <= time.monotonic() - int(value) / 1e6 < 60
    assert rest == ["READY=1", "STOPPING=1", "EXTEND_TIMEOUT_USEC=5000000"]


def test_an_abstract_address_is_found():
    name = f"polecal-test-{os.getpid()}"
    listener = Listener("\0" + name)
    Manager({"NOTIFY_SOCKET": "@" + name}).ready()
    assert listener.heard() == ["READY=1"]
    listener.socket.close()


def test_where_nobody_listens_nothing_happens(tmp_path):
    for environment in ({}, {"NOTIFY_SOCKET": ""}, {"NOTIFY_SOCKET": str(tmp_path / "none")}):
        manager = Manager(environment)
        manager.ready()
        manager.status("idle")
        manager.alive({})
        assert manager.watchdog_s is None


def test_a_manager_that_reads_nothing_holds_nobody_up(manager, listener, tmp_path):
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as other, contextlib.suppress(BlockingIOError):
        other.setblocking(False)
        while True:
            other.sendto(b"noise", str(tmp_path / "notify"))
    manager.ready()  # came back
    assert set(listener.heard()) == {"noise"}


@pytest.mark.parametrize(
    ("environment", "watchdog_s"),
    [
        ({"WATCHDOG_USEC": "30000000"}, 30.0),
        ({"WATCHDOG_USEC": "30000000", "WATCHDOG_PID": str(os.getpid())}, 30.0),
        ({"WATCHDOG_USEC": "30000000", "WATCHDOG_PID": "1"}, None),
        ({"WATCHDOG_USEC": "soon"}, None),
        ({}, None),
    ],
)
def test_the_watchdog_is_that_of_this_process(environment, watchdog_s):
    assert Manager(environment).watchdog_s == watchdog_s


def test_the_status_is_told_once_and_on_one_line(manager, listener):
    for text in ("idle: start", "idle: start", "fault:\n  two\n  lines", "idle: start"):
        manager.status(text)
    assert listener.heard() == ["STATUS=idle: start", "STATUS=fault: two lines", "STATUS=idle: start"]


def test_one_thread_that_does_not_beat_stops_the_pings_and_is_named_once(manager, listener):
    now_s = time.monotonic()
    manager.alive({})
    manager.alive({"front": now_s, "span": now_s, "writer": now_s})
    assert listener.heard() == ["WATCHDOG=1"] * 2
    with capture_logs() as logs:
        for name in ("front", "span", "writer"):
            manager.alive({"front": now_s, "span": now_s, "writer": now_s} | {name: now_s - 1.0})
            manager.alive({"front": now_s, "span": now_s, "writer": now_s} | {name: now_s - 1.0})
    assert listener.heard() == []
    assert [log["threads"] for log in logs] == ["front", "span", "writer"]
    manager.alive({"front": now_s, "span": now_s, "writer": now_s})
    assert listener.heard() == ["WATCHDOG=1"]


# --- beats of a real run


@pytest.fixture
def service(bench):
    made = Service(bench.config)
    made.handle({"class": "START", "name": None})
    yield made
    made.close()
    assert made.beats() == {}


def ages_s(service):
    now_s = time.monotonic()
    return {name: now_s - beat_s for name, beat_s in service.beats().items()}


def test_devices_that_are_unplugged_or_silent_are_not_stuck(service, bench, until):
    assert {"front", "span", "engine", "writer"} == service.beats().keys()
    bench.served.unplug(bench.lms)
    bench.receiver.transmit = lambda *_: b""  # and this one says nothing more
    oldest_s = 0.0

    def both_lost():
        nonlocal oldest_s
        oldest_s = max(oldest_s, *ages_s(service).values())
        return all(device.reconnects or device.state == "lost" for device in service._run.devices)

    until(both_lost)
    for _ in range(100):
        both_lost()
        time.sleep(0.02)
    assert oldest_s < 7.5  # half of what the unit's watchdog allows


@pytest.mark.parametrize("name", ["front", "span"])
def test_a_reader_that_is_stuck_stops_the_pings_until_it_goes_on(service, manager, listener, until, name):
    manager.alive(service.beats())
    assert listener.heard() == ["WATCHDOG=1"]
    (device,) = [device for device in service._run.devices if device.name == name]
    heard, free = device._heard, threading.Event()
    device._heard = lambda chunk: free.wait(30.0) and heard(chunk)
    try:
        until(lambda: ages_s(service)[name] > 1.0)
        manager.alive(service.beats())
        assert listener.heard() == []
        assert {other for other, age_s in ages_s(service).items() if age_s < 0.75} >= {"engine", "writer"}
    finally:
        free.set()
    until(lambda: ages_s(service)[name] < 0.75)
    manager.alive(service.beats())
    assert listener.heard() == ["WATCHDOG=1"]


def test_an_engine_that_is_stuck_stops_the_pings(service, manager, listener, until):
    feed, free = service._run._pipeline.feed, threading.Event()
    service._run._pipeline.feed = lambda *chunk: free.wait(30.0) and feed(*chunk)
    try:
        until(lambda: ages_s(service)["engine"] > 1.0)
        manager.alive(service.beats())
        assert listener.heard() == []
        assert ages_s(service)["front"] < 0.75
    finally:
        free.set()


# --- words


def test_the_summary_says_state_progress_trouble_and_what_to_do():
    slices = [{"done": True}] * 5 + [{"done": False}] * 7
    front = {"name": "front", "passes": 7, "coverage": slices}
    status = {
        "state": "collecting",
        "lasers": [front],
        "devices": [{"name": "front"}, {"name": "span", "problem": "/dev/span: gone"}],
        "next": "drive past the pole heading 90–150°",
    }
    assert summary(status) == (
        "collecting: 7 passes, 5 of 12 slices; /dev/span: gone; drive past the pole heading 90–150°"
    )
    status["lasers"] = [front | {"passes": 1}, front | {"name": "rear"}]
    status["devices"] = []
    assert summary(status).startswith(
        "collecting: front 1 pass, 5 of 12 slices; rear 7 passes, 5 of 12 slices; drive"
    )


def test_the_summary_of_an_idle_daemon_says_how_to_start(settings):
    assert summary(Service(settings()).status()) == "idle: polecal-field start"


def test_while_a_capture_is_being_closed_more_time_is_asked_for_but_not_for_ever(
    manager, listener, until, monkeypatch
):
    class Slow:
        """A service whose disk takes its time."""

        def close(self):
            free.wait(30.0)

    free = threading.Event()
    monkeypatch.setattr(service_module, "_TELL_S", 0.01)
    monkeypatch.setattr(service_module, "_CLOSE_S", 0.5)
    closing = threading.Thread(target=service_module._close, args=(Slow(), manager))
    closing.start()
    asked = until(listener.heard)
    assert set(asked) == {"EXTEND_TIMEOUT_USEC=5000000"}
    until(lambda: not listener.heard() and time.sleep(0.2) is None and not listener.heard())
    assert closing.is_alive()
    free.set()
    closing.join(5.0)
    assert not closing.is_alive()
