from dataclasses import replace

import numpy as np
import pytest

from polecal.calib import PARAMETERS, Criteria, Mount, Need, Setup, Verdict, estimate
from polecal.calib.estimate import passes_of
from polecal.calib.geometry import roll_pitch_yaw, rotation, skew
from polecal.calib.report.rig import Rig, drives
from polecal.calib.shared import Witness, _as_moved, share

FRONT, BESIDE = Mount(-0.029, -0.36, -0.996, -0.5, -8.2, -2.0), Mount(0.1, 0.4, -0.9, 0.7, -7.0, 1.5)
PASSES, EVERY, RUNS = 36, 3, 12
RIG = Rig(FRONT, passes=PASSES, speeds_mps=(1.5, 2.5, -1.0))
EASY = Criteria(1.0, 1.0, 9.0, 9.0, "all", (1.0,) * 6, 99.0)
SCALE = np.array([1e3, 1e3, 1e3, *np.degrees([1, 1, 1])])


def witness(name, returns, mount, *, of=lambda number: True, apart_ns=0, hold=(), measured=None):
    passes = [one for one in passes_of(returns, 30) if of(one.id)]
    setup = Setup(
        measured or mount,
        pole_radius_m=0.04,
        by_kind=False,
        extras=frozenset(),
        hold=frozenset(hold),
        criteria=EASY,
        need=Need(30, 0, 0, 0),
    )
    spans = [(one.id * 10**11 + apart_ns, one.id * 10**11 + apart_ns + 10**10) for one in passes]
    return Witness(name, passes, spans, setup, estimate(passes, setup))


def one_in_three(number):
    return 7 * number % PASSES < PASSES // EVERY


@pytest.fixture(scope="module")
def driven():
    """Both lasers' returns in each of some drives."""
    return [drives(RIG, (FRONT, BESIDE), seed, 150 * PASSES, 300 * PASSES) for seed in range(RUNS)]


@pytest.fixture(scope="module")
def pairs(driven):
    """The first of all passes, the second of one in three."""
    return [
        (witness("front", one, FRONT), witness("second", other, BESIDE, of=one_in_three))
        for one, other in driven
    ]


def test_a_laser_that_saw_a_third_of_the_passes_is_nearer_to_the_truth_with_one_that_saw_all(pairs, tell):
    errors = []
    for front, second in pairs:
        helped = share((front, second)).get("second", second.result)
        moved = _as_moved(FRONT.vector, BESIDE.vector) @ (front.result.mount.vector - FRONT.vector)
        off = [of.mount.vector - BESIDE.vector for of in (second.result, helped)]
        sigma = np.sqrt(np.diag(helped.covariance))
        errors.append([*off, *(of - moved for of in off), sigma])
    alone, shared, apart, together, claimed = np.sqrt((np.array(errors) ** 2).mean(axis=0)) * SCALE
    for index, name in enumerate(PARAMETERS):
        tell(
            f"{name}: alone {alone[index]:.2g}, shared {shared[index]:.2g}, claimed {claimed[index]:.2g}; on "
            f"the other laser {apart[index]:.2g}, {together[index]:.2g}; in mm or °"
        )
    free = [0, 1, 3, 4]  # z and yaw have more errors of each laser's own
    assert np.log(shared / alone)[free].mean() < np.log(0.9)
    assert np.log(together / apart)[free].mean() < np.log(0.85)
    assert (shared < 1.1 * alone).all()
    assert (shared[[0, 1, 3]] < 1.5 * claimed[[0, 1, 3]]).all(), "and σ, which is less, is honest"


def test_what_is_told_of_it_is_so(pairs):
    front, second = pairs[0]
    found = share((front, second))
    assert list(found) == ["second"], "who saw all has nothing to learn from who saw some of it"
    result, alone = found["second"], second.result
    assert (result.shared.laser, result.shared.passes) == ("front", PASSES // EVERY)
    for index, name in enumerate(PARAMETERS):
        sigma, before = (np.sqrt(of.covariance[index, index]) for of in (result, alone))
        ratio = result.shared.sigma_ratio.get(name, 1.0)
        assert sigma / before == pytest.approx(ratio, rel=0.05)
        assert (ratio == 1.0) == (result.mount.vector[index] == alone.mount.vector[index])
    assert np.linalg.eigvalsh(result.covariance).min() > 0
    assert result.sigma.vector == pytest.approx(np.sqrt(np.diag(result.covariance)))
    assert alone.cost_m <= result.cost_m < 1.01 * alone.cost_m
    assert (result.verdict, result.left_out) == (alone.verdict, alone.left_out)


def test_lasers_that_saw_the_same_passes_have_nothing_to_tell_one_another(driven):
    one, other = driven[0]
    assert share((witness("front", one, FRONT), witness("second", other, BESIDE))) == {}


def test_passes_of_other_errors_or_of_another_time_are_not_taken_for_common(driven, pairs):
    strangers = [
        (pairs[(number + 1) % RUNS][0], second) for number, (_, second) in enumerate(pairs)
    ]  # another drive's
    helped = [
        name for pair in strangers for result in share(pair).values() for name in result.shared.sigma_ratio
    ]
    assert len(helped) <= 0.05 * len(strangers) * len(PARAMETERS)
    one, other = driven[0]
    front = witness("front", one, FRONT)
    for apart_s, shared in ((12, True), (16, False), (-16, False)):  # passes are of 10 s
        late = witness("second", other, BESIDE, of=one_in_three, apart_ns=apart_s * 10**9)
        assert bool(share((front, late))) == shared
    few = witness("second", other, BESIDE, of=lambda number: number < 7)
    assert share((front, few)) == {}


def test_where_a_laser_is_wrong_does_not_reach_the_other(driven, pairs):
    """Held 15 cm from where it is, and never found out."""
    for (one, _), (front, second) in zip(driven[:4], pairs[:4], strict=True):
        off = replace(FRONT, x_m=FRONT.x_m + 0.15)
        wrong = witness("front", one, FRONT, hold=("x",), measured=off)
        right, with_wrong = (share((of, second)).get("second", second.result) for of in (front, wrong))
        assert np.abs(wrong.result.mount.vector - FRONT.vector)[0] == pytest.approx(0.15)
        sigma = np.sqrt(np.diag(second.result.covariance))
        assert (np.abs(with_wrong.mount.vector - right.mount.vector) < 2.0 * sigma).all()
        assert (np.abs(with_wrong.mount.vector - BESIDE.vector) < 4.0 * sigma).all()


def test_a_laser_that_was_knocked_during_the_drive_does_not_pull_the_other(driven, tell):
    """By little, so that it is not found out, and the other saw only what was after."""
    worst = 0.0
    for one, other in driven[:6]:
        second = witness("second", other, BESIDE, of=lambda number: number >= PASSES // 2)
        sigma = np.sqrt(np.diag(second.result.covariance))
        for knocked_m in (0.005, 0.01, 0.02, 0.1):
            c = rotation(one.rpy_rad)
            moved = (
                one.position_m - c[:, :, 0] * np.where(one.pass_id >= PASSES // 2, knocked_m, 0.0)[:, None]
            )
            front = witness("front", replace(one, position_m=moved), FRONT)
            front = replace(front, result=replace(front.result, verdict=Verdict(True, ())))
            result = share((front, second)).get("second", second.result)
            pulled = np.abs(result.mount.vector - second.result.mount.vector) / sigma
            worst = max(worst, float(pulled.max()))
    tell(f"a laser knocked by 5 mm to 10 cm pulls the other by {worst:.1f} of its own σ at most")
    assert worst < 3.0


@pytest.mark.parametrize("late_s", [0.01, 0.05])
def test_a_laser_whose_stamps_are_late_does_not_pull_one_that_saw_the_fast_passes_alone(driven, late_s):
    """What a late stamp adds to its x in those passes is no error of the navigation's."""
    for one, other in driven[:3]:
        late = replace(one, position_m=one.position_m - late_s * one.velocity_mps)
        front = witness("front", late, FRONT)
        front = replace(front, result=replace(front.result, verdict=Verdict(True, ())))
        second = witness("second", other, BESIDE, of=lambda number: number % 3 == 1)
        sigma = np.sqrt(np.diag(second.result.covariance))
        result = share((front, second)).get("second", second.result)
        assert (np.abs(result.mount.vector - second.result.mount.vector) < 2.0 * sigma).all()


def test_who_is_not_accepted_neither_gives_nor_takes(pairs):
    front, second = pairs[0]
    refused = Verdict(False, ("the pole fell over",))
    for pair in (
        (replace(front, result=replace(front.result, verdict=refused)), second),
        (front, replace(second, result=replace(second.result, verdict=refused))),
        (front, replace(second, result=replace(second.result, left_out={}))),
        (front,),
    ):
        assert share(pair) == {}


def test_the_better_of_two_helpers_is_taken(driven, pairs):
    front, second = pairs[0]
    some = witness("some", driven[0][0], FRONT, of=lambda number: one_in_three(number) or number < 8)
    both = share((some, front, second))["second"]
    assert both.shared == share((front, second))["second"].shared
    assert both.mount == share((front, some, second))["second"].mount


def test_mounts_on_one_body_move_as_it_does():
    """A small displacement of the body under both, by matrices."""
    shift, turn = np.array([1.0, -2.0, 0.5]) * 1e-6, np.array([0.3, 1.0, -0.7]) * 1e-6
    moved = []
    for mount in (FRONT, BESIDE):
        at = mount.vector[:3] + shift + np.cross(turn, mount.vector[:3])
        rpy = roll_pitch_yaw((np.eye(3) + skew(turn)) @ mount.rotation)
        moved.append(np.concatenate([at, rpy]) - mount.vector)
    assert _as_moved(FRONT.vector, BESIDE.vector) @ moved[0] == pytest.approx(moved[1], abs=1e-10)
