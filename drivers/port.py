"""A serial line as stamped chunks of bytes; the one module that knows pyserial.

Every chunk, both ways, goes to the tap before anybody else sees it, so that what is recorded is what was
on the wire. A chunk is stamped right after ``os.read`` returns: ``select`` and ``os.read`` stamp within
0.1 ms, where a ``read(n)`` with a time-out stamps tens of milliseconds late.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
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

Direction = Literal["rx", "tx"]
Tap = Callable[[Direction, int, bytes], None]
"""Takes (direction, CLOCK_MONOTONIC ns, bytes) of every chunk; called from the thread that uses the port."""

_READ_BYTES = 4096  # more than one read ever finds: 17 kB a pty's whole buffer, 4 kB a tty's
_WAIT_S = 0.2  # how long a read goes without looking whether it should stop
_WRITE_S = 2.0  # a line that takes no bytes for so long is lost
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
    """One serial line, opened for this process alone.

    ``stop``, once set, makes the next ``read`` raise `Stopped`; clear it to say goodbye to the device.
    ``beat`` is called several times a second while somebody reads, also in a silence.
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
            termios.tcflush(self._fd, termios.TCIFLUSH)
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
        empty = False
        while True:
            self._beat()
            if self.stop.is_set():
                raise Stopped
            left_s = max(0.0, deadline_s - time.monotonic())
            try:
                ready, _, _ = select.select([self._fd], [], [], min(left_s, _WAIT_S))
                data = os.read(self._fd, _READ_BYTES) if ready else b""
            except BlockingIOError:
                continue
            except (OSError, ValueError, termios.error) as error:
                raise self._lost(error) from error
            t_ns = time.monotonic_ns()
            if data:
                self._tap("rx", t_ns, data)
                return Chunk(t_ns, data)
            if ready and not empty:  # somebody else may have read it
                empty = True
                continue
            if ready:  # readable again, and again nothing there: hung up
                raise self._lost(OSError(errno.EIO, os.strerror(errno.EIO)))
            if left_s <= _WAIT_S:
                return None

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
        """Give the line back."""
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
