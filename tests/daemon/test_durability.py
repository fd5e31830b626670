"""Runs that are killed, or lose their power, at any moment: what was written is there afterwards.

The run is the daemon's own. Its devices are not: they say a drive's chunks, much faster.
"""

import json
import pickle
import random
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from polecal.daemon import recorder
from polecal.daemon.config import dump
from polecal.daemon.finalise import finalise, is_indexed
from polecal.daemon.tail import rescue

KILLS = 50
LOST_BY_A_POWER_CUT_S = 1.0

RUNS = """
import json, os, pickle, signal, stat, sys, time
from pathlib import Path
from polecal.daemon import recorder, run as running, sessions
from polecal.daemon.config import loads

folder, moments, at_once, pause_s = Path(sys.argv[1]), *map(json.loads, sys.argv[2:])
config = loads((folder / "polecal.yaml").read_text())
chunks = pickle.loads((folder / "chunks").read_bytes())
taps = {}

class Port:
    def close(self): ...

class Said:
    kind, path, state, problem, identity, reconnects = "", "", "streaming", None, "", 0
    def __init__(self, name, path, baud, tap, **_):
        self.name = name
        taps[name] = tap
    def open(self, stop):
        return Port()
    def run(self, port):
        if self.name != "span":
            return  # one thread says both, as they lie in the drive
        for n, (device, t_ns, data) in enumerate(chunks):
            taps[device]("rx", t_ns, data)
            tell("read", device, t_ns)
            if n % 20 == 0:
                time.sleep(pause_s)
        time.sleep(60)

running.SickLms = running.NovatelSpan = Said

def tell(*what):
    os.write(told, (json.dumps(what) + "\\n").encode())

class Telling(recorder.Recorder):
    def write(self, device, direction, t_ns, data):
        super().write(device, direction, t_ns, data)
        tell("wrote", device, t_ns, time.monotonic())

running.Recorder = Telling
write_pass = sessions.Session.write_pass
def store(self, laser, stored):
    write_pass(self, laser, stored)
    tell("pass", f"{laser}-{stored.id:03d}.npz", len(stored.returns))
sessions.Session.write_pass = store

def telling(sync):
    "Tell what a sync put on the disk: a folder's names, or a file's bytes, kept by a second name."
    def synced(fd):
        sync(fd)
        about = os.fstat(fd)
        if stat.S_ISDIR(about.st_mode):
            names = {entry.name: entry.inode() for entry in os.scandir(fd)}
            tell("folder", os.readlink(f"/proc/self/fd/{fd}"), names)
        else:
            kept = folder / "inodes" / str(about.st_ino)
            if not kept.exists():
                os.link(os.readlink(f"/proc/self/fd/{fd}"), kept)
            tell("file", about.st_ino, about.st_size)
    return synced
os.fsync, os.fdatasync = telling(os.fsync), telling(os.fdatasync)

def begin(n):
    global told
    if child := os.fork():
        return child
    told = os.open(folder / f"told-{n:02d}", os.O_WRONLY | os.O_CREAT | os.O_APPEND)
    session = sessions.create(config.state_dir, config, f"run{n:02d}")
    one = running.Run(config, session)
    tell("session", str(session.folder))
    one.begin()
    one.ended.wait()
    os._exit(1)

for first in range(0, len(moments), at_once):
    part = range(first, min(first + at_once, len(moments)))
    children = {begin(n): n for n in part}
    due = {}
    while children:
        for child, n in list(children.items()):
            if os.waitpid(child, os.WNOHANG) != (0, 0):
                sys.exit(f"run {n} has ended by itself")
            path = folder / f"told-{n:02d}"
            after, delay_s = moments[n]
            if child not in due and path.exists() and f'["{after}"'.encode() in path.read_bytes():
                due[child] = time.monotonic() + delay_s
            if child in due and time.monotonic() > due[child]:
                os.kill(child, signal.SIGKILL)
                assert os.waitpid(child, 0)[1] == signal.SIGKILL
                del children[child]
        time.sleep(0.002)
"""


class Told:
    """What one run had told when it was killed."""

    def __init__(self, path):
        lines = [
            json.loads(line) for line in path.read_bytes().splitlines(keepends=True) if line[-1:] == b"\n"
        ]
        self.lines = lines
        self.folder = Path(self.of("session")[0][0])
        self.read = [tuple(rest) for rest in self.of("read")]
        self.written = [tuple(rest) for rest in self.of("wrote")]
        self.passes = dict(self.of("pass"))

    def of(self, kind):
        return [rest for what, *rest in self.lines if what == kind]


@pytest.fixture
def killed(recorded, drive, settings, tmp_path):
    """Begins the daemon's run again and again, and kills each so many seconds after what it told first."""

    def kill(moments, *, at_once, pause_s):
        (tmp_path / "run").mkdir()
        folders = {"state_dir": str(tmp_path / "state"), "runtime_dir": str(tmp_path / "run")}
        config = settings(**folders, routine={"min_passes": 99})
        (tmp_path / "polecal.yaml").write_text(dump(config))
        first_ns = recorded.played.passes[0][1].t_ns[0] - 4 * 10**9
        (tmp_path / "chunks").write_bytes(
            pickle.dumps([chunk for chunk in drive.chunks if chunk[1] > first_ns])
        )
        (tmp_path / "inodes").mkdir()
        command = [sys.executable, "-W", "error", "-c", RUNS, str(tmp_path)]
        how = [json.dumps(value) for value in (moments, at_once, pause_s)]
        done = subprocess.run([*command, *how], capture_output=True, timeout=50, check=False)
        assert done.returncode == 0, done.stderr.decode()
        return [Told(path) for path in sorted(tmp_path.glob("told-*"))]

    return kill


def records(capture):
    return [(item.device, item.t_ns) for item in capture if isinstance(item, recorder.Record)]


def test_fifty_kills_lose_no_message_and_no_pass_and_every_session_is_repaired(killed, tell):
    rng = random.Random(7)
    moments = [("pass" if n < 8 else "wrote", rng.uniform(0, 0.5)) for n in range(KILLS)]
    runs = killed(moments, at_once=4, pause_s=0.0)
    assert len(runs) == KILLS
    for run in runs:
        path = run.folder / "capture.mcap"
        whole = list(recorder.read(path))
        done = finalise(path)
        assert is_indexed(path)
        assert "is cut off" in done.recovered
        capture = recorder.read(path)
        assert list(capture) == whole
        assert capture.cut is None
        found = records(capture)
        written = [(device, t_ns) for device, t_ns, _ in run.written]
        assert found[: len(written)] == written
        assert len(found) <= len(written) + 1  # the one that was written and not yet told
        for name, count in run.passes.items():
            with np.load(run.folder / "passes" / name) as stored:
                assert len(stored["range_m"]) == count
    messages = sum(len(run.written) for run in runs)
    passes = sum(len(run.passes) for run in runs)
    tell(f"{KILLS} kills: {messages} messages and {passes} passes told, none lost")
    assert messages > 100 * KILLS
    assert passes > 0


def test_a_kill_loses_nothing_that_was_read_though_it_was_not_written_yet(killed, tmp_path, tell):
    rng = random.Random(11)
    runs = killed([("wrote", rng.uniform(0.2, 0.6)) for _ in range(12)], at_once=4, pause_s=0.02)
    rescue(tmp_path / "run")
    from_tail = []
    for run in runs:
        path = run.folder / "capture.mcap"
        before = list(recorder.read(path))
        done = finalise(path)
        after = list(recorder.read(path))
        assert after[: len(before)] == before
        assert len(after) - len(before) == done.from_tail
        found = records(after)
        assert len(found) == len(set(found))
        assert found[: len(run.read)] == run.read
        assert len(found) <= len(run.read) + 1  # the one that was read and not yet told
        assert [one.name for one in run.folder.glob(".*")] == []
        from_tail.append(done.from_tail)
    tell(f"{len(runs)} kills: {sum(from_tail)} chunks were read and not written yet, none lost")
    assert max(from_tail) > 0


def on_disk(run, inodes):
    """Give the folder's files as a power cut at the end would leave them: content by name."""
    sizes = dict(map(tuple, run.of("file")))
    names = {}
    for folder, entries in run.of("folder"):
        names[Path(folder)] = entries
    files = {}
    for folder, entries in names.items():
        for name, inode in entries.items():
            if inode in sizes:
                files[folder / name] = (inodes / str(inode)).read_bytes()[: sizes[inode]]
    return files


def test_a_power_cut_loses_a_second_at_most_and_no_pass_and_leaves_nothing_corrupt(killed, tmp_path, tell):
    runs = killed([("wrote", 0.6), ("wrote", 1.1), ("pass", 0.3), ("pass", 0.9)], at_once=4, pause_s=0.02)
    worst_s = passes = 0
    for run in runs:
        files = on_disk(run, tmp_path / "inodes")
        capture = files[run.folder / "capture.mcap"]
        written = [(device, t_ns) for device, t_ns, _ in run.written]
        for name, tail in {"nothing": b"", "zeros": bytes(4096), "junk": b"\xa5\x5a" * 2048}.items():
            path = tmp_path / f"{run.folder.name}-{name}" / "capture.mcap"
            path.parent.mkdir()
            path.write_bytes(capture + tail)  # blocks that were written in part
            found = records(recorder.read(path))
            assert finalise(path).recovered
            assert records(recorder.read(path)) == found == written[: len(found)]
            assert (run.folder / "session.yaml") in files
        lost = run.written[len(found) :]
        if lost:
            worst_s = max(worst_s, run.written[-1][2] - lost[0][2])
        for name, count in run.passes.items():
            path = tmp_path / f"{run.folder.name}-{name}"
            path.write_bytes(files[run.folder / "passes" / name])
            with np.load(path) as stored:
                assert len(stored["range_m"]) == count
            passes += 1
    tell(f"power cuts: at most {worst_s:.2f} s lost, {passes} passes kept")
    assert 0 < worst_s <= LOST_BY_A_POWER_CUT_S
    assert passes > 0
