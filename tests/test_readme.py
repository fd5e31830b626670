"""What README and docs say is so; the commands in them are carried out by `daemon/test_commands.py`."""

import math
import re
import threading
import time
from pathlib import Path

import numpy as np
import pytest
import yaml

from polecal.calib import Criteria, Kind, Need, Returns, Slice, acceptance, segment
from polecal.calib.acceptance import Jump
from polecal.calib.uncertainty import FEWEST_PASSES
from polecal.daemon import manual
from polecal.daemon.config import Config, loads
from polecal.drivers.emulated.serve import serve
from polecal.drivers.port import Port

ROOT = Path(__file__).parents[1]
PAGES = {
    str(path.relative_to(ROOT)): path.read_text(encoding="utf-8")
    for path in (ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md")))
}
TOGETHER = "\n".join(PAGES.values())
README = " ".join(PAGES["README.md"].split())
SMALLEST = {
    "lasers": [
        {"port": "a", "mount": dict.fromkeys(("x_m", "y_m", "z_m", "roll_deg", "pitch_deg", "yaw_deg"), 0.0)}
    ],
    "navigation": {"port": "b"},
    "pole": {"radius_m": 0.04, "height_m": 2.4},
}


def fenced(language, text=TOGETHER):
    return re.findall(rf"^```{language}\n(.*?)^```", text, re.DOTALL | re.MULTILINE)


def inline(text=TOGETHER):
    """What stands in backticks, outside of blocks."""
    bare = re.sub(r"^```.*?^```", "", text, flags=re.DOTALL | re.MULTILINE)
    return [" ".join(each.split()) for each in re.findall(r"`([^`]+)`", bare)]


# --- what they point at


def anchors(page):
    headings = re.findall(r"^#+ (.*)$", PAGES[page], re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("page", PAGES)
def test_every_link_leads_somewhere(page):
    for target in re.findall(r"\]\(([^)]+)\)", PAGES[page]):
        if target.startswith("https://"):
            continue
        name, _, anchor = target.partition("#")
        path = (ROOT / page).parent / name if name else ROOT / page
        assert path.is_file(), target
        assert not anchor or anchor in anchors(str(path.resolve().relative_to(ROOT))), target


def test_every_page_is_linked_from_the_readme():
    assert {name for name in PAGES if name.startswith("docs/")} <= set(
        re.findall(r"\((docs/[^)#]+)\)", README)
    )


NAMED = sorted(
    {each for each in inline() if re.match(r"(drivers|calib|daemon|systemd|docs|polecal|tests)/", each)}
    - {"systemd/install --dry-run", "systemd/install --uninstall"}
)


@pytest.mark.parametrize("named", NAMED)
def test_every_file_folder_and_name_in_the_code_is_there(named):
    path, _, name = named.partition(":")
    assert (ROOT / path).exists()
    if path.endswith("/"):
        assert (ROOT / path).is_dir()
    if name:
        text = (ROOT / path).read_text(encoding="utf-8")
        assert re.search(rf"^(?:(?:class|def) {name}\b|{name}(?::.*)? = )", text, re.MULTILINE)


def test_the_names_are_found():
    assert len(NAMED) > 40
    assert "calib/solve.py:minimise_globally" in NAMED


def test_the_folders_are_those_of_the_tree():
    told = set(re.findall(r"^\| `(\w+)/` \|", PAGES["README.md"], re.MULTILINE))
    there = {path.name for path in ROOT.iterdir() if path.is_dir() and not path.name.startswith((".", "_"))}
    assert told == there - {"build", "polecal.egg-info", "demo-out"}


# --- configuration


def test_the_readmes_configuration_can_be_used():
    (text,) = fenced("yaml")
    config = loads(text)
    assert config.lasers[0].mount.pitch_deg == -8.0


PIECES = sorted({each for each in inline() if re.fullmatch(r"[a-z_]+:( \{.*\})?", each)})


@pytest.mark.parametrize("piece", PIECES)
def test_every_piece_of_configuration_is_one(piece):
    content = yaml.safe_load(piece)
    (key,) = content
    assert key in Config.model_fields
    if content[key] is not None:
        loads(yaml.safe_dump(SMALLEST | content))


def test_the_pieces_are_found():
    assert {"accept:", "page: {listen: 127.0.0.1:8291}", "storage: {decoded: true}"} <= set(PIECES)


OPTIONS = sorted(
    {option for each in inline() if each.startswith("--") for option in re.findall(r"--[a-z-]+", each)}
)


@pytest.mark.parametrize("option", OPTIONS)
def test_every_option_is_in_a_manual_page(option):
    manuals = "".join(manual.pages().values()).replace("\\-", "-")
    assert re.search(rf"{option}\b(?!-)", manuals)


def test_the_options_are_found():
    assert len(OPTIONS) >= 4


# --- what they claim


def test_the_numbers_of_the_verdict_are_the_defaults():
    said = re.search(
        r"below ([\d.]+), and of passes left out of the fit below ([\d.]+); "
        r"neither the last passes \((\d+) %\) nor half of all \((\d+) %\) would change it much; "
        r"what is not held is known to (\d+) cm and ([\d.]+)°",
        README,
    )
    cost_m, left_out_m, improvement, doubling, xyz_cm, angle_deg = map(float, said.groups())
    accept = loads(yaml.safe_dump(SMALLEST)).accept
    assert (accept.cost_m, accept.left_out_m) == (cost_m, left_out_m)
    assert (100 * accept.improvement, 100 * accept.doubling) == (improvement, doubling)
    most = accept.max_sigma
    assert {100 * most.xy_m, 100 * most.z_m} == {xyz_cm}
    assert {most.roll_deg, most.pitch_deg, most.yaw_deg} == {angle_deg}
    assert f"after {loads(yaml.safe_dump(SMALLEST)).routine.max_passes} passes" in README


def test_other_numbers_are_the_codes():
    works = " ".join(PAGES["docs/how-it-works.md"].split())
    assert f"level {math.ceil(7 * segment.RETRO_REFLECTIVE)} and up of the laser's 7" in works
    assert f"within {segment._GROUND_RANGE_M:.0f} m" in works
    assert f"which takes {FEWEST_PASSES} passes at least" in works
    unit = (ROOT / "systemd" / "polecal.service").read_text(encoding="utf-8")
    (watchdog_s,) = re.findall(r"WatchdogSec=(\d+)", unit)
    assert f"within another {watchdog_s} s" in README


def everything_wrong():
    """Every reason that there is for not accepting a result."""
    slices = [Slice(index, 0, 0, False) for index in range(12)]
    verdict = acceptance.judge(
        criteria=Criteria(),
        need=Need(),
        slices=slices,
        passes=2,
        cost_m=1.0,
        left_out_m=1.0,
        improvement=0.5,
        doubling=0.5,
        jump=Jump(0, 1.0, 5),
        last_set_aside="0.2 m off",
        sigma=np.ones(6),
        held=(),
        shift=np.ones(6),
        measured_sigma=np.full(6, 0.1),
    )
    return acceptance.given_up(verdict, 200).reasons


def test_what_the_verdict_says_is_told_with_what_to_do():
    table = PAGES["README.md"].split("| it says | so |")[1].split("\n\n")[0]
    told = re.findall(r"^\| `(.*?)` \| (.+) \|$", table, re.MULTILINE)
    reasons = everything_wrong()
    patterns = [".*?".join(map(re.escape, phrase.split("…"))) for phrase, _ in told]
    for pattern in patterns:
        assert any(re.search(pattern, reason) for reason in reasons), pattern
    for reason in reasons:
        assert any(re.search(pattern, reason) for pattern in patterns), reason


# --- examples in Python


def test_the_example_on_arrays_runs(rig_returns):
    (text,) = fenced("python", PAGES["docs/how-it-works.md"])
    names = ("range_m", "bearing_rad", "position_m", "rpy_rad", "kind", "pass_id")
    scope = {name: getattr(rig_returns, name) for name in names}
    exec(text, scope)
    assert scope["result"].cost_m < 0.05


@pytest.fixture
def rig_returns():
    rng = np.random.default_rng(0)
    n = 600
    yaw = rng.uniform(0, 2 * np.pi, n)
    position = np.column_stack([-4 * np.cos(yaw), -4 * np.sin(yaw), np.zeros(n)])
    kind = np.where(np.arange(n) % 2, Kind.GROUND, Kind.POLE).astype(np.uint8)
    ranges = np.where(kind == Kind.POLE, 4.0, 7.2) + 0.01 * rng.normal(size=n)
    rpy = np.column_stack([np.zeros(n), np.zeros(n), yaw])
    return Returns(ranges, np.zeros(n), position, rpy, kind, np.arange(n) // 50)


@pytest.fixture
def example():
    """The names that the worked example of a device defines."""
    scope = {"__name__": __name__}  # dataclasses look there
    for block in fenced("python", PAGES["docs/adding-a-device.md"]):
        exec(block, scope)
    return scope


def test_the_example_of_a_framer_lives_through_garbage_and_any_cut(example):
    good = b"$TILT,1.50,-0.25*2B\n"
    assert example["reduce"](example["xor"], good[1:-4]) == 0x2B
    stream = b"\xff\x00" + good + b"$TILT,9.99,-0.25*2B\n" + b"$TILT,1.5" + good + b"\x80" * 500 + good
    for step in (1, 7, len(stream)):
        framer = example["Framer"]()
        found = []
        for at in range(0, len(stream), step):
            found += framer.feed(stream[at : at + step], at)
            assert len(framer._held) <= example["LONGEST"]
        assert [(tilt.roll_deg, tilt.pitch_deg) for tilt in found] == [(1.5, -0.25)] * 3


def test_the_example_of_a_device_streams_is_found_again_and_leaves(example, tmp_path):
    link = tmp_path / "tilt"
    emulated = example["EmulatedInclinometer"](time.monotonic_ns())
    taps = []
    device = example["Inclinometer"]("tilt", str(link), 38400, lambda *tapped: taps.append(tapped))
    stop = threading.Event()

    with plugged(link, emulated):
        runs = threading.Thread(target=device.run, args=(device.open(stop),))
        runs.start()
        until(lambda: device.state == "streaming" and device.last)
        assert (device.last.roll_deg, device.last.pitch_deg) == (1.5, -0.25)
    until(lambda: device.state == "lost")
    with plugged(link, emulated):
        until(lambda: device.state == "streaming")
        assert device.reconnects >= 1
        stop.set()
        runs.join(10.0)
        until(lambda: not emulated.streams)
    assert device.state == "closed"
    assert {b"GO\n", b"NO\n"} == {data for direction, _, data in taps if direction == "tx"}


def test_the_example_of_a_device_says_what_is_wrong_with_a_silent_one(example, tmp_path):
    link = tmp_path / "tilt"
    deaf = example["EmulatedInclinometer"](time.monotonic_ns())
    deaf._hear = lambda t_ns, byte: None
    device = example["Inclinometer"]("tilt", str(link), 38400, lambda *_: None)
    silent = pytest.raises(example["DeviceNotFound"], match="no answer to GO")
    with plugged(link, deaf), Port(str(link), 38400) as port, silent as caught:
        device._set_up(port)
    assert "cable" in caught.value.hint


class plugged:  # noqa: N801
    """A device at a link, for as long as it lasts."""

    def __init__(self, link, device):
        self._stop, ready = threading.Event(), threading.Event()
        self._thread = threading.Thread(
            target=serve,
            args=({str(link): device},),
            kwargs={"stop": self._stop, "ready": lambda _: ready.set()},
        )
        self._thread.start()
        assert ready.wait(5.0)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self._stop.set()
        self._thread.join(5.0)


def until(ask, timeout_s=20.0):
    deadline_s = time.monotonic() + timeout_s
    while not ask():
        assert time.monotonic() < deadline_s
        time.sleep(0.02)
