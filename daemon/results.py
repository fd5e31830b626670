"""A calibration result as the control protocol and ``calibration.yaml`` show it."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

import numpy as np
from numpy.typing import NDArray

from polecal.calib import Criteria, Kind, Mount, Need, Result, Setup
from polecal.calib.geometry import quaternion_xyzw
from polecal.calib.observability import Direction, weak_directions
from polecal.daemon.config import Config, Laser

_TOLD = 1e-3  # of the hand measurement's σ: nothing is known better, to say what is known worst

FRAME = {
    "parent": "body, x forward, y right, z down; its origin is the point whose position the navigation gives",
    "child": "sensor, x along its middle beam, y right, z down",
    "rotation": "C = Rz(yaw) Ry(pitch) Rx(roll) takes sensor to body",
    "units": "m; degrees where a name ends in _deg, else rad",
}


def setup_of(config: Config, laser: Laser) -> Setup:
    """Give what a laser's calibration starts from and is judged by."""
    sigma, most = laser.mount_sigma, config.accept.max_sigma
    return Setup(
        measured=Mount(**laser.mount.model_dump()),
        measured_sigma=Mount(*[sigma.xyz_m] * 3, *[sigma.rpy_deg] * 3),
        pole_radius_m=config.pole.radius_m,
        hold=frozenset(laser.hold),
        criteria=Criteria(
            cost_m=config.accept.cost_m,
            left_out_m=config.accept.left_out_m,
            improvement=config.accept.improvement,
            doubling=config.accept.doubling,
            mode=config.accept.mode,
            max_sigma=(
                most.xy_m,
                most.xy_m,
                most.z_m,
                *(float(np.radians(angle)) for angle in (most.roll_deg, most.pitch_deg, most.yaw_deg)),
            ),
        ),
        need=Need(**config.routine.model_dump(exclude={"max_passes"})),
    )


def entry(name: str, setup: Setup, result: Result | None) -> dict[str, Any]:
    """Give a laser's part of STATUS; before the first pass there is no result."""
    if result is None:
        coverage = [
            {"slice": index, "pole_returns": 0, "passes": 0, "done": False}
            for index in range(360 // setup.need.slice_deg)
        ]
        return {
            "name": name,
            "passes": 0,
            "coverage": coverage,
            "measured": setup.measured.as_dict(),
            "estimate": None,
            "sigma": None,
            "held": sorted(setup.hold),
            "cost_m": None,
            "measured_cost_m": None,
            "left_out_m": None,
            "lowest": None,
            "shared": None,
            "improvement": None,
            "doubling": None,
            "set_aside": [],
            "time_offset_s": 0.0,
            "extras": {},
            "verdict": {"accepted": False, "reasons": ["no pass of the pole yet"]},
        }
    return {
        "name": name,
        "passes": result.passes,
        "coverage": [asdict(part) for part in result.slices],
        "measured": setup.measured.as_dict(),
        "estimate": result.mount.as_dict(),
        "sigma": result.sigma.as_dict(),
        "held": list(result.held),
        "cost_m": result.cost_m,
        "measured_cost_m": result.measured_cost_m,
        "left_out_m": result.left_out_m,
        "lowest": None if result.certificate is None else asdict(result.certificate),
        "shared": None if result.shared is None else asdict(result.shared),
        "improvement": result.improvement,
        "doubling": result.doubling,
        "set_aside": [{"pass": number, "why": why} for number, why in result.set_aside.items()],
        "time_offset_s": result.extras.get("time_s", 0.0),
        "extras": {
            name: {"value": value, "sigma": result.extra_sigma[name]} for name, value in result.extras.items()
        },
        "verdict": {"accepted": result.verdict.accepted, "reasons": list(result.verdict.reasons)},
    }


def weakest(setup: Setup, covariance: NDArray[np.float64]) -> Direction:
    """Give the combination of unknowns that is known worst, in the hand measurement's σ: 1 is held.

    ``covariance`` is a result's, (6, 6), m and rad.
    """
    scale = setup.measured_sigma.vector
    least = np.diag((_TOLD * scale) ** 2)  # the scatter of few passes is flat in some directions
    information = np.asarray(np.linalg.inv(covariance + least), dtype=np.float64)
    return weak_directions(information, scale)[0]


def calibration(name: str, setup: Setup, result: Result, session: str, created: str) -> dict[str, Any]:
    """Give a laser's part of ``calibration.yaml``."""
    matrix = np.eye(4)
    matrix[:3, :3] = result.mount.rotation
    matrix[:3, 3] = result.mount.vector[:3]
    return entry(name, setup, result) | {
        "frame": FRAME,
        "quaternion_xyzw": quaternion_xyzw(result.mount.rotation).tolist(),
        "matrix": matrix.tolist(),
        "covariance": result.covariance.tolist(),
        "returns": {kind.name.lower(): result.returns[kind] for kind in Kind},
        "session": session,
        "created": created,
    }
