"""A host whose wall clock is set while a session runs: by hours, and back."""

import ast
import importlib
from collections import Counter
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

import polecal
from polecal.daemon import sessions

SOURCES = Path(polecal.__file__).resolve().parent
WALL_CLOCK = {
    *("time", "time_ns", "localtime", "gmtime", "ctime", "asctime", "strftime"),
    *("now", "utcnow", "today", "clock_gettime", "clock_gettime_ns"),
}
MODULES = ("time", "datetime", "date")


def readers():
    """Count where each module asks for the wall clock."""
    found = Counter()
    for path in sorted(SOURCES.glob("*/**/*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            asks = (
                isinstance(node, ast.Attribute)
                and node.attr in WALL_CLOCK
                and isinstance(node.value, ast.Name)
                and node.value.id in MODULES
            )
            imports = isinstance(node, ast.ImportFrom) and node.module == "time"
            if asks or (imports and WALL_CLOCK & {name.name for name in node.names}):
                found[".".join(path.relative_to(SOURCES).with_suffix("").parts)] += 1
    return found


def test_only_names_and_dates_for_people_are_of_the_wall_clock():
    """A session's name, an import's, when somebody chose; and the doctor compares it with GPS."""
    assert readers() == {
        "daemon.findings": 1,
        "daemon.service": 1,
        "daemon.sessions": 1,
        "daemon.transfer": 1,
    }


@pytest.fixture
def wall(monkeypatch):
    """The wall clock of every module that reads it; may be set."""

    class Wall(datetime):
        off = timedelta()

        @classmethod
        def now(cls, tz=None):
            return datetime.now(tz) + cls.off

    for name in readers():
        monkeypatch.setattr(importlib.import_module(f"polecal.{name}"), "datetime", Wall)
    return Wall


def test_a_wall_clock_that_is_set_in_mid_run_costs_nothing(wall, trial, tell):
    trial.in_mid_pass()
    with trial.fault():
        wall.off = timedelta(hours=5)
        trial.until(lambda: trial.passes() >= 2)
        wall.off = timedelta(hours=-7)
    trial.recovers()
    trial.goes_on()
    trial.untouched("front")
    trial.untouched("span")
    assert trial.ask({"class": "DROP", "pass": "1"})["session"] == trial.session
    tell(trial.line("wall clock set by +5 h, then by -12 h"))


def test_a_session_begun_after_the_clock_was_set_back_still_is_the_last(wall, settings, tmp_path):
    """Else the result of an older one would be given out as the last."""
    config = settings(state_dir=str(tmp_path))
    made = []
    for hours in (0, -5, -5, -100_000, 3):
        wall.off = timedelta(hours=hours)
        session = sessions.create(tmp_path, config, None)
        made.append(session.id)
        session.write_calibration({"state": "accepted", "lasers": [], "of": session.id})
        assert sessions.calibration_of(tmp_path, None)["of"] == session.id
        assert sessions.folder_of(tmp_path, None) == session.folder
        said = (datetime.now(UTC) + wall.off).isoformat(timespec="minutes")[:13]
        assert session.created.startswith(said)  # what the clock said is in it all the same
    assert made == sorted(made)
