"""Every verb with every kind of error: the exit code, one line and a hint, and the same as JSON."""

import io
import json
import os
import re
import subprocess
import sys

import pytest
import structlog
import yaml

from polecal.daemon import field, manual
from polecal.daemon.control import Code, ControlServer, Refused
from polecal.daemon.recorder import Recorder

DAEMONS = {
    "start": ["start"],
    "status": ["status"],
    "watch": ["status", "--watch"],
    "wait": ["wait"],
    "stop": ["stop"],
    "stop and calibrate": ["stop", "--calibrate"],
    "result": ["result"],
    "result of one": ["result", "s1", "--format", "urdf"],
    "report": ["report"],
    "passes": ["passes"],
    "sessions": ["sessions"],
    "route": ["route"],
    "drop": ["drop", "front-001"],
    "keep": ["keep", "front-001"],
}
"""The verbs that need a daemon."""

FILES = {
    "replay": ["replay", "{gone}"],
    "import": ["import", "--lms", "{gone}", "--span", "{gone}", "--config", "{config}", "--out", "{out}"],
    "export": ["export", "{gone}", "--out", "{out}"],
    "decode": ["decode", "{gone}", "--as", "sick_lms"],
    "result of a folder": ["result", "{gone}"],
    "report of a folder": ["report", "{gone}"],
}
"""The verbs that work on files, with one that is not there."""

OTHERS = {"emulate", "demo", "doctor", "completion"}

CONFIG = {
    "lasers": [{"port": "/dev/lms", "mount": dict.fromkeys(("x_m", "y_m", "z_m"), 0)}],
    "navigation": {"port": "/dev/span"},
    "pole": {"radius_m": 0.04, "height_m": 2.4},
}
CONFIG["lasers"][0]["mount"] |= dict.fromkeys(("roll_deg", "pitch_deg", "yaw_deg"), 0)


ROUTE = {"class": "ROUTE", "session": "s1", "why": [], "pole": None, "legs": [], "unseen": [], "left_out": 0}


class Refuser:
    """Refuses whatever it is asked; or has a session that goes from state to state."""

    def __init__(self):
        self.error = None
        self.state = "collecting"
        self.device = "streaming"
        self.verdict = True

    def handle(self, request):
        if self.error is not None:
            raise self.error
        devices = [{"name": "front", "state": self.device}]
        laser = {"name": "front", "verdict": {"accepted": self.verdict, "reasons": []}}
        match request["class"]:
            case "STATUS":
                return {"class": "STATUS", "state": self.state, "devices": devices, "lasers": []}
            case "STOP":
                return {"class": "STOPPED", "session": "s1", "state": self.state}
            case "RESULT":
                return {"class": "RESULT", "state": self.state, "lasers": [laser]}
            case "ROUTE":
                return ROUTE | {"state": self.state}
            case other:
                return {"class": other, "sessions": [], "passes": [], "session": "s1", "next": None} | {
                    "state": self.state
                }


@pytest.fixture
def daemon(tmp_path, monkeypatch):
    monkeypatch.setattr(field, "_POLL_S", 0.01)
    monkeypatch.setenv("POLECAL_SOCKET", str(tmp_path / "control.sock"))
    structlog.configure(logger_factory=structlog.WriteLoggerFactory(io.StringIO()))
    refuser = Refuser()
    with ControlServer(tmp_path / "control.sock", refuser, watch_s=0.01):
        yield refuser
    structlog.reset_defaults()


@pytest.fixture
def run(capsys, tmp_path):
    """Run the command; give (exit code, standard output, lines of standard error)."""
    (tmp_path / "polecal.yaml").write_text(yaml.safe_dump(CONFIG))
    (tmp_path / "bad.yaml").write_text("lasers: 3")
    names = {"gone": tmp_path / "gone", "out": tmp_path / "out", "config": tmp_path / "polecal.yaml"}

    def run(*arguments):
        code = field.main([str(argument).format(**names) for argument in arguments])
        out, err = capsys.readouterr()
        return code, out, [line for line in err.splitlines() if not line.startswith("  ")]

    return run


def assert_told(lines, message=""):
    """One line says what is wrong, the other what to do."""
    assert len(lines) == 2, lines
    assert lines[0].startswith("polecal-field: ")
    assert message in lines[0]
    assert lines[1].startswith("hint: ")
    assert len(lines[1]) > len("hint: ") + 3


def test_no_verb_is_left_out_here():
    listed = {arguments[0] for arguments in (*DAEMONS.values(), *FILES.values())} | OTHERS
    assert listed >= set(manual.verbs(field.make_parser()))


@pytest.mark.parametrize(
    "code", [Code.DEGRADED, Code.USAGE, Code.DEVICE, Code.BUSY, Code.NOT_PERMITTED, Code.CONFIG]
)
@pytest.mark.parametrize("verb", DAEMONS)
def test_what_the_daemon_refuses_is_the_exit_code(verb, code, daemon, run):
    daemon.error = Refused("it will not do that", "do this instead", code)
    told, out, lines = run(*DAEMONS[verb])
    assert (told, out) == (code, "")
    assert lines == ["polecal-field: it will not do that", "hint: do this instead"]
    told, out, lines = run("--json", *DAEMONS[verb])
    assert told == code
    expected = {"class": "ERROR", "code": code, "message": "it will not do that", "hint": "do this instead"}
    assert json.loads(out) == expected
    assert_told(lines)


@pytest.mark.parametrize("verb", DAEMONS)
def test_without_a_daemon_it_is_3(verb, run, tmp_path):
    code, out, lines = run("--socket", tmp_path / "none.sock", *DAEMONS[verb])
    assert (code, out) == (Code.NO_DAEMON, "")
    assert_told(lines, "no daemon on")
    code, out, _ = run("--json", "--socket", tmp_path / "none.sock", *DAEMONS[verb])
    assert (code, json.loads(out)["code"]) == (3, 3)


@pytest.mark.parametrize("verb", DAEMONS)
def test_a_daemon_that_this_user_may_not_talk_to_is_77(verb, daemon, run, tmp_path):
    socket = tmp_path / "control.sock"
    socket.chmod(0)
    if os.geteuid() == 0:
        os.seteuid(65534)
    try:
        code, out, lines = run(*DAEMONS[verb])
    finally:
        if os.getuid() == 0:
            os.seteuid(0)
    assert (code, out) == (Code.NOT_PERMITTED, "")
    assert_told(lines, str(socket))
    assert "usermod" in lines[1]


@pytest.mark.parametrize("verb", FILES)
def test_a_file_that_is_not_there_is_2_or_degraded_and_named(verb, run):
    code, out, lines = run(*FILES[verb])
    assert code in (Code.USAGE, Code.DEGRADED)
    assert out == ""
    assert_told(lines, "gone")
    code_again, out, _ = run("--json", *FILES[verb])
    assert code_again == code
    assert json.loads(out)["class"] == "ERROR"


@pytest.mark.parametrize(
    "arguments",
    [
        ["import", "--lms", "{gone}", "--span", "{gone}", "--config", "{bad}", "--out", "{out}"],
        ["replay", "{capture}", "--config", "{bad}"],
        ["doctor", "--config", "{bad}"],
    ],
)
def test_a_bad_configuration_is_78(arguments, run, tmp_path):
    capture = tmp_path / "capture.mcap"
    with Recorder(
        capture, {"session": "s1", "created": "", "polecal": "0", "config": yaml.safe_dump(CONFIG)}
    ):
        pass
    named = {
        "bad": tmp_path / "bad.yaml",
        "capture": capture,
        "gone": tmp_path / "gone",
        "out": tmp_path / "out",
    }
    code, _, lines = run(*(argument.format(**named) for argument in arguments))
    assert code == Code.CONFIG
    assert "bad.yaml" in lines[0]
    assert lines[-1].startswith("hint: ")


WRONG = """
fly | start x | wait --for tea | wait --timeout x | result --format x | drop | keep | decode x
decode x --as radio | import | export x | replay | emulate --seed x | demo --seed x | doctor x
completion x | status --x
"""


@pytest.mark.parametrize("line", ["", *re.split(r" \| |\n", WRONG.strip())])
def test_wrong_usage_is_2_and_names_the_help(line, run):
    arguments = line.split()
    code, out, lines = run(*arguments)
    assert (code, out) == (Code.USAGE, "")
    assert_told(lines)
    assert "--help" in lines[1]
    code, out, _ = run("--json", *arguments)
    assert (code, json.loads(out)["class"], json.loads(out)["code"]) == (2, "ERROR", 2)


@pytest.mark.parametrize(
    ("arguments", "state_and_device", "code"),
    [
        (["status"], "idle closed", 0),
        (["status"], "collecting streaming", 0),
        (["status"], "collecting lost", 1),
        (["status"], "fault closed", 1),
        (["status"], "rejected closed", 0),
        (["wait"], "accepted closed", 0),
        (["wait"], "rejected closed", 5),
        (["wait"], "fault closed", 4),
        (["wait"], "idle closed", 2),
        (["wait", "--timeout", "0.03"], "collecting streaming", 1),
        (["wait", "--for", "collecting"], "collecting streaming", 0),
        (["wait", "--for", "collecting"], "accepted closed", 1),
        (["wait", "--for", "accepted"], "rejected closed", 5),
        (["wait", "--for", "accepted"], "fault closed", 4),
        (["stop"], "rejected closed", 0),
        (["stop", "--calibrate"], "accepted closed", 0),
        (["stop", "--calibrate"], "rejected closed", 5),
        (["stop", "--calibrate"], "fault closed", 4),
        (["result"], "accepted closed", 0),
        (["result"], "rejected closed", 5),
        (["passes"], "collecting streaming", 0),
        (["sessions"], "idle closed", 0),
        (["route"], "collecting streaming", 0),
        (["route"], "accepted closed", 0),
    ],
)
def test_what_came_of_it_is_the_exit_code(arguments, state_and_device, code, daemon, run):
    daemon.state, daemon.device = state_and_device.split()
    daemon.verdict = daemon.state == "accepted"
    told, out, _ = run("--json", *arguments)
    assert told == code
    assert out.count("\n") == 1
    assert json.loads(out)["class"] in ("STATUS", "STOPPED", "RESULT", "PASSES", "SESSIONS", "ROUTE", "ERROR")


def test_what_works_on_files_says_in_json_what_it_made(run, tmp_path, captures):
    lms = tmp_path / "lms.bin"
    lms.write_bytes(b"\x02\x80")
    made = tmp_path / "made.mcap"
    code, out, _ = run(
        "--json", *["import", "--lms"], lms, "--span", lms, "--config", "{config}", "--out", made
    )
    told = json.loads(out)
    assert (code, told["class"], told["capture"]) == (0, "IMPORT", str(made))
    code, out, _ = run("--json", "export", made, "--out", tmp_path / "dumps")
    told = json.loads(out)
    assert (code, told["class"]) == (0, "EXPORT")
    assert all(os.path.exists(path) for path in told["paths"])


def test_an_output_that_takes_no_more_is_1_without_a_traceback(tmp_path):
    with open("/dev/full", "w") as full:
        done = subprocess.run(
            [sys.executable, "-m", "polecal.daemon.field", "completion", "bash"],
            check=False,
            stdout=full,
            stderr=subprocess.PIPE,
            timeout=60,
        )
    assert done.returncode == 1
    assert_told(done.stderr.decode().splitlines(), "No space left")
