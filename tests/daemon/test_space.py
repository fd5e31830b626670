"""Room on the disk: the oldest sessions go that were not accepted, and no other."""

import shutil
from contextlib import suppress

import pytest
import yaml
from structlog.testing import capture_logs

from polecal.daemon import sessions
from polecal.daemon.config import ConfigError, Storage
from polecal.daemon.recorder import DiskFull
from polecal.daemon.run import Run
from polecal.daemon.service import Service
from polecal.daemon.space import Space
from polecal.drivers.errors import DeviceNotFound

MB = 1_000_000
STATES = {"1-old": None, "2-accepted": "accepted", "3-rejected": "rejected", "4-odd": "", "5-now": None}


@pytest.fixture
def state(tmp_path):
    """Five sessions of a MB each, oldest first."""
    for name, verdict in STATES.items():
        folder = tmp_path / "sessions" / name
        (folder / "passes").mkdir(parents=True)
        (folder / "capture.mcap").write_bytes(bytes(MB - 100_000))
        (folder / "passes" / "front-001.npz").write_bytes(bytes(90_000))
        if verdict is not None:
            text = yaml.safe_dump({"state": verdict}) if verdict else "\0 no YAML"
            (folder / "calibration.yaml").write_text(text)
    return tmp_path


def left(state):
    return sorted(path.name for path in (state / "sessions").iterdir())


@pytest.mark.parametrize(
    ("quota_mb", "gone"), [(None, []), (6, []), (4, ["1-old"]), (3, ["1-old", "3-rejected"])]
)
def test_a_quota_takes_the_oldest_that_were_not_accepted(state, quota_mb, gone):
    with capture_logs() as logs:
        assert Space(state, Storage(min_free_mb=1, quota_mb=quota_mb)).make_room("5-now") is None
    assert left(state) == [name for name in STATES if name not in gone]
    assert [entry["session"] for entry in logs] == gone


def test_neither_the_running_one_nor_accepted_ones_nor_unreadable_results_ever_go(state):
    Space(state, Storage(min_free_mb=1, quota_mb=1)).make_room("5-now")
    assert left(state) == ["2-accepted", "4-odd", "5-now"]


def test_a_floor_takes_only_as_many_as_are_needed_and_is_told_where_it_cannot_be_kept(state, monkeypatch):
    space = Space(state, Storage(min_free_mb=10))
    full = {name: 9_500_000 for name in STATES}
    monkeypatch.setattr(
        Space, "_free_bytes", lambda self: full["5-now"] + MB * (len(STATES) - len(left(state)))
    )
    assert "only 10 MB" in space.lacking()
    assert space.make_room("5-now") is None
    assert left(state) == [name for name in STATES if name != "1-old"]
    full["5-now"] = 0
    assert space.make_room("5-now") == "only 2 MB are free on the disk, of 10 that must be"
    assert left(state) == ["2-accepted", "4-odd", "5-now"]


def test_what_makes_no_sense_is_a_fault(settings):
    with pytest.raises(ConfigError, match=r"storage\.min_free_mb"):
        settings(storage={"min_free_mb": 0})
    assert settings(storage={"quota_mb": 5000}).storage == Storage(min_free_mb=200, quota_mb=5000)


def fill(disk):
    """Leave no room at all."""
    with (disk / "filler").open("wb", buffering=0) as file, suppress(OSError):
        for size in (1 << 16, 1 << 9):
            with suppress(OSError):
                while True:
                    file.write(bytes(size))
    return disk / "filler"


def test_a_pass_that_is_closed_on_a_full_disk_is_written_once_there_is_room(recorded, settings, small_disk):
    disk = small_disk("3m")
    config = settings(state_dir=str(disk), storage={"min_free_mb": 1})
    run = Run(config, sessions.create(config.state_dir, config, None))
    filler = fill(disk)
    laser, stored = recorded.played.passes[0]
    run._store(laser, stored)
    passes = run.session.folder / "passes"
    assert not list(passes.iterdir())
    assert "not written: pass 1 of front" in run.status()["notes"][0]
    filler.unlink()
    run._write()
    assert [path.name for path in passes.iterdir()] == ["front-001.npz"]
    assert not any("not written" in note for note in run.status()["notes"])
    run._recorder.close()


def test_a_session_that_starts_below_the_floor_makes_room_first_or_is_refused(state, small_disk, settings):
    disk = small_disk("8m")
    shutil.copytree(state / "sessions", disk / "sessions")
    config = settings(state_dir=str(disk), storage={"min_free_mb": 4})
    fill(disk)
    with pytest.raises(DiskFull, match="of 4 that must be") as caught:
        Service(config).handle({"class": "START"})
    assert "accepted" in caught.value.hint
    assert left(disk) == ["2-accepted", "4-odd"]
    (disk / "filler").unlink()
    with pytest.raises(DeviceNotFound):  # there is room, and no port in this configuration
        Service(config).handle({"class": "START"})
    assert left(disk) == ["2-accepted", "4-odd"]


def test_a_start_on_a_disk_without_any_room_left_removes_what_it_may(state, small_disk, settings):
    disk = small_disk("8m")
    shutil.copytree(state / "sessions", disk / "sessions")
    fill(disk)
    config = settings(state_dir=str(disk), storage={"min_free_mb": 1})
    with pytest.raises(DeviceNotFound):
        Service(config).handle({"class": "START"})
    assert left(disk) == ["2-accepted", "4-odd", "5-now"]


def test_a_quota_that_the_running_session_itself_exceeds_is_told_and_no_reason_to_stop(state):
    space = Space(state, Storage(min_free_mb=1, quota_mb=2))
    with capture_logs() as logs:
        assert [space.make_room("5-now") for _ in range(2)] == [None, None]
    assert left(state) == ["2-accepted", "4-odd", "5-now"]
    assert space.over.startswith("sessions take 3 MB, of 2 that they may")
    assert [entry["event"] for entry in logs] == ["session removed for room"] * 2 + ["quota exceeded"]
    shutil.rmtree(state / "sessions" / "2-accepted")
    assert space.make_room("5-now") is None
    assert space.over is None


def test_what_is_left_is_told_in_time_once_the_pace_is_known(state):
    capture = state / "sessions" / "5-now" / "capture.mcap"
    space = Space(state, Storage(min_free_mb=1))
    free_mb = shutil.disk_usage(state).free // MB
    early, later = space.left(capture, 3.0), space.left(capture, 90.0)  # 0.9 MB in 90 s
    assert early is not None
    assert later is not None
    assert early["left_s"] is None
    assert later["left_s"] == pytest.approx(free_mb * 100, rel=0.01)
    assert later["free_mb"] == pytest.approx(free_mb, rel=0.01)
    assert space.left(state / "gone", 90.0) is None
