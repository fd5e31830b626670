"""Emulated devices, a real daemon, a real run: and what was found against what is true."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import yaml
from rich.console import Console
from rich.live import Live
from rich.table import Table

from polecal.calib import KEYS, Mount
from polecal.daemon import screen
from polecal.daemon.control import Client, Refused
from polecal.daemon.routine import ENDED, State
from polecal.drivers.emulated.world import demo_world

_MEASURED = Mount(0.0, -0.35, -1.0, 0.0, -8.0, 0.0)
_SECONDS = 285.0
_END_S = 15.0


def demo(out: Path, seed: int) -> int:
    """Run the demonstration into the folder ``out``; give the exit code, 0 if it ended accepted."""
    out = out.resolve()
    out.mkdir(parents=True, exist_ok=True)
    console = Console()
    links = {name: out / f"tty-{name}" for name in ("lms", "span")}
    config = {
        "state_dir": str(out / "state"),
        "runtime_dir": str(out / "run"),
        "lasers": [{"name": "front", "port": str(links["lms"]), "mount": _MEASURED.as_dict()}],
        "navigation": {"port": str(links["span"])},
        "pole": {"radius_m": 0.04, "height_m": 2.4},
    }
    path = out / "polecal.yaml"
    path.write_text(yaml.safe_dump(config, sort_keys=False), encoding="utf-8")
    console.print(f"emulated laser and receiver, a real daemon on {path}, seed {seed}")
    emulate = ["emulate", "--lms-link", links["lms"], "--span-link", links["span"], "--seed", seed]
    with ExitStack() as running:
        running.enter_context(
            _program("polecal.daemon.field", *emulate, "--seconds", _SECONDS, log=out / "emulated.log")
        )
        running.enter_context(_program("polecal.daemon.service", "--config", path, log=out / "polecald.log"))
        client = _connect(out / "run" / "control.sock")
        running.enter_context(client)
        started = client.request({"class": "START", "name": "demo"})
        console.print(f"session {started['session']}")
        state = _follow(client, console)
        if state not in (State.ACCEPTED, State.REJECTED):
            client.request({"class": "STOP", "calibrate": True})
            state = client.request({"class": "STATUS"})["state"]
    folder = out / "state" / "sessions" / started["session"]
    laser = yaml.safe_load((folder / "calibration.yaml").read_text(encoding="utf-8"))["lasers"][0]
    _print_against_truth(console, laser, demo_world(seed).mount)
    console.print(f"{state}: {folder}")
    console.print(f"again from the capture: polecal-field replay {folder / 'capture.mcap'}")
    return 0 if state == State.ACCEPTED else 5
