"""One laser's bytes, with the trajectory, to passes of the pole: each beam at its own time and pose."""

from __future__ import annotations

import math
from collections import Counter, defaultdict, deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from polecal.calib import Kind, Mount, Returns, points_nav
from polecal.calib.geometry import rotation_rows
from polecal.calib.observations import points_body
from polecal.calib.segment import RETRO_REFLECTIVE, Ground, Places, Reflector, reflectors
from polecal.daemon.config import Config, Laser
from polecal.daemon.passes import OpenPass, PassBuilder, StoredPass, observed
from polecal.daemon.trajectory import Path, Trajectory
from polecal.drivers.clock import Clock
from polecal.drivers.errors import DeviceProtocolError
from polecal.drivers.port import BITS_PER_BYTE
from polecal.drivers.sick_lms import (
    REVOLUTION_S,
    Decoded,
    Frame,
    Framer,
    Scan,
    beam_ages_s,
    bearings_rad,
    decode,
)
from polecal.drivers.sick_lms.scans import ENERGY, S14, VALUES

LEVELS_MODE = 0x01  # measuring mode 01: 13 bits of range, 3 of reflectivity (sheet, 3.3)

_BRIGHT_WORD = math.ceil(RETRO_REFLECTIVE * 7) << 13  # a word of that mode below it is no reflector's
_SCANS = frozenset((VALUES, ENERGY, S14))  # by levels, or what it fell back to; by energy; of an S14
_REVOLUTION_NS = round(REVOLUTION_S * 1e9)
_MIRROR_DRIFT = 5e-3  # a motor, not a crystal: 75 Hz is 13.33 ms, the sheet's 148 µs word says 13.32 ms
_SILENCE_NS = 2_000_000_000  # after which it may have been switched off, and count from anywhere
_EARLY_SCANS = 0.1  # by which a clock that is still being learnt may put a scan too late
_GROUND_DEG = 1.0  # beams side by side meet the same bumps: of four, one makes σ what all four do, to 2 %
_TOGETHER_NS = 1_000_000_000  # a second's scans are placed at once: one by one it takes four times as long
_MOST_WAITING = 256  # scans that wait for their poses: 14 s at 18.8 Hz
_SLOWEST_MPS, _SLOWEST_RADPS = 0.05, 0.02  # a vehicle that stands adds weight and no information
_GATE_M = (0.5, 2.5)
_DOWN_ROLL_PITCH = slice(2, 5)

NO_POSE = "no pose at the beam's time"
NO_CLOCK = "clocks not settled yet"
STANDING = "vehicle standing"
WAITED_TOO_LONG = "poses came too late"
MALFORMED = "scan telegrams whose parts do not fit"
OTHER_VARIANT = "scans of another angle or resolution"
UNEVEN = "on the ground, but not of it"
OTHER_REFLECTOR = "a reflector, but not the pole"


@dataclass(frozen=True, slots=True)
class _Waiting:
    """A scan in which something could be the pole."""

    stx_ns: int  # host time at which its first byte left the laser
    range_m: NDArray[np.float64]
    reflectivity: NDArray[np.float64]
    found: list[Reflector]


_Sighting = tuple[int, NDArray[np.int64]]  # stamp of a scan, its rows


class LaserChannel:
    """Takes a laser's chunks, and gives passes as soon as the trajectory has come as far."""

    def __init__(
        self,
        laser: Laser,
        config: Config,
        trajectory: Trajectory,
        gps_clock: Clock,
        on_frame: Callable[[int], None],
        *,
        on_scan: Callable[[int, Decoded], None] | None = None,
        site: int = 0,
        passes_before: int = 0,
    ) -> None:
        self.dropped: Counter[str] = Counter()
        """Beams, or scans of a laser, that were not used, by reason."""
        self.framer = Framer()
        self.places = Places()
        self.measured = Mount(**laser.mount.model_dump())
        self.mount = self.measured
        """What places returns in n: the best known so far."""
        self._builder = PassBuilder(config.routine.slice_deg, site, passes_before)
        self._ground = Ground()
        self._clock = Clock(max_drift=_MIRROR_DRIFT)
        self._revolutions: tuple[int, int] | None = None  # the count so far, and its host time
        self._waiting: deque[_Waiting] = deque()
        self._seen_ns = 0
        self._laser, self._pole = laser, config.pole
        self._trajectory, self._gps_clock = trajectory, gps_clock
        self._gps_resets = gps_clock.resets
        self._on_frame, self._on_scan = on_frame, on_scan
        count = round(laser.fov_deg / laser.resolution_deg) + 1
        self._bearing_rad = bearings_rad(count, laser.fov_deg, laser.resolution_deg)
        self._step = max(1, round(_GROUND_DEG / laser.resolution_deg))
        ages_s = beam_ages_s(laser.fov_deg, laser.resolution_deg, count)
        self._age_ns = np.round(ages_s * 1e9).astype(np.int64)
        self._youngest_ns = int(self._age_ns.min())
        self._scan_revolutions = int(np.ceil(ages_s.max() / REVOLUTION_S))
        self._byte_ns = BITS_PER_BYTE * 1e9 / laser.baud

    def feed(self, chunks: Sequence[tuple[bytes, int]]) -> bool:
        """Take chunks, each with the host time at which it was read; say whether a telegram ended in them."""
        frames = self.framer.feed_all(chunks)
        for frame in frames:
            if frame.command not in _SCANS:
                continue
            try:
                scan = Scan.parse(frame)
            except DeviceProtocolError:
                self.dropped[MALFORMED] += 1
                continue
            if scan.count == len(self._bearing_rad) and scan.partial is None:
                self._on_frame(frame.t_first_ns)
                self._take(frame, scan)
            else:
                self.dropped[OTHER_VARIANT] += scan.count
        return bool(frames)

    def _take(self, frame: Frame, scan: Scan) -> None:
        stx_ns = self._stx_ns(frame, scan)
        self._seen_ns = frame.t_first_ns if stx_ns is None else stx_ns
        if self._on_scan is None and scan.code == VALUES and scan.values.max() < _BRIGHT_WORD:
            return
        decoded = decode(scan, LEVELS_MODE)
        if self._on_scan is not None:
            self._on_scan(self._seen_ns, decoded)
        found = reflectors(
            decoded.ranges_m, self._bearing_rad, decoded.reflectivity, pole_radius_m=self._pole.radius_m
        )
        if not found:
            return
        if stx_ns is None or not self._gps_clock.locked:
            self.dropped[NO_CLOCK] += scan.count
            return
        if len(self._waiting) == _MOST_WAITING:
            self._waiting.popleft()
            self.dropped[WAITED_TOO_LONG] += scan.count
        self._waiting.append(_Waiting(stx_ns, decoded.ranges_m, decoded.reflectivity, found))

    def _stx_ns(self, frame: Frame, scan: Scan) -> int | None:
        """Give the host time at which the telegram's first byte left, by the mirror's own clock."""
        stamp_ns = round(frame.t_first_ns - frame.lead_bytes * self._byte_ns)
        if self._revolutions is not None and stamp_ns - self._revolutions[1] > _SILENCE_NS:
            self._clock, self._revolutions = Clock(max_drift=_MIRROR_DRIFT), None
        count = self._revolution(stamp_ns, scan.scan_index)
        self._revolutions = count, stamp_ns
        self._clock.update(count * _REVOLUTION_NS, stamp_ns)
        return self._clock.to_host(count * _REVOLUTION_NS) if self._clock.locked else None

    def _revolution(self, stamp_ns: int, scan_index: int | None) -> int:
        """Give the number of the revolution that a scan ended in, where it is not told by the arrivals."""
        if self._revolutions is None:
            return scan_index or 0
        count, at_ns = self._revolutions
        if scan_index is not None:  # mod 256: 3.4 s
            guess = count + (stamp_ns - at_ns) / _REVOLUTION_NS
            return scan_index + 256 * round((guess - scan_index) / 256)
        if self._clock.locked:
            at_ns = self._clock.to_host(count * _REVOLUTION_NS)
        # Stamps are late, by less than a scan, and never early: what is over a whole number is lateness.
        scans = int((stamp_ns - at_ns) / (self._scan_revolutions * _REVOLUTION_NS) + _EARLY_SCANS)
        return count + self._scan_revolutions * max(1, scans)

    def fuse(self) -> list[StoredPass]:
        """Place scans once a second of them waits; give the passes that have ended."""
        if self._gps_resets != self._gps_clock.resets:
            self._host_jumped()
        if self._waiting and self._seen_ns - self._waiting[0].stx_ns >= _TOGETHER_NS:
            self._place_next()
        oldest_ns = self._waiting[0].stx_ns if self._waiting else self._seen_ns
        return self._closed(oldest_ns)

    def _host_jumped(self) -> None:
        """Learn the mirror's clock anew, as the receiver's had to be.

        The host may have been suspended: its clock stood still meanwhile, and the revolutions that it missed
        cannot be told from their number mod 256, which may look as though next to nothing had happened.
        """
        self._gps_resets = self._gps_clock.resets
        self._clock, self._revolutions = Clock(max_drift=_MIRROR_DRIFT), None
        self.dropped[NO_CLOCK] += sum(len(scan.range_m) for scan in self._waiting)
        self._waiting.clear()

    @property
    def open_passes(self) -> tuple[OpenPass, ...]:
        """The passes that are not over."""
        return self._builder.open_passes

    def end(self) -> list[StoredPass]:
        """Place what can be placed and close what is open, at the end of a run."""
        while self._place_next():
            pass
        return self._closed(None)

    def _closed(self, t_ns: int | None) -> list[StoredPass]:
        passes = self._builder.close(self.mount, t_ns)
        if passes:
            self.dropped[UNEVEN] = self._builder.uneven
        return passes

    def _place_next(self) -> bool:
        """Place the oldest scans whose poses are there, of a second at most; say if there were any."""
        scans: list[_Waiting] = []
        stx_gps_ns: list[int] = []
        while self._waiting and self._gps_clock.locked:  # a clock that starts anew is seconds off at first
            scan = self._waiting[0]
            gps_ns = self._gps_clock.to_device(scan.stx_ns)
            if gps_ns - self._youngest_ns > self._trajectory.last_ns:
                break
            if scans and scan.stx_ns - scans[0].stx_ns > _TOGETHER_NS:
                break
            scans.append(self._waiting.popleft())
            stx_gps_ns.append(gps_ns)
        if scans:
            self._place(scans, np.array(stx_gps_ns)[:, None] - self._age_ns)
        return bool(scans)

    def _place(self, scans: list[_Waiting], gps_ns: NDArray[np.int64]) -> None:
        """Place K scans of N beams, whose GPS times are (K, N)."""
        path = self._trajectory.path(gps_ns.ravel())
        known = path.known.reshape(gps_ns.shape)
        self.dropped[NO_POSE] += int(np.count_nonzero(~known))
        moves_mps, turns_radps = (_mean(of.reshape(gps_ns.shape), known) for of in path.speeds())
        standing = (moves_mps < _SLOWEST_MPS) & (turns_radps < _SLOWEST_RADPS)
        self.dropped[STANDING] += int(np.count_nonzero(known[standing]))
        moving = np.flatnonzero(~standing)
        range_m = np.where(known, np.stack([scan.range_m for scan in scans]), np.nan)
        reflectivity = np.stack([scan.reflectivity for scan in scans])
        down_m = self._down_m(np.nan_to_num(range_m[moving, :: self._step]), path, moving)
        ground = np.zeros((len(scans), down_m.shape[1]), dtype=bool)
        ground[moving] = self._ground.beams(range_m[moving], reflectivity[moving], down_m, step=self._step)
        kind = np.full(gps_ns.size, Kind.GROUND, dtype=np.uint8)

        def returns(rows: NDArray[np.int64]) -> Returns:
            bearing_rad = self._bearing_rad[rows % len(self._bearing_rad)]
            return observed(range_m.ravel()[rows], bearing_rad, path.poses(rows), kind[rows])

        seen: defaultdict[tuple[int, int], list[NDArray[np.int64]]] = defaultdict(list)  # by place and scan
        for place, number, rows in self._sighted(scans, moving, known, returns):
            kind[rows] = Kind.POLE
            seen[place, number].append(rows)  # one reflector may be seen in pieces
        parts: defaultdict[int, list[_Sighting]] = defaultdict(list)
        for (place, number), pieces in seen.items():
            on_ground = number * len(self._bearing_rad) + self._step * np.flatnonzero(ground[number])
            parts[place].append((scans[number].stx_ns, np.concatenate([*pieces, on_ground])))
        for place, sightings in parts.items():
            rows = np.concatenate([each for _, each in sightings])
            t_ns = sightings[0][0], sightings[-1][0]
            self._builder.add(place, t_ns, gps_ns.ravel()[rows], returns(rows))

    def _down_m(
        self, range_m: NDArray[np.float64], path: Path, scans: NDArray[np.int64]
    ) -> NDArray[np.float64]:
        """Give z in n of each ``step``-th return of some scans (M,), at (M, N / step) ranges."""
        origin_m = self.mount.vector[:3]
        bearing_rad = self._bearing_rad[:: self._step]
        rays = points_body(np.ones_like(bearing_rad), bearing_rad, self.mount) - origin_m
        beams = np.arange(0, len(self._bearing_rad), self._step)
        state = path.states(_DOWN_ROLL_PITCH, (scans[:, None] * len(self._bearing_rad) + beams).ravel())
        down_m = state[:, 0].reshape(range_m.shape).copy()
        (down,) = rotation_rows(state[:, 1:], (2,))
        for along, ray, at_m in zip(down, rays.T, origin_m, strict=True):
            down_m += along.reshape(range_m.shape) * (range_m * ray + at_m)
        return down_m

    def _sighted(
        self,
        scans: list[_Waiting],
        moving: NDArray[np.int64],
        known: NDArray[np.bool_],
        returns: Callable[[NDArray[np.int64]], Returns],
    ) -> Iterator[tuple[int, int, NDArray[np.int64]]]:
        """Give the place, the scan's number and the rows of the beams of what could be the pole."""
        width = len(self._bearing_rad)
        met = [
            (number, one, number * width + beams)
            for number in moving.tolist()
            for one in scans[number].found
            if len(beams := one.beams[known[number, one.beams]])
        ]
        if not met:
            return
        counts = [len(rows) for _, _, rows in met]
        points = points_nav(returns(np.concatenate([rows for _, _, rows in met])), self.mount)
        starts = np.cumsum([0, *counts[:-1]])
        north_east_m = np.add.reduceat(points[:, :2], starts) / np.array(counts)[:, None]
        for (number, one, rows), at_ne_m in zip(met, north_east_m.tolist(), strict=True):
            place = self.places.sight(at_ne_m, self._gate_m(one.range_m), thin=one.thin)
            if place is None or not one.thin or not self.places.could_be_pole(place):
                self.dropped[OTHER_REFLECTOR] += len(rows)
            else:
                yield place, number, rows

    def _gate_m(self, range_m: float) -> float:
        """How far off the hand measurement may put a sighting."""
        sigma = self._laser.mount_sigma
        wide_m = 2 * (sigma.xyz_m + range_m * math.radians(sigma.rpy_deg))
        return min(max(wide_m, _GATE_M[0]), _GATE_M[1])


def _mean(values: NDArray[np.float64], known: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Give the mean (K,) of each scan's values (K, N) where they are known, 0 where none is."""
    mean: NDArray[np.float64] = np.where(known, values, 0.0).sum(axis=1) / np.maximum(known.sum(axis=1), 1)
    return mean
