"""polecal as a service under a real systemd: started, watched, killed, reloaded, stopped, and at work."""

import json
import re
import time
from os import SCHED_OTHER, SCHED_RR

import pytest
import yaml

from polecal.daemon import recorder


def test_it_comes_up_ready_hardened_and_says_what_to_do(polecal):
    polecal.systemctl("start", "polecal")
    assert polecal.show("ActiveState") == "active"
    assert polecal.show("SubState") == "running"
    polecal.says("idle: polecal-field start")
    status = dict(
        line.split(":", 1)
        for line in polecal.path(f"/proc/{polecal.show('MainPID')}/status").read_text().splitlines()
    )
    assert int(status["CapEff"], 16) == int(status["CapBnd"], 16) == 0
    assert status["NoNewPrivs"].strip() == "1"
    assert status["Seccomp"].strip() == "2"
    about = polecal.run("stat", "--format=%U %G %a %F", "/run/polecal/control.sock", "/run/polecal").stdout
    assert about.splitlines() == ["polecal polecal 660 socket", "polecal polecal 750 directory"]
    assert polecal.run("polecal-field", "status").returncode == 0
    refused = polecal.run("runuser", "-u", "nobody", "--", "polecal-field", "status", check=False)
    assert refused.returncode == 77
    assert "usermod -aG polecal" in refused.stderr
    assert "asked" in polecal.journal
    assert "uid=0 request=STATUS" in polecal.journal


def test_what_reads_the_lines_goes_before_all_else(polecal):
    # in place of LimitRTPRIO=, which in a container even root may not raise; all else is as in the unit
    may = "[Service]\nCapabilityBoundingSet=CAP_SYS_NICE\nAmbientCapabilities=CAP_SYS_NICE\n"
    drop_in = polecal.path("/etc/systemd/system/polecal.service.d/may.conf")
    drop_in.parent.mkdir()
    drop_in.write_text(may)
    polecal.systemctl("daemon-reload")
    polecal.systemctl("start", "polecal")
    polecal.collecting()
    tasks = polecal.path(f"/proc/{polecal.show('MainPID')}/task").glob("*/stat")
    policies = [int(task.read_text().rpartition(")")[2].split()[38]) for task in tasks]  # proc(5), field 41
    assert policies.count(SCHED_RR) == 2
    assert set(policies) == {SCHED_RR, SCHED_OTHER}


def test_a_bad_configuration_is_said_and_not_tried_again(polecal):
    polecal.configure(pole={"radius_m": -1})
    assert polecal.systemctl("start", "polecal", check=False).returncode != 0
    assert polecal.show("ActiveState") == "failed"
    assert polecal.show("ExecMainStatus") == "78"
    assert polecal.show("NRestarts") == "0"
    assert "pole.radius_m" in polecal.journal


def test_a_daemon_that_is_stuck_is_ended_by_the_watchdog_and_starts_again(polecal, until, tell):
    polecal.override("WatchdogSec=2\nRestartSec=100ms")
    polecal.systemctl("start", "polecal")
    first = polecal.show("MainPID")
    began_s = time.monotonic()
    polecal.run("kill", "-STOP", first)
    until(lambda: polecal.show("NRestarts") == "1" and polecal.show("ActiveState") == "active")
    tell(f"stopped, ended by the watchdog of 2 s and ready again: {time.monotonic() - began_s:.1f} s")
    assert polecal.show("MainPID") not in (first, "0")
    assert "Watchdog timeout" in polecal.journal
    assert "Fatal Python error: Aborted" in polecal.journal  # and where each thread was
    assert "in _attend" in polecal.journal
    assert polecal.ask("STATUS")["state"] == "idle"


def test_devices_that_fall_silent_and_go_are_no_reason_for_the_watchdog(polecal, until):
    polecal.override("WatchdogSec=4")
    polecal.systemctl("start", "polecal")
    first = polecal.show("MainPID")
    polecal.collecting()
    polecal.systemctl("kill", "--signal=STOP", "emulated")
    polecal.says("/run/emulated/span", timeout_s=20.0)
    polecal.systemctl("kill", "--signal=KILL", "emulated")
    polecal.says("/run/emulated/lms", "no such port", timeout_s=20.0)
    gone_s = time.monotonic()
    until(lambda: time.monotonic() - gone_s > 6.0)
    assert (polecal.show("MainPID"), polecal.show("NRestarts")) == (first, "0")


def test_killed_it_starts_again_and_repairs_the_session_that_was_running(polecal, until, tell):
    polecal.override("RestartSec=100ms")
    polecal.systemctl("start", "polecal")
    first = polecal.show("MainPID")
    folder = polecal.collecting()
    polecal.run("kill", "-KILL", first)
    killed_ns = time.monotonic_ns()
    until(lambda: "capture repaired" in polecal.journal, 30.0)
    assert polecal.show("NRestarts") == "1"
    (said,) = [line for line in polecal.journal.splitlines() if "capture repaired" in line]
    assert folder.name in said
    capture = recorder.read(folder / "capture.mcap")
    items = list(capture)
    assert capture.cut is None
    assert (killed_ns - items[-1].t_ns) / 1e9 < 1.0
    tell(f"kill -9: {len(items)} chunks kept, the last {(killed_ns - items[-1].t_ns) / 1e6:.0f} ms before")
    assert polecal.ask("START", name="again", force=True)["session"] != folder.name


def test_a_stop_takes_less_than_5_s_and_closes_the_capture(polecal, tell):
    polecal.systemctl("start", "polecal")
    folder = polecal.collecting()
    began_s = time.monotonic()
    polecal.systemctl("stop", "polecal")
    took_s = time.monotonic() - began_s
    tell(f"stopped while collecting: {took_s:.1f} s")
    assert took_s < 5.0
    assert (polecal.show("ActiveState"), polecal.show("Result")) == ("inactive", "success")
    capture = recorder.read(folder / "capture.mcap")
    events = [item.content for item in capture if isinstance(item, recorder.Event)]
    states = [(event["new"], event["why"]) for event in events if event["event"] == "state"]
    assert capture.cut is None
    assert states[-1] == ("idle", "the daemon is stopped")
    assert not polecal.path("/run/polecal").exists()


def test_a_stop_is_no_longer_with_devices_that_do_not_answer(polecal, tell):
    polecal.systemctl("start", "polecal")
    folder = polecal.collecting()
    polecal.systemctl("kill", "--signal=STOP", "emulated")
    began_s = time.monotonic()
    polecal.systemctl("stop", "polecal")
    took_s = time.monotonic() - began_s
    polecal.systemctl("kill", "--signal=KILL", "emulated")
    tell(f"stopped with devices that are silent: {took_s:.1f} s")
    assert took_s < 5.0
    assert polecal.show("Result") == "success"
    capture = recorder.read(folder / "capture.mcap")
    assert any(True for _ in capture)
    assert capture.cut is None


def test_a_reload_takes_the_file_as_a_whole_or_says_why_not(polecal, until):
    polecal.systemctl("start", "polecal")
    first = polecal.show("MainPID")
    polecal.configure(pole={"radius_m": -1}, poles=2)
    polecal.systemctl("reload", "polecal")
    polecal.says("idle", "configuration not reloaded", "pole.radius_m", "poles: is not a key")
    folder = polecal.collecting()
    assert "radius_m: 0.04" in (folder / "session.yaml").read_text()
    polecal.configure(pole={"radius_m": 0.05, "height_m": 2.4})
    polecal.systemctl("reload", "polecal")
    polecal.says("collecting", f"configuration not reloaded: session {folder.name} is running")
    assert "radius_m: 0.04" in (folder / "session.yaml").read_text()
    polecal.ask("STOP")
    polecal.systemctl("reload", "polecal")
    until(lambda: "configuration not reloaded" not in polecal.show("StatusText"))
    assert "configuration reloaded changed=pole" in polecal.journal
    assert "radius_m: 0.05" in (polecal.collecting() / "session.yaml").read_text()
    assert (polecal.show("MainPID"), polecal.show("ActiveState")) == (first, "active")


@pytest.mark.realtime
def test_the_hardened_service_calibrates_with_devices_on_pseudo_terminals(polecal, until, tell):
    loose = {"xy_m": 1.0, "z_m": 1.0, "roll_deg": 5.0, "pitch_deg": 5.0, "yaw_deg": 5.0}
    polecal.configure(routine={"slices_needed": 3}, accept={"cost_m": 0.2, "max_sigma": loose})
    polecal.systemctl("start", "polecal")
    began_s = time.monotonic()
    folder = polecal.collecting()
    waiting = polecal.run("polecal-field", "wait", "--timeout", "150", timeout_s=170.0)
    assert waiting.returncode == 0
    tell(f"accepted {time.monotonic() - began_s:.0f} s after the start of the unit")
    result = polecal.ask("RESULT")
    true = yaml.safe_load(polecal.path("/run/truth").read_text())["mount"]
    (laser,) = result["lasers"]
    assert (laser["session"], result["state"]) == (folder.name, "accepted")
    assert abs(laser["estimate"]["yaw_deg"] - true["yaw_deg"]) < 0.5
    polecal.says("accepted: ", "passes")
    until(lambda: "capture indexed" in polecal.journal, 120.0)  # at a low priority
    until((folder / "report.html").is_file, 240.0)
    assert "Traceback" not in polecal.journal
    assert (folder / "calibration.yaml").is_file()


# --- install, again, and away

CHANGED = (
    "/etc/systemd/system/polecal.service",
    "/etc/sysusers.d/polecal.conf",
    "/etc/modules-load.d/polecal.conf",
    "/etc/udev/rules.d/70-polecal.rules",
    "/usr/local/bin/polecald",
    "/usr/local/bin/polecal-field",
    "/usr/local/share/man/man1/polecal-field.1",
    "/usr/local/share/man/man5/polecal.yaml.5",
    "/usr/local/share/man/man8/polecald.8",
    "/opt/polecal/bin/polecald",
    "/usr/local/share/bash-completion/completions/polecal-field",
)
OPERATORS = ("/etc/polecal/polecal.yaml", "/etc/udev/rules.d/71-polecal-names.rules")


def test_installed_again_it_keeps_what_the_operator_wrote_and_uninstalled_too(image):
    edit = "".join(f"echo '# mine' >>{path}; " for path in OPERATORS)
    spoil = "echo nonsense >/etc/systemd/system/polecal.service; rm /usr/local/bin/polecald; "
    show = f"md5sum {' '.join(OPERATORS)}; cat /etc/systemd/system/polecal.service; polecald --version; "
    again = image.run(
        "again", f"{edit}{spoil}{show.replace('polecald --version;', '')} systemd/install; {show}"
    )
    assert again.returncode == 0, again.stderr
    before, after = again.stdout.split("nonsense\n")
    assert len(before.splitlines()) == 2
    assert before in after
    assert "WatchdogSec=" in after
    for path in OPERATORS:
        assert f"{path} stays as it is" in again.stderr

    look = f"ls -d {' '.join(CHANGED)} {' '.join(OPERATORS)} /opt/polecal 2>/dev/null || true; id -un polecal"
    gone = image.run("gone", f"{edit} systemd/install --uninstall; systemd/install --uninstall; {look}")
    assert gone.returncode == 0, gone.stderr
    assert gone.stdout.split() == [*OPERATORS, "polecal"]


@pytest.mark.parametrize("arguments", [[], ["--uninstall"]])
def test_while_a_session_is_running_nothing_is_installed_or_taken_away(polecal, arguments):
    polecal.systemctl("start", "polecal")
    first = polecal.show("MainPID")
    polecal.collecting()
    done = polecal.run("/mnt/systemd/install", *arguments, check=False)
    assert done.returncode == 1
    assert "a session is running: collecting" in done.stderr
    assert "hint: end it first: polecal-field stop" in done.stderr
    assert polecal.show("MainPID") == first
    assert polecal.ask("STATUS")["state"] == "collecting"


def test_the_installed_files_are_the_projects_and_the_service_starts_at_boot(image):
    look = f"ls -dL {' '.join(CHANGED)}; systemctl is-enabled polecal; "
    check = "polecald --config /etc/polecal/polecal.yaml --check-config; id -nG polecal; "
    tree = "cd /opt/polecal/lib/python3*/site-packages/polecal && find . -name '*.py' | sort"
    done = image.run("looked-at", look + check + tree)
    assert done.returncode == 0, done.stderr
    *paths, enabled, groups = done.stdout.splitlines()[: len(CHANGED) + 2]
    assert sorted(paths) == sorted(CHANGED)
    assert enabled == "enabled"
    assert set(groups.split()) == {"polecal", "dialout"}
    modules = done.stdout.splitlines()[len(CHANGED) + 2 :]
    assert "./daemon/service.py" in modules
    assert len(modules) > 50


ASK = """
import http.client
line = http.client.HTTPConnection("127.0.0.1", 8291, timeout=5)
line.request("GET", "/status")
print(line.getresponse().read().decode())
"""


def test_the_page_takes_its_drop_in_and_is_then_there_for_this_machine(polecal, until):
    polecal.configure(page={"listen": "127.0.0.1:8291"})
    polecal.systemctl("start", "polecal")
    until(lambda: "no page yet" in polecal.journal)
    assert "page.conf" in polecal.journal
    assert polecal.ask("STATUS")["state"] == "idle"  # which is no reason not to work
    said = polecal.path("/opt/polecal/page.conf").read_text()
    (install,) = re.findall(r"^#\s+install (-D .*)$", said, re.MULTILINE)
    polecal.run("install", *install.replace("/etc/", "/run/").split())
    polecal.systemctl("daemon-reload")
    polecal.mark()
    polecal.systemctl("restart", "polecal")
    until(lambda: "listen=127.0.0.1:8291" in polecal.journal)
    assert "no page yet" not in polecal.journal
    assert json.loads(polecal.run("python3", "-c", ASK).stdout)["state"] == "idle"
