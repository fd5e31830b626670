"""Emulated devices in real time on pseudo-terminals: what any client can open, at links that stay put."""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import select
import signal
import struct
import sys
import termios
import threading
import time
import tty
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path

import numpy as np

from polecal.drivers.emulated.line import EmulatedDevice
from polecal.drivers.emulated.steer import Steered, lines
from polecal.drivers.emulated.virtual import Rig
from polecal.drivers.emulated.world import World

_READ_BYTES = 4096
_IDLE_S = 0.05
_ROUGHLY_M = 0.4  # off is what an operator knows of the pole's place, in each direction
_TCGETS2 = 0x802C542A  # asm-generic: reads struct termios2
_TERMIOS2 = struct.Struct("<4IB19s2I")
_BAUD_OF_SPEED = {
    getattr(termios, name): int(name[1:]) for name in dir(termios) if name[0] == "B" and name[1:].isdigit()
}


class _Pty:
    """A pseudo-terminal: the device holds the master, and a link names the slave."""

    def __init__(self, link: str | None) -> None:
        self.master, self._slave = os.openpty()
        tty.setraw(self._slave)  # else the line discipline echoes and edits
        os.set_blocking(self.master, False)
        self._target = os.ttyname(self._slave)  # the slave stays open, else the master reads EIO
        self._link = None if link is None else Path(link)
        if self._link is not None:
            if self._link.is_symlink():
                self._link.unlink()
            try:
                self._link.symlink_to(self._target)
            except OSError:
                self._link = None
                self.close()
                raise
        self.path = self._target if link is None else link

    @property
    def host_baud(self) -> int:
        """The rate to which the host has set its end, bit/s."""
        speed = termios.tcgetattr(self.master)[5]
        if speed in _BAUD_OF_SPEED:
            return _BAUD_OF_SPEED[speed]
        answer = fcntl.ioctl(self.master, _TCGETS2, bytes(_TERMIOS2.size))
        return int(_TERMIOS2.unpack(answer)[-1])

    def read(self) -> bytes:
        """Return what the host has written, if anything."""
        with contextlib.suppress(BlockingIOError):
            return os.read(self.master, _READ_BYTES)
        return b""

    def write(self, data: bytes) -> None:
        """Hand bytes to the host; those that it has no room for are lost, as on a UART."""
        with contextlib.suppress(BlockingIOError):
            os.write(self.master, data)

    def close(self) -> None:
        """Hang up and remove the link, unless somebody has put another there."""
        if self._link is not None:
            with contextlib.suppress(OSError):
                if os.readlink(self._link) == self._target:
                    self._link.unlink()
        os.close(self.master)
        os.close(self._slave)


def serve(
    devices: Mapping[str, EmulatedDevice] | Sequence[tuple[str | None, EmulatedDevice]],
    seconds: float | None = None,
    *,
    stop: threading.Event | None = None,
    ready: Callable[[list[str]], None] | None = None,
    usb_latency_s: float = 0.002,
) -> None:
    """Serve devices at their link paths until the seconds are over or ``stop`` is set.

    ``ready`` is called once with the paths, in the order of the devices; a device without a link is at its
    pseudo-terminal's own path. Bytes reach the host in batches of ``usb_latency_s``. Raises OSError where
    a link cannot be made. Devices must have been made for CLOCK_MONOTONIC ns.
    """
    stop = stop or threading.Event()
    end_s = time.monotonic() + seconds if seconds is not None else float("inf")
    with contextlib.ExitStack() as stack:
        ends: list[tuple[_Pty, EmulatedDevice]] = []
        for link, device in devices.items() if isinstance(devices, Mapping) else devices:
            pty = _Pty(link)
            stack.callback(pty.close)
            ends.append((pty, device))
        if ready is not None:
            ready([pty.path for pty, _ in ends])
        masters = [pty.master for pty, _ in ends]
        flush_ns = 0
        while not stop.is_set() and (left_s := end_s - time.monotonic()) > 0:
            now_ns = time.monotonic_ns()
            wake_ns = min((device.next_ns() or now_ns + 10**9 for _, device in ends), default=now_ns)
            wait_s = (max(wake_ns, flush_ns) - now_ns) * 1e-9
            readable, _, _ = select.select(masters, [], [], min(max(wait_s, 0.0), _IDLE_S, left_s))
            now_ns = time.monotonic_ns()
            for pty, device in ends:
                baud = pty.host_baud
                if pty.master in readable and (heard := pty.read()):
                    device.receive(now_ns, heard, baud)
                if now_ns >= flush_ns and (said := device.transmit(now_ns, baud)):
                    pty.write(said)
            if now_ns >= flush_ns:
                flush_ns = now_ns + round(usb_latency_s * 1e9)


def _steer(world: World, orders: Iterable[str]) -> None:
    vehicle = world.trajectory
    if not isinstance(vehicle, Steered):
        return
    for order in orders:
        vehicle.follow(lines(order, world.local))


def run_emulate(
    lms_link: str | None,
    span_link: str | None,
    seed: int,
    seconds: float | None,
    orders: Iterable[str] | None = None,
) -> int:
    """Serve the demonstration's laser and receiver, the ``emulate`` verb; return its exit code.

    Once both are there, prints one line: a JSON object with their paths and the laser's true mount, and
    roughly the pole's place. Ends after so many seconds, or on SIGTERM or SIGINT. With ``orders`` the
    vehicle stands until it is given a route: each line is one, as GeoJSON, and replaces the last.
    """
    stop = threading.Event()
    t0_ns = time.monotonic_ns()
    rig = Rig.demo(seed, t0_ns) if orders is None else Rig.steered(seed, t0_ns)
    if orders is not None:
        threading.Thread(target=_steer, args=(rig.world, orders), name="orders", daemon=True).start()
    north, east = rig.world.pole_ne_m
    place = rig.world.geodetic(np.array([[north + _ROUGHLY_M, east - _ROUGHLY_M, 0.0]]))
    pole = [round(float(degrees[0]), 7) for degrees in place[:2]]

    def ready(paths: list[str]) -> None:
        lms, span = paths
        mount = asdict(rig.world.mount)
        sys.stdout.write(
            json.dumps(
                {"class": "EMULATE", "lms": lms, "span": span, "seed": seed, "mount": mount, "pole": pole}
            )
        )
        sys.stdout.write("\n")
        sys.stdout.flush()

    signals = (signal.SIGTERM, signal.SIGINT)
    before = [(number, signal.signal(number, lambda *_: stop.set())) for number in signals]
    try:
        serve([(lms_link, rig.laser), (span_link, rig.receiver)], seconds, stop=stop, ready=ready)
    finally:
        for number, handler in before:
            signal.signal(number, handler)
    return 0
