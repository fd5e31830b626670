"""A driver's conversation in virtual time: its port, its clock and its waits, without a pseudo-terminal."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable
from itertools import pairwise
from typing import Any, Protocol

import pytest

from polecal.drivers.port import Chunk, Stopped, Tap

READ_S = 0.002  # a USB adapter hands over what came in so long


class Peer(Protocol):
    """What is at the other end of the line."""

    def receive(self, t_ns: int, data: bytes, host_baud: int) -> None: ...

    def transmit(self, t_ns: int, host_baud: int) -> bytes: ...

    def next_ns(self) -> int | None: ...


class Clock:
    """Stands for the `time` module in the modules of a driver; goes on only while somebody waits."""

    def __init__(self) -> None:
        self.ns = 1_000_000_000_000
        self._due: list[tuple[int, Callable[[], None]]] = []

    def monotonic(self) -> float:
        return self.ns * 1e-9

    def monotonic_ns(self) -> int:
        return self.ns

    def at(self, after_s: float, action: Callable[[], object]) -> None:
        """Have something done once so much time has passed."""
        self._due = sorted([*self._due, (self.ns + round(after_s * 1e9), action)], key=lambda due: due[0])

    def stop(self) -> Stop:
        """Make an event whose waits take no time."""
        return Stop(self)

    def to(self, ns: int) -> None:
        while self._due and self._due[0][0] <= ns:
            due_ns, action = self._due.pop(0)
            self.ns = max(self.ns, due_ns)
            action()
        self.ns = max(self.ns, ns)


class Stop(threading.Event):
    """An event whose waits take no time."""

    def __init__(self, clock: Clock) -> None:
        super().__init__()
        self._clock = clock

    def wait(self, timeout: float | None = None) -> bool:
        assert timeout is not None
        if not self.is_set():
            self._clock.to(self._clock.ns + round(timeout * 1e9))
        return self.is_set()


class VirtualPort:
    """`Port`, with a peer in place of the file."""

    def __init__(self, clock: Clock, peer: Peer, baud: int, tap: Tap, stop: threading.Event) -> None:
        self.path, self.baud, self.stop = "/dev/virtual", baud, stop
        self._clock, self._peer, self._tap = clock, peer, tap

    def __enter__(self) -> VirtualPort:
        return self

    def __exit__(self, *_: object) -> None: ...

    def close(self) -> None: ...

    def set_baud(self, baud: int) -> None:
        self._peer.transmit(self._clock.ns, self.baud)
        self.baud = baud

    def read(self, timeout_s: float) -> Chunk | None:
        end_ns = self._clock.ns + round(timeout_s * 1e9) + 1000  # no read takes no time
        while True:
            if self.stop.is_set():
                raise Stopped
            data = self._peer.transmit(self._clock.ns, self.baud)
            if data:
                self._tap("rx", self._clock.ns, data)
                return Chunk(self._clock.ns, data)
            if self._clock.ns >= end_ns:
                return None
            moment = self._peer.next_ns()
            wake_ns = end_ns if moment is None else max(moment, self._clock.ns + round(READ_S * 1e9))
            self._clock.to(min(wake_ns, end_ns))

    @property
    def looked_s(self) -> float:
        return self._clock.ns * 1e-9

    def gather(self, seconds: float) -> list[Chunk]:
        chunks, end_ns = [], self._clock.ns + round(seconds * 1e9)
        while self._clock.ns < end_ns:
            chunk = self.read((end_ns - self._clock.ns) * 1e-9)
            chunks += [] if chunk is None else [chunk]
        return chunks

    def write(self, data: bytes) -> None:
        self._tap("tx", self._clock.ns, data)
        self._peer.receive(self._clock.ns, data, self.baud)


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    """The time of all conversations."""
    made = Clock()
    for module in ("device", "sick_lms.device", "sick_lms.conversation"):
        monkeypatch.setattr(f"polecal.drivers.{module}.time", made)
    return made


@pytest.fixture
def connected(clock: Clock, monkeypatch: pytest.MonkeyPatch) -> Callable[[Peer], None]:
    """Put a peer at the end of every port that is opened."""

    def make(peer: Peer) -> None:
        def port(
            path: str, baud: int, tap: Tap, stop: threading.Event, beat: Callable[[], None]
        ) -> VirtualPort:
            return VirtualPort(clock, peer, baud, tap, stop)

        monkeypatch.setattr("polecal.drivers.device.Port", port)

    return make


@pytest.fixture(scope="session")
def same_though_they_wait() -> Callable[[Callable[[], Any], bytes, Iterable[int]], None]:
    """Hold a framer that hears chunks once it may lack no byte against one that hears each as it comes."""

    def check(framer: Callable[[], Any], data: bytes, cuts: Iterable[int]) -> None:
        at_once, waiting = framer(), framer()
        chunks, lacking = [], waiting.lacking
        for a, b in pairwise([0, *sorted(cuts), len(data)]):
            frames, other = at_once.feed(data[a:b], a), []
            chunks.append((data[a:b], a))
            lacking -= b - a
            if lacking <= 0:
                other, chunks, lacking = waiting.feed_all(chunks), [], waiting.lacking
            assert other == frames

    return check
