import numpy as np
import pytest

from polecal.drivers.emulated import laser_telegrams as lms
from polecal.drivers.emulated.laser_values import (
    IN_RANGE,
    MEASURING_MODES,
    Beams,
    Fault,
    Fields,
    energy_words,
    mean,
    reflectivity_bytes,
    value_words,
)


def config(mode, unit=0):
    return lms.DEFAULT_CONFIG[:5] + bytes([mode, unit]) + lms.DEFAULT_CONFIG[7:]


def beams(range_m, level=0, fault=IN_RANGE, fields=0):
    range_m = np.atleast_1d(np.asarray(range_m, float))
    return Beams(range_m, *(np.broadcast_to(given, range_m.shape) for given in (level, fault, fields)))


def test_the_unit_is_cm_or_mm():
    assert value_words(beams([0.0, 12.34, 81.82]), config(0)).tolist() == [0, 1234, 8182]
    assert value_words(beams([0.0, 1.234, 8.182]), config(0, 1)).tolist() == [0, 1234, 8182]


@pytest.mark.parametrize(
    ("mode", "bits", "upper"),
    [
        (0x00, 13, 0),
        (0x01, 13, 5),
        (0x02, 13, 0),
        (0x03, 14, 2),
        (0x04, 14, 0),
        (0x05, 15, 1),
        (0x06, 15, 0),
        (0x0F, 15, 0),
        (0x0D, 15, 0),
        (0x0E, 15, 0),
    ],
)
def test_a_level_fills_the_bits_that_a_mode_has_for_it(mode, bits, upper):
    assert value_words(beams(1.0, level=5), config(mode)).tolist() == [100 | upper << bits]


@pytest.mark.parametrize(
    ("mode", "fields", "word"),
    [
        (0x00, Fields.A, 1 << 13),
        (0x00, Fields.B | Fields.C, 1 << 14),
        (0x01, Fields.A, 0),
        (0x02, Fields.A | Fields.C, 1 << 13 | 1 << 15),
        (0x04, Fields.A | Fields.B, 1 << 14 | 1 << 15),
        (0x06, Fields.A, 1 << 15),
        (0x0F, Fields.A, 0),
    ],
)
def test_fields_are_flags_where_a_mode_has_them(mode, fields, word):
    assert value_words(beams(0.0, fields=fields), config(mode)).tolist() == [word]


@pytest.mark.parametrize(
    ("mode", "codes"),
    [
        (0x02, [8191, 8190, 8189, 8187, 8186, 8183]),
        (0x03, [16383, 16382, 16381, 16379, 16378, 16375]),
        (0x05, [32767, 32766, 32765, 32763, 32762, 32759]),
    ],
)
def test_each_fault_has_its_overflow_code_and_no_level(mode, codes):
    faulty = beams(np.ones(6), level=7, fault=np.array(list(Fault)))
    assert value_words(faulty, config(mode)).tolist() == codes


def test_what_is_too_far_for_the_bits_is_the_largest_value():
    assert value_words(beams([81.83, 82.0, 500.0]), config(1)).tolist() == [8183] * 3
    assert value_words(beams([8.19, 16.4]), config(3, 1)).tolist() == [8190, 16375]


def test_dazzle_has_a_flag_in_mode_00_besides_its_code():
    assert value_words(beams(1.0, fault=Fault.DAZZLE), config(0)).tolist() == [8190 | 1 << 15]
    assert value_words(beams(1.0, fault=Fault.NO_ECHO), config(0)).tolist() == [8191]


def test_energy_grows_with_the_level_and_is_nothing_without_an_echo():
    seen = beams(np.ones(8), level=np.arange(8))
    unnormalised, normalised = (energy_words(seen, config(mode)).astype(int) for mode in (0x0E, 0x0D))
    assert (unnormalised[0], unnormalised[-1]) == (7000, 13000)
    assert (normalised[0], normalised[-1]) == (0, 13000)
    assert np.all(np.diff(unnormalised) > 0)
    assert np.all(np.diff(normalised) > 0)
    assert reflectivity_bytes(seen).tolist() == [0, 36, 73, 109, 146, 182, 219, 255]
    gone = beams(np.inf, level=7, fault=Fault.NO_ECHO)
    assert energy_words(gone, config(0x0E)).tolist() == reflectivity_bytes(gone).tolist() == [0]


def test_mode_3f_has_energy_in_place_of_distance():
    seen = beams([1.0, 2.0], level=np.array([0, 7]))
    assert (
        value_words(seen, config(0x3F)).tolist() == energy_words(seen, config(0x3F)).tolist() == [7000, 13000]
    )


def test_a_mean_is_of_the_scans_that_saw_something():
    scans = [beams([1.0, 1.0, 1.0], 2), beams([2.0, 5.0, 1.0], 4)]
    blind = Beams(
        np.array([np.inf, np.inf, 1.0]),
        np.array([0, 0, 3]),
        np.array([Fault.NO_ECHO, Fault.NO_ECHO, IN_RANGE]),
        np.zeros(3, int),
    )
    found = mean([*scans, blind])
    assert found.range_m.tolist() == [1.5, 3.0, 1.0]
    assert found.level.tolist() == [3, 3, 3]
    assert found.fault.tolist() == [IN_RANGE] * 3
    assert mean([blind, blind]).fault.tolist() == blind.fault.tolist()


def test_every_measuring_mode_packs():
    assert len(MEASURING_MODES) == 11
    for mode in MEASURING_MODES:
        assert value_words(beams([1.0, 2.0]), config(mode)).shape == (2,)
