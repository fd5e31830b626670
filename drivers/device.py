"""A device's life on its port: open, set up, stream, leave politely; again after every loss."""

from __future__ import annotations

import contextlib
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Literal

import structlog

from polecal.drivers.errors import DeviceError, DeviceProtocolError
from polecal.drivers.port import Chunk, Port, Stopped, Tap

State = Literal["closed", "connecting", "streaming", "lost"]
OpenPort = Callable[[str, int, Tap, threading.Event], Port]

_RETRY_S = 1.0
_TOGETHER_S = 0.1  # of a stream: each chunk by itself takes ten times as long to hear as many at once


class Device(ABC):
    """What every device's conversation has in common; a template for `run`, which one thread calls.

    Other threads may read ``state``, ``problem``, ``identity``, ``reconnects`` and ``beat_s`` at any time:
    each is replaced as a whole.
    """

    kind: str
    silence_s = 2.0
    """A stream without a whole frame for so long has ended: the device is set up again."""

    def __init__(self, name: str, path: str, baud: int, tap: Tap) -> None:
        self.name = name
        self.path = path
        self.baud = baud
        self.state: State = "closed"
        self.problem: DeviceError | None = None
        self.identity = ""
        self.reconnects = 0
        self.beat_s = time.monotonic()
        """When its thread last showed that it is not stuck, be the device there or not."""
        self._tap = tap
        self._log = structlog.get_logger().bind(device=name, port=path)

    def open(self, stop: threading.Event) -> Port:
        """Open the port. Raises DeviceError."""
        return Port(self.path, self.baud, self._tap, stop, self._beat)

    def _beat(self) -> None:
        self.beat_s = time.monotonic()

    def run(self, port: Port) -> None:
        """Keep the device streaming until the port's ``stop`` is set, then leave it polite.

        Takes an open port and closes it. Raises nothing: what goes wrong is in ``problem`` and the log,
        and is tried again each second.
        """
        stop = port.stop
        while True:
            try:
                with port:
                    self._live(port)
            except Stopped:
                break
            except DeviceError as error:
                self._trouble(error)
            while not stop.wait(_RETRY_S):
                self._beat()
                try:
                    port = self.open(stop)
                    break
                except DeviceError as error:
                    self._trouble(error)
            if stop.is_set():
                with contextlib.suppress(DeviceError):
                    port.close()
                break
            self.reconnects += 1
        self.state = "closed"

    def _live(self, port: Port) -> None:
        """One connection, from set-up to its end. Raises Stopped, DeviceError."""
        stop = port.stop
        try:
            self.state = "connecting"
            self._set_up(port)
            self.state, self.problem = "streaming", None
            self._log.info("streaming", identity=self.identity, baud=port.baud)
            heard_s = looked_s = time.monotonic()
            while looked_s - heard_s < self.silence_s:
                looked_s = port.looked_s  # what had come by then is among what is gathered now
                if any([self._heard(chunk) for chunk in port.gather(_TOGETHER_S)]):
                    heard_s = time.monotonic()
            raise DeviceProtocolError(
                f"{self.name} on {port.path}: no whole frame for {self.silence_s:.0f} s",
                "check its power and cable; it is being set up again",
            )
        except Stopped:
            stop.clear()
            with contextlib.suppress(DeviceError):
                self._leave(port)
            stop.set()
            raise

    def _trouble(self, error: DeviceError) -> None:
        if self.problem is None or str(self.problem) != str(error):  # each trouble once, not each second
            self._log.warning("device trouble", problem=str(error), hint=error.hint)
        self.state, self.problem = "lost", error

    def about(self) -> dict[str, object]:
        """Give what the device last said of itself, beyond its stream, as JSON-able values."""
        return {}

    @abstractmethod
    def _set_up(self, port: Port) -> None:
        """Find the device, configure it and start its stream. Raises Stopped, DeviceError."""

    @abstractmethod
    def _heard(self, chunk: Chunk) -> bool:
        """Take bytes of the stream; say whether a whole frame ended in them."""

    @abstractmethod
    def _leave(self, port: Port) -> None:
        """Stop the stream and leave the device as a stranger would want to find it. Raises DeviceError."""
