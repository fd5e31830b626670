"""A run on pseudo-terminals, in real time: what it records, what it survives, how it leaves."""

import threading
import time

import numpy as np
import pytest
import yaml

from polecal.daemon import recorder, sessions
from polecal.daemon.choices import Choice
from polecal.daemon.config import Storage
from polecal.daemon.control import Refused
from polecal.daemon.recorder import RecorderError
from polecal.daemon.replay import BEGIN, FINISH, replay
from polecal.daemon.routine import State
from polecal.daemon.run import Run, joined
from polecal.daemon.sessions import CALIBRATION
from polecal.drivers.errors import DeviceBusy, DeviceError, DeviceNotFound
from polecal.drivers.sick_lms import SickLms

STREAMING = ["streaming", "streaming"]


@pytest.fixture
def begin(until):
    """Begins runs and waits for their devices; ends what a test leaves running."""
    runs = []

    def begin(bench, **changes):
        config = bench.config.model_copy(update=changes)
        run = Run(config, sessions.create(config.state_dir, config, None))
        runs.append(run)
        run.begin()
        until(lambda: states(run) == STREAMING)
        return run

    yield begin
    for run in runs:
        run.stop("the test is over")


def states(run):
    return [device["state"] for device in run.status()["devices"]]


@pytest.fixture(scope="module")
def ended(shared_bench, until):
    """A run with one pass of the pole, ended and calibrated on request; and what it said meanwhile."""
    bench = shared_bench
    run = Run(bench.config, sessions.create(bench.config.state_dir, bench.config, "yard"))
    run.begin()
    try:
        until(lambda: run.state is State.COLLECTING)
        collecting = run.status()
        until(lambda: bench.driven_s > 5.5)  # it is past the pole
    finally:
        run.stop("asked to stop", calibrate=True)
    return bench, run, collecting


def test_a_run_that_is_stopped_with_calibrate_calibrates_what_there_is(ended):
    _, run, _ = ended
    assert run.ended.is_set()
    assert run.state is State.REJECTED
    written = yaml.safe_load((run.session.folder / CALIBRATION).read_text())
    assert written["state"] == "rejected"
    assert written["lasers"][0]["passes"] == 1
    assert written["lasers"][0]["session"] == run.session.id
    assert [path.name for path in (run.session.folder / "passes").iterdir()] == ["front-001.npz"]


def test_replay_of_a_live_run_gives_its_calibration_to_the_last_digit(ended, tmp_path):
    _, run, _ = ended
    outcome = replay(run.session.capture, None, tmp_path / "out", None)
    assert outcome.cut is None
    assert (outcome.out / CALIBRATION).read_bytes() == (run.session.folder / CALIBRATION).read_bytes()
    with np.load(outcome.out / "passes" / "front-001.npz") as again:
        live = np.load(run.session.folder / "passes" / "front-001.npz")
        assert all(np.array_equal(again[name], live[name]) for name in live.files)
        live.close()


def test_the_capture_holds_every_byte_both_ways_in_order_and_what_was_done(ended):
    _, run, _ = ended
    items = list(recorder.read(run.session.capture))
    chunks = [item for item in items if isinstance(item, recorder.Record)]
    events = [item.content for item in items if isinstance(item, recorder.Event)]
    sent = b"".join(chunk.data for chunk in chunks if (chunk.device, chunk.direction) == ("span", "tx"))
    assert sent.count(b"UNLOGALL") >= 2  # once to find it, once to leave it
    assert b"INSPVASB ONTIME 0.01" in sent
    for name in ("front", "span"):
        assert {chunk.direction for chunk in chunks if chunk.device == name} == {"rx", "tx"}
        stamps = [chunk.t_ns for chunk in chunks if chunk.device == name and chunk.direction == "rx"]
        assert stamps == sorted(stamps)
    assert events[0] == {"event": BEGIN}
    assert [event["new"] for event in events if event["event"] == "state"] == [
        "connecting",
        "aligning",
        "collecting",
        "calibrating",
        "rejected",
    ]
    assert {"event": FINISH, "why": "asked to stop"} in events


def test_a_drop_behind_a_stop_is_refused_and_not_in_the_capture(bench, begin, monkeypatch):
    """A replay would apply it."""
    run = begin(bench)
    ending, go_on, end = threading.Event(), threading.Event(), run._end

    def late(item):
        ending.set()
        go_on.wait(20.0)
        end(item)

    monkeypatch.setattr(run, "_end", late)
    stopping = threading.Thread(target=run.stop, args=("asked to stop",))
    stopping.start()
    assert ending.wait(20.0)
    choice = Choice("front", 1, drop=True, by="me", at="now", site=0, t_ns=(0, 1))
    with pytest.raises(Refused, match="is being stopped"):
        run._choose_running(choice)
    go_on.set()
    stopping.join()
    events = [item.content for item in recorder.read(run.session.capture) if hasattr(item, "content")]
    assert "choice" not in {event["event"] for event in events}


def test_devices_are_left_polite(ended):
    bench, _, _ = ended
    assert bench.polite()


def test_status_says_what_each_device_does(ended):
    bench, run, collecting = ended
    front, span = collecting["devices"]
    assert (front["name"], front["kind"], front["port"]) == ("front", "sick_lms", str(bench.lms))
    assert (span["name"], span["kind"], span["port"]) == ("span", "novatel_span", str(bench.span))
    assert front["rate_hz"] == pytest.approx(18.8, rel=0.1)
    assert span["rate_hz"] == pytest.approx(100.0, rel=0.2)
    assert span["ins_status"] == "INS_SOLUTION_GOOD"
    assert front["reconnects"] == span["reconnects"] == 0
    assert front["identity"].startswith("LMS291")
    after = run.status()["devices"]
    assert [device["state"] for device in after] == ["closed", "closed"]
    assert [device["rate_hz"] for device in after] == [0.0, 0.0]


def test_devices_that_are_unplugged_come_back_by_themselves(bench, begin, until):
    run = begin(bench)
    until(lambda: run.state is State.COLLECTING)
    bench.served.unplug(bench.span)
    until(lambda: run.state is State.ALIGNING)  # by the laser's time, which still streams
    bench.served.unplug(bench.lms)
    until(lambda: states(run) == ["lost", "lost"])
    for device in run.status()["devices"]:
        assert device["port"] in device["problem"]
        assert device["hint"]
        assert device["rate_hz"] == 0.0
    bench.served.plug(bench.lms)
    bench.served.plug(bench.span)
    until(lambda: states(run) == STREAMING)
    assert [device["reconnects"] for device in run.status()["devices"]] == [1, 1]
    assert not any("problem" in device for device in run.status()["devices"])
    until(lambda: run.state is State.COLLECTING)
    run.stop("asked to stop")
    assert bench.polite()
    assert run.state is State.IDLE
    assert not (run.session.folder / CALIBRATION).exists()
    run.stop("again")  # is nothing


def fill(path):
    """Write until there is no room left."""
    with path.open("wb", buffering=0) as file:
        while True:
            file.write(bytes(1 << 14))


@pytest.fixture
def on_full_disk(bench, begin, until, small_disk):
    """A disk that was filled once the pole had been passed, and the run that records on it."""
    disk = small_disk("24m")
    run = begin(bench, state_dir=disk, storage=Storage(min_free_mb=1))
    until(lambda: run.status()["lasers"][0]["passes"] == 1)
    with pytest.raises(OSError, match="No space"):
        fill(disk / "filler")
    return disk, run


def test_a_full_disk_stops_recording_keeps_all_that_is_known_and_goes_on_when_there_is_room(
    on_full_disk, bench, until
):
    disk, run = on_full_disk
    until(lambda: any("nothing is recorded" in note for note in run.status()["notes"]))
    assert run.state is State.COLLECTING
    assert run.status()["lasers"][0]["estimate"] is not None
    until(lambda: run._writer.missed > 20)
    assert states(run) == STREAMING
    (disk / "filler").unlink()
    until(lambda: run._writer.full is None)
    heard = run.status()["devices"][0]["frames"]
    until(lambda: run.status()["devices"][0]["frames"] > heard)
    run.stop("asked to stop", calibrate=True)
    assert bench.polite()
    with np.load(run.session.folder / "passes" / "front-001.npz") as stored:
        assert len(stored["range_m"]) > 100
    events = [item.content for item in recorder.read(run.session.capture) if hasattr(item, "content")]
    (missed,) = (event["missed_chunks"] for event in events if event["event"] == "recording goes on")
    assert missed > 20
    outcome = replay(run.session.capture, None, bench.folder / "out", None)
    assert outcome.cut is None
    assert (outcome.out / CALIBRATION).read_bytes() == (run.session.folder / CALIBRATION).read_bytes()


def test_a_capture_that_cannot_be_begun_opens_no_port(bench, monkeypatch):
    session = sessions.create(bench.config.state_dir, bench.config, None)
    run = Run(bench.config, session)

    def refuse(*_):
        raise RecorderError("full")

    monkeypatch.setattr(run._recorder, "event", refuse)
    with pytest.raises(RecorderError):
        run.begin()
    assert run.ended.is_set()
    run.stop("is nothing")
    other = Run(bench.config, sessions.create(bench.config.state_dir, bench.config, None))
    other.begin()  # the ports are free again
    other.stop("enough")


def test_a_bug_in_a_run_is_a_fault_that_says_so_and_bytes_go_on_being_recorded(
    bench, begin, until, monkeypatch
):
    run = begin(bench)
    monkeypatch.setattr(run._pipeline, "feed", lambda *_: 1 / 0)
    assert run.ended.wait(10.0)
    assert run.state is State.FAULT
    assert "ZeroDivisionError" in run.status()["notes"][0]
    assert bench.polite()
    assert recorder.read(run.session.capture).metadata


def test_a_device_that_cannot_be_made_leaves_no_capture_open(bench, monkeypatch):
    """Unraisable warnings would tell of it."""
    config = bench.config
    monkeypatch.setattr(SickLms, "__init__", lambda *_, **__: (_ for _ in ()).throw(DeviceError("no")))
    session = sessions.create(config.state_dir, config, None)
    with pytest.raises(DeviceError):
        Run(config, session)
    assert not session.capture.exists()


def test_several_problems_become_one_with_all_of_them():
    busy = DeviceBusy("/dev/a: another program holds it", "stop it")
    gone = DeviceNotFound("/dev/b: there is no such port", "plug it in")
    assert joined([busy]) is busy
    both = joined([busy, gone])
    assert isinstance(both, DeviceBusy)
    assert "/dev/a" in str(both)
    assert "/dev/b" in str(both)
    assert (busy.hint in both.hint, gone.hint in both.hint) == (True, True)


def test_stopping_does_not_wait_for_devices_that_are_gone(bench, begin, until):
    run = begin(bench)
    bench.served.close()
    until(lambda: states(run) == ["lost", "lost"])
    since_s = time.monotonic()
    run.stop("asked to stop")
    assert time.monotonic() - since_s < 10.0
    assert run.state is State.IDLE


def test_an_end_on_a_full_disk_is_no_fault_and_its_result_is_written_once_there_is_room(
    on_full_disk, bench, until
):
    disk, run = on_full_disk
    until(lambda: run._writer.full is not None)
    run.stop("asked to stop", calibrate=True)
    assert run.state is State.REJECTED
    status = run.status()
    assert status["lasers"][0]["estimate"] is not None
    assert f"not written: {CALIBRATION}" in status["notes"][0]
    written = run.session.folder / CALIBRATION
    assert not written.exists()
    (disk / "filler").unlink()
    until(written.exists)
    until(lambda: not run.notes)
    outcome = replay(run.session.capture, None, bench.folder / "out", None)
    assert (outcome.out / CALIBRATION).read_bytes() == written.read_bytes()


def test_status_answers_while_a_pass_waits_for_the_disk(bench, begin, until, monkeypatch):
    run = begin(bench)
    waiting, go = threading.Event(), threading.Event()

    def slow():
        waiting.set()
        assert go.wait(10.0)

    monkeypatch.setattr(run._writer, "sync", slow)
    assert waiting.wait(15.0)
    since_s = time.monotonic()
    assert run.status()["lasers"][0]["passes"] == 0  # nobody sees it before it is on the disk
    assert time.monotonic() - since_s < 1.0
    go.set()
    until(lambda: run.status()["lasers"][0]["passes"] == 1)
