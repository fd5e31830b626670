"""A drive without an end, in virtual time: what the daemon holds does not grow with it."""

import gc
import tracemalloc

import pytest

from polecal.daemon import pipeline as pipelines
from polecal.daemon.spill import Spill
from polecal.drivers.emulated import laser_telegrams as lms
from polecal.drivers.emulated.drive import ThereAndBack
from polecal.drivers.emulated.laser import EmulatedLaser
from polecal.drivers.emulated.receiver import EmulatedReceiver
from polecal.drivers.emulated.virtual import play
from polecal.drivers.emulated.world import demo_world

LOGS = (("INSPVASB", 0.05), ("BESTPOSB", 1.0), ("TIMEB", 1.0))


@pytest.fixture(autouse=True)
def all_sums_on_the_disk(tmp_path, monkeypatch):
    monkeypatch.setattr(pipelines, "Spill", lambda _: Spill(tmp_path, in_memory_bytes=0))


def test_memory_is_flat_but_for_the_facts_of_each_pass(begun, settings, t0_ns, tell):
    """From 70 s on all windows are full but that of the poses' quality: 160 bytes of each of 16384."""
    world = demo_world(1)
    world.trajectory = ThereAndBack(world.trajectory, 8.0, world.trajectory.reverse_from_s)
    world.nav_error, world.reflectors = None, ()
    laser = EmulatedLaser(world, t0_ns=t0_ns, seed=1)
    receiver = EmulatedReceiver(world, t0_ns=t0_ns, seed=1)
    laser.force_stream(t0_ns, lms.Variant(100, 100))
    receiver.force_logs(t0_ns, LOGS)
    config = settings(
        laser={"resolution_deg": 1},
        navigation={"port": "/dev/span", "rate_hz": 20},
        routine={"min_passes": 99},
    )
    chunks = list(
        play({"front": laser, "span": receiver}, start_ns=t0_ns, seconds=130.0, chunk_s=0.1, jitter_s=3e-4)
    )
    played = begun(config)
    held_kb, passes = [], []
    waiting, builder = iter(chunks), played.pipeline._lasers["front"].channel._builder
    tracemalloc.start()
    try:
        for until_s in (70.0, 120.0):
            for chunk in waiting:
                played.feed([chunk])
                if chunk[1] - t0_ns > until_s * 1e9 and not builder.counts()[0]:  # no pass is open
                    break
            played.passes.clear()
            gc.collect()
            held_kb.append(tracemalloc.get_traced_memory()[0] / 1e3)
            passes.append(len(played.pipeline._lasers["front"].passes))
    finally:
        tracemalloc.stop()
    more = passes[1] - passes[0]
    grown_kb = held_kb[1] - held_kb[0]
    tell(f"{more} passes: {grown_kb:.0f} kB more; their sums, of 80 kB each, are on the disk")
    assert more > 3
    assert grown_kb < 10 * more + 200
