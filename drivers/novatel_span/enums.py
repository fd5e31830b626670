"""Numbers of the NovAtel protocol as names (sheet sections 3 and 5)."""

from __future__ import annotations

from enum import IntEnum
from functools import cache
from typing import Any, TypeVar

E = TypeVar("E", bound=IntEnum)

NAMELESS = -1
"""Stands for a word in an ASCII log that the sheet does not have; never a value on the wire."""


def named(kind: type[E], value: int) -> E | int:
    """Return the member of ``kind`` with that value, or the number itself where the sheet has no name."""
    member: E | int = _members(kind).get(value, value)
    return member


@cache
def _members(kind: type[IntEnum]) -> dict[int, Any]:
    return {int(member): member for member in kind}


class MessageId(IntEnum):
    """Message ids of logs and commands (sheet section 2)."""

    LOG = 1
    INTERFACEMODE = 3
    UNLOG = 36
    VERSION = 37
    UNLOGALL = 38
    BESTPOS = 42
    RANGE = 43
    PSRPOS = 47
    SATVIS = 48
    ECUTOFF = 50
    TRACKSTAT = 83
    RXSTATUS = 93
    RXSTATUSEVENT = 94
    BESTVEL = 99
    TIME = 101
    RTKPOS = 141
    PSRDOP = 174
    VALIDMODELS = 206
    MARKTIME = 231
    BESTXYZ = 241
    INSATT = 263
    INSCOV = 264
    INSPOS = 265
    INSSPD = 266
    INSVEL = 267
    RAWIMU = 268
    INSATTS = 319
    INSCOVS = 320
    INSPOSS = 321
    INSSPDS = 323
    INSVELS = 324
    RAWIMUS = 325
    BESTGPSPOS = 423
    TIMESYNC = 492
    INSPVA = 507
    INSPVAS = 508
    MARK2TIME = 616
    VEHICLEBODYROTATION = 642
    BESTUTM = 726
    CORRIMUDATA = 812
    CORRIMUDATAS = 813
    MARK1PVA = 1067
    MARK3TIME = 1075
    MARK4TIME = 1076
    MARK1TIME = 1130
    WAASECUTOFF = 505
    PSRDOP2 = 1163
    SERIALCONFIG = 1246
    IMURATEPVAS = 1305
    HEADING2 = 1335
    IMURATECORRIMUS = 1362
    BESTGNSSPOS = 1429
    INSATTX = 1457
    INSVELX = 1458
    INSPOSX = 1459
    RAWIMUX = 1461
    RAWIMUSX = 1462
    INSPVAX = 1465
    PPPPOS = 1538
    IMURATEPVA = 1778
    INSCONFIG = 1945
    INSSTDEV = 2051
    INSSTDEVS = 2052
    CORRIMUS = 2264


class InsStatus(IntEnum):
    """State of the inertial solution (sheet 3.1). Only INS_SOLUTION_GOOD may be used for calibration."""

    INS_INACTIVE = 0
    INS_ALIGNING = 1
    INS_HIGH_VARIANCE = 2
    INS_SOLUTION_NOT_GOOD = 2  # older firmware's word for it
    INS_SOLUTION_GOOD = 3
    TEST_ALIGNING = 4
    TEST_SOLUTION_GOOD = 5
    INS_SOLUTION_FREE = 6
    INS_BAD_GPS_AGREEMENT = 6  # older firmware's
    INS_ALIGNMENT_COMPLETE = 7
    DETERMINING_ORIENTATION = 8
    WAITING_INITIALPOS = 9
    WAITING_AZIMUTH = 10
    INITIALIZING_BIASES = 11
    MOTION_DETECT = 12
    TIMEOUT = 13
    WAITING_ALIGNMENTORIENTATION = 14

    @property
    def meaning(self) -> str:
        """What it means for calibration, and what ends it, in an operator's words."""
        return _INS_STATUS_MEANING[self]


_INS_STATUS_MEANING = {
    InsStatus.INS_INACTIVE: "the filter is off or hears no IMU: check the IMU's cable, power and type",
    InsStatus.INS_ALIGNING: "coarse alignment, the pose is a placeholder: drive straight at 5 m/s or more",
    InsStatus.INS_HIGH_VARIANCE: "the azimuth is too uncertain: drive turns and accelerate",
    InsStatus.INS_SOLUTION_GOOD: "the solution can be used",
    InsStatus.TEST_ALIGNING: "a factory test mode",
    InsStatus.TEST_SOLUTION_GOOD: "a factory test mode",
    InsStatus.INS_SOLUTION_FREE: "satellites disagree with the IMU and are left out: drive into the open",
    InsStatus.INS_ALIGNMENT_COMPLETE: "aligned, but not refined yet: drive turns and accelerate",
    InsStatus.DETERMINING_ORIENTATION: "finding which axis of the IMU is up: stand still",
    InsStatus.WAITING_INITIALPOS: "no satellite position yet: check the antenna, wait in the open",
    InsStatus.WAITING_AZIMUTH: "levelled, without a heading: drive straight, or give it an azimuth",
    InsStatus.INITIALIZING_BIASES: "estimating biases: stand still",
    InsStatus.MOTION_DETECT: "waiting until the vehicle is still",
    InsStatus.TIMEOUT: "no satellites for too long: drive into the open",
    InsStatus.WAITING_ALIGNMENTORIENTATION: "waiting for an orientation to align to",
}


class PositionType(IntEnum):
    """Position or velocity type (sheet 3.3)."""

    NONE = 0
    FIXEDPOS = 1
    FIXEDHEIGHT = 2
    DOPPLER_VELOCITY = 8
    SINGLE = 16
    PSRDIFF = 17
    WAAS = 18
    PROPAGATED = 19
    OMNISTAR = 20
    L1_FLOAT = 32
    IONOFREE_FLOAT = 33
    NARROW_FLOAT = 34
    L1_INT = 48
    WIDE_INT = 49
    NARROW_INT = 50
    RTK_DIRECT_INS = 51
    INS_SBAS = 52
    INS_PSRSP = 53
    INS_PSRDIFF = 54
    INS_RTKFLOAT = 55
    INS_RTKFIXED = 56
    INS_OMNISTAR = 57
    INS_OMNISTAR_HP = 58
    INS_OMNISTAR_XP = 59
    OMNISTAR_HP = 64
    OMNISTAR_XP = 65
    PPP_CONVERGING = 68
    PPP = 69
    OPERATIONAL = 70
    WARNING = 71
    OUT_OF_BOUNDS = 72
    INS_PPP_CONVERGING = 73
    INS_PPP = 74
    PPP_BASIC_CONVERGING = 77
    PPP_BASIC = 78
    INS_PPP_BASIC_CONVERGING = 79
    INS_PPP_BASIC = 80


class SolutionStatus(IntEnum):
    """Status of a satellite solution (sheet 3.3); never to be read as an INS status."""

    SOL_COMPUTED = 0
    INSUFFICIENT_OBS = 1
    NO_CONVERGENCE = 2
    SINGULARITY = 3
    COV_TRACE = 4
    TEST_DIST = 5
    COLD_START = 6
    V_H_LIMIT = 7
    VARIANCE = 8
    RESIDUALS = 9
    INTEGRITY_WARNING = 13
    INS_INACTIVE = 14
    INS_ALIGNING = 15
    INS_BAD = 16
    IMU_UNPLUGGED = 17
    PENDING = 18
    INVALID_FIX = 19
    UNAUTHORIZED = 20
    ANTENNA_WARNING = 21
    INVALID_RATE = 22
    INS_AIDED = 23


class TimeStatus(IntEnum):
    """Quality of the receiver's time (sheet 3.4)."""

    UNKNOWN = 20
    APPROXIMATEADJUSTING = 40
    APPROXIMATE = 60
    COARSEADJUSTING = 80
    COARSE = 100
    COARSESTEERING = 120
    FREEWHEELING = 130
    FINEADJUSTING = 140
    FINE = 160
    FINEBACKUPSTEERING = 170
    FINESTEERING = 180
    SATTIME = 200
    EXTERNAL = 220
    EXACT = 240


FINE_TIME = frozenset({TimeStatus.FINE, TimeStatus.FINEBACKUPSTEERING, TimeStatus.FINESTEERING})
"""The statuses at which a header's time may be mapped to the host's clock (sheet 3.4)."""


class ClockStatus(IntEnum):
    """State of the receiver's clock model (sheet 3.4)."""

    VALID = 0
    CONVERGING = 1
    ITERATING = 2
    INVALID = 3
    ERROR = 4


class UtcStatus(IntEnum):
    """Whether UTC fields may be used (TIME, sheet 2.2)."""

    INVALID = 0
    VALID = 1
    WARNING = 2


class Datum(IntEnum):
    """Datum of a position (BESTPOS, sheet 2.2)."""

    WGS84 = 61


class Component(IntEnum):
    """Parts that VERSION lists (sheet 2.2, and the makers' message table)."""

    UNKNOWN = 0
    GPSCARD = 1
    CONTROLLER = 2
    ENCLOSURE = 3
    IBOARD = 4
    L5_FPGA = 5
    IMUCARD = 7
    USERINFO = 8
    OEM6FPGA = 12
    GPSCARD2 = 13
    BLUETOOTH = 14
    WIFI = 15
    CELLULAR = 16
    EXTENSION = 17
    RADIO = 18
    WWW_CONTENT = 19
    REGULATORY = 20
    OEM7FPGA = 21
    APPLICATION = 22
    PACKAGE = 23
    DEFAULT_CONFIG = 25
    WHEELSENSOR = 26
    EMBEDDED_AUTH = 27


class Trigger(IntEnum):
    """When a log is sent (sheet section 5)."""

    ONNEW = 0
    ONCHANGED = 1
    ONTIME = 2
    ONNEXT = 3
    ONCE = 4
    ONMARK = 5
    ONALL = 6


class PortId(IntEnum):
    """32-bit port ids in message bodies; headers carry the low byte (sheet 3.6)."""

    COM1 = 0x20
    COM2 = 0x40
    COM3 = 0x60
    THISPORT = 0xC0


class ImuType(IntEnum):
    """IMU types of INSCONFIG and RAWIMUX that SPAN receivers are sold with (makers' message table)."""

    UNKNOWN = 0
    HG1700_AG11 = 1
    HG1700_AG17 = 4
    HG1900_CA29 = 5
    LN200 = 8
    LN200_400HZ = 9
    HG1700_AG58 = 11
    HG1700_AG62 = 12
    IMAR_FSAS = 13
    KVH_COTS = 16
    LITEF_LCI1 = 19
    HG1930_AA99 = 20
    ISA100C = 26
    HG1900_CA50 = 27
    HG1930_CA50 = 28
    ADIS16488 = 31
    STIM300 = 32
    KVH_1750 = 33
    ISA100 = 34
    ISA100_400HZ = 38
    ISA100C_400HZ = 39
    EPSON_G320 = 41
    KVH_1725 = 45
    KVH_1775 = 46
    LITEF_MICROIMU = 52
    STIM300D = 56
    HG4930_AN01 = 58
    EPSON_G370 = 61
    EPSON_G320_200HZ = 62
    HG4930_AN04 = 68
    HG4930_AN04_400HZ = 69


class InsProfile(IntEnum):
    """How the vehicle moves, as the receiver was told (SETINSPROFILE)."""

    DEFAULT = 0
    LAND = 1
    MARINE = 2
    FIXEDWING = 3
    FOOT = 4
    VTOL = 5
    RAIL = 6
    AGRICULTURE = 7
    LAND_PLUS = 33
    MARINE_PLUS = 34


class AlignmentMode(IntEnum):
    """How the receiver aligns (sheet section 5)."""

    UNAIDED = 0
    AIDED_STATIC = 1
    AIDED_TRANSFER = 2
    AUTOMATIC = 3
    STATIC = 4
    KINEMATIC = 5


class RelativeOutput(IntEnum):
    """The frame of relative INS output (INSCONFIG)."""

    INVALID = 0
    ROVER = 1
    MASTER = 2
    ECEF = 3
    LOCALLEVEL = 4


class Switch(IntEnum):
    """A yes or no."""

    FALSE = 0
    TRUE = 1


class InsOffset(IntEnum):
    """What a translation or rotation of INSCONFIG leads to (SETINSTRANSLATION, SETINSROTATION)."""

    INVALID = 0
    ANT1 = 1
    ANT2 = 2
    EXTERNAL = 3
    USER = 4
    MARK1 = 5
    MARK2 = 6
    GIMBAL = 7
    ALIGN = 8
    MARK3 = 9
    MARK4 = 10
    RBV = 11
    RBM = 12


class OffsetFrame(IntEnum):
    """The frame that an INSCONFIG item is given in."""

    IMUBODY = 0
    VEHICLE = 1
    UNKNOWN = 2


class OffsetSource(IntEnum):
    """Where an INSCONFIG item came from."""

    NONE = 0
    FROM_NVM = 1
    CALIBRATING = 2
    CALIBRATED = 3
    FROM_COMMAND = 4
    RESET = 5
    FROM_DUAL_ANT = 6
    INS_CONVERGING = 7
    INSUFFICIENT_SPEED = 8
    HIGH_ROTATION = 9


class StatusWord(IntEnum):
    """Which word of the receiver's status an event is about (RXSTATUSEVENT)."""

    ERROR = 0
    STATUS = 1
    AUX1 = 2
    AUX2 = 3
    AUX3 = 4
    AUX4 = 5


class StatusEvent(IntEnum):
    """What happened to a bit of a status word (RXSTATUSEVENT)."""

    CLEAR = 0
    SET = 1
