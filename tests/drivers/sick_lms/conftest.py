"""The sheet's telegrams and the real laser's, for all tests of the driver."""

import json
from pathlib import Path
from typing import Any

import pytest

Entry = dict[str, Any]


@pytest.fixture(scope="session")
def sheet(protocol: Path) -> list[Entry]:
    """Every telegram of the sheet; its bytes under ``data`` where it is printed whole."""
    entries: list[Entry] = json.loads((protocol / "sick-telegrams.json").read_text())
    for entry in entries:
        if ".." not in entry["hex"]:
            entry["data"] = bytes.fromhex(entry["hex"])
    return entries


@pytest.fixture(scope="session")
def usable(sheet: list[Entry]) -> dict[str, bytes]:
    """The telegrams that are right, by name."""
    return {entry["name"]: entry["data"] for entry in sheet if entry["usable"]}


@pytest.fixture(scope="session")
def misprints(sheet: list[Entry]) -> dict[str, bytes]:
    """The telegrams that are printed wrong, by name."""
    return {entry["name"]: entry["data"] for entry in sheet if not entry["usable"] and "data" in entry}


@pytest.fixture(scope="session", params=["lms200-setup-and-stream.jsonl", "lms200-stream.jsonl"])
def real_telegrams(request: pytest.FixtureRequest, captures: Path) -> list[bytes]:
    """What a real LMS200 sent, telegram by telegram."""
    lines = map(json.loads, (captures / request.param).read_text().splitlines())
    return [bytes.fromhex(line["hex"]) for line in lines if line["from"] == "lms"]
