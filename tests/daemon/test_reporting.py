"""A session's report, as a browser without a network shows it, of good runs, bad ones and old ones."""

import json
import re
import shutil
import subprocess
import sys
import threading

import numpy as np
import pytest
import yaml
from structlog.testing import capture_logs

from polecal.daemon import config as configuration
from polecal.daemon import reporting
from polecal.daemon.config import ConfigError
from polecal.daemon.finalise import Finaliser
from polecal.daemon.recorder import Recorder
from polecal.daemon.replay import BEGIN, replay
from polecal.daemon.service import Service
from polecal.daemon.sessions import SessionError

WIDTHS = (1280, 820)


@pytest.fixture
def look(browser):
    """Open a page, offline; check that it is whole, and give what a reader sees."""

    def open_it(path, width=1280, scheme="light"):
        context = browser.new_context(
            viewport={"width": width, "height": 900}, color_scheme=scheme, offline=True
        )
        page = context.new_page()
        troubles, asked = [], []
        page.on("console", lambda message: troubles.append(message.text))
        page.on("pageerror", lambda error: troubles.append(str(error)))
        page.on("request", lambda request: asked.append(request.url))
        page.goto(path.resolve().as_uri())
        decoded = page.evaluate(
            """Promise.all([...document.querySelectorAll('svg image, img')].map(
                 one => one.decode().then(() => one.getBoundingClientRect().width, why => String(why))))"""
        )
        assert troubles == []
        assert [url for url in asked if not url.startswith("data:")] == [path.resolve().as_uri()]
        assert all(isinstance(width, int | float) and width > 0 for width in decoded)
        seen = {
            "text": " ".join(page.inner_text("body").split()),
            "verdict": " ".join(page.inner_text(".verdict").split()),
            "colour": page.eval_on_selector(".verdict", "e => getComputedStyle(e).backgroundColor"),
            "verdict_bottom": page.eval_on_selector(".verdict", "e => e.getBoundingClientRect().bottom"),
            "wide": page.evaluate("document.documentElement.scrollWidth"),
            "ink": page.evaluate("getComputedStyle(document.body).color"),
            "paper": page.evaluate("getComputedStyle(document.body).backgroundColor"),
            "svg_ink": page.evaluate(
                "[...new Set([...document.querySelectorAll('svg text')].map(e => getComputedStyle(e).fill))]"
            ),
            "figures": page.locator("figure[role=img]").count(),
            "alts": page.eval_on_selector_all("figure", "all => all.map(e => e.getAttribute('aria-label'))"),
            "pictures": len(decoded),
        }
        context.close()
        return seen

    return open_it


def grey(colour):
    return sum(map(float, re.findall(r"[\d.]+", colour)[:3])) / 3


def is_red(colour):
    red, green, blue = map(float, re.findall(r"[\d.]+", colour)[:3])
    return red > 2 * max(green, blue)


@pytest.fixture(scope="module")
def copy(recorded, tmp_path_factory):
    """Give a folder with the recorded session in it, its capture a link, and not all of its passes."""

    def make(passes=6):
        folder = tmp_path_factory.mktemp("copy") / "state" / "sessions" / recorded.session.id
        left_out = shutil.ignore_patterns("*.mcap", "report.html")
        shutil.copytree(recorded.session.folder, folder, ignore=left_out)
        for path in sorted((folder / "passes").iterdir())[passes:]:
            path.unlink()
        (folder / "capture.mcap").symlink_to(recorded.session.capture)
        return folder

    return make


@pytest.fixture(scope="module")
def accepted(copy):
    folder = copy(passes=100)
    return folder, reporting.write(folder)


def content_of(folder):
    return yaml.safe_load((folder / "calibration.yaml").read_text())


def rewrite(path, change):
    told = yaml.safe_load(path.read_text())
    change(told)
    path.write_text(yaml.safe_dump(told, sort_keys=False))


def reconfigure(folder, change):
    """Change the configuration in a session's own file."""
    told = yaml.safe_load((folder / "session.yaml").read_text())
    config = yaml.safe_load(told["config"])
    change(config)
    told["config"] = yaml.safe_dump(config)
    (folder / "session.yaml").write_text(yaml.safe_dump(told))


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("width", WIDTHS)
def test_an_accepted_run_says_so_first_with_its_numbers(accepted, look, width, scheme):
    folder, path = accepted
    seen = look(path, width, scheme)
    laser = content_of(folder)["lasers"][0]
    assert seen["verdict"] == "✓ Accepted"
    assert not is_red(seen["colour"])
    assert seen["wide"] <= width
    assert seen["figures"] == 6
    assert seen["pictures"] >= 6
    assert all(len(alt) > 40 for alt in seen["alts"])
    for key, value in laser["estimate"].items():
        assert f"{value:.{4 if key.endswith('_m') else 3}f}".replace("-", "−") in seen["text"]
    assert f"{1000 * laser['cost_m']:.1f} mm" in seen["text"]
    assert f"{laser['returns']['pole']:,} returns on the pole" in seen["text"]
    assert re.search(r"its σ of 0\.\d+° is \d+ mm at 20 m", seen["text"])
    for title in ("Headings covered", "Rules of the verdict", "Cost against returns", "Residuals"):
        assert title in seen["text"]
    for title in ("What each pass weighs", "Navigation over time", "solution good", "At range"):
        assert title in seen["text"]
    assert abs(grey(seen["ink"]) - grey(seen["paper"])) > 150
    assert (grey(seen["paper"]) < 60) == (scheme == "dark")
    assert seen["ink"] in seen["svg_ink"]


def test_it_is_one_file_of_a_few_megabytes(accepted, tell):
    _, path = accepted
    size_mb = path.stat().st_size / 1e6
    tell(f"report of 170 s of driving: {size_mb:.1f} MB")
    assert size_mb < 4


def test_every_pass_is_listed_and_those_of_another_reflector_are_told(accepted, recorded, look):
    folder, path = accepted
    laser = content_of(folder)["lasers"][0]
    text = path.read_text()
    rows = re.findall(r'<tr class="(unused)?"><td>(\d+)</td>', text)
    assert [int(number) for _, number in rows] == [stored.id for _, stored in recorded.played.passes]
    assert sum(not unused for unused, _ in rows) == laser["passes"]


@pytest.fixture(scope="module")
def rejected(copy):
    """The same drive, judged by a bound that it cannot meet, by a replay beside it."""
    folder = copy()
    told = yaml.safe_load((folder / "session.yaml").read_text())
    config = yaml.safe_load(told["config"])
    config["accept"]["cost_m"] = 0.005
    config["lasers"][0]["hold"] = ["roll"]
    other = folder / "other.yaml"
    other.write_text(yaml.safe_dump(config))
    outcome = replay(folder / "capture.mcap", other, folder / "replay", None)
    assert not outcome.accepted
    reconfigure(folder, lambda config: config["accept"].update(cost_m=0.005))
    reconfigure(folder, lambda config: config["lasers"][0].update(hold=["roll"]))
    return outcome.out, reporting.write(outcome.out)


@pytest.mark.parametrize("width", WIDTHS)
def test_a_rejected_run_says_why_first_and_in_red(rejected, look, width):
    folder, path = rejected
    seen = look(path, width)
    assert seen["verdict"].startswith("✗ Rejected")
    for reason in content_of(folder)["lasers"][0]["verdict"]["reasons"]:
        assert reason in seen["verdict"]
    assert is_red(seen["colour"])
    assert seen["verdict_bottom"] < 600
    assert "Do not use these numbers." in seen["text"]
    assert "✗ no" in seen["text"]
    assert "the configuration asks for it (hold)" in seen["text"]


def empty(folder, config, *, seconds_ns=10**9):
    """A session whose capture has no pass in it."""
    (folder / "passes").mkdir(parents=True)
    meta = {
        "session": folder.name,
        "created": "2026-11-22T03:15:00+00:00",
        "config": configuration.dump(config),
    }
    (folder / "session.yaml").write_text(yaml.safe_dump(meta))
    with Recorder(folder / "capture.mcap", meta) as recorder:
        recorder.event(1, {"event": BEGIN})
        recorder.event(2, {"event": "state", "old": "idle", "new": "connecting", "why": "asked to start"})
        recorder.event(
            seconds_ns,
            {"event": "state", "old": "connecting", "new": "fault", "why": "front: its port is gone"},
        )
    return folder


def test_a_run_without_a_single_pass_says_so(settings, tmp_path, look):
    path = reporting.write(empty(tmp_path / "s1", settings()))
    seen = look(path)
    assert seen["verdict"].startswith("✗ Not a result no pass of the pole yet")
    assert "the run ended: front: its port is gone" in seen["verdict"]
    assert is_red(seen["colour"])
    assert "Drive past the pole from every side" in seen["text"]
    assert seen["figures"] == 2  # the rose, and what is to be driven


def test_passes_without_a_calibration_are_calibrated_for_the_page_and_never_accepted(copy, look):
    folder = copy()
    (folder / "calibration.yaml").unlink()
    reconfigure(folder, lambda config: config["accept"].update(cost_m=1.0))
    seen = look(reporting.write(folder))
    assert "Accepted" not in seen["verdict"]
    assert "the run ended without a calibration" in seen["verdict"]
    assert "these numbers were made for this report" in seen["text"]
    assert seen["figures"] == 7  # one more than an accepted one: what is still to be driven


def test_several_lasers_each_have_their_part(copy, look):
    folder = copy()
    for path in list((folder / "passes").iterdir()):
        shutil.copyfile(path, path.with_name(path.name.replace("front", "front-2")))

    def second(content):
        other = json.loads(json.dumps(content["lasers"][0])) | {"name": "front-2"}
        other["verdict"] = {"accepted": False, "reasons": ["slice 3 has no pass"]}
        content["lasers"].append(other)

    rewrite(folder / "calibration.yaml", second)
    reconfigure(
        folder,
        lambda config: config["lasers"].append(config["lasers"][0] | {"name": "front-2", "port": "/dev/2"}),
    )
    seen = look(reporting.write(folder))
    assert "front-2: slice 3 has no pass" in seen["verdict"]
    assert not seen["verdict"].startswith("✓")
    assert "Laser front: accepted" in seen["text"]
    assert "Laser front-2: not accepted" in seen["text"]
    assert seen["figures"] == 11


def test_what_an_older_version_wrote_is_enough(copy, look):
    """Passes of bare returns, a calibration of the interface's keys alone, and no capture any more."""
    folder = copy()
    for path in (folder / "passes").iterdir():
        with np.load(path) as file:
            names = ("range_m", "bearing_rad", "position_m", "rpy_rad", "kind", "pass_id", "t_ns", "place")
            known = {name: file[name] for name in names}
        np.savez_compressed(path, **known)
    (folder / "capture.mcap").unlink()

    def older(content):
        for laser in content["lasers"]:
            for key in ("improvement", "extras", "set_aside", "measured", "reflectors", "dropped"):
                laser.pop(key, None)

    rewrite(folder / "calibration.yaml", older)
    seen = look(reporting.write(folder))
    assert seen["verdict"] == "✓ Accepted"
    assert "There is no capture in the session's folder" in seen["text"]
    assert seen["figures"] == 5


def test_a_damaged_pass_is_left_out_and_named(copy, look):
    folder = copy()
    (folder / "passes" / "front-003.npz").write_bytes(b"PK\x03\x04 cut off")
    seen = look(reporting.write(folder))
    assert "front-003.npz could not be read, and is left out" in seen["text"]


def test_a_dropped_pass_is_told_and_by_whom(copy, look):
    folder = copy()
    choice = {"laser": "front", "number": 4, "drop": True, "by": "ann", "at": "2026-11-22T04:00:00+00:00"}
    rewrite(folder / "calibration.yaml", lambda content: content.update(choices=[choice]))
    assert "not used: dropped by ann" in look(reporting.write(folder))["text"]


def test_two_who_ask_for_one_report_write_it_one_after_the_other(tmp_path):
    folder, through = tmp_path, threading.Event()

    def other():
        with reporting._alone(folder):
            through.set()

    with reporting._alone(folder):
        asking = threading.Thread(target=other)
        asking.start()
        assert not through.wait(0.2)
    assert through.wait(10.0)
    asking.join()


def test_a_folder_that_is_no_session_is_refused_with_a_hint(tmp_path, settings):
    for told in (None, "- a list", "config: ["):
        if told is not None:
            (tmp_path / "session.yaml").write_text(told)
        with pytest.raises(SessionError) as caught:
            reporting.write(tmp_path)
        assert caught.value.hint
    (tmp_path / "session.yaml").write_text("session: s1\nconfig: 'lasers: []'\n")
    with pytest.raises(ConfigError):
        reporting.write(tmp_path)


def verb(*arguments):
    return subprocess.run(
        [sys.executable, "-W", "error", "-m", "polecal.daemon.field", *map(str, arguments)],
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )


def test_the_verb_writes_page_and_pictures_of_a_folder_without_a_daemon(rejected, tmp_path):
    folder, _ = rejected
    done = verb("report", f"{folder}/", "--out", tmp_path / "r.html", "--png", tmp_path / "png")
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.strip() == str(tmp_path / "r.html")
    assert (tmp_path / "r.html").read_text().startswith("<!doctype html>")
    names = {path.name for path in (tmp_path / "png").iterdir()}
    assert names == {
        *(f"front-{what}.png" for what in ("rose", "pole", "cost", "residuals", "influence")),
        "navigation.png",
    }
    assert all(path.read_bytes().startswith(b"\x89PNG") for path in (tmp_path / "png").iterdir())


def test_without_matplotlib_it_says_what_to_install(settings, tmp_path):
    folder = empty(tmp_path / "s1", settings())
    code = (
        "import sys, importlib.util as u; find = u.find_spec\n"
        "u.find_spec = lambda name, *more: None if name == 'matplotlib' else find(name, *more)\n"
        f"from polecal.daemon.field import main; sys.exit(main(['report', {str(folder) + '/'!r}]))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (1, "")
    assert "a report needs matplotlib, which is not installed" in done.stderr
    assert "pip install 'polecal[report]'" in done.stderr
    assert not (folder / "report.html").exists()


def test_the_daemon_writes_the_last_sessions_or_a_named_ones(settings, tmp_path):
    config = settings(state_dir=str(tmp_path))
    service = Service(config)
    with pytest.raises(SessionError, match="no session yet"):
        service.handle({"class": "REPORT"})
    for name in ("20261122T000000Z-a", "20261122T000001Z-b"):
        empty(tmp_path / "sessions" / name, config)
    answer = service.handle({"class": "REPORT", "session": None})
    assert answer == {
        "class": "REPORT",
        "session": "20261122T000001Z-b",
        "path": str(tmp_path / "sessions" / "20261122T000001Z-b" / "report.html"),
    }
    answer = service.handle({"class": "REPORT", "session": "20261122T000000Z-a"})
    assert "Not a result" in (tmp_path / "sessions" / "20261122T000000Z-a" / "report.html").read_text()
    for name in ("../sessions", "none", 3):
        with pytest.raises(SessionError, match="there is no session"):
            service.handle({"class": "REPORT", "session": name})
    (tmp_path / "sessions" / "20261122T000001Z-b" / "session.yaml").write_text("- broken")
    with pytest.raises(reporting.ReportError, match="is not what polecal writes") as caught:
        service.handle({"class": "REPORT"})
    assert "polecal-field replay" in caught.value.hint


def test_a_report_is_written_once_a_runs_capture_is_closed_and_a_fault_in_it_is_only_logged(
    settings, tmp_path
):
    config = settings(state_dir=str(tmp_path))
    good, bad = (empty(tmp_path / "sessions" / name, config) for name in ("a", "b"))
    (bad / "session.yaml").write_text("- broken")
    with capture_logs() as logs, Finaliser(tmp_path / "elsewhere") as finaliser:
        finaliser.add(good / "capture.mcap")
        finaliser.add(bad / "capture.mcap")
        finaliser.join()
    assert (good / "report.html").exists()
    assert not (bad / "report.html").exists()
    told = [(one["event"], one["log_level"]) for one in logs if "report" in one["event"]]
    assert told == [("report written", "info"), ("no report", "warning")]


def test_old_sessions_get_no_report_at_a_daemons_start(settings, tmp_path):
    old = empty(tmp_path / "sessions" / "a", settings())
    with Finaliser(tmp_path) as finaliser:
        finaliser.join()
    assert not (old / "report.html").exists()
