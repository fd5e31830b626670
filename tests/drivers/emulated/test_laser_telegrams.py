import numpy as np
import pytest

from polecal.drivers.emulated import laser_telegrams as lms
from polecal.drivers.emulated.laser_telegrams import Variant

INF = np.inf


def test_every_usable_telegram_of_the_sheet_has_our_crc(telegrams):
    assert len(telegrams) > 60
    for entry in telegrams:
        data = bytes.fromhex(entry["hex"])
        assert lms.crc16(data[:-2]).to_bytes(2, "little") == data[-2:], entry["name"]


@pytest.mark.parametrize(
    ("name", "code", "data"),
    [
        ("A0h mode switch ok (status 10h)", 0xA0, b"\x00"),
        ("A0h installation refused", 0xA0, b"\x01"),
        ("92h", lms.REJECTED, b""),
        ("91h", lms.RESET_DONE, b""),
        ("B2h no errors", 0xB2, b""),
        ("BBh variant 180/0.5 set", 0xBB, bytes.fromhex("01 B400 3200")),
        ("CAh", 0xCA, b"\1\1\1"),
        ("BAh type string LMS200", 0xBA, b"LMS200;S18063;V02.19 "),
    ],
)
def test_a_reply_is_the_sheets(known, name, code, data):
    assert lms.reply(code, data) == known(name)


def config(mode, unit, *, indices):
    return bytes([0, 0, 0x46, 0, 2 * indices, mode, unit]) + lms.DEFAULT_CONFIG[7:]


@pytest.mark.parametrize(
    ("name", "count", "settings", "start", "indices"),
    [
        ("B0h 181 values cm", 181, config(0, 0, indices=False), 1.00, (0, 0)),
        ("B0h 361 values mm 180/0.5deg (c", 361, config(4, 1, indices=False), 1.000, (0, 0)),
        ("B0h 401 values mm", 401, config(4, 1, indices=True), 1.000, (7, 3)),
    ],
)
def test_a_scan_is_the_sheets(known, name, count, settings, start, indices):  # noqa: PLR0917
    step = 0.001 if settings[6] else 0.01
    words = lms.value_words(start + step * np.arange(count), np.zeros(count, int), settings)
    assert lms.values(words, settings, indices) == known(name)


@pytest.mark.parametrize(("quarter", "name"), list(enumerate([".00", ".25", ".50", ".75"])))
def test_an_interlaced_partial_scan_is_the_sheets(known, quarter, name):
    telegram = known(f"B0h interlaced partial scan {name}")
    count = 181 if quarter == 0 else 180
    settings = config(4, 1, indices=True)
    words = lms.value_words(1.0 + 0.001 * quarter + 0.004 * np.arange(count), np.zeros(count, int), settings)
    index = (telegram[-5], telegram[-4])
    assert lms.values(words, settings, index, partial=quarter) == telegram


def test_values_carry_the_level_in_the_three_upper_bits():
    words = lms.value_words(np.array([0.0, 12.34, 81.82]), np.array([0, 7, 3]), config(1, 0, indices=True))
    assert words.tolist() == [0, 1234 | 7 << 13, 8182 | 3 << 13]


def test_no_echo_and_too_far_are_overflow_codes():
    far = np.array([INF, 500.0])
    level = np.zeros(2, int)
    assert lms.value_words(far, level, config(1, 0, indices=True)).tolist() == [8191, 8183]
    assert lms.value_words(far, level, config(3, 1, indices=True)).tolist() == [16383, 16375]
    assert lms.value_words(far, level, config(5, 1, indices=True)).tolist() == [32767, 32759]


def test_fewer_level_bits_keep_the_upper_ones():
    level = np.array([7, 4, 3, 0])
    near = np.ones(4)
    assert (lms.value_words(near, level, config(3, 0, indices=False)) >> 14).tolist() == [3, 2, 1, 0]
    assert (lms.value_words(near, level, config(5, 0, indices=False)) >> 15).tolist() == [1, 1, 0, 0]


def test_the_status_reply_says_what_a_real_one_says_of_the_same_state(known):
    real = known("B1h status reply (real) #1")
    fields = lms.StatusFields(
        mode=0x25,
        variant=Variant(180, 50),
        config=known("F4h configuration (real)")[5:-3],
        baud=38400,
        permanent_baud=False,
        motor_us=148,
        version="V02.19 ",
        serial="05270497",
    )
    ours = lms.reply(0xB1, lms.status_data(fields))
    assert len(ours) == len(real) == 160
    body, said = ours[4:], real[4:]
    # the fields that follow from the state: section 3.1
    for first, last in ((0, 19), (67, 69), (102, 103), (107, 112), (116, 118), (119, 120), (122, 124)):
        assert body[first:last] == said[first:last], first
