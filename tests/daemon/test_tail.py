import itertools
import os
import signal
import subprocess
import sys

import pytest

from polecal.daemon.recorder import Record
from polecal.daemon.tail import Tail, beside, read, rescue

SPAN_RX = ("span", "rx")
PUTS = """
import os, sys
from pathlib import Path
from polecal.daemon.recorder import Record
from polecal.daemon.tail import Tail

tail = Tail(Path(sys.argv[1]), Path(sys.argv[2]), ["span"])
n = 0
while True:
    n += 1
    tail.put(Record("span", "rx", n, b"%d" % n * 20))
    os.write(1, b"%d\\n" % n)
"""


@pytest.fixture
def capture(tmp_path):
    path = tmp_path / "sessions" / "one" / "capture.mcap"
    path.parent.mkdir(parents=True)
    path.touch()
    return path


def numbered(count, size=1000, line=SPAN_RX):
    return [Record(*line, n, bytes([n % 251]) * size) for n in range(1, count + 1)]


def test_chunks_of_every_line_are_kept_in_the_order_of_their_times(tmp_path, capture):
    tail = Tail(tmp_path, capture, ["front", "span"])
    lines = itertools.product(("front", "span"), ("rx", "tx"))
    records = [Record(*line, 10 * n, b"%d" % n) for n, line in enumerate(lines)]
    for record in reversed(records):
        tail.put(record)
    assert read(tail.path) == records


def test_of_more_than_it_holds_the_last_are_kept_and_at_least_half_of_its_room(tmp_path, capture):
    tail = Tail(tmp_path, capture, ["span"])
    least = tail.path.stat().st_size // 3 // 1000  # chunks; a half is a little more
    for count, record in enumerate(numbered(5 * least), 1):
        tail.put(record)
        if count % (least // 3) == 0:
            kept = read(tail.path)
            assert kept == numbered(count)[-len(kept) :]
            assert len(kept) >= min(count, least)


def test_a_kill_at_any_moment_leaves_every_chunk_that_was_put(tmp_path, capture):
    for _ in range(10):
        command = [sys.executable, "-c", PUTS, str(tmp_path), str(capture)]
        with subprocess.Popen(command, stdout=subprocess.PIPE) as process:
            for _ in range(3000):
                told = process.stdout.readline()
            process.kill()
            told = (told + process.stdout.read()).splitlines(keepends=True)
        assert process.returncode == -signal.SIGKILL
        last = int([line for line in told if line.endswith(b"\n")][-1])
        kept = read(tmp_path / "one.tail")
        assert kept[-1].t_ns in (last, last + 1)
        assert [record.t_ns for record in kept] == list(range(kept[0].t_ns, kept[-1].t_ns + 1))
        assert all(record.data == b"%d" % record.t_ns * 20 for record in kept)


def test_what_a_killed_run_left_is_moved_beside_its_capture_and_only_once(tmp_path, capture):
    tail = Tail(tmp_path, capture, ["span"])
    for record in numbered(3):
        tail.put(record)
    rescue(tmp_path)
    assert not beside(capture).exists()  # it lives
    path = tail.path
    del tail
    rescue(tmp_path)
    assert read(beside(capture)) == numbered(3)
    assert not path.exists()
    beside(capture).unlink()
    rescue(tmp_path)
    assert not beside(capture).exists()


@pytest.mark.parametrize("content", [b"", bytes(8192), b"{}", b"[1]", b"\1" * 99999])
def test_a_tail_that_was_killed_before_it_began_is_of_nothing(tmp_path, content):
    path = tmp_path / "one.tail"
    path.write_bytes(content)
    assert read(path) == []
    rescue(tmp_path)
    assert not path.exists()


def test_what_a_tail_of_senseless_bytes_has_is_what_is_whole(tmp_path, capture):
    tail = Tail(tmp_path, capture, ["span"])
    for record in numbered(200):
        tail.put(record)
    whole = tail.path.read_bytes()
    for cut in range(4096, len(whole) // 2, 9973):
        for junk in (b"", b"\1" * 5000, b"\1\0" + bytes(8) + b"\xff" * 4, b"\1\7" * 2500):
            tail.path.write_bytes(whole[:cut] + junk)
            kept = read(tail.path)
            assert [record for record in kept if record in numbered(200)] == numbered(
                min(200, (cut - 4096) // 1014)
            )


def test_a_tail_whose_session_was_removed_goes_too(tmp_path, capture):
    path = Tail(tmp_path, capture, ["span"]).path
    capture.unlink()
    rescue(tmp_path)
    assert not path.exists()
    assert os.listdir(capture.parent) == []


def test_a_capture_whose_path_is_too_long_to_be_told_has_no_tail(tmp_path, capture):
    with pytest.raises(OSError, match="too long"):
        Tail(tmp_path, capture.parent / ("x" * 5000) / "capture.mcap", ["span"])
    assert list(tmp_path.glob("*.tail")) == []


def test_a_run_that_ends_forgets_its_tail(tmp_path, capture):
    tail = Tail(tmp_path, capture, ["span"])
    tail.close()
    assert read(tail.path) == []
    assert not tail.path.exists()
