"""What the daemon answers, on pseudo-terminals and in a process of its own."""

import fcntl
import json
import os
import signal
import threading
import time

import pytest

from polecal.daemon import recorder, service
from polecal.daemon.control import Client, Code, Refused, code_of
from polecal.daemon.replay import replay
from polecal.daemon.service import Service
from polecal.drivers.device import Device
from polecal.drivers.errors import DeviceError, DeviceNotFound, DeviceNotPermitted
from polecal.drivers.sick_lms import device as sick_device

STATUS = {"class", "state", "session", "since_s", "devices", "lasers", "next"}  # interface.md
DEVICE = {"name", "kind", "port", "state", "rate_hz", "frames", "bad_frames", "reconnects"}
LASER = {
    "name",
    "passes",
    "coverage",
    "estimate",
    "sigma",
    "held",
    "cost_m",
    "measured_cost_m",
    "verdict",
}


@pytest.fixture
def daemon(bench):
    made = Service(bench.config)
    yield made
    made.close()


@pytest.fixture
def lonely(tmp_path, settings):
    """A service whose ports are named by the test; nothing is plugged in."""
    made = []

    def make(lms, span):
        config = settings(
            laser={"port": str(lms)},
            navigation={"port": str(span)},
            state_dir=str(tmp_path / "state"),
        )
        made.append(Service(config))
        return made[-1]

    yield make
    for each in made:
        each.close()


def ask(daemon, request, **more):
    return daemon.handle({"class": request, **more})


# --- one session after another


def test_a_session_from_start_to_stop_and_what_is_refused_meanwhile(daemon, bench, until):
    idle = ask(daemon, "STATUS")
    assert idle.keys() >= STATUS
    assert (idle["state"], idle["session"]) == ("idle", None)
    with pytest.raises(Refused, match="no session is running") as caught:
        ask(daemon, "STOP")
    assert caught.value.code == Code.USAGE

    started = ask(daemon, "START", name="yard")
    assert started["session"].endswith("-yard")
    assert [device["state"] for device in started["devices"]] == ["streaming", "streaming"]

    with pytest.raises(Refused, match=started["session"]) as caught:
        ask(daemon, "START", name=None)
    assert caught.value.code == Code.BUSY
    assert "--force" in caught.value.hint

    until(lambda: ask(daemon, "STATUS")["state"] == "collecting")
    status = ask(daemon, "STATUS")
    assert status.keys() >= STATUS
    assert status["session"] == started["session"]
    assert all(device.keys() >= DEVICE for device in status["devices"])
    assert "ins_status" in status["devices"][1]
    assert all(laser.keys() >= LASER for laser in status["lasers"])

    again = ask(daemon, "START", name="yard", force=True)
    assert again["session"] != started["session"]
    first = recorder.read(bench.config.state_dir / "sessions" / started["session"] / "capture.mcap")
    assert sum(1 for _ in first) > 100
    assert first.cut is None

    stopped = ask(daemon, "STOP")
    assert (stopped["session"], stopped["state"]) == (again["session"], "idle")
    assert bench.polite()
    with pytest.raises(Refused):
        ask(daemon, "STOP")
    after = ask(daemon, "STATUS")
    assert (after["state"], after["session"]) == ("idle", again["session"])
    with pytest.raises(Exception, match="no session was accepted yet"):
        ask(daemon, "RESULT")


@pytest.mark.parametrize("name", ["../../etc/x", "a/b", "", "a" * 65, "a\0b", "a\nb", 7, ["x"], ".."])
def test_a_name_that_would_not_be_a_folder_of_its_own_is_refused(lonely, tmp_path, name):
    daemon = lonely(tmp_path / "lms", tmp_path / "span")
    with pytest.raises(Refused, match="no name for a session") as caught:
        ask(daemon, "START", name=name)
    assert caught.value.code == Code.USAGE
    assert not (tmp_path / "state").exists()


def test_an_unknown_request_is_refused(lonely, tmp_path):
    with pytest.raises(Refused) as caught:
        ask(lonely("/dev/a", "/dev/b"), "FLY")
    assert caught.value.code == Code.USAGE


def test_while_it_is_being_stopped_nothing_is_started(lonely, tmp_path):
    daemon = lonely(tmp_path / "lms", tmp_path / "span")
    daemon.close()
    with pytest.raises(Refused, match="being stopped"):
        ask(daemon, "START", name=None)
    assert not (tmp_path / "state").exists()


# --- ports that cannot be used


def failed(daemon):
    """Start, which must fail; give the error. Nothing may be left running or open."""
    with pytest.raises(DeviceError) as caught:
        ask(daemon, "START", name=None)
    assert ask(daemon, "STATUS")["state"] in ("idle", "fault")
    assert caught.value.hint
    return caught.value


@pytest.fixture
def pty():
    """A pseudo-terminal on which nobody answers."""
    master, slave = os.openpty()
    yield os.ttyname(slave)
    os.close(master)
    os.close(slave)


def test_ports_that_do_not_exist_are_both_named(lonely, tmp_path):
    error = failed(lonely(tmp_path / "lms", tmp_path / "span"))
    assert isinstance(error, DeviceNotFound)
    assert code_of(error) == Code.DEVICE
    for name in ("lms", "span"):
        assert f"{tmp_path / name}: there is no such port" in str(error)
    assert "plug the adapter in" in error.hint


def test_a_second_try_at_once_fails_for_the_same_reason(lonely, tmp_path):
    daemon = lonely(tmp_path / "lms", tmp_path / "span")
    assert str(failed(daemon)) == str(failed(daemon)) == str(failed(daemon))


def test_a_port_that_another_program_holds_is_named_with_what_to_do(lonely, pty, tmp_path):
    with open(pty, "rb+", buffering=0) as other:
        fcntl.flock(other, fcntl.LOCK_EX)
        error = failed(lonely(pty, tmp_path / "span"))
    assert f"{pty}: another program holds it" in str(error)
    assert f"fuser -v {pty}" in error.hint
    assert code_of(error) == Code.DEVICE
    assert f"{tmp_path / 'span'}: there is no such port" in str(error)


@pytest.mark.parametrize("kind", ["file", "null", "folder"])
def test_something_that_is_no_serial_port_is_named(lonely, tmp_path, kind):
    path = {"file": tmp_path / "notes.txt", "null": "/dev/null", "folder": tmp_path}[kind]
    if kind == "file":
        path.write_text("precious")
    error = failed(lonely(path, tmp_path / "span"))
    assert str(path) in str(error)
    assert code_of(error) == Code.DEVICE
    if kind == "file":
        assert path.read_text() == "precious"


def test_a_port_that_this_user_may_not_open_is_exit_77(lonely, pty, tmp_path, monkeypatch):
    real = os.open

    def refuse(path, *rest, **more):
        if str(path) == pty:
            raise PermissionError(13, "Permission denied", path)
        return real(path, *rest, **more)

    monkeypatch.setattr(os, "open", refuse)
    error = failed(lonely(pty, tmp_path / "span"))
    assert isinstance(error, DeviceNotPermitted)
    assert code_of(error) == Code.NOT_PERMITTED
    assert "dialout" in error.hint
    assert pty in str(error)


def test_a_port_that_opened_is_free_again_when_another_did_not(lonely, pty, tmp_path):
    failed(lonely(pty, tmp_path / "span"))
    with open(pty, "rb+", buffering=0) as other:
        fcntl.flock(other, fcntl.LOCK_EX | fcntl.LOCK_NB)


def test_a_laser_that_is_silent_is_named_and_the_receiver_left_polite(bench, daemon, pty, monkeypatch):
    monkeypatch.setattr(sick_device, "_ROUNDS", 1)
    monkeypatch.setattr(sick_device, "_FOUND_WITHIN_S", 0.1)
    bench.content["lasers"][0]["port"] = pty
    silent = Service(bench.config)
    try:
        error = failed(silent)
        assert f"{pty}: no laser answers" in str(error)
        assert "power" in error.hint
        assert str(bench.span) not in str(error)
        assert code_of(error) == Code.DEVICE
        status = ask(silent, "STATUS")
        assert status["state"] == "fault"
        assert any(pty in note for note in status["notes"])
        assert not bench.receiver._logs
    finally:
        silent.close()


# --- starting and stopping at once


def test_a_session_that_is_stopped_while_it_starts_says_so_to_who_started_it(bench, lonely, pty, until):
    bench.content["lasers"][0]["port"] = pty
    daemon = Service(bench.config)
    said = []

    def start():
        try:
            said.append(ask(daemon, "START", name=None))
        except Refused as error:
            said.append(error)

    starting = threading.Thread(target=start)
    starting.start()
    until(lambda: ask(daemon, "STATUS")["state"] == "connecting")
    with pytest.raises(Refused, match="being started already") as caught:
        ask(daemon, "START", name=None, force=True)
    assert caught.value.code == Code.BUSY
    assert ask(daemon, "STOP")["state"] == "idle"
    starting.join(10.0)
    (error,) = said
    assert "was stopped" in str(error)
    daemon.close()


def test_a_device_that_does_not_stream_in_time_is_named(lonely, bench, monkeypatch):
    monkeypatch.setattr(service, "_START_S", 0.5)
    monkeypatch.setattr(Device, "_live", lambda *_: time.sleep(0.1))
    daemon = Service(bench.config)
    error = failed(daemon)
    assert "front" in str(error)
    assert "span" in str(error)
    daemon.close()


# --- another configuration


def test_another_configuration_is_taken_for_the_next_session(daemon, bench):
    bench.content["pole"] = {"radius_m": 0.05, "height_m": 2.4}
    assert daemon.reload(bench.config) == ["pole"]
    assert daemon.reload(bench.config) == []
    session = ask(daemon, "START", name=None)["session"]
    told = (bench.config.state_dir / "sessions" / session / "session.yaml").read_text()
    assert "radius_m: 0.05" in told

    bench.content["pole"] = {"radius_m": 0.03, "height_m": 2.4}
    bench.content["accept"] = {"cost_m": 1.0}
    with pytest.raises(Refused, match=f"{session} is running with another pole, accept") as caught:
        daemon.reload(bench.config)
    assert caught.value.code == Code.BUSY
    assert "polecal-field stop" in caught.value.hint
    ask(daemon, "STOP")
    assert daemon.reload(bench.config) == ["pole", "accept"]


def test_while_a_session_is_running_what_is_none_of_its_business_may_change(daemon, bench):
    ask(daemon, "START", name=None)
    bench.content["storage"] = {"min_free_mb": 1}
    assert daemon.reload(bench.config) == ["storage"]


@pytest.mark.parametrize("key", ["state_dir", "runtime_dir"])
def test_a_folder_cannot_move_under_a_daemon(daemon, bench, key, tmp_path):
    bench.content[key] = str(tmp_path / "elsewhere")
    with pytest.raises(Refused, match=f"{key} cannot change") as caught:
        daemon.reload(bench.config)
    assert "systemctl restart" in caught.value.hint
    assert not (tmp_path / "elsewhere").exists()


# --- a process of its own


def test_on_sighup_the_file_is_read_again_whole_or_all_stays_as_it_was(bench, running, until):
    with running(bench) as daemon:
        logged = bench.folder / "polecald.log"

        def reload(expected):
            before = len(logged.read_text().splitlines())
            bench.config_file.write_text(text)
            daemon.send_signal(signal.SIGHUP)
            lines = until(lambda: [json.loads(line) for line in logged.read_text().splitlines()[before:]])
            until(lambda: expected in logged.read_text().splitlines()[before])
            return lines[0]

        good = bench.config_file.read_text()
        text = good.replace("radius_m: 0.04", "radius_m: -0.04") + "poles: 2\n"
        said = reload("configuration not reloaded")
        assert "pole.radius_m" in said["problem"]
        assert "poles: is not a key" in said["problem"]
        text = good.replace("radius_m: 0.04", "radius_m: 0.05")
        assert reload("configuration reloaded")["changed"] == "pole"
        assert daemon.poll() is None
        told = (start(bench) / "session.yaml").read_text()
        assert "radius_m: 0.05" in told


def start(bench):
    with Client(bench.config.socket, 30.0) as client:
        session = client.request({"class": "START", "name": None})["session"]
        while client.request({"class": "STATUS"})["state"] != "collecting":
            time.sleep(0.05)
    return bench.config.state_dir / "sessions" / session


def test_killed_it_leaves_a_capture_to_replay_and_told_to_end_a_closed_one(bench, running, tmp_path):
    with running(bench) as daemon:
        killed = start(bench)
        daemon.kill()
        daemon.wait(10.0)
        killed_ns = time.monotonic_ns()
    assert not bench.polite()  # nobody could
    capture = recorder.read(killed / "capture.mcap")
    items = list(capture)
    assert "is cut off" in capture.cut
    assert (killed_ns - items[-1].t_ns) / 1e9 < 1.0
    outcome = replay(killed / "capture.mcap", None, tmp_path / "out", None)
    assert outcome.status["devices"][1]["ins_status"] == "INS_SOLUTION_GOOD"
    assert outcome.cut

    with running(bench) as daemon:  # the devices stream still, and the socket lies about
        ended = start(bench)
        assert ended != killed
        daemon.send_signal(signal.SIGTERM)
        assert daemon.wait(20.0) == 0
    assert bench.polite()
    assert not bench.config.socket.exists()
    capture = recorder.read(ended / "capture.mcap")
    events = [item.content for item in capture if isinstance(item, recorder.Event)]
    assert capture.cut is None
    last = [event for event in events if event["event"] == "state"][-1]
    assert last["new"] == "idle"
    assert "stopped" in last["why"]
