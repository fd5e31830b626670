"""What an operator sees of a STATUS object fits one small terminal and says all that counts."""

import copy
import io
import re

import pytest
from rich.console import Console

from polecal.daemon.screen import Screen

ESTIMATE = {
    "x_m": -0.028,
    "y_m": -0.361,
    "z_m": -0.997,
    "roll_deg": -0.53,
    "pitch_deg": -8.18,
    "yaw_deg": -2.02,
}
SIGMA = {"x_m": 0.004, "y_m": 0.005, "z_m": 0.011, "roll_deg": 0.01, "pitch_deg": 0.015, "yaw_deg": 0.02}
MEASURED = {"x_m": 0.0, "y_m": -0.35, "z_m": -1.0, "roll_deg": 0.0, "pitch_deg": -8.0, "yaw_deg": 0.0}
DEVICES = [
    {
        "name": "front",
        "kind": "sick_lms",
        "port": "/dev/polecal-lms-front",
        "state": "streaming",
        "rate_hz": 18.8,
        "frames": 1520,
        "bad_frames": 0,
        "reconnects": 0,
    },
    {
        "name": "span",
        "kind": "novatel_span",
        "port": "/dev/polecal-span",
        "state": "streaming",
        "rate_hz": 100.0,
        "ins_status": "INS_SOLUTION_GOOD",
        "frames": 8120,
        "bad_frames": 3,
        "reconnects": 1,
    },
]
RETURNS = [412, 388, 0, 0, 37, 1250, 98, 101, 230, 311, 188, 20512]


def coverage(returns=RETURNS):
    return [
        {"slice": k, "pole_returns": n, "passes": int(n > 0), "done": n >= 100} for k, n in enumerate(returns)
    ]


LOST = {"state": "lost", "problem": "no " * 99, "hint": "do " * 99}
LASER = {
    "name": "front",
    "passes": 7,
    "coverage": coverage(),
    "estimate": ESTIMATE,
    "sigma": SIGMA,
    "measured": MEASURED,
    "held": [],
    "cost_m": 0.031,
    "measured_cost_m": 0.118,
    "verdict": {"accepted": False, "reasons": ["slices 2, 3 have no pass"]},
}
STATUS = {
    "class": "STATUS",
    "state": "collecting",
    "session": "20261122T031500Z-front",
    "since_s": 81.2,
    "devices": DEVICES,
    "lasers": [LASER],
    "next": "drive past the pole heading 60–150°",
}


def drawn(status, width=80, **options):
    console = Console(file=io.StringIO(), width=width, **options)
    console.print(Screen(status))
    return console.file.getvalue()


def status(laser=(), **changes):
    made = copy.deepcopy(STATUS)
    made["lasers"][0].update(laser)
    return made | changes


def test_all_that_an_operator_asks_is_there():
    text = drawn(STATUS)
    for told in (
        "collecting",
        "20261122T031500Z-front",
        "1 min 21 s",
        "18.8 Hz",
        "INS_SOLUTION_GOOD",
        "3 bad 1 lost",
        "7 passes, 8 of 12 slices done",
        "cost     0.031 m   by hand 0.118 m",
        "slices 2, 3 have no pass",
        "next: drive past the pole heading 60–150°",
    ):
        assert told in text
    assert re.search(r"x +-0\.028 +±0\.004 +0\.000 +-0\.028 m", text)
    assert re.search(r"yaw +-2\.02 +±0\.020 +0\.00 +-2\.02 °", text)


def test_the_rose_shows_each_slice_with_heading_mark_and_returns():
    text = drawn(STATUS)
    marks = {int(m[1]): (m[2], m[3]) for m in re.finditer(r"(\d+)°([✓~·])(\w+)", text)}
    assert sorted(marks) == list(range(0, 360, 30))
    assert marks[0] == ("✓", "412")
    assert marks[60] == ("·", "0")
    assert marks[120] == ("~", "37")
    assert marks[330] == ("✓", "20k")


def test_north_is_up_and_headings_run_to_the_right():
    lines = drawn(STATUS).splitlines()

    def place(heading):
        row = next(n for n, line in enumerate(lines) if re.search(rf"\b{heading}°[✓~·]", line))
        return row, lines[row].index(f"{heading}°")

    assert place(0)[0] < place(60)[0] < place(90)[0] < place(150)[0]
    assert place(330)[0] < place(270)[0] < place(210)[0]
    assert place(60)[1] > place(270)[1]
    assert place(0)[0] == place(330)[0]


@pytest.mark.parametrize(
    "made",
    [
        {},
        {"state": None, "devices": None, "lasers": None},
        STATUS,
        status(lasers=[]),
        status(state="idle", session=None, lasers=[], next="polecal-field start"),
        status({"estimate": None, "sigma": None, "cost_m": None, "measured_cost_m": None, "coverage": []}),
        status({"estimate": {}, "sigma": {}, "measured": {}, "verdict": None, "passes": None}),
        status({"cost_m": float("nan"), "estimate": dict.fromkeys(ESTIMATE, -179.9994)}),
        status({"verdict": {"accepted": False, "reasons": ["a long reason " * 20] * 9}}),
        status({"dropped": {"no pose there": 123456789, "too far": 3}, "improvement": 0.034}),
        status(notes=["nothing is used " * 30] * 4),
        status(lasers=[LASER | {"name": name} for name in ("front", "left", "right")]),
        status(lasers=[LASER | {"name": f"laser-{n}"} for n in range(9)]),
        status(devices=[dict(device, name="d" * 40, port="/dev/" + "p" * 90) for device in DEVICES]),
        status(devices=[d | LOST for d in DEVICES]),
        status(devices=[d | LOST for d in DEVICES * 4]),
        status(next="drive " * 90),
        status(session="s" * 200, since_s=1e6),
        *(status({"coverage": coverage([150] * n)}) for n in (1, 2, 3, 4, 6, 8, 9, 10, 15, 24, 36, 120, 360)),
    ],
)
def test_it_fits_80_by_24_whatever_comes(made):
    text = drawn(made)
    lines = text.splitlines()
    assert len(lines) <= 24
    assert max(map(len, lines)) <= 80
    assert "None" not in text
    assert "nan" not in text
    if made.get("next"):
        assert "next: " in text


def test_every_slice_of_any_size_is_shown_once():
    for count in (1, 2, 3, 4, 5, 6, 8, 9, 10, 12, 15, 18, 20, 24):
        text = drawn(status({"coverage": coverage([150] * count)}))
        assert text.count("✓150") == count


def test_a_device_that_does_not_stream_says_why_and_what_to_do():
    lost = DEVICES[0] | {
        "state": "lost",
        "problem": "/dev/polecal-lms-front: there is no such port",
        "hint": "plug it in",
    }
    text = drawn(status(devices=[lost, DEVICES[1]]))
    assert "there is no such port" in text
    assert "→ plug it in" in text


def test_a_held_unknown_is_said_to_be():
    assert re.search(r"z +-0\.997 +held +-1\.000", drawn(status({"held": ["z"]})))


def test_without_an_estimate_there_are_dashes():
    text = drawn(status({"estimate": None, "sigma": None, "cost_m": None, "measured_cost_m": None}))
    assert re.search(r"x +— +— +0\.000 +—", text)
    assert "by hand — m" in text


@pytest.mark.parametrize(
    ("state", "verdict", "says"),
    [
        ("collecting", {"accepted": False, "reasons": ["too few passes"]}, "not yet: too few passes"),
        ("rejected", {"accepted": False, "reasons": ["cost 0.2 m"]}, "rejected: cost 0.2 m"),
        ("accepted", {"accepted": True, "reasons": []}, "✓ accepted"),
    ],
)
def test_the_verdict_is_in_words(state, verdict, says):
    assert says in drawn(status({"verdict": verdict}, state=state))


def test_several_lasers_each_get_slices_estimate_cost_and_verdict():
    text = drawn(status(lasers=[LASER, LASER | {"name": "left"}]))
    assert text.count("✓✓··~✓~✓✓✓✓✓") == 2
    assert text.count("cost 0.031 m, by hand 0.118 m") == 2
    assert text.count("slices 2, 3 have no pass") == 2


def test_without_a_terminal_there_are_no_escapes_and_with_one_there_is_colour():
    assert "\x1b" not in drawn(STATUS)
    assert "\x1b" in drawn(STATUS, force_terminal=True, color_system="standard")


def test_a_narrow_terminal_is_not_overflown():
    assert max(map(len, drawn(STATUS, width=60).splitlines())) <= 60


def test_a_terminal_without_unicode_gets_ascii():
    class Ascii(io.StringIO):
        encoding = "ascii"

    console = Console(file=Ascii(), width=80)
    console.print(Screen(STATUS))
    text = console.file.getvalue()
    assert text.isascii()
    assert "0d+412" in text
