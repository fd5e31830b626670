from polecal.drivers.emulated import laser_telegrams as lms
from polecal.drivers.emulated.laser_telegrams import Health


def test_every_usable_telegram_of_the_sheet_has_our_crc(telegrams):
    assert len(telegrams) > 60
    for entry in telegrams:
        data = bytes.fromhex(entry["hex"])
        assert lms.crc16(data[:-2]).to_bytes(2, "little") == data[-2:], entry["name"]


def test_the_status_byte_says_the_worst_error_that_is_not_past():
    assert Health().status == 0x10
    assert Health(errors=((0x84, 22), (1, 49))).status == 0x11
    assert Health(errors=((1, 49), (4, 22), (2, 17))).status == 0x14
    assert Health(errors=((0x84, 22),)).status == 0x10


def test_the_status_byte_has_a_bit_for_restart_implausible_values_and_pollution():
    assert Health(restart=True).status == 0x30
    assert Health(implausible=True).status == 0x50
    assert Health(polluted=True, errors=((2, 17),)).status == 0x92
