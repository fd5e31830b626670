"""One answer, from any start, for any rig."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from polecal.calib import Kind, Mount, Returns, moments
from polecal.calib.blas import one_thread
from polecal.calib.certificate import certify
from polecal.calib.geometry import roll_pitch_yaw, rotation
from polecal.calib.solve import CLEARLY, Form, Scatter, cost_m, minimise, minimise_globally

STARTS, RIGS = 1000, 200
NEARLY = 1.006  # minima this near are one to the noise; of them the one near the start is taken


def seen_by(mount, rng, *, poses=120, noise_m=0.01, tilt_deg=3.0):
    """What a scanner of all bearings sees of a pole at n's origin and of level ground, at random poses."""
    yaw = rng.uniform(-np.pi, np.pi, poses)
    rpy = np.column_stack([np.radians(tilt_deg) * rng.normal(size=(poses, 2)), yaw])
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


def test_two_hundred_random_rigs_are_each_found_from_a_start_that_knows_nothing(tell):
    rng = np.random.default_rng(2)
    wrong, off_deg, proven = [], [], 0
    for number in range(RIGS):
        true = random_mount(rng)
        form = seen_by(true, rng)
        found = solved(form, Mount(0.0, 0.0, -1.0, 0.0, 0.0, 0.0))
        from_truth = solved(form, true)
        if cost_m(form, found) > NEARLY * cost_m(form, from_truth):
            wrong.append((number, cost_m(form, found), cost_m(form, from_truth)))
        off_deg.append(turned_by_deg(found, true.vector))
        proven += certify(form, found, EXTRAS_HELD).proven
    assert wrong == []
    tell(f"{proven} of {RIGS} random rigs' minima are proven to be the lowest")
    assert proven >= 0.98 * RIGS
    assert np.median(off_deg) < 0.3, "and it is the rig's own, as far as the noise lets it be told"


def test_a_false_minimum_is_never_called_the_lowest_and_no_bound_is_above_the_true_one():
    rng = np.random.default_rng(3)
    false = 0
    for noise_m, poses in [(0.01, 120)] * 20 + [(0.5, 15)] * 20:
        true = random_mount(rng)
        form = seen_by(true, rng, poses=poses, noise_m=noise_m)
        best = solved(form, true)
        for _ in range(5):
            start = np.concatenate([random_mount(rng).vector, np.zeros(6)])
            ended = minimise(form, start, EXTRAS_HELD)
            told = certify(form, ended, EXTRAS_HELD)
            higher = cost_m(form, ended) > cost_m(form, best) / CLEARLY
            false += higher
            assert not (higher and told.proven)
            assert (1 - told.lower_by) * cost_m(form, ended) <= cost_m(form, best)
    assert false > 50


def test_of_a_mount_and_its_mirror_image_over_flat_ground_each_is_the_lowest():
    rng = np.random.default_rng(4)
    form = seen_by(Mount(0.2, -0.3, -1.0, 5.0, -12.0, 30.0), rng, tilt_deg=0.0)
    held = (*EXTRAS_HELD, "z")
    one = minimise_globally(form, np.concatenate([random_mount(rng).vector, np.zeros(6)]), held)
    mirrored = rotation(one[3:6]) * np.array([[1, 1, -1], [1, 1, -1], [-1, -1, 1]])
    other = minimise(form, np.concatenate([one[:3], roll_pitch_yaw(mirrored), one[6:]]), held)
    assert turned_by_deg(one, other) > 20
    assert cost_m(form, one) == pytest.approx(cost_m(form, other), rel=1e-6)
    assert certify(form, one, held).proven
    assert certify(form, other, held).proven
    assert not certify(form, one, EXTRAS_HELD).proven, "over flat ground there is no telling z"
