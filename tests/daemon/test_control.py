"""Requests and answers over the control socket, also from clients that err, stall or leave."""

import json
import os
import socket
import stat
import threading
from pathlib import Path

import pytest

from polecal import __version__
from polecal.daemon import control
from polecal.daemon.config import ConfigError
from polecal.daemon.control import Client, ControlServer, NoDaemon, Refused
from polecal.drivers.errors import DeviceBusy, DeviceNotFound, DeviceNotPermitted


class Handler:
    """Answers by the book, and does what a request's keys tell it."""

    def __init__(self):
        self.asked = []
        self.may_answer = threading.Event()

    def handle(self, request):
        self.asked.append(request)
        match request["class"]:
            case "STATUS":
                return {"class": "STATUS", "state": "idle", "asked": len(self.asked)}
            case "START" if request.get("name") == "slow":
                self.may_answer.wait(10)
                return {"class": "STARTED", "session": "slow"}
            case "START":
                raise Refused("a session is running", "stop it", 75)
            case "STOP":
                raise RuntimeError("unforeseen")
            case "RESULT":
                return {"class": "RESULT", "cost_m": float("nan"), "covariance": ((1.0, float("inf")),)}
            case "REPORT":
                return {"class": "REPORT", "text": "x" * control.MAX_LINE_BYTES}
            case other:
                return {"class": other, "echo": request}


@pytest.fixture
def handler():
    return Handler()


@pytest.fixture
def path(tmp_path):
    return tmp_path / "run" / "control.sock"


@pytest.fixture
def server(path, handler):
    with ControlServer(path, handler, watch_s=0.01) as server:
        yield server


class Raw:
    """A client that sends what it likes."""

    def __init__(self, path):
        self.socket = socket.socket(socket.AF_UNIX)
        self.socket.settimeout(10)
        self.socket.connect(str(path))
        self.file = self.socket.makefile("rb")

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.file.close()
        self.socket.close()

    def send(self, data):
        self.socket.sendall(data)

    def read(self):
        return json.loads(self.file.readline())


def test_the_banner_comes_unasked(server, path):
    with Raw(path) as client:
        assert client.read() == {"class": "VERSION", "release": __version__, "proto": [1, 0]}


def test_each_request_gets_one_answer(server, path, handler):
    with Client(path) as client:
        assert client.request({"class": "STATUS"}) == {"class": "STATUS", "state": "idle", "asked": 1}
        assert client.request({"class": "DROP", "pass": 7})["echo"] == {"class": "DROP", "pass": 7}
        assert client.request({"class": "STATUS"})["asked"] == 3


@pytest.mark.parametrize(
    ("line", "says"),
    [
        (b"\n", "not JSON"),
        (b"status\n", "not JSON"),
        (b'{"class":"STATUS"\n', "not JSON"),
        (b'{"class":"STATUS","x":NaN}\n', "not JSON"),
        (b"\xff\xfe\n", "not JSON"),
        (b"[" * 20000 + b"\n", "not JSON"),
        (b"[]\n", "class"),
        (b'{"state":"idle"}\n', "class"),
        (b'{"class":7}\n', "class"),
        (b'{"class":"status"}\n', "no such class: status"),
        (b'{"class":"STATUS","x":"' + b"x" * 200_000 + b'"}\n', "more than 65536 bytes"),
    ],
)
def test_a_bad_request_gets_an_error_and_the_connection_stays(server, path, line, says):
    with Raw(path) as client:
        client.read()
        client.send(line)
        error = client.read()
        assert (error["class"], error["code"]) == ("ERROR", 2)
        assert says in error["message"]
        assert set(error) == {"class", "code", "message", "hint"}
        client.send(b'{"class":"STATUS"}\n')
        assert client.read()["class"] == "STATUS"


def test_requests_may_come_in_pieces_and_many_at_once(server, path):
    with Raw(path) as client:
        client.read()
        for byte in b'{"class":"STATUS"}\n':
            client.send(bytes([byte]))
        client.send(b'{"class":"STATUS"}\n{"class":"STATUS"}\n{"cl')
        assert [client.read()["asked"] for _ in range(3)] == [1, 2, 3]


def test_a_refusal_comes_through_with_code_and_hint(server, path):
    with Client(path) as client, pytest.raises(Refused, match="a session is running") as caught:
        client.request({"class": "START"})
    assert (caught.value.code, caught.value.hint) == (75, "stop it")


def test_a_fault_of_the_program_is_an_error_too_and_the_daemon_lives(server, path):
    with Client(path) as client:
        with pytest.raises(Refused, match="unforeseen") as caught:
            client.request({"class": "STOP"})
        assert caught.value.code == 1
        assert client.request({"class": "STATUS"})["class"] == "STATUS"


def test_what_is_not_finite_is_null(server, path):
    with Client(path) as client:
        answer = client.request({"class": "RESULT"})
    assert answer == {"class": "RESULT", "cost_m": None, "covariance": [[1.0, None]]}


def test_an_answer_too_long_for_a_line_is_an_error(server, path):
    with Client(path) as client, pytest.raises(Refused, match="too many"):
        client.request({"class": "REPORT"})


def test_watch_streams_until_something_else_is_asked(server, path, handler):
    with Raw(path) as client:
        client.read()
        client.send(b'{"class":"WATCH"}\n')
        assert [client.read()["class"] for _ in range(5)] == ["STATUS"] * 5
        client.send(b'{"class":"PASSES"}\n')
        while (answer := client.read())["class"] == "STATUS":
            pass
        assert answer["class"] == "PASSES"


def test_watch_ends_when_the_client_leaves(server, path):
    with Client(path) as client:
        assert [status["asked"] for status, _ in zip(client.watch(), range(3), strict=False)] == [1, 2, 3]
    for thread in [thread for thread in threading.enumerate() if thread.name == "client"]:
        thread.join(10)
        assert not thread.is_alive()


def test_one_slow_request_holds_nobody_up(server, path, handler):
    answers = []

    def ask():
        with Client(path) as client:
            answers.append(client.request({"class": "START", "name": "slow"}))

    asking = threading.Thread(target=ask)
    asking.start()
    with Client(path) as client:
        while not any(request["class"] == "START" for request in handler.asked):
            assert client.request({"class": "STATUS"})["class"] == "STATUS"
        assert client.request({"class": "STATUS"})["class"] == "STATUS"
        assert not answers
    handler.may_answer.set()
    asking.join(10)
    assert answers == [{"class": "STARTED", "session": "slow"}]


def test_a_daemon_that_does_not_answer_in_time_is_said_so(server, path, handler):
    with Client(path, timeout_s=0.05) as client, pytest.raises(Refused, match=r"within 0\.05 s"):
        client.request({"class": "START", "name": "slow"})
    handler.may_answer.set()


def test_the_socket_is_for_owner_and_group_only_whatever_the_umask(path, handler):
    old = os.umask(0)
    try:
        with ControlServer(path, handler):
            assert stat.S_IMODE(path.stat().st_mode) == 0o660
        os.umask(0o077)
        with ControlServer(path, handler):
            assert stat.S_IMODE(path.stat().st_mode) == 0o660
    finally:
        os.umask(old)


def test_a_stale_socket_is_replaced_and_ones_own_taken_away(path, handler):
    path.parent.mkdir()
    with socket.socket(socket.AF_UNIX) as dead:
        dead.bind(str(path))
    with ControlServer(path, handler), Client(path) as client:
        assert client.request({"class": "STATUS"})["class"] == "STATUS"
    assert not path.exists()


def test_a_second_daemon_is_refused_and_the_first_goes_on(server, path, handler):
    with pytest.raises(Refused, match="another polecald") as caught:
        ControlServer(path, handler).start()
    assert caught.value.code == 75
    with Client(path) as client:
        assert client.request({"class": "STATUS"})["class"] == "STATUS"


def test_a_file_that_is_no_socket_is_left_alone(path, handler):
    path.parent.mkdir()
    path.write_text("mine")
    with pytest.raises(Refused, match="no socket") as caught:
        ControlServer(path, handler).start()
    assert caught.value.code == 78
    assert path.read_text() == "mine"


def test_a_path_too_long_for_a_socket_is_said_so(tmp_path, handler):
    with pytest.raises(Refused, match="too long") as caught:
        ControlServer(tmp_path / ("x" * 120) / "control.sock", handler).start()
    assert "runtime_dir" in caught.value.hint


def test_no_daemon_is_said_with_how_to_start_it(path):
    path.parent.mkdir()
    for _ in range(2):  # no socket at all, then one that nobody serves
        with pytest.raises(NoDaemon, match=str(path)) as caught:
            Client(path)
        assert caught.value.code == 3
        assert "polecald --config" in caught.value.hint
        if not path.exists():
            with socket.socket(socket.AF_UNIX) as dead:
                dead.bind(str(path))


def test_a_daemon_that_goes_away_is_noticed(path, handler):
    server = ControlServer(path, handler, watch_s=60)
    server.start()
    with Client(path) as client:
        watching = client.watch()
        next(watching)
        server.close()
        with pytest.raises(NoDaemon, match="went away"):
            next(watching)
        with pytest.raises(NoDaemon, match="went away"):
            client.request({"class": "STATUS"})


def test_who_may_not_is_told_of_the_group(path, monkeypatch):
    def refuse(*_):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(socket.socket, "connect", refuse)
    with pytest.raises(Refused, match="may not talk") as caught:
        Client(path)
    assert caught.value.code == 77
    assert "group polecal" in caught.value.hint


def test_another_protocol_is_refused(path):
    path.parent.mkdir()
    with socket.socket(socket.AF_UNIX) as other:
        other.bind(str(path))
        other.listen()

        def serve():
            for line in (b'{"class":"VERSION","release":"9","proto":[2,0]}\n', b"SSH-2.0\n", b"7\n"):
                connection, _ = other.accept()
                with connection:
                    connection.sendall(line)

        serving = threading.Thread(target=serve)
        serving.start()
        for says in (r"protocol \[2, 0\]", "not a polecald's reply", "not a polecald's reply"):
            with pytest.raises(Refused, match=says):
                Client(path)
        serving.join(10)


def test_one_client_too_many_is_refused_and_a_place_is_free_again_after(server, path):
    clients = [Client(path) for _ in range(32)]
    with pytest.raises(Refused, match="32 clients") as caught:
        Client(path)
    assert caught.value.code == 75
    leaving = [thread for thread in threading.enumerate() if thread.name == "client"]
    for client in clients:
        client.close()
    for thread in leaving:
        thread.join(10)
    with Client(path) as client:
        assert client.request({"class": "STATUS"})["class"] == "STATUS"


@pytest.mark.parametrize(
    ("error", "code"),
    [
        (Refused("x", code=5), 5),
        (NoDaemon("x"), 3),
        (ConfigError("x", []), 78),
        (DeviceNotFound("x"), 4),
        (DeviceBusy("x"), 4),
        (DeviceNotPermitted("x"), 77),
        (control.PolecalError("x"), 1),
    ],
)
def test_each_error_has_its_exit_code(error, code):
    assert control.code_of(error) == code


def test_the_interface_names_every_request(protocol):
    page = (Path(protocol).parent / "interface.md").read_text()
    requests = page.split("Requests: ")[1].split("A bad request")[0]
    assert all(
        f"{name}" in requests for name in control.REQUESTS if name not in ("SESSIONS", "REPORT", "ROUTE")
    )
