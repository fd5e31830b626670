"""Our framing against the sheet's vectors."""

import json

import pytest

from polecal.drivers.emulated import span_frames as span
from polecal.drivers.emulated.span_frames import Stamp


@pytest.fixture(scope="module")
def vectors(protocol):
    return {entry["name"]: entry for entry in json.loads((protocol / "novatel-vectors.json").read_text())}


def test_every_binary_vector_is_read_and_its_crc_is_ours(vectors):
    read = 0
    for name, entry in vectors.items():
        if entry["encoding"].startswith("binary") and "NEGATIVE" not in name:
            frame = bytes.fromhex(entry["hex"])
            assert span.frame_size(frame) == len(frame), name
            found = span.parse_frame(frame)
            assert found is not None, name
            assert (found[0], found[2].week, found[2].ms) == tuple(
                entry["header"][key] for key in ("msg_id", "week", "ms")
            )
            read += 1
    assert read >= 25


def test_every_ascii_vector_is_read_and_its_crc_is_ours(vectors):
    lines = [entry["ascii"] for entry in vectors.values() if entry["encoding"].startswith("ascii")]
    assert len(lines) >= 20
    for line in lines:
        words = span.parse_line(line)
        assert words is not None, line
        assert words[0] == line[1:].split(",")[0]
        assert span.parse_line(line[:-1] + ("0" if line[-1] != "0" else "1")) is None


def test_a_flipped_bit_is_not_a_frame(vectors):
    frame = bytearray.fromhex(vectors["INSPVAXB driven"]["hex"])
    frame[60] ^= 4
    assert span.parse_frame(bytes(frame)) is None
    assert list(span.frames(bytes(frame))) == []


def test_a_response_is_the_real_one_but_for_the_receivers_own_state(vectors):
    real = bytes.fromhex(vectors["LOGB command response OK"]["hex"])
    stamp = Stamp(1687, 419249437, status=0)
    ours = span.long_frame(1, b"\x01\0\0\0OK", stamp, definition=0xFFFF, response=True)
    assert ours[:12] == real[:12]
    assert ours[13:26] == real[13:26]
    assert ours[28:34] == real[28:34]


@pytest.mark.parametrize(
    ("port", "virtual", "byte", "name"),
    [
        ("COM1", 0, 0x20, "COM1"), ("COM2", 30, 0x5E, "COM2_30"), ("USB1", 0, 0xA0, "USB1"),
        ("ICOM1", 0, 0xA0, "ICOM1"), ("ICOM1", 30, 0xBE, "ICOM1_30"),
    ],
)  # fmt: skip
def test_a_port_is_the_low_byte_of_its_id(port, virtual, byte, name):
    stamp = Stamp(2400, 0, port=port, virtual=virtual, source=2)
    assert span.long_frame(42, b"", stamp)[6:8] == bytes([2, byte])
    assert span.ascii_line("TIMEA", ["1"], stamp).startswith(f"#TIMEA_2,{name},0,".encode())
