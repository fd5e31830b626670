"""Poses as they come, to what the navigation was worth over a stretch of time, at its worst."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass
from itertools import groupby

from polecal.drivers.novatel_span import Accuracy, InsStatus, PositionType

UTC_OFFSET_S = -18.0
"""UTC less GPS time since 2017; the receiver's TIME log tells it."""

_KEPT = 16_384  # poses: 80 s at 200 Hz, more than the longest pass and what it waits to be closed
_BEST_FIRST = (
    ("INT", "RTKFIXED", "RTK_DIRECT_INS"),
    ("FLOAT",),
    ("PPP", "OMNISTAR", "XP", "HP"),
    ("DIFF", "WAAS", "SBAS"),
    ("SINGLE", "PSRSP"),
)


@dataclass(frozen=True, slots=True)
class Quality:
    """The worst that the receiver said over a pass; None where it said nothing. σ of position: horizontal."""

    ins_status: str | None = None
    position_type: str | None = None
    position_sigma_m: float | None = None
    azimuth_sigma_deg: float | None = None
    unused_poses: int = 0
    utc_offset_s: float = UTC_OFFSET_S


_Pose = tuple[int, bool, InsStatus | int, PositionType | int | None, Accuracy | None]
"""GPS time, whether it was used, status, what the position rests on, and standard deviations."""


class QualityLog:
    """What the receiver said of its last poses."""

    def __init__(self) -> None:
        self.utc_offset_s = UTC_OFFSET_S
        self._poses: deque[_Pose] = deque(maxlen=_KEPT)

    def add(
        self,
        gps_ns: int,
        used: bool,
        ins_status: InsStatus | int,
        position_type: PositionType | int | None,
        accuracy: Accuracy | None,
    ) -> None:
        """Take a pose, used or not, and what was known beside it."""
        self._poses.append((gps_ns, used, ins_status, position_type, accuracy))

    def over(self, first_ns: int, last_ns: int) -> Quality:
        """Give the worst between two GPS times."""
        poses = [pose for pose in self._poses if first_ns <= pose[0] <= last_ns]
        if not poses:
            return Quality(utc_offset_s=self.utc_offset_s)
        _, used, *columns = zip(*poses, strict=True)
        # They stay as they are for many poses: each is looked at once.
        statuses, types, told = ([said for said, _ in groupby(of) if said is not None] for of in columns)
        status = max(statuses, key=lambda said: said != InsStatus.INS_SOLUTION_GOOD)
        return Quality(
            ins_status=_name(status),
            position_type=_name(max(types, key=_rank)) if types else None,
            position_sigma_m=_most(max(each.position_m[:2]) for each in told),
            azimuth_sigma_deg=_most(each.attitude_deg[2] for each in told),
            unused_poses=used.count(False),
            utc_offset_s=self.utc_offset_s,
        )


def _most(values: Iterable[float]) -> float | None:
    return max(values, default=None)


def _rank(position_type: PositionType | int) -> int:
    """Give 0 for whole wavelengths counted, more for less."""
    name = _name(position_type)
    return next(
        (rank for rank, words in enumerate(_BEST_FIRST) if any(name.endswith(word) for word in words)),
        len(_BEST_FIRST),
    )


def _name(value: InsStatus | PositionType | int) -> str:
    return value.name if isinstance(value, InsStatus | PositionType) else f"unknown ({value})"
