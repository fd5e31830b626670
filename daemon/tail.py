"""What was read last, in a file in memory: a process that is killed leaves it, written to the capture or not.

The capture's writer looks now and then at what came, as waking for each chunk costs more than writing it.
The file lies in the runtime folder, where nothing waits for a disk. Of its two halves the older one is
written over, so that a half's worth is always there: seconds of four lasers at their full rate.
"""

from __future__ import annotations

import errno
import fcntl
import json
import mmap
import os
import shutil
import struct
import threading
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from polecal.daemon.recorder import Direction, Record

_HALF_BYTES = 1 << 18
_ABOUT_BYTES = 4096  # what the file is of, in JSON
_HEAD = struct.Struct("<BBqI")  # 1 once the whole chunk is there, its line, its time, its length
_NAMED = "*.tail"

_Line = tuple[str, Direction]


class Tail:
    """The last chunks of a run's devices; any thread may `put`."""

    def __init__(self, folder: Path, capture: Path, devices: Sequence[str]) -> None:
        """Begin one in a folder, of what is to be in a capture. Raises OSError."""
        lines: list[_Line] = [(device, direction) for device in devices for direction in ("rx", "tx")]
        self.path = folder / f"{capture.parent.name}.tail"
        self._number = {line: number for number, line in enumerate(lines)}
        about = json.dumps({"capture": str(capture), "lines": lines}).encode()
        if len(about) > _ABOUT_BYTES:
            raise OSError(errno.ENAMETOOLONG, os.strerror(errno.ENAMETOOLONG))
        fd = os.open(self.path, os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_CLOEXEC, 0o640)
        try:
            fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
            os.posix_fallocate(fd, 0, _ABOUT_BYTES + 2 * _HALF_BYTES)  # no room is found out here, not later
            self._map = mmap.mmap(fd, 0)  # holds the file open, and so locked, too
        except OSError:
            self.path.unlink()
            raise
        finally:
            os.close(fd)
        self._map[: len(about)] = about
        self._lock = threading.Lock()
        self._half, self._at, self._end = 0, _ABOUT_BYTES, _ABOUT_BYTES + _HALF_BYTES

    def put(self, record: Record) -> None:
        """Keep a chunk until a half's worth has come after it."""
        size = _HEAD.size + len(record.data)
        with self._lock:
            if self._at + size > self._end:
                self._turn()
            head, self._at = self._at, self._at + size
            line = self._number[record.device, record.direction]
            _HEAD.pack_into(self._map, head, 0, line, record.t_ns, len(record.data))
            self._map[head + _HEAD.size : self._at] = record.data
            self._map[head] = 1

    def _turn(self) -> None:
        self._half = 1 - self._half
        self._at = _ABOUT_BYTES + self._half * _HALF_BYTES
        self._end = self._at + _HALF_BYTES
        self._map[self._at : self._end] = bytes(_HALF_BYTES)

    def close(self) -> None:
        """Forget it, once the capture has it all."""
        self.path.unlink(missing_ok=True)


def rescue(folder: Path) -> None:
    """Move what killed runs left in a folder beside their captures, to be put in them.

    Raises OSError: what was not moved stays where it is.
    """
    for path in folder.glob(_NAMED):
        with path.open("rb") as file:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:  # of a run that lives
                continue
            capture = Path(_about(file.read()).get("capture", ""))
            if capture.is_file():
                shutil.copyfile(path, beside(capture))
            path.unlink()


def beside(capture: Path) -> Path:
    """Give where `rescue` puts what may be missing in a capture."""
    return capture.with_name(f".{capture.name}.tail")


def read(path: Path) -> list[Record]:
    """Give the chunks in a tail in the order of their times; none where there is no tail."""
    data = path.read_bytes() if path.exists() else b""
    lines = _about(data).get("lines", [])
    records = []
    for begin in range(_ABOUT_BYTES, len(data), _HALF_BYTES):
        at, end = begin, min(begin + _HALF_BYTES, len(data))
        while at + _HEAD.size <= end and data[at] == 1:
            _, line, t_ns, size = _HEAD.unpack_from(data, at)
            at += _HEAD.size + size
            if at > end or line >= len(lines):
                break
            device, direction = lines[line]
            records.append(Record(device, direction, t_ns, data[at - size : at]))
    return sorted(records, key=lambda record: record.t_ns)


def _about(data: bytes) -> dict[str, Any]:
    """Give what a tail is of, nothing where a kill came before it was told."""
    try:
        told = json.loads(data[:_ABOUT_BYTES].rstrip(b"\0"))
    except ValueError:
        return {}
    return told if isinstance(told, dict) else {}
