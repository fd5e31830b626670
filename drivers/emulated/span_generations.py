"""What each generation of receivers has and says differently (sheet, sections 1.6, 2 to 5)."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

from polecal.drivers.emulated.span_enums import Component, ImuType, InsStatus
from polecal.drivers.emulated.span_logs import LOGS

_FOOT_M = 0.3048
_STANDARD_G_MPS2 = 9.80665

Version = tuple[Component, str, str, str, str, str, str, str]
"""Component, model, serial number, hardware, software, boot software, compile date and time."""


@dataclass(frozen=True, slots=True)
class Imu:
    """An inertial unit: its rate and its counts (section 2.3)."""

    kind: ImuType
    period_ms: int
    gyro_rad: float
    """An angle's one count."""
    accel_mps: float
    status: int
    """Of a healthy one, as captured."""


HG1700 = Imu(ImuType.HG1700_AG58, 10, 2.0**-33, 2.0**-27 * _FOOT_M, 0x00801503)
G320 = Imu(
    ImuType.EPSON_G320,
    8,
    math.radians(0.008 * 2**-16 / 125),
    0.2e-3 * _STANDARD_G_MPS2 * 2**-16 / 125,
    0xEA59FE00,
)


@dataclass(frozen=True, slots=True)
class Generation:
    """A generation of receivers."""

    digit: str
    """Its letter in `Log.of`."""
    build: int
    versions: tuple[Version, ...]
    imu: Imu
    most_logs: int
    rate_commands: frozenset[str]
    aligning: tuple[InsStatus, ...] = (InsStatus.INS_ALIGNING,)
    """Before INS_ALIGNMENT_COMPLETE."""
    status: int = 0
    """Bits of the status word that are always set."""
    status_words: int = 4
    own_overrun_bits: bool = True
    """Each COM port has its own overrun bit; else one stands for all."""
    accumulates: bool = False
    """CORRIMUDATA sums up since the log before; else it is one sample of the IMU."""
    definitions: Mapping[str, int] = field(default_factory=dict)
    """Definition CRCs that differ from the newest (section 2.4)."""

    def has(self, log: str) -> bool:
        """Whether there is such a log."""
        return self.digit in LOGS[log].of

    def definition(self, log: str) -> int:
        """Return the definition CRC of a log."""
        return self.definitions.get(log, LOGS[log].definition)


_BUILT = ("2020/Mar/12", "10:31:45")
OEM4 = Generation(
    digit="4",
    build=2177,
    versions=(
        (Component.GPSCARD, "INSRT2W", "SVA06090090", "OEM4g2-3.03-X2T", "2.312", "2.100", "2005/Dec/ 7",
         "15:14:13"),
        (Component.IMUCARD, "", "", "", "1.000  ", "", "Sep 21 2004", "16:41:00"),
        (Component.ENCLOSURE, "", "NYB06180023", "", "", "", "", ""),
    ),
    imu=HG1700,
    most_logs=30,
    rate_commands=frozenset(("COM",)),
    definitions={"BESTPOS": 0x6145, "INSPVA": 0x00EE, "INSATT": 0x5B35},
)  # fmt: skip
OEMV = replace(
    OEM4,
    build=2616,
    versions=(
        (Component.GPSCARD, "L12GRV", "DAB06210069", "OEMV3G-3.01-2T2", "3.100", "3.000", "2006/Nov/ 7",
         "07:21:53"),
        *OEM4.versions[1:],
    ),
    definitions={**OEM4.definitions, "BESTPOS": 0x7145, "INSPVA": 0x54E2},
)  # fmt: skip
OEM6 = Generation(
    digit="6",
    build=13306,
    versions=(
        (Component.GPSCARD, "D2QRPRTT0S1", "BJYA16010241V", "OEM615-2.00", "OEM060600RN0000",
         "OEM060201RB0000", "2015/Jan/28", "15:27:29"),
        (Component.IMUCARD, "HG1700_AG58", "", "", "", "", "", ""),
    ),
    imu=HG1700,
    most_logs=64,
    rate_commands=frozenset(("COM", "SERIALCONFIG")),
    definitions={"BESTPOS": 0xB1F6, "INSPVA": 0x54E2, "INSATT": 0x5B35, "INSPVAX": 0x4E14},
)  # fmt: skip
OEM7 = Generation(
    digit="7",
    build=16248,
    versions=(
        (Component.GPSCARD, "OEM719N", "BMGX15320028A", "OEM719N-1.00", "OM7MR0800RN0000",
         "OM7BR0001RB0000", *_BUILT),
        (Component.IMUCARD, "EPSON_G320", "E0001234", "1.00", "1.00", "1.00", *_BUILT),
    ),
    imu=G320,
    most_logs=80,
    rate_commands=frozenset(("SERIALCONFIG",)),
    aligning=(
        InsStatus.WAITING_INITIALPOS, InsStatus.INITIALIZING_BIASES, InsStatus.WAITING_AZIMUTH,
        InsStatus.INS_ALIGNING,
    ),
    status=1 << 25,
    status_words=5,
    own_overrun_bits=False,
    accumulates=True,
)  # fmt: skip
