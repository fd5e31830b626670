"""A real daemon, driven past a pole from side to side, whose devices, lines and host can be made to fail."""

from __future__ import annotations

import random
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import astuple, dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pymap3d
import pytest
import yaml

from polecal.calib import Kind, Mount, Returns, points_nav
from polecal.calib.estimate import split
from polecal.daemon import recorder
from polecal.daemon.config import SPAN
from polecal.daemon.control import Client, ControlServer
from polecal.daemon.recorder import Event, Record
from polecal.daemon.service import Service
from polecal.daemon.sessions import CALIBRATION, CAPTURE
from polecal.drivers.emulated.line import EmulatedDevice
from polecal.drivers.emulated.world import World, demo_world
from polecal.drivers.novatel_span import Framer as SpanFramer
from polecal.drivers.novatel_span import nav_state
from polecal.drivers.sick_lms import REVOLUTION_S, Scan
from polecal.drivers.sick_lms import Framer as LaserFramer

WITHIN_S = 10.0
"""So long after a fault's end all must be well again."""

_TIMES = 2.5
_LOOK_S = 0.03
SCAN = 0xB0
SCAN_NS = 4 * REVOLUTION_S * 1e9
_WELL = ["streaming", "streaming"]


class _Faster:
    """The demonstration's drive, so many times as fast."""

    def __init__(self, drive: Any) -> None:
        self._drive = drive

    def pose(self, t_s: Any) -> Any:
        position, rpy, velocity = self._drive.pose(np.asarray(t_s) * _TIMES)
        return position, rpy, velocity * _TIMES


def _world() -> World:
    """The demonstration's world at 7 m/s, a pass in 3 s; with exact navigation, and no plate."""
    world = demo_world(1)
    world.trajectory, world.nav_error, world.reflectors = _Faster(world.trajectory), None, ()
    return world


class Wire:
    """The line of a device, as it is or spoiled; what a pseudo-terminal has in place of the device.

    Of a ``noisy`` one, one byte in a hundred is another; on a ``dead`` one nothing gets through either way;
    on a ``stuck`` one everything the device says comes at once when it is no longer.
    """

    def __init__(self, device: EmulatedDevice) -> None:
        self.state: Literal["fine", "noisy", "dead", "stuck"] = "fine"
        self._device = device
        self._lock = threading.Lock()
        self._held = b""
        self._chance = random.Random(7)

    def do(self, action: Callable[[int], None]) -> None:
        """Have something happen to the device, now."""
        with self._lock:
            action(time.monotonic_ns())

    def receive(self, t_ns: int, data: bytes, host_baud: int) -> None:
        with self._lock:
            if self.state != "dead":
                self._device.receive(t_ns, self._noisy(data), host_baud)

    def transmit(self, t_ns: int, host_baud: int) -> bytes:
        with self._lock:
            data = self._device.transmit(t_ns, host_baud)
            if self.state == "dead":
                return b""
            self._held += self._noisy(data)
            if self.state == "stuck":
                return b""
            data, self._held = self._held, b""
            return data

    def next_ns(self) -> int | None:
        with self._lock:
            return self._device.next_ns()

    def _noisy(self, data: bytes) -> bytes:
        if self.state != "noisy":
            return data
        return bytes(
            byte ^ self._chance.randrange(1, 256) if self._chance.random() < 0.01 else byte for byte in data
        )


@dataclass
class Seen:
    """What an operator saw who asked for STATUS all the time."""

    since_s: float = field(default_factory=time.monotonic)
    states: list[str] = field(default_factory=list)
    devices: dict[str, list[str]] = field(default_factory=dict)
    said: dict[str, None] = field(default_factory=dict)
    """Problems and notes, in their order."""
    slowest_s: float = 0.0
    """The longest that a STATUS took."""

    def take(self, status: dict[str, Any], took_s: float) -> None:
        self.slowest_s = max(self.slowest_s, took_s)
        _append(self.states, status["state"])
        self.said |= dict.fromkeys(status["notes"])
        for device in status["devices"]:
            _append(self.devices.setdefault(device["name"], []), device["state"])
            if "problem" in device:
                self.said[device["problem"]] = None

    def told(self, *parts: str) -> bool:
        """Whether one problem or note has all of these parts."""
        return any(all(part in one for part in parts) for one in self.said)


def _append(values: list[str], value: str) -> None:
    if values[-1:] != [value]:
        values.append(value)


_RETURNS = ("range_m", "bearing_rad", "position_m", "rpy_rad", "kind", "pass_id")


def _held_against(world: World, origin: tuple[float, float, float], every: Returns) -> float:
    """Place returns by the true mount: none may be off the pole or the ground; give the worst on the pole, m.

    ``origin`` is n's: latitude, longitude, height.
    """
    at = world.reference
    point = points_nav(every, Mount(*astuple(world.mount)))
    point = point + pymap3d.geodetic2ned(*origin, at.lat_deg, at.lon_deg, at.height_m)
    on_pole = every.kind == Kind.POLE
    axis_m = np.linalg.norm(point[on_pole, :2] - world.pole_ne_m, axis=1)
    pole_m = np.abs(axis_m - world.pole_radius_m)
    ground_m = np.abs(point[~on_pole, 2] - world.ground_z_m)
    assert pole_m.max() < 0.15
    assert np.sqrt(np.mean(pole_m**2)) < 0.03
    assert np.percentile(ground_m, 99) < 0.1
    return float(pole_m.max())


@pytest.fixture(scope="session")
def held_against() -> Callable[..., float]:
    """What holds returns against a world."""
    return _held_against


class Trial:
    """A session on the bench, from its start to its end, and what is to be known of it."""

    def __init__(self, bench: Any, ask: Callable[[dict[str, Any]], dict[str, Any]]) -> None:
        self.bench, self.ask = bench, ask
        self.lms: Wire = bench.served.devices[bench.lms]
        self.span: Wire = bench.served.devices[bench.span]
        self.session = ask({"class": "START"})["session"]
        self.seen = Seen()
        self.recovery_s = self.worst_m = 0.0
        self.result: dict[str, Any] = {}
        self._bad_before: dict[str, int] = {}
        self._wait(self.passes, 25.0)

    @property
    def folder(self) -> Path:
        return self.bench.folder / "state" / "sessions" / self.session

    def status(self) -> dict[str, Any]:
        began_s = time.monotonic()
        status = self.ask({"class": "STATUS"})
        self.seen.take(status, time.monotonic() - began_s)
        return status

    def device(self, name: str) -> dict[str, Any]:
        return next(device for device in self.status()["devices"] if device["name"] == name)

    def passes(self) -> int:
        return self.status()["lasers"][0]["passes"]

    def _wait(self, ask: Callable[[], Any], timeout_s: float) -> None:
        deadline_s = time.monotonic() + timeout_s
        while not ask():
            assert time.monotonic() < deadline_s, (self.status(), self.seen)
            time.sleep(_LOOK_S)

    def until_seen(self, *parts: str, timeout_s: float = WITHIN_S) -> None:
        """Wait until a problem or a note says this."""
        self._wait(lambda: self.status() and self.seen.told(*parts), timeout_s)

    def until(self, ask: Callable[[], Any], timeout_s: float = WITHIN_S) -> None:
        """Wait until something is true, looking at the status meanwhile."""
        self._wait(lambda: self.status() and ask(), timeout_s)

    def in_mid_pass(self) -> None:
        """Wait until the vehicle is about to pass the pole: within 3 m of it, and nearing."""
        pole = np.array(self.bench.world.pole_ne_m)

        def near() -> bool:
            t_s = self.bench.driven_s + np.array([0.0, 0.05])
            position, _, _ = self.bench.world.trajectory.pose(t_s)
            now_m, then_m = np.linalg.norm(position[:, :2] - pole, axis=1)
            return 1.5 < now_m < 3.0 and then_m < now_m

        self._wait(near, 15.0)

    @contextmanager
    def fault(self, seconds: float = 0.0) -> Iterator[Seen]:
        """Have what is done within it be the fault, for so long; then wait until all is well again."""
        self.seen = Seen()
        self._bad_before = {device["name"]: device["bad_frames"] for device in self.status()["devices"]}
        end_s = time.monotonic() + seconds
        yield self.seen
        while time.monotonic() < end_s:
            self.status()
            time.sleep(_LOOK_S)

    def recovers(self) -> None:
        """Wait, once the fault has ended, until everything streams and is used."""
        over_s = time.monotonic()
        before = {device["name"]: device["frames"] for device in self.status()["devices"]}

        def well() -> bool:
            status = self.status()
            return (
                status["state"] == "collecting"
                and [device["state"] for device in status["devices"]] == _WELL
                and all(device["frames"] >= before[device["name"]] + 20 for device in status["devices"])
            )

        self._wait(well, WITHIN_S)
        self.recovery_s = time.monotonic() - over_s

    def goes_on(self) -> None:
        """Wait for one more pass, end the session, and hold all that it gave against the truth."""
        so_far = self.passes()
        self._wait(lambda: self.passes() > so_far, 20.0)
        last = self.status()
        assert last["state"] == "collecting", last
        assert self.seen.slowest_s < 1.0
        assert self.ask({"class": "STOP", "calibrate": True})["session"] == self.session
        self.result = yaml.safe_load((self.folder / CALIBRATION).read_text())["lasers"][0]
        assert self.status()["state"] in ("accepted", "rejected")
        self._returns_are_true()
        self._result_is_true()

    def _returns_are_true(self) -> None:
        """No return of any pass is anywhere but on the pole or the ground, by the true mount."""
        origin = self.origin()
        files = sorted((self.folder / "passes").glob("*.npz"))
        assert files
        for file in files:
            with np.load(file) as stored:
                every = Returns(**{name: stored[name] for name in _RETURNS})
                blocks = zip(stored["block_slice_kind"].tolist(), stored["block_count"], strict=True)
                counts = {tuple(key): int(count) for key, count in blocks}
            assert {(part, int(kind)): one.count for (part, kind), one in split(every, 30).items()} == counts
            self.worst_m = max(self.worst_m, _held_against(self.bench.world, origin, every))

    def origin(self) -> tuple[float, float, float]:
        """The first pose that was used: n is about it."""
        poses = (nav_state(frame) for frame in self._frames(SPAN))
        first = next(pose for pose in poses if pose is not None and pose.good)
        return first.lat_deg, first.lon_deg, first.height_m

    def _result_is_true(self) -> None:
        """What was found is as near to the truth as it claims, or to a twentieth of what is asked."""
        for name, key in zip(("x", "y", "z", "roll", "pitch", "yaw"), self.result["estimate"], strict=True):
            if name not in self.result["held"]:
                off = abs(self.result["estimate"][key] - getattr(self.bench.world.mount, key))
                enough = 1e-3 if key.endswith("_m") else 5e-3
                assert off < 5 * self.result["sigma"][key] + enough, (key, off, self.result["sigma"])

    def events(self, name: str) -> list[dict[str, Any]]:
        """The recorded events of a name."""
        items = recorder.read(self.folder / CAPTURE)
        return [item.content for item in items if isinstance(item, Event) and item.content["event"] == name]

    def _frames(self, device: str) -> Iterator[Any]:
        framer = SpanFramer() if device == SPAN else LaserFramer()
        for item in recorder.read(self.folder / CAPTURE):
            if isinstance(item, Record) and item.device == device and item.direction == "rx":
                yield from framer.feed(item.data, item.t_ns)

    def lost_poses(self) -> int:
        """How many poses are missing between the first and the last that came, by their own time."""
        poses = (nav_state(frame) for frame in self._frames(SPAN))
        times_ms = {pose.gps_ns // 1_000_000 for pose in poses if pose is not None}
        return (max(times_ms) - min(times_ms)) // 10 + 1 - len(times_ms)

    def lost_scans(self) -> int:
        """How many scans are missing between the first and the last that came.

        By the numbers of their revolutions, mod 256; over a longer gap by their stamps.
        """
        scans = [
            (frame.t_first_ns, Scan.parse(frame).scan_index)
            for frame in self._frames("front")
            if frame.command == SCAN
        ]
        lost = 0
        for (before_ns, before), (t_ns, turn) in pairwise(scans):
            gap = (t_ns - before_ns) / SCAN_NS
            lost += (round(gap) if gap > 32 else (turn - before) % 256 // 4) - 1
        return lost

    def untouched(self, name: str) -> None:
        """Say that what happened has cost a device's stream nothing: not a frame, not a byte."""
        device = self.device(name)
        assert device["reconnects"] == 0
        assert device["bad_frames"] == self._bad_before[name]
        assert (self.lost_poses() if name == SPAN else self.lost_scans()) == 0

    def line(self, fault: str) -> str:
        """Write a row of the table of faults."""
        said = "; ".join(self.seen.said).replace(f"{self.bench.folder}/", "") or "nothing"
        bad = {device["name"]: device["bad_frames"] for device in self.status()["devices"]}
        return (
            f"{fault} | well again after {self.recovery_s:.1f} s | lost {self.lost_scans()} scans, "
            f"{self.lost_poses()} poses, bad frames {bad['front']} and {bad[SPAN]} | worst pole return "
            f"{self.worst_m * 100:.0f} cm off | {' → '.join(self.seen.states)} | said: {said}"
        )


@contextmanager
def _bench_of_trial(made_bench: Callable[..., Any], folder: Path) -> Iterator[Any]:
    with made_bench(folder, _world(), Wire) as bench:
        bench.content["routine"] = {"min_passes": 99}  # it ends when it is told to
        yield bench


@pytest.fixture(scope="session")
def fast_world() -> Callable[[], World]:
    """Make the world that trials are in."""
    return _world


@pytest.fixture
def trial(made_bench: Callable[..., Any], tmp_path: Path) -> Iterator[Trial]:
    """A session of a daemon in this process, with one pass stored, whose operator is on its socket."""
    with _bench_of_trial(made_bench, tmp_path) as bench:
        service = Service(bench.config)
        with ControlServer(bench.config.socket, service) as server:
            try:
                with Client(server.path, timeout_s=60.0) as client:
                    yield Trial(bench, client.request)
            finally:
                service.close()


@pytest.fixture
def trial_apart(
    made_bench: Callable[..., Any], running: Callable[[Any], Any], tmp_path: Path
) -> Iterator[tuple[Trial, int]]:
    """The same of a daemon in a process of its own, and its number."""
    with (
        _bench_of_trial(made_bench, tmp_path) as bench,
        running(bench) as daemon,
        Client(bench.config.socket, timeout_s=60.0) as client,
    ):
        yield Trial(bench, client.request), daemon.pid
