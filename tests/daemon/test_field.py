"""What an operator types, what is printed, and the exit code a script goes by."""

import io
import json
import os
import signal
import subprocess
import sys
import threading
from pathlib import Path

import pytest
import structlog
import yaml

from polecal import __version__
from polecal.daemon import field
from polecal.daemon.control import ControlServer, Refused
from polecal.daemon.recorder import Recorder

STREAMING = [
    {"name": "front", "port": "/dev/lms", "state": "streaming", "identity": "LMS291;S05"},
    {"name": "span", "port": "/dev/span", "state": "streaming"},
]

POSE = {"x_m": 0.1, "y_m": 0.2, "z_m": -1.0, "roll_deg": 1.0, "pitch_deg": -8.0, "yaw_deg": 2.0}
LASERS = [
    {
        "name": "front",
        "cost_m": 0.03,
        "estimate": POSE,
        "sigma": POSE,
        "held": [],
        "verdict": {"accepted": True, "reasons": []},
    }
]


class Daemon:
    """Goes through states, one a STATUS, and stays in the last."""

    def __init__(self):
        self.states = ["collecting"]
        self.devices = STREAMING
        self.asked = []
        self.may_answer = threading.Event()
        self.error = None
        self.result = "accepted"

    def handle(self, request):
        self.asked.append(request)
        if self.error and request["class"] != "STATUS":
            raise self.error
        match request["class"]:
            case "STATUS":
                state = self.states.pop(0) if len(self.states) > 1 else self.states[0]
                return {
                    "class": "STATUS",
                    "state": state,
                    "session": "s1",
                    "devices": self.devices,
                    "lasers": [],
                }
            case "START":
                return {"class": "STARTED", "session": "s1", "devices": self.devices}
            case "STOP":
                return {"class": "STOPPED", "session": "s1", "state": self.states[0]}
            case _:
                return {"class": "RESULT", "state": self.result, "lasers": LASERS}


@pytest.fixture
def daemon(tmp_path, monkeypatch):
    monkeypatch.setattr(field, "_POLL_S", 0.01)
    monkeypatch.setenv("POLECAL_SOCKET", str(tmp_path / "control.sock"))
    structlog.configure(logger_factory=structlog.WriteLoggerFactory(io.StringIO()))  # not between the output
    daemon = Daemon()
    with ControlServer(tmp_path / "control.sock", daemon, watch_s=0.01):
        yield daemon
        daemon.may_answer.set()
    structlog.reset_defaults()


@pytest.fixture
def run(capsys):
    """Run the command; give (exit code, standard output, standard error)."""

    def run(*arguments):
        try:
            code = field.main([str(argument) for argument in arguments])
        except SystemExit as leaving:
            code = leaving.code
        return code, *capsys.readouterr()

    return run


def command(*arguments, **options):
    program = [sys.executable, "-m", "polecal.daemon.field", *map(str, arguments)]
    return subprocess.run(program, check=False, capture_output=True, timeout=60, **options)


def test_no_daemon_is_exit_3_with_a_line_and_a_hint(run, tmp_path):
    for verb in (["start"], ["status"], ["wait"], ["stop"], ["result"]):
        code, out, err = run("--socket", tmp_path / "none.sock", *verb)
        assert code == 3
        assert out == ""
        first, second = err.splitlines()
        assert first.startswith("polecal-field: no daemon on ")
        assert second.startswith("hint: start it: ")


def test_the_socket_comes_before_or_after_the_verb_or_from_the_environment(
    run, daemon, tmp_path, monkeypatch
):
    path = tmp_path / "control.sock"
    assert run("status")[0] == 0
    monkeypatch.setenv("POLECAL_SOCKET", "/nowhere")
    assert run("status")[0] == 3
    assert run("--socket", path, "status")[0] == 0
    assert run("status", "--socket", path)[0] == 0


@pytest.mark.parametrize(
    "arguments",
    [
        [],
        ["fly"],
        ["wait", "--for", "christmas"],
        ["decode", "x"],
        ["wait", "--timeout", "x"],
    ],
)
def test_wrong_usage_is_exit_2_with_a_line_and_a_hint(run, arguments):
    code, out, err = run(*arguments)
    assert (code, out) == (2, "")
    first, second = err.splitlines()
    assert first.startswith("polecal-field: ")
    assert second.startswith("hint: see `polecal-field")


def test_version_and_help(run):
    assert run("--version")[:2] == (0, __version__ + "\n")
    code, out, _ = run("--help")
    assert code == 0
    for verb in ("start", "status", "wait", "stop", "result", "demo", "replay", "emulate", "decode"):
        assert f"    {verb} " in out


def test_start_says_what_streams(run, daemon):
    code, out, _ = run("start", "--name", "yard", "--force")
    assert code == 0
    assert daemon.asked[0] == {"class": "START", "name": "yard", "force": True}
    assert "session s1 has started" in out
    assert "front: streaming, LMS291;S05 on /dev/lms" in out
    assert "span: streaming, /dev/span" in out


@pytest.mark.parametrize("code", [4, 75, 77])
def test_a_start_that_is_refused_says_why_and_what_to_do(run, daemon, code):
    daemon.error = Refused("/dev/lms: another program holds it", "stop it", code)
    exit_code, out, err = run("start")
    assert (exit_code, out) == (code, "")
    # On a busy machine what it waits for stands before.
    assert err.splitlines()[-2:] == ["polecal-field: /dev/lms: another program holds it", "hint: stop it"]
    code_again, out, _ = run("--json", "start")
    assert code_again == code
    assert json.loads(out) == {
        "class": "ERROR",
        "code": code,
        "message": "/dev/lms: another program holds it",
        "hint": "stop it",
    }


@pytest.mark.parametrize(
    ("state", "device_state", "code"),
    [
        ("idle", "closed", 0),
        ("connecting", "connecting", 1),
        ("aligning", "streaming", 0),
        ("collecting", "streaming", 0),
        ("collecting", "lost", 1),
        ("accepted", "closed", 0),
        ("fault", "streaming", 1),
    ],
)
def test_status_tells_its_health_by_its_exit_code(run, daemon, state, device_state, code):
    daemon.states = [state]
    daemon.devices = [STREAMING[0], STREAMING[1] | {"state": device_state}]
    got, out, err = run("status")
    assert (got, err) == (code, "")
    assert state in out
    assert "front" in out


def test_json_prints_exactly_the_protocols_object(run, daemon):
    for arguments in (["--json", "status"], ["status", "--json"]):
        _, out, _ = run(*arguments)
        assert json.loads(out) == daemon.handle({"class": "STATUS"})
        assert out.count("\n") == 1


def test_a_daemon_that_hangs_does_not_hang_the_status(run, daemon, monkeypatch):
    monkeypatch.setattr(field, "_STATUS_S", 0.05)
    monkeypatch.setattr(daemon, "handle", lambda _: daemon.may_answer.wait(5))
    code, _, err = run("status")
    assert code == 1
    assert "does not answer" in err


def test_watch_shows_each_status_until_ctrl_c_and_then_ends_as_status_does(run, daemon, monkeypatch):
    daemon.states = ["aligning", "collecting", "fault"]
    shown = []

    def show(status):
        shown.append(status["state"])
        if len(shown) == 3:
            raise KeyboardInterrupt

    monkeypatch.setattr(field, "_print_json", show)
    assert run("--json", "status", "--watch")[0] == 1
    assert shown == ["aligning", "collecting", "fault"]


@pytest.mark.parametrize(("state", "code"), [("accepted", 0), ("rejected", 5), ("fault", 4)])
def test_wait_ends_with_the_verdict_as_its_exit_code(run, daemon, state, code):
    daemon.states = ["collecting", "collecting", "calibrating", state]
    got, out, err = run("wait")
    assert got == code
    assert state in out
    assert err == f"  calibrating\n  {state}\n"


def test_wait_for_a_state(run, daemon):
    daemon.states = ["connecting", "aligning", "collecting"]
    assert run("wait", "--for", "collecting")[0] == 0
    daemon.states = ["collecting", "rejected"]
    code, _, err = run("wait", "--for", "accepted")
    assert code == 5
    assert "it ended rejected" in err
    daemon.states = ["accepted"]
    assert run("wait", "--for", "collecting")[0] == 1


def test_wait_gives_up_in_time(run, daemon):
    code, _, err = run("wait", "--timeout", "0.05")
    assert code == 1
    assert "still collecting after 0.05 s" in err


def test_wait_for_nothing_is_refused(run, daemon):
    daemon.states = ["idle"]
    code, _, err = run("wait")
    assert code == 2
    assert "polecal-field start" in err


def test_stop(run, daemon):
    assert run("stop")[:2] == (0, "session s1 has ended: collecting\n")
    assert daemon.asked[-1] == {"class": "STOP", "calibrate": False}
    daemon.states = ["rejected"]
    assert run("stop", "--calibrate")[0] == 5
    daemon.states = ["accepted"]
    assert run("stop", "--calibrate")[0] == 0


def test_result_as_yaml_json_and_object(run, daemon):
    content = {"state": "accepted", "lasers": LASERS}
    code, out, _ = run("result")
    assert (code, yaml.safe_load(out)) == (0, content)
    code, out, _ = run("result", "s1", "--format", "json")
    assert (code, json.loads(out)) == (0, content)
    assert daemon.asked[-1] == {"class": "RESULT", "session": "s1"}
    _, out, _ = run("--json", "result")
    assert json.loads(out) == {"class": "RESULT"} | content


@pytest.mark.parametrize("form", field._FORMATS)
def test_a_result_in_every_format_and_a_rejected_one_says_so_in_it(run, daemon, form):
    code, out, err = run("result", "--format", form)
    assert (code, err, "REJECTED" in out) == (0, "", False)
    assert "front" in out
    daemon.result = "rejected"
    code, out, err = run("result", "--format", form)
    assert (code, "was rejected" in err) == (5, True)
    assert "REJECTED - DO NOT USE" in "".join(out.splitlines()[:3])


def test_the_formats_are_those_that_there_are(run, tmp_path):
    from polecal.calib.export import FORMATS

    assert tuple(FORMATS) == field._FORMATS


def test_a_result_from_a_folder_needs_no_daemon(run, daemon, tmp_path):
    (tmp_path / "calibration.yaml").write_text(yaml.safe_dump({"state": "accepted", "lasers": LASERS}))
    code, out, _ = run("result", f"{tmp_path}/", "--format", "urdf", "--parent", "ins")
    assert (code, daemon.asked) == (0, [])
    assert '<parent link="ins"/>' in out
    (tmp_path / "calibration.yaml").write_text("lasers: 3\n")
    for folder in (tmp_path, tmp_path / "none"):
        code, out, err = run("result", f"{folder}/")
        assert (code, out) == (1, "")
        assert "calibration.yaml" in err
        assert "hint: " in err


def test_a_rejected_result_is_printed_but_not_as_a_success(run, daemon):
    daemon.result = "rejected"
    code, out, err = run("result", "s1")
    assert code == 5
    assert "cost_m: 0.03" in out
    assert "rejected" in err


def test_a_real_lasers_bytes_decode_to_json_lines(tmp_path, captures):
    lines = (captures / "lms200-setup-and-stream.jsonl").read_text().splitlines()
    telegrams = [json.loads(line) for line in lines]
    raw = tmp_path / "lms.bin"
    data = b"".join(bytes.fromhex(each["hex"]) for each in telegrams if each["from"] == "lms")
    raw.write_bytes(b"\x55\x02" + data)
    done = command("decode", raw, "--as", "sick_lms")
    assert (done.returncode, done.stderr) == (0, b"")
    rows = [json.loads(line) for line in done.stdout.splitlines()]
    assert [row["name"] for row in rows[:2]] == ["garbage", "garbage"]
    assert {row["frame"] for row in rows[:2]} == {None}
    offset = 0
    for row in rows:
        assert row["offset"] == offset
        offset += row["length"]
    assert offset == len(data) + 2
    frames = [row for row in rows if row["frame"] is not None]
    assert [row["frame"] for row in frames] == list(range(len(frames)))
    assert all(row["crc_ok"] for row in frames)
    scans = [row for row in frames if "ranges_m" in row]
    assert len(scans) > 30
    assert {len(row["ranges_m"]) for row in scans} == {361}
    piped = command("decode", "-", "--as", "sick_lms", input=raw.read_bytes())
    assert piped.stdout == done.stdout


def test_a_real_receivers_bytes_decode_to_json_lines(tmp_path, captures):
    raw = tmp_path / "span.bin"
    data = (captures / "span_driver_ins_ppp_driven_20hz.bin").read_bytes()[:60_000]
    raw.write_bytes(data)
    done = command("decode", raw, "--as", "novatel_span")
    assert (done.returncode, done.stderr) == (0, b"")
    rows = [json.loads(line) for line in done.stdout.splitlines()]
    assert sum(row["length"] for row in rows) == len(data)
    assert "NaN" not in done.stdout.decode()
    poses = [row for row in rows if row["name"] == "INSPVAX"]
    assert len(poses) > 20
    assert {"lat_deg", "lon_deg", "roll_deg", "pitch_deg", "azimuth_deg"} <= set(poses[0])


def test_a_reader_that_has_enough_ends_the_decoding_quietly(captures):
    program = f"{sys.executable} -m polecal.daemon.field decode --as novatel_span"
    capture = captures / "span_driver_ins_ppp_driven_20hz.bin"
    done = subprocess.run(
        ["/bin/sh", "-c", f"{program} {capture} | head -n 1"], check=False, capture_output=True, timeout=60
    )
    assert done.stdout.count(b"\n") == 1
    assert done.stderr == b""


def test_ctrl_c_ends_the_decoding_quietly():
    with subprocess.Popen(
        [sys.executable, "-m", "polecal.daemon.field", "decode", "-", "--as", "sick_lms"],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
    ) as running:
        running.stdin.write(b"\x55\x06" * 40)
        running.stdin.flush()
        assert running.stdout.readline()  # it is in its loop by now
        running.send_signal(signal.SIGINT)
        assert running.wait(10) == 130
        assert running.stderr.read() == b""


def test_a_file_that_is_not_there_is_exit_2(run, tmp_path):
    for arguments in (["decode", tmp_path / "gone", "--as", "sick_lms"], ["replay", tmp_path / "gone"]):
        code, out, err = run(*arguments)
        assert (code, out) == (2, "")
        assert "gone" in err
        assert err.count("\n") == 2


CONFIG = """
lasers:
- port: /dev/lms
  mount: {x_m: 0, y_m: -0.35, z_m: -1.0, roll_deg: 0, pitch_deg: -8, yaw_deg: 0}
navigation: {port: /dev/span}
pole: {radius_m: 0.04, height_m: 2.4}
"""


@pytest.fixture
def capture(tmp_path):
    path = tmp_path / "capture.mcap"
    told = {"session": "s1", "created": "2026-11-22T03:15:00+00:00", "polecal": "0", "config": CONFIG}
    with Recorder(path, told) as recorder:
        recorder.event(1_000_000_000, {"event": "begin"})
        for n in range(20):
            recorder.write("span", "rx", 1_000_000_000 + n * 10_000_000, b"noise")
    return path


def test_replay_of_too_little_says_what_is_missing_and_is_exit_5(run, capture, tmp_path):
    code, out, err = run("replay", capture, "--out", tmp_path / "out")
    assert (code, err) == (5, "")
    assert "no pass of the pole yet" in out
    assert "no calibration" in out
    _, out, _ = run("--json", "replay", capture, "--out", tmp_path / "again")
    assert json.loads(out)["class"] == "STATUS"


def test_replay_of_a_cut_capture_says_how_far_it_went(run, capture, tmp_path):
    os.truncate(capture, 900)
    code, _, err = run("replay", capture, "--out", tmp_path / "out")
    assert code == 5
    assert "is cut off: used " in err
    assert " of 900 bytes" in err


def test_replay_with_a_bad_configuration_names_each_fault_and_is_exit_78(run, capture, tmp_path):
    bad = CONFIG.replace("0.04", "-1").replace("x_m: 0, ", "").replace("2.4}", "tall}")
    (tmp_path / "bad.yaml").write_text(bad)
    code, _, err = run("replay", capture, "--config", tmp_path / "bad.yaml")
    assert code == 78
    for path in ("lasers[0].mount.x_m", "pole.radius_m", "pole.height_m"):
        assert path in err


def test_the_daily_verbs_need_no_numpy(daemon):
    code = """
import sys
import threading
from polecal.daemon.field import main
code = main(sys.argv[1:])
sys.exit(99 if {"numpy", "scipy", "matplotlib", "pydantic"} & set(sys.modules) else code)
"""
    for arguments in (["status"], ["start"], ["wait", "--for", "collecting"], ["stop"], ["result"]):
        done = subprocess.run(
            [sys.executable, "-c", code, *arguments], check=False, capture_output=True, timeout=60
        )
        assert done.returncode == 0, (arguments, done.stderr)


def test_the_installed_command_is_this_one():
    program = Path(sys.executable).with_name("polecal-field")
    if not program.exists():
        pytest.skip(f"not installed: {program}")
    done = subprocess.run([program, "--version"], check=True, capture_output=True, timeout=60)
    assert done.stdout.decode().strip() == __version__
