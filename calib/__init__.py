"""Arrays in, arrays out: the pose of a range sensor from a pole and the ground it stands on."""

from polecal.calib.acceptance import Criteria, Verdict
from polecal.calib.coverage import Need, Slice
from polecal.calib.estimate import Pass, Result, Setup, calibrate, estimate
from polecal.calib.observations import (
    KEYS,
    PARAMETERS,
    CalibrationError,
    Kind,
    Mount,
    Returns,
    cost,
    points_nav,
)
from polecal.calib.residuals import Residual, residuals

__all__ = [
    "KEYS",
    "PARAMETERS",
    "CalibrationError",
    "Criteria",
    "Kind",
    "Mount",
    "Need",
    "Pass",
    "Residual",
    "Result",
    "Returns",
    "Setup",
    "Slice",
    "Verdict",
    "calibrate",
    "cost",
    "estimate",
    "points_nav",
    "residuals",
]
