"""Calibration runs as folders: what each was told, its capture, its passes, its calibration."""

from __future__ import annotations

import os
import re
import shutil
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, fields
from datetime import UTC, datetime, timedelta
from io import BytesIO
from itertools import count
from pathlib import Path
from typing import IO, Any

import numpy as np
import structlog
import yaml

from polecal import PolecalError, __version__
from polecal.calib import CalibrationError
from polecal.calib.moments import WIDTH
from polecal.daemon.config import Config, dump
from polecal.daemon.facts import utc
from polecal.daemon.passes import StoredPass
from polecal.daemon.quality import Quality

CAPTURE = "capture.mcap"
CALIBRATION = "calibration.yaml"
CAPTURED_IN = "captured_in"
"""What ``session.yaml`` calls the folder with the captures, where it is another one: of a replay."""
CAPTURES = "capture*.mcap"
"""Matches all captures of a session's folder."""
REPLAY = "make it anew from the capture: `polecal-field replay`"
DAMAGE = (
    *(OSError, ValueError, KeyError, TypeError, EOFError, NotImplementedError, CalibrationError),
    *(zipfile.BadZipFile, zlib.error, yaml.YAMLError),
)
"""What numpy, zipfile and PyYAML raise on a file that is damaged, however it is."""
_LATER = "capture-{}.mcap"
_STAMP = "%Y%m%dT%H%M%SZ"
_STAMPED = re.compile(r"(\d{8}T\d{6}Z)-")
_NUMBERED = re.compile(r"capture(?:-(\d+))?\.mcap")
_LOADER = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
_DUMPER = getattr(yaml, "CSafeDumper", yaml.SafeDumper)


class SessionError(PolecalError):
    """A session's folder that cannot be made, written or found."""


@dataclass(frozen=True, slots=True)
class Session:
    """One calibration run's folder."""

    folder: Path
    created: str
    """UTC, ISO 8601."""
    number: int = 1
    """Which of its captures is made: one a day that it is gone on with."""

    @property
    def id(self) -> str:
        """The folder's name."""
        return self.folder.name

    @property
    def capture(self) -> Path:
        """Where this day's capture is."""
        return self.folder / (CAPTURE if self.number == 1 else _LATER.format(self.number))

    def metadata(self, config: Config) -> dict[str, str]:
        """Give what a replay must know; it is in the capture, too, so that one file is enough."""
        return {
            "session": self.id,
            "created": self.created,
            "polecal": __version__,
            "config": dump(config),
        }

    def write_told(self, told: dict[str, str]) -> None:
        """Write ``session.yaml``: what the run was told. Raises SessionError."""
        with _whole_file(self.folder / "session.yaml") as file:
            file.write(yaml.dump(told, Dumper=_DUMPER, sort_keys=False).encode())

    def write_pass(self, laser: str, stored: StoredPass) -> None:
        """Write a closed pass. Raises SessionError."""
        returns = stored.returns
        blocks = stored.blocks
        features = np.zeros((len(blocks), 3 * WIDTH), dtype=bool)
        first = np.zeros((len(blocks), 3 * WIDTH))
        for has, sums, block in zip(features, first, blocks.values(), strict=True):
            has[block.features], sums[block.features] = True, block.first
        about, quality = stored.facts, stored.quality
        arrays: dict[str, Any] = {
            "t_ns": stored.t_ns,
            "place": stored.place,
            "gps_ns": stored.gps_ns,
            "laser": laser,
            "site": stored.moments.site,
            "utc": [utc(gps_ns, quality.utc_offset_s) for gps_ns in about.gps_ns],
            **{name: getattr(about, name) for name in FACTS},
            **{name: _plain(getattr(quality, name)) for name in QUALITY},
            **{part.name: getattr(returns, part.name) for part in fields(returns)},
            "block_slice_kind": [(part, int(kind)) for part, kind in blocks],
            "block_count": [block.count for block in blocks.values()],
            "block_features": features,
            "block_first": first,
            "block_packed": np.concatenate([block.packed for block in blocks.values()]),
        }
        with _whole_file(self.folder / "passes" / f"{laser}-{stored.id:03d}.npz") as file:
            _save(file, arrays)

    def write_calibration(self, calibration: dict[str, Any]) -> Path:
        """Write ``calibration.yaml``; give its path. Raises SessionError."""
        path = self.folder / CALIBRATION
        with _whole_file(path) as file:
            told = yaml.dump(calibration, Dumper=_DUMPER, sort_keys=False, allow_unicode=True)
            file.write(told.encode())
        return path


FACTS = ("heading_deg", "span_deg", "speed_mps", "direction", "nearest_m", "mean_m")
QUALITY = tuple(part.name for part in fields(Quality))
"""What a pass's file has of `Facts` and `Quality`, under the same names."""


_SAMPLE_BYTES = 8192  # two scans of a column: what is shorter is not worth asking
_WORTH_IT = 0.4  # of its size: poses and moments are all digits, which costs much time and gains a tenth


def _save(file: IO[bytes], arrays: dict[str, Any]) -> None:
    """Write what `np.savez_compressed` does, but compressed only where that gains much."""
    with zipfile.ZipFile(file, "w") as archive:
        for name, value in arrays.items():
            column = BytesIO()
            np.lib.format.write_array(column, np.asarray(value), allow_pickle=False)
            content = column.getvalue()
            sample = content[len(content) // 2 :][:_SAMPLE_BYTES]
            worth_it = len(content) > _SAMPLE_BYTES and len(zlib.compress(sample, 1)) < _WORTH_IT * len(
                sample
            )
            method = zipfile.ZIP_DEFLATED if worth_it else zipfile.ZIP_STORED
            archive.writestr(zipfile.ZipInfo(f"{name}.npy"), content, method, compresslevel=1)


def _plain(value: str | float | None) -> str | float:
    """Give what numpy can write: None becomes not a number."""
    return np.nan if value is None else value


def captures_of(folder: Path) -> list[Path]:
    """Give a session's captures, day by day."""
    numbered = ((_NUMBERED.fullmatch(path.name), path) for path in folder.glob(CAPTURES))
    return [path for _, path in sorted((int(match[1] or 1), path) for match, path in numbered if match)]


def create(state_dir: Path, config: Config, name: str | None) -> Session:
    """Make a new session's folder. Raises SessionError."""
    now = datetime.now(UTC)
    label = name or "-".join(laser.name for laser in config.lasers)
    folder = first = state_dir / "sessions" / f"{_stamp(state_dir / 'sessions', now)}-{label}"
    others = count(2)
    try:
        while folder.exists():  # one that was started, and failed, within the same second
            folder = first.with_name(f"{first.name}-{next(others)}")
        (folder / "passes").mkdir(parents=True)
    except OSError as error:
        raise SessionError(
            f"{folder}: cannot be made: {error.strerror}",
            "see that state_dir is there, has room, and that this user may write to it",
        ) from error
    session = Session(folder, now.isoformat(timespec="seconds"))
    session.write_told(session.metadata(config))
    return session


def _stamp(sessions: Path, now: datetime) -> str:
    """Give the time that a new session is named after: now, or after all others if the clock was set back.

    The last session is the one whose name is the last, also on a host that forgets the time when it is off.
    """
    there = (_STAMPED.match(path.name) for path in sessions.glob("*/"))
    newest = max((match[1] for match in there if match), default="")
    stamp = now.strftime(_STAMP)
    if stamp >= newest:
        return stamp
    structlog.get_logger().warning(
        "the host's clock is behind the last session's", now=stamp, last=newest, hint="set the clock"
    )
    return (datetime.strptime(newest, _STAMP) + timedelta(seconds=1)).strftime(_STAMP)


def discard(session: Session) -> None:
    """Remove the folder of a session that never began; of a later day of one, its capture."""
    if session.number > 1:
        session.capture.unlink(missing_ok=True)
    else:
        shutil.rmtree(session.folder, ignore_errors=True)


def folders(state_dir: Path) -> list[Path]:
    """Give the sessions' folders, by name: those that are there, so that no name and no link leads away."""
    inside = (state_dir / "sessions").resolve()
    return sorted(path for path in (state_dir / "sessions").glob("*/") if path.resolve().parent == inside)


def calibration_of(state_dir: Path, session: str | None) -> dict[str, Any]:
    """Read a session's calibration; the last accepted one's if none is named. Raises SessionError."""
    inside = (state_dir / "sessions").resolve()
    for folder in reversed(folders(state_dir)):
        file = folder / CALIBRATION
        if session not in (None, folder.name) or (file.is_file() and file.resolve().parent.parent != inside):
            continue
        try:
            content = read_calibration(folder)
        except SessionError:
            if session is not None:
                raise
            continue  # an older one may be whole
        if content is not None and (session is not None or content["state"] == "accepted"):
            return content
    wanted = f"session {session} has no calibration" if session else "no session was accepted yet"
    raise SessionError(wanted, "see `polecal-field status` for what is still to be driven")


def folder_of(state_dir: Path, session: str | None) -> Path:
    """Give a session's folder, the last one's if none is named. Raises SessionError."""
    for folder in reversed(folders(state_dir)):
        if session in (None, folder.name) and (folder / "session.yaml").exists():
            return folder
    what = "there is no session yet" if session is None else f"there is no session {session}"
    raise SessionError(what, f"see {state_dir / 'sessions'}")


def read_calibration(folder: Path) -> dict[str, Any] | None:
    """Read the calibration of a session or of a replay, None where there is none. Raises SessionError."""
    path = folder / CALIBRATION
    if not path.exists():
        return None
    content = read_yaml(path)
    if "state" not in content or not isinstance(content.get("lasers"), list):
        raise SessionError(f"{path}: is no calibration", REPLAY)
    return content


def read_yaml(path: Path) -> dict[str, Any]:
    """Read a file that `Session` wrote. Raises SessionError."""
    try:
        content = yaml.load(path.read_bytes(), _LOADER)  # noqa: S506
    except DAMAGE as error:
        raise SessionError(f"{path}: cannot be read: {error}", REPLAY) from error
    if not isinstance(content, dict):
        raise SessionError(f"{path}: is not what polecal writes", REPLAY)
    return content


def write_whole(path: Path, content: bytes) -> None:
    """Write a file as a whole. Raises SessionError."""
    with _whole_file(path) as file:
        file.write(content)


@contextmanager
def _whole_file(path: Path) -> Iterator[IO[bytes]]:
    """Write a file that is there as a whole or not at all, also after a power cut. Raises SessionError."""
    temporary = path.with_name(f".{path.name}.part")
    try:
        with temporary.open("wb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        temporary.rename(path)
        folder = os.open(path.parent, os.O_RDONLY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)
    except OSError as error:
        with suppress(OSError):
            temporary.unlink()
        raise SessionError(
            f"{path}: cannot be written: {error.strerror}", "make room on the disk, then start again"
        ) from error
