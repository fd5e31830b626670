"""What the README says is so."""

import re
from pathlib import Path

import numpy as np
import pytest

from polecal.calib import Kind, Returns
from polecal.daemon.config import loads
from polecal.daemon.field import main

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")


def test_its_configuration_can_be_used():
    (text,) = re.findall(r"```yaml\n(.*?)```", README, re.DOTALL)
    config = loads(text)
    assert config.lasers[0].mount.pitch_deg == -8.0


def test_its_python_example_runs(rig_returns):
    (text,) = re.findall(r"```python\n(.*?)```", README, re.DOTALL)
    names = ("range_m", "bearing_rad", "position_m", "rpy_rad", "kind", "pass_id")
    scope = {name: getattr(rig_returns, name) for name in names}
    exec(text, scope)
    assert scope["result"].cost_m < 0.05


@pytest.fixture
def rig_returns():
    rng = np.random.default_rng(0)
    n = 600
    yaw = rng.uniform(0, 2 * np.pi, n)
    position = np.column_stack([-4 * np.cos(yaw), -4 * np.sin(yaw), np.zeros(n)])
    kind = np.where(np.arange(n) % 2, Kind.GROUND, Kind.POLE).astype(np.uint8)
    ranges = np.where(kind == Kind.POLE, 4.0, 7.2) + 0.01 * rng.normal(size=n)
    rpy = np.column_stack([np.zeros(n), np.zeros(n), yaw])
    return Returns(ranges, np.zeros(n), position, rpy, kind, np.arange(n) // 50)


@pytest.mark.parametrize("folder", re.findall(r"^\| `(\w+)/` \|", README, re.MULTILINE))
def test_its_layout_is_that_of_the_tree(folder):
    assert (ROOT / folder).is_dir()


@pytest.mark.parametrize("verb", sorted(set(re.findall(r"polecal-field (\w+)", README))))
def test_every_command_that_it_names_is_there(verb, capsys):
    with pytest.raises(SystemExit) as ended:
        main([verb, "--help"])
    assert ended.value.code == 0
    assert verb in capsys.readouterr().out
