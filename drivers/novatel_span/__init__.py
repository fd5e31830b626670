"""NovAtel SPAN receiver: bytes of its serial line to frames, logs and navigation states."""

from polecal.drivers.novatel_span.bulk import columns
from polecal.drivers.novatel_span.describe import Describer
from polecal.drivers.novatel_span.device import NovatelSpan
from polecal.drivers.novatel_span.enums import (
    InsStatus,
    MessageId,
    PositionType,
    SolutionStatus,
    TimeStatus,
)
from polecal.drivers.novatel_span.framer import Fault, Frame, Framer, Kind, Skip
from polecal.drivers.novatel_span.logs import BestPos, InsPva, InsPvax, Time, Version, parse
from polecal.drivers.novatel_span.nav import Deduplicator, NavState, nav_state, reference_point

__all__ = [
    "BestPos",
    "Deduplicator",
    "Describer",
    "Fault",
    "Frame",
    "Framer",
    "InsPva",
    "InsPvax",
    "InsStatus",
    "Kind",
    "MessageId",
    "NavState",
    "NovatelSpan",
    "PositionType",
    "Skip",
    "SolutionStatus",
    "Time",
    "TimeStatus",
    "Version",
    "columns",
    "nav_state",
    "parse",
    "reference_point",
]
