"""A capture run again: the same to the last digit, or as far as it goes."""

import json
import os
import shutil
import subprocess
import sys

import pytest
import yaml
from mcap.writer import Writer

from polecal import PolecalError
from polecal.daemon import config as configuration
from polecal.daemon.config import ConfigError
from polecal.daemon.recorder import Recorder, RecorderError
from polecal.daemon.replay import BEGIN, FINISH, replay
from polecal.daemon.sessions import CALIBRATION, SessionError


@pytest.fixture(scope="module")
def again(recorded, tmp_path_factory):
    """The folder and the status of a replay by the command, in a process where sets have another order."""
    out = tmp_path_factory.mktemp("again") / "out"
    command = [sys.executable, "-m", "polecal.daemon.field", "--json", "replay"]
    done = subprocess.run(
        [*command, str(recorded.session.capture), "--out", str(out)],
        env=os.environ | {"PYTHONHASHSEED": "12345", "PYTHONWARNINGS": "error"},
        capture_output=True,
        timeout=60,
        check=False,
    )
    assert (done.returncode, done.stderr) == (0, b"")
    return out, json.loads(done.stdout)


@pytest.fixture
def cut(recorded, tmp_path):
    """The capture, cut off after a part of its bytes."""

    def make(part):
        path = tmp_path / "cut.mcap"
        shutil.copyfile(recorded.session.capture, path)
        os.truncate(path, round(path.stat().st_size * part))
        return path

    return make


def test_it_gives_the_live_runs_calibration_byte_for_byte(recorded, again):
    out, _ = again
    assert (out / CALIBRATION).read_bytes() == (recorded.session.folder / CALIBRATION).read_bytes()


def test_it_never_writes_over_the_session_that_it_plays(recorded):
    before = (recorded.session.folder / CALIBRATION).read_bytes()
    with pytest.raises(SessionError, match="is the session itself") as caught:
        replay(recorded.session.capture, None, recorded.session.folder / "passes" / "..", None)
    assert caught.value.hint == "name another folder to write to"
    assert (recorded.session.folder / CALIBRATION).read_bytes() == before


def test_it_says_what_was_played_with_which_configuration(recorded, again):
    out, _ = again
    told = yaml.safe_load((out / "session.yaml").read_text())
    assert told == yaml.safe_load((recorded.session.folder / "session.yaml").read_text()) | {
        "captured_in": str(recorded.session.folder)
    }


def test_it_gives_the_same_passes_and_status(recorded, again):
    out, shown = again
    live = recorded.session.folder / "passes"
    assert sorted(path.name for path in (out / "passes").iterdir()) == sorted(
        path.name for path in live.iterdir()
    )
    status = recorded.played.pipeline.status()
    assert {key: shown[key] for key in status} == status
    assert [device["frames"] for device in shown["devices"]] == [
        recorded.played.pipeline.device(name)["frames"] for name in ("front", "span")
    ]


@pytest.mark.parametrize("part", [0.02, 0.45])
def test_a_cut_capture_is_used_as_far_as_it_goes_and_it_is_said_how_far(recorded, cut, tmp_path, part):
    outcome = replay(cut(part), None, tmp_path / "out", None)
    assert "is cut off" in outcome.cut
    assert f"of {round(recorded.session.capture.stat().st_size * part)} bytes" in outcome.cut
    live = recorded.played.laser()
    laser = outcome.status["lasers"][0]
    if part < 0.1:  # before the first pass is over
        assert outcome.result is None
        assert not (outcome.out / CALIBRATION).exists()
        assert (laser["passes"], outcome.accepted) == (0, False)
    else:
        assert 0 < laser["passes"] < live["passes"]
        assert not outcome.accepted
        assert yaml.safe_load((outcome.out / CALIBRATION).read_text()) == outcome.result


def test_another_configuration_may_be_tried_on_it(recorded, cut, tmp_path):
    other = yaml.safe_load(recorded_config(recorded))
    other["routine"]["slices_needed"] = 3
    other["lasers"][0]["hold"] = ["roll", "z"]
    path = tmp_path / "other.yaml"
    path.write_text(yaml.safe_dump(other))
    outcome = replay(cut(0.45), path, tmp_path / "out", None)
    laser = outcome.result["lasers"][0]
    assert laser["held"] == ["z", "roll"]
    assert laser["estimate"]["roll_deg"] == 0.0
    assert outcome.status["session"] == recorded.session.id


def recorded_config(recorded):
    return yaml.safe_load((recorded.session.folder / "session.yaml").read_text())["config"]


def test_without_a_place_named_it_goes_beside_the_capture_and_tells_how_far_it_is(cut):
    path = cut(0.3)
    told = []
    outcome = replay(path, None, None, told.append)
    assert told == sorted(told)
    assert (told[-1], len(told) > 10) == (1.0, True)
    assert outcome.out == path.parent / "replay"
    assert list((outcome.out / "passes").iterdir())


def short(path, config, *events, metadata=None):
    """A capture without bytes, but with some events."""
    told = {"session": "s1", "created": "2026-11-22T03:15:00+00:00", "config": configuration.dump(config)}
    with Recorder(path, told if metadata is None else metadata) as recorder:
        for t_ns, content in events:
            recorder.event(t_ns, content)
    return path


def test_an_end_that_the_operator_asked_for_is_part_of_it(settings, tmp_path):
    path = short(
        tmp_path / "c.mcap",
        settings(),
        (1, {"event": BEGIN}),
        (2, {"event": "state", "old": "idle", "new": "connecting", "why": "asked to start"}),
        (3, {"event": FINISH, "why": "asked to stop"}),
    )
    outcome = replay(path, None, None, None)
    assert outcome.status["state"] == "rejected"
    assert outcome.result is None


def test_a_run_that_never_began_is_idle(settings, tmp_path):
    outcome = replay(short(tmp_path / "c.mcap", settings()), None, None, None)
    assert (outcome.status["state"], outcome.accepted, outcome.result) == ("idle", False, None)


def test_a_file_that_is_no_capture_is_refused(tmp_path):
    path = tmp_path / "holiday.mcap"
    for content in (b"", b"\xff\xd8\xff\xe0 a photograph", b"\x89MCAP0\r\n" + bytes(100)):
        path.write_bytes(content)
        with pytest.raises(RecorderError) as caught:
            replay(path, None, tmp_path / "out", None)
        assert str(path) in str(caught.value)
        assert caught.value.hint
    with pytest.raises(RecorderError, match="No such file"):
        replay(tmp_path / "nowhere.mcap", None, None, None)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("lacking", ["session", "created", "config"])
def test_a_capture_that_does_not_say_all_that_is_needed_is_refused(settings, tmp_path, lacking):
    told = {"session": "s1", "created": "2026", "config": configuration.dump(settings())}
    del told[lacking]
    path = short(tmp_path / "c.mcap", settings(), metadata=told)
    with pytest.raises(RecorderError, match=lacking):
        replay(path, None, tmp_path / "out", None)


def test_a_bad_configuration_is_refused_with_its_faults(settings, tmp_path):
    path = short(tmp_path / "c.mcap", settings())
    bad = tmp_path / "bad.yaml"
    bad.write_text("lasers: []\n")
    with pytest.raises(ConfigError) as caught:
        replay(path, bad, tmp_path / "out", None)
    assert len(caught.value.faults) == 3


def test_a_place_that_cannot_be_written_to_says_so(settings, tmp_path):
    path = short(tmp_path / "c.mcap", settings(), (1, {"event": BEGIN}))
    (tmp_path / "out").write_text("in the way")
    with pytest.raises(SessionError, match="out") as caught:
        replay(path, None, tmp_path / "out", None)
    assert caught.value.hint


def test_a_flipped_bit_anywhere_is_told_and_what_is_whole_is_used(settings, tmp_path):
    path = short(
        tmp_path / "c.mcap",
        settings(),
        (10**9, {"event": BEGIN}),
        (2 * 10**9, {"event": "tick"}),
        (3 * 10**9, {"event": FINISH, "why": "asked to stop"}),
    )
    whole = path.read_bytes()
    damaged = tmp_path / "damaged.mcap"
    end = whole.index(b"\x0f\x04" + bytes(7))  # DataEnd
    used, hints = 0, []
    for at in range(0, len(whole), 5):
        damaged.write_bytes(whole[:at] + bytes([whole[at] ^ 1 << at % 8]) + whole[at + 1 :])
        try:
            outcome = replay(damaged, None, tmp_path / "out", None)
        except PolecalError as error:
            hints.append(error.hint)
        else:
            assert (outcome.cut is not None) or at > end  # behind it is nothing that is used
            used += 1
    assert min(used, len(hints)) > 10
    assert all(hints)


@pytest.mark.parametrize("content", [[1], {"event": FINISH}, {"event": BEGIN, "past": 7}])
def test_an_event_that_makes_no_sense_is_told_and_the_rest_is_used(settings, tmp_path, content):
    path = short(tmp_path / "c.mcap", settings(), (1, {"event": BEGIN}), (2, content))
    outcome = replay(path, None, tmp_path / "out", None)
    assert "makes no sense" in outcome.cut or "is damaged" in outcome.cut
    assert outcome.status["state"] == "rejected"


def test_a_folder_without_a_capture_and_another_programs_are_refused(tmp_path):
    other = tmp_path / "other.mcap"
    with other.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        writer.add_message(writer.register_channel("/chatter", "json", 0), 1, b"{}", 1)
        writer.finish()
    for path, says in ((tmp_path / "nothing", "no capture"), (other, "not recorded by polecal")):
        (tmp_path / "nothing").mkdir(exist_ok=True)
        with pytest.raises(RecorderError, match=says) as caught:
            replay(path, None, tmp_path / "out", None)
        assert caught.value.hint
    assert not (tmp_path / "out").exists()
