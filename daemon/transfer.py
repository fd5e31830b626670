"""Raw serial dumps, a file a device, to a capture that replays; and a capture back to dumps."""

from __future__ import annotations

import csv
import heapq
from collections.abc import Iterator
from contextlib import ExitStack
from datetime import UTC, datetime
from itertools import pairwise
from pathlib import Path
from typing import IO

from polecal import __version__
from polecal.daemon import recorder
from polecal.daemon.config import Config, dump
from polecal.daemon.recorder import Record, Recorder, RecorderError
from polecal.daemon.replay import BEGIN
from polecal.drivers.port import BITS_PER_BYTE

COLUMNS = ("byte_offset", "host_time_s")
"""Of an arrivals file: from this byte on, until the next row's, the dump arrived at this time."""

_EVEN_BYTES = 256  # a chunk of a dump without arrival times
_NAME_IT = "an arrivals file has the line `byte_offset,host_time_s`, then rising numbers"


def import_dumps(out: Path, config: Config, dumps: dict[str, tuple[Path, Path | float]]) -> list[str]:
    """Make a capture of a dump of each device: its path, and its arrivals file or rate in bytes/s.

    A device without arrivals is stamped evenly from the time of the first arrival that is known. Gives
    what an operator must be told of that, in sentences. Raises RecorderError.
    """
    arrivals = {name: _arrivals(source) for name, (_, source) in dumps.items() if isinstance(source, Path)}
    first_ns = min((times[0][1] for times in arrivals.values()), default=10**9)
    notes = []
    metadata = {
        "session": out.stem,
        "created": datetime.now(UTC).isoformat(timespec="seconds"),
        "polecal": __version__,
        "config": dump(config),
        "imported": ", ".join(f"{name}: {path.name}" for name, (path, _) in dumps.items()),
    }
    with ExitStack() as stack:
        streams = []
        for name, (path, source) in dumps.items():
            try:
                file = stack.enter_context(path.open("rb"))
            except OSError as error:
                raise RecorderError(f"{path}: cannot be read: {error.strerror}", "name a dump") from error
            if isinstance(source, Path):
                streams.append(_timed(name, file, arrivals[name]))
            else:
                streams.append(_even(name, file, source, first_ns))
                notes.append(
                    f"{name}: has no arrival times: stamped evenly at {source:g} bytes/s, which a "
                    "calibration must not rest on unless the line was never silent"
                )
        recording = stack.enter_context(Recorder(out, metadata))
        recording.event(first_ns, {"event": BEGIN})
        for record in heapq.merge(*streams, key=lambda record: record.t_ns):
            recording.write(record.device, record.direction, record.t_ns, record.data)
    return notes


def line_rate(baud: int) -> float:
    """Give the bytes/s of a line that is never silent."""
    return baud / BITS_PER_BYTE


def export_dumps(capture: Path, out: Path) -> list[Path]:
    """Write what each device said (``NAME.bin``) and was told (``NAME.tx.bin``), each with its arrivals.

    Gives the paths of the dumps. Nothing is written over. Raises RecorderError.
    """
    source = recorder.read(capture)
    files: dict[tuple[str, str], tuple[IO[bytes], IO[str]]] = {}
    paths = []
    try:
        out.mkdir(parents=True, exist_ok=True)
        with ExitStack() as stack:
            for item in source:
                if not isinstance(item, Record):
                    continue
                key = item.device, item.direction
                if key not in files:
                    stem = item.device if item.direction == "rx" else f"{item.device}.tx"
                    paths.append(out / f"{stem}.bin")
                    arrivals = out / f"{stem}.arrivals.csv"
                    files[key] = (
                        stack.enter_context(paths[-1].open("xb")),
                        stack.enter_context(arrivals.open("x", encoding="ascii")),
                    )
                    files[key][1].write(",".join(COLUMNS) + "\n")
                dumped, times = files[key]
                times.write(f"{dumped.tell()},{item.t_ns // 10**9}.{item.t_ns % 10**9:09d}\n")
                dumped.write(item.data)
    except OSError as error:
        hint = "name another folder to write to"
        raise RecorderError(f"{error.filename or out}: cannot be written: {error.strerror}", hint) from error
    if source.cut is not None:
        raise RecorderError(source.cut, f"what was whole is in {out}")
    return paths


def _arrivals(path: Path) -> list[tuple[int, int]]:
    """Read (offset, ns) rows. Raises RecorderError."""
    rows: list[tuple[int, int]] = []
    try:
        with path.open(encoding="utf-8", newline="") as file:
            lines = csv.reader(line for line in file if not line.startswith("#"))
            offset, time = next(lines, ["", ""])
            if offset != COLUMNS[0] or not time.endswith("time_s"):
                raise ValueError("another file")
            for offset, time in lines:
                whole, _, part = time.partition(".")
                rows.append((int(offset), int(whole) * 10**9 + int(part[:9].ljust(9, "0"))))
    except OSError as error:
        raise RecorderError(f"{path}: cannot be read: {error.strerror}", _NAME_IT) from error
    except ValueError as error:
        raise RecorderError(f"{path}: is no arrivals file, after {len(rows)} rows", _NAME_IT) from error
    if not rows or rows[0][0] != 0 or any(a[0] > b[0] or a[1] > b[1] for a, b in pairwise(rows)):
        raise RecorderError(f"{path}: does not rise from byte 0 on", _NAME_IT)
    return rows


def _timed(name: str, file: IO[bytes], arrivals: list[tuple[int, int]]) -> Iterator[Record]:
    ends = [offset for offset, _ in arrivals[1:]]
    for (offset, t_ns), end in zip(arrivals, [*ends, None], strict=True):
        data = file.read() if end is None else file.read(end - offset)
        if data:
            yield Record(name, "rx", t_ns, data)


def _even(name: str, file: IO[bytes], rate_hz: float, first_ns: int) -> Iterator[Record]:
    count = 0
    while data := file.read(_EVEN_BYTES):
        count += len(data)
        yield Record(name, "rx", first_ns + round(count / rate_hz * 1e9), data)
