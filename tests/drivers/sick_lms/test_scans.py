"""Measurements: values, overflow codes, reflectivity, bearings and the age of beams."""

from dataclasses import replace

import numpy as np
import pytest

from polecal.drivers.errors import DeviceProtocolError
from polecal.drivers.sick_lms import (
    REVOLUTION_S,
    SCAN_CODES,
    Framer,
    Interlace,
    NoRange,
    Scan,
    beam_ages_s,
    bearings_rad,
    build,
    decode,
)


def scan_of(data: bytes) -> Scan:
    (frame,) = Framer().feed(data, 0)
    return Scan.parse(frame)


def scan(values, *, unit_m=0.01, **more) -> Scan:
    words = np.asarray(values, np.uint16)
    given = {"partial": None, "scan_index": None, "telegram_index": None, "status": 0x10}
    return Scan(0xB0, unit_m, values=words, **(given | more))


def test_every_scan_of_a_real_laser_is_ranges_of_a_room(real_telegrams):
    framer = Framer()
    frames = framer.feed(b"".join(real_telegrams), 0)
    scans = [Scan.parse(frame) for frame in frames if frame.command in SCAN_CODES]
    assert len(scans) == sum(data[4] == 0xB0 for data in real_telegrams) > 50
    for one in scans:
        ranges_m, kinds, reflectivity, flags = one.decode(0x04)  # as its F4 says
        assert (one.count, one.unit_m, one.partial, one.scan_index) == (361, 0.001, None, None)
        assert np.isnan(ranges_m).tolist() == (kinds != NoRange.RANGE).tolist()
        assert 0.05 < np.nanmin(ranges_m) < np.nanmax(ranges_m) < 16
        assert np.isnan(reflectivity).all()
        assert not flags.any()


def test_the_codes_of_the_real_laser_are_kinds(usable):
    # The sheet counted them: 3FFF no stop pulse, 3FFB signal too weak, 3FFD overflow
    kinds = decode(scan([0x3FFF, 0x3FFB, 0x3FFD, 10979], unit_m=0.001), 0x04).kinds
    assert kinds.tolist() == [
        NoRange.NO_STOP_PULSE, NoRange.SIGNAL_TOO_WEAK, NoRange.OPERATION_OVERFLOW, NoRange.RANGE
    ]  # fmt: skip


def test_the_sheets_overflow_telegram_has_each_code_once(usable):
    decoded = scan_of(usable["B0h overflow codes 13-bit mm (constructed)"]).decode(0x01)
    assert decoded.kinds[:7].tolist() == [1, 2, 3, 4, 5, 6, 0]
    assert np.isnan(decoded.ranges_m[:6]).all()
    assert decoded.ranges_m[6] == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("modes", "bits"), [((0, 1, 2), 13), ((3, 4), 14), ((5, 6, 0x0D, 0x0E, 0x0F), 15)], ids=str
)
@pytest.mark.parametrize("unit_m", [0.01, 0.001])
def test_no_code_and_nothing_beyond_the_maximum_is_ever_a_range(modes, bits, unit_m):
    words = np.arange(1 << 16, dtype=np.uint16)
    for mode in modes:
        decoded = decode(scan(words, unit_m=unit_m, interlaced=mode == 0x0F), mode)
        number = words & (1 << bits) - 1
        good = (number < (1 << bits) - 9) & (number * unit_m < 81.83)
        assert ((decoded.kinds == NoRange.RANGE) == good).all()
        assert (np.isnan(decoded.ranges_m) == ~good).all()
        np.testing.assert_allclose(decoded.ranges_m[good], number[good] * unit_m)
        assert (decoded.flags == words >> bits).all()


@pytest.mark.parametrize(("mode", "top"), [(0x01, 7), (0x03, 3), (0x05, 1)])
def test_reflector_levels_are_0_to_1(mode, top):
    bits = 16 - top.bit_length()
    decoded = decode(scan([level << bits | 500 for level in range(top + 1)]), mode)
    assert decoded.reflectivity == pytest.approx(np.arange(top + 1) / top)
    assert decoded.ranges_m == pytest.approx(5.0)


@pytest.mark.parametrize("mode", [0, 2, 4, 6, 0x0F])
def test_modes_without_levels_have_no_reflectivity(mode):
    assert np.isnan(decode(scan([0xFFFF, 0, 500]), mode).reflectivity).all()


def test_energy_instead_of_ranges_is_no_range():
    decoded = decode(scan([0, 6500, 13000, 30000]), 0x3F)
    assert (decoded.kinds == NoRange.ENERGY_ONLY).all()
    assert np.isnan(decoded.ranges_m).all()
    assert decoded.reflectivity == pytest.approx([0, 0.5, 1, 1])


def test_interlaced_scans_have_15_bits_of_range_and_no_levels_whatever_mode_is_set(usable):
    names = [f"B0h interlaced partial scan .{part} deg (constructed)" for part in ("00", "25", "50", "75")]
    parts = [scan_of(usable[name]) for name in names]
    far = parts[1].values | 0x4000
    interlace = Interlace()
    for part in (parts[0], replace(parts[1], values=far), parts[2], parts[3]):
        joined = interlace.feed(part)
    for one, values in ((replace(parts[1], values=far), far), (joined, joined.values)):
        decoded = one.decode(0x01)
        assert decoded.ranges_m == pytest.approx(values * 0.001)
        assert np.isnan(decoded.reflectivity).all()


def test_an_unknown_measuring_mode_is_refused():
    with pytest.raises(DeviceProtocolError, match="measuring mode 3E"):
        decode(scan([1]), 0x3E)


def test_a_header_of_the_sheet_is_count_unit_and_partial(usable):
    names = [f"B0h interlaced partial scan .{part} deg (constructed)" for part in ("00", "25", "50", "75")]
    parts = [scan_of(usable[name]) for name in names]
    assert [part.partial for part in parts] == [0, 1, 2, 3]
    assert [part.count for part in parts] == [181, 180, 180, 180]
    assert [(part.scan_index, part.telegram_index) for part in parts] == [(0, 0), (1, 1), (2, 2), (3, 3)]


def test_indices_are_there_only_if_two_bytes_are(usable):
    with_indices = scan_of(usable["B0h 401 values mm 100/0.25deg with indices (constructed)"])
    assert (with_indices.scan_index, with_indices.telegram_index) == (7, 3)
    without = scan_of(usable["B0h 181 values cm 180/1deg (constructed)"])
    assert (without.scan_index, without.telegram_index, without.unit_m) == (None, None, 0.01)


def test_pairs_of_range_and_energy_keep_the_lasers_own_numbers(usable):
    pairs = scan_of(usable["F5h 3 pairs of range 1..3 mm (constructed)"])
    assert pairs.spans == ((1, 3),)
    assert pairs.energy.tolist() == [7000, 12000, 0]
    decoded = pairs.decode(0x0E)
    assert decoded.ranges_m[:2] == pytest.approx([1.5, 1.501])
    assert decoded.kinds.tolist() == [0, 0, NoRange.NO_STOP_PULSE]
    assert decoded.reflectivity == pytest.approx([0, 5 / 6, 0])  # 7000 to 13000 as received
    normalised = pairs.decode(0x0D)
    assert normalised.reflectivity == pytest.approx([7000 / 13000, 12000 / 13000, 0])
    assert normalised.ranges_m[:2] == pytest.approx([1.5, 1.501])


def test_several_spans_of_energy_are_read_and_built():
    several = scan(
        [1, 2, 3, 4, 5],
        energy=np.array([9, 8, 7, 6, 5], np.uint16),
        spans=((1, 2), (10, 12)),
        scan_index=1,
        telegram_index=2,
    )
    object.__setattr__(several, "code", 0xF5)
    back = scan_of(several.build())
    assert back.spans == several.spans
    assert (back.values.tolist(), back.energy.tolist()) == ([1, 2, 3, 4, 5], [9, 8, 7, 6, 5])
    assert back.build() == several.build()


def test_s14_has_a_byte_of_reflectivity_for_each_beam(usable):
    s14 = scan_of(usable["C4h S14 181 distances + 181 reflectivity bytes (constructed)"])
    assert s14.count == 181
    assert s14.decode(0x01).reflectivity == pytest.approx(np.arange(181) / 255)


def test_means_and_sub_ranges_say_of_what(usable):
    assert scan_of(usable["B6h mean of 2, 101 values (constructed)"]).mean_of == 2
    assert scan_of(usable["B7h sub range 10..20 (constructed)"]).spans == ((10, 20),)
    both = build(bytes.fromhex("BF 05 0A 00 0B 00 02 00 64 00 65 00 10"), 0x80)
    assert (scan_of(both).mean_of, scan_of(both).spans) == (5, ((10, 11),))
    assert scan_of(both).build() == both


@pytest.mark.parametrize(
    "body",
    [
        "B0 03 00 64 00 10",  # three values announced, one there
        "B0 01 00 64 00 07 10",  # one index
        "B0 01 80 64 00 10",  # reserved unit
        "B0 10",
        "F5 01 00 01 00 02 00 02 00 64 00 10",
        "F5 00 00 10",
        "C4 01 00 64 00 02 00 01 00 02 00 05 06 10",  # reflectivity of a beam that is not there
    ],
)
def test_a_measurement_whose_parts_do_not_fit_is_refused(body):
    with pytest.raises(DeviceProtocolError):
        scan_of(build(bytes.fromhex(body), 0x80))


def test_the_first_beam_is_at_the_right_and_bearings_fall():
    bearings = np.rad2deg(bearings_rad(401, 100, 0.25))
    assert bearings[[0, 1, 200, 400]] == pytest.approx([50, 49.75, 0, -50])
    assert np.rad2deg(bearings_rad(181, 180, 1))[[0, -1]] == pytest.approx([90, -90])
    assert np.rad2deg(bearings_rad(180, 100, 0.25, partial=3))[[0, -1]] == pytest.approx([89.25, -89.75])


@pytest.mark.parametrize(("resolution_deg", "revolutions"), [(1, 1), (0.5, 2), (0.25, 4)])
@pytest.mark.parametrize("fov_deg", [100, 180])
def test_neighbouring_beams_are_of_different_revolutions(fov_deg, resolution_deg, revolutions):
    count = round(fov_deg / resolution_deg) + 1
    ages_s = beam_ages_s(fov_deg, resolution_deg, count)
    for beam in (0, 1, 2, 3, count - 1):
        angle_deg = 90 - fov_deg / 2 + beam * resolution_deg
        fired_s = (beam % revolutions + angle_deg / 360) * REVOLUTION_S
        assert ages_s[beam] == pytest.approx(revolutions * REVOLUTION_S - fired_s)
    assert (ages_s > 0.006).all()


def test_the_first_beam_of_180_degrees_is_as_old_as_the_sheet_says():
    assert beam_ages_s(180, 1, 181)[0] == pytest.approx(0.01332)
    assert beam_ages_s(180, 0.5, 361)[0] == pytest.approx(0.02664)
    assert beam_ages_s(90, 0.5, 181)[[0, -1]] == pytest.approx(np.array([7, 5]) / 8 * 0.01332)
    assert beam_ages_s(180, 0.25, 181, partial=0)[[0, -1]] == pytest.approx([0.01332, 0.00666])


def test_four_partial_scans_are_one_with_each_beam_in_its_place(usable):
    names = [f"B0h interlaced partial scan .{part} deg (constructed)" for part in ("00", "25", "50", "75")]
    parts = [scan_of(usable[name]) for name in names]
    interlace = Interlace()
    assert [interlace.feed(part) for part in parts[:3]] == [None] * 3
    joined = interlace.feed(parts[3])
    assert joined.values.tolist() == list(range(1000, 1721))
    assert (joined.partial, joined.scan_index, interlace.lost) == (None, 3, 0)
    ages_s, last_s = beam_ages_s(180, 0.25, joined.count), beam_ages_s(180, 0.25, 180, partial=3)
    assert ages_s[3::4] == pytest.approx(last_s)


def test_a_lost_partial_scan_costs_its_group_only(usable):
    names = [f"B0h interlaced partial scan .{part} deg (constructed)" for part in ("00", "25", "50", "75")]
    parts = [scan_of(usable[name]) for name in names]
    interlace = Interlace()
    given = [interlace.feed(part) for part in (parts[2], parts[3], parts[0], parts[2], parts[3], *parts)]
    assert [one is not None for one in given] == [False] * 8 + [True]
    assert interlace.lost == 5
