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
