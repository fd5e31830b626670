"""What a report draws and says follows from the returns, and can be seen by all readers."""

import html
import re
from dataclasses import replace

import numpy as np
import pytest

from polecal.calib import (
    CalibrationError,
    Criteria,
    Kind,
    Mount,
    Need,
    Returns,
    Setup,
    estimate,
)
from polecal.calib.certificate import Certificate
from polecal.calib.estimate import Shared, passes_of
from polecal.calib.observations import points_body
from polecal.calib.report.evidence import Seen, gather, largest, moved, placed_to_m
from polecal.calib.report.figures import HEADINGS
from polecal.calib.report.page import LaserReport, Report, in_millimetres, render
from polecal.calib.report.rules import rules
from polecal.calib.route import Lack, Vehicle, plan
from polecal.calib.sight import Sensor
from polecal.daemon import results

RADIUS_M = 0.04


@pytest.fixture(scope="module")
def returns(rig):
    return rig.drive(passes=14, noise_m=0.01, nav_m=0.01, radius_m=RADIUS_M)


@pytest.fixture(scope="module")
def setup(rig):
    return Setup(measured=rig.measured, pole_radius_m=RADIUS_M, extras=frozenset({"range_m"}))


@pytest.fixture(scope="module")
def result(returns, setup):
    return estimate(passes_of(returns, 30), setup)


def seen_of(returns, **changed):
    return [
        Seen(number, (number * 10**10, (number + 1) * 10**10), returns[returns.pass_id == number])
        for number in np.unique(returns.pass_id).tolist()
    ]


@pytest.fixture(scope="module")
def evidence(returns, setup, result):
    return gather(seen_of(returns), setup, result.mount, result.held, result.extras)


def spread_m(points):
    return float(np.sqrt(points[:, :2].var(axis=0).sum()))


def test_the_pole_comes_together_and_stands_where_it_stands(evidence):
    assert spread_m(evidence.before.points_m) > 3 * spread_m(evidence.after.points_m)
    assert np.linalg.norm(evidence.after.points_m[:, :2], axis=1).mean() == pytest.approx(RADIUS_M, abs=0.02)
    assert evidence.after.ground_m[:, 2].mean() == pytest.approx(0.0, abs=0.01)
    assert np.abs(evidence.after.ground_m[:, 2]).max() < 0.1


def test_the_last_point_of_the_cost_curve_is_the_results_cost(evidence, result, returns):
    numbers, counts, costs = zip(*evidence.curve, strict=True)
    assert (numbers[0], numbers[-1], len(numbers)) == (1, 14, 12)
    assert list(numbers) == sorted(set(numbers))
    assert counts[-1] == len(returns)
    assert costs[-1] == pytest.approx(result.cost_m, rel=1e-6)
    assert evidence.measured_cost_m == pytest.approx(result.measured_cost_m, rel=1e-6)
    assert costs[0] > costs[-1]


def test_residuals_are_about_nothing_and_of_the_size_of_the_cost(evidence, result):
    pole, ground = evidence.pole_after.offset_m, evidence.ground_after.offset_m
    assert np.sqrt((pole**2).sum(axis=1).mean() + (ground**2).mean()) == pytest.approx(
        result.cost_m, rel=0.05
    )
    assert np.abs(pole.mean(axis=0)).max() < 0.005
    assert np.abs(evidence.pole_before.offset_m).mean() > 4 * np.abs(pole).mean()


def test_a_pass_with_a_worse_heading_weighs_most(rig, setup):
    """A worse position would weigh little: passes count by how their poles scatter."""
    returns = rig.drive(passes=14, noise_m=0.01, nav_m=0.001, radius_m=RADIUS_M)
    rpy = returns.rpy_rad.copy()
    rpy[returns.pass_id == 5, 2] += np.radians(0.6)
    worse = replace(returns, rpy_rad=rpy)
    result = estimate(passes_of(worse, 30), setup)
    assert not result.set_aside
    told = gather(seen_of(worse), setup, result.mount, result.held, result.extras)
    sigma = result.sigma.vector
    sizes = {one.id: largest(one.shift, sigma, result.held)[1] for one in told.weights}
    assert max(sizes, key=sizes.get) == 5
    (weight,) = (one for one in told.weights if one.id == 5)
    assert set(result.left_out) == set(range(14))
    assert weight.shift == pytest.approx(result.left_out[5] - result.mount.vector, abs=1e-4)
    assert weight.off_m == max(one.off_m for one in told.weights)


def test_passes_that_were_not_used_are_listed_and_nothing_else(returns, setup, result):
    every = seen_of(returns)
    some = [replace(one, why_not="dropped" if one.id == 3 else "") for one in every]
    told = gather(some, setup, result.mount, result.held, result.extras)
    assert [(one.id, one.why_not) for one in told.weights if one.why_not] == [(3, "dropped")]
    assert [one.shift is None for one in told.weights].count(True) == 1
    assert told.curve[-1][1] == len(returns) - len(every[3].returns)
    with pytest.raises(CalibrationError):
        gather([replace(one, why_not="dropped") for one in every], setup, result.mount, (), {})


def test_poles_of_two_days_are_drawn_on_one_spot(returns, setup, result):
    elsewhere = replace(returns, position_m=returns.position_m + np.array([200.0, -50.0, 3.0]))
    days = [replace(one, site=0) for one in seen_of(returns)]
    days += [replace(one, site=1, id=one.id + 100) for one in seen_of(elsewhere)]
    told = gather(days, setup, result.mount, result.held, result.extras)
    assert np.abs(told.after.points_m[:, :2]).max() < 0.2
    assert np.abs(told.ground_after.offset_m).max() < 0.2


def test_a_late_laser_is_moved_along_its_path():
    """A turn at constant speed, known in closed form."""
    late_s, rate, speed = 0.05, 0.4, 5.0
    yaw = np.linspace(0.0, 1.0, 20)
    n = len(yaw)

    def at(yaw):
        return speed / rate * np.column_stack([np.sin(yaw), -np.cos(yaw), np.zeros(n)])

    zero = np.zeros(n)
    heading = np.column_stack([np.cos(yaw), np.sin(yaw), zero])
    returns = Returns(
        np.full(n, 5.0),
        zero,
        at(yaw),
        np.column_stack([zero, zero, yaw]),
        (np.arange(n) % 2).astype(np.uint8),
        np.zeros(n, np.int64),
        speed * heading,
        np.column_stack([zero, zero, np.full(n, rate)]),
        speed * rate * np.column_stack([-np.sin(yaw), np.cos(yaw), zero]),
        np.zeros((n, 3)),
    )
    after = moved(returns, {"time_s": late_s, "range_m": 0.02})
    assert after.position_m == pytest.approx(at(yaw + rate * late_s), abs=1e-4)
    assert after.rpy_rad[:, 2] == pytest.approx(yaw + rate * late_s)
    assert after.range_m == pytest.approx(np.where(returns.kind == Kind.POLE, 5.02, 5.0))
    assert moved(returns, {}).position_m is returns.position_m


def test_what_is_placed_to_how_much_by_a_thousand_draws(tell):
    mount = Mount(0.1, -0.35, -1.0, 5.0, -8.0, 20.0)
    root = np.diag([0.004, 0.005, 0.02, *np.radians([0.05, 0.03, 0.08])])
    root[5, 1] = 0.001
    chance = np.random.default_rng(0)
    drawn = mount.vector + chance.normal(size=(4000, 6)) @ root.T
    points = np.array(
        [points_body(np.array([20.0]), np.zeros(1), Mount.from_vector(one))[0] for one in drawn]
    )
    assert placed_to_m(root @ root.T, mount, 20.0) == pytest.approx(points.std(axis=0), rel=0.05)


def test_an_angle_in_millimetres():
    assert in_millimetres(0.02, 20) == "0.02° is 7 mm at 20 m"


@pytest.mark.parametrize(
    ("criteria", "passes", "unmet"),
    [
        (Criteria(), 14, set()),
        (Criteria(cost_m=0.01), 14, {"cost √c"}),
        (Criteria(improvement=1e-9), 14, {"√c improved by the last passes by"}),
        (Criteria(cost_m=0.001, mode="any"), 14, set()),
        (Criteria(max_sigma=(1e-5, 1.0, 1.0, 1.0, 1.0, 1.0)), 14, {"σ of x"}),
        (Criteria(max_shift_sigmas=0.1), 14, {"roll, pitch, yaw: off the hand measurement, in its σ"}),
        (Criteria(), 3, {"passes", "√c improved by the last passes by"}),
    ],
)
def test_the_rules_are_those_of_the_verdict(returns, setup, criteria, passes, unmet):
    setup = replace(setup, criteria=criteria, need=Need(slices_needed=1))
    result = estimate(passes_of(returns[returns.pass_id < passes], 30), setup)
    told = rules(results.calibration("front", setup, result, "", ""), setup)
    missed = {rule.what for rule in told if not rule.met}
    assert missed >= unmet
    assert result.verdict.accepted == (not missed)


def lab(rgb):
    """sRGB (N, 3) in 0 to 1 to CIE L*a*b*, D65."""
    linear = np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)
    to_xyz = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]])
    xyz = linear @ to_xyz.T / [0.9505, 1.0, 1.089]
    f = np.where(xyz > 0.008856, np.cbrt(xyz), 7.787 * xyz + 16 / 116)
    return np.column_stack([116 * f[:, 1] - 16, 500 * (f[:, 0] - f[:, 1]), 200 * (f[:, 1] - f[:, 2])])


DICHROMATS = {  # Machado, Oliveira, Fernandes 2009, severity 1, on linear RGB
    "protanopia": [
        [0.152286, 1.052583, -0.204868],
        [0.114503, 0.786281, 0.099216],
        [-0.003882, -0.048116, 1.051998],
    ],
    "deuteranopia": [
        [0.367322, 0.860646, -0.227968],
        [0.280085, 0.672501, 0.047413],
        [-0.011820, 0.042940, 0.968881],
    ],
    "all colours": np.eye(3).tolist(),
}


@pytest.mark.parametrize("reader", DICHROMATS)
def test_opposite_headings_look_different_to_every_reader(reader, tell):
    rgb = HEADINGS(np.arange(36) / 36)[:, :3]
    linear = np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)
    seen = np.clip(linear @ np.array(DICHROMATS[reader]).T, 0, 1)
    seen = np.where(seen <= 0.0031308, 12.92 * seen, 1.055 * seen ** (1 / 2.4) - 0.055)
    colours = lab(seen)
    apart = np.linalg.norm(colours - np.roll(colours, 18, axis=0), axis=1)
    tell(f"opposite headings differ by ΔE {apart.min():.0f} at least, {reader}")
    assert apart.min() > 30


def test_headings_come_round_and_are_lost_on_no_page():
    ends = HEADINGS(np.array([0.0, 1.0]))[:, :3]
    assert ends[0] == pytest.approx(ends[1])
    light = lab(HEADINGS(np.arange(36) / 36)[:, :3])[:, 0]
    assert light.min() > 30
    assert light.max() < 80


def page_of(returns, setup, result, evidence, **changed):
    entry = results.calibration("front", setup, result, "s1", "2026")
    laser = LaserReport("front", setup, entry, evidence, dict.fromkeys(result.held, "why it is held"), "")
    report = {
        "title": "Calibration <script>alert(1)</script>",
        "state": "accepted",
        "why": "",
        "lasers": [laser],
        "quality": None,
        "facts": [("session", "s1")],
        "notes": [],
        "history": [],
        "configuration": "lasers: [<b>]",
    }
    return render(Report(**report | changed))


@pytest.fixture(scope="module")
def page(returns, setup, result, evidence):
    return page_of(returns, setup, result, evidence)


def test_the_page_says_what_was_found_and_is_whole(page, result):
    text = html.unescape(re.sub(r"<[^>]+>", " ", page.html))
    for key, value in result.mount.as_dict().items():
        assert f"{value:.{4 if key.endswith('_m') else 3}f}".replace("-", "−") in text
    targets = re.findall(r"""(?:src|href)="([^"]*)"|url\(([^)]*)\)""", page.html)
    assert all((a or b).startswith(("data:", "#")) for a, b in targets)
    ids = re.findall(r'\sid="([^"]+)"', page.html)
    assert len(ids) == len(set(ids))
    links = set(re.findall(r'href="#([^"]+)"|url\(#([^)]+)\)', page.html))
    assert {a or b for a, b in links} <= set(ids)
    assert len(page.drawings) == 5
    assert all(
        one.png.startswith(b"\x89PNG") and one.alt in html.unescape(page.html) for one in page.drawings
    )
    assert len(page.html) < 3e6


def test_the_page_says_whether_the_cost_is_proven_to_be_the_lowest_and_what_another_laser_has_helped(
    returns, setup, result, evidence, page
):
    assert "lower cost" not in page.html, "where that was not asked"
    for proven, words in ((True, "cost is proven."), (False, "cost is not proven; the search")):
        told = replace(
            result,
            certificate=Certificate(0.001, proven),
            shared=Shared("rear", 12, {"x": 0.7, "y": 0.82, "roll": 0.6}),
        )
        text = page_of(returns, setup, told, evidence).html
        assert f"That no other mount has a lower {words}" in text
        assert "12 passes that rear saw, too" in text
        assert "σ is of x 0.70, of y 0.82 and of roll 0.60 of what it was without." in text


def test_what_others_wrote_is_text_and_never_markup(page):
    assert "<script" not in page.html
    assert "&lt;script&gt;" in page.html
    assert "lasers: [&lt;b&gt;]" in page.html


def test_a_laser_that_was_not_accepted_makes_the_page_red_whatever_the_state_says(returns, setup, evidence):
    strict = replace(setup, criteria=Criteria(cost_m=0.001))
    result = estimate(passes_of(returns, 30), strict)
    page = page_of(returns, strict, result, evidence)
    head = page.html.partition("</header>")[0]
    assert "Accepted" not in head
    assert 'class="verdict"' in head
    assert "is above 0.001 m" in html.unescape(head)


def test_what_is_still_to_be_driven_is_drawn_where_something_is(returns, setup, result, evidence, page):
    assert "Still to be driven" not in page.html
    mount = Mount(0.0, -0.35, -1.0, 0.0, -8.0, 0.0)
    sensor = Sensor("front", mount, 100.0, 0.25, 0.04, 2.4, (0.1, 0.1), 18.77)
    lacks = [Lack(sensor, {2: (1, 100), 7: (1, 100)})]
    legs = plan(lacks, 30, Vehicle(), both_ways=True).legs
    longer = page_of(returns, setup, result, evidence, route=legs, state="collecting")
    assert "Still to be driven" in longer.html
    drawing = longer.drawings[-1]
    assert len(longer.drawings) == len(page.drawings) + 1
    assert drawing.alt == "A route of 3 approaches, 1 of them in reverse, in slices 2, 7."
    assert drawing.alt in longer.html
