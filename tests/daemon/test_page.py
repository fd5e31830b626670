"""The page for a tablet: what it serves, whom it turns away, and what a browser makes of it."""

import base64
import hashlib
import http.client
import json
import os
import re
import shutil
import signal
import socket
import threading
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from structlog.testing import capture_logs

from polecal.calib import Mount
from polecal.daemon import page
from polecal.daemon.clouds import Clouds
from polecal.daemon.config import ConfigError, loads
from polecal.daemon.control import Client, Refused
from polecal.daemon.page import Onlooker, Page
from polecal.daemon.service import Service

SIZES = [(1024, 768), (768, 1024)]
HTML = Path(page.__file__).with_name("page.html").read_text(encoding="utf-8")


def free_port():
    with socket.create_server(("127.0.0.1", 0)) as probe:
        return probe.getsockname()[1]


@pytest.fixture
def serve(tmp_path, until):
    """Serve a page on loopback, of a function that answers; gives its port."""

    @contextmanager
    def started(ask, state_dir=tmp_path):
        port = free_port()
        with Page(f"127.0.0.1:{port}", ask, state_dir):
            until(lambda: reachable(port))
            yield port

    return started


def reachable(port):
    try:
        socket.create_connection(("127.0.0.1", port), timeout=1.0).close()
    except OSError:
        return False
    return True


def get(port, path="/", method="GET", **headers):
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=10.0)
    connection.request(method, path, headers=headers)
    answer = connection.getresponse()
    body = answer.read()
    connection.close()
    return answer, body


def raw(port, sent):
    """What comes back for some bytes."""
    with socket.create_connection(("127.0.0.1", port), timeout=10.0) as connection:
        connection.sendall(sent)
        answer = b""
        while data := connection.recv(65536):
            answer += data
    return answer


IDLE = {
    "class": "STATUS",
    "state": "idle",
    "session": None,
    "since_s": 0.0,
    "devices": [],
    "lasers": [],
    "next": "polecal-field start",
    "notes": [],
}


def telling(status):
    """What a service answers that stands as STATUS says, and has no passes."""
    nothing = {"class": "PASSES", "passes": [], "next": None}
    return lambda request: status if request["class"] == "STATUS" else nothing


idle = telling(IDLE)


# --- what is served


def test_the_page_may_load_and_run_nothing_but_what_is_in_its_file(serve):
    with serve(idle) as port:
        answer, body = get(port)
    assert answer.status == 200
    assert body.decode() == HTML
    policy = answer.getheader("Content-Security-Policy")
    assert "default-src 'none'" in policy
    for kind in ("script", "style"):
        (inside,) = re.findall(rf"<{kind}>(.*?)</{kind}>", HTML, re.DOTALL)
        digest = base64.b64encode(hashlib.sha256(inside.encode()).digest()).decode()
        assert f"{kind}-src 'sha256-{digest}'" in policy
    assert re.findall(r"(?:src|href)=\"(?!data:)", HTML) == []
    assert re.findall(r"https?://(?!www\.w3\.org/2000/svg)", HTML) == []


def test_its_script_is_of_a_language_that_an_old_tablet_speaks():
    (script,) = re.findall(r"<script>(.*?)</script>", HTML, re.DOTALL)
    code = re.sub(r"//.*|\"[^\"\n]*\"", "", script)
    newer = r"=>|`|\.\.\.|\?\.|\?\?|\b(?:let|const|class|async|await|fetch|Promise)\b"
    assert re.findall(newer, code) == []  # than ES5 of 2011
    assert len(code) > 5000


def test_no_other_page_may_read_or_frame_it(serve):
    with serve(idle) as port:
        for path in ("/", "/status", "/clouds", "/nothing"):
            answer, _ = get(port, path, Origin="http://elsewhere.example")
            named = {name.lower() for name, _ in answer.getheaders()}
            assert not {name for name in named if name.startswith("access-control-")}
            assert "frame-ancestors 'none'" in answer.getheader("Content-Security-Policy")
            assert answer.getheader("Cross-Origin-Resource-Policy") == "same-origin"
            assert answer.getheader("X-Content-Type-Options") == "nosniff"


def test_status_is_what_the_control_protocol_says(settings, tmp_path, serve):
    service = Service(settings(state_dir=str(tmp_path)))
    with serve(service.handle) as port:
        answer, body = get(port, "/status")
        clouds = json.loads(get(port, "/clouds")[1])
    assert answer.getheader("Content-Type") == "application/json"
    assert json.loads(body) == service.handle({"class": "STATUS"})
    assert clouds == {"class": "CLOUDS", "session": None, "lasers": []}


def test_however_many_look_the_service_is_asked_once_in_a_while(serve, monkeypatch):
    asked = []
    monkeypatch.setattr(page, "_FRESH_S", 3600.0)
    with serve(lambda request: asked.append(request) or IDLE) as port:
        assert {get(port, "/status")[1] for _ in range(20)} == {page.encode(IDLE)}
    assert asked == [{"class": "STATUS"}]


def test_what_is_shown_is_no_older_than_that(tmp_path, monkeypatch):
    monkeypatch.setattr(page, "_FRESH_S", 0.0)
    states = iter(("idle", "connecting"))
    onlooker = Onlooker(lambda _: IDLE | {"state": next(states)}, tmp_path)
    assert [json.loads(onlooker.status())["state"] for _ in range(2)] == ["idle", "connecting"]


def test_a_refusal_of_the_service_is_told_with_its_hint(serve):
    def refuse(_):
        raise Refused("the disk is on fire", "use water")

    with serve(refuse) as port:
        answer, body = get(port, "/status")
    assert answer.status == 503
    assert json.loads(body)["message"] == "the disk is on fire"
    assert json.loads(body)["hint"] == "use water"


# --- who is turned away


@pytest.mark.parametrize("method", ["POST", "PUT", "DELETE", "PATCH", "OPTIONS", "TRACE", "BREW"])
@pytest.mark.parametrize("path", ["/", "/status"])
def test_whatever_would_change_something_is_not_allowed(serve, method, path):
    asked = []
    with serve(lambda request: asked.append(request) or IDLE) as port:
        answer, _ = get(port, path, method)
    assert (answer.status, answer.getheader("Allow")) == (405, "GET")
    assert asked == []


@pytest.mark.parametrize("path", ["/page.py", "/../config.py", "//etc/passwd", "/status/", "/%2e%2e/", "*"])
def test_there_is_nothing_else(serve, path):
    with serve(idle) as port:
        assert raw(port, f"GET {path} HTTP/1.0\r\nHost: localhost\r\n\r\n".encode()).startswith(
            b"HTTP/1.0 404 "
        )


@pytest.mark.parametrize(
    "host", ["evil.example", "evil.example:8291", "localhost.evil.example", "127.0.0.1.evil.example", ""]
)
def test_a_name_that_was_turned_to_this_address_gets_nothing(serve, host):
    with serve(idle) as port:
        answer, body = get(port, "/status", Host=host)
    assert answer.status == 421
    assert b"idle" not in body


def test_a_request_that_names_no_host_or_two_gets_nothing(serve):
    with serve(idle) as port:
        for head in (b"", b"Host: localhost\r\nHost: evil.example\r\n"):
            assert raw(port, b"GET /status HTTP/1.1\r\n" + head + b"\r\n").startswith(b"HTTP/1.0 421 ")


@pytest.mark.parametrize(
    "host", ["127.0.0.1", "localhost:8000", "LOCALHOST", "192.168.8.1:8291", "[::1]:8291", "[fe80::1]"]
)
def test_who_asks_by_number_is_answered_also_through_a_tunnel(serve, host):
    with serve(idle) as port:
        assert get(port, "/status", Host=host)[0].status == 200


@pytest.mark.parametrize(
    "sent",
    [
        b"\x16\x03\x01\x02\x00\x01\x00\r\n\r\n",
        b"GET / HTTP/9.9\r\n\r\n",
        b"GET /" + b"a" * 70000 + b" HTTP/1.0\r\n\r\n",
        b"GET / HTTP/1.0\r\n" + b"X: y\r\n" * 200 + b"\r\n",
        b"\r\n",
    ],
)
def test_what_is_no_request_is_refused_and_the_next_one_served(serve, sent):
    with serve(idle) as port:
        try:
            answer = raw(port, sent)
        except ConnectionResetError:
            answer = b""
        assert b"STATUS" not in answer
        assert b" 200 " not in answer
        assert get(port, "/status")[0].status == 200


def test_clients_are_few_and_none_stays_for_long(serve, monkeypatch, until):
    monkeypatch.setattr(page, "_MAX_CLIENTS", 3)
    monkeypatch.setattr(page, "_LONGEST_S", 0.4)
    with serve(idle) as port:
        lasting = [socket.create_connection(("127.0.0.1", port), timeout=10.0) for _ in range(3)]
        for each in lasting:
            each.sendall(b"GET /st")
        until(lambda: sum(thread.name.startswith("Thread-") for thread in threading.enumerate()) >= 3)
        with pytest.raises((ConnectionError, http.client.HTTPException)):
            get(port, "/status")
        for each in lasting:  # ends them, as they have been there for too long
            assert each.recv(4096) == b""
            each.close()
        assert until(lambda: answered(port)) == 200


def answered(port):
    try:
        return get(port, "/status")[0].status
    except (ConnectionError, http.client.HTTPException):
        return None


# --- where it is served


def test_an_address_that_is_taken_is_told_once_and_waited_for(monkeypatch, tmp_path, until):
    monkeypatch.setattr(page, "_AGAIN_S", 0.02)
    with socket.create_server(("127.0.0.1", 0)) as other, capture_logs() as logs:
        port = other.getsockname()[1]
        with Page(f"127.0.0.1:{port}", idle, tmp_path):
            until(lambda: logs)
            other.close()
            assert until(lambda: answered(port)) == 200
    assert [entry["event"] for entry in logs] == ["no page yet", "page", "page asked"]
    assert "page.conf" in logs[0]["hint"]


def test_it_can_be_ended_while_its_address_is_not_there(monkeypatch, tmp_path, until):
    with capture_logs() as logs, Page("192.0.2.1:8291", idle, tmp_path):
        until(lambda: logs)
    assert threading.active_count() == len([each for each in threading.enumerate() if each.name != "page"])


@pytest.mark.parametrize(
    "listen",
    ["127.0.0.1", "localhost:8291", ":8291", "127.0.0.1:0", "127.0.0.1:70000", "::1:8291", "[::1]", 1],
)
def test_an_address_that_cannot_be_meant_is_a_fault(listen, settings):
    with pytest.raises(ConfigError, match=r"page\.listen: must be"):
        settings(page={"listen": listen})


@pytest.mark.parametrize("listen", ["127.0.0.1:8291", "0.0.0.0:80", "[::1]:8291"])
def test_an_address_is_taken_as_it_is(listen, settings):
    assert settings(page={"listen": listen}).page.listen == listen


def test_another_address_takes_a_restart(settings, tmp_path):
    service = Service(settings(state_dir=str(tmp_path)))
    with pytest.raises(Refused, match="page cannot change while the daemon runs"):
        service.reload(settings(state_dir=str(tmp_path), page={"listen": "127.0.0.1:8291"}))


def listening(pid):
    """The TCP ports that a process listens at."""
    inodes = set()
    for each in Path(f"/proc/{pid}/fd").iterdir():
        inodes |= set(re.findall(r"socket:\[(\d+)\]", os.readlink(each)))
    ports = []
    for table in ("tcp", "tcp6"):
        for line in Path(f"/proc/{pid}/net/{table}").read_text().splitlines()[1:]:
            fields = line.split()
            if fields[3] == "0A" and fields[9] in inodes:
                ports.append(int(fields[1].rpartition(":")[2], 16))
    return ports


def test_a_daemon_listens_nowhere_unless_asked_to(bench, running, until):
    with running(bench) as daemon:
        assert listening(daemon.pid) == []
    port = free_port()
    bench.content["page"] = {"listen": f"127.0.0.1:{port}"}
    with running(bench) as daemon:
        assert until(lambda: listening(daemon.pid)) == [port]
        told = json.loads(get(port, "/status")[1])
        with Client(bench.config.socket) as client:
            assert told == client.request({"class": "STATUS"})
    assert not reachable(port)


# --- the pole's clouds


@pytest.fixture(scope="module")
def driven(recorded):
    """A drive's session, as a service that is still in it would tell of it."""
    pipeline = recorded.played.pipeline

    def ask(request):
        if request["class"] == "PASSES":
            rows = pipeline.passes()
            first = request["from"]
            last = first + 3  # pages as the control protocol has, only shorter
            return {"passes": rows[first:last], "next": last if last < len(rows) else None}
        devices = [{"name": name, "state": "streaming"} | pipeline.device(name) for name in ("front", "span")]
        return {"class": "STATUS", "session": recorded.session.id, "since_s": 81.2, "devices": devices} | (
            pipeline.status()
        )

    return ask


@pytest.fixture(scope="module")
def state_dir(recorded):
    return recorded.session.folder.parents[1]


def test_clouds_are_of_the_passes_in_the_estimate_and_the_found_one_is_the_smaller(driven, state_dir, tell):
    onlooker = Onlooker(driven, state_dir)
    (laser,) = json.loads(onlooker.clouds())["lasers"]
    rows = driven({"class": "PASSES", "from": 0})["passes"]
    rows = [row for first in range(0, 99, 3) for row in driven({"class": "PASSES", "from": first})["passes"]]
    used = {row["pass"]: row for row in rows if row["use"] == "used"}
    assert [one["pass"] for one in laser["passes"]] == sorted(used)
    spread_m = {}
    for which in ("before", "after"):
        every = np.concatenate([one[which] for one in laser["passes"]])
        spread_m[which] = np.sqrt(every[:, :2].var(axis=0).sum())
        assert len(every) <= 2400
    tell(f"the pole's cloud, {spread_m['before']:.3f} m before and {spread_m['after']:.3f} m after")
    assert spread_m["after"] < 0.5 * spread_m["before"]
    for one in laser["passes"]:
        apart_deg = (one["heading_deg"] - used[one["pass"]]["heading_deg"] + 180) % 360 - 180
        assert abs(apart_deg) < used[one["pass"]]["span_deg"] / 2 + 10


def test_each_files_pole_returns_are_read_once(recorded, driven, monkeypatch, tmp_path):
    shutil.copytree(recorded.session.folder / "passes", tmp_path / "passes")
    status = driven({"class": "STATUS"})["lasers"][0]
    mounts = Mount(**status["measured"]), Mount(**status["estimate"])
    clouds = Clouds(tmp_path, "front")
    first = clouds.show([1, 2], *mounts)
    shutil.rmtree(tmp_path / "passes")
    assert clouds.show([1, 2], *mounts) == first


def test_a_pass_that_is_not_written_yet_or_is_damaged_is_left_out(recorded, driven, tmp_path):
    shutil.copytree(recorded.session.folder / "passes", tmp_path / "passes")
    (tmp_path / "passes" / "front-002.npz").write_bytes(b"PK\x03\x04 and then the power failed")
    status = driven({"class": "STATUS"})["lasers"][0]
    mounts = Mount(**status["measured"]), Mount(**status["estimate"])
    shown = Clouds(tmp_path, "front").show([1, 2, 998], *mounts)
    assert [one["pass"] for one in shown] == [1]
    whole = (tmp_path / "passes" / "front-001.npz").read_bytes()
    rng = np.random.default_rng(1)
    for _ in range(40):
        damaged = np.frombuffer(whole, dtype=np.uint8).copy()
        damaged[rng.integers(0, len(damaged), 2000)] ^= 0x55
        (tmp_path / "passes" / "front-001.npz").write_bytes(damaged.tobytes())
        Clouds(tmp_path, "front").show([1], *mounts)
    assert Clouds(tmp_path, "front").show([2], *mounts) == []


# --- in a browser


@pytest.fixture
def look(browser):
    """Open the page as a tablet of some size does; check at the end that nothing was wrong with it."""
    sync = pytest.importorskip("playwright.sync_api")
    contexts = []

    def open_it(port, size=SIZES[0], troubles_expected=False):
        context = browser.new_context(viewport={"width": size[0], "height": size[1]})
        shown = context.new_page()
        troubles, asked = [], []
        shown.on("console", lambda message: troubles.append(message.text))
        shown.on("pageerror", lambda error: troubles.append(str(error)))
        shown.on("request", lambda request: asked.append(request.url))
        contexts.append((context, port, troubles, asked, troubles_expected))
        shown.goto(f"http://127.0.0.1:{port}/")
        sync.expect(shown.locator("#state")).not_to_have_text("…", timeout=15000)
        return shown

    yield open_it
    for context, port, troubles, asked, expected in contexts:
        context.close()
        assert expected or troubles == []
        others = [url for url in asked if not url.startswith((f"http://127.0.0.1:{port}/", "data:"))]
        assert others == []


CONTRASTS = """() => {
  const rgb = text => text.match(/[\\d.]+/g).map(Number);
  const light = c => c.slice(0, 3).map(v => v / 255)
    .map(v => v <= .03928 ? v / 12.92 : ((v + .055) / 1.055) ** 2.4)
    .reduce((sum, v, i) => sum + v * [.2126, .7152, .0722][i], 0);
  const behind = e => { for (; e; e = e.parentElement) {
    const c = rgb(getComputedStyle(e).backgroundColor);
    if (c.length < 4 || c[3] > 0) return c; } return [255, 255, 255]; };
  return [...document.querySelectorAll('body *')]
    .filter(e => !e.closest('svg, script') && [...e.childNodes].some(n => n.nodeType === 3 && n.data.trim())
                 && e.getBoundingClientRect().width > 0)
    .map(e => { const a = light(rgb(getComputedStyle(e).color)), b = light(behind(e));
                return [(Math.max(a, b) + .05) / (Math.min(a, b) + .05), e.textContent.slice(0, 40)]; });
}"""
INKED = """all => all.map(canvas => {
  const data = canvas.getContext('2d').getImageData(0, 0, canvas.width, canvas.height).data;
  let inked = 0;
  for (let i = 0; i < data.length; i += 4) inked += data[i] + data[i + 1] + data[i + 2] < 765;
  return inked;
})"""


@pytest.fixture
def driven_port(serve, driven, state_dir):
    with serve(driven, state_dir) as port:
        yield port


@pytest.mark.parametrize("size", SIZES, ids=lambda size: "×".join(map(str, size)))
def test_a_drive_is_shown_as_status_tells_it(driven_port, look, driven, size, tmp_path):
    status = driven({"class": "STATUS"})
    (laser,) = status["lasers"]
    shown = look(driven_port, size)
    shown.wait_for_selector("body[data-clouds]")
    shown.screenshot(path=tmp_path / "page.png", full_page=True)
    done = sum(part["done"] for part in laser["coverage"])
    assert done > 0
    assert shown.locator(".slice.done").count() == done
    assert shown.locator(".slice").count() == len(laser["coverage"])
    assert shown.inner_text("#state") == status["state"]
    text = " ".join(shown.inner_text("body").split())
    assert f"{laser['passes']} passes, {done} of 12" in text
    for reason in laser["verdict"]["reasons"]:
        assert reason in shown.inner_text(".verdict")
    assert ("✓ accepted" in text) is laser["verdict"]["accepted"]
    for key, digits in (("x_m", 3), ("yaw_deg", 2)):
        assert f"{laser['estimate'][key]:.{digits}f}".replace("-", "−") in text
    assert status["next"] in text
    assert shown.evaluate("document.documentElement.scrollWidth") <= size[0]
    inked = shown.eval_on_selector_all("canvas", INKED)
    assert len(inked) == 4
    assert min(inked) > 500
    assert inked[1] < inked[0]  # from above, the found cloud is the smaller one
    assert min(shown.evaluate(CONTRASTS)) >= [7.0]  # WCAG's AAA


def test_what_a_device_says_is_text_and_no_markup(serve, look):
    evil = "<img src=x onerror=document.title='evil'><b>bold</b>"
    device = {
        "name": evil,
        "kind": "sick_lms",
        "port": "/dev/x",
        "state": "lost",
        "problem": evil,
        "hint": evil,
    }
    status = IDLE | {"devices": [device], "notes": [evil], "next": evil, "session": evil}
    with serve(telling(status)) as port:
        shown = look(port)
        assert shown.inner_text("#devices").count(evil) == 3
        assert shown.locator("main img, main li b").count() == 0
        assert shown.title() == "idle – polecal"
        shown.context.close()


def test_a_verdict_is_told_in_words_and_colours(serve, look, driven):
    met, not_met = (True, []), (False, ["√c is 0.2 m, over 0.05 m"])
    cases = {
        "accepted": [(met, "✓ accepted", "rgb(0, 96, 15)")],
        "rejected": [
            (not_met, "✗ rejected", "rgba(0, 0, 0, 0)"),
            (met, "its criteria are met; the session is rejected", "rgba(0, 0, 0, 0)"),
        ],
        "collecting": [(not_met, "not yet", "rgba(0, 0, 0, 0)")],
    }
    for state, lasers in cases.items():
        status = json.loads(json.dumps(driven({"class": "STATUS"}))) | {"state": state}
        status["lasers"] = [
            status["lasers"][0] | {"name": str(name), "verdict": {"accepted": accepted, "reasons": reasons}}
            for name, ((accepted, reasons), _, _) in enumerate(lasers)
        ]
        with serve(telling(status)) as port:
            shown = look(port)
            for verdict, ((_, reasons), words, colour) in zip(
                shown.locator(".verdict").all(), lasers, strict=True
            ):
                assert verdict.inner_text().split("\n")[0] == words
                assert all(reason in verdict.inner_text() for reason in reasons)
                assert verdict.evaluate("e => getComputedStyle(e).backgroundColor") == colour
            assert not any(
                canvas.is_visible() for canvas in shown.locator("canvas").all()
            )  # no pass, no cloud
            shown.context.close()


def test_a_daemon_that_goes_away_is_missed_and_found_again(bench, running, look):
    port = free_port()
    bench.content["page"] = {"listen": f"127.0.0.1:{port}"}
    with running(bench) as daemon:
        shown = look(port, troubles_expected=True)  # the browser itself tells of each lost request
        assert shown.inner_text("#state") == "idle"
        assert not shown.is_visible("#lost")
        daemon.send_signal(signal.SIGKILL)
        shown.wait_for_selector("#lost", state="visible", timeout=15000)
        assert re.match(
            r"No answer from the daemon since \d\d:\d\d:\d\d\. What is shown is old",
            shown.inner_text("#lost"),
        )
        assert shown.title() == "lost – polecal"
    with running(bench):
        shown.wait_for_selector("#lost", state="hidden", timeout=15000)
        assert shown.title() == "idle – polecal"
        assert shown.get_attribute("#shown", "class") == ""


def test_a_session_is_followed_live_from_its_start(bench, running, look):
    port = free_port()
    bench.content["page"] = {"listen": f"127.0.0.1:{port}"}
    with running(bench), Client(bench.config.socket) as client:
        shown = look(port)
        session = client.request({"class": "START"})["session"]
        shown.get_by_text(session).wait_for(timeout=15000)
        shown.get_by_text("● streaming").nth(1).wait_for(timeout=15000)
        assert shown.locator(".slice").count() == 12
        shown.locator("body[data-clouds='1']").wait_for(timeout=60000)  # of the pass that was just closed
        assert min(shown.eval_on_selector_all("canvas", INKED)) > 100
        client.request({"class": "STOP"})
        shown.get_by_text("idle", exact=True).wait_for(timeout=15000)
        shown.context.close()


def test_clouds_that_take_long_are_no_sign_of_a_lost_daemon(serve, look, driven):
    asked, done = threading.Semaphore(0), threading.Event()

    def slow(request):
        if request["class"] == "PASSES":
            asked.release()
            done.wait(30.0)
        return driven(request)

    with serve(slow) as port:
        shown = look(port)
        assert asked.acquire(timeout=15.0)
        shown.wait_for_timeout(5500)  # longer than the page waits for an answer
        assert not shown.is_visible("#lost")
        assert shown.get_attribute("body", "data-clouds") is None
        done.set()
        shown.wait_for_selector("body[data-clouds]", timeout=20000)
        shown.context.close()


def test_a_page_that_cannot_show_what_it_is_told_says_so(serve, look):
    with serve(telling(IDLE | {"lasers": [{"name": "front"}]})) as port:
        shown = look(port, troubles_expected=True)
        shown.wait_for_selector("#lost", state="visible", timeout=15000)
        assert "cannot show what the daemon says" in shown.inner_text("#lost")


def test_its_configuration_key_is_off_by_default():
    assert (
        loads(
            "lasers: [{port: a, mount: {x_m: 0, y_m: 0, z_m: 0, roll_deg: 0, pitch_deg: 0, yaw_deg: 0}}]\n"
            "navigation: {port: b}\npole: {radius_m: 0.04, height_m: 2.4}"
        ).page.listen
        is None
    )
