"""Passes dropped and kept: at once, honestly, and the same again in a replay."""

import shutil
from itertools import pairwise

import numpy as np
import pytest
import yaml

from polecal.daemon import archive, sessions
from polecal.daemon.choices import Choice, meant, parse_name
from polecal.daemon.control import Code, Refused
from polecal.daemon.pipeline import Pipeline
from polecal.daemon.recorder import Recorder
from polecal.daemon.replay import BEGIN, CHOICE, FINISH, replay
from polecal.daemon.routine import State
from polecal.daemon.sessions import CALIBRATION

T0_NS = 1_000_000_000_000
HER = {"by": "ann", "at": "2026-11-22T03:17:00+00:00"}


@pytest.mark.parametrize(
    ("said", "lasers", "meant"),
    [
        ("7", ["front"], ("front", 7)),
        (7, ["front"], ("front", 7)),
        ("front-007", ["front", "rear"], ("front", 7)),
        ("rear-12", ["front", "rear"], ("rear", 12)),
        ("rear-left-003", ["rear-left", "rear"], ("rear-left", 3)),
    ],
)
def test_a_pass_is_named_by_its_number_or_with_its_laser(said, lasers, meant):
    assert parse_name(said, lasers) == meant


@pytest.mark.parametrize("said", ["", "seven", None, -1, 7.5, ["7"], "side-007", "front-", "7" * 9])
def test_what_names_no_pass_is_refused_with_how_to_name_one(said):
    with pytest.raises(Refused) as caught:
        parse_name(said, ["front"])
    assert caught.value.code == Code.USAGE
    assert "front" in caught.value.hint


def test_of_several_lasers_it_must_be_said_which():
    with pytest.raises(Refused, match="any of 2 lasers") as caught:
        parse_name("7", ["front", "rear"])
    assert "front-007 or rear-007" in caught.value.hint


@pytest.fixture(scope="module")
def chosen(drive, settings, tmp_path_factory):
    """A session in which passes were dropped and kept while it ran; its folder, and what was answered."""
    config = settings(state_dir=str(tmp_path_factory.mktemp("state")))
    session = sessions.create(config.state_dir, config, "choosy")
    pipeline = Pipeline(config, session=session.id, created=session.created, on_pass=session.write_pass)
    wishes = [(3, "3", True), (5, "front-004", True), (8, "3", False)]  # once there are so many passes
    answers = []
    with Recorder(session.capture, session.metadata(config)) as recorder:
        recorder.event(T0_NS, {"event": BEGIN})
        pipeline.begin(T0_NS)
        for device, t_ns, data in drive.until(110.0):
            recorder.write(device, "rx", t_ns, data)
            pipeline.feed(device, t_ns, data)
            if wishes and len(pipeline.passes()) >= wishes[0][0]:
                _, said, drop = wishes.pop(0)
                choice = pipeline.choice(said, drop=drop, **HER)
                recorder.event(t_ns, {"event": CHOICE, "choice": choice.as_dict()})
                answers.append(pipeline.choose(t_ns, choice))
        recorder.event(t_ns, {"event": FINISH, "why": "asked to stop"})
        pipeline.finish(t_ns, "asked to stop")
    assert not wishes
    session.write_calibration(pipeline.calibration())
    return session, pipeline, answers


def test_a_dropped_pass_counts_no_more_and_what_changed_is_said(chosen):
    _, pipeline, (first, second, third) = chosen
    assert (first["name"], first["dropped"]) == ("front-003", True)
    assert (first["before"]["passes"], first["after"]["passes"]) == (
        2,
        1,
    )  # front-002 is of another reflector
    assert first["before"]["estimate"] != first["after"]["estimate"]
    assert first["slices_lost"]
    assert first["slices_won"] == []
    assert second["after"]["passes"] == second["before"]["passes"] - 1
    assert third["after"]["passes"] == third["before"]["passes"] + 1
    assert first["slices_lost"] == third["slices_won"]
    rows = {row["pass"]: row for row in pipeline.passes()}
    assert rows[3]["use"] == "used"
    assert (rows[4]["use"], rows[4]["why"]) == ("dropped", "by ann, 2026-11-22T03:17:00+00:00")
    assert pipeline.status()["lasers"][0]["dropped_passes"] == [4]
    assert rows[4]["cost_m"] > 0, "how far off it would be is told all the same"


def test_it_is_what_would_have_come_without_the_pass(chosen, drive, settings):
    """Dropped moments leave nothing behind."""
    session, pipeline, _ = chosen
    past = archive.past_of(session.folder)
    few = {"front": [one for one in past.passes["front"] if one.id != 4]}
    other = Pipeline(settings())
    other.reopen(type(past)(1, few, past.poles), 0)
    keys = ("estimate", "sigma", "cost_m", "coverage")
    mine, its = (each.status()["lasers"][0] for each in (pipeline, other))
    assert {key: mine[key] for key in keys} == {key: its[key] for key in keys}


def test_a_replay_gives_the_same_calibration_byte_for_byte(chosen, tmp_path):
    session, _, _ = chosen
    outcome = replay(session.folder, None, tmp_path / "out", None)
    assert (tmp_path / "out" / CALIBRATION).read_bytes() == (session.folder / CALIBRATION).read_bytes()
    assert outcome.cut is None
    assert [each["number"] for each in outcome.result["choices"]] == [3, 4, 3]
    assert outcome.status["lasers"][0]["dropped_passes"] == [4]


def test_a_pass_that_is_not_there_or_so_already_is_refused_with_what_there_is(chosen):
    _, pipeline, _ = chosen
    with pytest.raises(Refused, match="no pass front-099") as caught:
        pipeline.choice("99", drop=True, **HER)
    assert "front-001, front-002" in caught.value.hint
    with pytest.raises(Refused, match="front-004 was dropped already, by ann"):
        pipeline.choice("4", drop=True, **HER)
    with pytest.raises(Refused, match="front-003 is not dropped"):
        pipeline.choice("3", drop=False, **HER)


def test_before_a_run_nothing_can_be_dropped(settings):
    with pytest.raises(Refused, match="while the session is idle") as caught:
        Pipeline(settings()).choice("1", drop=True, **HER)
    assert caught.value.hint


@pytest.fixture
def over(recorded, tmp_path):
    """A session that was accepted, in another life of the daemon."""
    folder = tmp_path / "sessions" / recorded.session.id
    shutil.copytree(recorded.session.folder, folder)
    return folder


def content(folder):
    return yaml.safe_load((folder / CALIBRATION).read_text())


def test_of_an_accepted_session_a_drop_that_leaves_too_little_makes_a_rejected_one(over, tmp_path):
    before = (over / CALIBRATION).read_bytes()
    used = [row["pass"] for row in archive.reopen(over)[1].passes() if row["use"] == "used"]
    changes = [archive.choose(over, str(number), drop=True, **HER) for number in used[:4]]
    assert changes[0]["before"]["state"] == "accepted"
    for one, next_one in pairwise(changes):
        assert one["after"] == next_one["before"]
    lost = sorted(part for one in changes for part in one["slices_lost"])
    assert lost
    assert changes[-1]["after"]["state"] == content(over)["state"] == "rejected"
    reasons = content(over)["lasers"][0]["verdict"]["reasons"]
    assert any(f"{lost[0]}" in reason and reason.startswith("slice") for reason in reasons)
    replay(over / "capture.mcap", None, tmp_path / "again", None)
    assert (tmp_path / "again" / CALIBRATION).read_bytes() == (over / CALIBRATION).read_bytes()
    for number in used[:4]:
        archive.choose(over, number, drop=False, **HER)
    now = content(over)
    assert now["state"] == "accepted"
    assert len(now["choices"]) == 8
    assert now | {"choices": []} == yaml.safe_load(before), "all taken back: as if nothing had been"


def test_the_last_pass_of_an_ended_session_stays(over):
    _, pipeline = archive.reopen(over)
    passes = [row["pass"] for row in pipeline.passes() if row["use"] != "other reflector"]
    for number in passes[:-1]:
        pipeline.choose(0, pipeline.choice(number, drop=True, **HER))
    before = pipeline.calibration()
    with pytest.raises(Refused, match="nothing left to calibrate from") as caught:
        pipeline.choose(0, pipeline.choice(passes[-1], drop=True, **HER))
    assert caught.value.hint
    assert pipeline.calibration() == before


def test_an_old_session_stands_where_it_ended_to_the_last_bit(over):
    before = (over / CALIBRATION).read_bytes()
    session, pipeline = archive.reopen(over)
    assert pipeline.routine.state is State.ACCEPTED
    session.write_calibration(pipeline.calibration())
    assert (over / CALIBRATION).read_bytes() == before


def test_the_pass_is_known_by_its_time_where_it_has_another_number(chosen):
    session, _, _ = chosen
    passes = archive.past_of(session.folder).passes["front"]
    third = passes[2]
    first_ns, last_ns = third.t_ns

    def choice(number, t_ns, site=0):
        return Choice("front", number, True, "ann", "", site, t_ns)

    assert meant(choice(3, third.t_ns), passes) == 3
    assert meant(choice(7, (first_ns + 10, last_ns + 10)), passes) == 3
    assert meant(choice(3, (first_ns - 10**12, first_ns - 10**11)), passes) is None
    assert meant(choice(3, third.t_ns, site=1), passes) is None


def test_with_another_configuration_the_same_passes_are_dropped(chosen, tmp_path):
    session, _, _ = chosen
    other = yaml.safe_load(yaml.safe_load((session.folder / "session.yaml").read_text())["config"])
    other["lasers"][0]["hold"] = ["roll"]
    other["routine"]["slice_deg"] = 45
    other["routine"]["slices_needed"] = 8
    (tmp_path / "other.yaml").write_text(yaml.safe_dump(other))
    outcome = replay(session.folder, tmp_path / "other.yaml", tmp_path / "out", None)
    assert outcome.status["lasers"][0]["dropped_passes"] == [4]
    assert "roll" in outcome.result["lasers"][0]["held"]
    assert len(outcome.result["lasers"][0]["coverage"]) == 8


def test_a_row_says_what_was_driven(chosen):
    _, pipeline, _ = chosen
    rows = [row for row in pipeline.passes() if row["use"] != "other reflector"]
    assert len(rows) > 8
    for row in rows:
        seconds = (np.array(row["t_ns"]) - T0_NS) / 1e9
        assert 0.5 < seconds[1] - seconds[0] < 20.0
        assert row["direction"] == "forward"
        assert 1.0 < row["speed_mps"] < 8.0
        assert 0.5 < row["nearest_m"] < row["mean_m"] < 9.0
        assert row["ins_status"] == "INS_SOLUTION_GOOD"
        assert row["position_type"] is not None
        assert row["start"].startswith("20")
        assert row["end"] > row["start"]
        assert row["cost_m"] == pytest.approx(np.hypot(row["offset_m"], row["spread_m"]), abs=2e-4)
        assert sum(part["pole"] for part in row["slices"]) >= 20
        middle = {part["slice"] for part in row["slices"]}
        assert int(row["heading_deg"] // 30) in middle
