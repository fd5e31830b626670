"""Frames as plain values."""

import json

import pytest

from polecal.drivers.novatel_span import Describer, Framer


def described(data):
    (frame,) = Framer().feed(data, 0)
    plain = Describer().describe(frame)
    assert json.loads(json.dumps(plain, allow_nan=False)) == plain
    return plain


def test_a_log_is_described_by_its_fields(vectors):
    plain = described(vectors["INSPVAXB driven"]["wire"])
    assert plain["name"] == "INSPVAX"
    assert plain["encoding"] == "binary"
    assert plain["crc_ok"] is True
    assert (plain["week"], plain["ms"], plain["time_status"]) == (1820, 160255900, "FINESTEERING")
    assert plain["ins_status"] == "INS_SOLUTION_GOOD"
    assert plain["lat_deg"] == pytest.approx(43.404095)
    assert plain["height_ellipsoidal_m"] == pytest.approx(289.7797, abs=1e-3)


def test_every_known_message_can_be_described(vectors):
    for vector in vectors.values():
        if vector["crc_ok"]:
            assert described(vector["wire"])["name"]


def test_a_reply_is_described_by_its_text():
    assert described(b"\r\n<ERROR:Invalid Message. Field = 2\r\n") == {
        "name": "REPLY",
        "encoding": "reply",
        "crc_ok": None,
        "text": "ERROR:Invalid Message. Field = 2",
    }


def test_a_response_is_described_as_such(vectors):
    plain = described(vectors["LOGB command response OK"]["wire"])
    assert (plain["name"], plain["response"], plain["text"]) == ("LOG", True, "OK")


def test_every_frame_of_the_captures_can_be_described(captures):
    for path in sorted(captures.glob("*.bin")):
        for frame in Framer().feed(path.read_bytes()[:100_000], 0):
            json.dumps(Describer().describe(frame), allow_nan=False)
