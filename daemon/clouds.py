"""Stored passes to the pole's cloud as an onlooker is shown it: by the measured mount, and by the found."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from polecal.calib import Kind, Mount, Returns, points_nav
from polecal.daemon.sessions import DAMAGE

_MOST_POINTS = 2400  # of a laser, in each of its two clouds
_MOST_OF_A_PASS = 80
_NEEDED = ("range_m", "bearing_rad", "position_m", "rpy_rad", "kind", "pass_id")


class Clouds:
    """Keeps a few pole returns of each pass of one session's laser, so that each file is read once."""

    def __init__(self, folder: Path, laser: str) -> None:
        self._folder, self._laser = folder, laser
        self._thinned: dict[int, tuple[int, Returns]] = {}

    def show(self, passes: Collection[int], measured: Mount, found: Mount) -> list[dict[str, Any]]:
        """Give a row a pass: its number, and its points by either mount, [north, east, down] in m.

        The origin is the middle of the found cloud, on each day its own, as the pole may then be another.
        Passes whose file is not there yet are left out.
        """
        seen = {number: read for number in sorted(passes) if (read := self._read(number)) is not None}
        most = max(1, _MOST_POINTS // max(1, len(seen)))
        drawn = {number: _every(returns, most) for number, (_, returns) in seen.items()}
        after = {number: points_nav(returns, found) for number, returns in drawn.items()}
        middle = {}
        for site in {site for site, _ in seen.values()}:
            of_it = [after[number] for number, read in seen.items() if read[0] == site]
            middle[site] = np.concatenate(of_it).mean(axis=0)
        return [
            {
                "pass": number,
                "heading_deg": _heading_deg(returns),
                "before": _plain(points_nav(returns, measured) - middle[seen[number][0]]),
                "after": _plain(after[number] - middle[seen[number][0]]),
            }
            for number, returns in drawn.items()
        ]

    def _read(self, number: int) -> tuple[int, Returns] | None:
        """Give a pass's site and some of its pole returns, None where it cannot be read."""
        if number not in self._thinned:
            path = self._folder / "passes" / f"{self._laser}-{number:03d}.npz"
            try:
                with path.open("rb") as stream, np.load(stream, allow_pickle=False) as file:
                    returns = Returns(**{name: file[name] for name in _NEEDED})
                    site = int(file["site"])
            except DAMAGE:
                return None
            pole = returns[returns.kind == Kind.POLE]
            self._thinned[number] = site, _every(pole, _MOST_OF_A_PASS)
        return self._thinned[number]


def _every(returns: Returns, most: int) -> Returns:
    """Give at most so many of the returns, evenly over all of them."""
    if len(returns) <= most:
        return returns
    return returns[np.linspace(0, len(returns) - 1, most).astype(np.int64)]


def _heading_deg(returns: Returns) -> float:
    yaw_rad = returns.rpy_rad[:, 2]
    mean = np.degrees(np.arctan2(np.sin(yaw_rad).mean(), np.cos(yaw_rad).mean())) % 360.0
    return round(float(mean), 1)


def _plain(points: NDArray[np.float64]) -> list[list[float]]:
    rows: list[list[float]] = points.round(3).tolist()
    return rows
