"""A capture becomes an indexed one with the same messages, or stays as it is."""

import fcntl
import os
import shutil

import pytest
from mcap.reader import make_reader
from structlog.testing import capture_logs

from polecal.daemon import finalise as finalising
from polecal.daemon import recorder
from polecal.daemon.finalise import REPAIR, Finaliser, finalise, is_indexed
from polecal.daemon.recorder import Recorder, RecorderError
from polecal.daemon.replay import replay
from polecal.daemon.sessions import CALIBRATION

METADATA = {"session": "s1", "created": "2026-11-22T03:15:00+00:00", "config": "lasers: []\n"}


def session(state, name, count=200, *, close=True):
    """A session's folder with a capture that is closed, or has no footer."""
    folder = state / "sessions" / name
    (folder / "passes").mkdir(parents=True)
    writing = Recorder(folder / "capture.mcap", METADATA)
    for n in range(count):
        writing.write("front", "rx", 10**9 + n, bytes([n % 256]) * n)
        if n % 50 == 0:
            writing.event(10**9 + n, {"event": "state", "n": n})
    path = writing.path
    if close:
        writing.close()
    else:
        whole = path.read_bytes()
        writing.close()
        path.write_bytes(whole)
    return path


def test_the_messages_are_the_same_in_the_same_order_and_so_is_the_calibration(recorded, tmp_path):
    path = tmp_path / "capture.mcap"
    shutil.copyfile(recorded.session.capture, path)
    os.truncate(path, path.stat().st_size // 4)
    live = replay(path, None, tmp_path / "live", None)
    before = list(recorder.read(path))
    done = finalise(path)
    capture = recorder.read(path)
    assert list(capture) == before
    assert capture.cut is None
    assert done.messages == len(before)
    assert done.size_bytes[1] == path.stat().st_size
    assert is_indexed(path)
    assert not is_indexed(recorded.session.capture)
    outcome = replay(path, None, tmp_path / "out", None)
    assert (outcome.out / CALIBRATION).read_bytes() == (live.out / CALIBRATION).read_bytes()


def test_the_official_reader_finds_it_indexed_compressed_and_its_crcs_right(tmp_path):
    path = session(tmp_path, "a")
    before = list(recorder.read(path))
    finalise(path)
    with path.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        summary = reader.get_summary()
        seen = [
            (channel.topic, message.log_time, message.data) for _, channel, message in reader.iter_messages()
        ]
        (metadata,) = reader.iter_metadata()
    assert summary.statistics.message_count == len(seen) == len(before) == 204
    assert {index.compression for index in summary.chunk_indexes} == {"zstd"}
    raw = [(item.t_ns, item.data) for item in before if isinstance(item, recorder.Record)]
    assert [(t_ns, data) for topic, t_ns, data in seen if topic == "/front/rx"] == raw
    assert (metadata.name, metadata.metadata) == ("polecal", METADATA)


def test_a_daemon_finalises_at_its_start_and_when_a_session_ends(bench, running, until):
    from polecal.daemon.control import Client

    crashed = session(bench.folder / "state", "20261122T000000Z-crashed", close=False)
    with running(bench), Client(bench.config.socket, 60.0) as client:
        until(lambda: is_indexed(crashed), 60.0)
        assert client.request({"class": "START", "name": "yard"})["class"] == "STARTED"
        client.request({"class": "STOP"})
        log = bench.folder / "polecald.log"
        until(lambda: "capture repaired" in log.read_text() and "capture indexed" in log.read_text(), 60.0)
    assert len(bench.sessions) == 2
    assert all(is_indexed(folder / "capture.mcap") for folder in bench.sessions)


def test_one_that_was_cut_off_is_repaired_and_tells_so(tmp_path):
    path = session(tmp_path, "a", close=False)
    os.truncate(path, path.stat().st_size - 3)
    done = finalise(path)
    assert "is cut off" in done.recovered
    assert done.messages == 203
    with path.open("rb") as stream:
        told = {record.name: record.metadata for record in make_reader(stream).iter_metadata()}
    assert told[REPAIR] == {"recovered": done.recovered}
    assert not path.with_name("capture.mcap.damaged").exists()


def test_a_damaged_original_is_kept_beside(tmp_path):
    path = session(tmp_path, "a")
    whole = path.read_bytes()
    at = len(whole) // 2
    damaged = whole[:at] + bytes(300) + whole[at + 300 :]
    path.write_bytes(damaged)
    assert "is damaged" in finalise(path).recovered
    assert path.with_name("capture.mcap.damaged").read_bytes() == damaged
    assert recorder.read(path).metadata == METADATA


@pytest.mark.parametrize("fails", ["room", "write", "fsync", "read back", "rename"])
def test_whatever_fails_the_capture_stays_as_it_was(tmp_path, monkeypatch, fails):
    path = session(tmp_path, "a")
    before = path.read_bytes()

    def fail(*_, **__):
        raise OSError(28, "No space left on device")

    leave = 0
    match fails:
        case "room":
            leave = shutil.disk_usage(tmp_path).free
        case "write":
            monkeypatch.setattr(finalising, "_rewrite", fail)
        case "fsync":
            monkeypatch.setattr(os, "fsync", fail)
        case "read back":
            monkeypatch.setattr(finalising, "_digest", lambda _: b"another")
        case "rename":
            monkeypatch.setattr(type(path), "rename", fail)
    with pytest.raises(RecorderError, match=str(path)) as caught:
        finalise(path, leave)
    assert caught.value.hint
    assert path.read_bytes() == before
    assert sorted(os.listdir(path.parent)) == ["capture.mcap", "passes"]


def test_one_at_which_another_is_already_is_left_alone(tmp_path):
    path = session(tmp_path, "a")
    folder = os.open(path.parent, os.O_RDONLY)
    fcntl.flock(folder, fcntl.LOCK_EX)
    (path.parent / ".capture.mcap.part").write_bytes(b"what the other is writing")
    with pytest.raises(RecorderError, match="cannot be indexed"):
        finalise(path)
    os.close(folder)
    assert sorted(os.listdir(path.parent)) == [".capture.mcap.part", "capture.mcap", "passes"]
    assert not is_indexed(path)


def test_a_start_repairs_what_a_crash_left_and_says_what_it_recovered(tmp_path):
    closed = session(tmp_path, "a")
    crashed = session(tmp_path, "b", close=False)
    (crashed.parent / "passes" / "front-001.npz").write_bytes(b"a pass")
    (crashed.parent / "passes" / ".front-002.npz.part").write_bytes(b"half a pa")
    (crashed.parent / ".capture.mcap.part").write_bytes(b"half a capture")
    hopeless = session(tmp_path, "c")
    hopeless.write_bytes(b"")
    with capture_logs() as logs, Finaliser(tmp_path) as finaliser:
        finaliser.join()
    assert is_indexed(closed)
    assert is_indexed(crashed)
    assert hopeless.read_bytes() == b""
    said = {entry["event"]: entry for entry in logs}
    assert set(said) == {"capture indexed", "capture repaired", "capture stays as it was written"}
    repaired = said["capture repaired"]
    assert "is cut off" in repaired["recovered"]
    assert (repaired["capture"], repaired["messages"], repaired["passes"]) == (str(crashed), 204, 1)
    assert "no MCAP file" in said["capture stays as it was written"]["problem"]
    assert os.listdir(crashed.parent / "passes") == ["front-001.npz"]
    assert not (crashed.parent / ".capture.mcap.part").exists()


def test_one_that_is_closed_leaves_the_rest_to_the_next(tmp_path):
    path = session(tmp_path, "a")
    with capture_logs() as logs:
        with Finaliser(tmp_path / "nothing yet") as finaliser:
            finaliser.close()
            finaliser.add(path)
        assert not is_indexed(path)
        for _ in range(2):
            with Finaliser(tmp_path) as finaliser:
                finaliser.join()
    assert [entry["event"] for entry in logs] == ["capture indexed"]
    assert is_indexed(path)


def test_one_that_is_closed_by_a_run_is_finalised_too(tmp_path):
    with Finaliser(tmp_path) as finaliser, capture_logs():
        path = session(tmp_path, "a")
        finaliser.add(path)
        finaliser.join()
    assert is_indexed(path)
