"""An operator's wish to leave a pass out, or to have it back, as it is recorded and written."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from typing import Any

from polecal.daemon.control import Code, Refused
from polecal.daemon.passes import Kept

_NAME = re.compile(r"(?:(?P<laser>.+)-)?(?P<number>\d{1,6})")


@dataclass(frozen=True, slots=True)
class Choice:
    """That a laser's pass is to be dropped, or kept after all; by whom, and when (UTC).

    ``t_ns`` (host time of its scans) and ``site`` tell the pass where another configuration counts the
    passes differently. ``ended`` says that it was made after the run's capture was closed, so that only the
    calibration tells of it.
    """

    laser: str
    number: int
    drop: bool
    by: str
    at: str
    site: int
    t_ns: tuple[int, int]
    ended: bool = False

    @property
    def name(self) -> str:
        """The pass's name."""
        return name_of(self.laser, self.number)

    def as_dict(self) -> dict[str, Any]:
        """Write it for JSON and YAML."""
        return asdict(self) | {"t_ns": list(self.t_ns)}

    @classmethod
    def from_dict(cls, content: dict[str, Any]) -> Choice:
        """Read what `as_dict` wrote."""
        known = {name: content[name] for name in cls.__dataclass_fields__}
        return cls(**known | {"t_ns": (content["t_ns"][0], content["t_ns"][1])})


def name_of(laser: str, number: int) -> str:
    """Give a pass's name, which is also its file's."""
    return f"{laser}-{number:03d}"


def parse_name(said: object, lasers: list[str]) -> tuple[str, int]:
    """Read ``7`` or ``front-007`` as (laser, number). Raises Refused."""
    match = _NAME.fullmatch(str(said)) if isinstance(said, str | int) else None
    if match is None:
        raise Refused(f"{said!r} is no pass", f"name it like 7, or like {name_of(lasers[0], 7)}", Code.USAGE)
    laser, number = match["laser"], int(match["number"])
    if laser is None:
        if len(lasers) > 1:
            names = " or ".join(name_of(name, number) for name in lasers)
            raise Refused(f"pass {number} may be of any of {len(lasers)} lasers", f"name {names}", Code.USAGE)
        return lasers[0], number
    if laser not in lasers:
        raise Refused(f"there is no laser {laser!r}", f"there is {', '.join(lasers)}", Code.USAGE)
    return laser, number


def meant(choice: Choice, passes: Iterable[Kept]) -> int | None:
    """Give the number of the pass that a choice means: the same one, else the one that most overlaps it."""
    best: tuple[int, int | None] = (0, None)
    for one in passes:
        if one.moments.site != choice.site:
            continue
        if (one.id, one.t_ns) == (choice.number, choice.t_ns):
            return one.id
        overlap_ns = min(one.t_ns[1], choice.t_ns[1]) - max(one.t_ns[0], choice.t_ns[0])
        best = max(best, (overlap_ns, one.id), key=lambda each: each[0])
    return best[1]
