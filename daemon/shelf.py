"""The sessions on a disk to a row each, as SESSIONS tells them; also of runs that were killed."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import yaml

from polecal import PolecalError
from polecal.daemon import archive
from polecal.daemon.sessions import captures_of, read_calibration
from polecal.daemon.space import preserved, size_of

UNFINISHED = "unfinished"
"""The state of a session whose last run was not calibrated: it was stopped, failed or killed."""


def rows(state_dir: Path, running: tuple[str, str] | None) -> list[dict[str, Any]]:
    """Give a row a session, the newest first; ``running`` is the present one's name and state."""
    folders = sorted((state_dir / "sessions").glob("*/"), reverse=True)
    return [_row(folder, running) for folder in folders]


def _row(folder: Path, running: tuple[str, str] | None) -> dict[str, Any]:
    captures = len(captures_of(folder))
    row: dict[str, Any] = {
        "session": folder.name,
        "created": None,
        "state": UNFINISHED,
        "passes": sum(1 for _ in (folder / "passes").glob("*.npz")),
        "cost_m": {},
        "size_bytes": size_of(folder),
        "preserved": preserved(folder),
        "captures": captures,
        "problem": None,
    }
    try:
        row["created"] = archive.told(folder)[0]["created"]
        content = read_calibration(folder)
        if content is not None:
            row["cost_m"] = {laser["name"]: laser["cost_m"] for laser in content["lasers"]}
            if content.get("captures", 1) == captures:
                row["state"] = content["state"]
    except (PolecalError, KeyError, TypeError, AttributeError, yaml.YAMLError) as error:
        row["problem"] = str(error)
    if running is not None and folder.name == running[0]:
        row["state"] = running[1]
    return row
