"""A closed or cut-off capture to an indexed, compressed one with the same messages, and what they mean.

Beside what was recorded it has messages that robot tools show (`decoded`), unless there is no room for them
or something is wrong with them: they can be had again, what was recorded cannot. The old file is there until
the new one is; whatever goes wrong, it stays as it was. A process of its own does it (``python -m
polecal.daemon.finalise CAPTURE``), so that it takes neither the interpreter nor the memory of a run that may
be under way.
"""

from __future__ import annotations

import errno
import fcntl
import hashlib
import json
import os
import queue
import shutil
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass
from itertools import count
from pathlib import Path
from typing import IO, Any, Self

import structlog
from mcap.exceptions import McapError
from mcap.reader import make_reader
from mcap.records import Message
from mcap.writer import CompressionType, Writer

from polecal import PolecalError, __version__
from polecal.daemon import recorder, reporting, tail
from polecal.daemon.recorder import FULL, METADATA, Event, Record, RecorderError
from polecal.daemon.sessions import CAPTURES, captures_of

REPAIR = "polecal.repair"
"""The metadata record of a capture that was not closed by the daemon that wrote it."""

_PART, _DAMAGED = ".part", ".damaged"
_DECODED = "decoded"
_LOOK_EVERY = 500  # messages: a few seconds of a capture
_NO_ROOM = "too little room on the disk: what was recorded is whole; make room before the next run ends"


@dataclass(frozen=True, slots=True)
class Finalised:
    """What became of a capture; ``recovered`` says how far it went, None for one that was closed.

    ``from_tail`` of its messages had been read, and not yet been written when the run was killed.
    """

    capture: str
    messages: int
    from_tail: int
    size_bytes: tuple[int, int]
    """Before and after."""
    recovered: str | None
    decoded: int
    """How many messages were added that robot tools show."""
    not_decoded: str | None
    """Why there are none, None where there are."""


class _NotDecoded(Exception):
    """What was recorded must do without what it means; the message says why."""


def is_indexed(path: Path) -> bool:
    """Say whether a capture is as `finalise` leaves it."""
    try:
        with path.open("rb") as stream:
            summary = make_reader(stream).get_summary()
    except (OSError, ValueError, McapError):
        return False
    return summary is not None and bool(summary.chunk_indexes)


def finalise(path: Path, leave_bytes: int = 0, *, decoded: bool = True) -> Finalised:
    """Rewrite a capture indexed and compressed, all that is whole in it; ``decoded``, with what it means.

    The new file has its own name until it is on the disk and was read back. A damaged original is kept
    beside it, as more may be found in it by hand. ``leave_bytes`` must stay free on the disk meanwhile.

    Raises RecorderError: the capture is as it was.
    """
    capture = recorder.read(path)
    try:
        with _alone(path.parent) as folder:
            path.with_name(f".{path.name}{_PART}").unlink(missing_ok=True)  # of a crash in the midst of it
            free_bytes = shutil.disk_usage(path.parent).free
            if free_bytes - capture.size_bytes < leave_bytes:
                raise OSError(errno.ENOSPC, "too little room on the disk")
            done = _replace(capture, leave_bytes, decoded=decoded)
            tail.beside(path).unlink(missing_ok=True)
            os.fsync(folder)
    except OSError as error:
        hint = "see that the disk is there and has room; the next start tries again"
        raise RecorderError(f"{path}: cannot be indexed: {error.strerror}", hint) from error
    return done


@contextmanager
def _alone(path: Path) -> Iterator[int]:
    """Hold a folder, as a daemon that was killed may have left a process at work in it."""
    folder = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
    try:
        fcntl.flock(folder, fcntl.LOCK_EX | fcntl.LOCK_NB)
        yield folder
    finally:
        os.close(folder)


def _replace(capture: recorder.Capture, leave_bytes: int, *, decoded: bool) -> Finalised:
    """Put the rewritten capture in the old one's place."""
    path = capture.path
    part = path.with_name(f".{path.name}{_PART}")
    why = None if decoded else "it is not asked for"
    left = tail.read(tail.beside(path))
    try:
        if why is None:
            try:
                written = _write(capture, left, part, leave_bytes)
            except (OSError, RecorderError, _NotDecoded) as error:
                why = _words(error)
        if why is not None:
            written = _write(capture, left, part, None)
        if capture.damaged:
            os.link(path, path.with_name(path.name + _DAMAGED))
        size_bytes = part.stat().st_size
        part.rename(path)
    finally:
        with suppress(OSError):
            part.unlink()
    sizes = (capture.size_bytes, size_bytes)
    return Finalised(str(path), written.messages, written.from_tail, sizes, capture.cut, written.decoded, why)


@dataclass(frozen=True, slots=True)
class _Written:
    """How many messages a file has: in all but those decoded, of these from the tail, and decoded."""

    messages: int
    from_tail: int
    decoded: int
    digest: bytes


def _write(capture: recorder.Capture, left: list[Record], part: Path, leave_bytes: int | None) -> _Written:
    """Write a capture to ``part`` and read it back; decoded, too, unless ``leave_bytes`` is None.

    What is ``left`` and not in the capture is put behind it. Raises OSError, RecorderError, _NotDecoded.
    """
    with part.open("wb") as file:
        written = _rewrite(capture, left, file, leave_bytes)
        file.flush()
        os.fsync(file.fileno())
    after = recorder.read(part)
    if _digest(after) != written.digest or after.cut is not None:
        raise RecorderError(
            f"{capture.path}: was not read back as it was written", "look at the disk's health"
        )
    return written


def _rewrite(
    capture: recorder.Capture, left: list[Record], file: IO[bytes], leave_bytes: int | None
) -> _Written:
    writer = Writer(file, compression=CompressionType.ZSTD, enable_data_crcs=True)
    writer.start(library=f"polecal {__version__}")
    writer.add_metadata(METADATA, capture.metadata)
    channels: dict[tuple[str, str], int] = {}
    digest, counts = hashlib.sha256(), {False: 0, True: 0}
    with _decoding(capture, writer, leave_bytes) as decode:
        for of_tail, topic, encoding, message, item in _all(capture, left):
            if (topic, encoding) not in channels:
                channels[topic, encoding] = writer.register_channel(topic, encoding, 0)
            writer.add_message(
                channels[topic, encoding],
                message.log_time,
                message.data,
                message.publish_time,
                message.sequence,
            )
            digest.update(_identity(topic, message))
            counts[of_tail] += 1
            decode(item)
        decoded = decode(None)
    if capture.cut is not None:
        writer.add_metadata(REPAIR, {"recovered": capture.cut})
    writer.finish()  # type: ignore[no-untyped-call]
    return _Written(counts[False], counts[True], decoded, digest.digest())


def _all(
    capture: recorder.Capture, left: list[Record]
) -> Iterator[tuple[bool, str, str, Message, Record | Event]]:
    """Give each message: whether it is of the tail, its topic and encoding, itself, and its meaning.

    The chunks of one line are in the order of their times: those of the tail that the capture has are not
    later than its last.
    """
    last_ns: dict[tuple[str, str], int] = {}
    sequence = 0
    for channel, body, item in capture.messages():
        message = recorder.message_of(body)
        sequence = message.sequence
        if isinstance(item, Record):
            last_ns[item.device, item.direction] = item.t_ns
        yield False, channel.topic, channel.message_encoding, message, item
    for record in left:
        if record.t_ns > last_ns.get((record.device, record.direction), -1):
            sequence += 1
            message = Message(0, record.t_ns, record.data, record.t_ns, sequence)
            yield True, recorder.topic_of(record.device, record.direction), recorder.RAW, message, record


@contextmanager
def _decoding(
    capture: recorder.Capture, writer: Writer, leave_bytes: int | None
) -> Iterator[Callable[[Record | Event | None], int]]:
    """Give what takes each item, and None for the end, and writes what they mean; it counts what it wrote.

    Raises _NotDecoded, also for a bug in it: nothing may cost what was recorded.
    """
    if leave_bytes is None:
        yield lambda _: 0
        return
    from polecal.daemon.decoded import Decoder  # noqa: PLC0415 - 27 MB, which only the child is to take

    folder, taken = capture.path.parent, count(1)

    def decode(item: Record | Event | None) -> int:
        if next(taken) % _LOOK_EVERY == 0 and shutil.disk_usage(folder).free < leave_bytes:
            raise _NotDecoded(_NO_ROOM)
        try:
            if item is None:
                decoder.finish()
            else:
                decoder.take(item)
        except Exception as error:
            raise _NotDecoded(_words(error)) from error
        return decoder.count

    try:
        decoder = Decoder(capture.metadata, folder, writer)
    except Exception as error:
        raise _NotDecoded(_words(error)) from error
    try:
        yield decode
    finally:
        decoder.close()


def _words(error: Exception) -> str:
    """Say what kept a capture from being decoded, and what to do."""
    if isinstance(error, PolecalError):
        return f"{error}: {error.hint}" if error.hint else str(error)
    if isinstance(error, OSError) and error.errno in FULL:
        return _NO_ROOM
    if isinstance(error, OSError):
        return (
            f"{error.strerror or error}: what was recorded is whole; see that the disk is there and has room"
        )
    return str(error) if isinstance(error, _NotDecoded) else f"a bug in polecal: {error!r}; report it"


def _digest(capture: recorder.Capture) -> bytes:
    digest = hashlib.sha256()
    for channel, body, _ in capture.messages():
        digest.update(_identity(channel.topic, recorder.message_of(body)))
    return digest.digest()


def _identity(topic: str, message: Message) -> bytes:
    head = (topic, message.log_time, message.publish_time, message.sequence, len(message.data))
    return repr(head).encode() + message.data


class Finaliser:
    """A thread that has captures finalised one after another, the oldest session's first.

    What it does not come to, the next start of the daemon does.
    """

    def __init__(self, state_dir: Path, leave_bytes: int = 0, *, decoded: bool = True) -> None:
        """Prepare to finalise what an earlier daemon left, not indexed yet or cut off."""
        self._how = [str(leave_bytes), *([_DECODED] if decoded else [])]
        self._queue: queue.Queue[tuple[Path, bool] | None] = queue.Queue()
        self._lock = threading.Lock()
        self._child: subprocess.Popen[bytes] | None = None
        self._closed = False
        self._log = structlog.get_logger()
        for folder in sorted((state_dir / "sessions").glob("*/")):
            for left in folder.rglob(f".*{_PART}"):  # a crash in the midst of writing a file
                if not left.match(f".{CAPTURES}{_PART}"):  # on which a process may still be at work
                    left.unlink(missing_ok=True)
            for path in captures_of(folder):
                self._queue.put((path, False))
        self._thread = threading.Thread(target=self._work, name="finaliser")

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def add(self, capture: Path) -> None:
        """Have a capture finalised that has just been closed, and then its session's report written."""
        self._queue.put((capture, True))

    def join(self) -> None:
        """Wait until all is done that was asked for."""
        self._queue.put(None)
        self._thread.join()

    def close(self) -> None:
        """Leave the rest to the next start."""
        with self._lock:
            self._closed = True
            if self._child is not None:
                self._child.kill()
        self.join()

    def _work(self) -> None:
        while (item := self._queue.get()) is not None:
            path, has_ended = item
            if not is_indexed(path):
                self._run(path)
            else:
                tail.beside(path).unlink(missing_ok=True)
            if has_ended:
                self._report(path.parent)

    def _report(self, folder: Path) -> None:
        """Write a session's report, where the packages for it are there; a run does not depend on it."""
        if lack := reporting.lacking():
            self._log.info("no report", folder=str(folder), lacking=lack)
        elif (ended := self._child_of(reporting.command(folder))) is not None:
            code, _, why = ended
            if code == 0:
                self._log.info("report written", report=str(folder / reporting.NAME))
            elif code > 0:
                self._log.warning("no report", folder=str(folder), problem=why.strip())

    def _child_of(self, command: list[str]) -> tuple[int, bytes, str] | None:
        """Run a child process; give its exit code, output and standard error. None once closed."""
        with self._lock:
            if self._closed:
                return None
            child = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE)  # noqa: S603
            self._child = child
        said, trouble = child.communicate()
        with self._lock:
            self._child = None
        return child.returncode, said, trouble.decode(errors="replace")

    def _run(self, path: Path) -> None:
        """Finalise in a child process, unless closed."""
        ended = self._child_of([sys.executable, "-m", __spec__.name, str(path), *self._how])
        if ended is None:
            return
        code, said, trouble = ended
        if code < 0 and is_indexed(path):  # killed just after it was done
            self._log.info("capture indexed", capture=str(path))
        elif code < 0:
            self._log.info("capture is left to the next start", capture=str(path))
        elif code:
            why = trouble.strip().rpartition("\n")[2]
            self._log.error("capture stays as it was written", capture=str(path), problem=why)
        else:
            done: dict[str, Any] = json.loads(said)
            if done["recovered"]:
                self._log.warning("capture repaired", **done, passes=_passes(path))
            else:
                self._log.info("capture indexed", **done)


def _passes(path: Path) -> int:
    return sum(1 for _ in (path.parent / "passes").glob("*.npz"))


def main(argv: list[str]) -> int:
    """Finalise one capture; say on standard output what became of it, or on stderr why it stays."""
    os.nice(10)
    try:
        done = finalise(Path(argv[0]), int(argv[1]), decoded=_DECODED in argv)
    except PolecalError as error:
        sys.stderr.write(f"{error}\n")
        return 1
    sys.stdout.write(json.dumps(asdict(done)))
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
