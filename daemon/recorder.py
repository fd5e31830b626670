"""Raw bytes of every device, both ways, into an MCAP file that survives a crash, and back."""

from __future__ import annotations

import errno
import json
import os
import struct
import threading
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from io import BytesIO
from operator import itemgetter
from pathlib import Path
from typing import IO, Any, Literal, NamedTuple, Self, TypeVar, cast

from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, DataEnd, Message, Metadata
from mcap.stream_reader import get_chunk_data_stream
from mcap.writer import CompressionType, Writer
from zstandard import ZstdError

from polecal import PolecalError, __version__

RAW = "application/octet-stream"
EVENTS = "/events"
METADATA = "polecal"
_MAGIC = b"\x89MCAP0\r\n"
_CHANNEL, _MESSAGE, _CHUNK = int(Opcode.CHANNEL), int(Opcode.MESSAGE), int(Opcode.CHUNK)
_DATA_END, _FOOTER = int(Opcode.DATA_END), int(Opcode.FOOTER)
"""Plain numbers: to compare with an enum's takes eight times as long, and there are hundreds in a second."""
_RECORD_HEAD = struct.Struct("<BQ")  # opcode, length of the body
_MESSAGE_HEAD = struct.Struct("<HIQQ")  # channel, sequence, log time, publish time
_CHANNEL_TIME = struct.Struct("<H4xQ8x")  # the same, channel and log time of it
_AT_ONCE_BYTES = 1 << 18  # that are read of a file
_DAMAGE = (McapError, ValueError, struct.error, ZstdError)  # what the package raises on senseless bytes
_CUT_OFF = "is cut off"
FULL = (errno.ENOSPC, errno.EDQUOT)
_NAME_ONE = "name a capture.mcap of polecal"

Direction = Literal["rx", "tx"]
_R = TypeVar("_R", Channel, Chunk, DataEnd)


class RecorderError(PolecalError):
    """A capture that cannot be written, or read."""


class DiskFull(RecorderError):
    """There is no room for a message; it is kept, and goes before any other once there is."""


class Record(NamedTuple):  # made in half a dataclass's time: there are hundreds in a second
    """One chunk of bytes as it went over a device's line; ``t_ns`` is CLOCK_MONOTONIC."""

    device: str
    direction: Direction
    t_ns: int
    data: bytes


_record = partial(tuple.__new__, Record)  # as Record._make does, in two thirds of Record's time


@dataclass(frozen=True, slots=True)
class Event:
    """Something that the daemon did or noticed at ``t_ns`` (CLOCK_MONOTONIC)."""

    t_ns: int
    content: dict[str, Any]


class Recorder:
    """An MCAP file under way; any thread may write.

    Not chunked, and each message is one ``write`` to the file: whatever was written before a ``kill -9``
    is in it, and after a power cut whatever was written before the last `sync`.
    """

    def __init__(self, path: Path, metadata: dict[str, str]) -> None:
        """Begin a capture at a path where nothing is. Raises RecorderError."""
        self.path = path
        self._lock = threading.Lock()
        self._syncing = threading.Lock()
        self._channels: dict[tuple[str, str], int] = {}
        self._messages = 0
        self._file = _WholeWrites(path)
        self._writer = Writer(
            cast(IO[bytes], self._file),
            use_chunking=False,
            compression=CompressionType.NONE,
            enable_data_crcs=True,
        )
        try:
            self._writer.start(library=f"polecal {__version__}")
            self._writer.add_metadata(METADATA, metadata)
        except RecorderError:
            self._file.close()
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def size_bytes(self) -> int:
        """How much is in the file."""
        return self._file.tell()

    @property
    def closed(self) -> bool:
        """Whether nothing can be written any more."""
        return self._file.closed

    def add(self, item: Record | Event) -> None:
        """Record a chunk or an event. Raises RecorderError, as `write` does."""
        if isinstance(item, Record):
            self.write(item.device, item.direction, item.t_ns, item.data)
        else:
            self.event(item.t_ns, item.content)

    def write(self, device: str, direction: Direction, t_ns: int, data: bytes) -> None:
        """Record a chunk. Raises RecorderError: this chunk is lost, the file is whole."""
        self._message(topic_of(device, direction), RAW, t_ns, data)

    def event(self, t_ns: int, content: dict[str, Any]) -> None:
        """Record what the daemon did or noticed. Raises RecorderError, as `write` does."""
        self._message(EVENTS, "json", t_ns, json.dumps(content, separators=(",", ":")).encode())

    def _message(self, topic: str, encoding: str, t_ns: int, data: bytes) -> None:
        with self._lock:
            self._file.settle()
            channel = self._channels.get((topic, encoding))
            if channel is None:  # its record goes out in one piece with its first message
                channel = self._writer.register_channel(topic, encoding, schema_id=0)
                self._channels[topic, encoding] = channel
            self._messages += 1
            self._writer.add_message(channel, t_ns, data, t_ns, self._messages)

    def settle(self) -> None:
        """Write what there was no room for. Raises DiskFull if there still is none."""
        with self._lock:
            self._file.settle()

    def sync(self) -> None:
        """Wait until all that was written is on the disk; writers need not wait. Raises RecorderError."""
        with self._syncing:
            self._file.sync()

    def abandon(self) -> None:
        """End the capture behind its last whole message, as a kill would, for good. Raises RecorderError."""
        with self._lock, self._syncing:
            if self._file.closed:
                return
            try:
                self._file.sync()
            finally:
                self._file.close()

    def close(self) -> None:
        """Write the summary and close the file, which a full disk leaves cut off. Raises RecorderError."""
        with self._lock, self._syncing:
            if self._file.closed:
                return
            try:
                self._file.settle()
                self._writer.finish()  # type: ignore[no-untyped-call]
                self._file.sync()
            finally:
                self._file.close()


class _WholeWrites:
    """A file in which each ``write`` is there as a whole or not at all.

    The writer counts what it hands over (statistics, CRC) before it knows whether there was room. So
    what did not fit is owed: it is kept, and `settle` writes it before anything else may be.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._size = 0
        self._owed = b""
        try:
            self._fd = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o640)
            folder = os.open(path.parent, os.O_RDONLY | os.O_CLOEXEC)
            try:
                os.fsync(folder)  # the name too must outlive a power cut
            finally:
                os.close(folder)
        except FileExistsError as error:
            raise RecorderError(f"{path}: is there already", "a capture is never written over") from error
        except OSError as error:
            raise self._error(error) from error

    @property
    def closed(self) -> bool:
        return self._fd < 0

    def write(self, data: bytes) -> int:
        self.settle()
        self._owed = bytes(data)
        self.settle()
        return len(data)

    def settle(self) -> None:
        if self._owed and self.closed:
            raise RecorderError(f"{self._path}: the capture is closed")
        left = memoryview(self._owed)
        try:
            while left:
                left = left[os.write(self._fd, left) :]
        except OSError as error:
            try:
                os.ftruncate(self._fd, self._size)
                os.lseek(self._fd, self._size, os.SEEK_SET)
            except OSError:
                self.close()  # what follows half a message could not be read
            raise self._error(error) from error
        self._size += len(self._owed)
        self._owed = b""

    def tell(self) -> int:
        return self._size

    def flush(self) -> None: ...

    def sync(self) -> None:
        if self.closed:
            return
        try:
            os.fdatasync(self._fd)
        except OSError as error:
            raise self._error(error) from error

    def close(self) -> None:
        fd, self._fd = self._fd, -1
        os.close(fd)

    def _error(self, error: OSError) -> RecorderError:
        kind = DiskFull if error.errno in FULL else RecorderError
        return kind(
            f"{self._path}: cannot be written: {error.strerror}",
            "see that the disk is there, has room (`df -h`) and that this user may write to it",
        )


class Capture:
    """A capture to iterate over: each Record and Event, in the order in which they were written.

    ``metadata`` is there from the start. ``cut``, once iterated, is None for a file that was closed, or
    says in a sentence how far one that is cut off or damaged went; ``damaged`` tells the second, after which
    there may be more that is whole. ``used_bytes`` of ``size_bytes`` tell how far the iteration is.
    """

    def __init__(self, path: Path) -> None:
        """Read as far as the metadata. Raises RecorderError for a file that is no capture."""
        self.path = path
        self.cut: str | None = None
        self.damaged = False
        self.used_bytes = 0
        try:
            with path.open("rb") as stream:
                self.size_bytes = os.fstat(stream.fileno()).st_size
                self.metadata = self._find_metadata(stream)
        except OSError as error:
            raise RecorderError(f"{path}: cannot be read: {error.strerror}", _NAME_ONE) from error

    def __iter__(self) -> Iterator[Record | Event]:
        return map(itemgetter(2), self.messages())

    def messages(self) -> Iterator[tuple[Channel, bytes, Record | Event]]:
        """Give each message that was recorded, as it lies in the file (see `message_of`), and its meaning."""
        self.cut, self.damaged, self.used_bytes = None, False, 0
        count, first_ns, last_ns = 0, 0, 0
        channels: dict[int, tuple[Channel, str | None, Direction]] = {}
        try:
            with self.path.open("rb") as stream:
                for opcode, body in self._walk(stream):
                    if opcode != _MESSAGE:
                        if opcode == _CHANNEL:
                            channel = _read(Channel, body)
                            channels[channel.id] = channel, *_line(channel)
                        continue
                    try:
                        number, t_ns = _CHANNEL_TIME.unpack_from(body)
                        channel, device, direction = channels[number]
                    except struct.error as error:
                        raise _Cut(f"is damaged ({error})") from error
                    except KeyError as error:
                        raise _Cut("is damaged (a message on a channel that is not there)") from error
                    if device is not None:
                        data = body[_MESSAGE_HEAD.size :]
                        item = _record((device, direction, t_ns, data)) if device else _event(t_ns, data)
                        count += 1
                        first_ns, last_ns = first_ns or t_ns, t_ns
                        yield channel, body, item
        except _Cut as cut:
            self.damaged = cut.args[0] != _CUT_OFF
            self.cut = (
                f"{self.path} {cut}: used {self.used_bytes} of {self.size_bytes} bytes, "
                f"{count} messages, {(last_ns - first_ns) / 1e9:.1f} s"
            )

    def _find_metadata(self, stream: IO[bytes]) -> dict[str, str]:
        try:
            for opcode, body in self._walk(stream):
                if opcode == Opcode.METADATA:
                    metadata = Metadata.read(ReadDataStream(BytesIO(body)))
                    if metadata.name == METADATA:
                        return dict(metadata.metadata)
                elif opcode in (Opcode.MESSAGE, Opcode.CHUNK, Opcode.DATA_END):
                    break
        except _Cut as cut:
            raise RecorderError(f"{self.path} {cut}, and nothing in it can be used", _NAME_ONE) from cut
        except _DAMAGE as error:
            raise RecorderError(f"{self.path}: its metadata is damaged: {error}", _NAME_ONE) from error
        raise RecorderError(f"{self.path}: an MCAP file, but not recorded by polecal", _NAME_ONE)

    def _walk(self, stream: IO[bytes]) -> Iterator[tuple[int, bytes]]:
        """Take the file apart into (opcode, body) up to its footer; behind a chunk comes what is in it.

        Raises RecorderError for another kind of file, _Cut where this one ends before its end. Not the
        package's StreamReader: it believes a damaged length, and reads a gigabyte or to the end for it.
        """
        magic = stream.read(len(_MAGIC))
        if not magic or magic != _MAGIC[: len(magic)]:
            raise RecorderError(f"{self.path}: not a capture, no MCAP file at all", _NAME_ONE)
        self.used_bytes, crc = len(magic), zlib.crc32(magic)
        held, lacking, ended = b"", 0, False
        while more := stream.read(max(_AT_ONCE_BYTES, lacking)):
            held, at, lacking = held + more, 0, 0
            while (start := at + _RECORD_HEAD.size) <= len(held):
                opcode, length = _RECORD_HEAD.unpack_from(held, at)
                if opcode == 0:  # left by the file system where blocks were lost; no record has it
                    raise _Cut("is damaged (nothing where a record should begin)")
                if length > self.size_bytes:
                    raise _Cut(_CUT_OFF)
                end = start + length
                if end > len(held):
                    lacking = end - len(held)
                    break
                if opcode == _DATA_END:
                    ended = True
                    told = _read(DataEnd, held[start:end]).data_section_crc
                    if told not in (0, zlib.crc32(memoryview(held)[:at], crc)):
                        raise _Cut("is damaged (bytes in it were changed: the CRC is wrong)")
                yield opcode, held[start:end]
                if opcode == _CHUNK:
                    yield from _inside(held[start:end])
                self.used_bytes += end - at
                if opcode == _FOOTER:
                    if not ended:
                        raise _Cut("is damaged (its data have no end)")
                    if held[end:] + stream.read() != _MAGIC:
                        raise _Cut(_CUT_OFF)
                    self.used_bytes = self.size_bytes
                    return
                at = end
            held, crc = held[at:], zlib.crc32(memoryview(held)[:at], crc)
        raise _Cut(_CUT_OFF)


def read(path: Path) -> Capture:
    """Open a capture, whole or cut off. Raises RecorderError for a file that is none."""
    return Capture(path)


class _Cut(Exception):
    """The file goes no further, though it was not closed there; the message says what is wrong."""


def topic_of(device: str, direction: Direction) -> str:
    """Give the topic of a line's chunks."""
    return f"/{device}/{direction}"


def message_of(body: bytes) -> Message:
    """Read a message's record."""
    channel, sequence, log_time, publish_time = _MESSAGE_HEAD.unpack_from(body)
    return Message(channel, log_time, body[_MESSAGE_HEAD.size :], publish_time, sequence)


def _inside(body: bytes) -> Iterator[tuple[int, bytes]]:
    """Give each (opcode, body) in a chunk's record. Raises _Cut.

    Not the package's way, which takes five times as long to read the messages in them.
    """
    try:
        stream, size = get_chunk_data_stream(_read(Chunk, body), validate_crc=True)
    except _DAMAGE as error:
        raise _Cut(f"is damaged ({error})") from error
    inside, at = stream.read(size), 0
    while at < size:
        if at + _RECORD_HEAD.size > size:
            raise _Cut("is damaged (a chunk that ends within a record)")
        opcode, length = _RECORD_HEAD.unpack_from(inside, at)
        at += _RECORD_HEAD.size + length
        if at > size:
            raise _Cut("is damaged (a chunk that ends within a record)")
        yield opcode, inside[at - length : at]


def _read(kind: type[_R], body: bytes) -> _R:
    """Read a record by the package. Raises _Cut."""
    try:
        record: _R = kind.read(ReadDataStream(BytesIO(body)))
    except _DAMAGE as error:
        raise _Cut(f"is damaged ({error})") from error
    return record


def _event(t_ns: int, data: bytes) -> Event:
    """Read what was done or noticed. Raises _Cut."""
    try:
        content = json.loads(data)
    except ValueError as error:
        raise _Cut(f"is damaged ({error})") from error
    if not isinstance(content, dict):
        raise _Cut("is damaged (an event that is none)")
    return Event(t_ns, content)


def _line(channel: Channel) -> tuple[str | None, Direction]:
    """Tell the device and the direction that a channel is of: "" of events, None if it was decoded."""
    if channel.topic == EVENTS:
        return "", "rx"
    device, _, direction = channel.topic.removeprefix("/").rpartition("/")
    recorded = channel.message_encoding == RAW and direction in ("rx", "tx") and device
    return device if recorded else None, cast(Direction, direction)
