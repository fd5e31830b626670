"""What cannot be calibrated from: refused with what is missing, never a number that looks right."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from polecal.calib import CalibrationError, Kind, Mount, Need, Returns, calibrate


@pytest.fixture(scope="module")
def good(rig):
    return rig.drive(noise_m=0.01, nav_m=0.012, passes=16)


def of_heading(returns: Returns, most_deg: float) -> Returns:
    return returns[np.degrees(returns.rpy_rad[:, 2]) % 360 < most_deg]


ERRORS: dict[str, tuple[Callable[[Returns], Returns], str]] = {
    "nothing": (lambda r: r[:0], "there are no returns"),
    "a single return": (lambda r: r[np.flatnonzero(r.kind == Kind.POLE)[:1]], "1 pole returns are too few"),
    "all ground": (lambda r: r[r.kind == Kind.GROUND], "0 pole returns are too few"),
    "a kind that is none": (lambda r: replace(r, kind=r.kind + np.uint8(7)), "neither pole"),
    "NaN": (lambda r: replace(r, bearing_rad=r.bearing_rad * np.nan), "bearing_rad holds"),
    "NaN in the motion": (lambda r: replace(r, velocity_mps=r.position_m * np.nan), "velocity_mps holds"),
    "infinity": (lambda r: replace(r, position_m=r.position_m + np.inf), "position_m holds"),
    "a column for a row": (lambda r: replace(r, range_m=r.range_m[:, None]), "range_m has shape"),
    "one row too few": (lambda r: replace(r, rpy_rad=r.rpy_rad[1:]), "rpy_rad has shape"),
    "a list": (lambda r: replace(r, range_m=r.range_m.tolist()), "not a NumPy array of numbers"),
    "half passes": (lambda r: replace(r, pass_id=r.pass_id + 0.5), "not a NumPy array of whole numbers"),
    "millimetres": (lambda r: replace(r, range_m=1000 * r.range_m), "range_m goes"),
    "ranges of nothing": (lambda r: replace(r, range_m=0 * r.range_m), "range_m goes from 0"),
    "degrees": (lambda r: replace(r, rpy_rad=np.degrees(r.rpy_rad)), "beyond two turns"),
    "a grid's coordinates": (lambda r: replace(r, position_m=r.position_m + 6.2e6), "no digits left"),
}
REFUSALS: dict[str, tuple[Callable[[Returns], Returns], str]] = {
    "one pass": (lambda r: r[r.pass_id == 0], "1 passes of the pole are too few"),
    "three passes": (lambda r: r[r.pass_id < 3], "3 passes of the pole are too few"),
    "all in one pass": (lambda r: replace(r, pass_id=0 * r.pass_id), "1 passes of the pole are too few"),
    "one slice": (lambda r: of_heading(r, 30), "slices 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11 have no pass"),
    "half a turn": (lambda r: of_heading(r, 180), "slices 6, 7, 8, 9, 10, 11 have no pass"),
    "every return a pass": (lambda r: replace(r[::40], pass_id=np.arange(len(r[::40]))), "too few"),
    "one pose": (
        lambda r: replace(r, position_m=0 * r.position_m + 3, rpy_rad=0 * r.rpy_rad),
        "have no pass",
    ),
    "one pose and one beam": (
        lambda r: replace(
            r,
            position_m=0 * r.position_m + 3,
            rpy_rad=0 * r.rpy_rad,
            range_m=0 * r.range_m + 3,
            bearing_rad=0 * r.bearing_rad,
        ),
        "have no pass",
    ),
    "one line, one heading": (
        lambda r: replace(r, position_m=r.position_m * [1.0, 0.0, 0.0], rpy_rad=0 * r.rpy_rad),
        "have no pass",
    ),
    "ranges at random": (
        lambda r: replace(r, range_m=np.random.default_rng(0).uniform(1, 9, len(r))),
        "is above",
    ),
    "pole and ground mixed up": (
        lambda r: replace(r, kind=np.random.default_rng(0).permutation(r.kind)),
        "is above",
    ),
    "the laser's left for its right": (lambda r: replace(r, bearing_rad=-r.bearing_rad), ""),
}


@pytest.mark.parametrize("name", ERRORS)
def test_what_is_no_cloud_is_an_error_that_names_what_is_wrong(good, rig, name):
    made, words = ERRORS[name]
    with pytest.raises(CalibrationError, match=words) as caught:
        calibrate(made(good), rig.measured)
    assert caught.value.hint


@pytest.mark.parametrize("name", REFUSALS)
def test_what_cannot_tell_the_mount_is_refused_with_what_is_missing(good, rig, name):
    made, words = REFUSALS[name]
    result = calibrate(made(good), rig.measured, pole_radius_m=0.0, need=Need(min_pole_returns=15))
    assert not result.verdict.accepted
    assert any(words in reason for reason in result.verdict.reasons), result.verdict.reasons
    assert np.isfinite(result.mount.vector).all()
    assert np.isfinite(result.covariance).all()


def test_the_same_drive_as_it_is_is_accepted(good, rig):
    result = calibrate(good, rig.measured, need=Need(min_pole_returns=15))
    assert result.verdict.accepted, result.verdict.reasons


def test_pole_returns_alone_are_enough_for_all_but_z_or_are_refused(good, rig):
    result = calibrate(good[good.kind == Kind.POLE], rig.measured, need=Need(min_pole_returns=15))
    off = np.abs(result.mount.vector - rig.true.vector)[[0, 1, 5]]
    assert (off < [0.03, 0.03, 0.01]).all() or not result.verdict.accepted


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"mount": Mount(np.nan, 0, 0, 0, 0, 0)}, "mount is not finite"),
        ({"measured_sigma": Mount(0, 0, 0, 0, 0, 0)}, "σ is not above 0"),
        ({"pole_radius_m": -0.04}, "radius cannot be -0.04"),
        ({"pole_radius_m": np.nan}, "radius cannot be nan"),
        ({"hold": ["rol"]}, "none of x, y, z, roll"),
        ({"extras": ["time"]}, "none of time_s"),
    ],
)
def test_a_question_that_makes_no_sense_is_refused(good, rig, given, words):
    with pytest.raises(CalibrationError, match=words):
        calibrate(good, **({"mount": rig.measured} | given))
