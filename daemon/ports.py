"""A serial port's path to what the system tells of it: who holds it, who may use it, its adapter's timer."""

from __future__ import annotations

import grp
import os
import pwd
import stat
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

_MASTERS = ("/dev/ptmx", "/dev/pts/ptmx")
_BY_ID = "dev/serial/by-id"


@dataclass(frozen=True, slots=True)
class Holder:
    """A process that has the port open."""

    pid: int
    name: str


@dataclass(frozen=True, slots=True)
class System:
    """The running system; ``root`` is where its /sys and /dev/serial are looked for."""

    root: Path = Path("/")

    def holders(self, path: str) -> list[Holder]:
        """Give the other processes that have the port open, as far as this user may see them.

        Who serves a pseudo-terminal from its other end is none of them.
        """
        target = os.path.realpath(path)
        number = target.removeprefix("/dev/pts/") if target.startswith("/dev/pts/") else None
        found = []
        for pid in self._processes():
            if pid == os.getpid():
                continue
            links = dict(_links(Path(f"/proc/{pid}/fd")))
            if target in links.values() and not (number and _serves(pid, links, number)):
                found.append(Holder(pid, self._name(pid)))
        return found

    def running(self, name: str) -> bool:
        """Say whether a program of this name runs."""
        return any(self._name(pid) == name for pid in self._processes())

    def latency_ms(self, path: str) -> int | None:
        """Give a USB adapter's latency timer that is in force; None where the port has none."""
        device = Path(os.path.realpath(path)).name
        try:
            text = (self.root / "sys/bus/usb-serial/devices" / device / "latency_timer").read_text()
            return int(text)
        except (OSError, ValueError):
            return None

    def adapters(self) -> list[str]:
        """Name the USB serial adapters that are plugged in."""
        with suppress(OSError):
            return [f"/{_BY_ID}/{name}" for name in sorted(os.listdir(self.root / _BY_ID))]
        return []

    def _processes(self) -> Iterator[int]:
        return (int(name) for name in os.listdir("/proc") if name.isdecimal())

    def _name(self, pid: int) -> str:
        with suppress(OSError):
            return Path(f"/proc/{pid}/comm").read_text().strip()
        return "?"


def _links(folder: Path) -> Iterator[tuple[str, str]]:
    with suppress(OSError):  # it has ended, or is another user's
        for name in os.listdir(folder):
            with suppress(OSError):
                yield name, os.readlink(folder / name)


def _serves(pid: int, links: dict[str, str], number: str) -> bool:
    """Say whether a process holds the master of pseudo-terminal ``number``."""
    for name, target in links.items():
        if target in _MASTERS:
            with suppress(OSError):
                told = Path(f"/proc/{pid}/fdinfo/{name}").read_text().split()
                if "tty-index:" in told and told[told.index("tty-index:") + 1] == number:
                    return True
    return False


def who_may(path: str) -> str:
    """Say who may use a port, and what this user lacks to; for one that it may not open."""
    about = os.stat(path)
    try:
        group = grp.getgrgid(about.st_gid)
    except KeyError:
        return f"its group {about.st_gid} has no name: see its udev rule"
    try:
        user = pwd.getpwuid(os.geteuid()).pw_name
    except KeyError:
        user = str(os.geteuid())
    if not about.st_mode & stat.S_IWGRP:
        return f"only its owner may (mode {stat.S_IMODE(about.st_mode):o}): see its udev rule"
    if user in group.gr_mem and group.gr_gid not in os.getgroups():
        return f"{user} is in group {group.gr_name}, but not in this login: log out and in again"
    return f"`sudo usermod -aG {group.gr_name} {user}`, then log out and in again"
