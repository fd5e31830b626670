"""The daemon: what the control socket is asked, to runs of a calibration."""

from __future__ import annotations

import argparse
import contextlib
import faulthandler
import queue
import re
import signal
import sys
import threading
import time
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import structlog

from polecal import PolecalError, __version__
from polecal.daemon import archive, log, reporting, route, sessions, shelf, tail
from polecal.daemon.config import SPAN, Config, load
from polecal.daemon.control import Code, ControlServer, Refused, asker, code_of
from polecal.daemon.finalise import Finaliser
from polecal.daemon.memory import give_back
from polecal.daemon.notify import Manager, summary
from polecal.daemon.pipeline import Pipeline
from polecal.daemon.routine import ENDED, State
from polecal.daemon.run import Run, joined, silent
from polecal.daemon.space import Space

_START_S = 120.0  # every rate of every device tried twice, and an EEPROM written
_LOOK_S = 0.1
_TELL_S = 1.0
_CLOSE_S = 60.0  # so long a disk may take to close a capture,
_EXTEND_S = 5.0  # of which so much is asked for at a time
_PAGE_ROWS = 48  # of at most 1 KiB each
_CALIBRATED = (State.ACCEPTED, State.REJECTED)
_SWITCH_S = 1e-4  # a chunk is stamped once its reader has the interpreter: so long it waits for a calculation
_ABOUT = "The daemon that calibrates the pose of a vehicle's lasers, in the foreground."
_NAME = re.compile(r"[A-Za-z0-9_-][A-Za-z0-9._-]{0,63}")


class Service:
    """Answers the control protocol; holds at most one run."""

    def __init__(self, config: Config, on_closed: Callable[[Path], None] | None = None) -> None:
        """Serve a configuration; ``on_closed`` is told each capture that was closed."""
        self._config = config
        self._on_closed = on_closed
        self._run: Run | None = None
        self._starting = threading.Lock()
        self._changing = threading.Lock()
        self._choosing = threading.Lock()
        self._closed = False

    def handle(self, request: dict[str, Any]) -> dict[str, Any]:
        """Answer one request. Raises Refused and other PolecalErrors."""
        match request.get("class"):
            case "START":
                return self._start(
                    request.get("name"), request.get("continue"), force=bool(request.get("force", False))
                )
            case "STATUS":
                return self.status()
            case "STOP":
                return self._stop(calibrate=bool(request.get("calibrate", False)))
            case "RESULT":
                return self._result(request.get("session"))
            case "REPORT":
                folder = sessions.folder_of(self._config.state_dir, request.get("session"))
                path = reporting.write_apart(folder)
                return {"class": "REPORT", "session": folder.name, "path": str(path)}
            case "PASSES":
                return self._passes(request.get("session"), request.get("from", 0))
            case "DROP" | "KEEP":
                return self._choose(request, drop=request["class"] == "DROP")
            case "SESSIONS":
                return self._sessions(request.get("from", 0))
            case "ROUTE":
                return self._route(request)
            case other:
                raise Refused(
                    f"{other!r} is not a request that this daemon knows", "see README.md", Code.USAGE
                )

    def close(self) -> None:
        """End what runs, leave the devices polite, and start nothing any more."""
        with self._changing:
            self._closed = True
        if self._run is not None:
            self._run.stop("the daemon is stopped")

    def beats(self) -> dict[str, float]:
        """Give for each thread of the run when it last showed that it is not stuck (CLOCK_MONOTONIC, s)."""
        return {} if self._run is None else self._run.beats()

    def reload(self, config: Config) -> list[str]:
        """Take another configuration for the next session; give the keys that differ.

        Raises Refused, where a folder would move or a run would no longer be of its configuration: then all
        stays as it was.
        """
        with self._changing:
            changed = [
                key for key in Config.model_fields if getattr(config, key) != getattr(self._config, key)
            ]
            if moved := [key for key in changed if key in ("state_dir", "runtime_dir", "page")]:
                raise Refused(
                    f"{' and '.join(moved)} cannot change while the daemon runs",
                    "restart it: systemctl restart polecal",
                    Code.CONFIG,
                )
            run = self._run
            running = run is not None and not run.ended.is_set() and run.state not in ENDED
            if run is not None and running and set(changed) - {"storage"}:
                raise Refused(
                    f"session {run.session.id} is running with another {', '.join(changed)}",
                    "end it by `polecal-field stop`, then reload again",
                    Code.BUSY,
                )
            self._config = config
        return changed

    def _start(self, name: str | None, continued: str | None, *, force: bool) -> dict[str, Any]:
        if name is not None and not (isinstance(name, str) and _NAME.fullmatch(name)):
            raise Refused(
                f"{name!r} is no name for a session", "use 1 to 64 letters, digits, . _ or -", Code.USAGE
            )
        if not self._starting.acquire(blocking=False):
            raise Refused(
                "a session is being started already", "wait for it, or see `polecal-field status`", Code.BUSY
            )
        try:
            current = self._run
            if current is not None and not current.ended.is_set():
                if current.state not in ENDED and not force:
                    raise Refused(
                        f"session {current.session.id} is running",
                        "stop it by `polecal-field stop`, or start with --force",
                        Code.BUSY,
                    )
                current.stop("another session was started")
            run = self._begin(name, continued)
            self._await_streams(run)
        finally:
            self._starting.release()
        return {"class": "STARTED", "session": run.session.id, "devices": run.status()["devices"]}

    def _begin(self, name: str | None, continued: str | None) -> Run:
        with self._changing:
            if self._closed:
                raise Refused("the daemon is being stopped", "start it again first", Code.BUSY)
            Space(self._config.state_dir, self._config.storage).require(continued)
            past = None
            if continued is None:
                session = sessions.create(self._config.state_dir, self._config, name)
            else:
                folder = archive.find(self._config.state_dir, continued)
                session, past = archive.resume(folder, self._config)
            run = Run(self._config, session, self._on_closed, past)
            try:
                run.begin()
            except PolecalError:
                sessions.discard(session)  # nothing came into it
                raise
            self._run = run
        return run

    def _await_streams(self, run: Run) -> None:
        """Wait until every device streams.

        Raises DeviceError with what each that does not is missing, and what ended the run meanwhile.
        """
        deadline_s = time.monotonic() + _START_S
        while time.monotonic() < deadline_s and not run.ended.wait(_LOOK_S):
            if all(device.state == "streaming" for device in run.devices):
                return
            if all(device.state == "streaming" or device.problem is not None for device in run.devices):
                break
        if run.ended.is_set():
            raise run.problem or Refused(f"session {run.session.id} was stopped while it started")
        missing = [device for device in run.devices if device.state != "streaming"]
        if not missing:
            return
        problem = joined([device.problem or silent(device) for device in missing])
        run.stop("not all devices stream", problem=problem)
        raise problem

    def status(self, *, passing: bool = True) -> dict[str, Any]:
        """Give what STATUS is answered; of a pass that is not over only if ``passing``."""
        if self._run is not None:
            return {"class": "STATUS"} | self._run.status(passing=passing)
        devices = [
            {"name": laser.name, "kind": "sick_lms", "port": laser.port, "state": "closed"}
            for laser in self._config.lasers
        ]
        devices.append(
            {"name": SPAN, "kind": "novatel_span", "port": self._config.navigation.port, "state": "closed"}
        )
        return {
            "class": "STATUS",
            "state": str(State.IDLE),
            "session": None,
            "since_s": 0.0,
            "devices": devices,
            "lasers": [],
            "next": "polecal-field start",
            "notes": [],
        }

    def _stop(self, *, calibrate: bool) -> dict[str, Any]:
        if self._run is None or self._run.ended.is_set():
            raise Refused("no session is running", "start one by `polecal-field start`", Code.USAGE)
        self._run.stop("asked to stop", calibrate=calibrate)
        answer = {"class": "STOPPED", "session": self._run.session.id, "state": str(self._run.state)}
        return answer | ({"notes": self._run.notes} if self._run.notes else {})

    def _result(self, session: str | None) -> dict[str, Any]:
        return {"class": "RESULT"} | sessions.calibration_of(self._config.state_dir, session)

    def _passes(self, session: str | None, first: object) -> dict[str, Any]:
        run = self._run_of(session)
        if run is not None:
            name, state, rows = run.session.id, str(run.state), run.passes()
        else:
            name = self._named(session)
            _, pipeline = archive.reopen(archive.find(self._config.state_dir, name))
            ended = pipeline.routine.state
            state = str(ended) if ended in _CALIBRATED else shelf.UNFINISHED
            rows = pipeline.passes()
        return {"class": "PASSES", "session": name, "state": state} | _page("passes", rows, first)

    def _choose(self, request: dict[str, Any], *, drop: bool) -> dict[str, Any]:
        by, at = asker(), datetime.now(UTC).isoformat(timespec="seconds")
        said, session = request.get("pass"), request.get("session")
        run = self._run_of(session)
        if run is not None:
            name, change = run.session.id, run.choose(said, drop=drop, by=by, at=at)
        else:
            name = self._named(session)
            with self._choosing:  # of two at once, the second must know of the first
                change = archive.choose(
                    archive.find(self._config.state_dir, name), said, drop=drop, by=by, at=at
                )
        return {"class": "CHANGED", "session": name} | change

    def _sessions(self, first: object) -> dict[str, Any]:
        run = self._run
        running = (run.session.id, str(run.state)) if run is not None and not run.ended.is_set() else None
        return {"class": "SESSIONS"} | _page("sessions", shelf.rows(self._config.state_dir, running), first)

    def _route(self, request: dict[str, Any]) -> dict[str, Any]:
        session = request.get("session")
        run = self._run_of(session)
        config, name = self._config, session
        if run is not None:
            name, stand = run.session.id, run.stand()
        elif session is None and not any((self._config.state_dir / "sessions").glob("*/")):
            stand = Pipeline(config).stand()  # nothing was driven yet
        else:
            folder = archive.find(self._config.state_dir, self._named(session))
            name, config = folder.name, archive.told(folder)[1]
            stand = archive.reopen(folder)[1].stand()
        return {"session": name} | route.answer(config, stand, request)

    def _run_of(self, session: str | None) -> Run | None:
        """Give the present run, or the last one's, if that is the session which is meant."""
        run = self._run
        return run if run is not None and session in (None, run.session.id) else None

    def _named(self, session: str | None) -> str:
        """Give the session which is meant, the newest if none is named. Raises Refused."""
        if session is not None:
            return session
        names = sorted(path.name for path in (self._config.state_dir / "sessions").glob("*/"))
        if not names:
            raise Refused("there is no session yet", "start one by `polecal-field start`", Code.USAGE)
        return names[-1]


def _page(name: str, rows: list[dict[str, Any]], first: object) -> dict[str, Any]:
    """Give the part of many rows that fits into a reply, and from where to ask for the rest."""
    if not isinstance(first, int) or first < 0:
        raise Refused(f"{first!r} is no number of a row", "send what the last reply's next says", Code.USAGE)
    last = first + _PAGE_ROWS
    return {name: rows[first:last], "next": last if last < len(rows) else None}


def make_parser() -> argparse.ArgumentParser:
    """Make the parser of ``polecald``, which its manual is made of, too."""
    parser = argparse.ArgumentParser(prog="polecald", description=_ABOUT)
    parser.add_argument("--config", required=True, metavar="FILE", help="the configuration, YAML")
    parser.add_argument("--check-config", action="store_true", help="only say whether it can be used")
    parser.add_argument("--version", action="version", version=__version__, help="print its version")
    return parser


def main(argv: list[str] | None = None) -> int:
    """Run ``polecald``; give its exit code."""
    arguments = make_parser().parse_args(argv)
    try:
        config = load(arguments.config)
        if arguments.check_config:
            return 0
        log.configure()
        return _serve(arguments.config, config)
    except PolecalError as error:
        sys.stderr.write(f"polecald: {error}\n" + (f"hint: {error.hint}\n" if error.hint else ""))
        return code_of(error)


def _serve(path: str, config: Config) -> int:
    sys.setswitchinterval(_SWITCH_S)
    give_back()
    faulthandler.enable()  # the watchdog ends by SIGABRT: the log then has where each thread was
    signals: queue.SimpleQueue[int] = queue.SimpleQueue()
    for number in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP):
        signal.signal(number, lambda number, _: signals.put(number))
    for folder in (config.state_dir, config.runtime_dir):
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise Refused(
                f"{folder}: cannot be made: {error.strerror}",
                "make it, or let systemd start polecal",
                Code.NOT_PERMITTED if isinstance(error, PermissionError) else Code.CONFIG,
            ) from error
    try:
        tail.rescue(config.runtime_dir)
    except (OSError, ValueError) as error:
        structlog.get_logger().warning("no tail rescued", problem=str(error))
    manager = Manager()
    finaliser = Finaliser(
        config.state_dir, config.storage.min_free_mb * 1_000_000, decoded=config.storage.decoded
    )
    service = Service(config, finaliser.add)
    with ControlServer(config.socket, service), finaliser, _page_of(config, service):
        structlog.get_logger().info("ready", socket=str(config.socket), release=__version__)
        manager.ready()
        _attend(service, manager, signals, path)
        manager.stopping()
        _close(service, manager)
    return 0


def _page_of(config: Config, service: Service) -> contextlib.AbstractContextManager[object]:
    """Give the page for a tablet, if the configuration asks for one."""
    if config.page.listen is None:
        return contextlib.nullcontext()
    from polecal.daemon.page import Page  # noqa: PLC0415 - an HTTP server that most daemons do without

    return Page(config.page.listen, service.handle, config.state_dir)


def _attend(service: Service, manager: Manager, signals: queue.SimpleQueue[int], path: str) -> None:
    """Tell the manager how it stands, and reload on SIGHUP, until another signal comes."""
    every_s = min(_TELL_S, (manager.watchdog_s or _TELL_S) / 4)
    refused = ""
    while True:
        manager.alive(service.beats())
        manager.status(summary(service.status(passing=False)) + refused)
        try:
            number = signals.get(timeout=every_s)
        except queue.Empty:
            continue
        if number != signal.SIGHUP:
            return
        manager.reloading()
        refused = _reload(service, path)
        manager.ready()


def _reload(service: Service, path: str) -> str:
    """Read the configuration again; give what to add to the status if it stays as it was."""
    logger = structlog.get_logger()
    try:
        changed = service.reload(load(path))
    except PolecalError as error:
        logger.error("configuration not reloaded", problem=str(error), hint=error.hint)
        return f"; configuration not reloaded: {error}"
    logger.info("configuration reloaded", changed=", ".join(changed) or "nothing")
    return ""


def _close(service: Service, manager: Manager) -> None:
    """End what runs, and ask the manager for the time that it takes."""
    closing = threading.Thread(target=service.close, name="closing")
    closing.start()
    until_s = time.monotonic() + _CLOSE_S
    while closing.is_alive():
        if time.monotonic() < until_s:
            manager.extend(_EXTEND_S)
        closing.join(_TELL_S)


if __name__ == "__main__":
    sys.exit(main())
