import itertools

import numpy as np
import pymap3d
import pytest

from polecal.drivers.emulated import span_frames as span
from polecal.drivers.emulated.receiver import PlaybackReceiver, load_recording, recorded_path
from polecal.drivers.emulated.virtual import play

OK = b"\r\n<OK\r\n[COM1]"
REFUSED = b"\r\n<ERROR:Invalid Message. Field = 2\r\n[COM1]"


@pytest.fixture(scope="module")
def driven(captures):
    return load_recording(captures / "span_driver_ins_ppp_driven_20hz.bin")


@pytest.fixture
def receiver(driven, t0_ns):
    return PlaybackReceiver(*driven, t0_ns=t0_ns)


def test_it_waits_to_be_asked_and_refuses_what_it_does_not_hold(receiver, host):
    client = host(receiver, 115200)
    assert client.listen(5.0) == b""
    assert client.ask(b"UNLOGALL\r\n", 1.0) == OK
    assert client.ask(b"LOG INSPVASB ONTIME 0.01\r\n", 1.0) == REFUSED
    assert client.ask(b"LOG INSPVAXB ONTIME 0.05\r\n", 1.0).startswith(OK)


def test_every_byte_comes_at_its_recorded_time(receiver, driven, t0_ns):
    data, offsets, arrival_s = driven
    started = []
    receiver._on_start = started.append
    script = [(t0_ns, "span", b"LOG INSPVAXB ONTIME 0.05\r\n")]
    heard = list(play({"span": receiver}, start_ns=t0_ns, seconds=120.0, script=script, chunk_s=0.0001))
    assert b"".join(chunk for _, _, chunk in heard) == OK + data
    assert receiver.done
    at = len(OK)
    ends = np.array([*itertools.accumulate(len(chunk) for _, _, chunk in heard)])
    for k in range(0, len(offsets), 97):
        _, t_ns, _ = heard[int(np.searchsorted(ends, at + offsets[k], side="right"))]
        assert (t_ns - started[0]) * 1e-9 == pytest.approx(arrival_s[k] - arrival_s[0], abs=0.0002)


def test_unlogall_silences_it_and_time_goes_on(receiver, driven, host):
    client = host(receiver, 115200)
    client.ask(b"LOG INSPVAXB ONTIME 0.05\r\n", 10.0)
    client.ask(b"UNLOGALL\r\n", 0.1)
    assert client.listen(10.0) == b""
    client.ask(b"LOG BESTPOSB ONTIME 1\r\n", 1.0)
    data, offsets, arrival_s = driven
    said = client.listen(1.0)
    k = int(np.searchsorted(np.array(arrival_s) - arrival_s[0], 21.2))
    assert data[offsets[k] : offsets[k] + 100] in said


def test_at_a_wrong_rate_it_is_noise(receiver, driven, host):
    client = host(receiver, 115200)
    client.ask(b"LOG INSPVAXB ONTIME 0.05\r\n", 1.0)
    client.baud = 57600
    noise = client.listen(5.0)
    assert len(noise) > 1000
    assert b"\xaa\x44\x12\x1c" not in noise


def test_the_recorded_path_is_what_the_logs_say(driven):
    arrival_s = driven[2]
    path, origin = recorded_path(*driven)
    assert len(path.t_s) == 2289
    position, rpy, velocity = path.pose(path.t_s)
    assert position[0] == pytest.approx(np.zeros(3), abs=1e-6)
    length_m = np.sum(np.linalg.norm(np.diff(position[:, :2], axis=0), axis=1))
    assert length_m == pytest.approx(77, abs=4)  # the sheet's, section 9
    assert set((np.rad2deg(rpy[:, 2]) % 360 // 30).astype(int)) == set(range(12))
    moving = np.linalg.norm(velocity[:, :2], axis=1) > 0.5
    course = np.arctan2(velocity[moving, 1], velocity[moving, 0])
    off = np.angle(np.exp(1j * (course - rpy[moving, 2])))
    assert np.rad2deg(np.median(off)) == pytest.approx(0.07, abs=0.1)
    assert origin.height_m == pytest.approx(326.2 - 36.5, abs=1.0)
    lat, lon, _ = pymap3d.ned2geodetic(*position[100], origin.lat_deg, origin.lon_deg, origin.height_m)
    assert (lat, lon) == pytest.approx((43.404, -80.470), abs=1e-3)
    assert path.t_s[-1] <= arrival_s[-1] - arrival_s[0]


def test_no_recorded_log_arrived_before_its_epoch(driven):
    data, offsets, arrival_s = driven
    path, _ = recorded_path(*driven)
    ends = [end for end, message_id, _, _ in span.frames(data) if message_id == 1465]
    chunk = np.searchsorted(offsets, np.array(ends) - 1, side="right") - 1
    late_s = np.array(arrival_s)[chunk] - arrival_s[0] - path.t_s
    assert late_s.min() >= -1e-6
    assert np.median(late_s) == pytest.approx(0.0218, abs=0.01)  # section 6
    slope = np.polyfit(path.t_s, path.t_s - np.arange(len(path.t_s)) * 0.05, 1)[0]
    assert abs(slope) < 200e-6


def test_the_unaligned_recording_is_played_too(captures, host, t0_ns):
    recording = load_recording(captures / "span_driver_basic_fix_unaligned_10hz.bin")
    client = host(PlaybackReceiver(*recording, t0_ns=t0_ns), 115200)
    assert client.ask(b"LOG INSPVAXB ONTIME 0.1\r\n", 300.0) == OK + recording[0]


@pytest.mark.parametrize("speed", [0.5, 10.0])
def test_it_may_be_played_at_another_speed(driven, host, t0_ns, speed):
    data, offsets, arrival_s = driven
    client = host(PlaybackReceiver(*driven, t0_ns=t0_ns, start_ns=t0_ns + 1, speed=speed), 115200)
    client.device.force_logs(t0_ns, [("INSPVAXB", 0.05)], baud=115200)
    heard = client.listen(30.0 / speed)
    k = int(np.searchsorted(np.array(arrival_s) - arrival_s[0], 30.0, side="right"))
    assert heard == data[: offsets[k]]
    assert client.listen(90.0 / speed) == data[offsets[k] :]
