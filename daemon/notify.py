"""How the daemon stands, as datagrams to the service manager that started it: sd_notify(3).

Where nobody listens nothing is sent, so that the daemon runs the same by hand.
"""

from __future__ import annotations

import contextlib
import os
import socket
import time
from collections.abc import Mapping
from typing import Any

import structlog

_SEND_S = 0.2  # a manager that takes nothing must not hold the daemon up


class Manager:
    """The service manager; ``watchdog_s`` is within what time it wants to hear from us, None if it does not.

    It is told that the daemon lives only while each of its threads does: a beat is CLOCK_MONOTONIC, s, at
    which a thread last showed that it is not stuck.
    """

    def __init__(self, environment: Mapping[str, str] = os.environ) -> None:
        """Find it by NOTIFY_SOCKET, WATCHDOG_USEC and WATCHDOG_PID."""
        address = environment.get("NOTIFY_SOCKET", "")
        self._address = "\0" + address[1:] if address.startswith("@") else address
        self.watchdog_s: float | None = None
        if environment.get("WATCHDOG_PID", str(os.getpid())) == str(os.getpid()):
            with contextlib.suppress(KeyError, ValueError):
                self.watchdog_s = int(environment["WATCHDOG_USEC"]) / 1e6
        self._said = ""
        self._stuck: list[str] = []
        self._log = structlog.get_logger()

    def ready(self) -> None:
        """Say that requests are answered."""
        self._send("READY=1")

    def reloading(self) -> None:
        """Say that the configuration is read again; `ready` ends it."""
        self._send(f"RELOADING=1\nMONOTONIC_USEC={time.monotonic_ns() // 1000}")

    def stopping(self) -> None:
        """Say that the end has begun."""
        self._send("STOPPING=1")

    def extend(self, seconds: float) -> None:
        """Ask for so much time from now on for what is being done, starting or stopping."""
        self._send(f"EXTEND_TIMEOUT_USEC={round(seconds * 1e6)}")

    def status(self, text: str) -> None:
        """Say in a line how it stands, if that is news."""
        text = " ".join(text.split())
        if text != self._said:
            self._said = text
            self._send(f"STATUS={text}")

    def alive(self, beats: Mapping[str, float]) -> None:
        """Feed the watchdog, unless a thread has not beaten for half of its time: say which, once."""
        if self.watchdog_s is None:
            return
        now_s = time.monotonic()
        stuck = [name for name, beat_s in beats.items() if now_s - beat_s > self.watchdog_s / 2]
        if stuck and stuck != self._stuck:
            self._log.error("stuck", threads=", ".join(stuck), hint="the watchdog will restart polecald")
        self._stuck = stuck
        if not stuck:
            self._send("WATCHDOG=1")

    def _send(self, state: str) -> None:
        if self._address:
            with contextlib.suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as sender:
                sender.settimeout(_SEND_S)
                sender.sendto(state.encode(), self._address)


def summary(status: Mapping[str, Any]) -> str:
    """Say in a line what a STATUS says: where the run is, what is missing, what to do next."""
    parts = []
    for laser in status["lasers"]:
        done = sum(part["done"] for part in laser["coverage"])
        name = f"{laser['name']} " if len(status["lasers"]) > 1 else ""
        passes = "1 pass" if laser["passes"] == 1 else f"{laser['passes']} passes"
        parts.append(f"{name}{passes}, {done} of {len(laser['coverage'])} slices")
    parts += [device["problem"] for device in status["devices"] if device.get("problem")]
    if status["next"]:
        parts.append(status["next"])
    return f"{status['state']}: {'; '.join(parts)}"
