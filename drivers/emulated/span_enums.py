"""A SPAN receiver's names for its numbers (sheet, section 3), those that the emulated one says."""

from __future__ import annotations

from enum import IntEnum


class InsStatus(IntEnum):
    """Section 3.1."""

    INS_INACTIVE = 0
    INS_ALIGNING = 1
    INS_HIGH_VARIANCE = 2
    INS_SOLUTION_GOOD = 3
    INS_SOLUTION_FREE = 6
    INS_ALIGNMENT_COMPLETE = 7
    DETERMINING_ORIENTATION = 8
    WAITING_INITIALPOS = 9
    WAITING_AZIMUTH = 10
    INITIALIZING_BIASES = 11
    MOTION_DETECT = 12


class SolStatus(IntEnum):
    """Section 3.3."""

    SOL_COMPUTED = 0
    INSUFFICIENT_OBS = 1


class PosType(IntEnum):
    """Section 3.3."""

    NONE = 0
    DOPPLER_VELOCITY = 8
    SINGLE = 16
    NARROW_INT = 50
    INS_PSRSP = 53
    INS_RTKFIXED = 56
    PPP = 69
    INS_PPP = 74


class TimeStatus(IntEnum):
    """Section 3.4."""

    UNKNOWN = 20
    FINESTEERING = 180


class ClockStatus(IntEnum):
    """Section 3.4, of TIME and MARKTIME."""

    VALID = 0
    INVALID = 3


class UtcStatus(IntEnum):
    """Section 2.2, TIME."""

    INVALID = 0
    VALID = 1


class Datum(IntEnum):
    """Section 2.2, BESTPOS."""

    WGS84 = 61


class Component(IntEnum):
    """Section 2.2, VERSION."""

    GPSCARD = 1
    CONTROLLER = 2
    ENCLOSURE = 3
    IMUCARD = 7
    USERINFO = 8
    OEM7FPGA = 21


class EventWord(IntEnum):
    """Section 2.2, RXSTATUSEVENT: the status word of which it speaks."""

    STATUS = 1
    AUX4 = 5


class EventType(IntEnum):
    """Section 2.2, RXSTATUSEVENT."""

    CLEAR = 0
    SET = 1


class ImuType(IntEnum):
    """Section 2.3, INSCONFIG and RAWIMUX."""

    HG1700_AG58 = 11
    EPSON_G320 = 41


class Profile(IntEnum):
    """SETINSPROFILE, section 5."""

    DEFAULT = 0
    LAND = 1


class AlignmentMode(IntEnum):
    """ALIGNMENTMODE, section 5."""

    UNAIDED = 0
    AUTOMATIC = 3


class RelIns(IntEnum):
    """Section 2.3, INSCONFIG."""

    ROVER = 1


class Offset(IntEnum):
    """Section 2.3, INSCONFIG: what a translation or a rotation leads to."""

    ANT1 = 1
    RBV = 11


class OffsetFrame(IntEnum):
    """Section 2.3, INSCONFIG."""

    IMUBODY = 0
    VEHICLE = 1


class Source(IntEnum):
    """Section 2.3, INSCONFIG."""

    FROM_NVM = 1
    FROM_COMMAND = 4


class Bool(IntEnum):
    """A truth value as ASCII logs spell it."""

    FALSE = 0
    TRUE = 1
