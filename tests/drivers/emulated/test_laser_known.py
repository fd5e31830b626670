"""The sheet's telegrams both ways: a host's get its answers, a laser's come from the state they tell of."""

import ast
import json
from pathlib import Path

import numpy as np
import pytest

from polecal.drivers.emulated import laser_telegrams as lms
from polecal.drivers.emulated.laser import EmulatedLaser, Fault, Fields, Health, Quirks

ACK, NAK = b"\x06", b"\x15"
S05, S14, LMS200 = "LMS291;S05;V02.10 ", "LMS291;S14;V02.10 ", "LMS200;S18063;V02.19 "
INSTALL = bytes.fromhex("20 00") + b"SICK_LMS"
STOP, PARTIALS = b"\x20\x25", b"\x20\x2a"
OK, REFUSED, REJECTED = b"\xa0\x00", b"\xa0\x01", b"\x92"


def variant(angle_deg, resolution_cdeg):
    return b"\x3b" + angle_deg.to_bytes(2, "little") + resolution_cdeg.to_bytes(2, "little")


def config(mode, unit=0, *, indices=False):
    given = bytearray(lms.DEFAULT_CONFIG)
    given[lms.AVAILABILITY] = 2 * indices
    given[lms.MEASURING_MODE], given[lms.UNIT] = mode, unit
    return bytes(given)


class GivenWorld:
    """Not a world: what each beam meets, as it is given."""

    def __init__(self, range_m=1.0, level=0):
        self.range_m, self.level = range_m, level
        self.start_ns = None

    def start(self, t_ns):
        self.start_ns = t_ns

    def seconds(self, t_ns):
        return np.zeros(len(t_ns))

    def range_scan(self, t_s, bearing_rad, key):
        return np.broadcast_to(self.range_m, t_s.shape), np.broadcast_to(self.level, t_s.shape)


@pytest.fixture
def connect(host, t0_ns):
    """A host of a laser that has booted and been told some things, each of which it took."""

    def make(*said, world=None, health=None, **how):
        quirks = how.pop("quirks", Quirks(no_echo=0.0))
        laser = EmulatedLaser(world or GivenWorld(), t0_ns=t0_ns, drift_ppm=0.0, quirks=quirks, **how)
        client = host(laser, how.get("baud", 9600))
        client.listen(1.0)
        if health is not None:
            laser.health = health
        for payload in said:
            assert client.ask(lms.telegram(0, payload), 1.0)[5:6] not in (b"", REJECTED), payload.hex()
            if payload[0] == 0x20 and payload[1] in lms.BAUD_OF_SUB:
                client.baud = lms.BAUD_OF_SUB[payload[1]]
        return client

    return make


# --- what the host sends: (how its name begins, type, what was said before, how the reply's payload begins)

HOST = [
    ("10h", S05, [], b"\x91"),
    ("20h 00 installation mode, password", S05, [], OK),
    ("20h 00 installation, wrong", S05, [], REFUSED),
    ("20h 10", S05, [], OK),
    ("20h 24", S05, [], OK),
    ("20h 25", S05, [], OK),
    ("20h 42", S05, [], OK),
    ("20h 41", S05, [], OK),
    ("20h 40", S05, [], OK),
    ("20h 48", S05, [], OK),
    ("20h 27", S05, [], OK),
    ("20h 27", S14, [], REFUSED),  # has no 299 beams
    ("20h 30", S05, [], REFUSED),
    ("20h 2A", S05, [], REFUSED),
    ("20h 2A", S05, [variant(100, 25)], OK),
    ("20h 2A", S14, [], REFUSED),
    ("20h 2B", S05, [], REFUSED),  # measuring mode 00
    ("20h 2B", S05, [INSTALL, b"\x77" + config(0x0E), STOP], OK),
    ("20h 2B", S14, [], REFUSED),
    ("20h 50", S05, [], REFUSED),
    ("20h 50", S14, [], OK),
    ("20h 21", S05, [], OK),
    ("20h 21", S14, [], REFUSED),
    ("20h 2C", S05, [], OK),
    ("20h 29", S05, [], REFUSED),
    ("30h 01", S05, [], bytes.fromhex("B0 6901")),
    ("30h 01", S14, [], bytes.fromhex("B0 B500")),
    ("30h 01", LMS200, [], bytes.fromhex("B0 6941")),
    ("30h 08", S05, [], b"\xb0"),
    ("30h 08", S14, [], REJECTED),
    ("31h", S05, [], b"\xb1V02.10 \x25"),
    ("32h", S05, [], b"\xb2\x10"),
    ("35h", S05, [], bytes.fromhex("B5 0000 0100")),
    ("35h", LMS200, [], REJECTED),
    ("36h", S05, [], bytes.fromhex("B6 02 6901")),
    ("37h", S05, [], bytes.fromhex("B7 0100 6901 6901")),
    ("37h", S05, [variant(180, 100)], REJECTED),
    ("3Ah", S05, [], b"\xba" + S05.encode()),
    ("3Bh variant 180deg / 0.5deg", S05, [], b"\xbb\x01"),
    ("3Bh variant 180deg / 1deg", S05, [], b"\xbb\x01"),
    ("3Bh variant 100deg / 1deg", S05, [], b"\xbb\x01"),
    ("3Bh variant 100deg / 0.5deg", S05, [], b"\xbb\x01"),
    ("3Bh variant 100deg / 0.25deg", S05, [], b"\xbb\x01"),
    ("3Bh variant 100deg / 0.25deg", LMS200, [], b"\xbb\x01"),
    ("3Bh variant 180deg / 0.5deg", S14, [], b"\xbb\x00"),
    ("3Eh", S05, [], REJECTED),
    ("3Fh", S05, [], bytes.fromhex("BF 02 0100 2A01 2A01")),
    ("40h", S05, [], REJECTED),
    ("41h", S05, [], b"\xc1\x01"),
    ("41h", S14, [], REJECTED),
    ("42h", S05, [], REJECTED),
    ("44h", S14, [], bytes.fromhex("C4 B500")),
    ("44h", S05, [], REJECTED),
    ("45h", S05, [], REJECTED),
    ("46h", S05, [], REJECTED),
    ("4Ah", S05, [], bytes.fromhex("CA 01 01 01")),
    ("66h 00", S05, [], REJECTED),
    ("66h 00", S05, [INSTALL], bytes.fromhex("E6 01 00")),
    ("66h 01", S05, [INSTALL], bytes.fromhex("E6 01 01")),
    ("66h 02", S05, [INSTALL], bytes.fromhex("E6 01 02")),
    ("74h", S05, [], b"\xf4" + lms.DEFAULT_CONFIG),
    ("75h", S05, [variant(100, 25), INSTALL, b"\x77" + config(0x0E), STOP], REJECTED),  # does not fit
    ("75h", S14, [], REJECTED),
    ("76h", S05, [], REJECTED),
    ("77h config as printed in Tbl 6-8", LMS200, [], REJECTED),
    ("77h config as printed in Tbl 6-8", LMS200, [INSTALL], b"\xf7\x01"),
    ("77h config as printed in Tbl 7-123", LMS200, [INSTALL], b"\xf7\x01"),
    ("77h config accepted", LMS200, [INSTALL], b"\xf7\x01"),
    ("77h 32-byte", S05, [INSTALL], b"\xf7\x01"),
    ("77h 32-byte", S14, [INSTALL], b"\xf7\x00"),  # measuring mode 0D
    ("77h 34-byte", S05, [INSTALL], b"\xf7\x01"),
    ("77h LMS291 config, mode 01", S05, [INSTALL], b"\xf7\x01"),
    ("77h LMS291 config, mode 0E", S05, [INSTALL], b"\xf7\x01"),
    ("77h LMS291 config, mode 0E", S14, [INSTALL], b"\xf7\x00"),
    ("7Bh", S05, [], b"\xfb" + bytes(84)),
    ("7Ch conf", S05, [], REJECTED),
    ("7Ch old", S05, [], REJECTED),
]


@pytest.mark.parametrize(("name", "laser", "before", "payload"), HOST)
def test_a_hosts_telegram_gets_the_sheets_answer(connect, known, name, laser, before, payload):  # noqa: PLR0917
    reply = connect(*before, type_string=laser).ask(known(name), 2.0)
    assert reply[:1] == ACK
    size = 6 + int.from_bytes(reply[3:5], "little")
    answer = reply[1 : 1 + size]
    assert answer[:2] == b"\x02\x80"
    assert lms.crc16(answer[:-2]) == int.from_bytes(answer[-2:], "little")
    assert answer[4 : 4 + len(payload)] == payload


def test_every_usable_telegram_of_a_host_is_tried(telegrams):
    names = [entry["name"] for entry in telegrams if entry["direction"].startswith("host")]
    to_address_1 = "20h 00 installation, broadcast"  # in test_laser.py
    assert len(names) > 50
    assert not [name for name in names if not name.startswith((*(row[0] for row in HOST), to_address_1))]


def test_no_misprint_is_acknowledged(connect, protocol):
    found = json.loads((protocol / "sick-telegrams.json").read_text())
    misprints = [e for e in found if not e["usable"] and e["direction"].startswith("host")]
    assert len(misprints) == 5
    for entry in misprints:
        data = bytes.fromhex(entry["hex"])
        reply = connect().ask(data)
        assert reply == NAK if data[0] == lms.STX else ACK not in reply, entry["name"]


# --- what the laser sends: the state, and what is asked

FACTORY_200 = "77h config as printed in Tbl 6-8"
REAL_CONFIG = "77h config accepted"
INFO = Health(errors=((1, 49),))
HISTORY = [(0x84, 22), *[(0x84, 49)] * 8, (0x84, 22), (1, 49)]


def test_the_power_on_string(host, known, t0_ns):
    laser = EmulatedLaser(GivenWorld(), t0_ns=t0_ns, type_string="LMS200;301063;V02.06 ", address=1)
    laser.health = Health(errors=((3, 49),))
    assert host(laser, 9600).listen(1.0) == known("90h power-on string (QM")


def test_the_answer_to_a_reset(connect, known):
    assert connect().ask(known("10h"), 0.2) == ACK + known("91h")


@pytest.mark.parametrize(
    ("ask", "answer", "how"),
    [
        ("40h", "92h", {}),
        ("20h 25", "A0h mode switch ok (status 10h)", {}),
        ("20h 25", "A0h mode switch ok (address 81)", {"address": 1}),
        ("20h 25", "A0h mode switch ok (status 11h)", {"health": INFO}),
        ("20h 00 installation, wrong", "A0h installation refused", {}),
        ("3Ah", "BAh type string (TL)", {"type_string": "LMS200;301063;V02.10 "}),
        ("3Ah", "BAh type string LMS200", {"type_string": LMS200}),
        ("3Ah", "BAh type string, status 11h", {"type_string": LMS200, "health": INFO}),
        ("3Bh variant 180deg / 0.5deg", "BBh variant 180/0.5 set", {}),
        ("3Bh variant 180deg / 0.5deg", "BBh variant refused", {"type_string": S14}),
        ("32h", "B2h no errors", {}),
        ("32h", "B2h real error list", {"health": Health(errors=tuple(HISTORY))}),
        ("35h", "B5h", {}),
        ("41h", "C1h correct length", {}),
        ("4Ah", "CAh", {}),
        ("74h", "F4h configuration (real)", {"type_string": LMS200, "eeprom": REAL_CONFIG}),
        (
            "74h",
            "F4h configuration (real, from",
            {"type_string": LMS200, "eeprom": REAL_CONFIG, "health": INFO},
        ),
    ],
)
def test_an_answer_is_the_sheets(connect, known, ask, answer, how):
    if "eeprom" in how:
        how = {**how, "eeprom": known(how["eeprom"])[5:-2]}
    assert connect(**how).ask(known(ask)) == ACK + known(answer)


@pytest.mark.parametrize(
    ("ask", "answer", "how"),
    [
        ("66h 00", "E6h correct length", {}),
        (FACTORY_200, "F7h configuration accepted (TL)", {"type_string": LMS200}),
        (REAL_CONFIG, "F7h configuration accepted (real)", {"type_string": LMS200}),
        (REAL_CONFIG, "F7h configuration (real, from", {"type_string": LMS200, "health": INFO}),
        (
            REAL_CONFIG,
            "F7h configuration rejected",
            {"eeprom": bytes(34), "quirks": Quirks(refuse_config=True)},
        ),
    ],
)
def test_an_answer_in_installation_mode_is_the_sheets(connect, known, ask, answer, how):
    assert connect(INSTALL, **how).ask(known(ask)) == ACK + known(answer)


@pytest.mark.parametrize("number", [1, 2, 3, 4])
def test_a_real_lasers_status_is_told_by_one_in_its_state(connect, known, number):
    real = known(f"B1h status reply (real) #{number}")
    own = bytearray(real[5:-3])
    for first, end in STATE_FIELDS:
        own[first - 1 : end - 1] = b"\xaa" * (end - first)  # whatever the state tells is told anew
    health = Health(
        errors=((1, 49),) if real[-3] & 1 else (),
        pollution=tuple(np.frombuffer(real, "<u2", 8, 4 + 19).tolist()),
        reference_pollution=tuple(np.frombuffer(real, "<u2", 4, 4 + 35).tolist()),
    )
    said = [b"\x41\x01", INSTALL] if real[4 + 8] == 0 else [b"\x41\x01"]
    client = connect(
        b"\x20\x40",
        *said,
        type_string=LMS200,
        eeprom=known(REAL_CONFIG)[5:-2],
        own=bytes(own),
        health=health,
    )
    assert client.ask(known("31h")) == ACK + real


STATE_FIELDS = ((1, 10), (19, 43), (67, 69), (102, 103), (107, 114), (116, 123))
"""Offsets in B1, section 3.1, from and to: version, mode, defect; pollution; motor; and so on."""


def ramp(start, step, count):
    return start + step * np.arange(count)


@pytest.mark.parametrize(
    ("name", "world", "said", "ask", "how"),
    [
        ("B0h 181 values cm", GivenWorld(ramp(1, 0.01, 181)), [variant(180, 100)], b"\x30\x01", {}),
        (
            "B0h 361 values mm 180/0.5deg (c",
            GivenWorld(ramp(1, 0.001, 361)),
            [],
            b"\x30\x01",
            {"type_string": LMS200},
        ),
        ("B6h mean of 2", GivenWorld(), [variant(100, 100)], b"\x36\x02", {"type_string": LMS200}),
        ("B7h sub range", GivenWorld(), [], bytes.fromhex("37 0A00 1400"), {"type_string": LMS200}),
        (
            "C4h S14",
            GivenWorld(ramp(1, 0.001, 181), np.arange(181) * 7 / 255),
            [],
            bytes.fromhex("44 0100 B500"),
            {"type_string": S14, "eeprom": config(0, 1)},
        ),
        (
            "F5h 3 pairs",
            GivenWorld(np.array([1.5, 1.501, np.inf] + [1.0] * 358), np.array([0, 35 / 6, 0] + [0] * 358)),
            [],
            bytes.fromhex("75 0100 0100 0300"),
            {"eeprom": config(0x0E, 1)},
        ),
    ],
)
def test_measured_values_are_the_sheets(connect, known, name, world, said, ask, how):  # noqa: PLR0917
    reply = connect(*said, world=world, **how).ask(lms.telegram(0, ask), 2.0)
    assert reply == ACK + known(name)


def test_overflow_codes_are_the_sheets(connect, known):
    client = connect(variant(100, 100), eeprom=config(2, 1))
    client.device.faults.update(enumerate(Fault))
    assert client.ask(known("30h 01"), 1.0)[1:] == known("B0h overflow codes")


def test_indices_are_the_sheets(host, known, t0_ns):
    world = GivenWorld(ramp(1, 0.001, 401))
    laser = EmulatedLaser(world, t0_ns=t0_ns, type_string=LMS200, drift_ppm=0.0, quirks=Quirks(no_echo=0.0))
    laser.force_stream(t0_ns)
    laser._telegrams = 1
    heard = host(laser, 500000).listen(0.2)  # of turns -1, 3 and 7
    assert heard[2 * 814 : 3 * 814] == known("B0h 401 values mm")


def test_interlaced_partial_scans_are_the_sheets(connect, known, t0_ns):
    class Quarters(GivenWorld):
        def range_scan(self, t_s, bearing_rad, key):
            return ramp(1 + 0.001 * ((key - 1) % 4), 0.004, len(t_s)), np.zeros(len(t_s), int)

    client = connect(variant(100, 25), b"\x20\x48", world=Quarters(), eeprom=config(4, 1, indices=True))
    stream = client.ask(lms.telegram(0, PARTIALS), 0.5)
    for quarter, name in enumerate([".00", ".25", ".50", ".75"]):
        sheet = known(f"B0h interlaced partial scan {name}")
        values = sheet[:-5]  # then turn, telegram, status, CRC
        assert stream[stream.index(values) + len(values)] % 4 == sheet[-5] == quarter


@pytest.mark.parametrize("number", [1, 2, 3])
def test_a_real_lasers_scan_is_told_by_one_that_sees_the_same(connect, known, number):
    real = known(f"B0h scan 361 values mm 16 m mode (real) #{number}")
    client = connect(type_string=LMS200, eeprom=known(REAL_CONFIG)[5:-2])
    see(client.device, real)
    assert client.ask(known("30h 01"), 2.0)[1:] == real


def see(laser, scan):
    """Let a laser see what a B0 in measuring mode 04, mm, tells."""
    words = np.frombuffer(scan, "<u2", int.from_bytes(scan[5:7], "little") & 0x3FF, 7)
    distance = words & 0x3FFF
    laser._world.range_m = distance * 0.001
    laser.faults.clear()
    laser.faults.update({int(i): Fault(0x3FFF - distance[i]) for i in np.flatnonzero(distance >= 16375)})
    laser.fields.clear()
    laser.fields.update({int(i): Fields(int(words[i]) >> 14) for i in np.flatnonzero(words >> 14)})


def test_every_usable_telegram_of_a_laser_is_made(telegrams):
    names = [entry["name"] for entry in telegrams if entry["direction"].startswith("LMS")]
    asked = ast.walk(ast.parse(Path(__file__).read_text()))
    starts = {node.value for node in asked if isinstance(node, ast.Constant) and isinstance(node.value, str)}
    starts = tuple(start for start in starts if start[:3] in {name[:3] for name in names})
    assert len(names) > 40
    assert not [name for name in names if not name.startswith(starts)]
