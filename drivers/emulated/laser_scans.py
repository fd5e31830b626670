"""Turns of the mirror to what the beams met: each beam at its own angle and moment (sheet, section 6)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from polecal.drivers.emulated.drive import Floats
from polecal.drivers.emulated.laser_telegrams import Variant
from polecal.drivers.emulated.laser_values import IN_RANGE, Beams, Fault, Fields
from polecal.drivers.emulated.world import World

REVOLUTION_NS = 13_320_000.0
"""A turn of the mirror at 75 Hz (section 6)."""
_QUARTERS = 4  # of a degree, that an interlaced scan goes through


class Mirror:
    """A mirror that began its turn 0 at ``t0_ns``, and the world that the beams meet.

    ``no_echo`` is the chance that a beam gets no echo. ``faults`` and ``fields`` are what the beams at
    given places of a scan, the first is 0, get instead of their range, and which fields they are in.
    """

    def __init__(self, world: World, *, t0_ns: int, revolution_ns: float, no_echo: float, seed: int) -> None:
        self.t0_ns = t0_ns
        self.faults: dict[int, Fault] = {}
        self.fields: dict[int, Fields] = {}
        self._world = world
        self._revolution_ns = revolution_ns
        self._no_echo = no_echo
        self._seed = seed

    def moment_ns(self, turn: int) -> int:
        """When a turn begins."""
        return self.t0_ns + round(turn * self._revolution_ns)

    def end_from(self, t_ns: float, turns: int) -> int:
        """Return the first turn that begins at or after a moment and ends a scan of so many turns."""
        passed = (t_ns - self.t0_ns) / self._revolution_ns
        return int(-(-passed // turns)) * turns

    def scan(self, end: int, variant: Variant) -> Beams:
        """Return the scan that is complete when turn ``end`` begins."""
        turns = variant.revolutions
        angle_deg = variant.angles_deg
        # Beam i is measured in turn i mod the scan's turns, when the mirror is at its angle
        return self._look(end, end - turns + np.arange(len(angle_deg)) % turns, angle_deg)

    def partial_scan(self, end: int) -> tuple[Beams, int]:
        """Return the 1° raster of the turn before ``end``, a whole half circle, and its quarter degree."""
        quarter = (end - 1) % _QUARTERS
        angle_deg = np.arange(181.0 if quarter == 0 else 180.0) + quarter / _QUARTERS
        return self._look(end, np.full(len(angle_deg), end - 1), angle_deg), quarter

    def _look(self, end: int, turn: NDArray[np.int64], angle_deg: Floats) -> Beams:
        fired_ns = self.t0_ns + np.rint((turn + angle_deg / 360) * self._revolution_ns).astype(np.int64)
        bearing_rad = np.deg2rad(90 - angle_deg)  # the laser's 0 is its right
        range_m, level = self._world.range_scan(self._world.seconds(fired_ns), bearing_rad, key=end)
        lost = ~np.isfinite(range_m)
        if self._no_echo:
            lost |= np.random.default_rng([self._seed, end]).random(len(range_m)) < self._no_echo
        fault = np.where(lost, Fault.NO_ECHO, IN_RANGE)
        fields = np.zeros(len(range_m), np.int64)
        for place, why in self.faults.items():
            fault[place : place + 1] = why
        for place, where in self.fields.items():
            fields[place : place + 1] = where
        return Beams(range_m, level, fault, fields)
