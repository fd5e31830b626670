"""Platform yaw in slices: what has been seen in each, and what to drive next."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from polecal.calib.geometry import Array


@dataclass(frozen=True, slots=True)
class Need:
    """What makes the coverage whole: in each slice so many pole returns and passes, in so many slices."""

    slice_deg: int = 30
    min_pole_returns: int = 100
    min_passes: int = 1
    slices_needed: int = 12


@dataclass(frozen=True, slots=True)
class Slice:
    """What has been seen while the platform's yaw was in [slice, slice + 1) times the slice's width."""

    slice: int
    pole_returns: int
    passes: int
    done: bool


_HAIR = 1e-12  # of a slice: north is 0 also where rounding made it -1e-14


def slice_of(yaw_rad: Array, slice_deg: int) -> NDArray[np.int64]:
    """Give the slice of each platform yaw."""
    slices: NDArray[np.int64] = np.floor(np.degrees(yaw_rad) / slice_deg + _HAIR).astype(np.int64)
    return slices % (360 // slice_deg)


def coverage(pole_returns: Sequence[dict[int, int]], need: Need) -> tuple[Slice, ...]:
    """Give all slices, from each pass's pole returns by slice."""
    slices = []
    for index in range(360 // need.slice_deg):
        counts = [returns[index] for returns in pole_returns if returns.get(index, 0)]
        done = sum(counts) >= need.min_pole_returns and len(counts) >= need.min_passes
        slices.append(Slice(index, sum(counts), len(counts), done))
    return tuple(slices)


def is_whole(slices: Sequence[Slice], need: Need) -> bool:
    """Say whether enough slices are done."""
    return sum(part.done for part in slices) >= need.slices_needed


def headings(slices: Sequence[int], slice_deg: int) -> str:
    """Give slices as headings in words, neighbours joined, also across north: 330-30°, 90-120°."""
    count = 360 // slice_deg
    wanted = set(slices)
    if len(wanted) == count:
        return "0–360°"
    runs = []
    for first in sorted(wanted):
        if (first - 1) % count in wanted:
            continue
        last = first
        while (last + 1) % count in wanted:
            last = (last + 1) % count
        runs.append(f"{first * slice_deg}–{(last + 1) * slice_deg % 360 or 360}°")
    return ", ".join(runs)
