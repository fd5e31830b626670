"""The programs as an operator's script meets them: exit codes, one line of error and one of advice."""

import json
import os
import subprocess
import sys

import pytest
import yaml

from polecal.daemon import sessions
from polecal.daemon.recorder import Recorder
from polecal.daemon.replay import BEGIN


def run(module, *arguments, env=None, timeout_s=60):
    """Run a program to its end; give (exit code, standard output, lines of standard error)."""
    done = subprocess.run(
        [sys.executable, "-W", "error", "-m", f"polecal.daemon.{module}", *map(str, arguments)],
        capture_output=True,
        text=True,
        env=os.environ | (env or {}),
        timeout=timeout_s,
        check=False,
    )
    return done.returncode, done.stdout, done.stderr.splitlines()


@pytest.fixture(scope="module")
def told(shared_bench, running):
    """The operator's command on a daemon of its own process."""
    socket = {"POLECAL_SOCKET": str(shared_bench.config.socket)}
    with running(shared_bench):
        yield lambda *arguments: run("field", *arguments, env=socket)


def assert_one_line_and_a_hint(lines, *words):
    said = [line for line in lines if not line.startswith("  ")]  # what a start waits for
    assert len(said) == 2, lines
    assert all(word in said[0] for word in words), said
    assert said[1].startswith("hint: ")


def test_a_session_by_hand(told, shared_bench):
    code, out, _ = told("start", "--name", "yard")
    assert code == 0
    session = next(word for word in out.split() if word.endswith("-yard"))
    assert f"streaming, LMS291;S05;V02.10 on {shared_bench.lms}" in out

    code, out, err = told("start")
    assert (code, out) == (75, "")
    assert_one_line_and_a_hint(err, session, "is running")

    code, out, err = told("wait", "--for", "collecting", "--timeout", "20")
    assert code == 0, err
    code, out, _ = told("--json", "status")
    assert code == 0
    status = json.loads(out)
    assert (status["class"], status["session"], status["state"]) == ("STATUS", session, "collecting")
    code, out, _ = told("status")
    assert code == 0
    assert "collecting" in out
    assert max(len(line) for line in out.splitlines()) <= 80
    assert len(out.splitlines()) <= 24

    code, out, _ = told("stop")
    assert code == 0
    assert "idle" in out
    assert shared_bench.polite()
    code, _, err = told("stop")
    assert code == 2
    assert_one_line_and_a_hint(err, "no session is running")


def test_there_is_no_result_before_anything_was_accepted(told):
    code, out, err = told("result")
    assert (code, out) == (1, "")
    assert_one_line_and_a_hint(err, "no session was accepted yet")


def test_a_name_with_a_slash_is_a_usage_error(told):
    code, _, err = told("start", "--name", "../x")
    assert code == 2
    assert_one_line_and_a_hint(err, "no name")


def test_a_port_that_is_not_there_is_a_device_fault(told, shared_bench):
    shared_bench.served.unplug(shared_bench.span)
    try:
        code, out, err = told("start")
    finally:
        shared_bench.served.plug(shared_bench.span)
    assert (code, out) == (4, "")
    assert_one_line_and_a_hint(err, str(shared_bench.span), "no such port")


def test_a_second_daemon_on_the_same_socket_is_refused(told, shared_bench):
    code, _, err = run("service", "--config", shared_bench.config_file)
    assert code == 75
    assert_one_line_and_a_hint(err, str(shared_bench.config.socket), "another polecald is running")
    assert told("status")[0] == 0  # the first one is none the worse


def test_without_a_daemon_it_is_exit_3(tmp_path):
    for verb in ("status", "start", "stop", "result", "wait"):
        code, out, err = run("field", "--socket", tmp_path / "control.sock", verb)
        assert (code, out) == (3, "")
        assert_one_line_and_a_hint(err, "no daemon")
        assert "systemctl start polecal" in err[1]


def test_every_fault_of_a_configuration_is_listed(tmp_path):
    path = tmp_path / "polecal.yaml"
    mount = {"x_m": 0, "y_m": -0.35, "z_m": -1.0, "roll_deg": 0.0, "pitch_deg": -8.0, "yaw_deg": 0.0}
    content = {
        "lasers": [{"port": "/dev/lms", "mount": mount, "baud": 12345}],
        "navigation": {"port": "/dev/span", "rate": 100},
        "pole": {"radius_m": -0.04, "height_m": 2.4},
    }
    path.write_text(yaml.safe_dump(content))
    for check in (["--check-config"], []):
        code, out, err = run("service", "--config", path, *check)
        assert (code, out) == (78, "")
        for fault in ("lasers[0].baud", "navigation.rate", "pole.radius_m"):
            assert sum(fault in line for line in err) == 1
        assert "3 faults" in err[0]
        assert "hint" in err[-1]
    content["lasers"][0].pop("baud")
    content["navigation"].pop("rate")
    content["pole"]["radius_m"] = 0.04
    path.write_text(yaml.safe_dump(content))
    assert run("service", "--config", path, "--check-config") == (0, "", [])
    assert run("service", "--config", tmp_path / "none.yaml", "--check-config")[0] == 78


def test_a_place_for_its_files_that_cannot_be_made_is_a_bad_configuration(bench):
    (bench.folder / "state").write_text("in the way")
    code, _, err = run("service", "--config", bench.config_file)
    assert code == 78
    assert_one_line_and_a_hint(err, str(bench.folder / "state"), "cannot be made")


def test_a_replay_that_comes_to_nothing_is_exit_5_and_a_bad_file_is_2(settings, tmp_path):
    session = sessions.create(tmp_path, settings(), None)
    with Recorder(session.capture, session.metadata(settings())) as capture:
        capture.event(1, {"event": BEGIN})
    code, out, err = run("field", "replay", session.capture)
    assert (code, err) == (5, [])
    assert "no pass" in out
    code, out, err = run("field", "replay", session.folder / "session.yaml")
    assert (code, out) == (2, "")
    assert_one_line_and_a_hint(err, "not a capture")
