"""Arrays of logs, against the logs one by one."""

import numpy as np
import pytest

from polecal.drivers.novatel_span import Framer, MessageId, columns, parse
from polecal.drivers.novatel_span.fields import LOGS, layout
from polecal.drivers.novatel_span.framer import crc32


@pytest.mark.parametrize(
    "name",
    [
        "span_driver_ins_ppp_driven_20hz.bin",
        "span_driver_basic_fix_unaligned_10hz.bin",
        "oem7drv_ins1.bin",
        "oem7drv_bestpos.bin",
        "gavlab_ParsingData_GPS.bin",
    ],
)
def test_arrays_hold_what_the_logs_say(captures, name):
    data = (captures / name).read_bytes()
    frames = [f for f in Framer().feed(data, 0) if f.message_id in LOGS and not f.is_response]
    for message in {frame.message_id for frame in frames}:
        if not layout(LOGS[message]).fixed:
            continue
        logs = [frame for frame in frames if frame.message_id == message]
        records = columns(data, MessageId(message))
        assert records["header_ms"].tolist() == [frame.ms for frame in logs]
        assert records["header_week"].tolist() == [frame.week for frame in logs]
        for field in layout(LOGS[message]).fields:
            column = [getattr(parse(frame), field.name) for frame in logs]
            got = records[field.name]
            if got.dtype.kind == "S":
                assert [text.partition(b"\0")[0].decode("latin-1") for text in got] == column
            else:
                np.testing.assert_array_equal(got, np.array(column))


def test_long_and_short_headers_of_one_stretch_stay_in_order(vectors):
    pose = vectors["INSPVASB OEM6"]["wire"]
    body = pose[12:-4]
    head = b"\xaa\x44\x12\x1c" + (508).to_bytes(2, "little") + bytes(2) + (88).to_bytes(2, "little")
    long = head + bytes(4) + (7).to_bytes(2, "little") + (9).to_bytes(4, "little") + bytes(8) + body
    long += crc32(long).to_bytes(4, "little")
    records = columns(pose + long + b"noise" + pose, MessageId.INSPVAS)
    assert records["header_week"].tolist() == [1881, 7, 1881]
    assert len(set(records["azimuth_deg"].tolist())) == 1


def test_a_broken_or_cut_off_frame_is_no_record(vectors):
    pose = vectors["INSPVASB OEM6"]["wire"]
    broken = pose[:50] + b"\x00" + pose[51:]
    assert len(columns(broken + pose + pose[:-1], MessageId.INSPVAS)) == 1
    assert len(columns(pose[:8], MessageId.INSPVAS)) == 0
    assert len(columns(b"", MessageId.INSPVAS)) == 0


def test_responses_are_no_records(vectors):
    assert len(columns(vectors["LOGB command response OK"]["wire"], MessageId.INSPVAS)) == 0


@pytest.mark.parametrize("message", [MessageId.VERSION, MessageId.LOG])
def test_logs_without_a_fixed_length_are_refused(message):
    with pytest.raises(ValueError, match="no record of a fixed length"):
        columns(b"", message)
