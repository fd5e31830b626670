"""Segmented scans to passes: from the pole's coming into view to its going out of view."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, field, fields, replace

import numpy as np
from numpy.typing import NDArray

from polecal.calib import Kind, Mount, Pass, Returns, points_nav
from polecal.calib.estimate import Blocks, split
from polecal.calib.segment import even_ground
from polecal.daemon import facts
from polecal.daemon.facts import Facts
from polecal.daemon.quality import Quality
from polecal.daemon.spill import Spill
from polecal.daemon.trajectory import Poses

_OUT_OF_VIEW_NS = 1_500_000_000
_LONGEST_NS = 60_000_000_000  # bounds what is kept of a vehicle that never turns away
_FEWEST_POLE_RETURNS = 20


@dataclass(frozen=True, slots=True)
class Kept:
    """What stays of a closed pass in memory: all but its returns."""

    place: int
    t_ns: tuple[int, int]
    moments: Pass
    facts: Facts
    quality: Quality

    @property
    def id(self) -> int:
        """The pass's number, from 1 on over all days of a session."""
        return self.moments.id

    @property
    def where(self) -> tuple[int, int]:
        """Which reflector it is of: site and place."""
        return self.moments.site, self.place

    def spilled(self, spill: Spill) -> Kept:
        """Give the same pass, its sums kept by ``spill``, if they are not yet by any."""
        totals = {
            kind: of if callable(of.held) else replace(of, held=spill.put(of.held))
            for kind, of in self.moments.totals.items()
        }
        return replace(self, moments=replace(self.moments, totals=totals))


def most_of_one(passes: Iterable[Kept]) -> int:
    """Count the passes of each day's reflector of which there are most: the pole, but for odd days."""
    busiest: dict[int, int] = {}
    for (site, _), count in Counter(one.where for one in passes).items():
        busiest[site] = max(count, busiest.get(site, 0))
    return sum(busiest.values())


@dataclass(frozen=True, slots=True)
class StoredPass:
    """A closed pass: its returns with their GPS times, and their moments, by slice and in all."""

    id: int
    place: int
    t_ns: tuple[int, int]
    """Host time of its first and last scan, CLOCK_MONOTONIC ns."""
    gps_ns: NDArray[np.int64]
    """(N,) GPS time of each return."""
    returns: Returns
    blocks: Blocks
    moments: Pass
    facts: Facts
    quality: Quality = field(default_factory=Quality)

    @property
    def kept(self) -> Kept:
        """The pass without its returns."""
        return Kept(self.place, self.t_ns, self.moments, self.facts, self.quality)


@dataclass(slots=True, eq=False)
class OpenPass:
    """A pass that is not over: host times, and GPS times and returns of its scans, some at a time."""

    place: int
    first_ns: int
    last_ns: int
    parts: list[tuple[NDArray[np.int64], Returns]]

    @property
    def ends_ns(self) -> int:
        """Until when it goes on, if it is not seen again."""
        return min(self.last_ns + _OUT_OF_VIEW_NS, self.first_ns + _LONGEST_NS)


class PassBuilder:
    """Collects returns place by place, and closes a pass once its place has not been seen for a while."""

    def __init__(self, slice_deg: int, site: int = 0, count: int = 0) -> None:
        """Begin without any pass; those of ``site`` are numbered on from ``count``."""
        self.too_short = 0
        self.uneven = 0
        """Ground returns left out, as they stood out of the ground."""
        self._slice_deg = slice_deg
        self._open: dict[int, OpenPass] = {}
        self._site, self._count = site, count

    def add(
        self,
        place: int,
        t_ns: tuple[int, int],
        gps_ns: NDArray[np.int64],
        returns: Returns,
    ) -> None:
        """Add some scans' returns of the reflector at ``place`` and of the ground.

        ``t_ns`` is the host time of the first and of the last of these scans.
        """
        current = self._open.setdefault(place, OpenPass(place, *t_ns, []))
        current.last_ns = t_ns[1]
        current.parts.append((gps_ns, returns))

    def close(self, mount: Mount, t_ns: int | None = None) -> list[StoredPass]:
        """Give the passes that have ended by host time ``t_ns``; all that are open if None.

        ``mount`` is the best known, to tell even ground from what stands on it.
        """
        ended = [place for place, one in self._open.items() if t_ns is None or t_ns > one.ends_ns]
        closed = []
        for place in ended:
            one = self._open.pop(place)
            gps_ns = np.concatenate([part[0] for part in one.parts])
            returns = joined([part[1] for part in one.parts], self._count + 1)
            if np.count_nonzero(returns.kind == Kind.POLE) < _FEWEST_POLE_RETURNS:
                self.too_short += 1
                continue
            self._count += 1
            kept = even(returns, mount)
            self.uneven += int(np.count_nonzero(~kept))
            if not kept.all():
                gps_ns, returns = gps_ns[kept], returns[kept]
            blocks = split(returns, self._slice_deg)
            closed.append(
                StoredPass(
                    id=self._count,
                    place=place,
                    t_ns=(one.first_ns, one.last_ns),
                    gps_ns=gps_ns,
                    returns=returns,
                    blocks=blocks,
                    moments=Pass.of(self._count, blocks, self._site),
                    facts=facts.of(returns, gps_ns),
                )
            )
        return closed

    @property
    def open_passes(self) -> tuple[OpenPass, ...]:
        """The passes that are not over, one a place."""
        return tuple(self._open.values())

    def counts(self) -> tuple[int, int]:
        """Give how many passes are open, and how many returns they hold."""
        return len(self._open), sum(len(part[1]) for one in self._open.values() for part in one.parts)


def even(returns: Returns, mount: Mount) -> NDArray[np.bool_]:
    """Say which returns (N,) are the pole's, or of ground that nothing stands on, as ``mount`` has it."""
    kept = np.ones(len(returns), dtype=bool)
    ground = np.flatnonzero(returns.kind == Kind.GROUND)
    down_m = points_nav(returns, mount)[ground, 2]
    kept[ground] = even_ground(returns.range_m[ground], returns.bearing_rad[ground], down_m)
    return kept


def observed(
    range_m: NDArray[np.float64], bearing_rad: NDArray[np.float64], poses: Poses, kind: NDArray[np.uint8]
) -> Returns:
    """Join ranges, bearings and poses of N beams of one scan to returns (their pass is not known yet)."""
    return Returns(
        range_m,
        bearing_rad,
        poses.position_m,
        poses.rpy_rad,
        kind,
        np.zeros(len(range_m), dtype=np.int64),
        poses.velocity_mps,
        poses.rate_radps,
        poses.acceleration_mps2,
        poses.angular_acceleration_radps2,
    )


def joined(parts: list[Returns], pass_id: int) -> Returns:
    """Put returns of one pass behind one another."""
    known = [one.name for one in fields(Returns) if getattr(parts[0], one.name) is not None]
    whole = {name: np.concatenate([getattr(part, name) for part in parts]) for name in known}
    whole["pass_id"] = np.full(len(whole["range_m"]), pass_id, dtype=np.int64)
    return Returns(**whole)
