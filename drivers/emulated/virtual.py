"""Emulated devices without real time: the chunks that a host would have read, as fast as they can be made."""

from __future__ import annotations

import random
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

from polecal.drivers.emulated.laser import EmulatedLaser
from polecal.drivers.emulated.line import EmulatedDevice
from polecal.drivers.emulated.receiver import EmulatedReceiver, PlaybackReceiver, recorded_path
from polecal.drivers.emulated.steer import Steered
from polecal.drivers.emulated.world import HAND_MEASURED, MountPose, World, demo_world, steered_world

STREAM_LOGS = (("INSPVASB", 0.01), ("BESTPOSB", 1.0), ("TIMEB", 1.0))
"""What a host wants of the receiver, as (log, period in s)."""


RECORDED_LOGS = (("INSPVAXB", 0.05), ("BESTPOSB", 1.0), ("TIMEB", 1.0))
"""The same of a receiver that plays a recording: it says what it once said."""

_RECORDED_POLE_NE_M = (3.25, -0.75)
_RECORDED_GROUND_M = 0.1  # below the recorded vehicle's reference point, where that was at first


@dataclass(frozen=True, slots=True)
class Rig:
    """A world and the two devices that see it."""

    world: World
    laser: EmulatedLaser
    receiver: EmulatedReceiver | PlaybackReceiver
    logs: tuple[tuple[str, float], ...] = STREAM_LOGS

    @classmethod
    def demo(cls, seed: int, t0_ns: int) -> Rig:
        """Return the demonstration's world with both devices just powered up."""
        world = demo_world(seed)
        return cls(
            world,
            EmulatedLaser(world, t0_ns=t0_ns, seed=seed),
            EmulatedReceiver(world, t0_ns=t0_ns, seed=seed),
        )

    @classmethod
    def steered(cls, seed: int, t0_ns: int, hand: MountPose = HAND_MEASURED) -> Rig:
        """Return a vehicle that stands 9 m from a pole until it is told where to drive, as `Steered` is."""
        vehicle = Steered((3.0, -6.0, 0.3), seed=seed)
        world = steered_world(vehicle, seed, hand)
        return cls(
            world,
            EmulatedLaser(world, t0_ns=t0_ns, seed=seed),
            EmulatedReceiver(world, t0_ns=t0_ns, seed=seed),
        )

    @classmethod
    def recorded(
        cls,
        recording: tuple[bytes, Sequence[int], Sequence[float]],
        *,
        t0_ns: int,
        mount: MountPose,
        seed: int = 0,
        pole_ne_m: tuple[float, float] = _RECORDED_POLE_NE_M,
        ground_z_m: float = _RECORDED_GROUND_M,
    ) -> Rig:
        """Return a receiver that plays a recording (`load_recording`), and a laser on that same driven path.

        The world's origin is the recording's first pose, and its motion begins with the first chunk.
        """
        path, origin = recorded_path(*recording)
        world = World(
            path, mount=mount, pole_ne_m=pole_ne_m, ground_z_m=ground_z_m, reference=origin, seed=seed
        )
        return cls(
            world,
            EmulatedLaser(world, t0_ns=t0_ns, seed=seed, starts_world=False),
            PlaybackReceiver(*recording, t0_ns=t0_ns, seed=seed, on_start=world.start),
            RECORDED_LOGS,
        )

    def stream(self, t_ns: int) -> None:
        """Have both devices stream as after a host's whole set-up."""
        self.laser.force_stream(t_ns)
        self.receiver.force_logs(t_ns, self.logs)


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
