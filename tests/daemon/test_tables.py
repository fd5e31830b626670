"""PASSES, DROP and SESSIONS as an operator reads them: on 80 columns, whatever comes."""

import pytest

from polecal.daemon import tables

ROW = {
    "name": "front-007", "laser": "front", "pass": 7, "site": 0, "place": 0, "use": "used", "why": "",
    "start": "2026-11-22T03:16:41.2Z", "end": "2026-11-22T03:16:45.4Z",
    "gps_ns": [10**18, 10**18 + 4_200_000_000], "t_ns": [1, 2], "heading_deg": 85.2, "span_deg": 24.0,
    "slices": [{"slice": 2, "pole": 310, "ground": 12_000}, {"slice": 3, "pole": 12, "ground": 7_040}],
    "speed_mps": -4.84, "direction": "reverse", "nearest_m": 1.21, "mean_m": 4.5,
    "ins_status": "INS_SOLUTION_GOOD", "position_type": "INS_RTKFIXED", "position_sigma_m": None,
    "azimuth_sigma_deg": None, "unused_poses": 0, "cost_m": 0.0286, "offset_m": 0.0121, "spread_m": 0.0259,
}  # fmt: skip
WORST = {
    "use": "set aside", "why": "its pole is 11.23 m off, and more words than fit",
    "heading_deg": 259.6, "span_deg": 359.0, "slices": [{"slice": 0, "pole": 99_999, "ground": 999_999}],
    "nearest_m": 10.0, "mean_m": 12.0, "offset_m": 9.876, "spread_m": 0.999, "position_sigma_m": 0.123,
    "ins_status": "INS_ALIGNMENT_COMPLETE", "unused_poses": 120, "site": 1, "speed_mps": 22.0,
}  # fmt: skip


def drawn(table, answer):
    return [line.plain for line in table(answer)]


def passes(*rows):
    return drawn(tables.passes, {"session": "s1", "state": "collecting", "passes": [*rows], "next": None})


def test_a_pass_is_a_line_of_80_columns():
    title, head, date, line = passes(ROW)
    assert title == "session s1, collecting: 1 pass, 1 used"
    assert date == "2026-11-22"
    assert len(line) == len(head) == 80
    assert line.split() == [
        *("front-007", "03:16:41", "4", "85±12", "322", "19040"),
        *("4.8", "rev", "1.2/4.5", "12", "26", "FIXED"),
    ]


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"position_sigma_m": 0.02}, "±0.02m"),
        ({"position_type": "SINGLE"}, "SINGLE"),
        ({"position_type": None}, "—"),
        ({"offset_m": None, "spread_m": None}, "   —   —"),
    ],
)
def test_what_is_known_of_the_navigation_and_the_residual_is_in_it(changes, says):
    assert says in passes(ROW | changes)[-1]


def test_why_a_pass_is_not_used_stands_below_it():
    lines = passes(ROW, ROW | {"use": "dropped", "why": "by ann, 2026-11-22T03:17:00+00:00"})
    assert "└ dropped: by ann, 2026-11-22T03:17:00+00:00" in lines[-1]
    assert lines[0].endswith("2 passes, 1 used")


def test_nothing_of_a_pass_goes_beyond_80_columns():
    lines = passes(ROW | WORST)
    assert max(map(len, lines)) <= 80
    assert any("at times INS_ALIGNMENT_COMPLETE" in line for line in lines)
    assert any("120 poses not used" in line for line in lines)
    assert any("2026-11-22, day 2" in line for line in lines)


def test_without_a_pass_there_is_one_line():
    assert passes() == ["session s1, collecting: 0 passes, 0 used"]


KEYS = ("x_m", "y_m", "z_m", "roll_deg", "pitch_deg", "yaw_deg")
STANDING = {
    "state": "accepted", "passes": 12,
    "estimate": dict.fromkeys(KEYS, -0.5), "sigma": dict.fromkeys(KEYS, 0.01),
    "held": ["z"], "cost_m": 0.03, "verdict": {"accepted": True, "reasons": []},
}  # fmt: skip
CHANGE = {
    "session": "s1", "name": "front-007", "dropped": True, "slices_lost": [3, 4], "slices_won": [],
    "before": STANDING,
    "after": STANDING | {
        "state": "rejected", "passes": 11, "estimate": dict.fromkeys(KEYS, -0.48), "cost_m": 0.04,
        "verdict": {"accepted": False, "reasons": ["slices 3, 4 have no pass", "x" * 200]},
    },
}  # fmt: skip


def test_what_a_drop_changed_is_told_before_and_after():
    lines = drawn(tables.change, CHANGE)
    assert lines[0] == "pass front-007 of session s1 is dropped"
    assert lines[2].split() == ["x", "-0.5000", "0.0100", "-0.4800", "0.0100", "+0.0200", "m"]
    assert lines[4].split()[2] == "held"
    assert "no longer covered: slices 3, 4" in lines
    assert "accepted → rejected" in lines
    assert max(map(len, lines)) <= 80


def test_before_there_is_an_estimate_dashes_are_told():
    none = {"estimate": None, "sigma": None, "cost_m": None, "passes": 0, "state": "collecting"}
    none["verdict"] = {"accepted": False, "reasons": ["no pass of the pole yet"]}
    lines = drawn(tables.change, CHANGE | {"after": STANDING | none, "slices_lost": []})
    assert lines[2].split() == ["x", "-0.5000", "0.0100", "—", "—", "—", "m"]
    assert "accepted → collecting, not yet" in lines


def test_sessions_are_a_line_each_with_what_is_wrong_below():
    row = {
        "session": "20261122T031500Z-front", "created": "2026", "state": "accepted", "passes": 36,
        "cost_m": {"front": 0.031, "rear": None}, "size_bytes": 51_000_000, "preserved": True, "captures": 2,
        "problem": None,
    }  # fmt: skip
    broken = row | {"session": "s" * 99, "state": "unfinished", "cost_m": {}, "preserved": False}
    lines = drawn(tables.sessions, {"sessions": [row, broken | {"problem": "session.yaml: " + "no " * 99}]})
    assert lines[1].split() == ["20261122T031500Z-front", "accepted", "36", "0.031/—", "51", "2", "yes"]
    assert "session.yaml: no" in lines[3]
    assert max(map(len, lines)) <= 80
    assert drawn(tables.sessions, {"sessions": []}) == ["no session yet: start one by `polecal-field start`"]
