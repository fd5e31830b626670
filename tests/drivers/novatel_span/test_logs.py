"""Logs in named fields, against the sheet's vectors and the maker's own decoder."""

import json
import math
from dataclasses import fields, is_dataclass

import novatel_edie
import novatel_edie.oem
import pytest

from polecal.drivers.novatel_span import (
    BestPos,
    Framer,
    InsPva,
    InsPvax,
    InsStatus,
    Kind,
    MessageId,
    PositionType,
    Time,
    Version,
    parse,
)
from polecal.drivers.novatel_span.enums import NAMELESS, Component, TimeStatus
from polecal.drivers.novatel_span.fields import LOGS, layout
from polecal.drivers.novatel_span.framer import crc32
from polecal.drivers.novatel_span.logs import InsConfig, RawImux, Response, RxStatus

COMMANDS = {"LOG", "UNLOG", "UNLOGALL", "SERIALCONFIG"}


def frame_of(data):
    (frame,) = Framer().feed(data, 0)
    return frame


def leaves(value):
    """The plain values of a log, in the order of the wire."""
    if is_dataclass(value):
        return [leaf for field in fields(value) for leaf in leaves(getattr(value, field.name))]
    if isinstance(value, dict):
        return [
            leaf
            for key, item in value.items()
            if key != "header" and key.removesuffix("_length") not in value.keys() - {key}
            for leaf in leaves(item)
        ]
    if isinstance(value, list | tuple):
        return [leaf for item in value for leaf in leaves(item)]
    if isinstance(value, bytes):
        return [value.rstrip(b"\0").decode()]
    return [int(value) if isinstance(value, int) else value]


def same(ours, theirs):
    """Equal to the last bit, but for what lies behind a text's end and decimals that were read by another."""
    if isinstance(ours, float):
        return ours == theirs or math.isclose(ours, theirs, rel_tol=1e-15)
    if isinstance(ours, str):
        return ours == theirs.partition("\0")[0]
    return ours in (theirs, NAMELESS)


def agree(ours, theirs):
    ours, theirs = leaves(ours), leaves(theirs)
    return len(ours) == len(theirs) and all(map(same, ours, theirs))


def oracle(data):
    """What the maker's decoder reads from ``data``: messages with a header that are no responses."""
    parser = novatel_edie.oem.Parser()
    at, found = 0, []
    while at < len(data):
        at += parser.write(data[at : at + parser.available_space])
        found += [item for item in parser if isinstance(item, novatel_edie.oem.Message)]
    return [item for item in found if not isinstance(item, novatel_edie.oem.Response)]


def test_every_known_log_has_the_values_that_the_vectors_say(vectors):
    checked = 0
    for name, vector in vectors.items():
        if vector["crc_ok"] and frame_of(vector["wire"]).is_response:
            assert parse(frame_of(vector["wire"])) == Response(**vector["decoded"]), name
        elif vector["crc_ok"] and frame_of(vector["wire"]).name not in COMMANDS:
            log = parse(frame_of(vector["wire"]))
            assert log is not None, name
            assert agree(log, vector["edie_decoded"]), name
            if vector["decoded"]:
                assert agree(log, vector["decoded"]), name
            checked += 1
    assert checked == 44


def test_every_log_of_every_capture_agrees_with_the_makers_decoder(captures):
    compared = 0
    for entry in json.loads((captures / "novatel-index.json").read_text()):
        data = (captures / entry["file"]).read_bytes()
        ours = [
            (frame.name, parse(frame))
            for frame in Framer().feed(data, 0)
            if frame.message_id in LOGS and not frame.is_response
        ]
        known = {name for name, _ in ours}
        theirs = [message for message in oracle(data) if base_name(message) in known]
        assert [name for name, _ in ours] == [base_name(message) for message in theirs], entry["file"]
        for (name, log), message in zip(ours, theirs, strict=True):
            assert agree(log, message.to_dict()), (entry["file"], name, log)
        compared += len(ours)
    assert compared > 15_000


def base_name(message):
    return type(message).__name__.split("_")[0]


def test_binary_and_ascii_of_one_receiver_say_the_same(captures):
    def logs(name):
        return [
            (frame.name, frame.week, frame.ms, parse(frame))
            for frame in Framer().feed((captures / name).read_bytes(), 0)
            if frame.kind.checked and not frame.is_response and frame.message_id in LOGS
        ]

    binary, text = logs("gavlab_ParsingData_GPS.bin"), logs("gavlab_ParsingData_ASC.asc")
    twins = {(name, week, ms): log for name, week, ms, log in text}
    compared = 0
    for name, week, ms, log in binary:
        if (twin := twins.get((name, week, ms))) is None:
            continue
        for ours, theirs in zip(leaves(log), leaves(twin), strict=True):
            if isinstance(ours, float):
                assert ours == pytest.approx(theirs, abs=5.1e-5)  # as many decimals as the text has
            else:
                assert same(theirs, ours), (name, log, twin)
        compared += 1
    assert compared > 80


def near(ours, theirs):
    """Equal as far as the decimals of the text go."""
    if isinstance(ours, float):
        return ours == pytest.approx(theirs, abs=5.1e-5)
    return ours == theirs or NAMELESS in (ours, theirs)


def test_every_log_translated_by_the_maker_into_its_other_form_is_read_alike(vectors):
    translated = set()
    for name, vector in vectors.items():
        if not vector["crc_ok"] or frame_of(vector["wire"]).is_response or name.startswith("NEG"):
            continue
        frame = frame_of(vector["wire"])
        if frame.name in COMMANDS:
            continue
        (message,) = oracle(vector["wire"])
        other = message.to_ascii() if frame.kind in (Kind.BINARY, Kind.SHORT_BINARY) else message.to_binary()
        twin = frame_of(bytes(other.message))
        assert twin.name == frame.name
        assert twin.key == frame.key
        ours, theirs = leaves(parse(frame)), leaves(parse(twin))
        assert len(ours) == len(theirs), name
        assert all(map(near, ours, theirs)), (name, parse(frame), parse(twin))
        translated.add(frame.name)
    assert len(translated) > 20


NUMBERED = sorted(
    message.name
    for message in MessageId
    if message in LOGS and layout(LOGS[message]).fixed and hasattr(novatel_edie.oem.messages, message.name)
)


@pytest.mark.parametrize("name", NUMBERED)
def test_every_log_encoded_by_the_maker_with_a_value_of_its_own_in_each_field_is_read_alike(name):
    header = novatel_edie.oem.Header(week=2345, milliseconds=123_450.0)
    message = getattr(novatel_edie.oem.messages, name)(header=header)
    number = 0
    for field, value in message.to_dict().items():
        if type(value) in (int, float) and not field.startswith(("reserved", "rsvd")):
            number += 1
            setattr(message, field, type(value)(number))
    binary, text = frame_of(bytes(message.to_binary().message)), frame_of(bytes(message.to_ascii().message))
    assert binary.name == name
    assert (binary.week, binary.ms) == (2345, 123_450)
    for frame in (binary, text):
        read = [value for value in leaves(parse(frame)) if value and not isinstance(value, str)]
        assert [value for value in read if 0 < value <= number] == list(range(1, number + 1))


def test_every_log_that_calibration_or_its_checks_may_want_has_a_class():
    wanted = """INSPVA INSPVAS INSPVAX INSATT INSATTS INSATTX INSPOS INSPOSS INSPOSX INSVEL INSVELS INSVELX
        INSCOV INSCOVS INSSTDEV INSSTDEVS BESTPOS BESTGPSPOS BESTVEL TIME TIMESYNC MARKTIME MARK2TIME RXSTATUS
        VERSION INSCONFIG RAWIMU RAWIMUS RAWIMUX RAWIMUSX CORRIMUDATA CORRIMUDATAS VEHICLEBODYROTATION
        HEADING2"""
    assert all(MessageId[name] in LOGS for name in wanted.split())
    assert len(NUMBERED) > 35


def test_fields_carry_their_units(vectors):
    pose = InsPvax.parse(frame_of(vectors["INSPVAXB driven"]["wire"]))
    assert pose.ins_status is InsStatus.INS_SOLUTION_GOOD
    assert pose.position_type is PositionType.INS_PPP
    assert pose.azimuth_deg == pytest.approx(151.911, abs=1e-3)
    assert pose.height_ellipsoidal_m == pytest.approx(326.2797 - 36.5, abs=1e-4)
    fix = BestPos.parse(frame_of(vectors["BESTPOSB INS_PPP"]["wire"]))
    assert fix.station_id == "TSTR"
    clock = Time.parse(frame_of(vectors["TIMEB utc_offset -16"]["wire"]))
    assert clock.utc_offset_s == -16
    version = Version.parse(frame_of(vectors["VERSIONA OEM4 SPAN (real)"]["wire"]))
    assert [part.component for part in version.components] == [
        Component.GPSCARD,
        Component.IMUCARD,
        Component.ENCLOSURE,
        Component.CONTROLLER,
    ]


def test_lists_in_logs_are_read(vectors):
    status = RxStatus.parse(frame_of(vectors["RXSTATUSB"]["wire"]))
    assert len(status.words) == 5
    config = InsConfig.parse(frame_of(vectors["INSCONFIGB"]["wire"]))
    assert (len(config.translations), len(config.rotations)) == (0, 1)
    assert config.rotations[0].xyz_sigma == (3.0, 3.0, 3.0)
    imu = RawImux.parse(frame_of(vectors["RAWIMUSXA OEM6"]["wire"]))
    assert (imu.imu_status, imu.accel_z_counts) == (0x00801503, 43110635)


def test_ellipsoidal_and_sea_level_heights_of_one_moment_agree(vectors):
    ellipsoidal = InsPva.parse(frame_of(vectors["INSPVASB pair (ellipsoidal height)"]["wire"]))
    sea_level = InsPvax.parse(frame_of(vectors["INSPVAXB pair (MSL height)"]["wire"]))
    assert sea_level.height_ellipsoidal_m == pytest.approx(ellipsoidal.height_ellipsoidal_m, abs=1e-4)


def with_status(vectors, status):
    wire = vectors["INSPVASB OEM6"]["wire"]
    head = wire[:-8] + status.to_bytes(4, "little")
    return head + crc32(head).to_bytes(4, "little")


def test_an_unknown_word_for_a_status_is_no_good_one(vectors):
    line = vectors["INSPVASA short"]["ascii"].replace("INS_SOLUTION_GOOD", "INS_SOLUTION_BETTER")
    text = line[1 : line.index("*")].encode()
    assert InsPva.parse(frame_of(b"%" + text + b"*%08x\r\n" % crc32(text))).ins_status == NAMELESS


def test_an_unknown_status_stays_a_number(vectors):
    pose = InsPva.parse(frame_of(with_status(vectors, 99)))
    assert pose.ins_status == 99
    assert not isinstance(pose.ins_status, InsStatus)


def test_every_ins_status_says_what_it_means():
    assert all(status.meaning for status in InsStatus)


def test_older_names_of_a_status_are_read(vectors):
    line = vectors["INSPVASA short"]["ascii"].replace("INS_SOLUTION_GOOD", "INS_SOLUTION_NOT_GOOD")
    text = line[1 : line.index("*")].encode()
    frame = frame_of(b"%" + text + b"*%08x\r\n" % crc32(text))
    assert InsPva.parse(frame).ins_status is InsStatus.INS_HIGH_VARIANCE


def test_a_frame_of_another_log_is_refused(vectors):
    with pytest.raises(ValueError, match="BESTPOS is no InsPva"):
        InsPva.parse(frame_of(vectors["BESTPOSB INS_PPP"]["wire"]))


def test_a_body_that_is_too_short_is_no_log():
    head = b"\xaa\x44\x13\x08" + (508).to_bytes(2, "little") + bytes(6) + bytes(8)
    frame = frame_of(head + crc32(head).to_bytes(4, "little"))
    assert frame.kind is Kind.SHORT_BINARY
    assert parse(frame) is None
    with pytest.raises(ValueError, match="not as it should be"):
        InsPva.parse(frame)


def test_an_absurd_count_in_a_body_is_no_log():
    body = (0).to_bytes(4, "little") + (0xFFFFFFFF).to_bytes(4, "little")
    head = b"\xaa\x44\x12\x1c" + (93).to_bytes(2, "little") + bytes(2) + (8).to_bytes(2, "little") + bytes(18)
    frame = frame_of(head + body + crc32(head + body).to_bytes(4, "little"))
    assert frame.message_id == MessageId.RXSTATUS
    assert parse(frame) is None


def test_names_are_those_of_the_makers_table():
    table = novatel_edie.get_builtin_database()
    for message in MessageId:
        known = table.get_msg_def(message.value)
        if known is not None:
            assert known.name == message.name


def test_time_status_names_are_read():
    assert TimeStatus(180).name == "FINESTEERING"
