"""A serial line in virtual time: what a device sends and when each byte has left, and what it hears."""

from __future__ import annotations

import heapq
import itertools
import math
import random
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

BITS_PER_BYTE = 10  # 8N1


@dataclass(slots=True)
class _Burst:
    ready_ns: int
    data: bytes
    then_baud: int | None


class Line:
    """The sending side of a UART: first in, first out, a byte in ten bits."""

    def __init__(self, baud: int, t_ns: int) -> None:
        self.baud = baud
        self._queue: deque[_Burst] = deque()
        self._free_ns: float = t_ns  # when the last byte to have left had left
        self._left: list[tuple[int, bytes]] = []

    @property
    def byte_ns(self) -> float:
        """How long a byte takes, ns."""
        return 1e9 * BITS_PER_BYTE / self.baud

    @property
    def busy_until_ns(self) -> float:
        """When all that is queued will have left, ns."""
        end, byte_ns = self._free_ns, self.byte_ns
        for burst in self._queue:
            end = max(end, burst.ready_ns) + len(burst.data) * byte_ns
            if burst.then_baud:
                byte_ns = 1e9 * BITS_PER_BYTE / burst.then_baud
        return end

    def send(self, ready_ns: int, data: bytes, then_baud: int | None = None) -> None:
        """Queue bytes that may leave from ``ready_ns`` on; the rate changes after the last of them."""
        self._queue.append(_Burst(ready_ns, data, then_baud))

    def say(self, data: bytes) -> None:
        """Let bytes leave at once, past the queue."""
        self._left.append((self.baud, data))

    def run(self, t_ns: int) -> None:
        """Let everything leave whose last bit is through by ``t_ns``."""
        while self._queue:
            burst = self._queue[0]
            start = max(self._free_ns, burst.ready_ns)
            count = min(len(burst.data), int((t_ns - start + 0.5) // self.byte_ns))
            if count > 0:
                self._left.append((self.baud, burst.data[:count]))
                self._free_ns = start + count * self.byte_ns
                burst.data = burst.data[count:]
            if burst.data:
                return
            if burst.then_baud:
                self.baud = burst.then_baud
            self._queue.popleft()

    def cut(self, t_ns: int) -> None:
        """Drop everything queued but the byte that is on the line at ``t_ns``."""
        self.run(t_ns)
        if self._queue:
            burst = self._queue[0]
            begun = max(self._free_ns, burst.ready_ns) < t_ns
            self._queue.clear()
            if begun:
                self.send(burst.ready_ns, burst.data[:1])

    def take(self) -> list[tuple[int, bytes]]:
        """Return what has left since the last call, as (bit/s, bytes)."""
        left, self._left = self._left, []
        return left

    def next_ns(self) -> int | None:
        """When the next byte will have left, or None."""
        if not self._queue:
            return None
        return math.ceil(max(self._free_ns, self._queue[0].ready_ns) + self.byte_ns)


def garble(data: bytes, sent_baud: int, heard_baud: int, rng: random.Random) -> bytes:
    """Return what a UART at one rate makes of bytes sent at another: noise, fewer bytes if it is slower."""
    if sent_baud == heard_baud:
        return data
    return rng.randbytes(max(1, round(len(data) * min(heard_baud / sent_baud, 3.0))))


class EmulatedDevice(ABC):
    """What both devices have in common: a state machine that moves when it is asked about a moment.

    Moments are host CLOCK_MONOTONIC ns (or any other virtual time), and never go back.
    """

    def __init__(self, *, t0_ns: int, seed: int, baud: int) -> None:
        self._line = Line(baud, t0_ns)
        self._noise = random.Random(seed)  # noqa: S311 - noise, not secrets
        self._agenda: list[tuple[int, int, Callable[[int], None]]] = []
        self._order = itertools.count()
        self._ear_free_ns: float = t0_ns
        self._now_ns = t0_ns

    @property
    def baud(self) -> int:
        """The device's rate, bit/s."""
        return self._line.baud

    def receive(self, t_ns: int, data: bytes, host_baud: int) -> None:
        """Take bytes that the host began to send at ``t_ns`` at its own rate."""
        self._advance(t_ns)
        byte_ns = 1e9 * BITS_PER_BYTE / host_baud
        start = max(float(t_ns), self._ear_free_ns)
        for i, byte in enumerate(data):
            self._at(math.ceil(start + (i + 1) * byte_ns), self._hearer(byte, host_baud))
        self._ear_free_ns = start + len(data) * byte_ns

    def transmit(self, t_ns: int, host_baud: int) -> bytes:
        """Return what has left the device by ``t_ns`` since the last call, as the host hears it."""
        self._advance(t_ns)
        return b"".join(garble(data, baud, host_baud, self._noise) for baud, data in self._line.take())

    def next_ns(self) -> int | None:
        """When next there will be something to transmit or to do, or None."""
        moments = [moment for moment in (self._line.next_ns(), self._due_ns()) if moment is not None]
        if self._agenda:
            moments.append(self._agenda[0][0])
        return min(moments, default=None)

    def _at(self, t_ns: int, action: Callable[[int], None]) -> None:
        """Put something on the agenda; it is called with its moment."""
        heapq.heappush(self._agenda, (t_ns, next(self._order), action))

    def _hearer(self, byte: int, host_baud: int) -> Callable[[int], None]:
        def hear(t_ns: int) -> None:
            for heard in garble(bytes([byte]), host_baud, self.baud, self._noise):
                self._hear(t_ns, heard)

        return hear

    def _advance(self, t_ns: int) -> None:
        """Do everything that is due by ``t_ns``, in order."""
        self._now_ns = max(self._now_ns, t_ns)
        while True:
            due = self._due_ns()
            event = self._agenda[0][0] if self._agenda else None
            first = min((moment for moment in (due, event) if moment is not None), default=None)
            if first is None or first > self._now_ns:
                break
            self._line.run(first)
            if event is not None and event == first:
                heapq.heappop(self._agenda)[2](first)
            else:
                self._do_due(first)
        self._line.run(self._now_ns)

    @abstractmethod
    def _hear(self, t_ns: int, byte: int) -> None:
        """Take one byte whose last bit came in at ``t_ns``."""

    @abstractmethod
    def _due_ns(self) -> int | None:
        """When the next periodic output is to be made, or None."""

    @abstractmethod
    def _do_due(self, t_ns: int) -> None:
        """Make it; what `_due_ns` says must then be later."""
