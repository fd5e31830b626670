"""What is recorded comes back to the byte, however the file ended."""

import os
import resource
import signal
import subprocess
import sys
import threading

import pytest
from mcap.reader import make_reader
from mcap.writer import Writer

from polecal.daemon import recorder
from polecal.daemon.recorder import Event, Record, Recorder, RecorderError

METADATA = {"config": "lasers: []\n", "version": "1"}
ITEMS = [
    Record("front", "tx", 1_000_000_000, b"\x02\x00\x01\x00\x31\x15\x12"),
    Record("front", "rx", 1_004_000_000, b"\x06"),
    Record("span", "rx", 1_003_000_000, bytes(range(256))),  # later in the file, earlier by its stamp
    Event(1_005_000_000, {"event": "state", "to": "collecting", "heading_deg": 12.5}),
    Record("front", "rx", 1_006_000_000, bytes(812)),
    Record("span", "rx", 2_500_000_000, b"\xaaD\x13"),
]


def put(to: Recorder, items):
    for item in items:
        if isinstance(item, Event):
            to.event(item.t_ns, item.content)
        else:
            to.write(item.device, item.direction, item.t_ns, item.data)


@pytest.fixture
def path(tmp_path):
    return tmp_path / "capture.mcap"


@pytest.fixture
def closed(path):
    with Recorder(path, METADATA) as writing:
        put(writing, ITEMS)
    return path


def test_what_was_recorded_comes_back_in_the_order_of_writing(closed):
    capture = recorder.read(closed)
    assert capture.metadata == METADATA
    assert list(capture) == ITEMS
    assert capture.cut is None
    assert capture.used_bytes == capture.size_bytes == closed.stat().st_size
    assert list(capture) == ITEMS  # and again


def test_the_official_reader_reads_it_and_its_crcs(closed):
    with closed.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        seen = [
            (channel.topic, channel.message_encoding, message.log_time, message.publish_time, message.data)
            for _, channel, message in reader.iter_messages(log_time_order=False)
        ]
        summary = reader.get_summary()
        (metadata,) = reader.iter_metadata()
    assert seen[0] == (
        "/front/tx",
        "application/octet-stream",
        1_000_000_000,
        1_000_000_000,
        ITEMS[0].data,
    )
    assert [topic for topic, *_ in seen] == [
        "/front/tx",
        "/front/rx",
        "/span/rx",
        "/events",
        "/front/rx",
        "/span/rx",
    ]
    assert seen[3][1] == "json"
    assert summary.statistics.message_count == len(ITEMS)
    assert (metadata.name, metadata.metadata) == ("polecal", METADATA)


def test_a_file_cut_anywhere_gives_its_whole_messages_and_says_how_far(closed, tmp_path):
    whole = closed.read_bytes()
    cut = tmp_path / "cut.mcap"
    counts, refusals = [], []
    for size in range(len(whole)):
        cut.write_bytes(whole[:size])
        try:
            capture = recorder.read(cut)
        except RecorderError as error:
            assert not counts  # only where the metadata is not yet whole
            refusals.append(str(error))
            continue
        items = list(capture)
        assert capture.metadata == METADATA
        assert items == ITEMS[: len(items)]
        assert f"is cut off: used {capture.used_bytes} of {size} bytes, {len(items)} messages" in capture.cut
        assert capture.used_bytes <= size
        counts.append(len(items))
    assert all(str(cut) in refusal for refusal in refusals)
    assert counts == sorted(counts)
    assert set(counts) == set(range(len(ITEMS) + 1))


def test_seconds_used_are_told(closed, tmp_path):
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(closed.read_bytes()[:-10])
    capture = recorder.read(cut)
    list(capture)
    assert capture.cut.endswith("6 messages, 1.5 s")


def test_messages_are_in_the_file_as_soon_as_written(path):
    writing = Recorder(path, METADATA)
    for n, item in enumerate(ITEMS):
        put(writing, [item])
        assert list(recorder.read(path)) == ITEMS[: n + 1]
    assert writing.size_bytes == path.stat().st_size
    writing.close()


def test_a_kill_loses_nothing_that_was_written(path):
    code = f"""
import os, signal
from pathlib import Path
from polecal.daemon.recorder import Recorder
r = Recorder(Path({str(path)!r}), {{"version": "1"}})
for n in range(500):
    r.write("front", "rx", n, bytes([n % 256]) * n)
os.kill(os.getpid(), signal.SIGKILL)
"""
    done = subprocess.run([sys.executable, "-c", code], check=False, timeout=60)
    assert done.returncode == -signal.SIGKILL
    capture = recorder.read(path)
    assert [record.data for record in capture] == [bytes([n % 256]) * n for n in range(500)]
    assert "is cut off" in capture.cut


@pytest.mark.parametrize(
    ("content", "says"),
    [
        (b"", "no MCAP file"),
        (b"\x02\x80\x2c\x00\xb0" * 100, "no MCAP file"),
        (b"\x89MCAP0\r\n", "nothing in it can be used"),
        (b"\x89MCA", "nothing in it can be used"),
        (b"\x89MCAP0\r\n" + bytes(4096), "nothing in it can be used"),
        (b"\x89MCAP0\r\n\x0c" + b"\xff" * 4096, "nothing in it can be used"),
    ],
)
def test_a_file_that_is_no_capture_is_refused(path, content, says):
    path.write_bytes(content)
    with pytest.raises(RecorderError, match=says) as caught:
        recorder.read(path)
    assert str(path) in str(caught.value)
    assert caught.value.hint


def test_a_file_that_cannot_be_opened_is_refused(path, tmp_path):
    for there in (path, tmp_path):
        with pytest.raises(RecorderError, match=str(there)):
            recorder.read(there)


def test_another_programs_mcap_is_refused(path):
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        channel = writer.register_channel("/chatter", "json", 0)
        writer.add_message(channel, 1, b"{}", 1)
        writer.finish()
    with pytest.raises(RecorderError, match="not recorded by polecal"):
        recorder.read(path)


def test_a_compressed_capture_with_more_in_it_reads_the_same(path):
    with path.open("wb") as stream:
        writer = Writer(stream, chunk_size=300, enable_data_crcs=True)
        writer.start()
        writer.add_metadata("polecal", METADATA)
        other = writer.register_channel("/front/scan", "json", 0)
        channels = {}
        for item in ITEMS:
            raw = isinstance(item, Record)
            topic = f"/{item.device}/{item.direction}" if raw else "/events"
            data = item.data if raw else b'{"event":"state","to":"collecting","heading_deg":12.5}'
            if topic not in channels:
                channels[topic] = writer.register_channel(
                    topic, "application/octet-stream" if raw else "json", 0
                )
            writer.add_message(channels[topic], item.t_ns, data, item.t_ns)
            writer.add_message(other, item.t_ns, b"{}", item.t_ns)
        writer.finish()
    capture = recorder.read(path)
    assert list(capture) == ITEMS
    assert capture.cut is None

    whole = path.read_bytes()
    for at in range(300, len(whole), 7):  # a changed byte: an error told, never an exception
        path.write_bytes(whole[:at] + bytes([whole[at] ^ 0x55]) + whole[at + 1 :])
        capture = recorder.read(path)
        items = list(capture)
        assert items == ITEMS[: len(items)]


def test_a_changed_byte_is_told(closed):
    whole = closed.read_bytes()
    at = whole.index(bytes(range(256))) + 100
    closed.write_bytes(whole[:at] + b"\xff" + whole[at + 1 :])
    capture = recorder.read(closed)
    assert len(list(capture)) == len(ITEMS)
    assert "CRC is wrong" in capture.cut


def test_data_without_their_end_and_its_crc_are_told(closed):
    whole = closed.read_bytes()
    at = whole.index(b"\x0f" + (4).to_bytes(8, "little"))  # DataEnd
    closed.write_bytes(whole[:at] + b"\x7f" + whole[at + 1 :])
    capture = recorder.read(closed)
    assert list(capture) == ITEMS
    assert "is damaged" in capture.cut


def test_a_record_longer_than_what_is_read_at_once_is_read(path):
    long = Record("front", "rx", 5, bytes(range(256)) * 4000)
    with Recorder(path, METADATA) as writing:
        put(writing, [*ITEMS, long, *ITEMS])
    capture = recorder.read(path)
    assert list(capture) == [*ITEMS, long, *ITEMS]
    assert capture.cut is None


def test_blocks_of_zeros_at_the_end_are_not_taken_for_data(path):
    writing = Recorder(path, METADATA)
    put(writing, ITEMS)
    size = path.stat().st_size
    os.truncate(path, size + 4096)
    capture = recorder.read(path)
    assert list(capture) == ITEMS
    assert capture.used_bytes == size
    assert "is damaged" in capture.cut
    writing.close()


@pytest.fixture
def room():
    """Set how large a file may become, as a disk without more room would."""
    old = resource.getrlimit(resource.RLIMIT_FSIZE)
    yield lambda size: resource.setrlimit(resource.RLIMIT_FSIZE, (size or old[0], old[1]))
    resource.setrlimit(resource.RLIMIT_FSIZE, old)


def test_a_full_disk_is_told_and_recording_goes_on_when_there_is_room(path, room):
    writing = Recorder(path, METADATA)
    put(writing, ITEMS[:2])
    size = path.stat().st_size
    room(size + 100)
    for _ in range(3):
        with pytest.raises(RecorderError, match="cannot be written") as caught:
            writing.write("span", "rx", 1_003_000_000, bytes(range(256)))
        assert caught.value.hint
        assert path.stat().st_size == size  # no half message left
    assert list(recorder.read(path)) == ITEMS[:2]
    room(None)
    put(writing, ITEMS[3:])
    writing.close()
    capture = recorder.read(path)
    # the first that did not fit was kept and is there; the next two are the ones lost
    assert list(capture) == ITEMS
    assert capture.cut is None
    with path.open("rb") as stream:
        assert make_reader(stream, validate_crcs=True).get_summary().statistics.message_count == len(ITEMS)


def test_a_disk_full_at_the_close_leaves_a_usable_file(path, room):
    writing = Recorder(path, METADATA)
    put(writing, ITEMS)
    room(path.stat().st_size + 5)
    with pytest.raises(RecorderError):
        writing.close()
    room(None)
    writing.close()  # again: nothing more to do
    capture = recorder.read(path)
    assert list(capture) == ITEMS
    assert "is cut off" in capture.cut


def test_a_capture_is_never_written_over(closed):
    before = closed.read_bytes()
    with pytest.raises(RecorderError, match="is there already"):
        Recorder(closed, METADATA)
    assert closed.read_bytes() == before


def test_a_folder_that_is_not_there_is_named(tmp_path):
    with pytest.raises(RecorderError, match="gone"):
        Recorder(tmp_path / "gone" / "capture.mcap", METADATA)


def test_after_the_close_nothing_is_taken(tmp_path):
    writing = Recorder(tmp_path / "other.mcap", METADATA)
    writing.close()
    with pytest.raises(RecorderError, match="closed"):
        writing.write("front", "rx", 1, b"x")
    writing.sync()
    writing.close()
    assert list(recorder.read(writing.path)) == []


def test_threads_may_write_at_once(path):
    writing = Recorder(path, METADATA)

    def write(device):
        for n in range(200):
            writing.write(device, "rx", n, f"{device} {n}".encode())
            if n % 50 == 0:
                writing.sync()

    threads = [threading.Thread(target=write, args=(name,)) for name in ("front", "rear", "span")]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    writing.close()
    records = list(recorder.read(path))
    for device in ("front", "rear", "span"):
        mine = [record.data.decode() for record in records if record.device == device]
        assert mine == [f"{device} {n}" for n in range(200)]
