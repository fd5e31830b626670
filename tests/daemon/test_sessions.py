"""Folders of sessions: whole files or none, and the last good calibration found again."""

import errno
import os
from dataclasses import fields

import numpy as np
import pytest
import yaml

from polecal.calib.estimate import split
from polecal.daemon import config as configuration
from polecal.daemon import sessions
from polecal.daemon.sessions import CALIBRATION, Session, SessionError


@pytest.fixture
def config(settings):
    return settings()


def full(*_):
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def test_a_session_is_a_folder_named_after_its_time_with_all_it_was_told(tmp_path, config):
    session = sessions.create(tmp_path, config, None)
    assert session.folder.parent == tmp_path / "sessions"
    assert session.id.endswith("Z-front")
    assert len(session.id) == len("20261122T031500Z-front")
    told = yaml.safe_load((session.folder / "session.yaml").read_text())
    assert told["session"] == session.id
    assert told["created"] == session.created
    assert configuration.loads(told["config"]) == config
    assert sessions.create(tmp_path, config, "yard").id.endswith("Z-yard")


def test_two_sessions_of_the_same_second_are_two(tmp_path, config):
    made = [sessions.create(tmp_path, config, "yard") for _ in range(4)]
    assert len({one.id for one in made}) == 4
    assert [one.id for one in made] == sorted(one.id for one in made)


def test_a_calibration_is_read_back_and_leaves_nothing_else(tmp_path, config):
    session = sessions.create(tmp_path, config, None)
    content = {"state": "accepted", "lasers": [{"cost_m": 0.1 + 0.2, "name": "café"}]}
    path = session.write_calibration(content)
    assert path == session.folder / CALIBRATION
    assert sessions.calibration_of(tmp_path, None) == content
    session.write_calibration(content | {"state": "rejected"})
    assert sessions.calibration_of(tmp_path, session.id)["state"] == "rejected"
    assert sorted(each.name for each in session.folder.iterdir()) == [CALIBRATION, "passes", "session.yaml"]


@pytest.mark.parametrize("broken", ["fsync", "rename"])
def test_a_file_that_cannot_be_finished_leaves_the_old_one_whole(tmp_path, config, monkeypatch, broken):
    session = sessions.create(tmp_path, config, None)
    session.write_calibration({"state": "accepted", "lasers": []})
    if broken == "fsync":
        monkeypatch.setattr(os, "fsync", full)
    else:
        monkeypatch.setattr(sessions.Path, "rename", full)
    with pytest.raises(SessionError, match="cannot be written: No space left on device") as caught:
        session.write_calibration({"state": "rejected"})
    assert caught.value.hint
    monkeypatch.undo()
    assert sessions.calibration_of(tmp_path, None) == {"state": "accepted", "lasers": []}
    assert sorted(each.name for each in session.folder.iterdir()) == [CALIBRATION, "passes", "session.yaml"]


def test_a_full_disk_says_so_with_a_hint(config, small_disk):
    disk = small_disk("64k")
    session = sessions.create(disk, config, None)
    with pytest.raises(SessionError, match="No space left on device") as caught:
        session.write_calibration({"state": "x" * 200_000})
    assert "room" in caught.value.hint
    assert not (session.folder / CALIBRATION).exists()
    assert not list(session.folder.glob(".*"))


def test_a_place_that_cannot_be_written_to_says_so_with_a_hint(tmp_path, config):
    (tmp_path / "sessions").write_text("in the way")
    with pytest.raises(SessionError, match="cannot be made") as caught:
        sessions.create(tmp_path, config, None)
    assert "state_dir" in caught.value.hint


def test_a_session_whose_folder_has_gone_says_so(tmp_path, config):
    session = Session(tmp_path / "gone" / "s1", "2026")
    with pytest.raises(SessionError, match="cannot be written") as caught:
        session.write_calibration({})
    assert caught.value.hint
    (tmp_path / "gone").write_text("a file where a folder was")
    with pytest.raises(SessionError, match="cannot be written"):
        session.write_calibration({})


def write(state_dir, name, state):
    folder = state_dir / "sessions" / name
    folder.mkdir(parents=True)
    if state is not None:
        (folder / CALIBRATION).write_text(yaml.safe_dump({"state": state, "lasers": [], "session": name}))


def test_the_last_accepted_one_is_found_or_the_one_named(tmp_path):
    write(tmp_path, "20260101T000000Z-front", "accepted")
    write(tmp_path, "20260102T000000Z-front", "accepted")
    write(tmp_path, "20260103T000000Z-front", "rejected")
    write(tmp_path, "20260104T000000Z-front", None)
    assert sessions.calibration_of(tmp_path, None)["session"] == "20260102T000000Z-front"
    assert sessions.calibration_of(tmp_path, "20260103T000000Z-front")["state"] == "rejected"
    with pytest.raises(SessionError, match="20260104T000000Z-front has no calibration"):
        sessions.calibration_of(tmp_path, "20260104T000000Z-front")


@pytest.mark.parametrize("damage", ["state: [", "\0", "a list", "state: accepted"])
def test_one_that_is_damaged_hides_none_before_it_and_is_told_where_it_is_named(tmp_path, damage):
    write(tmp_path, "20260101T000000Z-front", "accepted")
    write(tmp_path, "20260102T000000Z-front", "accepted")
    (tmp_path / "sessions" / "20260102T000000Z-front" / CALIBRATION).write_text(damage)
    assert sessions.calibration_of(tmp_path, None)["session"] == "20260101T000000Z-front"
    with pytest.raises(SessionError, match="20260102T000000Z-front/calibration") as caught:
        sessions.calibration_of(tmp_path, "20260102T000000Z-front")
    assert "polecal-field replay" in caught.value.hint


@pytest.mark.parametrize("name", [None, "20260103T000000Z-front", "../../etc", ""])
def test_where_none_was_accepted_it_says_so(tmp_path, name):
    with pytest.raises(SessionError) as caught:
        sessions.calibration_of(tmp_path, name)
    assert caught.value.hint
    write(tmp_path, "20260101T000000Z-front", "rejected")
    with pytest.raises(SessionError):
        sessions.calibration_of(tmp_path, name)


def test_a_stored_pass_has_its_times_returns_and_moments(recorded):
    files = sorted((recorded.session.folder / "passes").iterdir())
    stored = [one for _, one in recorded.played.passes]
    plain_bytes = sum(getattr(stored[0].returns, part.name).nbytes for part in fields(stored[0].returns))
    assert files[0].stat().st_size < 0.6 * plain_bytes
    assert [file.name for file in files] == [f"front-{one.id:03d}.npz" for one in stored]
    with np.load(files[0], allow_pickle=False) as file:
        one = stored[0]
        assert tuple(file["t_ns"]) == one.t_ns
        assert np.array_equal(file["gps_ns"], one.gps_ns)
        for name in ("range_m", "bearing_rad", "position_m", "rpy_rad", "kind", "velocity_mps", "rate_radps"):
            assert np.array_equal(file[name], getattr(one.returns, name))
        blocks = split(one.returns, 30)
        assert {tuple(row) for row in file["block_slice_kind"].tolist()} == {(s, int(k)) for s, k in blocks}
        assert file["block_count"].tolist() == [block.count for block in one.blocks.values()]
        for has, first, block in zip(
            file["block_features"], file["block_first"], one.blocks.values(), strict=True
        ):
            assert np.array_equal(first[has], block.first)
        assert np.array_equal(
            file["block_packed"], np.concatenate([block.packed for block in one.blocks.values()])
        )
