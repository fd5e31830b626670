"""What has happened to the state of the calibration run: a state machine without I/O."""

from __future__ import annotations

from collections.abc import Callable
from enum import StrEnum

from polecal import PolecalError


class State(StrEnum):
    """Where a run is (design.md, the way of the data, 6)."""

    IDLE = "idle"
    CONNECTING = "connecting"
    ALIGNING = "aligning"
    COLLECTING = "collecting"
    CALIBRATING = "calibrating"
    ACCEPTED = "accepted"
    REJECTED = "rejected"
    FAULT = "fault"

    __hash__ = str.__hash__  # looked up with every chunk


ENDED = frozenset({State.IDLE, State.ACCEPTED, State.REJECTED, State.FAULT})
"""In these nothing runs."""

_NEXT = {
    State.IDLE: {State.CONNECTING},
    State.CONNECTING: {State.ALIGNING, State.CALIBRATING},
    State.ALIGNING: {State.COLLECTING, State.CALIBRATING},
    State.COLLECTING: {State.ALIGNING, State.CALIBRATING},
    State.CALIBRATING: {State.ACCEPTED, State.REJECTED},
    State.ACCEPTED: {State.CONNECTING, State.CALIBRATING},
    State.REJECTED: {State.CONNECTING, State.CALIBRATING},
    State.FAULT: {State.CONNECTING},
}

OnTransition = Callable[[int, State, State, str], None]
"""Takes (t_ns, old, new, why)."""


class RoutineError(PolecalError):
    """A step that the routine does not have: a fault of the program."""


class Routine:
    """The run's state; each transition has a reason and is reported once."""

    def __init__(self, on_transition: OnTransition | None = None) -> None:
        self.state = State.IDLE
        self.since_ns = 0
        self._on_transition = on_transition

    @property
    def running(self) -> bool:
        """Whether data is still being taken."""
        return self.state not in ENDED

    def to(self, state: State, t_ns: int, why: str) -> None:
        """Go to a state; to the present one is nothing, to idle or fault is possible from everywhere.

        Raises RoutineError.
        """
        if state is self.state:
            return
        if state not in (State.IDLE, State.FAULT) and state not in _NEXT[self.state]:
            raise RoutineError(f"there is no way from {self.state} to {state}", "report this as a bug")
        old, self.state, self.since_ns = self.state, state, t_ns
        if self._on_transition is not None:
            self._on_transition(t_ns, old, state, why)

    def reopen(self, state: State, t_ns: int) -> None:
        """Stand where a run ended in another life of the daemon; nobody is told."""
        self.state, self.since_ns = state, t_ns
