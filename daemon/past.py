"""What a session's earlier days left: passes, reflectors that could be the pole, what was dropped."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from polecal.daemon.choices import Choice
from polecal.daemon.passes import Kept
from polecal.daemon.routine import State

Where = tuple[int, int]
"""A reflector: its day's site, and its place there."""


@dataclass(frozen=True, slots=True)
class Past:
    """All that a session's next day starts from; ``passes`` and ``poles`` by laser, ``site`` is the next.

    ``ended``, ``reference_point`` and ``origin`` (of n: degrees, m) are of a session whose last day was
    calibrated.
    """

    site: int
    passes: Mapping[str, Sequence[Kept]]
    poles: Mapping[str, Sequence[Where]]
    choices: tuple[Choice, ...] = ()
    ended: State | None = None
    reference_point: Any = None
    origin: tuple[float, float, float] | None = None

    def as_event(self) -> dict[str, Any]:
        """Write which it is, as the capture of the next day says it: the passes by their numbers alone."""
        return {
            "site": self.site,
            "passes": {name: [one.id for one in passes] for name, passes in self.passes.items()},
            "poles": {name: [list(where) for where in poles] for name, poles in self.poles.items()},
            "choices": [choice.as_dict() for choice in self.choices],
        }

    def as_told(self, event: Mapping[str, Any], *, same_passes: bool) -> Past:
        """Give the part of this that an event says it started from, and its poles and choices.

        A run that was killed, or failed, knew of fewer passes than its capture gives. All of them stay where
        they are not the ``same_passes`` as those that the event lists.
        """
        choices = tuple(Choice.from_dict(each) for each in event["choices"])
        if not same_passes:
            return replace(self, site=event["site"], choices=choices)
        listed = event["passes"]
        return replace(
            self,
            site=event["site"],
            passes={
                name: [one for one in passes if one.id in listed.get(name, [])]
                for name, passes in self.passes.items()
            },
            poles={name: [(site, place) for site, place in poles] for name, poles in event["poles"].items()},
            choices=choices,
        )
