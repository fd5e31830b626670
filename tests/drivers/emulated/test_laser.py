import itertools
from collections import Counter

import numpy as np
import pytest

from polecal.drivers.emulated import laser_telegrams as lms
from polecal.drivers.emulated.drive import SampledTrajectory
from polecal.drivers.emulated.laser import EmulatedLaser, Quirks
from polecal.drivers.emulated.laser_telegrams import Variant
from polecal.drivers.emulated.world import MountPose, World

ACK = b"\x06"
T0_NS = 1_000_000_000_000
REV_NS = 13_320_000
CONFIG_01 = "77h LMS291 config, mode 01"
INSTALL = "20h 00 installation mode, password SICK_LMS"


@pytest.fixture
def laser(parked, t0_ns):
    """Just powered up, with a mirror that turns in exactly its nominal time, and no missing echoes."""
    return EmulatedLaser(parked(), t0_ns=t0_ns, drift_ppm=0.0, quirks=Quirks(no_echo=0.0))


@pytest.fixture
def ready(laser, host):
    """A host at 9600 that has heard the power-on string."""
    client = host(laser, 9600)
    client.listen(1.0)
    return client


@pytest.fixture
def streaming(laser, host, t0_ns):
    """A host at 500000 of a laser that begins to stream."""
    client = host(laser, 500000)
    laser.force_stream(t0_ns)
    return client


def scans(data):
    """Split a clean stream of telegrams, the last of which may not be whole yet."""
    out = []
    while len(data) > 4 and len(data) >= (size := int.from_bytes(data[2:4], "little") + 6):
        assert data[0] == lms.STX
        assert lms.crc16(data[: size - 2]) == int.from_bytes(data[size - 2 : size], "little")
        out.append(data[:size])
        data = data[size:]
    return out


def words(scan):
    count = int.from_bytes(scan[5:7], "little") & 0x3FF
    return np.frombuffer(scan, "<u2", count, 7)


# --- power and conversation


def test_power_up_says_the_type_once_and_then_nothing(laser, host):
    client = host(laser, 9600)
    said = client.listen(5.0)
    assert said == lms.telegram(0x80, b"\x90LMS291;S05;V02.10 \x10")
    assert client.listen(100.0) == b""


def test_it_is_deaf_until_it_has_booted(laser, host, known):
    client = host(laser, 9600)
    assert client.ask(known("3Ah"), 0.3) == b""


def test_requests_get_an_ack_and_their_reply(ready, known):
    assert ready.ask(known("3Ah")) == ACK + lms.reply(0xBA, b"LMS291;S05;V02.10 ")
    assert ready.ask(known("32h")) == ACK + known("B2h no errors")
    assert ready.ask(known("74h")) == ACK + lms.reply(0xF4, lms.DEFAULT_CONFIG)
    assert ready.ask(known("4Ah")) == ACK + known("CAh")
    assert len(ready.ask(known("7Bh"))) == 1 + 92
    assert len(ready.ask(known("35h"))) == 1 + 12
    assert len(ready.ask(known("31h"))) == 1 + 160


def test_the_ack_comes_within_60_ms_and_the_reply_later(ready, known):
    assert ready.ask(known("20h 25"), 0.03) == ACK
    assert ready.listen(0.07) == known("A0h mode switch ok (status 10h)")


def test_a_wrong_crc_gets_a_nak_alone(ready):
    assert ready.ask(bytes.fromhex("02 00 02 00 20 41 52 08")) == b"\x15"


def test_a_foreign_address_gets_silence(ready):
    assert ready.ask(lms.telegram(5, b"\x31")) == b""


def test_its_own_address_is_answered_from_it(parked, host, known, t0_ns):
    client = host(EmulatedLaser(parked(), t0_ns=t0_ns, address=1), 9600)
    assert client.listen(1.0)[:2] == b"\x02\x81"
    assert client.ask(known("20h 00 installation, broadcast to address 1")) == ACK + known(
        "A0h mode switch ok (address 81)"
    )
    assert client.ask(known("20h 25"))[1:3] == b"\x02\x81"


def test_a_telegram_with_a_pause_in_it_is_forgotten(ready, known):
    request = known("3Ah")
    assert ready.ask(request[:4], 0.02) == b""
    assert ready.ask(request[4:]) == b""
    assert ready.ask(request).startswith(ACK)


def test_garbage_before_a_request_does_no_harm(ready, known):
    assert ready.ask(b"\x00\xff\x13" + known("3Ah")).startswith(ACK)


@pytest.mark.parametrize("name", ["40h", "42h", "66h 00", CONFIG_01])
def test_what_needs_installation_mode_is_rejected_without_it(ready, known, name):
    assert ready.ask(known(name)) == ACK + known("92h")


def test_a_wrong_password_is_refused(ready, known):
    assert ready.ask(known("20h 00 installation, wrong password")) == ACK + known("A0h installation refused")
    assert ready.ask(known(CONFIG_01)) == ACK + known("92h")


def test_a_scan_on_request(ready, known):
    reply = ready.ask(known("30h 01"), 2.0)
    (scan,) = scans(reply[1:])
    assert reply[:1] == ACK
    assert len(words(scan)) == 361
    assert ready.listen(1.0) == b""


def test_a_partial_scan_on_request_has_the_whole_half_circle(ready, known):
    reply = ready.ask(known("30h 08"), 2.0)
    (scan,) = scans(reply[1:])
    assert len(words(scan)) in (180, 181)
    assert scan[6] & 0x20


# --- state


def test_writing_the_configuration_counts_and_echoes(ready, laser, known):
    request = known(CONFIG_01)
    ready.ask(known(INSTALL))
    assert ready.ask(request) == ACK + lms.reply(0xF7, b"\x01" + request[5:-2])
    assert laser.eeprom_writes == 1
    ready.ask(known("20h 25"))
    assert ready.ask(known("74h")) == ACK + lms.reply(0xF4, request[5:-2])
    assert laser.eeprom_writes == 1


def test_an_unknown_measuring_mode_is_not_taken(ready, laser, known):
    ready.ask(known(INSTALL))
    bad = lms.telegram(0, b"\x77" + lms.DEFAULT_CONFIG[:5] + b"\x33" + lms.DEFAULT_CONFIG[6:])
    assert ready.ask(bad) == ACK + lms.reply(0xF7, b"\x00" + lms.DEFAULT_CONFIG)
    assert laser.eeprom_writes == 0


def test_a_short_configuration_keeps_the_rest(ready, laser, known):
    ready.ask(known(INSTALL))
    ready.ask(lms.telegram(0, b"\x77" + lms.STREAM_CONFIG[:7]))
    assert laser.config == lms.STREAM_CONFIG


def test_variants_that_do_not_exist_are_refused(ready, laser, known):
    assert ready.ask(known("3Bh variant 100deg / 0.25deg"))[5:7] == b"\xbb\x01"
    assert laser.variant == Variant(100, 25)
    assert ready.ask(lms.telegram(0, bytes.fromhex("3B B400 1900")))[5:7] == b"\xbb\x00"
    assert laser.variant == Variant(100, 25)


@pytest.mark.parametrize(
    ("name", "baud", "word"),
    [("20h 48", 500000, 0x8001), ("20h 40 set", 38400, 0x8019), ("20h 41 set", 19200, 0x8033)],
)
def test_the_rate_changes_after_the_answer_and_the_status_says_so(ready, known, name, baud, word):
    assert ready.ask(known(name)) == ACK + known("A0h mode switch ok (status 10h)")
    assert ready.ask(known("31h")) == b""
    ready.baud = baud
    status = ready.ask(known("31h"))[5:]
    assert int.from_bytes(status[116:118], "little") == word


def test_the_status_follows_the_state(ready, known):
    ready.ask(known(INSTALL))
    ready.ask(known(CONFIG_01))
    ready.ask(known("3Bh variant 100deg / 0.25deg"))
    status = ready.ask(known("31h"))[5:]
    assert status[8] == 0x00
    assert status[102] == 0x01
    assert int.from_bytes(status[107:109], "little") == 100
    assert int.from_bytes(status[109:111], "little") == 25
    assert int.from_bytes(status[67:69], "little") == 148
    ready.ask(known("20h 25"))
    assert ready.ask(known("31h"))[5:][8] == 0x25


def test_a_reset_forgets_what_is_volatile_and_keeps_the_eeprom(ready, laser, known):
    ready.ask(known(INSTALL))
    ready.ask(known(CONFIG_01))
    ready.ask(known("3Bh variant 100deg / 0.25deg"))
    ready.ask(known("20h 48"))
    ready.baud = 500000
    assert ready.ask(known("10h"), 0.1) == ACK + known("91h")
    ready.baud = 9600
    assert ready.listen(2.0)[4] == lms.POWER_ON
    assert laser.mode == 0x25
    assert laser.variant == Variant(180, 50)
    assert laser.config[5] == 0x01


def test_a_permanent_rate_survives_a_reset(ready, known):
    ready.ask(known("20h 40 set"))
    ready.baud = 38400
    ready.ask(known(INSTALL))
    assert ready.ask(known("66h 01"))[5] == 0xE6
    ready.ask(known("10h"), 2.0)
    assert ready.ask(known("3Ah")).startswith(ACK)


# --- the wrong rate


def test_at_a_wrong_rate_both_sides_hear_noise(streaming, laser, known):
    streaming.baud = 38400
    noise = streaming.listen(2.0)
    assert len(noise) > 1000
    assert known("20h 25")[:4] not in noise
    streaming.ask(known("20h 25"))
    assert laser.streaming
    streaming.baud = 500000
    streaming.ask(known("20h 25"))
    assert not laser.streaming


# --- scanning


def test_a_scan_takes_four_turns_and_leaves_in_two(streaming):
    heard = streaming.hear_stamped(0.4, step_s=0.00002)
    by_turn = Counter()
    for t_ns, data in heard:
        by_turn[(t_ns - T0_NS - 1) // REV_NS] += len(data)
    first = min(by_turn)
    assert first % 4 == 0  # right at the turn that ends a scan
    assert [by_turn[first + i] for i in range(8)] == [508, 814 - 508, 0, 0, 508, 814 - 508, 0, 0]
    assert heard[0] == (T0_NS + first * REV_NS + 20_000, b"\x02")


def test_counters_count_turns_and_telegrams_mod_256(streaming):
    found = scans(streaming.listen(20.0))[:300]
    turns = np.array([scan[-5] for scan in found])
    sent = np.array([scan[-4] for scan in found])
    assert len(found) == 300
    assert set(np.diff(turns) % 256) == {4}
    assert set(np.diff(sent) % 256) == {1}


@pytest.mark.parametrize(
    ("baud", "variant", "turns"),
    [
        (38400, Variant(180, 50), 16),
        (38400, Variant(180, 100), 8),
        (38400, Variant(100, 25), 16),
        (9600, Variant(180, 50), 58),
    ],
)
def test_slow_lines_lose_scans_in_whole_turns(laser, host, baud, variant, turns):
    client = host(laser, baud)
    laser.force_stream(client.t_ns, variant)
    laser._line.baud = baud
    found = scans(client.listen(6.0))
    assert {(b[-5] - a[-5]) % 256 for a, b in itertools.pairwise(found)} == {turns}


def test_a_request_cuts_the_running_scan_and_a_fresh_one_follows(streaming, known):
    streaming.listen(4 * 0.01332 + 0.005)  # within a scan
    heard = streaming.ask(known("20h 24"), 0.3)
    answer = ACK + known("A0h mode switch ok (status 10h)")
    at = heard.index(answer)
    assert 0 < at < 814
    scans(heard[at + len(answer) :])


def test_stopping_stops(streaming, known):
    streaming.listen(0.06)
    assert streaming.ask(known("20h 25")).endswith(known("A0h mode switch ok (status 10h)"))
    assert streaming.listen(2.0) == b""


def test_the_first_value_is_the_right_most_beam(host, parked, t0_ns):
    world = parked(pole_ne_m=(4.0, 3.0), mount=MountPose(z_m=-1.0))  # 37° to the right
    laser = EmulatedLaser(world, t0_ns=t0_ns, quirks=Quirks(no_echo=0.0))
    laser.force_stream(t0_ns)
    scan = scans(host(laser, 500000).listen(0.075))[0]
    levels = words(scan) >> 13
    (bright,) = np.nonzero(levels == 7)
    assert bright.mean() * 0.25 == pytest.approx(50 - np.rad2deg(np.arctan2(3, 4)), abs=0.3)
    assert (words(scan)[bright] & 0x1FFF).mean() == pytest.approx(500 - 4, abs=1)


def test_each_beam_is_measured_in_its_own_turn(host, t0_ns):
    """Driving at a wall of ground: the distance to it falls by the turn, so beam i says when it was fired."""
    speed = 100.0
    t_s = np.array([0.0, 1.0])
    climb = SampledTrajectory(
        t_s, [[0, 0, -1.0], [0, 0, -1.0 - speed]], np.zeros((2, 3)), np.tile([0, 0, -speed], (2, 1))
    )
    world = World(climb, mount=MountPose(0, 0, 0, 0, -90, 0), pole_ne_m=(1e3, 0), range_noise_m=0.0)
    laser = EmulatedLaser(world, t0_ns=t0_ns, drift_ppm=0.0, quirks=Quirks(no_echo=0.0))
    laser.force_stream(t0_ns)
    scan = scans(host(laser, 500000).listen(0.2))[1]  # the first was measured before it all began
    beam = np.arange(401)
    angle_deg = 40 + beam / 4
    depth_m = (words(scan) & 0x1FFF) / 100 * np.cos(np.deg2rad(90 - angle_deg))
    fired_s = (depth_m - 1.0) / speed
    assert fired_s == pytest.approx((beam % 4 + angle_deg / 360) * REV_NS * 1e-9, abs=1e-4)


def test_interlaced_scans_cover_the_half_circle_a_quarter_at_a_time(ready, laser, known):
    ready.ask(known(INSTALL))
    ready.ask(known(CONFIG_01))
    assert ready.ask(known("20h 2A"))[5:7] == b"\xa0\x01"  # not from 180/0.5
    ready.ask(known("3Bh variant 100deg / 0.25deg"))
    ready.ask(known("20h 48"))
    ready.baud = 500000
    answer = ready.ask(known("20h 2A"), 0.08)
    found = scans(answer[1:] + ready.listen(0.5))[1:9]
    headers = [int.from_bytes(scan[5:7], "little") for scan in found]
    assert {header & 0x2000 for header in headers} == {0x2000}
    quarters = [header >> 11 & 3 for header in headers]
    assert np.all(np.diff(quarters) % 4 == 1)
    assert [header & 0x3FF for header in headers] == [181 if quarter == 0 else 180 for quarter in quarters]
    assert {(b[-5] - a[-5]) % 256 for a, b in itertools.pairwise(found)} == {1}


def test_the_worlds_motion_begins_with_the_first_stream(ready, laser, known):
    world = laser._world
    assert world.start_ns is None
    before = ready.t_ns
    ready.ask(known("20h 24"))
    assert before <= world.start_ns <= ready.t_ns


def test_the_same_seed_gives_the_same_bytes(parked, host, t0_ns):
    def record(seed):
        laser = EmulatedLaser(parked(range_noise_m=0.01, seed=seed), t0_ns=t0_ns, seed=seed)
        laser.force_stream(t0_ns)
        client = host(laser, 500000)
        return b"".join(client.listen(step) for step in (0.5, 0.001, 0.2, 0.1))

    assert record(3) == record(3)
    assert record(3) != record(4)


# --- what real lasers do at times


def quirky(parked, host, t0_ns, **quirks):
    client = host(EmulatedLaser(parked(), t0_ns=t0_ns, quirks=Quirks(**quirks)), 9600)
    client.listen(1.0)
    return client


def test_an_info_may_be_pending(parked, host, t0_ns, known):
    client = quirky(parked, host, t0_ns, info_pending=1.0)
    assert client.ask(known("20h 25")) == ACK + known("A0h mode switch ok (status 11h)")


def test_requests_may_be_overlooked(parked, host, t0_ns, known):
    client = quirky(parked, host, t0_ns, overlooked=0.5)
    answered = [bool(client.ask(known("3Ah"))) for _ in range(40)]
    assert 8 < sum(answered) < 32


def test_scans_may_be_cut_short(parked, host, t0_ns):
    laser = EmulatedLaser(parked(), t0_ns=t0_ns, quirks=Quirks(cut_scan=1.0))
    laser.force_stream(t0_ns)
    stream = host(laser, 500000).listen(2.0)
    assert 0 < len(stream) < 814 * 30
    assert scans_ok(stream) == 0


def scans_ok(stream):
    at = [i for i in range(len(stream) - 813) if stream[i : i + 4] == b"\x02\x80\x28\x03"]
    return sum(
        lms.crc16(stream[i : i + 812]) == int.from_bytes(stream[i + 812 : i + 814], "little") for i in at
    )


def test_a_configuration_may_be_refused(parked, host, t0_ns, known):
    client = quirky(parked, host, t0_ns, refuse_config=True)
    client.ask(known(INSTALL))
    assert client.ask(known(CONFIG_01))[5:7] == b"\xf7\x00"
    assert client.device.eeprom_writes == 0


def test_an_accepted_configuration_may_be_answered_as_if_it_were_not(parked, host, t0_ns, known):
    client = quirky(parked, host, t0_ns, accept_as_zero=True)
    client.ask(known(INSTALL))
    request = known(CONFIG_01)
    assert client.ask(request) == ACK + lms.reply(0xF7, b"\x00" + request[5:-2])
    assert client.device.config == request[5:-2]


def test_an_ack_may_be_lost(parked, host, t0_ns, known):
    client = quirky(parked, host, t0_ns, lost_ack=1.0)
    assert client.ask(known("32h")) == known("B2h no errors")


def test_the_answer_to_a_change_of_rate_may_be_lost(parked, host, t0_ns, known):
    client = quirky(parked, host, t0_ns, lost_rate_reply=1.0)
    assert client.ask(known("20h 48")) == ACK
    client.baud = 500000
    assert client.ask(known("20h 25")) == ACK + known("A0h mode switch ok (status 10h)")


def test_firmware_may_have_no_energy(parked, host, t0_ns, known):
    client = quirky(parked, host, t0_ns, refuse_energy=True)
    client.ask(known(INSTALL))
    assert client.ask(known("77h LMS291 config, mode 0E"))[5:7] == b"\xf7\x00"
    assert client.ask(known("77h 32-byte"))[5:7] == b"\xf7\x00"
    assert client.ask(known("20h 2B"))[5:7] == b"\xa0\x01"
    assert client.ask(lms.telegram(0, bytes.fromhex("75 0100 0100 0300")))[5:6] == b"\x92"


def test_old_firmware_has_32_bytes_of_configuration(parked, host, t0_ns, known):
    client = quirky(parked, host, t0_ns, short_config=True)
    assert client.ask(known("74h")) == ACK + lms.reply(0xF4, lms.DEFAULT_CONFIG[:32])
    client.ask(known(INSTALL))
    old = known("77h 32-byte")[5:-2]
    assert client.ask(known("77h 32-byte")) == ACK + lms.reply(0xF7, b"\x01" + old)
    assert client.ask(known("7Bh")) == ACK + lms.reply(0xFB, bytes(4))


def test_a_beam_without_an_echo_is_an_overflow_code(parked, host, t0_ns):
    laser = EmulatedLaser(parked(), t0_ns=t0_ns, quirks=Quirks(no_echo=1.0))
    laser.force_stream(t0_ns)
    assert set(words(scans(host(laser, 500000).listen(0.2))[0])) == {8191}
