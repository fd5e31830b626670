"""Passes listed, dropped and kept through a real daemon's socket, and a session gone on with."""

import json
import subprocess
import sys

import pytest
import yaml

from polecal.daemon import recorder
from polecal.daemon.control import Client
from polecal.daemon.replay import replay
from polecal.daemon.service import Service
from polecal.daemon.sessions import CALIBRATION


def field(bench, *arguments):
    """Run the command; give its exit code and what it printed."""
    command = [
        sys.executable,
        "-W",
        "error",
        "-m",
        "polecal.daemon.field",
        "--socket",
        str(bench.config.socket),
    ]
    done = subprocess.run([*command, *arguments], capture_output=True, timeout=60, check=False, text=True)
    return done.returncode, done.stdout, done.stderr


def one_pass(client, until):
    """Start, and wait until the pole was passed."""
    session = client.request({"class": "START", "name": "yard"})["session"]
    until(lambda: client.request({"class": "STATUS"})["lasers"][0]["passes"] == 1, 40.0)
    return session


@pytest.fixture
def loose(bench):
    """A bench on which one pass, of one slice, is enough to be calibrated; not to be accepted."""
    bench.content["routine"] = {"slices_needed": 1, "min_pole_returns": 10}
    return bench


def test_a_pass_is_listed_dropped_and_kept_while_a_run_goes_on_and_after_it(loose, running, until, tmp_path):
    with running(loose), Client(loose.config.socket, 60.0) as client:
        session = one_pass(client, until)
        listed = client.request({"class": "PASSES"})
        assert (listed["session"], listed["next"]) == (session, None)
        (row,) = listed["passes"]
        assert (row["name"], row["use"], row["direction"]) == ("front-001", "used", "forward")
        assert row["speed_mps"] == pytest.approx(5.0, abs=0.1)
        assert row["heading_deg"] == pytest.approx(0.0, abs=1.0) or row["heading_deg"] > 359.0

        code, out, err = field(loose, "drop", "1")
        assert (code, err) == (0, "")
        assert "pass front-001" in out
        assert "is dropped" in out
        assert "no longer covered: slices" in out
        status = client.request({"class": "STATUS"})["lasers"][0]
        assert (status["passes"], status["dropped_passes"]) == (0, [1])
        code, out, _ = field(loose, "passes")
        assert "dropped: by " in out
        assert max(map(len, out.splitlines())) <= 80
        code, _, err = field(loose, "drop", "front-001")
        assert code == 2
        assert "was dropped already" in err
        code, _, err = field(loose, "drop", "8")
        assert (code, "no pass front-008" in err, "there is front-001" in err) == (2, True, True)
        code, out, _ = field(loose, "--json", "keep", "front-001")
        kept = json.loads(out)
        assert (kept["class"], kept["dropped"], kept["after"]["passes"]) == ("CHANGED", False, 1)

        client.request({"class": "STOP", "calibrate": True})
        folder = loose.config.state_dir / "sessions" / session
        before = yaml.safe_load((folder / CALIBRATION).read_text())
        assert [each["drop"] for each in before["choices"]] == [True, False]
        code, _, err = field(loose, "drop", "1")
        assert (code, "nothing left to calibrate from" in err) == (2, True)
        assert yaml.safe_load((folder / CALIBRATION).read_text()) == before
        code, out, _ = field(loose, "sessions")
        assert code == 0
        assert session in out
        assert "rejected" in out
    replay(folder, None, tmp_path / "again", None)
    assert (tmp_path / "again" / CALIBRATION).read_bytes() == (folder / CALIBRATION).read_bytes()


def test_killed_between_a_drop_and_its_answer_the_session_is_whole(bench, running, until, tmp_path):
    with running(bench) as daemon, Client(bench.config.socket, 60.0) as client:
        session = one_pass(client, until)
        client._socket.sendall(b'{"class":"DROP","pass":1}\n')
        daemon.kill()
        daemon.wait(10.0)
    folder = bench.config.state_dir / "sessions" / session
    dropped = [
        item.content["choice"]["number"]
        for item in recorder.read(folder / "capture.mcap")
        if isinstance(item, recorder.Event) and item.content["event"] == "choice"
    ]
    outcome = replay(folder, None, tmp_path / "out", None)
    assert outcome.status["lasers"][0]["dropped_passes"] == dropped
    service = Service(bench.config)
    (row,) = service.handle({"class": "SESSIONS"})["sessions"]
    assert (row["session"], row["state"], row["passes"]) == (session, "unfinished", 1)
    (row,) = service.handle({"class": "PASSES", "session": session})["passes"]
    assert row["use"] == ("dropped" if dropped else "used")


def test_a_session_is_gone_on_with_through_the_socket_and_replayed_as_one(loose, running, until, tmp_path):
    with running(loose), Client(loose.config.socket, 60.0) as client:
        session = one_pass(client, until)
        client.request({"class": "STOP", "calibrate": True})
        folder = loose.config.state_dir / "sessions" / session
        first = yaml.safe_load((folder / CALIBRATION).read_text())
        code, out, err = field(loose, "start", "--continue", "nothing")
        assert (code, "no session nothing" in err) == (2, True)
        code, out, err = field(loose, "start", "--continue", session)
        assert (code, session in out) == (0, True), err
        status = client.request({"class": "STATUS"})["lasers"][0]
        assert (status["passes"], status["earlier_passes"]) == (1, 1)
        until(lambda: client.request({"class": "STATUS"})["state"] == "collecting", 40.0)
        client.request({"class": "STOP", "calibrate": True})
        (row,) = client.request({"class": "SESSIONS"})["sessions"]
        assert (row["session"], row["passes"]) == (session, 1)
    both = yaml.safe_load((folder / CALIBRATION).read_text())
    assert (first["captures"], both["captures"]) == (1, 2)
    assert first["lasers"][0]["estimate"] == both["lasers"][0]["estimate"]
    replay(folder, None, tmp_path / "again", None)
    assert (tmp_path / "again" / CALIBRATION).read_bytes() == (folder / CALIBRATION).read_bytes()


def test_pages_hold_as_much_as_a_reply_may(bench):
    """Five hundred sessions, asked page by page."""
    service = Service(bench.config)
    for number in range(130):
        (bench.config.state_dir / "sessions" / f"s{number:03d}").mkdir(parents=True)
    rows, first = [], 0
    while first is not None:
        answer = service.handle({"class": "SESSIONS", "from": first})
        rows += answer["sessions"]
        first = answer["next"]
    assert [row["session"] for row in rows] == [f"s{number:03d}" for number in reversed(range(130))]
    assert all("cannot be read" in row["problem"] for row in rows)
