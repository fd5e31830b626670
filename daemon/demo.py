"""Emulated devices, a real daemon, a real run: and what was found against what is true."""

from __future__ import annotations

import json
import math
import os
import socket
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from itertools import pairwise
from pathlib import Path
from typing import IO, Any

import yaml
from rich.console import Console
from rich.live import Live
from rich.table import Table

from polecal import PolecalError
from polecal.calib import KEYS, PARAMETERS, Mount
from polecal.daemon.control import Client
from polecal.daemon.routefile import geojson
from polecal.daemon.routine import ENDED, State
from polecal.daemon.screen import Screen
from polecal.daemon.sessions import CALIBRATION, CAPTURE

_MEASURED = Mount(0.0, -0.35, -1.0, 0.0, -8.0, 0.0)  # paper.md, Table IV
_POLE = {"radius_m": 0.04, "height_m": 2.4}
_DRIVE_S = 270.0  # then what there is is calibrated
_ROUTED_S = 600.0
_ROOM = {"turn_radius_m": 3.0, "area_m": 15.0}  # that the emulated vehicle needs, and has
_STOP_S = 3.0
_READY_S = 20.0
_LEAVE_S = 20.0
_LINE_EVERY_S = 5.0


class DemoError(PolecalError):
    """A part of the demonstration did not come up."""


def demo(out: Path, seed: int, console: Console, *, routed: bool = False) -> dict[str, Any]:
    """Run the demonstration into the folder ``out``, told on a console; give its calibration's content.

    If it is ``routed``, no drive is planned beforehand: the vehicle drives what ROUTE says, until it is done.
    Raises DemoError, and what the daemon refuses.
    """
    out = out.resolve()
    out.mkdir(parents=True, exist_ok=True)
    began_s = time.monotonic()
    with ExitStack() as stack:
        truth, steering = stack.enter_context(_emulated_devices(out, seed, routed=routed))
        config = _write_config(out, truth)
        socket_path = stack.enter_context(_daemon(out, config))
        console.print(f"emulated laser and receiver (seed {seed}), and a real daemon: {out}")
        with Client(socket_path, timeout_s=None) as client:
            session = client.request({"class": "START", "name": "demo"})["session"]
            minutes = "five" if routed else "three"
            console.print(f"session {session}: the vehicle drives past the pole, about {minutes} minutes")
            autopilot = Autopilot(client, steering, truth["pole"]) if steering is not None else None
            _follow(client, console, began_s + (_ROUTED_S if routed else _DRIVE_S), autopilot)
            if client.request({"class": "STATUS"})["state"] not in ENDED:
                client.request({"class": "STOP", "calibrate": True})
    folder = out / "state" / "sessions" / session
    content = yaml.safe_load((folder / CALIBRATION).read_text(encoding="utf-8"))
    laser = content["lasers"][0]
    console.print(_against_truth(laser, truth["mount"]))
    ratio = laser["measured_cost_m"] / laser["cost_m"]
    console.print(
        f"√c {laser['measured_cost_m']:.4f} m as measured by hand, {laser['cost_m']:.4f} m as found: "
        f"{ratio:.1f} times less; {laser['passes']} passes, {laser['returns']['pole']} pole returns"
    )
    console.print(
        f"[bold]{content['state']}[/bold] after {time.monotonic() - began_s:.0f} s", highlight=False
    )
    console.print(f"the same again from its capture: polecal-field replay {folder / CAPTURE}", soft_wrap=True)
    return dict(content)


@contextmanager
def _emulated_devices(
    out: Path, seed: int, *, routed: bool
) -> Iterator[tuple[dict[str, Any], IO[bytes] | None]]:
    """Serve the emulated devices; give their ports, the true mount, and what steers the vehicle."""
    piped: dict[str, Any] = {"stdin": subprocess.PIPE} if routed else {}
    links = ["--lms-link", out / "tty-lms", "--span-link", out / "tty-span"]
    options = [*links, "--seed", seed, *["--route"] * routed]
    with (
        (out / "emulate.log").open("wb") as log,
        _program("field", "emulate", *options, stdout=subprocess.PIPE, stderr=log, **piped) as program,
    ):
        assert program.stdout is not None
        line = program.stdout.readline()
        if not line:
            raise DemoError("the emulated devices did not start", f"see {out / 'emulate.log'}")
        truth: dict[str, Any] = json.loads(line)
        yield truth, program.stdin


@contextmanager
def _daemon(out: Path, config: Path) -> Iterator[Path]:
    """Run the daemon; give its socket once it says that it is ready, as it would to systemd."""
    address = out / "notify"
    address.unlink(missing_ok=True)
    with (
        socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as notify,
        (out / "polecald.log").open("wb") as log,
    ):
        notify.bind(str(address))
        notify.settimeout(_READY_S)
        environment = os.environ | {"NOTIFY_SOCKET": str(address)}
        with _program("service", "--config", config, stderr=log, env=environment):
            try:
                notify.recv(64)
            except TimeoutError:
                raise DemoError("the daemon did not come up", f"see {out / 'polecald.log'}") from None
            yield out / "run" / "control.sock"
    address.unlink(missing_ok=True)


@contextmanager
def _program(module: str, *arguments: object, **how: Any) -> Iterator[subprocess.Popen[bytes]]:
    command = [sys.executable, "-m", f"polecal.daemon.{module}", *map(str, arguments)]
    with subprocess.Popen(command, **how) as program:  # noqa: S603 - ourselves
        try:
            yield program
        finally:
            program.terminate()
            try:
                program.wait(_LEAVE_S)
            except subprocess.TimeoutExpired:
                program.kill()


def _write_config(out: Path, devices: Mapping[str, Any]) -> Path:
    path = out / "polecal.yaml"
    content = {
        "state_dir": str(out / "state"),
        "runtime_dir": str(out / "run"),
        "lasers": [{"name": "front", "port": devices["lms"], "mount": _MEASURED.as_dict()}],
        "navigation": {"port": devices["span"]},
        "pole": _POLE,
    }
    path.write_text(yaml.safe_dump(content, sort_keys=False), encoding="utf-8")
    return path


class Autopilot:
    """Asks for a route while a session collects, and gives it to the vehicle; again once it is driven.

    Also once the pole was seen, as until then the vehicle keeps far from where somebody said that it is.
    """

    def __init__(self, client: Client, steering: IO[bytes], pole: Sequence[float]) -> None:
        self._steering = steering
        self._path = client.path
        self._request = {"class": "ROUTE", "pole": list(pole)} | _ROOM
        self._known = ""
        self._until_s = 0.0

    def attend(self, status: Mapping[str, Any]) -> None:
        """Take a STATUS, and do what it asks for."""
        driven = time.monotonic() >= self._until_s
        seen = self._known == "given" and any(laser["passes"] for laser in status["lasers"])
        if status["state"] != State.COLLECTING or not (driven or seen):
            return
        with Client(self._path, timeout_s=None) as client:
            route = client.request(self._request)
        if not route["legs"]:
            return
        self._known = route["pole"]["known"]
        self._until_s = time.monotonic() + _driven_s(route)
        self._steering.write(geojson(route).encode())
        self._steering.flush()


def _driven_s(route: Mapping[str, Any]) -> float:
    """Give about how long a route takes, with the stops before and after what is driven in reverse."""
    total_s, way = _STOP_S, "forward"
    for leg in route["legs"]:
        length_m = sum(math.dist(one[:2], other[:2]) for one, other in pairwise(leg["points"]))
        total_s += length_m / leg["speed_mps"] + _STOP_S * (leg["direction"] != way)
        way = leg["direction"]
    return total_s


def _follow(client: Client, console: Console, until_s: float, autopilot: Autopilot | None = None) -> None:
    """Show the run until it ends: the status screen on a terminal, else a line now and then."""
    spoken_s = 0.0
    live = Live(console=console, auto_refresh=False, transient=True) if console.is_terminal else None
    with live or ExitStack():
        for status in client.watch():
            if autopilot is not None:
                autopilot.attend(status)
            if live is not None:
                live.update(Screen(status), refresh=True)
            elif time.monotonic() - spoken_s >= _LINE_EVERY_S:
                spoken_s = time.monotonic()
                console.print(_line(status), soft_wrap=True, highlight=False)
            if status["state"] in ENDED or time.monotonic() > until_s:
                return


def _line(status: Mapping[str, Any]) -> str:
    laser = status["lasers"][0]
    done = sum(part["done"] for part in laser["coverage"])
    cost = "" if laser["cost_m"] is None else f", cost {laser['cost_m']:.3f} m"
    return (
        f"{status['since_s']:6.1f} s {status['state']}: {laser['passes']} passes, "
        f"{done} of {len(laser['coverage'])} slices{cost}; {status['next']}"
    )


def _against_truth(laser: Mapping[str, Any], truth: Mapping[str, float]) -> Table:
    table = Table(title="found against true")
    for heading in ("", "by hand", "found", "true", "error", "σ", "error / σ", ""):
        table.add_column(heading, justify="right")
    for name, key in zip(PARAMETERS, KEYS, strict=True):
        found, sigma = laser["estimate"][key], laser["sigma"][key]
        error = found - truth[key]
        row = (laser["measured"][key], found, truth[key], error, sigma)
        unit = "m" if key.endswith("_m") else "°"
        table.add_row(
            f"{name} {unit}",
            *(f"{value:.4f}" for value in row),
            f"{error / sigma:+.1f}",
            "held" if name in laser["held"] else "",
        )
    return table
