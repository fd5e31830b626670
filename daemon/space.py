"""The sessions on a disk to fewer of them: the oldest go that were not accepted, until there is room."""

from __future__ import annotations

import shutil
from contextlib import suppress
from pathlib import Path

import structlog
import yaml

from polecal.daemon.config import Storage
from polecal.daemon.sessions import CALIBRATION

_MB = 1_000_000


class Space:
    """How much room the sessions may take, and how much they must leave."""

    def __init__(self, state_dir: Path, storage: Storage) -> None:
        self._sessions = state_dir / "sessions"
        self._storage = storage
        self._log = structlog.get_logger()

    @property
    def floor_bytes(self) -> int:
        """What stays free: passes and calibrations are written into it, captures are not."""
        return self._storage.min_free_mb * _MB

    def lacking(self) -> str | None:
        """Say that the disk is too full to record on, None if it is not."""
        free = self._free_bytes()
        if free >= self.floor_bytes:
            return None
        return f"only {free / _MB:.0f} MB are free on the disk, of {self._storage.min_free_mb} that must be"

    def make_room(self, running: str) -> str | None:
        """Remove sessions as long as there is too little room; say so if there still is, as `lacking` does.

        The oldest go first; never ``running``, nor one that was accepted.
        """
        quota = self._storage.quota_mb
        sizes = {path: _size(path) for path in sorted(self._sessions.glob("*/"))}
        for path in sizes.copy():
            over = quota is not None and sum(sizes.values()) > quota * _MB
            if not over and self.lacking() is None:
                break
            if path.name == running or _accepted(path):
                continue
            shutil.rmtree(path, ignore_errors=True)
            if path.exists():
                self._log.error("session cannot be removed", session=path.name)
            else:
                self._log.warning("session removed for room", session=path.name, size_bytes=sizes.pop(path))
        return self.lacking()

    def _free_bytes(self) -> int:
        return shutil.disk_usage(self._sessions.parent).free


def _size(folder: Path) -> int:
    size = 0
    for path in folder.rglob("*"):
        with suppress(OSError):  # a temporary file that has just been renamed
            size += path.stat().st_size
    return size


def _accepted(folder: Path) -> bool:
    """Say whether a session must stay; one whose result cannot be read does."""
    try:
        content = yaml.safe_load((folder / CALIBRATION).read_text(encoding="utf-8"))
    except FileNotFoundError:
        return False
    except (OSError, ValueError, yaml.YAMLError):
        return True
    return not isinstance(content, dict) or content.get("state") != "rejected"
