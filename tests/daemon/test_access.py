"""Who may do what at the control socket, as real processes of other users; and clients that mean no good."""

import grp
import json
import os
import socket
import subprocess
import sys
import tempfile
import threading
from pathlib import Path

import pytest
from structlog.testing import capture_logs

from polecal import PolecalError
from polecal.daemon import control
from polecal.daemon.control import LOOKING, REQUESTS, Client, ControlServer
from polecal.daemon.service import Service
from polecal.daemon.sessions import CALIBRATION

STRANGER = 65534
GROUP = "games"  # stands for polecal, which this machine may not have
OTHER = "tape"

# Imports first: another user may not read this Python.
ASK = """
import json, os, socket, sys
path, uid, gid, groups, lines = json.loads(sys.argv[1])
os.setgroups(groups)
os.setgid(gid)
os.setuid(uid)
with socket.socket(socket.AF_UNIX) as client:
    client.settimeout(10)
    client.connect(path)
    file = client.makefile("rb")
    file.readline()
    for line in lines:
        client.sendall(line.encode() + b"\\n")
        sys.stdout.buffer.write(file.readline())
"""


class Echo:
    """Answers anything, and knows what it was asked."""

    def __init__(self):
        self.asked = []

    def handle(self, request):
        self.asked.append(request["class"])
        return {"class": request["class"]}


@pytest.fixture
def handler():
    return Echo()


@pytest.fixture
def path(monkeypatch):
    """Where a socket may be that other users can reach."""
    monkeypatch.setattr(control, "GROUP", GROUP)
    with tempfile.TemporaryDirectory() as folder:
        os.chmod(folder, 0o755)
        yield Path(folder) / "control.sock"


@pytest.fixture
def server(path, handler):
    with ControlServer(path, handler, watch_s=0.01) as server:
        yield server


as_root = pytest.mark.skipif(os.geteuid() != 0, reason="only root can be somebody else")


def gid(name):
    return grp.getgrnam(name).gr_gid


def ask(path, requests, uid=STRANGER, group=STRANGER, groups=()):
    """Ask in a process of another user; give (answers, what it said if it could not)."""
    lines = [json.dumps({"class": name}) for name in requests]
    told = json.dumps([str(path), uid, group, list(groups), lines])
    done = subprocess.run(
        [sys.executable, "-c", ASK, told], capture_output=True, text=True, timeout=60, check=False
    )
    return [json.loads(line) for line in done.stdout.splitlines()], done.stderr


@as_root
def test_the_socket_belongs_to_the_group_and_nobody_else_gets_in(server, path):
    about = path.stat()
    assert (about.st_gid, about.st_mode & 0o777) == (gid(GROUP), 0o660)
    answers, trouble = ask(path, ["STATUS"])
    assert answers == []
    assert "PermissionError" in trouble


@as_root
@pytest.mark.parametrize("how", [{"group": GROUP}, {"groups": [OTHER, GROUP]}])
def test_a_member_of_the_group_may_do_everything(server, path, handler, how):
    ids = {"group": gid(how.get("group", OTHER)), "groups": [gid(name) for name in how.get("groups", [])]}
    asked = [name for name in REQUESTS if name != "WATCH"]
    answers, trouble = ask(path, asked, **ids)
    assert [answer["class"] for answer in answers] == asked, trouble
    assert handler.asked == asked


@as_root
def test_who_is_let_in_besides_may_look_and_nothing_more(server, path, handler):
    path.chmod(0o666)  # as an access list of the administrator's would
    answers, trouble = ask(path, REQUESTS, groups=[gid(OTHER)])
    said = dict(zip(REQUESTS, answers, strict=True))
    assert {name for name in REQUESTS if said[name]["class"] != "ERROR"} == LOOKING, trouble
    assert {"START", "STOP", "DROP", "KEEP", "REPORT"} == set(REQUESTS) - LOOKING
    for name in set(REQUESTS) - LOOKING:
        assert said[name]["code"] == 77
        assert f"uid {STRANGER} may look, but {name}" in said[name]["message"]
        assert f"usermod -aG {GROUP}" in said[name]["hint"]
    assert set(handler.asked) == LOOKING - {"WATCH"} | {"STATUS"}


@as_root
def test_the_daemons_own_user_may_do_everything_and_another_of_its_group_may_not(path, monkeypatch, handler):
    """A daemon that somebody runs by hand, where there is no group polecal: root plays its user here."""
    monkeypatch.setattr(control, "GROUP", "no-such-group")
    monkeypatch.setattr(os, "geteuid", lambda: STRANGER)
    with ControlServer(path, handler):
        path.chmod(0o666)
        assert ask(path, ["STOP"])[0] == [{"class": "STOP"}]
        assert ask(path, ["STOP"], uid=STRANGER - 1)[0][0]["code"] == 77


@as_root
def test_each_command_is_logged_with_the_uid_that_gave_it(server, path):
    path.chmod(0o666)
    with capture_logs() as logs:
        ask(path, ["STATUS", "STATUS", "STOP"])
        with Client(path) as client:
            client.request({"class": "START", "name": "yard", "force": True})
    asked = [(log["log_level"], log["uid"], log["request"]) for log in logs if log["event"] == "asked"]
    assert asked == [
        ("info", STRANGER, "STATUS"),
        ("debug", STRANGER, "STATUS"),  # who polls is heard of once
        ("info", STRANGER, "STOP"),
        ("info", 0, "START"),
    ]
    (refused,) = [log for log in logs if log["event"] == "refused"]
    assert (refused["log_level"], refused["uid"], refused["code"]) == ("warning", STRANGER, 77)
    assert "yard" in [log for log in logs if log["event"] == "asked"][-1]["with"]


# --- clients that mean no good


def connected(path):
    client = socket.socket(socket.AF_UNIX)
    client.settimeout(20.0)
    client.connect(str(path))
    return client


def test_ten_clients_of_which_three_are_bad_and_seven_are_served(server, path, monkeypatch):
    monkeypatch.setattr(control, "_SEND_S", 1.0)
    with connected(path) as deaf, connected(path) as mad, connected(path) as long_winded:
        deaf.sendall(b'{"class":"WATCH"}\n')  # and never reads what then comes 100 times a second

        def babble():
            with mad.makefile("rb") as answers:
                answers.readline()
                for _ in range(50):
                    mad.sendall(os.urandom(300).replace(b"\n", b"") + b"\n")
                    said.append(json.loads(answers.readline())["code"])

        def go_on():
            with long_winded.makefile("rb") as answers:
                answers.readline()
                long_winded.sendall(b"x" * 10_000_000 + b'\n{"class":"STOP"}\n')
                long_answers.extend(json.loads(answers.readline()) for _ in range(2))

        said, long_answers = [], []
        bad = [threading.Thread(target=babble), threading.Thread(target=go_on)]
        for thread in bad:
            thread.start()
        with_answers = 0
        for _ in range(5):
            clients = [Client(path) for _ in range(7)]
            for client in clients:
                with_answers += client.request({"class": "STATUS"})["class"] == "STATUS"
                client.close()
        assert with_answers == 35
        for thread in bad:
            thread.join(20.0)
        assert said == [2] * 50
        assert "more than 65536 bytes" in long_answers[0]["message"]
        assert long_answers[1] == {"class": "STOP"}


def test_a_client_that_never_reads_is_dropped_and_its_place_free(path, handler, monkeypatch, until):
    monkeypatch.setattr(control, "_SEND_S", 1.0)
    with ControlServer(path, handler, watch_s=0.0) as server, connected(path) as deaf:
        deaf.sendall(b'{"class":"WATCH"}\n')
        until(lambda: handler.asked)
        until(lambda: not server._clients)
        with Client(path) as client:
            assert client.request({"class": "STOP"}) == {"class": "STOP"}


def test_one_that_sends_and_never_reads_is_dropped_too(server, path, monkeypatch, until):
    monkeypatch.setattr(control, "_SEND_S", 1.0)
    with connected(path) as deaf:
        with pytest.raises(OSError, match=r"Broken pipe|reset"):
            deaf.sendall(b"nonsense\n" * 1_000_000)
        until(lambda: not server._clients)


# --- the state folder, which no name leads out of


@pytest.fixture
def state(tmp_path):
    """A state folder with one accepted session, links that lead out of it, and what they lead to."""
    outside = tmp_path / "outside"
    outside.mkdir()
    (outside / CALIBRATION).write_text("state: accepted\nlasers: []\nsecret: yes\n")
    (outside / "session.yaml").write_text("created: never\n")
    folder = tmp_path / "state" / "sessions"
    (folder / "20260101T000000Z-yard" / "passes").mkdir(parents=True)
    (folder / "20260101T000000Z-yard" / CALIBRATION).write_text("state: accepted\nlasers: []\n")
    (folder / "20260102T000000Z-folder").symlink_to(outside)
    (folder / "20260103T000000Z-file").mkdir()
    (folder / "20260103T000000Z-file" / CALIBRATION).symlink_to(outside / CALIBRATION)
    return tmp_path / "state"


LEADING_OUT = [
    "../outside",
    "../../outside",
    "20260101T000000Z-yard/../../../outside",
    "/absolute",
    "20260101T000000Z-yard\0",
    "20260102T000000Z-folder",
    "20260103T000000Z-file",
    "",
    ".",
    "..",
    "*",
    7,
    ["20260101T000000Z-yard"],
]


@pytest.mark.parametrize("name", LEADING_OUT)
def test_a_session_is_only_one_in_the_state_folder_whatever_is_asked_of_it(settings, state, tmp_path, name):
    service = Service(settings(state_dir=str(state)))
    if name == "/absolute":
        name = str(tmp_path / "outside")
    with pytest.raises(PolecalError, match=r"has no calibration|no session was accepted"):
        service.handle({"class": "RESULT", "session": name})
    before = sorted(path.name for path in (tmp_path / "outside").iterdir())
    for request in ("REPORT", "PASSES", "DROP", "KEEP"):
        with pytest.raises(PolecalError, match=r"there is no session|session.yaml: cannot be read"):
            service.handle({"class": request, "session": name, "pass": 1})
    with pytest.raises(PolecalError, match=r"there is no session|session.yaml: cannot be read"):
        service.handle({"class": "START", "continue": name})
    assert sorted(path.name for path in (tmp_path / "outside").iterdir()) == before
    last = service.handle({"class": "RESULT"})
    assert last == {"class": "RESULT", "state": "accepted", "lasers": []}
