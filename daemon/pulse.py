"""Stamps of whatever comes again and again, to how often it comes."""

from __future__ import annotations

from collections import deque

_OVER = 50  # stamps


class Pulse:
    """How often something comes."""

    def __init__(self) -> None:
        self.count = 0
        self._times_ns: deque[int] = deque(maxlen=_OVER)

    def beat(self, t_ns: int) -> None:
        """Take the stamp of one more."""
        self.count += 1
        self._times_ns.append(t_ns)

    @property
    def rate_hz(self) -> float:
        """Its rate over the last of them; 0 before there are two."""
        if len(self._times_ns) < 2 or self._times_ns[-1] == self._times_ns[0]:
            return 0.0
        return (len(self._times_ns) - 1) * 1e9 / (self._times_ns[-1] - self._times_ns[0])
