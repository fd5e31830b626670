"""A real LMS200's conversation: its host's side, replayed to an emulated one, gets what the real one said."""

import json

import numpy as np
import pytest

from polecal.drivers.emulated import laser_telegrams as lms
from polecal.drivers.emulated.laser import EmulatedLaser, Fault, Fields, Quirks


class ScenesInTurn:
    """A world that shows a laser what the scans of a recording tell, one after the other."""

    def __init__(self, scans):
        self.start_ns = None
        self.laser = None
        self._words = [np.frombuffer(scan, "<u2", 361, 7) for scan in scans]
        self._shown = 0

    def start(self, t_ns):
        self.start_ns = t_ns

    def seconds(self, t_ns):
        return np.zeros(len(t_ns))

    def range_scan(self, t_s, bearing_rad, key):
        words = self._words[min(self._shown, len(self._words) - 1)]
        self._shown += 1
        distance = words & 0x3FFF  # measuring mode 04
        self.laser.faults.clear()
        gone = np.flatnonzero(distance > 16375)
        self.laser.faults.update((int(i), Fault(0x3FFF - distance[i])) for i in gone)
        self.laser.fields.clear()
        self.laser.fields.update((int(i), Fields(int(words[i] >> 14))) for i in np.flatnonzero(words >> 14))
        return distance * 0.001, np.zeros(len(words), int)


@pytest.fixture(scope="module")
def recording(captures):
    lines = (captures / "lms200-setup-and-stream.jsonl").read_text().splitlines()
    return [(row["t"], row["from"], bytes.fromhex(row["hex"])) for row in map(json.loads, lines)]


def telegrams(data):
    """Take the telegrams out of a host's chunks; what lies between must be ACKs and one cut scan's rest."""
    found, between = [], b""
    while data:
        whole = data[: 6 + int.from_bytes(data[2:4], "little")]
        if data[:2] == b"\x02\x80" and lms.crc16(whole[:-2]).to_bytes(2, "little") == whole[-2:]:
            found.append(whole)
        else:
            whole = data[:1]
            between += whole
        data = data[len(whole) :]
    return found, between


def state_of(telegram):
    """Leave out of B1 what wanders: calibration was not the same in the recording's two."""
    return telegram[: 4 + 131] if telegram[4] == 0xB1 else telegram


def test_the_real_hosts_side_gets_the_real_lasers_answers(recording, host, t0_ns):
    said = [data for _, who, data in recording if who == "lms"]
    world = ScenesInTurn([data for data in said if data[4] == 0xB0])
    status, config = (next(data for data in said if data[4] == code) for code in (0xB1, 0xF4))
    laser = EmulatedLaser(
        world,
        t0_ns=t0_ns,
        drift_ppm=0.0,
        type_string="LMS200;S18063;V02.19 ",
        eeprom=config[5:-3],
        own=status[5:-3],
        quirks=Quirks(no_echo=0.0),
    )
    world.laser = laser
    laser.health = lms.Health(
        pollution=tuple(np.frombuffer(status, "<u2", 8, 4 + 19).tolist()),
        reference_pollution=tuple(np.frombuffer(status, "<u2", 4, 4 + 35).tolist()),
    )
    client = host(laser, 9600)
    client.listen(1.0)
    client.ask(lms.telegram(0, b"\x20\x40"))  # an earlier program had set 38400
    client.baud = 38400
    client.ask(lms.telegram(0, b"\x41\x01"))  # and the field set

    heard, began_ns = b"", client.t_ns
    for t_s, who, data in recording:
        if who == "host":
            due_ns = max(began_ns + t_s * 1e9, client.t_ns + 70e6)  # at least when the answer is there
            heard += client.listen((due_ns - client.t_ns) * 1e-9)
            heard += client.ask(data, 0.0)
    heard += client.listen(0.2)
    answers, between = telegrams(heard)

    assert [data[4] for data in answers[:11]] == [data[4] for data in said[:11]]
    assert [data[4] for data in answers[-2:]] == [0xA0, 0xA0]
    scans = [data for data in answers if data[4] == 0xB0]
    real_scans = [data for data in said if data[4] == 0xB0]
    assert len(scans) == len(real_scans) == 51
    assert scans == real_scans
    for ours, real in zip(answers, said, strict=True):
        assert state_of(ours) == state_of(real)
    assert between.count(b"\x06") >= sum(who == "host" for _, who, _ in recording)
