"""The sessions on a disk to fewer of them: the oldest go that were not accepted, until there is room."""

from __future__ import annotations

import shutil
from contextlib import suppress
from pathlib import Path
from typing import Any

import structlog
import yaml

from polecal.daemon.config import Storage
from polecal.daemon.recorder import DiskFull
from polecal.daemon.sessions import CALIBRATION

MAKE_ROOM = "make room on the disk: what is known is kept, and recording goes on"

_MB = 1_000_000
_PACE_S = 10.0  # of a recording, before it can be said how fast it grows


class Space:
    """How much room the sessions may take, and how much they must leave.

    The floor is kept: below it nothing is recorded. A quota is only aimed at: where what may not be removed
    takes more, the running session too, that is told and recording goes on, as a drive cannot be repeated
    so easily as a disk can be cleared.
    """

    def __init__(self, state_dir: Path, storage: Storage) -> None:
        self.over: str | None = None
        """By how much the quota is exceeded, though all that may go has gone; as of the last look."""
        self._sessions = state_dir / "sessions"
        self._storage = storage
        self._log = structlog.get_logger()

    @property
    def floor_bytes(self) -> int:
        """What stays free: passes and calibrations are written into it, captures are not."""
        return self._storage.min_free_mb * _MB

    def left(self, capture: Path, run_s: float) -> dict[str, Any] | None:
        """Give the room to record on, and for how long it will do at a capture's pace, once that is known."""
        try:
            room, recorded = max(0, self._free_bytes() - self.floor_bytes), capture.stat().st_size
        except OSError:  # the folder is gone: what records says so
            return None
        left_s = round(room * run_s / recorded) if recorded and run_s > _PACE_S else None
        return {"free_mb": room // _MB, "left_s": left_s}

    def lacking(self) -> str | None:
        """Say that the disk is too full to record on, None if it is not."""
        free = self._free_bytes()
        if free >= self.floor_bytes:
            return None
        return f"only {free / _MB:.0f} MB are free on the disk, of {self._storage.min_free_mb} that must be"

    def require(self, session: str | None = None) -> None:
        """Make room for a session that is to run. Raises DiskFull if there is too little even so."""
        if (why := self.make_room(session)) is not None:
            raise DiskFull(
                f"{self._sessions}: {why}; no session is left that was not accepted",
                "make room on the disk, or move accepted sessions away; then start again",
            )

    def make_room(self, running: str | None) -> str | None:
        """Remove sessions as long as there is too little room; say so if there still is, as `lacking` does.

        The oldest go first; never ``running``, nor one that was accepted.
        """
        quota = self._storage.quota_mb
        sizes = {path: size_of(path) for path in sorted(self._sessions.glob("*/"))}
        for path in sizes.copy():
            over = quota is not None and sum(sizes.values()) > quota * _MB
            if not over and self.lacking() is None:
                break
            if path.name == running or preserved(path):
                continue
            shutil.rmtree(path, ignore_errors=True)
            if path.exists():
                self._log.error("session cannot be removed", session=path.name)
            else:
                self._log.warning("session removed for room", session=path.name, size_bytes=sizes.pop(path))
        taken_mb = sum(sizes.values()) / _MB
        if quota is None or taken_mb <= quota:
            self.over = None
        else:
            if self.over is None:
                self._log.warning("quota exceeded", taken_mb=round(taken_mb), quota_mb=quota)
            self.over = (
                f"sessions take {taken_mb:.0f} MB, of {quota} that they may: move accepted ones away, "
                "which are never removed"
            )
        return self.lacking()

    def _free_bytes(self) -> int:
        there = next(path for path in self._sessions.parents if path.exists())  # it is made by the first
        return shutil.disk_usage(there).free


def size_of(folder: Path) -> int:
    """Give how many bytes a session takes."""
    size = 0
    for path in folder.rglob("*"):
        with suppress(OSError):  # a temporary file that has just been renamed
            size += path.stat().st_size
    return size


def preserved(folder: Path) -> bool:
    """Say whether a session must stay; one whose result cannot be read does."""
    try:
        content = yaml.safe_load((folder / CALIBRATION).read_text(encoding="utf-8"))
    except FileNotFoundError:
        return False
    except (OSError, ValueError, yaml.YAMLError):
        return True
    return not isinstance(content, dict) or content.get("state") != "rejected"
