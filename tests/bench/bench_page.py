"""The page's cost: what tablets that ask once a second take of a core, with 19 passes to show."""

import http.client
import socket
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from polecal.calib import KEYS
from polecal.daemon import config as configuration
from polecal.daemon import log, sessions
from polecal.daemon.config import SPAN, dump
from polecal.daemon.page import Page
from polecal.daemon.pipeline import Pipeline
from polecal.drivers.emulated.virtual import Rig, play
from polecal.drivers.emulated.world import HAND_MEASURED

HEADINGS = ("request", "bytes", "CPU ms", "% of a core by 3 tablets")

_TABLETS = 3
_TIMES = 300
_SECONDS = 170.0
_MOUNT = {key: getattr(HAND_MEASURED, key) for key in KEYS}


def rows() -> Iterator[tuple[object, ...]]:
    log.configure()  # as the daemon does: what is asked is not written
    with tempfile.TemporaryDirectory() as folder, socket.create_server(("127.0.0.1", 0)) as probe:
        port = probe.getsockname()[1]
        probe.close()
        ask = _driven(Path(folder))
        with Page(f"127.0.0.1:{port}", ask, Path(folder)):
            _reachable(port)
            _get(port, "/clouds")  # from the passes' files, once a pass
            for path in ("/status", "/clouds"):
                size = _get(port, path)
                began_s = time.process_time()
                for _ in range(_TIMES):
                    _get(port, path)
                each_s = (time.process_time() - began_s) / _TIMES  # the client's part is in it
                share = 100 * each_s * _TABLETS if path == "/status" else "once a pass"
                yield path, str(size), 1e3 * each_s, share
        began_s = time.process_time()
        ask({"class": "STATUS"})
        yield "STATUS itself, once a second", "", 1e3 * (time.process_time() - began_s), "for all of them"


def _driven(state_dir: Path) -> Any:
    """Drive the demonstration's forward passes; give what answers as a service in it would."""
    content = {
        "state_dir": str(state_dir),
        "lasers": [{"port": "/dev/lms", "mount": _MOUNT}],
        "navigation": {"port": "/dev/span"},
        "pole": {"radius_m": 0.04, "height_m": 2.4},
    }
    config = configuration.loads(dump(configuration.Config.model_validate(content, strict=False)))
    session = sessions.create(state_dir, config, "bench")
    pipeline = Pipeline(config, session=session.id, on_pass=session.write_pass)
    pipeline.begin(0)
    rig = Rig.demo(1, 0)
    rig.stream(0)
    for name, t_ns, data in play(
        {"front": rig.laser, SPAN: rig.receiver}, start_ns=0, seconds=_SECONDS, chunk_s=0.05
    ):
        pipeline.feed(name, t_ns, data)

    def ask(request: dict[str, Any]) -> dict[str, Any]:
        if request["class"] == "PASSES":
            return {"passes": pipeline.passes(), "next": None}
        devices = [{"name": name, "state": "streaming"} | pipeline.device(name) for name in ("front", SPAN)]
        told = {"class": "STATUS", "session": session.id, "since_s": 1.0, "devices": devices}
        return told | pipeline.status()

    return ask


def _get(port: int, path: str) -> int:
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=10.0)
    connection.request("GET", path)
    size = len(connection.getresponse().read())
    connection.close()
    return size


def _reachable(port: int) -> None:
    until_s = time.monotonic() + 10.0
    while time.monotonic() < until_s:
        try:
            socket.create_connection(("127.0.0.1", port), timeout=1.0).close()
        except ConnectionRefusedError:
            continue
        return
    raise ConnectionRefusedError(port)
