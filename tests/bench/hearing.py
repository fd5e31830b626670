"""A drive's chunks on standard input to what a process that hears and records them holds, as JSON lines.

``python -m tests.bench.hearing CONFIG CAPTURE EVERY_S``: apart from the devices, so that the memory is the
daemon's alone.
"""

import json
import os
import struct
import sys
from pathlib import Path

from polecal.daemon.config import load
from polecal.daemon.memory import give_back
from polecal.daemon.pipeline import Pipeline
from polecal.daemon.recorder import Recorder

HEAD = struct.Struct("<BqH")
"""Before each chunk: of which device, the lasers' first; its stamp in ns, how many bytes."""


def rss_mb(pid: int) -> float:
    return _status_mb(pid, "VmRSS")


def peak_mb(pid: int) -> float:
    """Give the most that was resident since this was asked last."""
    most = _status_mb(pid, "VmHWM")
    Path(f"/proc/{pid}/clear_refs").write_text("5")  # proc(5): the peak is what there is now
    return most


def _status_mb(pid: int, key: str) -> float:
    status = Path(f"/proc/{pid}/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in status if line.startswith(key)) / 1024


def tell(pipeline: Pipeline, t_s: float) -> None:
    held = {
        "t_s": t_s,
        "rss_mb": rss_mb(os.getpid()),
        "peak_mb": peak_mb(os.getpid()),
        "passes": sum(len(laser.passes) for laser in pipeline._lasers.values()),
    }
    print(json.dumps(held), flush=True)


def main(config_file: str, capture_file: str, every_s: float) -> None:
    give_back()  # as polecald does
    config = load(config_file)
    devices = [*(laser.name for laser in config.lasers), "span"]
    pipeline = Pipeline(config, folder=Path(capture_file).parent)
    begun_ns = due_ns = 0
    with Recorder(Path(capture_file), {}) as capture:
        while head := sys.stdin.buffer.read(HEAD.size):
            number, t_ns, size = HEAD.unpack(head)
            data = sys.stdin.buffer.read(size)
            if not begun_ns:
                begun_ns, due_ns = t_ns, t_ns + round(every_s * 1e9)
                pipeline.begin(t_ns)
            capture.write(devices[number], "rx", t_ns, data)
            pipeline.feed(devices[number], t_ns, data)
            if t_ns >= due_ns:
                tell(pipeline, (t_ns - begun_ns) / 1e9)
                due_ns += round(every_s * 1e9)


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2], float(sys.argv[3]))
