"""A receiver's stream to values: ours beside the maker's own decoder, on the same 20 MB of INSPVAS."""

import struct
import time
from collections.abc import Callable, Iterator

import novatel_edie
from novatel_edie import oem

from polecal.drivers.novatel_span import Framer, MessageId, columns, nav_state
from polecal.drivers.novatel_span.framer import crc32

HEADINGS = ("what", "MB/s", "messages/s", "times the maker's, all fields", "times the maker's, iterating")

MESSAGES = 200_000
HALVES = 10  # what takes a Python object a message is measured on so much less
FIELDS = (
    *("week", "seconds", "latitude", "longitude", "height", "north_velocity", "east_velocity", "up_velocity"),
    *("roll", "pitch", "azimuth", "status"),
)


def rows() -> Iterator[tuple[object, ...]]:
    stream = _stream()
    part = stream[: len(stream) // HALVES]
    iterating = _rate(_iterate, stream)
    reading = _rate(_read, part)
    measured = {
        "maker: iterating only": iterating,
        "maker: all fields of each message": reading,
        "ours: columns, all fields in one array": _rate(_columns, stream),
        "ours: frames": _rate(lambda data: len(Framer().feed(data, 0)), part),
        "ours: frames to nav states": _rate(_nav_states, part),
    }
    size = len(stream) / MESSAGES
    for what, rate in measured.items():
        yield what, rate * size / 1e6, rate, rate / reading, rate / iterating


def _stream() -> bytes:
    frames = []
    for number in range(MESSAGES):
        body = struct.pack(
            "<Id9dI", 2345, number * 0.01, -33.9, 151.2, 50.0, 1.0, 2.0, 3.0, 0.5, 1.5, number % 360, 3
        )
        head = struct.pack("<3sBHHI", b"\xaa\x44\x13", len(body), MessageId.INSPVAS, 2345, number * 10)
        frames.append(head + body + struct.pack("<I", crc32(head + body)))
    return b"".join(frames)


def _messages(data: bytes) -> Iterator[object]:
    parser = oem.Parser()
    at = 0
    while at < len(data):
        at += parser.write(data[at : at + parser.available_space])
        yield from parser


def _iterate(data: bytes) -> int:
    return sum(1 for _ in _messages(data))


def _read(data: bytes) -> int:
    count = 0
    names: list[str] = []
    for message in _messages(data):
        assert isinstance(message, novatel_edie.Message)
        names = names or [name for name in message.to_dict() if name != "header"]
        values = [getattr(message, name) for name in names]
        count += len(values) == len(FIELDS)
    return count


def _columns(data: bytes) -> int:
    return len(columns(data, MessageId.INSPVAS))


def _nav_states(data: bytes) -> int:
    return sum(nav_state(frame) is not None for frame in Framer().feed(data, 0))


def _rate(work: Callable[[bytes], int], data: bytes) -> float:
    """Return messages per second, of the best of three."""
    best_s = float("inf")
    for _ in range(3):
        began_s = time.perf_counter()
        count = work(data)
        best_s = min(best_s, time.perf_counter() - began_s)
    return count / best_s
