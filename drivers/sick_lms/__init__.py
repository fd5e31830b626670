"""SICK LMS-2xx lasers: serial bytes to scans, and the conversation that gets them."""

from polecal.drivers.sick_lms.describe import Describer
from polecal.drivers.sick_lms.device import Health, SickLms, refusal
from polecal.drivers.sick_lms.framer import Frame, Framer, Skip
from polecal.drivers.sick_lms.scans import (
    REVOLUTION_S,
    SCAN_CODES,
    Decoded,
    Interlace,
    NoRange,
    Scan,
    beam_ages_s,
    bearings_rad,
    decode,
)
from polecal.drivers.sick_lms.telegrams import build

__all__ = [
    "REVOLUTION_S",
    "SCAN_CODES",
    "Decoded",
    "Describer",
    "Frame",
    "Framer",
    "Health",
    "Interlace",
    "NoRange",
    "Scan",
    "SickLms",
    "Skip",
    "beam_ages_s",
    "bearings_rad",
    "build",
    "decode",
    "refusal",
]
