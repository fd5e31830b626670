"""Bytes to values: MB/s, and as a multiple of the line's rate."""

import time
from collections.abc import Callable, Iterator

from polecal.drivers import novatel_span, sick_lms
from polecal.drivers.emulated.virtual import Rig, play

HEADINGS = ("what", "MB/s", "times the line's rate", "frames/s")

LASER_LINE_BPS, SPAN_LINE_BPS = 50_000, 23_040
REPEAT = 20
RUNS = 3  # the best counts: others use the machine too


def rows() -> Iterator[tuple[object, ...]]:
    rig = Rig.demo(1, 0)
    rig.stream(0)
    devices = {"laser": rig.laser, "receiver": rig.receiver}
    heard: dict[str, bytes] = dict.fromkeys(devices, b"")
    for name, _, data in play(devices, start_ns=0, seconds=20):
        heard[name] += data
    yield _row("laser: frames", heard["laser"], LASER_LINE_BPS, _telegrams)
    yield _row("laser: frames, ranges, reflectivity", heard["laser"], LASER_LINE_BPS, _scans)
    yield _row("receiver: frames", heard["receiver"], SPAN_LINE_BPS, _logs)
    yield _row("receiver: frames, nav states", heard["receiver"], SPAN_LINE_BPS, _nav_states)
    yield _row("receiver: bulk columns of INSPVAS", heard["receiver"], SPAN_LINE_BPS, _columns)


def _telegrams(data: bytes) -> int:
    return len(sick_lms.Framer().feed(data, 0))


def _logs(data: bytes) -> int:
    return len(novatel_span.Framer().feed(data, 0))


def _scans(data: bytes) -> int:
    frames = sick_lms.Framer().feed(data, 0)
    return sum(len(sick_lms.decode(sick_lms.Scan.parse(frame), 1).ranges_m) > 0 for frame in frames)


def _nav_states(data: bytes) -> int:
    return sum(novatel_span.nav_state(frame) is not None for frame in novatel_span.Framer().feed(data, 0))


def _columns(data: bytes) -> int:
    return len(novatel_span.columns(data, novatel_span.MessageId.INSPVAS))


def _row(what: str, data: bytes, line_bps: int, work: Callable[[bytes], int]) -> tuple[object, ...]:
    data = data * REPEAT
    took_s = float("inf")
    for _ in range(RUNS):
        began_s = time.perf_counter()
        count = work(data)
        took_s = min(took_s, time.perf_counter() - began_s)
    return what, len(data) / took_s / 1e6, len(data) / took_s / line_bps, count / took_s
