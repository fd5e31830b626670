"""Raw serial dumps, a file a device, to a capture that replays; and a capture back to dumps."""

from __future__ import annotations

import csv
import heapq
import math
import os
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from itertools import pairwise
from pathlib import Path
from typing import IO

from polecal import __version__
from polecal.daemon import recorder
from polecal.daemon.config import SPAN, Config, dump
from polecal.daemon.recorder import Record, Recorder, RecorderError
from polecal.daemon.replay import BEGIN
from polecal.daemon.sessions import captures_of
from polecal.drivers.novatel_span import Framer as SpanFramer
from polecal.drivers.port import BITS_PER_BYTE
from polecal.drivers.sick_lms import Framer as LmsFramer

COLUMNS = ("byte_offset", "host_time_s")
"""Of an arrivals file: from this byte on, until the next row's, the dump arrived at this time."""

_LOOKED_AT_BYTES = 1 << 18
_APART_NS = 10_000_000_000
_EVEN_BYTES = 256  # a chunk of a dump without arrival times
_NAME_IT = "an arrivals file has the line `byte_offset,host_time_s`, then rising numbers"


def dumps_of(
    config: Config, lms: list[str], arrivals: list[str], rates: list[str]
) -> dict[str, tuple[Path, Path | float]]:
    """Read which laser's dump is which file, and its arrivals file or rate, from words like NAME=FILE.

    With one laser NAME= may be left out. Raises RecorderError.
    """
    names = [laser.name for laser in config.lasers]
    files, times, speeds = (_named(names, words) for words in (lms, arrivals, rates))
    if lacking := [name for name in names if name not in files]:
        raise RecorderError(
            f"{', '.join(lacking)}: has no dump, but is in the configuration",
            f"give it by --lms {lacking[0]}=FILE, or leave that laser out of the configuration",
        )
    dumps: dict[str, tuple[Path, Path | float]] = {}
    for laser in config.lasers:
        source: Path | float = line_rate(laser.baud)
        if laser.name in times:
            source = Path(times[laser.name])
        elif laser.name in speeds:
            source = _rate(laser.name, speeds[laser.name])
        dumps[laser.name] = Path(files[laser.name]), source
    return dumps


def _named(names: list[str], words: list[str]) -> dict[str, str]:
    """Take words like NAME=VALUE apart. Raises RecorderError for a name that is not there, or twice."""
    found: dict[str, str] = {}
    for word in words:
        name, equals, value = word.partition("=")
        if len(names) == 1 and name not in names:
            name, value = names[0], word
        if name not in names:
            raise RecorderError(
                f"{word}: does not say of which laser it is" if not equals else f"{name}: is no laser",
                f"write NAME=FILE with one of the configuration's lasers: {', '.join(names)}",
            )
        if name in found:
            raise RecorderError(f"{name}: is given twice, {found[name]} and {value}", "give each laser once")
        found[name] = value
    return found


def _rate(name: str, text: str) -> float:
    try:
        rate_hz = float(text)
    except ValueError:
        rate_hz = 0.0
    if not 0 < rate_hz < math.inf:
        raise RecorderError(f"{name}: {text} is no rate", "give bytes/s, as 50000")
    return rate_hz


@dataclass(frozen=True, slots=True)
class _Dump:
    """A device's dump, and when it arrived: rows of (offset, ns), or evenly at so many bytes/s."""

    name: str
    path: Path
    size: int
    times: list[tuple[int, int]] | float

    def span_ns(self, first_ns: int) -> tuple[int, int]:
        """Give when it began and ended; one without arrivals begins at ``first_ns``."""
        if isinstance(self.times, float):
            return first_ns, first_ns + round(self.size / self.times * 1e9)
        return self.times[0][1], self.times[-1][1]

    def records(self, file: IO[bytes], first_ns: int) -> Iterator[Record]:
        """Give it in chunks."""
        if isinstance(self.times, float):
            return _even(self.name, file, self.times, first_ns)
        return _timed(self.name, file, self.times)


def import_dumps(out: Path, config: Config, dumps: dict[str, tuple[Path, Path | float]]) -> list[str]:
    """Make a capture of a dump of each device: its path, and its arrivals file or rate in bytes/s.

    A device without arrivals is stamped evenly from the time of the first arrival that is known. Gives
    what an operator must be told of that, in sentences. Raises RecorderError; then nothing is left of it.
    """
    every = [_look(name, path, source) for name, (path, source) in dumps.items()]
    first_ns = min((each.times[0][1] for each in every if isinstance(each.times, list)), default=10**9)
    notes = [note for each in every for note in _notes(each)] + _apart(every, first_ns)
    metadata = {
        "session": out.stem,
        "created": datetime.now(UTC).isoformat(timespec="seconds"),
        "polecal": __version__,
        "config": dump(config),
        "imported": ", ".join(f"{each.name}: {each.path.name}" for each in every),
    }
    with Recorder(out, metadata) as recording, ExitStack() as stack:
        stack.enter_context(_removed_unless_done(out))
        streams = [each.records(stack.enter_context(each.path.open("rb")), first_ns) for each in every]
        recording.event(first_ns, {"event": BEGIN})
        for record in heapq.merge(*streams, key=lambda record: record.t_ns):
            recording.write(record.device, record.direction, record.t_ns, record.data)
    return notes


@contextmanager
def _removed_unless_done(path: Path) -> Iterator[None]:
    try:
        yield
    except BaseException:
        path.unlink(missing_ok=True)
        raise


def _look(name: str, path: Path, source: Path | float) -> _Dump:
    """See that a dump is there and its arrivals are its own. Raises RecorderError."""
    try:
        with path.open("rb") as file:
            size = os.fstat(file.fileno()).st_size
    except OSError as error:
        raise RecorderError(f"{path}: cannot be read: {error.strerror}", "name a dump") from error
    if not isinstance(source, Path):
        return _Dump(name, path, size, float(source))
    times = _arrivals(source)
    if times[-1][0] > size:
        raise RecorderError(
            f"{source}: says when byte {times[-1][0]} arrived, but {path} has only {size}",
            "give each dump its own arrivals file, and the whole dump",
        )
    return _Dump(name, path, size, times)


def _notes(given: _Dump) -> list[str]:
    """Say what is odd about one dump."""
    notes = []
    if isinstance(given.times, float):
        notes.append(
            f"{given.name}: has no arrival times: stamped evenly at {given.times:g} bytes/s, which a "
            "calibration must not rest on unless the line was never silent; give its arrival times"
        )
    with given.path.open("rb") as file:
        begin = file.read(_LOOKED_AT_BYTES)
    framer = SpanFramer() if given.name == SPAN else LmsFramer()
    if not framer.feed(begin, 0):
        kind = "NovAtel receiver" if given.name == SPAN else "SICK laser"
        notes.append(
            f"{given.name}: nothing of a {kind} in the first {len(begin)} bytes of {given.path}; "
            "see that it is the right file, and that of a line with the right baud rate"
        )
    return notes


def _apart(every: list[_Dump], first_ns: int) -> list[str]:
    """Say which dumps begin late or end early. Raises RecorderError where they have no moment in common."""
    spans = {each.name: each.span_ns(first_ns) for each in every if each.size}
    if len(spans) < 2:
        return []
    late, early = max(spans, key=lambda name: spans[name][0]), min(spans, key=lambda name: spans[name][1])
    begin_ns, end_ns = spans[late][0], spans[early][1]
    if begin_ns > end_ns:
        raise RecorderError(
            f"{late} begins {(begin_ns - end_ns) / 1e9:.1f} s after {early} has ended: never both at once",
            "give dumps of one drive, with arrival times by one clock",
        )
    return [
        f"{name}: only the {(end_ns - begin_ns) / 1e9:.1f} s that all dumps share are of use, not "
        f"{(begin_ns - began_ns) / 1e9:.1f} s before and {(ended_ns - end_ns) / 1e9:.1f} s after; "
        "see that all are of one drive, and whole"
        for name, (began_ns, ended_ns) in spans.items()
        if begin_ns - began_ns > _APART_NS or ended_ns - end_ns > _APART_NS
    ]


def line_rate(baud: int) -> float:
    """Give the bytes/s of a line that is never silent."""
    return baud / BITS_PER_BYTE


def export_dumps(capture: Path, out: Path) -> list[Path]:
    """Write what each device said (``NAME.bin``) and was told (``NAME.tx.bin``), each with its arrivals.

    Of a session's folder, each day's capture goes into a folder of its own where there are several. Gives
    the paths of the dumps. Nothing is written over. Raises RecorderError.
    """
    if capture.is_dir():
        days = captures_of(capture)
        if not days:
            raise RecorderError(f"{capture}: there is no capture in it", "name a session's folder")
        several = len(days) > 1
        return [path for day in days for path in export_dumps(day, out / day.stem if several else out)]
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
                whole, _, part = time.strip().partition(".")
                if not (whole + part).isdecimal():
                    raise ValueError("no time")
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
