"""Arrays that a vehicle driving past a pole would give."""

import numpy as np
import pytest

from polecal.calib import Kind, Mount, Returns
from polecal.calib.geometry import rotation

TRUE = Mount(-0.029, -0.360, -0.996, -0.528, -8.182, -2.017)
MEASURED = Mount(0.0, -0.35, -1.0, 0.0, -8.0, 0.0)


def drive(
    *,
    mount: Mount = TRUE,
    passes: int = 24,
    tilt_deg: float = 2.0,
    noise_m: float = 0.0,
    nav_m: float = 0.0,
    radius_m: float = 0.0,
    seed: int = 0,
) -> Returns:
    """Straight passes at even headings, pole 1.2 m aside; ground level at z = 0, body at z = 0 ± 3 cm."""
    rng = np.random.default_rng(seed)
    csb, rb = mount.rotation, mount.vector[:3]
    parts = []
    for number in range(passes):
        yaw = 2 * np.pi * (number + 0.5) / passes
        along = np.linspace(-7.0, -1.5, 60)
        tilt = np.radians(tilt_deg) * np.stack([np.sin(along + number), np.cos(1.3 * along + 2 * number)], 1)
        rpy = np.column_stack([tilt, np.full(60, yaw) + 0.05 * np.sin(along)])
        heading = np.array([np.cos(yaw), np.sin(yaw)])
        side = np.array([-heading[1], heading[0]]) * 1.2 * (-1) ** number
        xy = along[:, None] * heading + side
        position = np.column_stack([xy, 0.03 * np.sin(along)])
        c = rotation(rpy)
        for kind in Kind:
            bearing = np.radians(np.linspace(48, -48, 40 if kind is Kind.GROUND else 2881))
            direction = np.stack([np.cos(bearing), np.sin(bearing), 0 * bearing], -1) @ csb.T
            ray = np.einsum("pij,bj->pbi", c, direction)
            origin = position + np.einsum("pij,j->pi", c, rb)
            if kind is Kind.GROUND:
                r = -origin[:, None, 2] / np.where(ray[..., 2] > 1e-3, ray[..., 2], -1.0)
                hit = (r > 0) & (r < 30)
            else:
                u = ray[..., :2] / np.linalg.norm(ray[..., :2], axis=-1, keepdims=True)
                to_pole = -origin[:, None, :2]
                closest = (u * to_pole).sum(-1)
                miss = u[..., 0] * to_pole[..., 1] - u[..., 1] * to_pole[..., 0]
                hit = (np.abs(miss) < max(radius_m, 1e-3)) & (closest > 0)
                chord = np.sqrt(np.maximum(radius_m**2 - miss**2, 0.0))
                r = (closest - chord) / np.linalg.norm(ray[..., :2], axis=-1)
            at, beam = np.nonzero(hit)
            if kind is Kind.POLE and radius_m:  # a beam in eight hits: the fan is finer than the laser's
                keep = rng.random(len(at)) < 0.2
                at, beam = at[keep], beam[keep]
            n = len(at)
            parts.append(
                Returns(
                    r[at, beam] + noise_m * rng.normal(size=n),
                    bearing[beam],
                    position[at] + nav_m * rng.normal(size=3),
                    rpy[at],
                    np.full(n, kind, np.uint8),
                    np.full(n, number, np.int64),
                )
            )
    names = ("range_m", "bearing_rad", "position_m", "rpy_rad", "kind", "pass_id")
    return Returns(*(np.concatenate([getattr(part, name) for part in parts]) for name in names))


class Rig:
    """The simulated rig: `TRUE` is what `drive` was simulated with, unless it is told otherwise."""

    true = TRUE
    measured = MEASURED
    drive = staticmethod(drive)


@pytest.fixture(scope="session")
def rig() -> Rig:
    """Give the simulated rig."""
    return Rig()
