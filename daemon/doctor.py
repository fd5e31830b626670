"""A configuration to what is wrong in the field: ports, devices, disk, clock, each with what to do.

Nothing is changed: devices are asked only what they answer in any state, and ports that a running session
holds are not touched: its daemon is asked instead.
"""

from __future__ import annotations

import os
import shutil
import stat
import textwrap
import threading
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.text import Text

from polecal import PolecalError
from polecal.daemon.config import SPAN, Config, Laser
from polecal.daemon.control import Client, Code, NoDaemon, Refused, code_of
from polecal.daemon.findings import Check, fault, of_laser, of_receiver, of_status, ok, unknown, warn
from polecal.daemon.ports import System, who_may
from polecal.drivers.errors import DeviceBusy, DeviceError, DeviceNotPermitted
from polecal.drivers.novatel_span import probe as span
from polecal.drivers.novatel_span.device import RATES as SPAN_RATES
from polecal.drivers.port import Port, Stopped
from polecal.drivers.sick_lms import probe as lms

_WITHIN_S = 25.0
_ASK_S = 2.0
_LMS_RATES = (500000, 9600, 38400, 19200)
_LATENCY_MS = 2  # more makes stamps late by as much
_RECORDED_BYTES_S = 80_000  # a laser's stream at 500 kbaud, its share of poses, and the capture's frame
_LEAST_S = 3600.0
_PROBE_BAUD = 9600  # of the port until the device's rate is tried
_EXIT_ORDER = (Code.NOT_PERMITTED, Code.BUSY, Code.DEVICE, Code.DEGRADED)

_DO = " " * 25 + "-> "
_STYLES = {"ok": "green", "warn": "bold yellow", "fault": "bold red", "unknown": "dim"}

_GRABBERS = {
    "ModemManager": "it takes serial ports for modems: `sudo systemctl disable --now ModemManager`, or "
    'the udev rule ENV{ID_MM_DEVICE_IGNORE}="1" of systemd/70-polecal.rules',
    "brltty": "it takes USB adapters for Braille displays: "
    "`sudo systemctl mask --now brltty-udev.service brltty.service`",
    "polecald": "a daemon's session has it: `polecal-field --socket PATH doctor` asks that daemon",
}


def examine(
    config: Config | None, socket: Path, *, system: System | None = None, within_s: float = _WITHIN_S
) -> list[Check]:
    """Give every check, within about ``within_s``; without a configuration, what the daemon knows.

    Raises Refused, where there is neither.
    """
    daemon, status = _ask(socket)
    if status is not None and any(device.get("state") != "closed" for device in status.get("devices") or []):
        checks = [daemon, *of_status(status)]
        return [*checks, _disk(config)] if config else checks
    if config is None:
        if status is None:
            raise Refused(
                f"there is no configuration to go by, and no daemon on {socket}",
                "name one: `polecal-field doctor --config FILE`, or start the daemon",
                Code.NO_DAEMON,
            )
        devices = status.get("devices") or []
        return [
            daemon,
            *(
                unknown(
                    f"{device.get('name')} port",
                    f"{device.get('port')}: no session, so the daemon has it closed",
                    "name the configuration: `polecal-field doctor --config FILE`",
                )
                for device in devices
            ),
        ]
    return [daemon, _disk(config), *_ports(config, system or System(), within_s)]


def exit_code(checks: Iterable[Check]) -> int:
    """Give the exit code that most needs somebody: no permission, busy, device fault, degraded, 0."""
    codes = {check.code for check in checks}
    return next((int(code) for code in _EXIT_ORDER if code in codes), 0)


def as_message(checks: Iterable[Check]) -> dict[str, Any]:
    """Give the JSON object of a report."""
    return {"class": "DOCTOR", "checks": [check.as_dict() for check in checks]}


def in_words(checks: Iterable[Check], width: int | None = None) -> Text:
    """Write a line a check, and under what is not well what to do; wrapped where a width is given."""
    text = Text()
    for check in checks:
        lead = f"{check.state:<8}{check.name:<16} "
        for said, style in ((lead + check.what, _STYLES[check.state]), (_DO + check.hint, "")):
            if said == _DO:
                continue
            indent = " " * (len(lead) if said.startswith(lead) else len(_DO))
            lines = textwrap.wrap(said, max(40, width), subsequent_indent=indent) if width else [said]
            for number, line in enumerate(lines):
                text.append(line[:8], style if not number else "").append(line[8:] + "\n")
    text.rstrip()
    return text


def _ask(socket: Path) -> tuple[Check, dict[str, Any] | None]:
    name = "daemon"
    try:
        with Client(socket, _ASK_S) as client:
            status = client.request({"class": "STATUS"})
    except NoDaemon:
        return ok(name, f"none runs on {socket}"), None
    except PolecalError as error:
        return fault(name, str(error), error.hint, code_of(error)), None
    session = status.get("session")
    told = f"session {session} is {status.get('state')}" if session else "runs, no session"
    if status.get("state") == "fault":
        return fault(name, told, "see `polecal-field status`", Code.DEGRADED), status
    return ok(name, told), status


def _disk(config: Config) -> Check:
    name, folder = "disk", config.state_dir
    while not os.path.exists(folder) and folder != folder.parent:  # or this user may not see it
        folder = folder.parent
    room = shutil.disk_usage(folder).free - config.storage.min_free_mb * 1_000_000
    left_s = room / (_RECORDED_BYTES_S * len(config.lasers))
    told = f"{folder}: {max(0, room) / 1e6:.0f} MB to record on"
    if os.statvfs(folder).f_flag & os.ST_RDONLY:
        hint = "mount it for writing (`mount -o remount,rw`); see `dmesg` for why it is not"
        return fault(name, f"{folder}: is read-only", hint, Code.DEGRADED)
    if room <= 0:
        return fault(
            name,
            f"{told}: less is free than the {config.storage.min_free_mb} MB that must stay so",
            "delete old sessions, or lower storage.min_free_mb: nothing would be recorded",
            Code.DEGRADED,
        )
    if left_s < _LEAST_S:
        return warn(name, f"{told}, {left_s / 60:.0f} minutes", "delete old sessions that are not needed")
    return ok(name, f"{told}, {left_s / 3600:.0f} hours")


@dataclass(frozen=True, slots=True)
class _Place:
    """A port to look at: whose it is, and how its device is looked for."""

    name: str
    path: str
    examine: Callable[[Port], list[Check]]


def _ports(config: Config, system: System, within_s: float) -> list[Check]:
    """Look at all ports at once, each in its own thread, until they are done or the time is over."""
    places = [_laser_place(laser) for laser in config.lasers]
    places.append(_Place(SPAN, config.navigation.port, lambda port: _receiver(config, port)))
    stop = threading.Event()
    clock = threading.Timer(within_s, stop.set)
    clock.start()
    try:
        with ThreadPoolExecutor(len(places)) as pool:
            looked = pool.map(lambda place: _port(place, system, stop), places)
            return [check for checks in looked for check in checks]
    finally:
        clock.cancel()


def _laser_place(laser: Laser) -> _Place:
    def look(port: Port) -> list[Check]:
        found = lms.probe(port, dict.fromkeys((laser.baud, *_LMS_RATES)))
        other = not found.baud and not found.frames_heard
        instead = span.probe(port, SPAN_RATES, rounds=1) if other else None
        return of_laser(laser, found, instead)

    return _Place(laser.name, laser.port, look)


def _receiver(config: Config, port: Port) -> list[Check]:
    found = span.probe(port, dict.fromkeys((config.navigation.baud, *SPAN_RATES)))
    instead = None if found.baud or found.checked else lms.probe(port, _LMS_RATES, rounds=1)
    return of_receiver(config.navigation, found, instead)


def _port(place: _Place, system: System, stop: threading.Event) -> list[Check]:
    name = f"{place.name} port"
    if (trouble := _taken(name, place.path, system)) is not None:
        return [trouble]
    try:
        with Port(place.path, _PROBE_BAUD, stop=stop) as port:
            checks = [ok(name, f"{place.path} opens, and nobody else has it"), *_latency(place, system)]
            return checks + place.examine(port)
    except Stopped:
        return [fault(name, f"{place.path}: no end of it within the time", "try again; see the cable")]
    except DeviceNotPermitted as error:
        return [fault(name, str(error), who_may(place.path), Code.NOT_PERMITTED)]
    except DeviceBusy as error:
        hint = f"`sudo fuser -v {place.path}` names it"
        for program, remedy in _GRABBERS.items():
            if system.running(program):
                hint += f"; {program} runs, and may be it: {remedy}"
        return [fault(name, str(error), hint, Code.BUSY)]
    except DeviceError as error:
        return [fault(name, str(error), error.hint, code_of(error))]


def _taken(name: str, path: str, system: System) -> Check | None:
    """Say why a port cannot even be opened, or should not be."""
    if not os.path.exists(path):
        there = system.adapters()
        hint = f"there are: {', '.join(there)}" if there else "no USB serial adapter is plugged in"
        if system.running("brltty"):
            hint += f"; brltty runs, and may have taken it: {_GRABBERS['brltty']}"
        return fault(name, f"{path}: there is no such port", hint)
    if not stat.S_ISCHR(os.stat(path).st_mode):
        return fault(name, f"{path}: is no serial port", "correct it in the configuration")
    holders = system.holders(path)
    if holders:
        told = ", ".join(f"{holder.name} (pid {holder.pid})" for holder in holders)
        hint = _GRABBERS.get(holders[0].name, f"stop it (`kill {holders[0].pid}`), then try again")
        return fault(name, f"{path}: held by {told}", hint, Code.BUSY)
    return None


def _latency(place: _Place, system: System) -> list[Check]:
    name, latency_ms = f"{place.name} latency", system.latency_ms(place.path)
    if latency_ms is None:
        return []
    if latency_ms <= _LATENCY_MS:
        return [ok(name, f"{latency_ms} ms")]
    device = Path(os.path.realpath(place.path)).name
    return [
        warn(
            name,
            f"the USB adapter gathers bytes for {latency_ms} ms: stamps come as late",
            f"`echo 1 | sudo tee /sys/bus/usb-serial/devices/{device}/latency_timer`, "
            "and for good systemd/70-polecal.rules",
        )
    ]
