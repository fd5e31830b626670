"""Emulated devices without real time: the chunks that a host would have read, as fast as they can be made."""

from __future__ import annotations

import random
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass

from polecal.drivers.emulated.laser import EmulatedLaser
from polecal.drivers.emulated.line import EmulatedDevice
from polecal.drivers.emulated.receiver import EmulatedReceiver
from polecal.drivers.emulated.world import World, demo_world

STREAM_LOGS = (("INSPVASB", 0.01), ("BESTPOSB", 1.0), ("TIMEB", 1.0))
"""What a host wants of the receiver, as (log, period in s)."""


@dataclass(frozen=True, slots=True)
class Rig:
    """A world and the two devices that see it."""

    world: World
    laser: EmulatedLaser
    receiver: EmulatedReceiver

    @classmethod
    def demo(cls, seed: int, t0_ns: int) -> Rig:
        """Return the demonstration's world with both devices just powered up."""
        world = demo_world(seed)
        return cls(
            world,
            EmulatedLaser(world, t0_ns=t0_ns, seed=seed),
            EmulatedReceiver(world, t0_ns=t0_ns, seed=seed),
        )

    def stream(self, t_ns: int) -> None:
        """Have both devices stream as after a host's whole set-up."""
        self.laser.force_stream(t_ns)
        self.receiver.force_logs(t_ns, STREAM_LOGS)


def play(
    devices: Mapping[str, EmulatedDevice],
    *,
    start_ns: int,
    seconds: float,
    script: Iterable[tuple[int, str, bytes]] = (),
    chunk_s: float = 0.002,
    jitter_s: float = 0.0,
    seed: int = 0,
) -> Iterator[tuple[str, int, bytes]]:
    """Yield (device, host's stamp in ns, bytes) of each chunk read, in order of the stamps.

    The host reads at most every ``chunk_s``, at the device's own rate, and its stamps are late by an
    exponential jitter of mean ``jitter_s``. ``script`` has what it writes: (moment in ns, device, bytes), in
    order of the moments.
    """
    chance = random.Random(seed)  # noqa: S311
    writes = iter(script)
    write = next(writes, None)
    step_ns, end_ns = round(chunk_s * 1e9), start_ns + round(seconds * 1e9)
    t_ns, stamp_ns = start_ns, start_ns
    while t_ns <= end_ns:
        while write is not None and write[0] <= t_ns:
            devices[write[1]].receive(write[0], write[2], devices[write[1]].baud)
            write = next(writes, None)
        for name, device in devices.items():
            data = device.transmit(t_ns, device.baud)
            if data:
                late_s = chance.expovariate(1 / jitter_s) if jitter_s else 0.0
                stamp_ns = max(stamp_ns, t_ns + round(late_s * 1e9))
                yield name, stamp_ns, data
        moments = [moment for device in devices.values() if (moment := device.next_ns()) is not None]
        if write is not None:
            moments.append(write[0])
        if not moments:
            return
        t_ns = max(t_ns + step_ns, min(moments))
