import io
import os
import threading
import time
import tty

import pytest

from polecal.drivers.errors import DeviceLost
from polecal.drivers.port import Port, Stopped

MANY = 300


@pytest.fixture
def line():
    """A pseudo-terminal: the device's end, and the path of the host's."""
    device, host = os.openpty()
    tty.setraw(host)
    with io.FileIO(device, "r+") as end, io.FileIO(host, "r+"):
        yield end, os.ttyname(host)


class Taps:
    """What was recorded; `until` waits for some of it."""

    def __init__(self):
        self.seen, self._more = [], threading.Condition()

    def __call__(self, direction, t_ns, data):
        with self._more:
            self.seen.append((direction, t_ns, data))
            self._more.notify()

    def read(self):
        return b"".join(data for direction, _, data in self.seen if direction == "rx")

    def until(self, read):
        with self._more:
            assert self._more.wait_for(lambda: self.read() == read, 5.0), self.seen


@pytest.fixture
def opened(line):
    """The device's end, the open port, and what of it was recorded."""
    device, path = line
    taps = Taps()
    with Port(path, 9600, taps) as port:
        yield device, port, taps


def test_what_comes_is_stamped_and_recorded_before_anybody_asks_for_it(opened):
    device, port, taps = opened
    before_ns = time.monotonic_ns()
    device.write(b"one")
    taps.until(b"one")
    after_ns = time.monotonic_ns()
    device.write(b"two")
    taps.until(b"onetwo")
    chunks = [port.read(1.0), port.read(1.0)]
    assert [(chunk.t_ns, chunk.data) for chunk in chunks] == [(t_ns, data) for _, t_ns, data in taps.seen]
    assert before_ns < chunks[0].t_ns < after_ns < chunks[1].t_ns


def test_many_chunks_are_gathered_in_their_order_and_each_once(opened):
    device, port, taps = opened
    sent = b""
    for number in range(MANY):
        sent += b"%d," % number
        device.write(b"%d," % number)
        taps.until(sent)
    chunks = port.gather(0.1)
    assert port.gather(0.0) == []
    assert len(chunks) == MANY
    assert b"".join(chunk.data for chunk in chunks) == sent


def test_a_change_of_rate_drops_what_nobody_has_heard(opened):
    device, port, taps = opened
    device.write(b"at the old rate")
    taps.until(b"at the old rate")
    port.set_baud(38400)
    device.write(b"new")
    assert port.read(1.0).data == b"new"


def test_a_port_that_hangs_up_is_lost_to_whoever_asks_and_what_came_before_is_heard(opened):
    device, port, taps = opened
    device.write(b"last words")
    taps.until(b"last words")
    device.close()
    assert port.read(1.0).data == b"last words"
    for ask in (port.read, port.gather, lambda _: port.set_baud(9600), port.read):
        with pytest.raises(DeviceLost, match="stopped working"):
            ask(0.1)


@pytest.mark.parametrize("ask", ["read", "gather"])
def test_who_waits_is_told_to_stop(line, ask):
    stop = threading.Event()
    with Port(line[1], 9600, stop=stop) as port:
        threading.Timer(0.05, stop.set).start()
        began_s = time.monotonic()
        with pytest.raises(Stopped):
            getattr(port, ask)(60.0)
        assert time.monotonic() - began_s < 30.0


def test_a_thread_that_is_stuck_with_a_chunk_stops_the_beat_of_who_waits_for_it(line, monkeypatch):
    device, path = line
    monkeypatch.setattr("polecal.drivers.port._STUCK_S", 0.3)
    stuck, go_on, beats = threading.Event(), threading.Event(), []

    def tap(direction, t_ns, data):
        stuck.set()
        assert go_on.wait(10.0)

    with Port(path, 9600, tap, beat=lambda: beats.append(time.monotonic())) as port:
        assert port.read(0.4) is None
        assert len(beats) > 1  # a silence is no reason
        device.write(b"x")
        assert stuck.wait(5.0)
        port.gather(0.3)
        beats.clear()
        assert port.read(0.5) is None
        assert not beats
        go_on.set()
        assert port.read(1.0).data == b"x"
        assert port.read(0.4) is None
        assert beats


def test_a_port_is_closed_once_however_often_it_is_asked(line):
    opened = len(os.listdir("/proc/self/fd"))
    port = Port(line[1], 9600)
    port.close()
    port.close()
    assert len(os.listdir("/proc/self/fd")) == opened
    assert not [thread for thread in threading.enumerate() if thread.name == line[1]]
