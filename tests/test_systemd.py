"""The unit is one that systemd takes, and that keeps the daemon to what it needs."""

import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

UNIT = Path(__file__).parents[1] / "systemd/polecal.service"

pytestmark = pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="no systemd here")


@pytest.fixture
def unit(tmp_path):
    """The unit, its program one that is there."""
    path = tmp_path / UNIT.name
    path.write_text(UNIT.read_text().replace("/opt/polecal/bin/polecald", sys.executable))
    return path


def analyze(*arguments):
    command = ["systemd-analyze", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, check=False)


def test_unit_has_no_key_that_systemd_does_not_know(unit):
    done = analyze("verify", "--man=no", unit)
    about_it = [line for line in done.stderr.splitlines() if UNIT.name in line]
    assert about_it == []  # a misspelt key exits 0


def test_a_misspelt_key_would_be_found(unit):
    unit.write_text(unit.read_text().replace("ProtectHome=", "ProtectHmoe="))
    assert "ProtectHmoe" in analyze("verify", "--man=no", unit).stderr


def test_unit_is_as_closed_as_a_serial_daemon_can_be(unit):
    done = analyze("security", "--offline=true", "--no-pager", unit)
    (exposure,) = re.findall(r"Overall exposure level .*?: ([\d.]+)", done.stdout)
    assert float(exposure) <= 1.0, done.stdout


def test_paths_are_those_of_the_configuration():
    from polecal.daemon.config import Config

    text = UNIT.read_text()
    for key in ("state_dir", "runtime_dir"):
        folder = Config.model_fields[key].default
        directive = {"state_dir": "StateDirectory", "runtime_dir": "RuntimeDirectory"}[key]
        assert f"{directive}={folder.name}\n" in text
