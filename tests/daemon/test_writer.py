"""One order of what is recorded and what is heard, whatever is slow; and a disk without room."""

import threading
import time
from contextlib import suppress

import pytest

from polecal.daemon import recorder, writer
from polecal.daemon.config import Storage
from polecal.daemon.recorder import DiskFull, Event, Record, Recorder, RecorderError
from polecal.daemon.replay import FINISH, TICK
from polecal.daemon.space import Space
from polecal.daemon.writer import Writer

FINISHED = Event(99, {"event": FINISH, "why": "asked to stop"})


def chunk(n, device="span", direction="rx"):
    return Record(device, direction, n, b"%d" % n)


@pytest.fixture
def begin(tmp_path):
    """Begins writers of a capture in a folder, and closes them."""
    writers = []

    def begin(folder=tmp_path, kind=Recorder, **storage):
        (folder / "sessions" / "now").mkdir(parents=True)
        writing = Writer(
            kind(folder / "sessions" / "now" / "capture.mcap", {}),
            Space(folder, Storage(**{"min_free_mb": 1} | storage)),
            "now",
        )
        writing.start()
        writers.append(writing)
        return writing

    yield begin
    for writing in writers:
        with suppress(RecorderError):
            writing.close()


def heard(writing):
    """What was handed on of all that was put, but for ticks."""
    with suppress(RecorderError):
        writing.sync()
    items = []
    while (item := writing.get(0.0)) is not None:
        if not isinstance(item, Event) or item.content["event"] != TICK:
            items.append(item)
    return items


def recorded(writing):
    """What a replay of the capture would hear, but for ticks."""
    return [
        item
        for item in recorder.read(writing._recorder.path)
        if (item.direction == "rx" if isinstance(item, Record) else item.content["event"] == FINISH)
    ]


class Held(Recorder):
    """A recorder on a disk that takes until it is let go."""

    def __init__(self, *args):
        super().__init__(*args)
        self.writing, self.syncing, self.go = threading.Event(), threading.Event(), threading.Event()
        self.slow_write = False

    def write(self, *args):
        if self.slow_write:
            self.writing.set()
            assert self.go.wait(10.0)
        super().write(*args)

    def sync(self):
        self.syncing.set()
        assert self.go.wait(10.0)
        super().sync()


def test_many_threads_are_heard_in_the_order_of_the_capture(begin):
    writing = begin()

    def say(device):
        for n in range(500):
            writing.put(chunk(n, device))
            if n % 100 == 0:
                writing.put(chunk(n, device, "tx"))

    threads = [threading.Thread(target=say, args=(name,)) for name in ("front", "rear", "span")]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    writing.put(FINISHED)
    items = heard(writing)
    writing.close()
    assert len(items) == 1501
    assert recorded(writing) == items
    assert items[-1] == FINISHED


def test_what_is_neither_chunk_nor_event_comes_in_its_place_and_notes_do_not(begin):
    writing = begin()
    marker = object()
    writing.put(chunk(1))
    writing.note(Event(2, {"event": "state"}))
    writing.put(marker)
    writing.put(chunk(3))
    assert heard(writing) == [chunk(1), marker, chunk(3)]
    writing.close()
    assert Event(2, {"event": "state"}) in list(recorder.read(writing._recorder.path))


def test_time_that_goes_on_without_bytes_is_an_input_that_is_recorded(begin):
    writing = begin()
    tick = writing.get(5.0)
    assert tick.content == {"event": TICK}
    writing.close()
    assert tick in list(recorder.read(writing._recorder.path))


def test_nothing_is_heard_before_it_is_written(begin):
    writing = begin(kind=Held)
    writing._recorder.slow_write = True
    writing.put(chunk(1))
    assert writing._recorder.writing.wait(5.0)
    assert writing.get(0.1) is None
    writing._recorder.go.set()
    assert writing.get(5.0) == chunk(1)


def test_a_disk_that_takes_its_time_to_sync_holds_up_neither_readers_nor_what_is_heard(begin):
    writing = begin(kind=Held)
    writing.put(chunk(0))
    assert writing._recorder.syncing.wait(5.0)  # and does not come back
    for n in range(1, 100):
        writing.put(chunk(n))
    assert writing.get(5.0) == chunk(0)
    writing._recorder.go.set()
    assert heard(writing) == [chunk(n) for n in range(1, 100)]


def test_recording_goes_on_while_nobody_hears(begin):
    writing = begin()
    for n in range(2000):
        writing.put(chunk(n))
    writing.sync()
    assert len(recorded(writing)) == 2000
    assert heard(writing) == [chunk(n) for n in range(2000)]


def test_readers_wait_when_too_much_is_under_way_and_nothing_is_dropped(begin, monkeypatch):
    monkeypatch.setattr(writer, "_UNDER_WAY", 10)
    writing = begin()
    said = []

    def say():
        for n in range(50):
            writing.put(chunk(n))
            said.append(n)

    thread = threading.Thread(target=say)
    thread.start()
    thread.join(0.3)
    assert thread.is_alive()
    assert len(said) == 10
    writing.note(Event(1, {"event": "state"}))  # what hears may not wait
    writing.sync()
    assert [writing.get(5.0) for _ in range(50)] == [chunk(n) for n in range(50)]
    thread.join()


def test_a_recorder_that_fails_is_told_in_its_place_and_to_who_waits(begin, monkeypatch):
    writing = begin()

    def fail(*_):
        raise RecorderError("the disk is gone")

    monkeypatch.setattr(writing._recorder, "write", fail)
    monkeypatch.setattr(writing._recorder, "sync", fail)
    writing.put(chunk(1))
    assert "gone" in str(writing.get(5.0))
    with pytest.raises(RecorderError, match="gone"):
        writing.sync()
    monkeypatch.setattr(writing._recorder, "write", lambda *_: 1 / 0)
    writing.put(chunk(2))
    assert any("ZeroDivisionError" in str(item) for item in heard(writing))  # and it goes on
    monkeypatch.undo()
    writing.put(chunk(3))
    assert heard(writing)[-1] == chunk(3)


def fill(disk):
    with (disk / "filler").open("wb", buffering=0) as file:
        for size in (1 << 16, 1 << 9, 1):
            with suppress(OSError):
                while True:
                    file.write(bytes(size))
    return disk / "filler"


def until_full(writing):
    """Write until there is no room; give what was put."""
    n, deadline_s = 0, time.monotonic() + 10.0
    while writing.full is None:
        assert time.monotonic() < deadline_s
        writing.put(Record("span", "rx", n := n + 1, bytes(4000)))
    writing.sync()


def test_a_full_disk_is_left_alone_until_there_is_room_and_heard_is_what_was_recorded(small_disk, begin):
    writing = begin(small_disk("3m"))
    filler = fill(writing._space._sessions.parent)
    until_full(writing)
    assert writing.missed > 0
    before = heard(writing)
    filler.unlink()
    deadline_s = time.monotonic() + 10.0
    while writing.full is not None:
        assert time.monotonic() < deadline_s
        before += heard(writing)
        time.sleep(0.02)
    writing.put(chunk(7))
    writing.put(FINISHED)
    items = before + heard(writing)
    writing.close()
    assert items[-2:] == [chunk(7), FINISHED]
    assert recorded(writing) == items


@pytest.mark.parametrize("room_again", [False, True])
def test_an_end_that_is_asked_for_on_a_full_disk_is_heard_and_a_replay_ends_there_too(
    small_disk, begin, room_again
):
    disk = small_disk("3m")
    writing = begin(disk)
    filler = fill(disk)
    until_full(writing)
    if room_again:
        filler.unlink()
    writing.put(FINISHED)
    items = heard(writing)
    filler.unlink(missing_ok=True)
    assert items[-1] == FINISHED
    if room_again:
        writing.close()
        assert recorded(writing) == items
    else:  # the capture ends there: nothing that was not heard comes after it
        writing.put(chunk(7))
        assert heard(writing) == []
        writing.close()
        assert recorded(writing) == items[:-1]


def test_the_floor_stops_chunks_and_not_what_must_be_heard(begin, monkeypatch):
    writing = begin()
    monkeypatch.setattr(Space, "_free_bytes", lambda _: 10)
    until_full(writing)
    writing.put(FINISHED)
    items = heard(writing)
    writing.close()
    assert items[-1] == FINISHED
    assert recorded(writing) == items


def test_a_quota_is_looked_at_while_recording(begin, tmp_path, monkeypatch):
    monkeypatch.setattr(writer, "_COUNT_S", 0.0)
    old = tmp_path / "sessions" / "a-old"
    old.mkdir(parents=True)
    (old / "capture.mcap").write_bytes(bytes(900_000))
    writing = begin(quota_mb=1)
    deadline_s = time.monotonic() + 20.0
    n = 0
    while old.exists():
        assert time.monotonic() < deadline_s
        writing.put(Record("span", "rx", n := n + 1, bytes(4000)))
        writing.get(0.01)
    assert writing.full is None


def test_a_capture_that_cannot_be_closed_is_cut_off_and_that_is_told(small_disk, begin):
    disk = small_disk("3m")
    writing = begin(disk)
    fill(disk)
    until_full(writing)
    with pytest.raises(DiskFull):
        writing.close()
    capture = recorder.read(writing._recorder.path)
    list(capture)
    assert "is cut off" in capture.cut
