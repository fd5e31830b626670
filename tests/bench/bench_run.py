"""A whole run: the pipeline, the recorder and the solution."""

import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

from polecal.calib import estimate
from polecal.daemon.config import SPAN, loads
from polecal.daemon.passes import StoredPass
from polecal.daemon.pipeline import Pipeline
from polecal.daemon.recorder import Record, Recorder
from polecal.daemon.replay import BEGIN, replay
from polecal.daemon.results import setup_of
from polecal.daemon.tail import Tail
from polecal.drivers.emulated.virtual import Rig, play

HEADINGS = ("what", "value", "unit")

SECONDS = 100.0
T0_NS = 10**12
CONFIG = """
lasers:
  - name: front
    port: /dev/null
    mount: {x_m: 0.0, y_m: -0.35, z_m: -1.0, roll_deg: 0.0, pitch_deg: -8.0, yaw_deg: 0.0}
navigation: {port: /dev/zero}
pole: {radius_m: 0.04, height_m: 2.4}
routine: {min_passes: 99}
"""


def rows() -> Iterator[tuple[object, ...]]:
    rig = Rig.demo(1, T0_NS)
    rig.stream(T0_NS)
    chunks = list(play({"front": rig.laser, SPAN: rig.receiver}, start_ns=T0_NS, seconds=SECONDS))
    config = loads(CONFIG)
    passes: list[StoredPass] = []
    pipeline = Pipeline(config, on_pass=lambda _, stored: passes.append(stored))
    pipeline.begin(T0_NS)
    watch = _Watch()
    for name, t_ns, data in chunks:
        pipeline.feed(name, t_ns, data)
    yield from watch.speed("pipeline")
    moments, setup = [stored.moments for stored in passes], setup_of(config, config.lasers[0])
    for everywhere, what in ((False, "solution after a pass"), (True, "final solution, from everywhere")):
        began_s = time.perf_counter()
        estimate(moments, setup, everywhere=everywhere)
        yield f"{what}, {len(passes)} passes", (time.perf_counter() - began_s) * 1e3, "ms"
    told = {"session": "bench", "created": "", "config": CONFIG}
    with tempfile.TemporaryDirectory() as folder:
        with Recorder(Path(folder) / "capture.mcap", told) as recorder:
            recorder.event(T0_NS, {"event": BEGIN})
            began_s = time.perf_counter()
            for name, t_ns, data in chunks:
                recorder.write(name, "rx", t_ns, data)
            took_s = time.perf_counter() - began_s
            yield "recorder: cost of a message", took_s / len(chunks) * 1e6, "µs"
            tail = Tail(Path(folder), recorder.path, ("front", SPAN))
            began_s = time.perf_counter()
            for name, t_ns, data in chunks:
                tail.put(Record(name, "rx", t_ns, data))
            yield "tail: cost of a chunk", (time.perf_counter() - began_s) / len(chunks) * 1e6, "µs"
            yield "recorder: size", recorder.size_bytes / SECONDS * 60 / 1e6, "MB a minute"
        watch = _Watch()
        replay(recorder.path, None, None, None)
        yield from watch.speed("replay, its files written")


class _Watch:
    """Time since it was made: by the clock, and by the CPU, which tells the same on a busy machine."""

    def __init__(self) -> None:
        self._wall_s, self._cpu_s = time.perf_counter(), time.process_time()

    def speed(self, what: str) -> Iterator[tuple[object, ...]]:
        """Give the rows for what was done to `SECONDS` of a drive."""
        wall_s, cpu_s = time.perf_counter() - self._wall_s, time.process_time() - self._cpu_s
        yield f"{what}: speed", SECONDS / wall_s, "times real time"
        yield f"{what}: speed by CPU time", SECONDS / cpu_s, "times real time"
        yield f"{what}: CPU", 100 * cpu_s / SECONDS, "% of a core at real time"
