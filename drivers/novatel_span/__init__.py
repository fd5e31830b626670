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
    UtcStatus,
)
from polecal.drivers.novatel_span.framer import Fault, Frame, Framer, Kind, Skip
from polecal.drivers.novatel_span.logs import BestPos, InsConfig, InsPva, InsPvax, Time, Version, parse
from polecal.drivers.novatel_span.nav import (
    Accuracy,
    Deduplicator,
    NavState,
    accuracy,
    nav_state,
    position_type,
    reference_point,
)

__all__ = [
    "Accuracy",
    "BestPos",
    "Deduplicator",
    "Describer",
    "Fault",
    "Frame",
    "Framer",
    "InsConfig",
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
    "UtcStatus",
    "Version",
    "accuracy",
    "columns",
    "nav_state",
    "parse",
    "position_type",
    "reference_point",
]
