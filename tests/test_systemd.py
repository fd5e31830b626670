"""What is in systemd/ is what systemd takes and the daemon understands; `tests/systemd` runs it."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from polecal.daemon.config import Config, load
from polecal.daemon.service import main

ROOT = Path(__file__).parents[1]
FOLDER = ROOT / "systemd"
UNIT = FOLDER / "polecal.service"
EXAMPLE = FOLDER / "polecal.yaml"

PLAIN = {"PATH": "/usr/sbin:/usr/bin:/sbin:/bin"}

analyzed = pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="no systemd-analyze here")


@pytest.fixture
def unit(tmp_path):
    """The unit, its program one that is there."""
    path = tmp_path / UNIT.name
    path.write_text(UNIT.read_text().replace("/opt/polecal/bin/polecald", sys.executable))
    return path


def analyze(*arguments):
    command = ["systemd-analyze", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, check=False)


@analyzed
def test_unit_has_no_key_that_systemd_does_not_know(unit):
    done = analyze("verify", "--man=no", unit)
    about_it = [line for line in done.stderr.splitlines() if UNIT.name in line]
    assert about_it == []  # a misspelt key exits 0


@analyzed
def test_a_misspelt_key_would_be_found(unit):
    unit.write_text(unit.read_text().replace("ProtectHome=", "ProtectHmoe="))
    assert "ProtectHmoe" in analyze("verify", "--man=no", unit).stderr


@pytest.fixture
def with_page(unit):
    """The unit with the drop-in for the page."""
    folder = unit.with_name(f"{unit.name}.d")
    folder.mkdir()
    shutil.copy(FOLDER / "page.conf", folder)
    return unit


@analyzed
def test_the_pages_drop_in_has_no_key_that_systemd_does_not_know(with_page):
    done = analyze("verify", "--man=no", with_page)
    assert [line for line in done.stderr.splitlines() if "page.conf" in line or UNIT.name in line] == []
    drop_in = with_page.with_name(f"{UNIT.name}.d") / "page.conf"
    drop_in.write_text(drop_in.read_text().replace("SocketBindAllow=", "SocketBnidAllow="))
    assert "SocketBnidAllow" in analyze("verify", "--man=no", with_page).stderr


@analyzed
def test_the_pages_drop_in_opens_one_port_to_this_machine_and_nothing_else(with_page):
    before, after = closed_by(UNIT), closed_by(with_page)
    assert before - after == {"PrivateNetwork=", "IPAddressDeny=", "RestrictAddressFamilies=~AF_(INET|INET6)"}
    said = (FOLDER / "page.conf").read_text()
    keys = [line for line in said.splitlines() if line and line[0] not in "#["]
    assert keys == [
        "PrivateNetwork=no",
        "RestrictAddressFamilies=AF_INET AF_INET6",
        "SocketBindAllow=tcp:8291",
        "IPAddressAllow=localhost",
    ]


def closed_by(unit):
    """The restrictions that systemd finds in a unit."""
    done = analyze("security", "--offline=true", "--no-pager", unit)
    return {line.split()[1] for line in done.stdout.splitlines() if line.startswith("✓")}


@analyzed
def test_unit_is_as_closed_as_a_serial_daemon_can_be(unit):
    done = analyze("security", "--offline=true", "--no-pager", unit)
    (exposure,) = re.findall(r"Overall exposure level .*?: ([\d.]+)", done.stdout)
    assert float(exposure) <= 1.0, done.stdout


def test_paths_are_those_of_the_configuration():
    text = UNIT.read_text()
    for key in ("state_dir", "runtime_dir"):
        folder = Config.model_fields[key].default
        directive = {"state_dir": "StateDirectory", "runtime_dir": "RuntimeDirectory"}[key]
        assert f"{directive}={folder.name}\n" in text


def test_a_protection_that_is_off_is_given_a_reason_in_the_unit():
    text = UNIT.read_text()
    said = " ".join(line for line in text.splitlines() if line.startswith("#"))
    for key in ("PrivateDevices=", "PrivateUsers=", "RootDirectory=", "RestrictRealtime="):
        assert f"\n{key}" not in text
        assert key in said
    assert "AF_UNIX is on" in said


def test_the_example_configuration_can_be_used_and_has_the_units_folders(capsys):
    assert main(["--config", str(EXAMPLE), "--check-config"]) == 0
    assert capsys.readouterr().err == ""
    config = load(EXAMPLE)
    assert config.state_dir == Path("/var/lib/polecal")
    assert config.runtime_dir == Path("/run/polecal")


def test_the_example_configuration_says_the_defaults_and_each_line_says_what_it_is():
    config = load(EXAMPLE)
    (laser,) = config.lasers
    needed = {"lasers": [{"port": laser.port, "mount": laser.mount}]}
    needed |= {"navigation": {"port": config.navigation.port}, "pole": config.pole}
    assert config == Config.model_validate(needed)
    for part in ("lasers", "navigation", "pole", "routine", "accept", "storage"):
        (line,) = [line for line in EXAMPLE.read_text().splitlines() if line.startswith(f"{part}:")]
        following = EXAMPLE.read_text().split(line)[1].split("\n\n")[0]
        assert "#" in line + following


def test_the_examples_ports_are_those_that_the_names_rules_make():
    config = load(EXAMPLE)
    made = re.findall(r'SYMLINK\+="([^"]+)"', (FOLDER / "polecal-names.rules").read_text())
    assert {f"/dev/{name}" for name in made} == {config.lasers[0].port, config.navigation.port}


def test_the_modules_are_those_that_the_unit_wants():
    modules = [
        line for line in (FOLDER / "polecal.modules-load.conf").read_text().split("\n") if line[:1] != "#"
    ]
    for module in filter(None, modules):
        assert f"modprobe@{module}.service" in UNIT.read_text()


# --- the install script; tests/systemd runs it for real


def script(*arguments, **environment):
    command = [FOLDER / "install", *arguments]
    environment = os.environ | environment
    return subprocess.run(command, capture_output=True, text=True, check=False, env=environment)


def test_it_is_plain_shell():
    done = subprocess.run(["sh", "-n", FOLDER / "install"], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    assert (FOLDER / "install").read_text().startswith("#!/bin/sh\n")


def test_a_dry_run_names_every_file_and_does_nothing():
    if not Path("/usr/bin/python3").exists():
        pytest.skip("no /usr/bin/python3 here")
    before = sorted(path.name for path in ROOT.iterdir())
    there = Path("/opt/polecal").exists()
    done = script("--dry-run")
    assert done.returncode == 0, done.stderr
    shipped = {f"systemd/{path.name}" for path in FOLDER.iterdir()} - {"systemd/install"}
    named = set(re.findall(r"systemd/[\w.-]+", done.stdout))
    stays = {f"systemd/{Path(path).name}" for path in re.findall(r"(\S+) stays as it is", done.stderr)}
    assert shipped - named <= {name.replace("71-", "") for name in stays}
    assert "venv --without-pip /opt/polecal" in done.stdout or there
    assert Path("/opt/polecal").exists() == there
    assert sorted(path.name for path in ROOT.iterdir()) == before


def test_an_option_that_it_does_not_know_is_a_usage_error():
    done = script("--force")
    assert done.returncode == 2
    assert "usage" in done.stderr


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can be somebody else")
def test_who_is_not_root_is_told_how():
    command = f"cd {FOLDER} && exec ./install"
    done = subprocess.run(
        ["/bin/sh", "-c", command], capture_output=True, text=True, check=False, user=65534, env=PLAIN
    )
    if "Permission denied" in done.stderr:
        pytest.skip("another user cannot read this tree")
    assert done.returncode == 1
    assert "hint: sudo systemd/install" in done.stderr


def test_an_interpreter_that_will_not_do_is_refused_before_anything_is_done(tmp_path):
    old = tmp_path / "python3"
    old.write_text('#!/bin/sh\n[ "$1" = --version ] && echo Python 3.9.2\nexit 1\n')
    old.chmod(0o755)
    done = script("--dry-run", PYTHON=str(old))
    assert (done.returncode, done.stdout) == (1, "")
    assert "Python 3.9.2 is too old" in done.stderr
    assert "hint:" in done.stderr
    done = script("--dry-run", PYTHON=str(tmp_path / "none"))
    assert (done.returncode, done.stdout) == (1, "")
    assert "apt-get install python3" in done.stderr
