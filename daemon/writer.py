"""Chunks and inputs from many threads to one order: each is recorded, and only then handed on to be heard.

What is handed on is what a replay of the capture gives, one for one. A disk that is slow, or full, holds up
nothing but this; and however long the hearing takes, recording goes on.
"""

from __future__ import annotations

import contextlib
import math
import queue
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass

import structlog

from polecal import PolecalError
from polecal.daemon.recorder import DiskFull, Event, Record, Recorder, RecorderError
from polecal.daemon.replay import TICK
from polecal.daemon.space import MAKE_ROOM, Space

_UNDER_WAY = 50_000  # minutes of both devices, written or not: beyond it the readers wait
_SYNC_S = 0.5  # what is written may wait for so long again, in a silence: a power cut takes 1 s at most
_TOGETHER_S = 0.05  # between two looks at what came: waking for each chunk costs more than writing it
_COUNT_S = 10.0  # between two sums of what all sessions take: some 0.5 MB are recorded meanwhile
_BUG = "report it with the session's folder"


@dataclass(frozen=True, slots=True)
class _Note:
    event: Event


class Writer:
    """One thread that alone writes a capture, syncs it, and minds the room on its disk.

    Any thread may `put`; one thread is to `get`. `full` is why nothing is recorded, None while it is;
    ``missed`` counts the chunks that were not; ``beat_s`` is when it last showed that it is not stuck.
    """

    def __init__(self, recorder: Recorder, space: Space, session: str) -> None:
        self.full: str | None = None
        self.missed = 0
        self.beat_s = time.monotonic()
        self._recorder, self._space, self._session = recorder, space, session
        self._log = structlog.get_logger().bind(session=session)
        self._room = threading.Semaphore(_UNDER_WAY)
        self._incoming: queue.SimpleQueue[tuple[object, bool]] = queue.SimpleQueue()
        self._written: queue.SimpleQueue[tuple[object, bool]] = queue.SimpleQueue()
        self._owed: Record | Event | None = None  # the first without room: the recorder keeps it
        self._counted_s = time.monotonic()
        self._closed: Future[None] = Future()
        self._thread = threading.Thread(target=self._work, name="writer")

    def start(self) -> None:
        """Begin to write what was put."""
        self._thread.start()

    def put(self, item: object) -> None:
        """Give a Record or Event to be recorded and heard, or something else to be handed on in its place.

        Waits while too much is under way: then the kernel buffers, and what it loses is counted by framers.
        """
        self._room.acquire()
        self._incoming.put((item, True))

    def note(self, event: Event) -> None:
        """Give an event to be recorded, if there is room, and not to be heard; never waits."""
        self._incoming.put((_Note(event), False))

    def get(self, timeout_s: float) -> object | None:
        """Take the next that was written: a Record read from a device, an Event, what was put in between.

        An error of the recorder is handed on too; None if nothing comes in time.
        """
        try:
            item, bounded = self._written.get(timeout=timeout_s)
        except queue.Empty:
            return None
        if bounded:
            self._room.release()
        return item

    @property
    def all_heard(self) -> bool:
        """Whether all that was written has been taken."""
        return self._written.empty()

    def sync(self) -> None:
        """Wait until all that was handed on is on the disk. Raises RecorderError."""
        if self._thread.is_alive():
            done: Future[None] = Future()
            self._incoming.put((done, False))
            done.result()

    def close(self) -> None:
        """Write what was put, then close the capture. Raises RecorderError: it is left cut off."""
        if not self._closed.done():
            self._incoming.put((self._closed, False))
            self._thread.join()
        self._closed.result()

    def _work(self) -> None:
        synced_s = time.monotonic()
        while not self._closed.done():
            self.beat_s = time.monotonic()
            try:
                item, bounded = self._incoming.get(timeout=_SYNC_S)
            except queue.Empty:  # that time goes on is an input
                item, bounded = (
                    Event(time.monotonic_ns(), {"event": TICK}),
                    self._room.acquire(blocking=False),
                )
            try:
                self._take(item, bounded)
                if time.monotonic() - synced_s >= _SYNC_S:
                    synced_s = time.monotonic()
                    self._look_at_disk()
                    self._recorder.sync()
            except DiskFull as error:
                self._pause(str(error))
            except RecorderError as error:
                self._hand_on(error)
            except Exception as error:  # a bug: what comes in is still recorded
                self._log.exception("bug")
                self._hand_on(PolecalError(f"a bug in polecal: {error!r}", _BUG))
            if self._incoming.empty():
                time.sleep(_TOGETHER_S)
        self.beat_s = math.inf  # done, which is not stuck

    def _take(self, item: object, bounded: bool) -> None:
        if item is self._closed:
            _told(self._closed, self._recorder.close)
            return
        heard = False
        try:
            match item:
                case Future():
                    _told(item, self._recorder.sync)
                case _Note(event):
                    if not self._recorder.closed:
                        self._recorder.add(event)
                case Record() | Event(content={"event": "tick"}):
                    heard = self._record(item)
                case Event():
                    self._record_input(item)
                    heard = True
                case _:
                    heard = True
        finally:
            if heard:
                self._hand_on(item, bounded=bounded)
            elif bounded:
                self._room.release()

    def _hand_on(self, item: object, *, bounded: bool = False) -> None:
        self._written.put((item, bounded))

    def _record(self, item: Record | Event) -> bool:
        """Write what may be missed, if there is room; say whether it is to be heard."""
        if self.full is not None:
            self.missed += isinstance(item, Record)
            return False
        try:
            self._recorder.add(item)
        except DiskFull as error:
            self._owed = item
            self._pause(str(error))
            return False
        return isinstance(item, Event) or item.direction == "rx"

    def _record_input(self, event: Event) -> None:
        """Write what must be heard: into the room that is kept free, or else the capture ends before it.

        So a run that is ended on a full disk ends in a replay with what it had heard, too.
        """
        if self._recorder.closed:
            return
        try:
            self._settle()
            self._recorder.add(event)
        except DiskFull as error:
            self._pause(str(error))
            self._recorder.abandon()

    def _settle(self) -> None:
        """Write and hand on what there was no room for. Raises DiskFull."""
        self._recorder.settle()
        owed, self._owed = self._owed, None
        if owed is not None:
            self._hand_on(owed)

    def _look_at_disk(self) -> None:
        """Stop to record while there is too little room, and go on once there is enough."""
        if self._recorder.closed:
            return
        if self.full is None:
            due = time.monotonic() - self._counted_s >= _COUNT_S
            if due:
                self._counted_s = time.monotonic()
            if (due or self._space.lacking()) and (why := self._space.make_room(self._session)):
                self._pause(why)
        elif self._space.make_room(self._session) is None:
            self._settle()
            missed, self.missed, self.full = self.missed, 0, None
            self._log.info("recording goes on", missed_chunks=missed)
            self._recorder.event(time.monotonic_ns(), {"event": "recording goes on", "missed_chunks": missed})

    def _pause(self, why: str) -> None:
        if self.full is None:
            self._log.error("disk full", problem=why, hint=MAKE_ROOM)
            with contextlib.suppress(DiskFull):
                self._recorder.event(time.monotonic_ns(), {"event": "disk full", "why": why})
        self.full = why


def _told(done: Future[None], work: Callable[[], None]) -> None:
    """Do what somebody waits for, and tell how it went."""
    try:
        work()
    except Exception as error:
        done.set_exception(error)
    else:
        done.set_result(None)
