"""One calibration run: device threads to a thread that records each chunk, and one that then hears it."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import structlog

from polecal import PolecalError
from polecal.daemon.choices import Choice
from polecal.daemon.config import SPAN, Config
from polecal.daemon.control import Code, Refused
from polecal.daemon.passes import StoredPass
from polecal.daemon.past import Past
from polecal.daemon.pipeline import GO_ON, Pipeline
from polecal.daemon.recorder import FULL, DiskFull, Event, Record, Recorder, RecorderError
from polecal.daemon.replay import BEGIN, CHOICE, FINISH, play
from polecal.daemon.route import Stand
from polecal.daemon.routine import ENDED, State
from polecal.daemon.sessions import CALIBRATION, Session, SessionError
from polecal.daemon.space import MAKE_ROOM, Space
from polecal.daemon.tail import Tail
from polecal.daemon.writer import Writer
from polecal.drivers.device import Device
from polecal.drivers.errors import DeviceError, DeviceProtocolError
from polecal.drivers.novatel_span import NovatelSpan
from polecal.drivers.port import Direction, Port, Tap
from polecal.drivers.sick_lms import SickLms

_LOOK_S = 0.5
_TOGETHER_S = 0.05  # between two looks: waking for each chunk costs more than hearing it
_PATIENCE_S = 0.3  # a status waits no longer for one that is being calculated
_WRITE_AGAIN_S = 1.0


@dataclass(frozen=True, slots=True)
class _End:
    """Asks the engine to end the run without a result: as a fault, or just so."""

    why: str
    problem: PolecalError | None = None


class Run:
    """A run from its start to its end; `status` and `stop` may be called from any thread."""

    def __init__(
        self,
        config: Config,
        session: Session,
        on_closed: Callable[[Path], None] | None = None,
        past: Past | None = None,
    ) -> None:
        """Prepare a run; ``on_closed`` is told the capture once it is closed. Raises RecorderError.

        ``past`` is of a session that goes on.
        """
        self.session = session
        self._past = past
        self._on_closed = on_closed
        self.ended = threading.Event()
        """Set once the devices are left, the capture is closed and the result is written."""
        self._log = structlog.get_logger().bind(session=session.id)
        self._lock = threading.Lock()
        self._problem: PolecalError | None = None
        self._pipeline = Pipeline(
            config,
            session=session.id,
            created=session.created,
            folder=session.folder,
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
        self._runtime_dir = config.runtime_dir
        self._tail: Tail | None = None
        self._space = Space(config.state_dir, config.storage)
        self._writer = Writer(self._recorder, self._space, session.id)
        self._stops = [threading.Event() for _ in self._devices]
        self._leaving = False
        self._unwritten: list[tuple[str, Callable[[], object]]] = []  # what there was no room for
        self._write_again_s = 0.0
        self._known = self._know()
        self._asking = threading.Lock()  # the order in which inputs are put
        self._given_up = False
        self._asked: dict[int, Future[dict[str, Any] | None]] = {}  # by the event that asks
        self._threads: list[threading.Thread] = []
        self._engine = threading.Thread(target=self._work, name="engine")
        self._beat_s = self._begun_s = time.monotonic()

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
            undo.callback(self._forget)
            undo.callback(self._recorder.close)
            self._keep()
            for device, stop in zip(self._devices, self._stops, strict=True):
                try:
                    ports.append(device.open(stop))
                    undo.callback(ports[-1].close)
                except DeviceError as error:
                    problems.append(error)
            if problems:
                raise joined(problems)
            now_ns = time.monotonic_ns()
            past = {} if self._past is None else {"past": self._past.as_event()}
            self._recorder.event(now_ns, {"event": BEGIN} | past)
            with self._lock:
                self._pipeline.begin(now_ns, self._past)
            undo.pop_all()
        for device, port in zip(self._devices, ports, strict=True):
            reading = threading.Thread(target=device.run, args=(port,), name=device.name)
            self._threads.append(reading)
        self._writer.start()
        for thread in (*self._threads, self._engine):
            thread.start()

    def stop(self, why: str, *, calibrate: bool = False, problem: PolecalError | None = None) -> None:
        """End the run, also as a fault or with what there is calibrated; returns once all is closed."""
        if not self.ended.is_set():
            finish = Event(time.monotonic_ns(), {"event": FINISH, "why": why})
            with self._asking:
                calibrated = calibrate and problem is None
                self._given_up = self._given_up or not calibrated
                self._writer.put(finish if calibrated else _End(why, problem))
        self.ended.wait()

    def passes(self) -> list[dict[str, Any]]:
        """Give a row a pass."""
        with self._lock:
            return self._pipeline.passes()

    def stand(self) -> Stand:
        """Give what a route depends on."""
        with self._lock:
            return self._pipeline.stand()

    def choose(self, said: object, *, drop: bool, by: str, at: str) -> dict[str, Any]:
        """Drop or keep a pass, also after the end; give what changed.

        Raises Refused, and RecorderError or SessionError where it cannot be written: nothing has changed.
        """
        with self._lock:
            choice = self._pipeline.choice(said, drop=drop, by=by, at=at)
        if not self.ended.is_set():
            change = self._choose_running(choice)
            if change is not None:
                return change
        with self._lock:
            if self._unwritten:
                raise DiskFull("the result is not written yet", MAKE_ROOM)
            now_ns = time.monotonic_ns()
            choice = replace(choice, ended=True)  # no capture tells of it
            change = self._pipeline.choose(now_ns, choice)
            try:
                self.session.write_calibration(self._pipeline.calibration() or {})
            except SessionError:
                self._pipeline.choose(now_ns, replace(choice, drop=not drop))
                raise
        return change

    def _choose_running(self, choice: Choice) -> dict[str, Any] | None:
        """Have the engine drop or keep a pass, which is an input as any; None if the run ended before it."""
        if self._writer.full is not None:
            raise DiskFull(f"nothing is recorded: {self._writer.full}", MAKE_ROOM)
        with self._asking:
            if self._given_up:  # behind that a choice would be refused, but be in the capture
                raise Refused("the session is being stopped, and not calibrated", GO_ON, Code.USAGE)
            event = Event(time.monotonic_ns(), {"event": CHOICE, "choice": choice.as_dict()})
            answer = self._asked[id(event)] = Future()
            self._writer.put(event)
        while not self.ended.is_set():
            with contextlib.suppress(TimeoutError):
                return answer.result(_LOOK_S)
        return answer.result() if answer.done() else None

    def status(self, *, passing: bool = True) -> dict[str, Any]:
        """Give the parts of STATUS that a run knows; while it calculates, those from before.

        What a pass says that is not over takes some ms a second of it: it is told if ``passing``.
        """
        if self._lock.acquire(timeout=_PATIENCE_S):
            try:
                self._known = self._know(passing=passing)
            finally:
                self._lock.release()
        status, since_ns, heard = self._known
        since_s = round((time.monotonic_ns() - since_ns) / 1e9, 1)
        run_s = round(time.monotonic() - self._begun_s, 1)
        return status | {
            "session": self.session.id,
            "since_s": since_s,
            "run_s": run_s,
            "disk": self._space.left(self.session.capture, run_s),
            "devices": [self._device(device, heard[device.name]) for device in self._devices],
            "notes": [*self.notes, *status["notes"]],
        }

    @property
    def notes(self) -> list[str]:
        """What is wrong with the run, in plain words."""
        notes = [] if self._problem is None else [str(self._problem)]
        if self._writer.full is not None and not self.ended.is_set():
            notes.append(f"nothing is recorded: {self._writer.full}; {MAKE_ROOM}")
        if self._space.over is not None:
            notes.append(self._space.over)
        if self._write_again_s and (names := [name for name, _ in self._unwritten]):
            notes.append(f"for want of room not written: {', '.join(names)}; they are once there is room")
        return notes

    def _know(self, *, passing: bool = False) -> tuple[dict[str, Any], int, dict[str, dict[str, Any]]]:
        """Give what the pipeline says: its status, since when it is in its state, and of each device."""
        heard = {device.name: self._pipeline.device(device.name) for device in self._devices}
        return self._pipeline.status(passing=passing), self._pipeline.routine.since_ns, heard

    def beats(self) -> dict[str, float]:
        """Give for each thread when it last showed that it is not stuck; of those that are done, nothing."""
        if self.ended.is_set():
            return {}
        readers = {
            device.name: device.beat_s
            for device, thread, stop in zip(self._devices, self._threads, self._stops, strict=False)
            if thread.is_alive() or not stop.is_set()
        }
        return readers | {"engine": self._beat_s, "writer": self._writer.beat_s}

    def _device(self, device: Device, heard: dict[str, Any]) -> dict[str, Any]:
        problem = device.problem
        return {
            "name": device.name,
            "kind": device.kind,
            "port": device.path,
            "state": device.state,
            "identity": device.identity,
            **heard,
            **({} if device.state == "streaming" else {"rate_hz": 0.0}),
            "reconnects": device.reconnects,
            **device.about(),
            **({"problem": str(problem), "hint": problem.hint} if problem is not None else {}),
        }

    def _tap(self, name: str) -> Tap:
        def tap(direction: Direction, t_ns: int, data: bytes) -> None:
            record = Record(name, direction, t_ns, data)
            if self._tail is not None:
                self._tail.put(record)
            self._writer.put(record)

        return tap

    def _keep(self) -> None:
        """Begin a tail; a run without one may only lose more by a kill."""
        names = [device.name for device in self._devices]
        try:
            self._tail = Tail(self._runtime_dir, self.session.capture, names)
        except OSError as error:
            self._log.warning("no tail", folder=str(self._runtime_dir), problem=error.strerror)

    def _forget(self) -> None:
        if self._tail is not None:
            self._tail.close()

    def _work(self) -> None:
        """Hear what was recorded until every device is left, and nothing waits."""
        while any(thread.is_alive() for thread in self._threads):
            self._do(self._writer.get(_LOOK_S))
            if self._writer.all_heard:
                time.sleep(_TOGETHER_S)
        try:
            self._writer.close()
        except DiskFull as error:  # it is cut off, and repaired at the daemon's next start
            self._log.warning("capture cut off", problem=str(error), hint=error.hint)
        except RecorderError as error:
            self._fail(error)
        self._forget()
        while (item := self._writer.get(0.0)) is not None:
            self._do(item)
        if self._unwritten:
            threading.Thread(target=self._write_late, name="late", daemon=True).start()
        self.ended.set()
        if self._on_closed is not None:
            self._on_closed(self.session.capture)

    def _do(self, item: object | None) -> None:
        self._beat_s = time.monotonic()
        try:
            match item:
                case Event(content={"event": "choice"}):
                    self._choose(item)
                case Record() | Event():
                    self._hear(item)
                case _End():
                    self._end(item)
                case PolecalError():
                    self._fail(item)
            if self._unwritten and time.monotonic() >= self._write_again_s:
                self._write()
        except PolecalError as error:
            self._fail(error)
        except Exception as error:  # a bug: what comes in is still recorded, and the devices are left
            self._log.exception("bug")
            self._fail(PolecalError(f"a bug in polecal: {error!r}", "report it with the session's folder"))
        if self.state in ENDED:
            self._leave()

    def _hear(self, item: Record | Event) -> None:
        """Let the pipeline hear what is in the capture, and nothing else."""
        if self._problem is not None or not self._pipeline.routine.running:
            return
        with self._lock:
            if isinstance(item, Event):
                self._known = self._know()  # what it asks for may take a while
            play(self._pipeline, item)
            if self.state in (State.ACCEPTED, State.REJECTED):
                self._keep_result()

    def _choose(self, event: Event) -> None:
        """Drop or keep a pass, and answer who waits for it: also a run that has just ended may change."""
        answer = self._asked.pop(id(event))
        if self._recorder.closed:  # too late for the capture
            answer.set_result(None)
            return
        try:
            with self._lock:
                choice = Choice.from_dict(event.content["choice"])
                change = self._pipeline.choose(event.t_ns, choice)
                if self.state in (State.ACCEPTED, State.REJECTED):
                    self._keep_result()
        except Refused as error:
            answer.set_exception(error)
        else:
            answer.set_result(change)

    def _end(self, end: _End) -> None:
        if end.problem is not None:
            self._fail(end.problem)
        elif self._pipeline.routine.running:
            self._pipeline.routine.to(State.IDLE, time.monotonic_ns(), end.why)

    def _keep_result(self) -> None:
        """Write the result of a run that has just ended, before anybody can see that it has."""
        calibration = self._pipeline.calibration()
        if calibration is not None:
            self._unwritten.append((CALIBRATION, lambda: self.session.write_calibration(calibration)))
            self._write()

    def _store(self, laser: str, stored: StoredPass) -> None:
        """Write a pass, once it is sure that what it is made of is on the disk, before anybody can see it."""
        self._known = self._know()
        self._unwritten.append(
            (f"pass {stored.id} of {laser}", lambda: self.session.write_pass(laser, stored))
        )
        self._write()
        self._log.info("pass", laser=laser, id=stored.id, returns=len(stored.returns))

    def _write(self) -> None:
        """Write passes and the result; those for which there is no room are kept until there is."""
        try:
            self._writer.sync()
            while self._unwritten:
                self._unwritten[0][1]()
                self._unwritten.pop(0)
            self._write_again_s = 0.0
        except (DiskFull, SessionError) as error:
            full = isinstance(error, DiskFull) or getattr(error.__cause__, "errno", None) in FULL
            if not full:
                raise
            if not self._write_again_s:  # each second again
                self._log.error("not written", problem=str(error), hint=MAKE_ROOM)
            self._write_again_s = time.monotonic() + _WRITE_AGAIN_S

    def _write_late(self) -> None:
        """Go on trying to write what the end of the run left in memory."""
        again = threading.Event()
        while self._unwritten:
            again.wait(_WRITE_AGAIN_S)
            try:
                self._write()
            except PolecalError as error:
                self._log.error("never written", problem=str(error), hint=error.hint)
                return

    def _on_transition(self, t_ns: int, old: State, new: State, why: str) -> None:
        self._log.info("state", old=str(old), new=str(new), why=why)
        self._writer.note(Event(t_ns, {"event": "state", "old": old, "new": new, "why": why}))

    def _fail(self, error: PolecalError) -> None:
        if self._problem is None:
            self._log.error("run failed", problem=str(error), hint=error.hint)
            self._problem = error
            self._pipeline.routine.to(State.FAULT, time.monotonic_ns(), str(error))
        self._leave()

    def _leave(self) -> None:
        """Tell the devices to leave; once, as a device that says goodbye clears the flag meanwhile."""
        with self._lock:
            leaving, self._leaving = self._leaving, True
        if not leaving:
            for stop in self._stops:
                stop.set()


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
