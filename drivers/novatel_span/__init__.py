"""NovAtel SPAN receiver: bytes of its serial line to frames, logs and navigation states."""

from polecal.drivers.novatel_span.framer import Fault, Frame, Framer, Kind, Skip

__all__ = ["Fault", "Frame", "Framer", "Kind", "Skip"]
