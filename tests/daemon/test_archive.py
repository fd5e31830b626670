"""Sessions that are over: read back, and gone on with on another day, where the pole stands elsewhere."""

import os
import shutil
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import yaml

from polecal.daemon import archive, sessions
from polecal.daemon import pipeline as pipelines
from polecal.daemon.config import Config
from polecal.daemon.control import Code, Refused
from polecal.daemon.passes import most_of_one
from polecal.daemon.pipeline import Pipeline
from polecal.daemon.recorder import Recorder
from polecal.daemon.replay import BEGIN, CHOICE, FINISH, replay
from polecal.daemon.sessions import CALIBRATION, FACTS, QUALITY, SessionError, captures_of
from polecal.daemon.spill import Spill
from polecal.daemon.transfer import export_dumps
from polecal.drivers.emulated.world import demo_world

HER = {"by": "ann", "at": "2026-11-22T03:17:00+00:00"}
REBOOT_NS = 990_000_000_000  # the second day's host clock starts from anew


@pytest.fixture(scope="module")
def days(drive, streaming):
    """Two days of half a drive each: another pole place, another height of ground, another host clock."""
    first = drive.until(75.0)
    world = demo_world(1)
    north, east = world.pole_ne_m
    world.pole_ne_m = (north + 0.4, east - 0.3)
    world.ground_z_m += 0.2
    later = [chunk for chunk in streaming(world, 150.0) if chunk[1] > first[-1][1]]
    return first, [(device, t_ns - REBOOT_NS, data) for device, t_ns, data in later]


def day(config, session, past, chunks, *, drop=None, heard=None):
    """Record a day as the daemon does, and finish it, unless killed after so many passes were ``heard``."""
    pipeline = Pipeline(config, session=session.id, created=session.created, on_pass=session.write_pass)
    with Recorder(session.capture, session.metadata(config)) as recorder:
        t_ns = chunks[0][1]
        recorder.event(t_ns, {"event": BEGIN} | ({} if past is None else {"past": past.as_event()}))
        pipeline.begin(t_ns, past)
        for device, t_ns, data in chunks:
            recorder.write(device, "rx", t_ns, data)
            if heard is not None and len(pipeline.passes()) >= heard:
                continue
            pipeline.feed(device, t_ns, data)
            if drop is not None and any(row["pass"] == drop for row in pipeline.passes()):
                choice = pipeline.choice(drop, drop=True, **HER)
                recorder.event(t_ns, {"event": CHOICE, "choice": choice.as_dict()})
                pipeline.choose(t_ns, choice)
                drop = None
        if heard is None:
            recorder.event(t_ns, {"event": FINISH, "why": "asked to stop"})
            pipeline.finish(t_ns, "asked to stop")
            session.write_calibration(pipeline.calibration())
    return pipeline


@dataclass(frozen=True)
class Resumed:
    """A session of two days, and its pipeline on the second."""

    folder: Path
    config: Config
    second: Pipeline

    def calibration(self):
        return (self.folder / CALIBRATION).read_bytes()


@pytest.fixture(scope="module")
def resumed(days, settings, tmp_path_factory):
    """The first day was finished, and a pass dropped after that; on the second, another while it ran."""
    config = settings(state_dir=str(tmp_path_factory.mktemp("state")))
    first = sessions.create(config.state_dir, config, "two days")
    day(config, first, None, days[0])
    archive.choose(first.folder, "4", drop=True, **HER)
    session, past = archive.resume(first.folder, config)
    numbers = [one.id for one in past.passes["front"]]
    return Resumed(first.folder, config, day(config, session, past, days[1], drop=max(numbers) + 2))


def test_the_second_day_goes_on_with_the_passes_of_the_first(resumed):
    rows = resumed.second.passes()
    assert [row["pass"] for row in rows] == list(range(1, len(rows) + 1))
    sites = [row["site"] for row in rows]
    assert sites == sorted(sites)
    assert set(sites) == {0, 1}
    entry = resumed.second.status()["lasers"][0]
    assert entry["earlier_passes"] == sites.count(0)
    assert entry["dropped_passes"] == [4, sites.count(0) + 2]
    assert sum(row["use"] == "used" for row in rows) == entry["passes"] > 10
    assert [path.name for path in captures_of(resumed.folder)] == ["capture.mcap", "capture-2.mcap"]
    files = sorted(path.stem for path in (resumed.folder / "passes").iterdir())
    assert files == [row["name"] for row in rows]


def test_though_the_pole_and_the_ground_were_elsewhere_the_mount_is_right(resumed, drive):
    entry = resumed.second.calibration()["lasers"][0]
    assert entry["cost_m"] < 0.05
    found = {name: entry["estimate"][name] for name in ("x_m", "y_m", "roll_deg", "pitch_deg", "yaw_deg")}
    true = asdict(drive.world.mount)
    for name, value in found.items():
        assert value == pytest.approx(true[name], abs=0.03 if name.endswith("_m") else 0.2), name
    poles = [each for each in entry["reflectors"] if each["is_pole"]]
    assert sorted(each["site"] for each in poles) == [0, 1]


@pytest.mark.parametrize("named", ["", "capture.mcap", "capture-2.mcap"])
def test_a_replay_plays_both_days_and_gives_the_same_byte_for_byte(resumed, tmp_path, named):
    outcome = replay(resumed.folder / named, None, tmp_path / "out", None)
    assert outcome.cut is None
    assert (tmp_path / "out" / CALIBRATION).read_bytes() == resumed.calibration()
    live = resumed.folder / "passes"
    assert {path.name for path in (tmp_path / "out" / "passes").iterdir()} == set(os.listdir(live))


def test_what_is_dropped_after_the_second_day_is_dropped_in_a_replay(resumed, tmp_path):
    folder = tmp_path / resumed.folder.name
    shutil.copytree(resumed.folder, folder)
    archive.choose(folder, "1", drop=True, **HER)
    archive.choose(folder, "4", drop=False, **HER)
    content = yaml.safe_load((folder / CALIBRATION).read_text())
    assert [(each["number"], each["ended"]) for each in content["choices"][-2:]] == [(1, True), (4, True)]
    replay(folder, None, tmp_path / "out", None)
    assert (tmp_path / "out" / CALIBRATION).read_bytes() == (folder / CALIBRATION).read_bytes()


def test_of_a_lone_second_day_it_is_said_what_is_lacking(resumed, tmp_path):
    shutil.copy(resumed.folder / "capture-2.mcap", tmp_path)
    outcome = replay(tmp_path / "capture-2.mcap", None, None, None)
    assert "passes of earlier days are not in it: name the session's folder" in outcome.cut
    assert 0 < outcome.status["lasers"][0]["passes"] < resumed.second.status()["lasers"][0]["passes"]


def test_each_days_dumps_go_into_a_folder_of_their_own(resumed, tmp_path):
    paths = export_dumps(resumed.folder, tmp_path / "out")
    assert {path.parent.name for path in paths} == {"capture", "capture-2"}
    assert {path.name for path in paths} == {"front.bin", "span.bin"}


def test_a_day_that_was_killed_is_gone_on_with_and_replayed_the_same(days, settings, tmp_path):
    """What its capture gives beyond what it knew is not made up afterwards."""
    config = settings(state_dir=str(tmp_path))
    first = sessions.create(config.state_dir, config, "killed")
    day(config, first, None, days[0], drop=1, heard=4)
    _, reopened = archive.reopen(first.folder)
    assert reopened.status()["lasers"][0]["dropped_passes"] == [1]
    with pytest.raises(Refused, match="while the session is idle") as caught:
        archive.choose(first.folder, "2", drop=True, **HER)
    assert "--continue" in caught.value.hint
    session, past = archive.resume(first.folder, config)
    assert [one.id for one in past.passes["front"]] == [1, 2, 3, 4]
    second = day(config, session, past, days[1])
    assert second.status()["lasers"][0]["dropped_passes"] == [1]
    replay(first.folder, None, tmp_path / "out", None)
    assert (tmp_path / "out" / CALIBRATION).read_bytes() == (first.folder / CALIBRATION).read_bytes()
    names = {path.name for path in (tmp_path / "out" / "passes").iterdir()}
    assert names == set(os.listdir(first.folder / "passes"))


@pytest.mark.parametrize(
    ("key", "value", "named"),
    [
        ("pole", {"radius_m": 0.05, "height_m": 2.4}, "pole.radius_m"),
        ("routine", {"slice_deg": 45, "slices_needed": 8}, "routine.slice_deg"),
    ],
)
def test_with_another_configuration_a_session_is_not_gone_on_with(recorded, settings, key, value, named):
    with pytest.raises(Refused, match=named) as caught:
        archive.resume(recorded.session.folder, settings(**{key: value}))
    assert caught.value.code == Code.CONFIG
    assert "session.yaml" in caught.value.hint


def test_passes_of_all_days_together_are_as_many_as_there_may_be(days, settings, tmp_path):
    config = settings(state_dir=str(tmp_path / "state"), routine={"max_passes": 7})
    first = sessions.create(config.state_dir, config, "two days")
    earlier = day(config, first, None, days[0][: len(days[0]) // 2])
    assert 0 < len(earlier.passes()) < 7
    session, past = archive.resume(first.folder, config)
    pipeline = day(config, session, past, days[1])
    assert most_of_one(pipeline._lasers["front"].passes) == 7
    reasons = pipeline.calibration()["lasers"][0]["verdict"]["reasons"]
    assert any("7 passes, still not" in reason for reason in reasons)
    with pytest.raises(Refused, match="all of the 7 passes of front") as caught:
        archive.resume(first.folder, config)
    assert "begin a new session" in caught.value.hint


def test_with_all_sums_on_the_disk_both_days_come_to_the_same(resumed, tmp_path, monkeypatch):
    for module in (archive, pipelines):
        monkeypatch.setattr(module, "Spill", partial(Spill, in_memory_bytes=0))
    replay(resumed.folder, None, tmp_path / "out", None)
    assert (tmp_path / "out" / CALIBRATION).read_bytes() == resumed.calibration()
    (front,) = archive.past_of(resumed.folder).passes.values()
    assert all(callable(of.held) for one in front for of in one.moments.totals.values())
    _, reopened = archive.reopen(resumed.folder)
    assert reopened.calibration()["lasers"] == resumed.second.calibration()["lasers"]


def test_with_other_ports_and_folders_it_is(recorded, settings, tmp_path):
    other = settings(
        laser={"port": "/dev/ttyUSB7"}, navigation={"port": "/dev/ttyUSB8"}, state_dir=str(tmp_path)
    )
    session, past = archive.resume(recorded.session.folder, other)
    assert session.capture.name == "capture-2.mcap"
    assert session.created == recorded.session.created
    assert len(past.passes["front"]) == len(recorded.played.passes)


def test_a_session_whose_capture_was_taken_away_is_not_opened(recorded, tmp_path):
    folder = tmp_path / "session"
    shutil.copytree(recorded.session.folder, folder, ignore=shutil.ignore_patterns("*.mcap", "replay"))
    with pytest.raises(SessionError, match="has no capture") as caught:
        archive.reopen(folder)
    assert caught.value.hint == "bring its capture.mcap back"


def test_a_pass_is_read_back_as_it_was(recorded):
    past = archive.past_of(recorded.session.folder)
    for read, (_, stored) in zip(past.passes["front"], recorded.played.passes, strict=True):
        assert (read.id, read.place, read.t_ns) == (stored.id, stored.place, stored.t_ns)
        assert (read.facts, read.quality) == (stored.facts, stored.quality)
        assert read.moments.counts == stored.moments.counts
        for kind, mine in read.moments.totals.items():
            its = stored.moments.totals[kind]
            assert mine.count == its.count
            assert np.array_equal(mine.features, its.features)
            assert np.array_equal(mine.first, its.first)
            assert np.array_equal(mine.packed, its.packed)


def test_a_pass_of_an_older_version_is_read_too(recorded, tmp_path):
    path = sorted((recorded.session.folder / "passes").iterdir())[0]
    new = {*FACTS, *QUALITY, "laser", "site", "utc", "block_features", "block_packed"}
    stored = recorded.played.passes[0][1]
    whole = np.zeros((len(stored.blocks), 108, 108))
    for second, block in zip(whole, stored.blocks.values(), strict=True):
        second[np.ix_(block.features, block.features)] = block.second
    with np.load(path) as file:
        old = {name: file[name] for name in file if name not in new}
        np.savez_compressed(tmp_path / path.name, **old, block_second=whole)
    mine, its = archive.read_pass(path), archive.read_pass(tmp_path / path.name)
    assert its.facts == mine.facts
    assert its.moments.counts == mine.moments.counts
    for kind, total in mine.moments.totals.items():
        assert np.array_equal(its.moments.totals[kind].first[total.features], total.first)
        left = its.moments.totals[kind] - total
        assert not left.packed.any()
    assert its.quality.ins_status is None
    assert its.moments.site == 0


@pytest.mark.parametrize("damage", [b"", b"PK\x03\x04 half a pass", None])
def test_a_pass_that_is_damaged_is_named_with_what_to_do(recorded, tmp_path, damage):
    path = tmp_path / "front-001.npz"
    if damage is None:
        np.savez(path, t_ns=[1, 2])
    else:
        path.write_bytes(damage)
    with pytest.raises(SessionError, match=r"front-001\.npz: cannot be read") as caught:
        archive.read_pass(path)
    assert "replay" in caught.value.hint


@pytest.mark.parametrize("name", ["nowhere", "", None, 7, "../sessions", ".", "away"])
def test_a_session_that_is_not_there_is_refused(tmp_path, name):
    (tmp_path / "sessions").mkdir()
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "sessions" / "away").symlink_to(tmp_path / "elsewhere")
    with pytest.raises(Refused, match="there is no session") as caught:
        archive.find(tmp_path, name)
    assert caught.value.hint
