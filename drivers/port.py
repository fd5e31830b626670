"""A serial line as stamped chunks of bytes; the one module that knows pyserial.

Every chunk, both ways, goes to the tap before anybody else sees it, so that what is recorded is what was
on the wire. A chunk is stamped right after ``os.read`` returns: ``select`` and ``os.read`` stamp within
0.1 ms, where a ``read(n)`` with a time-out stamps tens of milliseconds late. The thread that does it does
nothing else: whoever hears the chunks may take his time.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
import queue
import select
import termios
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, Self

import serial

from polecal.drivers.errors import (
    DeviceBusy,
    DeviceError,
    DeviceLost,
    DeviceNotFound,
    DeviceNotPermitted,
)
from polecal.drivers.urgent import urgently

Direction = Literal["rx", "tx"]
Tap = Callable[[Direction, int, bytes], None]
"""Takes (direction, CLOCK_MONOTONIC ns, bytes) of every chunk; of those that were read, in their order."""

_READ_BYTES = 4096  # more than one read ever finds: 17 kB a pty's whole buffer, 4 kB a tty's
_WAIT_S, _WAIT_MS = 0.2, 200  # how long a read goes without looking whether it should stop
_WRITE_S = 2.0  # a line that takes no bytes for so long is lost
_UNHEARD = 50_000  # chunks, minutes of them; those beyond it are recorded, and heard by nobody
_STUCK_S = 5 * _WAIT_S
BITS_PER_BYTE = 10  # 8N1


class Stopped(Exception):
    """Somebody asked the port's user to stop."""


@dataclass(frozen=True, slots=True)
class Chunk:
    """Bytes that one read returned, and when (CLOCK_MONOTONIC, ns)."""

    t_ns: int
    data: bytes


def _no_tap(direction: Direction, t_ns: int, data: bytes) -> None: ...


def _no_beat() -> None: ...


class Port:
    """One serial line, opened for this process alone, and read from then on.

    ``stop``, once set, makes the next ``read`` raise `Stopped`; clear it to say goodbye to the device.
    ``beat`` is called several times a second while somebody waits for chunks, also in a silence, unless the
    thread that reads them is stuck. ``looked_s`` is when that last had taken what there was.
    """

    def __init__(
        self,
        path: str,
        baud: int,
        tap: Tap = _no_tap,
        stop: threading.Event | None = None,
        beat: Callable[[], None] = _no_beat,
    ) -> None:
        self.path = path
        self.stop = stop or threading.Event()
        self._tap = tap
        self._beat = beat
        try:
            self._serial = serial.Serial(path, baud, timeout=0, write_timeout=0, exclusive=True)
        except (OSError, termios.error, ValueError) as error:
            raise _open_error(path, baud, error) from error
        self._fd = self._serial.fileno()
        if not os.path.realpath(path).startswith("/dev/pts/"):  # nobody could open a pty again
            with contextlib.suppress(OSError):
                fcntl.ioctl(self._fd, termios.TIOCEXCL)
        with contextlib.suppress(ValueError, OSError, NotImplementedError):  # only some UARTs can
            self._serial.set_low_latency_mode(True)
        self.looked_s = time.monotonic()
        self._unheard: queue.SimpleQueue[Chunk | Exception] = queue.SimpleQueue()
        self._taking = threading.Lock()
        self._closing, self._closed = os.eventfd(0), False
        self._reader = threading.Thread(target=urgently, args=(self._take,), name=path, daemon=True)
        self._reader.start()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def baud(self) -> int:
        """The line's rate, bit/s."""
        return int(self._serial.baudrate)

    def set_baud(self, baud: int) -> None:
        """Change the host's rate, once what was written is on the wire; what was received is dropped.

        Raises DeviceLost, and DeviceError where the adapter cannot do the rate.
        """
        try:
            termios.tcdrain(self._fd)
            self._serial.baudrate = baud
            with self._taking:
                termios.tcflush(self._fd, termios.TCIFLUSH)
                self._waiting()
        except ValueError as error:
            raise DeviceError(
                f"{self.path}: this adapter cannot do {baud} bit/s: {error}",
                "use an adapter that can (for 500000 bit/s an FTDI one), or set another baud",
            ) from error
        except (OSError, termios.error) as error:
            raise self._lost(error) from error

    def read(self, timeout_s: float) -> Chunk | None:
        """Return the next bytes, as soon as there are any, or None after ``timeout_s``.

        Raises Stopped, DeviceLost.
        """
        deadline_s = time.monotonic() + timeout_s
        while True:
            self._look_up()
            left_s = max(0.0, deadline_s - time.monotonic())
            with contextlib.suppress(queue.Empty):
                return self._whole(self._unheard.get(timeout=min(left_s, _WAIT_S)))
            if left_s <= _WAIT_S:
                return None

    def gather(self, seconds: float) -> list[Chunk]:
        """Let so much time pass, and return all that came: many chunks at once are cheaper to hear.

        Raises Stopped, DeviceLost.
        """
        self.stop.wait(seconds)
        self._look_up()
        return self._waiting()

    def _look_up(self) -> None:
        if time.monotonic() - self.looked_s < _STUCK_S:
            self._beat()
        if self.stop.is_set():
            raise Stopped

    def _whole(self, item: Chunk | Exception) -> Chunk:
        if isinstance(item, Exception):
            self._unheard.put(item)  # for who asks again
            raise self._lost(item) from item
        return item

    def _waiting(self) -> list[Chunk]:
        """Take all that nobody has heard. Raises DeviceLost."""
        return [self._whole(self._unheard.get()) for _ in range(self._unheard.qsize())]

    def _take(self) -> None:
        """Read, stamp and record until the port is closed or lost."""
        waiting = select.poll()
        for fd in (self._fd, self._closing):
            waiting.register(fd, select.POLLIN)
        empty = False
        try:
            while not self._closed:
                ready = waiting.poll(_WAIT_MS)
                with self._taking:
                    data = b""
                    if ready:
                        with contextlib.suppress(BlockingIOError):
                            data = os.read(self._fd, _READ_BYTES)
                    t_ns = time.monotonic_ns()
                    if data:
                        self._tap("rx", t_ns, data)
                        if self._unheard.qsize() < _UNHEARD:
                            self._unheard.put(Chunk(t_ns, data))
                    elif ready and empty and not self._closed:  # readable, and again nothing there: hung up
                        raise OSError(errno.EIO, os.strerror(errno.EIO))
                empty = bool(ready) and not data  # once, somebody else may have read it
                self.looked_s = t_ns * 1e-9
        except (OSError, ValueError, termios.error) as error:
            self._unheard.put(error)

    def write(self, data: bytes) -> None:
        """Send bytes. Raises DeviceLost."""
        self._tap("tx", time.monotonic_ns(), data)
        left = memoryview(data)
        while left:
            try:
                _, ready, _ = select.select([], [self._fd], [], _WRITE_S)
                if not ready:
                    raise OSError(errno.ETIMEDOUT, "the line takes no bytes")
                left = left[os.write(self._fd, left) :]
            except BlockingIOError:
                continue
            except (OSError, ValueError, termios.error) as error:
                raise self._lost(error) from error

    def close(self) -> None:
        """Give the line back; what was read and not heard stays where it was recorded."""
        if self._closed:
            return
        self._closed = True
        os.eventfd_write(self._closing, 1)
        self._reader.join()
        os.close(self._closing)
        with contextlib.suppress(OSError, termios.error):
            self._serial.close()

    def _lost(self, error: Exception) -> DeviceLost:
        return DeviceLost(
            f"{self.path}: the port stopped working: {error}",
            "check the cable and the adapter; polecal goes on by itself once the port is back",
        )


def _open_error(path: str, baud: int, error: Exception) -> DeviceError:
    number = getattr(error, "errno", None)
    if isinstance(error, ValueError):
        return DeviceError(f"{path}: {baud} bit/s is not a rate it can do: {error}", "set another baud")
    if number in (errno.ENOENT, errno.ENXIO, errno.ENODEV):
        return DeviceNotFound(
            f"{path}: there is no such port", "plug the adapter in, or correct the port in the configuration"
        )
    if number in (errno.EACCES, errno.EPERM):
        return DeviceNotPermitted(
            f"{path}: this user may not open it",
            "add the user to the group that `ls -l` shows for it (dialout on Debian), then log in again",
        )
    if number in (errno.EBUSY, errno.EAGAIN):
        return DeviceBusy(
            f"{path}: another program holds it", f"find it by `fuser -v {path}` and stop it, then start again"
        )
    return DeviceNotFound(f"{path}: not a usable serial port: {error}", "correct it in the configuration")
