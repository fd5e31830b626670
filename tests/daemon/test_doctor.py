"""Each fault that the field is known for is caused on emulated devices, and told apart from the others."""

import contextlib
import json
import os
import subprocess
import sys
import threading
import time
from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest
import yaml

from polecal.daemon import config as configuration
from polecal.daemon import doctor, field, findings
from polecal.daemon.doctor import examine, exit_code, in_words
from polecal.daemon.ports import System
from polecal.drivers.emulated import laser_telegrams as lms
from polecal.drivers.emulated.laser import EmulatedLaser
from polecal.drivers.emulated.laser_telegrams import Health
from polecal.drivers.emulated.receiver import EmulatedReceiver
from polecal.drivers.emulated.serve import serve
from polecal.drivers.novatel_span.enums import MessageId, UtcStatus
from polecal.drivers.novatel_span.probe import Probe as SpanProbe
from polecal.drivers.novatel_span.probe import probe as span_probe
from polecal.drivers.port import Port
from polecal.drivers.sick_lms.probe import Probe as LmsProbe

GPS_EPOCH_S, LEAP_S, WEEK_S = 315_964_800, 18, 604_800
NOBODY = 65534
UP_S = 2  # since when the devices have been running


class Silent:
    """A line with nothing on it."""

    def receive(self, t_ns, data, host_baud):
        pass

    def transmit(self, t_ns, host_baud):
        return b""

    def next_ns(self):
        return None


class Echo(Silent):
    """A line whose two pairs are joined."""

    def __init__(self):
        self._back = b""

    def receive(self, t_ns, data, host_baud):
        self._back += data

    def transmit(self, t_ns, host_baud):
        back, self._back = self._back, b""
        return back


class Through(Silent):
    """A device behind wires that change what comes through them."""

    def __init__(self, device, to_host=bytes, to_device=bytes):
        self._device, self._to_host, self._to_device = device, to_host, to_device

    def receive(self, t_ns, data, host_baud):
        if data := self._to_device(data):
            self._device.receive(t_ns, data, host_baud)

    def transmit(self, t_ns, host_baud):
        return self._to_host(self._device.transmit(t_ns, host_baud))

    def next_ns(self):
        return self._device.next_ns()


def inverted(data):
    """What a UART makes of a line whose + and − are exchanged."""
    return bytes(~byte & 0xFF for byte in data)


def nothing(data):
    return b""


def gps_now():
    week, s = divmod(time.time() - UP_S - GPS_EPOCH_S + LEAP_S, WEEK_S)
    return {"gps_week": int(week), "gps_s0": s}


@pytest.fixture
def make_laser(parked):
    return partial(EmulatedLaser, parked(), t0_ns=time.monotonic_ns() - UP_S * 10**9)


@pytest.fixture
def make_receiver(parked):
    usual = {"baud": 230400, "aligned_after_s": -9.0}

    def make(**how):
        now_ns = time.monotonic_ns() - UP_S * 10**9
        return EmulatedReceiver(parked(), t0_ns=now_ns, **usual | gps_now() | how)

    return make


@pytest.fixture
def site(tmp_path, make_laser, make_receiver, parked):
    """Devices on pseudo-terminals, by default healthy ones, and what a doctor says of them."""

    class Site:
        lms, span, config_file = tmp_path / "lms", tmp_path / "span", tmp_path / "polecal.yaml"

        def __init__(self):
            mount = dict.fromkeys(configuration.Mount.model_fields, 0)
            self.content = {
                "state_dir": str(tmp_path / "state"),
                "runtime_dir": str(tmp_path / "run"),
                "lasers": [{"port": str(self.lms), "mount": mount}],
                "navigation": {"port": str(self.span)},
                "pole": {"radius_m": 0.04, "height_m": 2.4},
            }

        @property
        def config(self):
            self.config_file.write_text(yaml.safe_dump(self.content))
            return configuration.load(self.config_file)

        @contextlib.contextmanager
        def with_devices(self, laser=None, receiver=None):
            ready, stop = threading.Event(), threading.Event()
            devices = {str(self.lms): laser or make_laser(), str(self.span): receiver or make_receiver()}
            thread = threading.Thread(
                target=serve, args=(devices,), kwargs={"stop": stop, "ready": lambda _: ready.set()}
            )
            thread.start()
            assert ready.wait(5)
            try:
                yield self
            finally:
                stop.set()
                thread.join()

        def checks(self, laser=None, receiver=None, **how):
            with self.with_devices(laser, receiver):
                return self.examine(**how)

        def examine(self, **how):
            checks = examine(self.config, self.config.socket, system=System(tmp_path / "root"), **how)
            return {check.name: check for check in checks}

    return Site()


@pytest.fixture
def few_rates(monkeypatch):
    """Fewer rates to try, as in real time each takes its while; tests of the probes try them all."""
    monkeypatch.setattr(doctor, "_LMS_RATES", (500000, 9600))
    monkeypatch.setattr(doctor, "SPAN_RATES", (230400, 9600))


def assert_only(checks, name, state, *words, code):
    """One check is not well, it says these words and what to do, and the exit code is its."""
    bad = {check.name: check for check in checks.values() if check.state in ("warn", "fault")}
    assert set(bad) == {name}, bad
    check = bad[name]
    assert check.state == state
    for word in words:
        assert word in f"{check.what} -> {check.hint}", check
    assert check.hint
    assert exit_code(checks.values()) == code


def test_healthy_devices_are_well_in_every_respect(site):
    checks = site.checks()
    assert {check.state for check in checks.values()} == {"ok"}, checks
    assert exit_code(checks.values()) == 0
    assert list(checks) == [
        *("daemon", "disk"),
        *("front port", "front line", "front laser", "front health"),
        *("span port", "span line", "span receiver", "span time", "span INS", "span position"),
        *("span lever arm", "clock"),
    ]
    assert "V02.10" in checks["front laser"].what
    assert "OEM719N" in checks["span receiver"].what


def test_devices_are_left_as_they_are_found_also_in_the_midst_of_their_streams(
    site, make_laser, make_receiver
):
    laser = make_laser(eeprom=lms.STREAM_CONFIG)
    laser.force_stream(time.monotonic_ns())
    receiver = make_receiver()
    receiver.force_logs(time.monotonic_ns(), [("INSPVASB", 0.01), ("BESTPOSB", 1.0)])
    before = laser.mode, laser.baud, laser.config, laser.variant, receiver.baud, set(receiver._logs)
    checks = site.checks(laser, receiver)
    assert {check.state for check in checks.values()} == {"ok"}, checks
    after = laser.mode, laser.baud, laser.config, laser.variant, receiver.baud, set(receiver._logs)
    assert after == before
    assert laser.streaming
    assert laser.eeprom_writes == 0


def test_no_permission(site):
    with site.with_devices():
        os.chmod(site.span, 0o620 if os.geteuid() == 0 else 0)
        os.chmod(site.lms, 0o666)
        site.content["lasers"][0]["port"] = os.path.realpath(site.lms)  # nobody gets into our folders
        site.content["navigation"]["port"] = os.path.realpath(site.span)
        config = site.config
        if os.geteuid() == 0:
            os.seteuid(NOBODY)
        try:
            checks = {check.name: check for check in examine(config, Path("/none.sock"))}
        finally:
            if os.getuid() == 0:
                os.seteuid(0)
    check = checks["span port"]
    assert check.state == "fault"
    assert "may not open it" in check.what
    assert "usermod" in check.hint or "udev rule" in check.hint
    assert exit_code(checks.values()) == 77
    assert checks["front line"].state == "ok"  # the other one is looked at all the same


@pytest.mark.parametrize("program", ["ModemManager", "brltty", "minicom"])
def test_a_port_that_another_program_holds_names_it_and_how_to_be_rid_of_it(site, tmp_path, program):
    holder = tmp_path / program
    holder.symlink_to(sys.executable)
    code = (
        "import os, sys; os.open(sys.argv[1], os.O_RDWR | os.O_NOCTTY); print(flush=True); sys.stdin.read()"
    )
    with (
        site.with_devices(),
        subprocess.Popen(
            [holder, "-S", "-c", code, os.path.realpath(site.lms)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
        ) as process,
    ):
        process.stdout.readline()
        checks = site.examine()
        process.stdin.close()
    hint = {"ModemManager": "ID_MM_DEVICE_IGNORE", "brltty": "brltty-udev"}.get(
        program, f"kill {process.pid}"
    )
    assert_only(checks, "front port", "fault", f"{program} (pid {process.pid})", hint, code=75)


def test_a_port_that_is_locked_by_who_cannot_be_seen_names_who_may_be_it(site, tmp_path):
    suspect = tmp_path / "ModemManager"
    suspect.symlink_to(sys.executable)
    with (
        site.with_devices(),
        Port(str(site.lms), 9600),  # its own process is not looked for
        subprocess.Popen([suspect, "-S", "-c", "input()"], stdin=subprocess.PIPE) as process,
    ):
        checks = site.examine()
        process.communicate(b"\n")
    assert_only(
        checks, "front port", "fault", "another program holds it", "fuser", "ModemManager runs", code=75
    )


def test_a_port_that_is_not_there_says_which_are(site, tmp_path):
    by_id = tmp_path / "root/dev/serial/by-id"
    by_id.mkdir(parents=True)
    (by_id / "usb-FTDI_A1B2").touch()
    site.content["lasers"][0]["port"] = "/dev/polecal-gone"
    assert_only(site.checks(), "front port", "fault", "no such port", "usb-FTDI_A1B2", code=4)
    site.content["lasers"][0]["port"] = str(site.config_file)
    assert_only(site.checks(), "front port", "fault", "is no serial port", code=4)


def test_a_usb_adapter_that_gathers_bytes_is_told(site, tmp_path):
    with site.with_devices():
        device = tmp_path / "root/sys/bus/usb-serial/devices" / Path(os.path.realpath(site.lms)).name
        device.mkdir(parents=True)
        (device / "latency_timer").write_text("16\n")
        assert_only(site.examine(), "front latency", "warn", "16 ms", "latency_timer", code=1)
        (device / "latency_timer").write_text("1\n")
        assert site.examine()["front latency"].state == "ok"


def test_a_rate_that_is_not_the_configured_one_is_told(site, make_laser, make_receiver):
    checks = site.checks(make_laser(baud=38400))
    assert_only(checks, "front line", "warn", "38400", "500000", code=1)
    checks = site.checks(receiver=make_receiver(baud=9600))
    assert_only(checks, "span line", "warn", "9600", "230400", "SAVECONFIG", code=1)


def test_an_adapter_that_cannot_do_the_rate_is_told(site):
    laser, navigation = site.config.lasers[0], site.config.navigation
    (check,) = findings.of_laser(laser, LmsProbe(cannot=(500000,)), None)
    assert (check.state, check.code) == ("fault", 4)
    assert "cannot do 500000" in check.what
    (check,) = findings.of_receiver(navigation, SpanProbe(cannot=(230400,)), None)
    assert "cannot do 230400" in check.what


@pytest.mark.parametrize(
    ("wires", "says"),
    [
        (lambda _: Silent(), ("not a byte comes", "minute to start", "pins 7 and 8")),
        (lambda _: Echo(), ("an echo", "joined", "two-wire")),
        (
            lambda laser: Through(laser, to_host=inverted),
            ("at none of", "telegram", "+ and −"),
        ),
        (
            lambda laser: Through(laser, to_device=nothing),
            ("heard at 500000", "does not hear"),
        ),
    ],
    ids=["silence", "echo", "noise", "deaf"],
)
@pytest.mark.usefixtures("few_rates")
def test_what_wires_do_to_a_laser_is_told_apart(site, make_laser, wires, says):
    laser = make_laser()
    laser.force_stream(time.monotonic_ns())
    assert_only(site.checks(wires(laser)), "front line", "fault", *says, code=4)


@pytest.mark.parametrize(
    ("wires", "says"),
    [
        (lambda _: Silent(), ("not a byte comes", "power")),
        (lambda _: Echo(), ("an echo", "joined")),
        (lambda receiver: Through(receiver, to_host=inverted), ("at none of", "RS-232 or RS-422")),
        (lambda receiver: Through(receiver, to_device=nothing), ("logs come at 230400", "INTERFACEMODE")),
    ],
    ids=["silence", "echo", "noise", "deaf"],
)
@pytest.mark.usefixtures("few_rates")
def test_what_wires_do_to_a_receiver_is_told_apart(site, make_receiver, wires, says):
    receiver = make_receiver()
    receiver.force_logs(time.monotonic_ns(), [("INSPVASB", 0.02)])
    assert_only(site.checks(receiver=wires(receiver)), "span line", "fault", *says, code=4)


@pytest.mark.usefixtures("few_rates")
def test_exchanged_plugs_are_told_at_both_ports(site, make_laser, make_receiver):
    checks = site.checks(make_receiver(), make_laser())
    for name, what in (("front line", "a NovAtel receiver"), ("span line", "a laser")):
        assert checks[name].state == "fault"
        assert what in checks[name].what
        assert "exchanged" in checks[name].hint


def test_an_ins_that_has_not_aligned_is_told(site, make_receiver):
    checks = site.checks(receiver=make_receiver(aligned_after_s=float("inf")))
    assert checks["span INS"].state == "warn"
    assert checks["span INS"].what.startswith("not aligned, ")
    assert "drive" in checks["span INS"].hint
    assert exit_code(checks.values()) == 1


def test_a_receiver_without_time_is_told(site, make_receiver):
    checks = site.checks(receiver=make_receiver(fine_after_s=1e6))
    assert_only(checks, "span time", "warn", "UNKNOWN", "no pulse per second", "antenna", code=1)
    assert checks["span INS"].state == "unknown"
    assert checks["clock"].state == "unknown"


def test_a_receiver_that_knows_no_utc_is_told(site, make_receiver):
    with site.with_devices(), Port(str(site.span), 9600) as port:
        found = span_probe(port, [230400])
    found.said[MessageId.TIME] = replace(found.said[MessageId.TIME], utc_status=UtcStatus.INVALID)
    checks = {check.name: check for check in findings.of_receiver(site.config.navigation, found, None)}
    assert_only(checks, "span time", "warn", "UTC is not known", code=1)


def test_a_lever_arm_of_zero_is_told(site, make_receiver):
    checks = site.checks(receiver=make_receiver(lever_arm_m=(0.0, 0.0, 0.0)))
    assert_only(checks, "span lever arm", "warn", "zero", "SETINSTRANSLATION ANT1", code=1)


def test_a_wrong_host_clock_is_told(site, make_receiver):
    late = gps_now()
    checks = site.checks(receiver=make_receiver(gps_s0=late["gps_s0"] - 300.0))
    assert_only(checks, "clock", "warn", "5 minutes ahead of GPS", "timedatectl", code=1)
    checks = site.checks(receiver=make_receiver(gps_week=late["gps_week"] + 52))
    assert_only(checks, "clock", "warn", "364 days behind GPS", code=1)
    checks = site.checks(receiver=make_receiver(gps_week=late["gps_week"] - 1024))
    assert_only(checks, "clock", "warn", "off by 1024 weeks", "firmware", code=1)


def test_a_disk_that_is_full_or_soon_will_be_is_told(site, small_disk):
    disk = small_disk("64m")
    site.content["state_dir"] = str(disk / "state")
    site.content["storage"] = {"min_free_mb": 60}
    assert_only(site.checks(), "disk", "warn", str(disk), "minutes", code=1)
    site.content["storage"] = {"min_free_mb": 70}
    assert_only(site.checks(), "disk", "fault", "nothing would be recorded", code=1)


def test_a_lasers_own_troubles_are_told(site, make_laser):
    laser = make_laser()
    laser.health = Health(errors=((3, 17),))
    assert_only(site.checks(laser), "front health", "fault", "window pollution", "clean", code=4)
    laser = make_laser(type_string="LMS291;S14;V02.10 ")
    assert_only(site.checks(laser), "front laser", "fault", "another type", "s14", code=4)


def test_an_old_receiver_does_not_tell_its_lever_arm(site, make_receiver):
    from polecal.drivers.emulated.span_generations import OEMV

    checks = site.checks(receiver=make_receiver(generation=OEMV))
    assert checks["span lever arm"].state == "unknown"
    assert checks["span INS"].state == "ok"
    assert exit_code(checks.values()) == 0


def test_it_comes_to_an_end_whatever_the_line_does(site):
    checks = site.checks(Silent(), Silent(), within_s=0.5)
    for name in ("front port", "span port"):
        assert "no end of it" in checks[name].what


@pytest.fixture
def command(capsys):
    def run(*arguments):
        code = field.main([str(argument) for argument in arguments])
        return code, *capsys.readouterr()

    return run


def test_the_verb_prints_a_line_a_check_or_one_object_and_ends_with_the_code(site, command):
    site.config  # noqa: B018
    with site.with_devices():
        code, out, err = command("doctor", "--config", site.config_file)
        assert (code, err) == (0, "")
        assert len(out.splitlines()) == 14
        code, out, _ = command("--json", "doctor", "--config", site.config_file)
    told = json.loads(out)
    assert told["class"] == "DOCTOR"
    assert {tuple(check) for check in told["checks"]} == {("name", "state", "what", "hint")}
    assert code == 0


def test_a_bad_configuration_is_78_and_none_at_all_is_3(tmp_path, command, monkeypatch):
    monkeypatch.setattr(field, "_CONFIG", str(tmp_path / "none.yaml"))
    monkeypatch.delenv("POLECAL_CONFIG", raising=False)
    code, out, err = command("--socket", tmp_path / "none.sock", "doctor")
    assert (code, out) == (3, "")
    assert "--config FILE" in err
    (tmp_path / "bad.yaml").write_text("lasers: []")
    monkeypatch.setenv("POLECAL_CONFIG", str(tmp_path / "bad.yaml"))
    code, _, err = command("doctor")
    assert code == 78
    assert "navigation: is missing" in err


def test_a_running_session_is_asked_and_not_disturbed(bench, running, command, until):
    with running(bench):
        assert command("--socket", bench.config.socket, "start")[0] == 0
        mode, logs = bench.laser.mode, set(bench.receiver._logs)
        code, out, _ = command("--json", "doctor", "--config", bench.config_file)
        checks = {check["name"]: check for check in json.loads(out)["checks"]}
        assert "session" in checks["daemon"]["what"]
        assert "held by polecald" in checks["front port"]["what"]
        assert (bench.laser.mode, set(bench.receiver._logs)) == (mode, logs)
        assert code in (0, 1)  # what a start says of its navigation for a moment
        assert command("--socket", bench.config.socket, "stop")[0] == 0


def test_words_are_wrapped_for_a_terminal_only():
    check = findings.warn("clock", "a word " * 40, "do this " * 40)
    assert all(len(line) <= 80 for line in in_words([check], 80).plain.splitlines())
    assert len(in_words([check]).plain.splitlines()) == 2
    assert doctor.as_message([check])["checks"][0]["state"] == "warn"
