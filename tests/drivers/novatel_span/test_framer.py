"""Frames out of a receiver's stream, however it is cut, and whatever lies between."""

import json
from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from polecal.drivers.novatel_span import Fault, Framer, Kind, MessageId, TimeStatus
from polecal.drivers.novatel_span.framer import MAX_FRAME_BYTES, crc32

REPLY = b"\r\n<OK\r\n[COM1]"
ERROR = b"\r\n<ERROR:Invalid Message. Field = 2\r\n[COM1]"
NMEA = b"$GPGGA,134658.00,5106.9792,N,11402.3003,W,2,09,1.0,1048.47,M,-16.27,M,08,AAAA*60\r\n"
TIMESYNC = (
    b"#TIMESYNCA,COM1,0,46.0,FINESTEERING,1337,410095.000,00000000,bd3f,1984;"
    b"1337,410095000,FINESTEERING*aa2025db\r\n"
)
RESPONSE = bytes.fromhex("aa44121c0100802006000000ffb497061d3dfd1800000000ffff0000010000004f4bea247892")
VERSION_LINES = b"<VERSION COM1 0 81.0 UNKNOWN 0 1165.383 004c0000 3681 2177\r\n<     1\r\n"


def feed_all(data, cuts=None):
    """Frames, skips and framer, from ``data`` cut at ``cuts``; each chunk is stamped with its start."""
    skips = []
    framer = Framer(skips.append)
    edges = [0, *sorted(cuts or []), len(data)]
    frames = [frame for a, b in pairwise(edges) for frame in framer.feed(data[a:b], a)]
    framer.close()
    return frames, skips, framer


def joined(frames, skips):
    return b"".join(part.data for part in sorted([*frames, *skips], key=lambda part: part.offset))


def told(frames):
    return [(frame.offset, frame.data, frame.kind) for frame in frames]


def good(vectors):
    return [vector for vector in vectors.values() if vector["crc_ok"]]


def test_every_known_message_is_one_frame(vectors):
    kinds = {
        "binary-long": Kind.BINARY,
        "binary-short": Kind.SHORT_BINARY,
        "ascii-long": Kind.ASCII,
        "ascii-short": Kind.SHORT_ASCII,
    }
    assert len(good(vectors)) == 51
    for vector in good(vectors):
        frames, skips, framer = feed_all(vector["wire"])
        assert told(frames) == [(0, vector["wire"], kinds[vector["encoding"]])], vector["name"]
        assert not skips
        assert framer.bad_frames == 0


def test_every_known_message_is_found_halved_and_byte_by_byte(vectors):
    for vector in good(vectors):
        size = len(vector["wire"])
        for cuts in ([size // 2], range(1, size)):
            frames, skips, _ = feed_all(vector["wire"], cuts)
            assert [frame.data for frame in frames] == [vector["wire"]], vector["name"]
            assert not skips


def test_every_known_message_is_found_between_garbage(vectors):
    garbage = b"\x00\xff\xaa\x44#%$<[\r\n\xaa\x44\x12\x1c<OK[COM1"
    data = garbage + b"".join(vector["wire"] + garbage for vector in good(vectors))
    frames, skips, _ = feed_all(data)
    assert [f.data for f in frames if f.kind.checked] == [v["wire"] for v in good(vectors)]
    assert joined(frames, skips) == data


def test_headers_are_as_the_vectors_say(vectors):
    for vector in good(vectors):
        if "header" in vector:
            (frame,) = feed_all(vector["wire"])[0]
            header = vector["header"]
            assert (frame.message_id, frame.week, frame.ms) == (
                header["msg_id"],
                header["week"],
                header["ms"],
            )
            if frame.kind is Kind.BINARY:
                assert frame.time_status == header["time_status"]
                assert frame.receiver_status == header["rx_status"]
                assert frame.port_address == header["port"]
                assert frame.is_response == bool(header["msg_type"] & 0x80)


def test_ascii_headers_are_read():
    (frame,) = feed_all(TIMESYNC)[0]
    assert (frame.name, frame.message_id, frame.week, frame.ms) == ("TIMESYNC", 492, 1337, 410095000)
    assert frame.time_status is TimeStatus.FINESTEERING
    assert frame.body == b"1337,410095000,FINESTEERING"


def test_a_flipped_bit_is_rejected(vectors):
    bad = vectors["NEGATIVE: INSPVAXB with one flipped bit"]["wire"]
    frames, skips, framer = feed_all(bad + bad)
    assert not frames
    assert framer.bad_frames == 2
    assert skips[0].reason is Fault.CRC
    assert joined(frames, skips) == bad + bad


def test_any_single_flipped_bit_loses_that_frame_alone(vectors):
    frame = vectors["INSPVASB OEM6"]["wire"]
    for bit in range(0, 8 * len(frame), 7):
        broken = bytearray(frame)
        broken[bit // 8] ^= 1 << bit % 8
        frames, _, _ = feed_all(frame + bytes(broken) + frame * 100)
        assert sum(f.data == frame for f in frames) == 101
        assert len(frames) == 101


def test_a_frame_cut_off_costs_no_frame_behind_it(vectors):
    frame = vectors["INSPVASB OEM6"]["wire"]
    frames, _, framer = feed_all(frame[:50] + frame)
    assert [f.data for f in frames] == [frame]
    assert framer.bad_frames == 1


def test_a_text_line_cut_off_costs_no_frame_behind_it(vectors):
    frame = vectors["INSPVASB OEM6"]["wire"]
    frames, _, framer = feed_all(TIMESYNC[:60] + frame + TIMESYNC[:60] + TIMESYNC)
    assert [f.data for f in frames] == [frame, TIMESYNC]
    assert framer.bad_frames == 2


def test_replies_and_prompts_lie_between_frames(vectors):
    frame = vectors["INSPVAXB driven"]["wire"]
    data = frame + REPLY + frame + ERROR + b"[COM1]" + frame
    frames, skips, _ = feed_all(data)
    assert not skips
    assert [f.kind.name for f in frames] == [
        *("BINARY", "REPLY", "PROMPT"),
        *("BINARY", "REPLY", "PROMPT", "PROMPT", "BINARY"),
    ]
    texts = [f.text for f in frames if f.kind in (Kind.REPLY, Kind.PROMPT)]
    assert texts == ["OK", "COM1", "ERROR:Invalid Message. Field = 2", "COM1", "COM1"]


def test_a_reply_is_given_out_with_its_line_end_without_waiting_for_more():
    framer = Framer()
    assert not framer.feed(b"\r\n<OK", 1)
    assert [f.text for f in framer.feed(b"\r\n", 2)] == ["OK"]
    assert [f.text for f in framer.feed(b"[ICOM1]", 3)] == ["ICOM1"]


def test_binary_responses_are_known_as_such():
    (frame,) = feed_all(RESPONSE)[0]
    assert frame.is_response
    assert frame.message_id == MessageId.LOG


def test_nmea_lines_are_passed_over_as_frames():
    frames, skips, _ = feed_all(NMEA + TIMESYNC)
    assert [f.kind for f in frames] == [Kind.NMEA, Kind.ASCII]
    assert not skips
    assert frames[0].message_id is None
    broken = NMEA.replace(b"*60", b"*61")
    assert [f.kind for f in feed_all(broken + TIMESYNC)[0]] == [Kind.ASCII]


def test_abbreviated_ascii_is_a_frame_a_line():
    frames, skips, _ = feed_all(VERSION_LINES + b"[COM1]")
    assert [(f.kind, f.name) for f in frames[:2]] == [
        (Kind.ABBREVIATED, "VERSION"),
        (Kind.ABBREVIATED, None),
    ]
    assert not skips


def test_text_may_end_in_a_bare_line_feed():
    assert [f.kind for f in feed_all(TIMESYNC.replace(b"\r", b""))[0]] == [Kind.ASCII]


def test_a_header_may_be_longer_than_today():
    head = b"\xaa\x44\x12" + bytes([32]) + (42).to_bytes(2, "little") + bytes(2)
    data = head + (8).to_bytes(2, "little") + bytes(22) + b"bodybody"
    data += crc32(data).to_bytes(4, "little")
    (frame,) = feed_all(data)[0]
    assert frame.body == b"bodybody"
    assert frame.name == "BESTPOS"


def test_an_impossible_length_does_not_stop_the_stream(vectors):
    frame = vectors["INSPVASB OEM6"]["wire"]
    frames, skips, framer = feed_all(b"\xaa\x44\x12\x1c\x2a\x00\x00\x00\xff\xff" + frame)
    assert [f.data for f in frames] == [frame]
    assert framer.bad_frames == 1
    assert skips[0].reason is Fault.LENGTH


@pytest.mark.parametrize(
    "start", [b"\xaa\x44\x12\x1c\x2a\x00\x00\x00\x00\x1f", b"#", b"#BESTPOSA,", b"$GPGGA,", b"<", b"<ERROR:"]
)
def test_what_is_kept_is_bounded(start):
    framer = Framer()
    framer.feed(start, 0)
    for _ in range(40):
        framer.feed(b"A" * 1000, 1)
        assert len(framer._rest) <= MAX_FRAME_BYTES


def test_stamps_are_of_the_chunks_with_the_first_and_the_last_byte(vectors):
    frame = vectors["INSPVASB OEM6"]["wire"]
    framer = Framer()
    assert not framer.feed(b"\x00\x00" + frame[:10], 100)
    assert not framer.feed(frame[10:90], 200)
    first, second = framer.feed(frame[90:] + frame, 300)
    assert (first.t_first_ns, first.t_last_ns, first.lead_bytes) == (100, 300, 10)
    assert (second.t_first_ns, second.t_last_ns, second.lead_bytes) == (300, 300, len(frame))


def test_the_key_of_a_log_and_of_its_copy_on_a_virtual_port_is_the_same(vectors):
    data = bytearray(vectors["BESTPOSB INS_PPP"]["wire"])
    data[7] = 0xBE
    copy = bytes(data[:-4]) + crc32(bytes(data[:-4])).to_bytes(4, "little")
    frames, _, _ = feed_all(vectors["BESTPOSB INS_PPP"]["wire"] + copy)
    assert frames[0].key == frames[1].key


@st.composite
def streams(draw):
    """A stream of frames, replies and hostile bytes, and where to cut it."""
    pieces = [REPLY, ERROR, NMEA, TIMESYNC, RESPONSE, VERSION_LINES, b"[COM1]"]
    broken = [piece[:-3] for piece in pieces] + [piece[2:] for piece in pieces]
    hostile = st.lists(
        st.sampled_from([b"\xaa", b"\x44", b"\x12", b"\x13", b"#", b"<", b"[", b"\r\n", b"*", b"A", b"\x00"])
    ).map(b"".join)
    part = st.sampled_from(pieces) | st.sampled_from(broken) | hostile | st.binary(max_size=40)
    data = b"".join(draw(st.lists(part, max_size=8)))
    return data, draw(st.lists(st.integers(0, len(data)), max_size=30))


@given(streams())
def test_frames_do_not_depend_on_how_the_stream_is_cut(stream):
    data, cuts = stream
    whole, skipped, counted = feed_all(data)
    for cut in (cuts, range(1, len(data))):
        frames, skips, framer = feed_all(data, cut)
        assert told(frames) == told(whole)
        assert joined(frames, skips) == data
        assert (framer.frames, framer.bad_frames) == (counted.frames, counted.bad_frames)
    assert joined(whole, skipped) == data


@given(streams())
def test_chunks_that_wait_until_no_byte_is_lacking_give_the_same_frames_at_the_same_time(
    same_though_they_wait, stream
):
    data, cuts = stream
    same_though_they_wait(Framer, data, cuts)


@given(streams())
def test_nothing_in_a_stream_raises_from_a_frames_properties(stream):
    for frame in feed_all(stream[0])[0]:
        assert frame.key is not None
        assert isinstance(frame.text + str(frame.name) + str(frame.time_status), str)
        assert isinstance(frame.body, bytes)


@given(st.binary(max_size=64), st.binary(max_size=64))
def test_a_whole_frame_behind_any_bytes_is_found(before, after):
    # bytes before it may be a frame's beginning, so there must be enough behind it to settle that
    data = before + RESPONSE + b"\x00" * (MAX_FRAME_BYTES + 1)
    assert any(frame.data == RESPONSE for frame in feed_all(data)[0])
    assert joined(*feed_all(before + RESPONSE + after)[:2]) == before + RESPONSE + after


def test_every_capture_holds_the_frames_that_its_index_says(captures):
    for entry in json.loads((captures / "novatel-index.json").read_text()):
        data = (captures / entry["file"]).read_bytes()
        frames, skips, _ = feed_all(data)
        kinds = [frame.kind for frame in frames]
        assert {
            "long_binary": kinds.count(Kind.BINARY),
            "short_binary": kinds.count(Kind.SHORT_BINARY),
            "long_ascii": kinds.count(Kind.ASCII),
            "short_ascii": kinds.count(Kind.SHORT_ASCII),
        } == entry["crc_valid_frames"], entry["file"]
        replies = entry["edie_counts"].get("RESPONSE(no header, <OK/<ERROR text)", 0)
        assert kinds.count(Kind.REPLY) == replies
        assert joined(frames, skips) == data


def test_a_capture_in_small_uneven_reads_is_the_same(captures):
    data = (captures / "span_driver_ins_ppp_driven_20hz.bin").read_bytes()[:200_000]
    whole = feed_all(data)[0]
    uneven = feed_all(data, range(1, len(data), 37))[0]
    assert told(uneven) == told(whole)
