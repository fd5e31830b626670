"""One calibration run: device threads to one thread that records each chunk and then feeds the pipeline."""

from __future__ import annotations

import contextlib
import queue
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import structlog

from polecal import PolecalError
from polecal.daemon.config import SPAN, Config
from polecal.daemon.passes import StoredPass
from polecal.daemon.pipeline import Pipeline
from polecal.daemon.recorder import FULL, DiskFull, Recorder, RecorderError
from polecal.daemon.replay import BEGIN, FINISH, TICK
from polecal.daemon.routine import ENDED, State
from polecal.daemon.sessions import Session, SessionError
from polecal.daemon.space import Space
from polecal.drivers.device import Device
from polecal.drivers.errors import DeviceError, DeviceProtocolError
from polecal.drivers.novatel_span import NovatelSpan
from polecal.drivers.port import Direction, Port, Tap
from polecal.drivers.sick_lms import SickLms

_QUEUED_CHUNKS = 50_000  # minutes of both devices: a disk that stalls for longer stalls the readers
_SYNC_S = 0.5  # what is written may wait for so long again, in a silence: a power cut takes 1 s at most
_MAKE_ROOM = "make room on the disk: what is known is kept, and recording goes on"

_Chunk = tuple[str, Direction, int, bytes]


@dataclass(frozen=True, slots=True)
class _End:
    """Asks the engine to end the run: with what there is calibrated, as a fault, or just so."""

    why: str
    calibrate: bool = False
    problem: PolecalError | None = None


class Run:
    """A run from its start to its end; `status` and `stop` may be called from any thread."""

    def __init__(
        self, config: Config, session: Session, on_closed: Callable[[Path], None] | None = None
    ) -> None:
        """Prepare a run; ``on_closed`` is told the capture once it is closed. Raises RecorderError."""
        self.session = session
        self._on_closed = on_closed
        self.ended = threading.Event()
        """Set once the devices are left, the capture is closed and the result is written."""
        self._log = structlog.get_logger().bind(session=session.id)
        self._lock = threading.Lock()
        self._queue: queue.Queue[_Chunk | _End] = queue.Queue(_QUEUED_CHUNKS)
        self._problem: PolecalError | None = None
        self._pipeline = Pipeline(
            config,
            session=session.id,
            created=session.created,
            on_pass=self._store,
            on_transition=self._on_transition,
        )
        self._devices: list[Device] = [
            *(
                SickLms(
                    laser.name,
                    laser.port,
                    laser.baud,
                    self._tap(laser.name),
                    fov_deg=laser.fov_deg,
                    resolution_deg=laser.resolution_deg,
                    reflectivity=laser.reflectivity,
                )
                for laser in config.lasers
            ),
            NovatelSpan(
                SPAN,
                config.navigation.port,
                config.navigation.baud,
                self._tap(SPAN),
                rate_hz=config.navigation.rate_hz,
            ),
        ]
        self._recorder = Recorder(session.capture, session.metadata(config))
        self._stops = [threading.Event() for _ in self._devices]
        self._leaving = False
        self._space = Space(config.state_dir, config.storage)
        self._full: str | None = None  # why nothing is recorded
        self._owed: _Chunk | None = None  # the first chunk without room: the recorder keeps it
        self._missed = 0
        self._unstored: list[tuple[str, StoredPass]] = []
        self._threads: list[threading.Thread] = []
        self._engine = threading.Thread(target=self._work, name="engine")
        self._beat_s = time.monotonic()

    @property
    def devices(self) -> Sequence[Device]:
        """The devices, lasers first."""
        return self._devices

    @property
    def state(self) -> State:
        """Where the routine is."""
        return self._pipeline.routine.state

    @property
    def problem(self) -> PolecalError | None:
        """What made the run a fault."""
        return self._problem

    def begin(self) -> None:
        """Open every port and start.

        Raises DeviceError with each port that could not be opened, RecorderError.
        """
        ports: list[Port] = []
        problems: list[DeviceError] = []
        with contextlib.ExitStack() as undo:
            undo.callback(self.ended.set)
            undo.callback(self._recorder.close)
            for device, stop in zip(self._devices, self._stops, strict=True):
                try:
                    ports.append(device.open(stop))
                    undo.callback(ports[-1].close)
                except DeviceError as error:
                    problems.append(error)
            if problems:
                raise joined(problems)
            self._full = self._space.make_room(self.session.id)
            if self._full is not None:
                raise DiskFull(f"{self.session.folder}: {self._full}", _MAKE_ROOM)
            now_ns = time.monotonic_ns()
            self._recorder.event(now_ns, {"event": BEGIN})
            with self._lock:
                self._pipeline.begin(now_ns)
            undo.pop_all()
        for device, port in zip(self._devices, ports, strict=True):
            self._threads.append(threading.Thread(target=device.run, args=(port,), name=device.name))
        for thread in (*self._threads, self._engine):
            thread.start()

    def stop(self, why: str, *, calibrate: bool = False, problem: PolecalError | None = None) -> None:
        """End the run, also as a fault or with what there is calibrated; returns once all is closed."""
        self._queue.put(_End(why, calibrate, problem))
        self.ended.wait()

    def status(self) -> dict[str, Any]:
        """Give the parts of STATUS that a run knows."""
        with self._lock:
            status = self._pipeline.status()
            since_ns = self._pipeline.routine.since_ns
            devices = [self._device(device) for device in self._devices]
        if self._problem is not None:
            status["notes"] = [str(self._problem), *status["notes"]]
        if self._full is not None:
            status["notes"] = [f"nothing is recorded: {self._full}; {_MAKE_ROOM}", *status["notes"]]
        since_s = round((time.monotonic_ns() - since_ns) / 1e9, 1)
        return status | {"session": self.session.id, "since_s": since_s, "devices": devices}

    def beats(self) -> dict[str, float]:
        """Give for each thread when it last showed that it is not stuck; of those that are done, nothing."""
        if self.ended.is_set():
            return {}
        readers = {
            device.name: device.beat_s
            for device, thread, stop in zip(self._devices, self._threads, self._stops, strict=False)
            if thread.is_alive() or not stop.is_set()
        }
        return readers | {"engine": self._beat_s}

    def _device(self, device: Device) -> dict[str, Any]:
        problem = device.problem
        return {
            "name": device.name,
            "kind": device.kind,
            "port": device.path,
            "state": device.state,
            "identity": device.identity,
            **self._pipeline.device(device.name),
            **({} if device.state == "streaming" else {"rate_hz": 0.0}),
            "reconnects": device.reconnects,
            **device.about(),
            **({"problem": str(problem), "hint": problem.hint} if problem is not None else {}),
        }

    def _tap(self, name: str) -> Tap:
        def tap(direction: Direction, t_ns: int, data: bytes) -> None:
            self._queue.put((name, direction, t_ns, data))

        return tap

    def _work(self) -> None:
        """Record, then parse, until every device is left and nothing waits."""
        synced_s = time.monotonic()
        while any(thread.is_alive() for thread in self._threads) or not self._queue.empty():
            self._beat_s = time.monotonic()
            try:
                item = self._queue.get(timeout=_SYNC_S)
            except queue.Empty:
                item = None
            try:
                if item is not None:
                    self._take(item)
                elif self._pipeline.routine.running and self._full is None:
                    self._tick()
                if time.monotonic() - synced_s >= _SYNC_S:
                    synced_s = time.monotonic()
                    self._look_at_disk()
                    self._recorder.sync()
            except DiskFull as error:
                self._pause(str(error))
            except PolecalError as error:
                self._fail(error)
            except Exception as error:  # a bug: what comes in is still recorded, and the devices are left
                self._log.exception("bug")
                self._fail(
                    PolecalError(f"a bug in polecal: {error!r}", "report it with the session's folder")
                )
            if self.state in ENDED:
                self._leave()
        self._close()

    def _take(self, item: _Chunk | _End) -> None:
        if isinstance(item, _End):
            self._end(item)
            return
        if self._full is not None:
            self._missed += 1
            return
        try:
            self._recorder.write(*item)
        except DiskFull as error:
            self._owed = item
            self._pause(str(error))
        else:
            self._hear(item)

    def _hear(self, chunk: _Chunk) -> None:
        """Feed the pipeline what is in the capture, and nothing else."""
        name, direction, t_ns, data = chunk
        if direction == "rx" and self._problem is None and self._pipeline.routine.running:
            with self._lock:
                self._pipeline.feed(name, t_ns, data)
                self._write_result()

    def _look_at_disk(self) -> None:
        """Stop to record while there is too little room, and go on once there is enough."""
        if self._full is None:
            if self._space.lacking() and (why := self._space.make_room(self.session.id)):
                self._pause(why)
        elif self._space.make_room(self.session.id) is None:
            self._recorder.settle()
            owed, self._owed = self._owed, None
            missed, self._missed = self._missed, 0
            self._full = None
            self._store_passes()
            self._log.info("recording goes on", missed_chunks=missed)
            if owed is not None:
                self._hear(owed)
            self._recorder.event(time.monotonic_ns(), {"event": "recording goes on", "missed_chunks": missed})

    def _pause(self, why: str) -> None:
        if self._full is None:
            self._log.error("disk full", problem=why, hint=_MAKE_ROOM)
            with contextlib.suppress(DiskFull):
                self._recorder.event(time.monotonic_ns(), {"event": "disk full", "why": why})
        self._full = why

    def _tick(self) -> None:
        """Let the pipeline know that time goes on, though nothing comes: an input, so it is recorded."""
        now_ns = time.monotonic_ns()
        self._recorder.event(now_ns, {"event": TICK})
        with self._lock:
            self._pipeline.tick(now_ns)

    def _end(self, end: _End) -> None:
        if end.problem is not None:
            self._fail(end.problem)
        elif end.calibrate:
            now_ns = time.monotonic_ns()
            self._recorder.event(now_ns, {"event": FINISH, "why": end.why})
            with self._lock:
                self._pipeline.finish(now_ns, end.why)
                self._write_result()
        elif self._pipeline.routine.running:
            self._pipeline.routine.to(State.IDLE, time.monotonic_ns(), end.why)

    def _write_result(self) -> None:
        """Write the result of a run that has just ended, before anybody can see that it has."""
        calibration = self._pipeline.calibration() if self.state in (State.ACCEPTED, State.REJECTED) else None
        if calibration is not None:
            self.session.write_calibration(calibration)

    def _store(self, laser: str, stored: StoredPass) -> None:
        """Write a pass before anybody can see that it is closed."""
        self._unstored.append((laser, stored))
        self._store_passes()

    def _store_passes(self) -> None:
        """Write the passes that are closed; for which there is no room, those are kept until there is."""
        try:
            while self._unstored:
                laser, stored = self._unstored[0]
                self._recorder.sync()
                self.session.write_pass(laser, stored)
                self._unstored.pop(0)
                self._log.info("pass", laser=laser, id=stored.id, returns=len(stored.returns))
        except DiskFull as error:
            self._pause(str(error))
        except SessionError as error:
            if not (isinstance(error.__cause__, OSError) and error.__cause__.errno in FULL):
                raise
            self._pause(str(error))

    def _on_transition(self, t_ns: int, old: State, new: State, why: str) -> None:
        self._log.info("state", old=str(old), new=str(new), why=why)
        try:
            self._recorder.event(t_ns, {"event": "state", "old": old, "new": new, "why": why})
        except DiskFull as error:  # not through the pipeline, which is in the midst of a chunk
            self._pause(str(error))

    def _fail(self, error: PolecalError) -> None:
        if self._problem is None:
            self._log.error("run failed", problem=str(error), hint=error.hint)
            self._problem = error
            with contextlib.suppress(RecorderError):  # which may be what failed
                self._pipeline.routine.to(State.FAULT, time.monotonic_ns(), str(error))
        self._leave()

    def _leave(self) -> None:
        """Tell the devices to leave; once, as a device that says goodbye clears the flag meanwhile."""
        with self._lock:
            leaving, self._leaving = self._leaving, True
        if not leaving:
            for stop in self._stops:
                stop.set()

    def _close(self) -> None:
        try:
            self._recorder.close()
        except RecorderError as error:
            self._fail(error)
        self.ended.set()
        if self._on_closed is not None:
            self._on_closed(self.session.capture)


def joined(problems: Sequence[DeviceError]) -> DeviceError:
    """Make one error of several, of the first one's class."""
    if len(problems) == 1:
        return problems[0]
    hints = dict.fromkeys(problem.hint for problem in problems)
    return type(problems[0])("; ".join(map(str, problems)), "; ".join(hints))


def silent(device: Device) -> DeviceError:
    """Make an error of a device that does not stream and does not say why."""
    return DeviceProtocolError(
        f"{device.name} on {device.path}: does not stream yet", "check its power and cable, then start again"
    )
