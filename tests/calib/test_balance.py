"""What the ground counts against the pole: what its returns are worth, not how many they are."""

from dataclasses import replace

import numpy as np
import pytest

from polecal.calib import Criteria, Kind, Mount, Setup, estimate
from polecal.calib.estimate import passes_of
from polecal.calib.report.rig import Rig, drive

SEEDS = 20
SETUP = Setup(
    Mount(0.0, -0.35, -1.0, 0.0, -8.0, 0.0),
    pole_radius_m=0.04,
    extras=frozenset(),
    criteria=Criteria(max_sigma=(1.0,) * 6),  # so that z is not held
)
EXACT = {"position_sigma_m": (0.0, 0.0, 0.0), "rpy_sigma_deg": (0.0, 0.0, 0.0)}
TILTED = {"rpy_sigma_deg": (0.05, 0.05, 0.1)}


def drives(rig, **of_rig):
    rigs = Rig(rig.true, passes=12, speeds_mps=(1.5, 2.5, -1.0), **of_rig)
    return [passes_of(drive(rigs, np.random.default_rng(seed), 1800, 18000), 30) for seed in range(SEEDS)]


def balance_of(result):
    return result.weights.balance(result.returns[Kind.POLE], result.returns[Kind.GROUND])


def test_ground_counts_as_in_eq7_unless_kinds_are_to_count_by_themselves(rig):
    passes = drives(rig)[0]
    assert balance_of(estimate(passes, replace(SETUP, by_kind=False))) == 1.0
    assert balance_of(estimate(passes, replace(SETUP, pass_error=False))) == 1.0


def test_ground_counts_by_its_returns_where_each_is_independent_and_less_where_they_are_not(rig, tell):
    independent, tilted = (
        np.median([balance_of(estimate(passes, SETUP)) for passes in drives(rig, **of_rig)])
        for of_rig in (EXACT, TILTED)
    )
    tell(
        f"the ground counts {independent:.0f} times as in Eq. 7; with 0.05° of tilt a pass {tilted:.1f} times"
    )
    assert independent > 15
    assert tilted < independent / 3


def test_where_the_vehicles_tilt_is_badly_known_the_ground_does_no_harm(rig):
    """By its returns, as if they were independent, it would make x and y twice as bad."""
    as_eq7 = replace(SETUP, by_kind=False)
    errors = []
    for passes in drives(rig, **TILTED):
        results = [estimate(passes, setup) for setup in (as_eq7, SETUP)]
        errors.append([result.mount.vector - rig.true.vector for result in results])
    without, with_it = np.sqrt((np.array(errors) ** 2).mean(axis=0))
    assert (with_it < 1.15 * without).all()
    assert np.linalg.norm(with_it[:2]) < 1.05 * np.linalg.norm(without[:2])


def test_a_mount_that_is_all_held_needs_no_balance(rig):
    passes = drives(rig)[0]
    held = replace(SETUP, hold=frozenset({"x", "y", "z", "roll", "pitch", "yaw"}))
    assert estimate(passes, held).mount.vector == pytest.approx(SETUP.measured.vector)
