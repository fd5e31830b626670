"""A pass's returns to what an operator wants to know of it: when, which way, how fast, how near."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import UTC, datetime, timedelta

import numpy as np
from numpy.typing import NDArray

from polecal.calib import Kind, Returns
from polecal.calib.geometry import rotation

_GPS_EPOCH = datetime(1980, 1, 6, tzinfo=UTC)
_SLOW_MPS, _STILL_RADPS = 0.1, 0.02  # what is slower stands; unless it turns
_MOSTLY = 0.9  # of the returns, for one direction


@dataclass(frozen=True, slots=True)
class Facts:
    """What is known of a pass beside its moments; of the pole's returns, where they are of a kind."""

    gps_ns: tuple[int, int]
    """GPS time of its first and last return."""
    heading_deg: float
    """Platform yaw, mean, 0 to 360."""
    span_deg: float
    """How much of platform yaw it swept."""
    speed_mps: float
    """Mean, along the body's x: negative in reverse."""
    direction: str
    """forward, reverse, both, turning (on the spot) or standing."""
    nearest_m: float
    mean_m: float
    """Range of the pole."""


def of(returns: Returns, gps_ns: NDArray[np.int64]) -> Facts:
    """Sum up a pass's returns and their GPS times (N,)."""
    pole = returns[returns.kind == Kind.POLE]
    yaw_deg = np.degrees(pole.rpy_rad[:, 2])  # goes on past 360 within a pass
    speed_mps, direction = _motion(pole)
    return Facts(
        gps_ns=(int(gps_ns.min()), int(gps_ns.max())),
        heading_deg=float(yaw_deg.mean() % 360.0),
        span_deg=float(np.ptp(yaw_deg)),
        speed_mps=speed_mps,
        direction=direction,
        nearest_m=float(pole.range_m.min()),
        mean_m=float(pole.range_m.mean()),
    )


def _motion(pole: Returns) -> tuple[float, str]:
    if pole.motion is None:
        return 0.0, "unknown"
    velocity, rate, *_ = pole.motion
    ahead = np.einsum("ni,ni->n", velocity, rotation(pole.rpy_rad)[:, :, 0])
    if np.linalg.norm(velocity, axis=1).mean() < _SLOW_MPS:
        turns = np.linalg.norm(rate, axis=1).mean() >= _STILL_RADPS
        return float(ahead.mean()), "turning" if turns else "standing"
    forward = float((ahead > 0).mean())
    direction = "forward" if forward >= _MOSTLY else "reverse" if forward <= 1 - _MOSTLY else "both"
    return float(ahead.mean()), direction


def utc(gps_ns: int, utc_offset_s: float) -> str:
    """Give a GPS time as UTC, ISO 8601 to the tenth of a second."""
    moment = _GPS_EPOCH + timedelta(microseconds=gps_ns // 1000, seconds=utc_offset_s)
    return f"{moment:%Y-%m-%dT%H:%M:%S}.{moment.microsecond // 100_000}Z"
