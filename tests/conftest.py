"""Where the recorded data and the protocol vectors are, if they are here at all."""

import os
from pathlib import Path

import pytest

SHARED = Path(__file__).resolve().parents[2] / "shared"


def _folder(path: Path) -> Path:
    if not path.is_dir():
        pytest.skip(f"no data at {path}")
    return path


@pytest.fixture(scope="session")
def captures() -> Path:
    """Recorded serial data of real devices."""
    return _folder(Path(os.environ.get("POLECAL_CAPTURES", SHARED / "captures")))


@pytest.fixture(scope="session")
def protocol() -> Path:
    """The protocol sheets' own telegrams and messages."""
    return _folder(SHARED / "protocol")


@pytest.fixture
def tell(record_property):
    """Take a line that says what a test measured; all are listed at the end of the run."""
    return lambda line: record_property("told", line)


def pytest_terminal_summary(terminalreporter):
    """List what the tests measured, also where they ran in other processes."""
    terminalreporter.section("measured")
    for reports in terminalreporter.stats.values():
        for report in reports:
            told = [value for name, value in getattr(report, "user_properties", ()) if name == "told"]
            if told and report.when == "call":
                terminalreporter.write_line(report.nodeid)
                for line in told:
                    terminalreporter.write_line(f"  {line}")
