"""A port to the laser on it, as it is found: nothing of it is changed, and a stream goes on."""

from __future__ import annotations

import contextlib
from collections.abc import Iterable
from dataclasses import dataclass, field

from polecal.drivers.errors import DeviceError, DeviceLost
from polecal.drivers.port import Port
from polecal.drivers.sick_lms.conversation import Conversation, NoReply, NotAllowed
from polecal.drivers.sick_lms.health import Errors, Status
from polecal.drivers.sick_lms.telegrams import RequestErrors, RequestStatus, RequestType, TypeText

_FOUND_WITHIN_S = 1.0


@dataclass(frozen=True, slots=True)
class Probe:
    """What was found.

    ``baud``: the laser's rate, None where none answers. ``heard``: by rate, the last bytes that came
    instead of an answer. ``frames``: by rate, how many of them were whole telegrams. ``cannot``: the rates
    that the adapter refused. ``sent``: the request that was made, to tell an echo.
    """

    baud: int | None = None
    identity: str = ""
    status: Status | None = None
    errors: Errors | None = None
    heard: dict[int, bytes] = field(default_factory=dict)
    frames: dict[int, int] = field(default_factory=dict)
    cannot: tuple[int, ...] = ()
    sent: bytes = RequestStatus().build()

    @property
    def frames_heard(self) -> bool:
        """Whether whole telegrams came though none was an answer: a deaf laser's, or an echo."""
        return any(self.frames.values())


def probe(port: Port, rates: Iterable[int], rounds: int = 3) -> Probe:
    """Ask for a laser's status at each rate, then who it is and what ails it.

    Every request is one that a streaming laser answers too (sheet section 7). Raises Stopped, DeviceLost.
    """
    talk = Conversation(port)
    heard: dict[int, bytes] = {}
    frames: dict[int, int] = {}
    cannot: set[int] = set()
    for _ in range(rounds):  # the laser overlooks a request now and then
        for rate in rates:
            if rate in cannot:
                continue
            try:
                talk.set_baud(rate)
            except DeviceLost:
                raise
            except DeviceError:
                cannot.add(rate)
                continue
            try:
                status = talk.ask(RequestStatus(), Status, tries=1, within_s=_FOUND_WITHIN_S)
            except (NoReply, NotAllowed):
                heard[rate] = max(heard.get(rate, b""), talk.heard, key=len)
                frames[rate] = max(frames.get(rate, 0), talk.framer.frames)
                continue
            identity, errors = "", None
            with contextlib.suppress(NoReply, NotAllowed):
                identity = talk.ask(RequestType(), TypeText).text.strip()
                errors = talk.ask(RequestErrors(), Errors)
            return Probe(rate, identity, status, errors, heard, frames, tuple(sorted(cannot)))
    return Probe(heard=heard, frames=frames, cannot=tuple(sorted(cannot)))
