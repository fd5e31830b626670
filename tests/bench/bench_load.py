"""Load: the daemon's share of a core, its memory, and how late its stamps are, at the devices' full rate.

One laser and four, 401 beams at 18.75 Hz and 500 kbaud, INSPVAS at 100 Hz, each on the pseudo-terminal of a
process that notes when it wrote each byte. Share and memory are the kernel's account of ``polecald``; a
stamp's delay is that from a write to the stamp of the chunk that has its first byte. While solving, a pass
is dropped and kept again without a pause. The soak is an hour of passes in virtual time, in a process that
holds what the daemon does.
"""

import json
import os
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from pathlib import Path

import numpy as np
import yaml

from polecal.calib import KEYS
from polecal.daemon import recorder
from polecal.daemon.config import SPAN
from polecal.daemon.control import Client, NoDaemon, Refused
from polecal.daemon.recorder import Record
from polecal.daemon.sessions import CAPTURE
from polecal.drivers.emulated import laser_telegrams as lms
from polecal.drivers.emulated.drive import ThereAndBack
from polecal.drivers.emulated.laser import EmulatedLaser
from polecal.drivers.emulated.receiver import EmulatedReceiver
from polecal.drivers.emulated.serve import serve
from polecal.drivers.emulated.virtual import STREAM_LOGS, play
from polecal.drivers.emulated.world import HAND_MEASURED, demo_world
from tests.bench.hearing import HEAD, peak_mb, rss_mb

HEADINGS = ("lasers", "what", "value", "unit", "target")

COLLECT_S = 45.0
SOLVE_S = 10.0
SOAK_S = 3600.0
SOAK_EVERY_S = 300.0
_TICK_HZ = os.sysconf("SC_CLK_TCK")
_MARK_BYTES = 400
_AT_ONCE = 4


def rows() -> Iterator[tuple[object, ...]]:
    for lasers in (1, 4):
        for what, value, unit, target in _live(lasers):
            yield lasers, what, value, unit, target
    for what, value, unit, target in _soak():
        yield 1, what, value, unit, target


# --- live


class _Noted:
    """A device that notes when what it said was taken, to be written at once."""

    def __init__(self, device, log):
        self._device, self._log = device, log
        self.receive, self.next_ns = device.receive, device.next_ns

    def transmit(self, t_ns, host_baud):
        data = self._device.transmit(t_ns, host_baud)
        if data:
            self._log.append((time.monotonic_ns(), data))
        return data


def emulate(folder: str, name: str, start_ns: int) -> None:
    """Serve a device until this process's input ends; then write down what was written when.

    The vehicle begins to drive at ``start_ns``.
    """
    world, log, now_ns = demo_world(1), [], time.monotonic_ns()
    world.start(start_ns)
    device = (
        EmulatedReceiver(world, t0_ns=now_ns, baud=230400, aligned_after_s=-2.0)
        if name == SPAN
        else EmulatedLaser(world, t0_ns=now_ns - 2 * 10**9, eeprom=lms.STREAM_CONFIG, starts_world=False)
    )
    stop = threading.Event()
    serving = {f"{folder}/{name}": _Noted(device, log)}
    # at no priority: it would hold up the kernel's own work on a line, as no real device does
    thread = threading.Thread(target=serve, args=(serving,), kwargs={"stop": stop})
    thread.start()
    sys.stdin.read()
    stop.set()
    thread.join()
    np.savez(
        f"{folder}/{name}.npz",
        stamps=np.array([t_ns for t_ns, _ in log]),
        ends=np.cumsum([len(data) for _, data in log]),
    )
    Path(f"{folder}/{name}.raw").write_bytes(b"".join(data for _, data in log))


@contextmanager
def _program(*command: str, **how):
    with subprocess.Popen([sys.executable, *command], **how) as program:
        try:
            yield program
        finally:
            if program.stdin is not None:
                program.stdin.close()
            else:
                program.terminate()
            program.wait(60.0)


def _connected(path: Path) -> Client:
    deadline_s = time.monotonic() + 20.0
    while True:
        try:
            return Client(path, timeout_s=120.0)
        except (NoDaemon, Refused):
            if time.monotonic() > deadline_s:
                raise
            time.sleep(0.05)


def _until_there(paths: list[Path]) -> None:
    deadline_s = time.monotonic() + 20.0
    while not all(path.exists() for path in paths):
        assert time.monotonic() < deadline_s, paths
        time.sleep(0.05)


def _cpu_s(pid: int) -> float:
    fields = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()
    return (int(fields[11]) + int(fields[12])) / _TICK_HZ


def _config(folder: Path, lasers: int) -> dict:
    mount = {key: getattr(HAND_MEASURED, key) for key in KEYS}
    return {
        "state_dir": str(folder / "state"),
        "runtime_dir": str(folder / "run"),
        "lasers": [
            {"name": f"lms{i}", "port": str(folder / f"lms{i}"), "mount": mount} for i in range(lasers)
        ],
        "navigation": {"port": str(folder / SPAN)},
        "pole": {"radius_m": 0.04, "height_m": 2.4},
        "routine": {"min_passes": 99, "max_passes": 500},
    }


def _live(lasers: int) -> Iterator[tuple[str, float, str, str]]:
    names = [f"lms{i}" for i in range(lasers)] + [SPAN]
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        config = folder / "polecal.yaml"
        config.write_text(yaml.safe_dump(_config(folder, lasers)))
        me = (
            "import sys; from tests.bench.bench_load import emulate as e; e(*sys.argv[1:3], int(sys.argv[3]))"
        )
        start_ns = time.monotonic_ns() + 8 * 10**9
        with ExitStack() as devices:
            for name in names:
                devices.enter_context(_program("-c", me, place, name, str(start_ns), stdin=subprocess.PIPE))
            service = ("-m", "polecal.daemon.service", "--config", str(config))
            with (
                (folder / "log").open("wb") as log,
                _program(*service, stderr=log) as daemon,
                _connected(folder / "run" / "control.sock") as client,
            ):
                _until_there([folder / device for device in names])
                yield "memory, idle", rss_mb(daemon.pid), "MB", ""
                session = client.request({"class": "START"})["session"]
                time.sleep(5.0)  # clocks settle
                spans = {}
                with _stretch(spans, "collecting"):
                    peak_mb(daemon.pid)  # from here on
                    before_s, began_s = _cpu_s(daemon.pid), time.monotonic()
                    time.sleep(COLLECT_S)
                    share = (_cpu_s(daemon.pid) - before_s) / (time.monotonic() - began_s)
                yield "share of a core, collecting", 100 * share, "%", "≤ 8" if lasers == 1 else ""
                at_most = "≤ 100" if lasers == 1 else ""
                yield "memory, collecting", rss_mb(daemon.pid), "MB", at_most
                yield "memory, peak collecting", peak_mb(daemon.pid), "MB", at_most
                passes = client.request({"class": "STATUS"})["lasers"][0]["passes"]
                with _stretch(spans, "solving"):
                    solved = _solve_on(client.path, "" if lasers == 1 else "lms0-", passes)
                yield "passes; solutions in a second", solved / SOLVE_S, f"of {passes} passes", ""
                yield "memory, peak solving", peak_mb(daemon.pid), "MB", at_most
                client.request({"class": "STOP"})
                yield "memory, at the end", rss_mb(daemon.pid), "MB", ""
        capture = folder / "state" / "sessions" / session / CAPTURE
        delays = _delays_ms(folder, capture, names)
        for what, (begin_ns, end_ns) in spans.items():
            for name, (stamps, late_ms) in delays.items():
                within = late_ms[(stamps >= begin_ns) & (stamps < end_ns)]
                for percent in (50, 99):
                    yield (
                        f"stamp delay of {name}, {what}, p{percent}",
                        float(np.percentile(within, percent)),
                        "ms",
                        "≤ 1" if percent == 99 else "",
                    )


def _solve_on(socket: Path, laser: str, passes: int) -> int:
    """Drop and keep passes, several at once so that one always waits; give how often it was calibrated."""
    end_s = time.monotonic() + SOLVE_S

    def choose(number: int) -> int:
        solved = 0
        with _connected(socket) as client:
            while time.monotonic() < end_s or solved % 2:
                client.request({"class": ("DROP", "KEEP")[solved % 2], "pass": f"{laser}{number}"})
                solved += 1
        return solved

    with ThreadPoolExecutor() as several:
        return sum(several.map(choose, range(1, min(passes, _AT_ONCE) + 1)))


@contextmanager
def _stretch(spans: dict, what: str) -> Iterator[None]:
    begin_ns = time.monotonic_ns()
    yield
    spans[what] = begin_ns, time.monotonic_ns()


def _delays_ms(folder: Path, capture: Path, names: list[str]) -> dict:
    """Give of each device (writes' moments in ns, how late the stamps of their first bytes are in ms)."""
    heard: dict[str, list[Record]] = {name: [] for name in names}
    for item in recorder.read(capture):
        if isinstance(item, Record) and item.direction == "rx":
            heard[item.device].append(item)
    out = {}
    for name in names:
        with np.load(folder / f"{name}.npz") as noted:
            written_ns, ends = noted["stamps"], noted["ends"]
        written = (folder / f"{name}.raw").read_bytes()
        chunks = heard[name]
        sizes = np.array([len(chunk.data) for chunk in chunks])
        stamps = np.array([chunk.t_ns for chunk in chunks])
        middle = len(chunks) // 2  # by then nothing is lost any more
        mark = b"".join(chunk.data for chunk in chunks[middle : middle + 60])[:_MARK_BYTES]
        at = written.find(mark)
        assert at >= 0
        begins = np.cumsum(sizes) - sizes
        begins = begins - begins[middle] + at  # of each chunk, in what was written
        firsts = np.concatenate([[0], ends[:-1]])
        whole = (firsts >= begins[20]) & (firsts < begins[-1])
        chunk_of = np.searchsorted(begins, firsts[whole], side="right") - 1
        out[name] = written_ns[whole], (stamps[chunk_of] - written_ns[whole]) * 1e-6
    return out


# --- an hour in virtual time


def _soak() -> Iterator[tuple[str, float, str, str]]:
    """An hour's passes through pipeline and recorder, in a process of their own; its memory as it goes on."""
    world = demo_world(1)
    world.trajectory = ThereAndBack(world.trajectory, 8.0, world.trajectory.reverse_from_s)
    world.nav_error = None
    t0_ns = 10**12
    laser = EmulatedLaser(world, t0_ns=t0_ns, seed=1)
    receiver = EmulatedReceiver(world, t0_ns=t0_ns, seed=1)
    laser.force_stream(t0_ns)
    receiver.force_logs(t0_ns, STREAM_LOGS)
    chunks = play({"lms0": laser, SPAN: receiver}, start_ns=t0_ns, seconds=SOAK_S + 1.0, chunk_s=0.02)
    with tempfile.TemporaryDirectory() as name:
        config = Path(name) / "polecal.yaml"
        config.write_text(yaml.safe_dump(_config(Path(name), 1)))
        hearing = ("-m", "tests.bench.hearing", str(config), f"{name}/capture.mcap", str(SOAK_EVERY_S))
        with _program(*hearing, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as heard:
            for device, t_ns, data in chunks:
                heard.stdin.write(HEAD.pack(device == SPAN, t_ns, len(data)) + data)
            heard.stdin.close()
            held = [json.loads(line) for line in heard.stdout]
    for at in held:
        when = f"{at['t_s'] / 60:.0f} minutes, {at['passes']} passes"
        yield f"soak: memory after {when}", at["rss_mb"], "MB", ""
        yield f"soak: peak until {when}", at["peak_mb"], "MB", "≤ 100"
    first, last = held[0], held[-1]
    grown_mb = last["rss_mb"] - first["rss_mb"]
    yield f"soak: grown since minute {first['t_s'] / 60:.0f}", grown_mb, "MB", "≤ 10"
