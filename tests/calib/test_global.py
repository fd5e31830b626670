"""One answer, from any start, for any rig."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from polecal.calib import Kind, Mount, Returns, moments
from polecal.calib.blas import one_thread
from polecal.calib.geometry import roll_pitch_yaw, rotation
from polecal.calib.solve import Form, Scatter, cost_m, minimise_globally

STARTS, RIGS = 1000, 200
NEARLY = 1.006  # minima this near are one to the noise; of them the one near the start is taken


def seen_by(mount, rng, *, poses=120, noise_m=0.01):
    """What a scanner of all bearings sees of a pole at n's origin and of level ground, at random poses."""
    yaw = rng.uniform(-np.pi, np.pi, poses)
    rpy = np.column_stack([np.radians(3) * rng.normal(size=(poses, 2)), yaw])
    distance = rng.uniform(2.0, 8.0, poses)
    around = rng.uniform(-np.pi, np.pi, poses)
    position = np.column_stack([distance * np.cos(around), distance * np.sin(around), np.zeros(poses)])
    c = rotation(rpy)
    csn = c @ mount.rotation  # sensor to n
    origin = position + np.einsum("nij,j->ni", c, mount.vector[:3])
    normal = csn[:, :, 2]  # of the scan plane, in n
    # The pole meets the plane at one height; of the ground, the plane meets a line.
    height = (np.einsum("ni,ni->n", normal[:, :2], origin[:, :2])) / normal[:, 2] + origin[:, 2]
    pole = np.column_stack([np.zeros((poses, 2)), height])
    along = np.cross(normal, [0.0, 0.0, 1.0])
    across = np.cross(along, normal)
    foot = origin - across * (origin[:, 2:] / across[:, 2:])
    ground = foot + along * rng.uniform(-4, 4, poses)[:, None]
    parts = []
    for kind, points in ((Kind.POLE, pole), (Kind.GROUND, ground)):
        local = np.einsum("nji,nj->ni", csn, points - origin)
        ranges = np.hypot(local[:, 0], local[:, 1])
        near = (ranges < 30) & (np.abs(points[:, 2]) < 3)
        bearing = np.arctan2(local[:, 1], local[:, 0])
        n = int(near.sum())
        noisy = ranges[near] + noise_m * rng.normal(size=n)
        parts.append(
            moments.of(
                Returns(noisy, bearing[near], position[near], rpy[near], np.full(n, kind), np.zeros(n, int))
            )
        )
    every = np.array([True])
    return Form(*(Scatter([part]).form(every) for part in parts))


def random_mount(rng):
    roll, pitch, yaw = np.degrees(roll_pitch_yaw(Rotation.random(random_state=rng).as_matrix()))
    return Mount(*rng.uniform(-1, 1, 2), rng.uniform(-2, -0.5), roll, pitch, yaw)


EXTRAS_HELD = ("time_s", "range_m", "lean_north", "lean_east", "slope_north", "slope_east")


def turned_by_deg(one, other):
    return np.degrees(
        np.linalg.norm(Rotation.from_matrix(rotation(one[3:6]).T @ rotation(other[3:6])).as_rotvec())
    )


@one_thread
def solved(form, start):
    return minimise_globally(form, np.concatenate([start.vector, np.zeros(6)]), EXTRAS_HELD)


def test_a_thousand_random_starts_give_one_answer():
    rng = np.random.default_rng(1)
    true = Mount(-0.029, -0.36, -0.996, -0.528, -8.182, -2.017)
    form = seen_by(true, rng)
    best = solved(form, true)
    for _ in range(STARTS):
        found = solved(form, random_mount(rng))
        assert cost_m(form, found) == pytest.approx(cost_m(form, best), rel=1e-6)
        assert turned_by_deg(found, best) < 1e-3


def test_two_hundred_random_rigs_are_each_found_from_a_start_that_knows_nothing():
    rng = np.random.default_rng(2)
    wrong, off_deg = [], []
    for number in range(RIGS):
        true = random_mount(rng)
        form = seen_by(true, rng)
        found = solved(form, Mount(0.0, 0.0, -1.0, 0.0, 0.0, 0.0))
        from_truth = solved(form, true)
        if cost_m(form, found) > NEARLY * cost_m(form, from_truth):
            wrong.append((number, cost_m(form, found), cost_m(form, from_truth)))
        off_deg.append(turned_by_deg(found, true.vector))
    assert wrong == []
    assert np.median(off_deg) < 0.3, "and it is the rig's own, as far as the noise lets it be told"
