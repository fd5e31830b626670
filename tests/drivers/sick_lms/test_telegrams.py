"""Requests and replies against the sheet's telegrams, both ways."""

import inspect

import pytest

from polecal.drivers.errors import DeviceProtocolError
from polecal.drivers.sick_lms import SCAN_CODES, Frame, Framer, Scan, configuration, health, telegrams
from polecal.drivers.sick_lms.configuration import Configuration, ConfigurationRead, WriteConfiguration
from polecal.drivers.sick_lms.health import Errors, Status
from polecal.drivers.sick_lms.telegrams import (
    BAUD_MODES,
    Counters,
    ModeSwitched,
    OperatingMode,
    PowerOn,
    RequestEnergy,
    RequestS14,
    RequestStatus,
    RequestType,
    Reset,
    SwitchMode,
    SwitchVariant,
    Telegram,
    TypeText,
    VariantSwitched,
    build,
    energy_spans,
)

CLASSES = {
    value.code: value
    for module in (telegrams, health, configuration)
    for value in vars(module).values()
    if inspect.isclass(value) and issubclass(value, Telegram) and hasattr(value, "code")
}
# sheet: "no" in the column of support, or only named
LEFT_ALONE = {0x3E, 0x3F, 0x40, 0x41, 0x42, 0x45, 0x46, 0x76, 0x7C, 0xC1}


NOT_PRINTED = {  # made by the layouts of the sheet's sections 3 and 4, as it has none that are right
    "BFh mean of 5, beams 10 to 11": build(bytes.fromhex("BF 05 0A 00 0B 00 02 00 64 00 65 00 10"), 0x80),
    "FBh configuration part 2": build(b"\xfb" + bytes(range(84)) + b"\x10", 0x80),
    "FBh configuration part 2, old firmware": build(b"\xfb" + bytes(4) + b"\x10", 0x80),
}


def frame_of(data: bytes) -> Frame:
    (frame,) = Framer().feed(data, 0)
    return frame


def test_every_telegram_of_the_sheet_is_read_and_built_again(usable, tell):
    covered = {}
    for name, data in (usable | NOT_PRINTED).items():
        frame = frame_of(data)
        if frame.command in LEFT_ALONE:
            assert build(frame.body, frame.address) == data
            continue
        known = Scan if frame.command in SCAN_CODES else CLASSES[frame.command]
        assert known.parse(frame).build(frame.address) == data, name
        covered.setdefault(frame.command, []).append(name)
    tell("code  telegrams covered")
    for code, names in sorted(covered.items()):
        tell(f"{code:02X}    {len(names):2}  {names[0]}")
    wanted = "10 20 30 31 32 35 36 37 3A 3B 44 4A 66 74 75 77 7B 90 91 92 A0 B0 B1 B2 B5 B6 B7 BA BB C4 CA E6"
    assert set(bytes.fromhex(wanted)) | {0xBF, 0xF4, 0xF5, 0xF7, 0xFB} == set(covered)


@pytest.mark.parametrize(
    ("telegram", "name"),
    [
        (Reset(), "10h reset"),
        (RequestStatus(), "31h status request"),
        (RequestType(), "3Ah type request"),
        (SwitchMode.installation(), "20h 00 installation mode, password SICK_LMS"),
        (SwitchMode(OperatingMode.STREAM), "20h 24 start continuous output of all values"),
        (SwitchMode(OperatingMode.ON_REQUEST), "20h 25 monitoring on request (stop stream)"),
        (SwitchMode(BAUD_MODES[500000]), "20h 48 set 500000 baud"),
        (SwitchMode(BAUD_MODES[38400]), "20h 40 set 38400 baud"),
        (SwitchMode(BAUD_MODES[19200]), "20h 41 set 19200 baud"),
        (SwitchMode(BAUD_MODES[9600]), "20h 42 set 9600 baud"),
        (SwitchVariant(100, 25), "3Bh variant 100deg / 0.25deg"),
        (SwitchVariant(180, 100), "3Bh variant 180deg / 1deg"),
        (RequestS14(1, 181), "44h distance + reflectivity sub range 1..181 (S14)"),
        (RequestEnergy(((1, 401),)), "75h distance+reflectivity request, 1 range 1..401"),
        (
            SwitchMode(OperatingMode.STREAM_ENERGY, energy_spans((1, 181))),
            "20h 2B distance+reflectivity stream, 1 range 1..181",
        ),
        (ModeSwitched(0), "A0h mode switch ok (status 10h)"),
        (ModeSwitched(1), "A0h installation refused (bad password)"),
        (VariantSwitched(True, 180, 50), "BBh variant 180/0.5 set"),
        (VariantSwitched(False, 180, 50), "BBh variant refused"),
        (TypeText("LMS200;S18063;V02.19 "), "BAh type string LMS200;S18063;V02.19"),
        (Errors(()), "B2h no errors"),
    ],
)
def test_a_telegram_built_from_its_meaning_is_the_sheets(telegram, name, usable):
    assert telegram.build() == usable[name]
    assert type(telegram).parse(frame_of(usable[name])) == telegram


def test_the_status_of_a_real_laser_says_what_the_sheet_found_in_it(usable):
    status = Status.parse(frame_of(usable["B1h status reply (real) #1"]))
    assert (status.software, status.serial, status.boot_prom) == ("V02.19 ", "05270497", "V02.02 ")
    assert (status.operating_mode, status.defect, status.measuring_mode) == (0x25, 0, 4)
    assert (status.fov_deg, status.resolution_cdeg, status.unit) == (180, 50, 1)
    assert (status.baud, status.motor, status.laser_power_percent) == (38400, 148, 161)
    assert status.revolution_s == pytest.approx(0.01332)
    assert (status.laser_on, status.permanent_baud, status.address, status.evaluations) == (1, 0, 0, 2)
    assert len(status.pollution) == 8


def test_the_status_of_146_bytes_has_the_same_fields_six_bytes_earlier(usable):
    body = frame_of(usable["B1h status reply (real) #1"]).body
    short = build(body[:10] + body[16:], 0x80)
    status, full = Status.parse(frame_of(short)), Status.parse(frame_of(build(body, 0x80)))
    assert (status.motor, status.baud, status.boot_prom) == (full.motor, full.baud, full.boot_prom)
    assert len(status.serial) == 2
    assert status.build() == short


def test_the_error_list_of_a_real_laser_has_texts(usable):
    faults = Errors.parse(frame_of(usable["B2h real error list"])).faults
    assert len(faults) == 11
    assert faults[0].text == "fatal 22: reference channel pollution (past)"
    assert (faults[1].severity, faults[1].number, faults[1].past) == (4, 49, True)
    assert faults[-1].text == "info 49: laser power"


def test_the_power_on_string_is_the_type(usable):
    power_on = PowerOn.parse(frame_of(usable["90h power-on string (QM, address 81)"]))
    assert power_on.text == "LMS200;301063;V02.06 "
    assert power_on.status == 0x13


def test_counters_are_in_hours():
    assert Counters(200, 3).build() == build(bytes.fromhex("B5 64 00 03 00 10"), 0x80)


@pytest.mark.parametrize("size", [32, 34])
def test_a_configuration_changes_in_mode_unit_and_indices_and_in_nothing_else(size):
    data = bytes(range(100, 100 + size))
    wanted = bytearray(data)
    wanted[4], wanted[5], wanted[6] = data[4] | 2, 1, 0
    assert Configuration(data).streaming(1).data == bytes(wanted)


def test_a_configuration_of_the_sheet_is_already_right(usable):
    name = "77h LMS291 config, mode 01 reflector levels, cm, indices on, high sensitivity"
    right = WriteConfiguration.parse(frame_of(usable[name])).configuration
    assert right.streaming(1) == right
    assert (right.sensitivity, right.availability, right.measuring_mode, right.unit) == (3, 3, 1, 0)


@pytest.mark.parametrize(
    "body", ["A0 10", "A0", "BB 01 B4 10", "B1 00 10", "F4 00 00 10", "B2 84 16 84 10", "CA 01 10", "B5 10"]
)
def test_a_reply_of_the_wrong_size_is_refused_not_misread(body):
    frame = frame_of(build(bytes.fromhex(body), 0x80))
    with pytest.raises(DeviceProtocolError):
        CLASSES[frame.command].parse(frame)


def test_another_telegram_is_refused(usable):
    with pytest.raises(DeviceProtocolError, match="A0 where F4"):
        ConfigurationRead.parse(frame_of(usable["A0h mode switch ok (status 10h)"]))
