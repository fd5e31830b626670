"""SICK LMS-2xx lasers: serial bytes to scans, and the conversation that gets them."""

from polecal.drivers.sick_lms.framer import Frame, Framer, Skip

__all__ = ["Frame", "Framer", "Skip"]
