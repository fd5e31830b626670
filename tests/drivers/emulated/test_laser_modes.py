"""What is allowed in which mode, what each mode sends, and what outlives the power."""

import itertools

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from polecal.drivers.emulated import laser_telegrams as lms
from polecal.drivers.emulated.laser import EmulatedLaser, Fault, Fields, Health, Quirks
from polecal.drivers.emulated.laser_telegrams import Variant

ACK = b"\x06"
S05, S14, LMS200 = "LMS291;S05;V02.10 ", "LMS291;S14;V02.10 ", "LMS200;S18063;V02.19 "
TURN_S = 0.01332


def config(mode, unit=0, *, indices=True):
    return lms.DEFAULT_CONFIG[:4] + bytes([2 * indices, mode, unit]) + lms.DEFAULT_CONFIG[7:]


def variant(angle_deg, resolution_cdeg):
    return "3B" + (angle_deg.to_bytes(2, "little") + resolution_cdeg.to_bytes(2, "little")).hex()


@pytest.fixture
def connect(parked, host, t0_ns):
    """A host at 9600 of a laser that has booted."""

    def make(**how):
        given = {"quirks": Quirks(no_echo=0.0), "drift_ppm": 0.0, **how}
        client = host(EmulatedLaser(parked(), t0_ns=t0_ns, **given), given.get("baud", 9600))
        client.listen(1.0)
        return client

    return make


def ask(client, payload, seconds=1.0):
    """Return the payload of the answer to a payload; the rate is followed."""
    sent = bytes.fromhex(payload)
    heard = client.ask(lms.telegram(0, sent), seconds)
    assert ACK in heard
    if sent[0] == lms.Command.MODE and len(sent) == 2:
        client.baud = lms.BAUD_OF_SUB.get(sent[1], client.baud)
    start = heard.index(ACK + b"\x02\x80") + 1
    size = int.from_bytes(heard[start + 2 : start + 4], "little")
    return heard[start + 4 : start + 4 + size]


def whole(data):
    """Return the whole telegrams of a stream that was begun in the middle."""
    found, at = [], 0
    while (at := data.find(b"\x02\x80", at)) >= 0:
        telegram = data[at : at + 6 + int.from_bytes(data[at + 2 : at + 4], "little")]
        if lms.crc16(telegram[:-2]).to_bytes(2, "little") == telegram[-2:]:
            found.append(telegram)
            at += len(telegram)
        else:
            at += 1
    return found


# --- what is allowed

INSTALL = "2000" + b"SICK_LMS".hex()
ALWAYS = ["31", "32", "35", "3A", variant(180, 100), "4A", "74", "7B", "4101"]
VALUES = ["3001", "3006", "3007", "3008", "3602", "37 0100 0A00", "3F 02 0100 0A00", "75 0100 0100 0A00"]
INSTALLATION_ONLY = ["77" + config(0x0E).hex(), "6600", "6601", "6602"]


@pytest.mark.parametrize("mode", ["2025", "2024", "2010", INSTALL])
def test_most_requests_are_answered_in_every_mode_and_some_in_installation_mode_alone(connect, mode):
    client = connect(eeprom=config(0x0E))
    for payload in [*ALWAYS, *VALUES, *INSTALLATION_ONLY]:
        ask(client, mode)
        code = ask(client, payload, 6.0)[0]
        allowed = mode == INSTALL or payload not in INSTALLATION_ONLY
        assert code == (int(payload[:2], 16) + 0x80 if allowed else lms.REJECTED), payload


@pytest.mark.parametrize(
    ("mode", "byte"), [(INSTALL, 0x00), ("2010", 0x10), ("2024", 0x24), ("2025", 0x25), ("2021", 0x21)]
)
def test_the_status_says_the_mode(connect, mode, byte):
    client = connect()
    assert ask(client, mode)[:2] == b"\xa0\x00"
    assert ask(client, "31", 3.0)[8] == byte


@pytest.mark.parametrize(
    "payload",
    [
        "1000", "3000", "3002", "3009", "30", "3601", "36FB", "3602FF", "37 0000 0A00", "37 0A00 0900",
        "37 0100 6A01", "37 01", "3F 01 0100 0A00", "3F 02 0100 6A01", "3100", "3A00", "3B B400", "4102",
        "75", "75 0000", "75 0600", "75 0100 0100", "75 0100 0100 C800", "44 0100 0A00", "7F", "90", "2C",
        "01",
    ],
)  # fmt: skip
def test_what_is_malformed_or_unknown_is_rejected(connect, payload):
    assert ask(connect(eeprom=config(0x0E)), payload) == b"\x92\x10"


@pytest.mark.parametrize(
    "payload",
    ["20", "2099", "2020", "2022", "202500", "204000", "2026", "2027 8100 0A00", "202B 0100", "202C 00"],
)
def test_a_mode_that_cannot_be_is_refused_and_the_old_one_stays(connect, payload):
    client = connect(eeprom=config(0x0E))
    assert ask(client, payload) == b"\xa0\x01\x10"
    assert client.device.mode == 0x25


@pytest.mark.parametrize(("pairs", "code"), [(199, 0xF5), (200, 0x92)])
def test_energy_is_limited_by_the_longest_telegram(connect, pairs, code):
    payload = "75 0100 0100" + pairs.to_bytes(2, "little").hex()
    reply = ask(connect(eeprom=config(0x0E)), payload, 2.0)
    assert reply[0] == code
    assert len(reply) in (2, 812 - 6 + 2)


def test_an_s14_has_one_variant_of_one_turn(connect):
    client = connect(type_string=S14)
    for other in (variant(180, 50), variant(180, 100), variant(100, 25)):
        assert ask(client, other)[1] == 0
    assert ask(client, variant(90, 50))[1] == 1
    assert ask(client, "31")[107:111] == bytes.fromhex("5A00 3200")
    for mode in (0x02, 0x01, 0x05):
        ask(client, INSTALL)
        assert ask(client, "77" + config(mode).hex())[1] == 1
    for mode in (0x0D, 0x0E, 0x3F):
        assert ask(client, "77" + config(mode).hex())[1] == 0


# --- what is sent


@pytest.mark.parametrize(
    ("kind", "settled", "set_to", "mode", "code", "size", "turns"),
    [
        (S05, config(1), variant(180, 100), "2024", 0xB0, 374, 1),
        (S05, config(1), variant(180, 50), "2024", 0xB0, 734, 2),
        (S05, config(1), variant(100, 25), "2024", 0xB0, 814, 4),
        (S05, config(1), variant(180, 50), "2026 02", 0xB6, 735, 4),
        (S05, config(1), variant(180, 50), "2027 0100 0B00", 0xB7, 38, 2),
        (S05, config(1), variant(180, 100), "2028 03 0100 0B00", 0xBF, 39, 3),
        (S05, config(1), variant(180, 100), "202C 05 0100 B500", 0xB7, 26, 1),
        (S05, config(0x0E), variant(180, 100), "202B 0100 0100 B500", 0xF5, 742, 2),
        (S05, config(0x0E), variant(180, 100), "202B 0100 0100 7A00", 0xF5, 506, 1),
        (S05, config(0x0E), variant(180, 50), "202B 0100 0100 B500", 0xF5, 742, 2),
        (S05, config(0x0E), variant(100, 25), "202B 0200 0100 0A00 1400 1D00", 0xF5, 104, 4),
        (S14, config(1, indices=False), variant(90, 50), "2050 0100 B500", 0xC4, 559, 1),
        (S14, config(1), variant(90, 50), "2024", 0xB0, 374, 1),
        (LMS200, config(4, 1), variant(180, 50), "2024", 0xB0, 734, 2),
    ],
)
def test_a_mode_sends_its_telegrams_at_its_pace(  # noqa: PLR0917
    connect, kind, settled, set_to, mode, code, size, turns
):
    client = connect(type_string=kind, eeprom=settled)
    ask(client, set_to)
    ask(client, "2048")
    assert ask(client, mode, 0.1)[:2] == b"\xa0\x00"
    found = whole(client.listen(1.0 + turns * TURN_S))
    assert {telegram[4] for telegram in found} == {code}
    assert {len(telegram) for telegram in found} == {size}
    assert len(found) == pytest.approx(1.0 / (turns * TURN_S), abs=2)
    if settled[lms.AVAILABILITY]:
        assert {(b[-5] - a[-5]) % 256 for a, b in itertools.pairwise(found)} == {turns}
        assert {(b[-4] - a[-4]) % 256 for a, b in itertools.pairwise(found)} == {1}


@pytest.mark.parametrize("mode", ["2021", "2023", "2010", INSTALL])
def test_other_modes_send_nothing(connect, mode):
    client = connect()
    ask(client, mode)
    assert client.listen(5.0) == b""


def test_a_part_of_a_scan_is_that_part(connect):
    client = connect(eeprom=config(1, indices=False))
    every = np.frombuffer(ask(client, "3001", 2.0)[3:-1], "<u2")
    assert np.array_equal(np.frombuffer(ask(client, "3006", 2.0)[3:-1], "<u2") & 0x1FFF, every[::2] & 0x1FFF)
    assert np.array_equal(np.frombuffer(ask(client, "3007", 2.0)[3:-1], "<u2") & 0x1FFF, every[::20] & 0x1FFF)
    part = ask(client, "37 6400 C800", 2.0)
    assert part[1:7] == bytes.fromhex("6400 C800 6500")
    assert np.array_equal(np.frombuffer(part[7:-1], "<u2") & 0x1FFF, every[99:200] & 0x1FFF)


def test_segments_are_the_nearest_in_each(connect):
    client = connect(eeprom=config(1, indices=False))
    every = np.frombuffer(ask(client, "3001", 2.0)[3:-1], "<u2") & 0x1FFF
    ask(client, "202C 04 0100 6801")
    segments = np.frombuffer(whole(client.listen(1.0))[-1][11:-3], "<u2") & 0x1FFF
    assert segments.tolist() == every[:360].reshape(4, 90).min(axis=1).tolist()


def test_a_mean_of_250_takes_as_long_as_the_sheet_says(connect):
    client = connect()
    ask(client, variant(100, 25))
    client.ask(lms.telegram(0, b"\x36\xfa"), 0.0)
    assert client.listen(10.0) == ACK
    assert client.listen(4.5)[4:6] == b"\xb6\xfa"


def test_partial_scans_are_32_m_without_flags_unless_the_firmware_sets_them(connect):
    for quirks, levels in (
        (Quirks(no_echo=0.0), {0}),
        (Quirks(no_echo=0.0, flags_in_partials=True), {0, 1, 6, 7}),
    ):
        client = connect(eeprom=lms.STREAM_CONFIG, quirks=quirks)
        ask(client, variant(100, 25))
        ask(client, "2048")
        ask(client, "202A", 0.1)
        words = [np.frombuffer(scan, "<u2", 180, 7) for scan in whole(client.listen(0.5))]
        near = np.concatenate(words)
        assert set((near[near & 0x1FFF < 8183] >> 13).tolist()) <= levels
        assert (near == 0x7FFF).any() == (levels == {0})
        assert len(set((near[near & 0x1FFF < 8183] >> 13).tolist())) == len(levels)


def test_faults_and_fields_are_where_they_are_put(connect):
    client = connect()
    client.device.faults.update({3: Fault.DAZZLE, 360: Fault.READ_ERROR, 500: Fault.TOO_FAR})
    client.device.fields[100] = Fields.A | Fields.B
    words = np.frombuffer(ask(client, "3001", 2.0)[3:-1], "<u2")
    assert words[3] == 8190 | 1 << 15
    assert words[360] == 8186
    assert np.flatnonzero(words >> 13 & 3).tolist() == [100]
    client.device.faults.clear()
    assert np.frombuffer(ask(client, "3001", 2.0)[3:-1], "<u2")[3] != 8190 | 1 << 15


def test_a_change_of_variant_changes_the_running_stream(connect):
    client = connect(eeprom=lms.STREAM_CONFIG)
    ask(client, "2048")
    ask(client, "2024", 0.2)
    ask(client, variant(100, 100), 0.5)
    assert {len(scan) for scan in whole(client.listen(0.5))} == {214}


def test_a_request_for_values_interrupts_a_stream_and_it_goes_on(connect):
    client = connect(eeprom=lms.STREAM_CONFIG)
    ask(client, "2048")
    ask(client, "2024", 0.2)
    assert ask(client, "37 0100 0A00", 0.2)[0] == 0xB7
    assert {scan[4] for scan in whole(client.listen(0.2))} == {0xB0}


# --- health


def test_health_shows_in_replies_status_and_error_list(connect):
    client = connect()
    client.device.health = Health(
        errors=((2, 17), (0x84, 22)),
        pollution=tuple(range(8)),
        reference_pollution=(9, 9, 9, 9),
        polluted=True,
    )
    status = ask(client, "31")
    assert status[-1] == 0x92
    assert status[9] == 2
    assert np.frombuffer(status, "<u2", 12, 19).tolist() == [0, 1, 2, 3, 4, 5, 6, 7, 9, 9, 9, 9]
    assert ask(client, "32") == bytes.fromhex("B2 0211 8416 92")


def test_a_reset_leaves_errors_as_history(connect):
    client = connect()
    client.device.health = Health(errors=((3, 29),))
    assert ask(client, "32") == bytes.fromhex("B2 031D 13")
    ask(client, "10", 3.0)
    assert ask(client, "32") == bytes.fromhex("B2 831D 10")


# --- power


def test_a_power_cycle_ends_a_stream_and_says_hello_at_9600(connect):
    client = connect(eeprom=lms.STREAM_CONFIG)
    ask(client, variant(100, 25))
    ask(client, "2048")
    ask(client, "2024", 0.3)
    client.device.power_cycle(client.t_ns, off_s=2.0)
    assert len(client.listen(1.9)) <= 1
    assert client.ask(lms.telegram(0, b"\x31"), 0.5) == b""
    client.baud = 9600
    assert client.listen(1.0) == lms.reply(lms.POWER_ON, S05.encode())
    assert client.listen(5.0) == b""
    status = ask(client, "31")
    assert status[8] == 0x25
    assert status[102] == 0x01
    assert status[107:111] == bytes.fromhex("B400 3200")
    assert ask(client, "35")[3:5] == b"\x02\x00"


def test_what_66h_made_permanent_outlives_a_power_cycle_until_it_is_taken_back(connect):
    client = connect()
    ask(client, "2040")
    ask(client, variant(100, 25))
    ask(client, INSTALL)
    ask(client, "6601")
    ask(client, "6602")
    assert client.device.eeprom_writes == 2
    client.device.power_cycle(client.t_ns)
    assert client.listen(3.0) == lms.reply(lms.POWER_ON, S05.encode())  # at 38400
    assert client.device.variant == Variant(100, 25)
    assert ask(client, "31")[119] == 1
    ask(client, INSTALL)
    ask(client, "6600")
    client.device.power_cycle(client.t_ns)
    client.baud = 9600
    assert client.listen(3.0) == lms.reply(lms.POWER_ON, S05.encode())
    assert ask(client, "31")[119] == 0


def test_a_laser_may_come_up_at_another_rate_for_good(connect):
    client = connect(baud=500000)
    assert ask(client, "31")[116:120] == bytes.fromhex("0180 02 01")
    ask(client, "10", 3.0)
    assert ask(client, "3A") == b"\xba" + S05.encode() + b"\x10"


# --- whatever is asked

PAYLOADS = st.one_of(
    st.sampled_from([*ALWAYS, *VALUES, *INSTALLATION_ONLY, INSTALL, "2024", "202A", "2050 0100 B500"]).map(
        bytes.fromhex
    ),
    st.builds(
        lambda command, data: bytes([command]) + data,
        st.sampled_from([code for code in lms.Command if code != lms.Command.RESET]),
        st.binary(max_size=9),
    ),
)


@settings(max_examples=80, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(kind=st.sampled_from([S05, S14, LMS200]), payloads=st.lists(PAYLOADS, min_size=1, max_size=6))
def test_whatever_is_asked_gets_an_ack_and_one_whole_answer(connect, kind, payloads):
    client = connect(type_string=kind, eeprom=config(0x01))
    for payload in payloads:
        if payload[0] == 0x36 or payload[:2] == b"\x20\x26":
            continue  # means of many scans take their time
        heard = ask(client, payload.hex(), 3.0)
        assert heard[0] in (payload[0] + 0x80, lms.REJECTED)
        ask(client, "2025", 1.0)
