"""The conversation with a laser, against a scripted one in virtual time."""

import os
import random
import struct
import threading
from collections.abc import Callable

import pytest

from polecal.drivers.errors import DeviceError, DeviceNotFound, DeviceProtocolError
from polecal.drivers.port import Stopped
from polecal.drivers.sick_lms import Framer, SickLms, build

ACK, NAK = b"\x06", b"\x15"
CONFIGURATION = bytes.fromhex(  # a real LMS200's, in cm: the sheet's F4
    "00 00 70 00 00 04 01 00 00 02 02 00 00 00 00 00 00 00 00 00 00 00 00 00 00 00 00 00 00 00 00 00 02 00"
)
RIGHT = CONFIGURATION[:4] + b"\x02\x01\x00" + CONFIGURATION[7:]
RATES = {0x42: 9600, 0x41: 19200, 0x40: 38400, 0x48: 500000}
NOISE = bytes.fromhex("F8 02 80 28 03 B0 06 15 80 FE 00 02 00 02 7F E6")
SILENT = object()
SCAN_NS = 5_000_000


class Laser:
    """Answers as the sheet says, at its own rate only; what it was asked is in ``asked``.

    ``script`` is tried on each request first: bytes are sent in place of the answer, SILENT is none.
    """

    def __init__(self, status: bytes, scan: bytes) -> None:
        self.baud = 500000
        self.mode = 0x25
        self.configuration = CONFIGURATION
        self.variant = (180, 50)
        self.type = b"LMS291;S05;V02.30 "
        self.errors = b""
        self.writes = 0
        self.asked: list[bytes] = []
        self.script: Callable[[bytes], object] = lambda body: None
        self.wire: Callable[[bytes], bytes] = bytes
        self.cut_off = False
        self.one_byte_at_a_time = False
        self.path = "/dev/virtual"
        self._status, self._scan = status, scan
        self._framer = Framer()
        self._said = b""
        self._next_ns: int | None = None  # when a scan comes; not before it has been spoken to
        self._host_baud = 0

    @property
    def streams(self) -> bool:
        return self.mode in (0x24, 0x2B, 0x50)

    def send(self, data: bytes) -> None:
        self._said += self.wire(data) if self._host_baud == self.baud else NOISE[: len(data)]

    def next_ns(self) -> int | None:
        return self._next_ns if self.streams else None

    def transmit(self, t_ns: int, host_baud: int) -> bytes:
        self._host_baud = host_baud
        if not self._said and self.streams and self._next_ns is not None and t_ns >= self._next_ns:
            self.send(self._scan)
            self._next_ns = t_ns + SCAN_NS
        size = 1 if self.one_byte_at_a_time else len(self._said)
        said, self._said = self._said[:size], self._said[size:]
        return said

    def receive(self, t_ns: int, data: bytes, host_baud: int) -> None:
        self._host_baud = host_baud
        self._next_ns = t_ns + SCAN_NS
        if host_baud != self.baud:
            if self.streams:
                self.send(NOISE)
            return
        for frame in self._framer.feed(data, t_ns):
            if self.streams:  # it stops in mid-telegram
                self.send(self._scan[:11])
                self.cut_off = True
            self.answer(frame.body)

    def answer(self, body: bytes) -> None:
        self.asked.append(body)
        scripted = self.script(body)
        if scripted is SILENT:
            return
        if isinstance(scripted, bytes):
            self.send(scripted)
            return
        then_baud = self.baud
        match body[0]:
            case 0x20:
                sub = body[1]
                if sub in RATES:
                    then_baud = RATES[sub]
                else:
                    self.mode = sub
                reply = b"\xa0\x00"
            case 0x31:
                reply = self._status_now()
            case 0x32:
                reply = b"\xb2" + self.errors
            case 0x3A:
                reply = b"\xba" + self.type
            case 0x3B:
                self.variant = struct.unpack("<2H", body[1:])
                reply = b"\xbb\x01" + body[1:]
            case 0x74:
                reply = b"\xf4" + self.configuration
            case 0x77 if self.mode == 0x00:
                self.writes += 1
                self.configuration = body[1:]
                reply = b"\xf7\x01" + body[1:]
            case _:
                reply = b"\x92"
        self.send(ACK + build(reply + b"\x10", 0x80))
        self.baud = then_baud

    def _status_now(self) -> bytes:
        status = bytearray(self._status)
        status[8], status[102], status[122] = self.mode, self.configuration[5], self.configuration[6]
        struct.pack_into("<2H", status, 107, *self.variant)
        return bytes(status)

    def subs(self) -> list[int]:
        """The sub bytes of all mode switches asked for."""
        return [body[1] for body in self.asked if body[0] == 0x20]


@pytest.fixture
def laser(usable: dict[str, bytes], connected: Callable[[Laser], None]) -> Laser:
    status = usable["B1h status reply (real) #1"][4:-3]
    scan = usable["B0h 401 values mm 100/0.25deg with indices (constructed)"]
    one = Laser(status, scan)
    connected(one)
    return one


def answer(begins: bytes, reply: bytes) -> Callable[[bytes], object]:
    """Script ``reply`` as the answer to requests that begin so."""
    return lambda body: ACK + build(reply + b"\x10", 0x80) if body.startswith(begins) else None


def device_on(laser: Laser, baud: int = 500000, **options: object) -> SickLms:
    return SickLms("front", laser.path, baud, lambda *_: None, **options)


def set_up(laser: Laser, **options: object) -> SickLms:
    device = device_on(laser, **options)
    with device.open(threading.Event()) as port:
        device._set_up(port)
        assert port.baud == device.baud == laser.baud
        while not device._heard(port.read(1.0)):
            pass
    return device


@pytest.mark.parametrize("baud", RATES.values())
@pytest.mark.parametrize("mode", [0x25, 0x24, 0x00], ids=["on request", "streaming", "installation"])
def test_a_laser_is_found_at_any_rate_in_any_mode_and_set_up(laser, baud, mode):
    laser.baud, laser.mode = baud, mode
    device = set_up(laser)
    assert device.identity == "LMS291;S05;V02.30"
    assert (laser.mode, laser.variant, laser.baud) == (0x24, (100, 25), 500000)
    assert laser.configuration == RIGHT
    assert (laser.writes, device.eeprom_writes) == (1, 1)
    assert laser.cut_off == (mode == 0x24)
    assert laser.subs()[0] == 0x25


def test_an_eeprom_that_is_right_is_not_written_and_installation_mode_not_entered(laser):
    laser.configuration = RIGHT
    device = set_up(laser)
    assert (laser.writes, device.eeprom_writes) == (0, 0)
    assert 0x00 not in laser.subs()


def test_a_variant_that_is_right_is_not_set(laser):
    laser.variant = (100, 25)
    set_up(laser)
    assert not [body for body in laser.asked if body[0] == 0x3B]


def test_a_configuration_of_32_bytes_is_written_back_as_32(laser):
    laser.configuration = CONFIGURATION[:32]
    set_up(laser)
    assert laser.configuration == RIGHT[:32]


def test_the_rate_stays_where_it_is_wanted(laser):
    laser.baud = 38400
    set_up(laser, baud=38400, resolution_deg=0.5)
    assert not set(laser.subs()) & set(RATES)


def test_lost_requests_and_naks_are_repeated(laser):
    seen: dict[bytes, int] = {}

    def lossy(body: bytes) -> object:
        seen[body] = seen.get(body, 0) + 1
        return {1: SILENT, 2: NAK}.get(seen[body]) if body[0] != 0x20 else None

    laser.script = lossy
    laser.configuration = RIGHT
    set_up(laser)
    assert seen[b"\x3a"] == 3


def test_a_lost_reply_to_a_change_of_rate_is_made_out_at_the_new_rate(laser):
    def mute(body: bytes) -> object:
        if body == b"\x20\x48" and laser.baud != 500000:
            laser.baud = 500000
            return SILENT
        return None

    laser.baud = 9600
    laser.script = mute
    set_up(laser)
    assert laser.subs().count(0x48) == 1


def test_a_lost_reply_to_a_write_is_made_out_by_reading_and_not_written_again(laser):
    def mute(body: bytes) -> object:
        if body[0] == 0x77:
            laser.writes += 1
            laser.configuration = body[1:]
            return SILENT
        return None

    laser.script = mute
    set_up(laser)
    assert laser.writes == 1


def test_a_configuration_that_does_not_hold_is_written_once_and_never_again(laser):
    laser.script = lambda body: (
        ACK + build(b"\xf7\x00" + CONFIGURATION + b"\x10", 0x80) if body[0] == 0x77 else None
    )
    device = device_on(laser)
    for _ in range(2):
        with device.open(threading.Event()) as port, pytest.raises(DeviceProtocolError):
            device._set_up(port)
    assert [body[0] for body in laser.asked].count(0x77) == 1
    assert device.eeprom_writes == 1
    assert laser.mode == 0x25


def test_not_allowed_and_refused_are_told_apart(laser):
    device = device_on(laser)
    laser.script = lambda body: ACK + build(b"\x92\x10", 0x80) if body[0] == 0x74 else None
    with (
        device.open(threading.Event()) as port,
        pytest.raises(DeviceProtocolError, match="not allowed") as not_allowed,
    ):
        device._set_up(port)
    laser.script = lambda body: ACK + build(b"\xa0\x01\x10", 0x80) if body[:2] == b"\x20\x00" else None
    with device.open(threading.Event()) as port, pytest.raises(DeviceProtocolError, match="A0 01") as refused:
        device._set_up(port)
    assert "another mode" in not_allowed.value.hint
    assert "password" in refused.value.hint


def test_energies_are_streamed_where_the_laser_has_them(laser):
    device = device_on(laser, reflectivity="energy", resolution_deg=1)
    with device.open(threading.Event()) as port:
        device._set_up(port)
    assert device.measuring_mode == laser.configuration[5] == 0x0E
    assert laser.asked[-1] == bytes.fromhex("20 2B 01 00 01 00 65 00")


def test_a_laser_that_refuses_energies_gives_levels(laser):
    laser.script = answer(b"\x20\x2b", b"\x92")
    device = set_up(laser, reflectivity="energy", resolution_deg=1)
    assert (device.reflectivity, device.measuring_mode) == ("levels", 1)
    assert (laser.mode, laser.configuration) == (0x24, RIGHT)


def test_an_s14_streams_with_its_reflectivity(laser):
    laser.type = b"LMS291;S14;V02.30 "
    device = device_on(laser, fov_deg=90, resolution_deg=0.5, reflectivity="s14")
    with device.open(threading.Event()) as port:
        device._set_up(port)
    assert laser.asked[-1] == bytes.fromhex("20 50 01 00 B5 00")
    assert not [body for body in laser.asked if body[0] == 0x3B]


def test_a_laser_of_another_type_than_configured_is_refused(laser):
    laser.type = b"LMS291;S14;V02.30 "
    device = device_on(laser)
    with device.open(threading.Event()) as port, pytest.raises(DeviceProtocolError, match="S14"):
        device._set_up(port)


def test_the_error_list_and_pollution_are_health(laser):
    laser.errors = bytes.fromhex("84 16 03 31")
    device = set_up(laser)
    assert device.health.faults == ("error 49: laser power",)
    assert device.health.past == ("fatal 22: reference channel pollution (past)",)
    assert device.health.pollution[0] == pytest.approx(402 / 432)
    assert not device.health.polluted


def test_health_is_asked_again_while_it_streams(laser):
    device = device_on(laser)
    with device.open(threading.Event()) as port:
        device._set_up(port)
        laser.errors = bytes.fromhex("02 11")
        device._health_due_ns = 0
        asked = len(laser.asked)
        while len(laser.asked) < asked + 2 or not device.health.faults:
            device._heard(port.read(1.0))
    assert [body[0] for body in laser.asked[asked:]] == [0x32, 0x31]
    assert device.health.faults == ("warning 17: window pollution",)


def test_a_laser_that_starts_anew_in_mid_run_is_noticed(laser, usable):
    device = device_on(laser)
    with device.open(threading.Event()) as port:
        device._set_up(port)
        laser.send(usable["90h power-on string (QM, address 81)"])
        chunks = iter(lambda: port.read(1.0), None)
        with pytest.raises(DeviceProtocolError, match="started anew"):
            all(device._heard(chunk) or True for chunk in chunks)


@pytest.mark.parametrize("harm", ["loss", "flips", "one byte at a time"])
def test_it_streams_once_a_bad_line_is_good_again(laser, clock, harm):
    """One byte in five lost, or bits flipped, in the first answers; no crash, no hang."""
    chance = random.Random(7)

    def wire(data: bytes) -> bytes:
        if len(laser.asked) > 8 or harm == "one byte at a time":
            return data
        if harm == "loss":
            return bytes(byte for byte in data if chance.random() > 0.2)
        return bytes(byte ^ (1 << chance.randrange(8) if chance.random() < 0.05 else 0) for byte in data)

    laser.wire = wire
    laser.one_byte_at_a_time = harm == "one byte at a time"
    laser.configuration = RIGHT
    device = device_on(laser)
    assert run_until_it_streams(device, clock)
    assert laser.mode == 0x25


def run_until_it_streams(device: SickLms, clock, at_most_s: float = 30.0) -> bool:
    """Run it and stop it with the first scan; say whether one came."""
    stop = clock.stop()
    framer, scans = Framer(), []

    def tap(direction: str, t_ns: int, data: bytes) -> None:
        if direction == "rx" and any(frame.command == 0xB0 for frame in framer.feed(data, t_ns)):
            scans.append(t_ns)
            stop.set()

    device._tap = tap
    clock.at(at_most_s, stop.set)
    device.run(device.open(stop))
    return bool(scans)


def test_it_is_left_in_request_mode_at_the_resting_rate(laser, clock):
    device = device_on(laser)
    assert run_until_it_streams(device, clock)
    assert (device.state, device.problem) == ("closed", None)
    assert (laser.mode, laser.baud) == (0x25, 9600)


def test_a_stop_ends_the_search_at_once():
    master, slave = os.openpty()
    stop = threading.Event()
    device = SickLms("front", os.ttyname(slave), 500000, lambda *_: stop.set())
    try:
        with device.open(stop) as port, pytest.raises(Stopped):
            device._set_up(port)
    finally:
        os.close(master)
        os.close(slave)


@pytest.mark.parametrize(
    ("sound", "said"),
    [
        (b"", "silence"),
        (b"\xf8\x00\x80\xfe" * 5, "noise"),
        (b"\xaa\x44\x12\x1c" + bytes(40), "NovAtel"),
        (b"login: ", "text"),
    ],
)
def test_nothing_found_says_what_was_heard(laser, sound, said):
    laser.baud = 38400
    laser.script = lambda body: sound or SILENT
    device = device_on(laser)
    with device.open(threading.Event()) as port, pytest.raises(DeviceNotFound, match=said) as error:
        device._set_up(port)
    assert laser.path in str(error.value)
    assert "9600, 19200, 38400, 500000" in str(error.value)
    assert error.value.hint


@pytest.mark.parametrize(
    ("options", "why"),
    [
        ({"fov_deg": 180, "resolution_deg": 0.25}, "interlaced"),
        ({"baud": 38400}, "one scan in 5"),
        ({"baud": 115200}, "115200"),
        ({"fov_deg": 90}, "90"),
        ({"resolution_deg": 0.125}, "0.125"),
        ({"reflectivity": "energy"}, "199 beams"),
        ({"reflectivity": "s14"}, "S14"),
        ({"reflectivity": "colour"}, "colour"),
        ({"resting_baud": 4800}, "4800"),
        ({"unit": "mm"}, "8.18 m, not 80 m"),
        ({"unit": "mm", "reflectivity": "energy", "resolution_deg": 1}, "32.76 m, not 80 m"),
        ({"max_range_m": 150}, "81.83 m, not 150 m"),
        ({"unit": "inch"}, "inch"),
    ],
)
def test_what_no_laser_can_do_is_refused_with_the_reason(options, why):
    given = {"baud": 500000} | options
    with pytest.raises(DeviceError, match=why):
        SickLms("front", "/dev/nowhere", given.pop("baud"), lambda *_: None, **given)
