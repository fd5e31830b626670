"""Telegrams in words, as `polecal-field decode` prints them."""

import json

from polecal.drivers.sick_lms import Describer, Framer, build


def described(describer: Describer, data: bytes) -> dict:
    (frame,) = Framer().feed(data, 0)
    return json.loads(json.dumps(describer.describe(frame), allow_nan=False))


def test_every_telegram_of_the_sheet_is_named_and_explained(usable):
    describer = Describer()
    for name, data in usable.items():
        said = described(describer, data)
        assert said["name"] == f"{data[4]:02X}"
        assert not said["meaning"].startswith("unknown"), name
        assert "error" not in said, name
        assert said["from"] == ("laser" if data[1] & 0x80 else "host")


def test_the_measuring_mode_is_learnt_from_the_configuration_read(usable):
    codes = usable["B0h overflow codes 13-bit mm (constructed)"]
    describer = Describer()
    assert described(describer, codes)["ranges_m"][:2] == [None, None]
    assert described(describer, codes)["no_range"]["dazzle"] == 1
    described(describer, usable["F4h configuration (real)"])
    said = described(describer, codes)
    assert (said["measuring_mode"], said["ranges_m"][0]) == ("04", 8.191)
    assert said["reflectivity"][0] is None
    assert said["field_a"][0] is False


def test_a_refused_configuration_teaches_nothing(usable):
    describer = Describer()
    described(describer, usable["F7h configuration rejected"])
    assert describer.measuring_mode == 1


def test_the_status_is_in_words_and_si(usable):
    said = described(Describer(), usable["B1h status reply (real) #1"])
    assert (said["software"], said["baud"], said["revolution_s"]) == ("V02.19 ", 38400, 0.01332)
    assert (said["fov_deg"], said["resolution_deg"]) == (180, 0.5)


def test_a_scan_has_its_indices_and_ranges_in_metres(usable):
    said = described(Describer(), usable["B0h 401 values mm 100/0.25deg with indices (constructed)"])
    assert (said["scan_index"], said["telegram_index"], said["count"]) == (7, 3, 401)
    assert said["ranges_m"][:2] == [1.0, 1.001]


def test_what_does_not_fit_its_layout_has_an_error_and_its_bytes():
    said = described(Describer(), build(bytes.fromhex("B0 03 00 64 00 10"), 0x80))
    assert "error" in said
    assert said["data"] == "03 00 64 00 10"
    assert described(Describer(), build(b"\xee\x01", 0x80))["meaning"] == "unknown reply"
