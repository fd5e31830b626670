"""Drives in virtual time, the same recorded, and devices on pseudo-terminals for a real service."""

from __future__ import annotations

import os
import shutil
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from polecal.calib import KEYS
from polecal.daemon import config as configuration
from polecal.daemon import sessions
from polecal.daemon.config import Config
from polecal.daemon.passes import StoredPass
from polecal.daemon.pipeline import Pipeline
from polecal.daemon.recorder import Recorder
from polecal.daemon.replay import BEGIN
from polecal.daemon.routine import State
from polecal.daemon.sessions import Session
from polecal.drivers.emulated import laser_telegrams as lms
from polecal.drivers.emulated.drive import SampledTrajectory
from polecal.drivers.emulated.laser import EmulatedLaser
from polecal.drivers.emulated.line import EmulatedDevice
from polecal.drivers.emulated.receiver import EmulatedReceiver
from polecal.drivers.emulated.serve import serve
from polecal.drivers.emulated.virtual import STREAM_LOGS, play
from polecal.drivers.emulated.world import HAND_MEASURED, World, demo_world

T0_NS = 1_000_000_000_000
_BROWSERS = ("chromium", "chromium-browser", "google-chrome")
MEASURED = {key: getattr(HAND_MEASURED, key) for key in KEYS}
POLE = {"radius_m": 0.04, "height_m": 2.4}

Chunk = tuple[str, int, bytes]


@pytest.fixture(scope="session")
def t0_ns() -> int:
    """The host's time at which virtual drives begin."""
    return T0_NS


@pytest.fixture(scope="session")
def settings() -> Callable[..., Config]:
    """A configuration, with some of its top-level keys changed, and ``laser`` in the one laser."""

    def make(laser: dict[str, Any] | None = None, **changes: Any) -> Config:
        front = {"name": "front", "port": "/dev/lms", "mount": MEASURED} | (laser or {})
        content = {"lasers": [front], "navigation": {"port": "/dev/span"}, "pole": POLE} | changes
        return configuration.loads(yaml.safe_dump(content))

    return make


@dataclass
class Played:
    """A pipeline that has heard some chunks, and what it said on the way."""

    pipeline: Pipeline
    transitions: list[tuple[int, State, State, str]] = field(default_factory=list)
    passes: list[tuple[str, StoredPass]] = field(default_factory=list)
    last_ns: int = T0_NS

    def feed(self, chunks: Iterable[Chunk]) -> Played:
        for device, t_ns, data in chunks:
            self.pipeline.feed(device, t_ns, data)
            self.last_ns = t_ns
        return self

    def finish(self) -> Played:
        self.pipeline.finish(self.last_ns, "the drive is over")
        return self

    @property
    def state(self) -> State:
        return self.pipeline.routine.state

    @property
    def states(self) -> list[State]:
        """Every state entered, in order."""
        return [new for _, _, new, _ in self.transitions]

    def laser(self, index: int = 0) -> dict[str, Any]:
        return self.pipeline.status()["lasers"][index]

    def dropped(self) -> dict[str, int]:
        return self.laser()["dropped"]


@pytest.fixture(scope="session")
def begun() -> Callable[[Config], Played]:
    """A pipeline at the beginning of a run."""

    def make(config: Config) -> Played:
        pipeline = Pipeline(
            config,
            session="s1",
            created="2026-11-22T03:15:00+00:00",
            on_pass=lambda *it: played.passes.append(it),
            on_transition=lambda *it: played.transitions.append(it),
        )
        played = Played(pipeline)
        pipeline.begin(T0_NS)
        return played

    return make


@pytest.fixture(scope="session")
def streaming() -> Callable[..., list[Chunk]]:
    """What a host hears of devices that stream in a world, in virtual time."""

    def make(
        world: World,
        seconds: float,
        *,
        laser: dict[str, Any] | None = None,
        chunk_s: float = 0.007,
        **how: Any,
    ) -> list[Chunk]:
        front = EmulatedLaser(world, t0_ns=T0_NS, seed=1, **(laser or {}))
        span = EmulatedReceiver(world, t0_ns=T0_NS, seed=1, **how)
        front.force_stream(T0_NS)
        span.force_logs(T0_NS, STREAM_LOGS)
        return list(
            play(
                {"front": front, "span": span},
                start_ns=T0_NS,
                seconds=seconds,
                chunk_s=chunk_s,
                jitter_s=3e-4,
            )
        )

    return make


@dataclass(frozen=True)
class Drive:
    """The demonstration's drive: what is true, and what the host heard."""

    world: World
    chunks: Sequence[Chunk]

    def until(self, seconds: float) -> list[Chunk]:
        return [chunk for chunk in self.chunks if chunk[1] <= T0_NS + seconds * 1e9]


@pytest.fixture(scope="session")
def drive(streaming: Callable[..., list[Chunk]]) -> Drive:
    """170 s of the demonstration: all of its passes forward."""
    world = demo_world(1)
    return Drive(world, streaming(world, 170.0))


@dataclass(frozen=True)
class Recorded:
    """A run's session, recorded as the daemon does, and its pipeline."""

    session: Session
    played: Played


@pytest.fixture(scope="session")
def recorded(
    drive: Drive, settings: Callable[..., Config], tmp_path_factory: pytest.TempPathFactory
) -> Recorded:
    """The drive's session: capture, passes and calibration."""
    config = settings(state_dir=str(tmp_path_factory.mktemp("state")))
    session = sessions.create(config.state_dir, config, "virtual")
    pipeline = Pipeline(
        config,
        session=session.id,
        created=session.created,
        on_pass=lambda *it: (played.passes.append(it), session.write_pass(*it)),
        on_transition=lambda *it: played.transitions.append(it),
    )
    played = Played(pipeline)
    with Recorder(session.capture, session.metadata(config)) as recorder:
        recorder.event(T0_NS, {"event": BEGIN})
        pipeline.begin(T0_NS)
        for device, t_ns, data in drive.chunks:
            recorder.write(device, "rx", t_ns, data)
            pipeline.feed(device, t_ns, data)
    result = pipeline.calibration()
    assert result is not None
    session.write_calibration(result)
    return Recorded(session, played)


@pytest.fixture
def parked() -> Callable[..., World]:
    """A vehicle that stands at the origin, heading north, 0.1 m above the ground; a pole 5 m ahead."""

    def make(**changes: Any) -> World:
        still = SampledTrajectory(
            [0.0, 1e6], np.tile([0, 0, -0.1], (2, 1)), np.zeros((2, 3)), np.zeros((2, 3))
        )
        return World(**{"trajectory": still, "mount": HAND_MEASURED, "pole_ne_m": (5.0, 0.0)} | changes)

    return make


class Served:
    """Devices on pseudo-terminals until closed; each may be unplugged and plugged in again."""

    def __init__(self, devices: dict[Path, EmulatedDevice]) -> None:
        self.devices = devices
        self._ends: dict[Path, tuple[threading.Event, threading.Thread]] = {}
        for path in devices:
            self.plug(path)

    def plug(self, path: Path) -> None:
        stop, ready = threading.Event(), threading.Event()

        def run() -> None:
            serve({str(path): self.devices[path]}, stop=stop, ready=lambda _: ready.set())

        thread = threading.Thread(target=run, name=f"serve {path.name}")
        thread.start()
        assert ready.wait(5.0)
        self._ends[path] = stop, thread

    def unplug(self, path: Path) -> None:
        stop, thread = self._ends.pop(path)
        stop.set()
        thread.join(5.0)
        assert not thread.is_alive()

    def close(self) -> None:
        for path in list(self._ends):
            self.unplug(path)


@dataclass
class Bench:
    """A laser and a receiver on pseudo-terminals, and the configuration that knows them."""

    folder: Path
    world: World
    laser: EmulatedLaser
    receiver: EmulatedReceiver
    served: Served
    content: dict[str, Any]

    @property
    def lms(self) -> Path:
        return self.folder / "lms"

    @property
    def span(self) -> Path:
        return self.folder / "span"

    @property
    def config(self) -> Config:
        return configuration.loads(yaml.safe_dump(self.content))

    @property
    def config_file(self) -> Path:
        path = self.folder / "polecal.yaml"
        path.write_text(yaml.safe_dump(self.content))
        return path

    @property
    def sessions(self) -> list[Path]:
        return sorted((self.folder / "state" / "sessions").iterdir())

    @property
    def driven_s(self) -> float:
        """How long the vehicle has been driving."""
        return float(self.world.seconds(time.monotonic_ns())[0])

    def polite(self) -> bool:
        """Whether both devices are as a stranger would want to find them."""
        return self.laser.mode == lms.Mode.REQUEST and self.laser.baud == 9600 and not self.receiver._logs


def _straight() -> World:
    """A vehicle that drives straight on and passes the pole 5 s after the laser's first scan."""
    t = np.array([0.0, 1e3])
    way = np.column_stack([5.0 * t, np.zeros(2), np.full(2, -0.1)])
    straight = SampledTrajectory(t, way, np.zeros((2, 3)), np.tile([5.0, 0, 0], (2, 1)))
    return World(straight, mount=HAND_MEASURED, pole_ne_m=(24.0, 1.0))


@contextmanager
def _bench(
    folder: Path, world: World | None = None, wire: Callable[[EmulatedDevice], Any] = lambda device: device
) -> Iterator[Bench]:
    """Devices that are aligned from the start, with nothing to write to an EEPROM, in a world of one pass.

    ``wire`` makes of a device what is on its pseudo-terminal.
    """
    now_ns = time.monotonic_ns()
    world = world or _straight()
    laser = EmulatedLaser(world, t0_ns=now_ns - 2 * 10**9, eeprom=lms.STREAM_CONFIG)
    receiver = EmulatedReceiver(world, t0_ns=now_ns, baud=230400, aligned_after_s=-2.0)
    content = {
        "state_dir": str(folder / "state"),
        "runtime_dir": str(folder / "run"),
        "lasers": [{"name": "front", "port": str(folder / "lms"), "mount": MEASURED}],
        "navigation": {"port": str(folder / "span")},
        "pole": POLE,
    }
    served = Served({folder / "lms": wire(laser), folder / "span": wire(receiver)})
    try:
        yield Bench(folder, world, laser, receiver, served, content)
    finally:
        served.close()


@pytest.fixture(scope="session")
def made_bench() -> Callable[..., Any]:
    """Devices on pseudo-terminals in a folder, in a world and behind wires of one's own."""
    return _bench


@pytest.fixture
def bench(tmp_path: Path) -> Iterator[Bench]:
    """Devices on pseudo-terminals, for one test."""
    with _bench(tmp_path) as made:
        yield made


@pytest.fixture(scope="module")
def shared_bench(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Bench]:
    """Devices on pseudo-terminals, for a module."""
    with _bench(tmp_path_factory.mktemp("bench")) as made:
        yield made


@contextmanager
def _running(bench: Bench) -> Iterator[subprocess.Popen[bytes]]:
    address = bench.folder / "notify"
    address.unlink(missing_ok=True)
    with (
        socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as notify,
        (bench.folder / "polecald.log").open("ab") as log,
    ):
        notify.bind(str(address))
        notify.settimeout(20.0)
        command = [sys.executable, "-W", "error", "-m", "polecal.daemon.service", "--config"]
        environment = os.environ | {"NOTIFY_SOCKET": str(address)}
        with subprocess.Popen([*command, str(bench.config_file)], stderr=log, env=environment) as daemon:
            try:
                assert notify.recv(64) == b"READY=1"
                yield daemon
            finally:
                daemon.terminate()
                try:
                    daemon.wait(20.0)
                except subprocess.TimeoutExpired:
                    daemon.kill()
                    raise


@pytest.fixture(scope="session")
def running() -> Callable[[Bench], Any]:
    """A daemon of its own process, from its being ready to its end."""
    return _running


@pytest.fixture(scope="session")
def until() -> Callable[..., Any]:
    """Wait until something is true, and give it; fail with what it was last."""

    def wait(ask: Callable[[], Any], timeout_s: float = 15.0) -> Any:
        deadline_s = time.monotonic() + timeout_s
        while not (answer := ask()):
            assert time.monotonic() < deadline_s, answer
            time.sleep(0.02)
        return answer

    return wait


@contextmanager
def _tmpfs(folder: Path, size: str) -> Iterator[Path]:
    folder.mkdir()
    if os.system(f"mount -t tmpfs -o size={size} polecal-test {folder} 2>/dev/null"):
        pytest.skip("this user may not mount a tmpfs")
    try:
        yield folder
    finally:
        assert not os.system(f"umount {folder}")


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Callable[[str], Path]]:
    """Mounts a file system of a given size."""
    from contextlib import ExitStack

    with ExitStack() as stack:
        yield lambda size: stack.enter_context(_tmpfs(tmp_path / "disk", size))


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    """Headless Chromium, the system's or the test package's own."""
    sync = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    path = next(filter(None, map(shutil.which, _BROWSERS)), None)
    with sync.sync_playwright() as playwright:
        if path is None and not os.path.exists(playwright.chromium.executable_path):
            pytest.skip("no Chromium here: apt-get install chromium")
        shown = playwright.chromium.launch(executable_path=path, args=["--no-sandbox"])
        yield shown
        shown.close()
