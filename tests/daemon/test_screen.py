"""What an operator sees of a STATUS object fits one small terminal and says all that counts."""

import copy
import io
import os
import re
from pathlib import Path

import pytest
from rich.console import Console

from polecal.daemon.screen import Screen, lines

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
        ("rejected", {"accepted": True, "reasons": []}, "its own criteria are met; the session is rejected"),
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


# --- golden drawings: what each state looks like, in full and in ASCII

GOLDEN = Path(__file__).parent / "golden"
NEED = {"slice_deg": 30, "min_pole_returns": 100, "min_passes": 1, "slices_needed": 12}
CLOSED = [device | {"state": "closed", "rate_hz": 0.0, "frames": 0, "bad_frames": 0} for device in DEVICES]
NOTHING = {
    "passes": 0,
    "coverage": coverage([0] * 12),
    "estimate": None,
    "sigma": None,
    "cost_m": None,
    "measured_cost_m": None,
    "verdict": {"accepted": False, "reasons": ["no pass of the pole yet"]},
}
COSTS = [0.214, 0.182, 0.121, 0.067, 0.048, 0.039, 0.036, 0.033, 0.031]
SILENT = CLOSED[0] | {
    "state": "connecting",
    "problem": "/dev/polecal-lms-front: no laser answers at 9600, 19200, 38400, 500000 bit/s: silence",
    "hint": "check the laser's power (it needs a minute to start) and the data cable",
}
ALIGNING = DEVICES[1] | {"ins_status": "WAITING_AZIMUTH", "position_type": "INS_RTKFIXED", "bad_frames": 0}
LATE = {"costs_m": COSTS, "improvement": 0.034, "need": NEED, "dropped": {"no pose there": 1234}}
DONE = LATE | {"coverage": coverage([150] * 12), "passes": 19}
FEW_PASSES = [{"slice": k, "pole_returns": 250, "passes": 1 + k % 3, "done": k % 3 == 2} for k in range(12)]
REASONS = ["√c is 0.081 m, more than 0.05 m", "z is known to ±31 mm, not ±20 mm"]
OK_DISK = {"free_mb": 70123, "left_s": 900000}
LONG = "a name that somebody has thought much too long about " * 4

SCENES = {
    "idle": status(state="idle", session=None, lasers=[], devices=CLOSED, next="polecal-field start"),
    "connecting": status(
        NOTHING | {"need": NEED},
        state="connecting",
        devices=[SILENT, DEVICES[1]],
        next="wait: not all devices stream yet",
        disk={"free_mb": 70123, "left_s": None},
    ),
    "aligning": status(
        NOTHING | {"need": NEED},
        state="aligning",
        devices=[DEVICES[0], ALIGNING],
        notes=["navigation says WAITING_AZIMUTH: the roll and pitch are known, not yet the heading"],
        next="drive until the navigation has aligned: straight, briskly, with a few turns",
        disk=OK_DISK,
    ),
    "collecting early": status(
        {
            "need": NEED,
            "passes": 1,
            "coverage": coverage([0, 0, 37] + [0] * 9),
            "costs_m": [0.214],
            "held": ["z"],
        }
        | {"verdict": {"accepted": False, "reasons": ["slices 0, 1, 3–11 have no pass", "one is few"]}},
        next="drive past the pole from any side but heading 60–90°",
        run_s=40.0,
        disk=OK_DISK,
    ),
    "collecting late": status(LATE, run_s=121.0, disk={"free_mb": 500, "left_s": 5400}),
    "collecting, passing": status(
        LATE | {"passing": {"pole_returns": 134, "estimate": {}, "sigma": {}, "cost_m": 0.0347}}
    ),
    "collecting, passes missing": status(
        LATE
        | {"need": NEED | {"min_passes": 3}}
        | {
            "coverage": [
                {"slice": k, "pole_returns": 250, "passes": 1 + k % 3, "done": k % 3 == 2} for k in range(12)
            ]
        }
    ),
    "accepted": status(
        DONE | {"verdict": {"accepted": True, "reasons": []}},
        state="accepted",
        next="",
        devices=CLOSED,
        disk=OK_DISK,
    ),
    "rejected": status(
        DONE
        | {
            "verdict": {
                "accepted": False,
                "reasons": REASONS,
            }
        },
        state="rejected",
        next="",
        devices=CLOSED,
        disk=OK_DISK,
    ),
    "fault": status(
        LATE,
        state="fault",
        devices=[
            DEVICES[0] | {"health": {"faults": ["fatal 49: laser power"], "polluted": True}},
            DEVICES[1]
            | {
                "state": "lost",
                "problem": "/dev/polecal-span: the port stopped working",
                "hint": "check the cable",
            },
        ],
        notes=["a bug in polecal: ZeroDivisionError()"],
        next="",
    ),
    "two lasers": status(
        devices=[DEVICES[0], DEVICES[0] | {"name": "left"}, DEVICES[1]],
        lasers=[LASER | LATE, LASER | NOTHING | {"name": "left", "need": NEED}],
        disk=OK_DISK,
        run_s=100.0,
    ),
    "four lasers": status(
        devices=[*(DEVICES[0] | {"name": name} for name in ("front", "left", "right", "rear")), DEVICES[1]],
        lasers=[LASER | LATE | {"name": name} for name in ("front", "left", "right", "rear")],
        disk=OK_DISK,
    ),
    "long words": status(
        LATE | {"name": LONG, "verdict": {"accepted": False, "reasons": [LONG] * 5}},
        session=LONG,
        notes=[LONG] * 5,
        next=LONG,
        devices=[d | LOST | {"name": LONG, "port": "/dev/" + LONG, "problem": LONG} for d in DEVICES],
    ),
    "disk full": status(
        LATE,
        notes=["nothing is recorded: only 120 MB are free on the disk, of 200 that must be"],
        disk={"free_mb": 0, "left_s": 0},
    ),
}


def scene(made):
    """Draw it as it is, and below it in ASCII."""
    return "".join(
        "\n".join(line.plain for line in lines(made, ascii_only=ascii_only)) + "\n" + "=" * 80 + "\n"
        for ascii_only in (False, True)
    )


@pytest.mark.parametrize("name", SCENES)
def test_each_state_looks_as_it_was_last_found_good(name):
    """After a change on purpose: ``POLECAL_GOLDEN=write``, then look at what git shows as changed."""
    path = GOLDEN / f"{name.replace(', ', '-').replace(' ', '-')}.txt"
    if os.environ.get("POLECAL_GOLDEN") == "write":
        path.write_text(scene(SCENES[name]), encoding="utf-8")
    assert scene(SCENES[name]) == path.read_text(encoding="utf-8")


@pytest.mark.parametrize("name", SCENES)
def test_no_state_needs_more_than_80_by_24_nor_more_than_ascii(name):
    for width in (80, 60, 40):
        drawn = lines(SCENES[name], width, ascii_only=True)
        assert len(drawn) <= 23
        assert all(line.cell_len <= width for line in drawn)
        assert all(line.plain.isascii() for line in drawn)


def test_what_a_terminal_would_take_for_a_command_is_not_passed_on():
    drawn = lines(status({"name": "\x1b[2J\x07"}, session="a\x1b]0;b\x07\tc", next="go\r\non\x9b2J"))
    assert not [char for line in drawn for char in line.plain if not char.isprintable()]


def test_what_a_slice_still_needs_is_said():
    parts = [
        {"slice": 0, "pole_returns": 412, "passes": 2, "done": True},
        {"slice": 1, "pole_returns": 37, "passes": 1, "done": False},
        {"slice": 2, "pole_returns": 0, "passes": 0, "done": False},
        {"slice": 3, "pole_returns": 140, "passes": 1, "done": False},
    ]
    text = drawn(status({"coverage": parts, "need": NEED | {"min_passes": 2}}))
    for told in ("0°✓412", "90°−63", "180°−100", "270°−1p"):
        assert told in text


def test_cost_is_drawn_as_it_falls():
    text = drawn(status({"costs_m": [0.4, 0.2, 0.1, 0.05]}))
    assert "√c    █▅▃▂" in text
    assert "√c" not in drawn(status({"costs_m": [float("nan"), None]}))


def test_time_and_disk_left_are_told_and_a_disk_that_is_soon_full_is_told_loudly():
    rule = {}
    for left in (1e6, 7300, 60):
        rule[left] = drawn(status(disk={"free_mb": 9, "left_s": left})).splitlines()[3]
    assert rule[1e6].endswith("disk ok ──")
    assert rule[7300].endswith("disk full in 2 h ──")
    assert rule[60].endswith("disk full in 60 s ──")
    assert "1;33m disk full" in drawn(
        status(disk={"free_mb": 9, "left_s": 60}), force_terminal=True, color_system="standard"
    )
    assert "at this pace 40 s of driving left" in drawn(status(run_s=80.0))  # 8 of 12 slices done
