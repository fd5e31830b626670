"""What a receiver goes through: power-up, alignment, faults, resets, events; its ports and its IMU."""

import itertools
import struct

import novatel_edie
import numpy as np
import pytest
from novatel_edie import oem

from polecal.drivers.emulated import span_frames as span
from polecal.drivers.emulated.drive import SampledTrajectory
from polecal.drivers.emulated.receiver import EmulatedReceiver, Faults
from polecal.drivers.emulated.span_frames import Stamp
from polecal.drivers.emulated.span_generations import G320, OEM4, OEM6, OEM7
from polecal.drivers.emulated.span_logs import LOGS, Paced
from polecal.drivers.emulated.world import MountPose, World

OK = b"\r\n<OK\r\n[COM1]"


@pytest.fixture
def connect(parked, host, t0_ns):
    def make(world=None, baud=115200, **options):
        given = {"latency_tail_s": 0.0, "whole_second_latency_s": 0.0, "drift_ppm": 0.0}
        return host(EmulatedReceiver(world or parked(), t0_ns=t0_ns, baud=baud, **{**given, **options}), baud)

    return make


@pytest.fixture
def moving(t0_ns):
    def make(velocity=(5.0, 0.0, 0.0), yaw_deg=(0.0, 0.0)):
        """100 s at a steady velocity, the heading going from one angle to another."""
        ends = np.array([np.zeros(3), np.multiply(velocity, 100.0)])
        rpy = np.deg2rad([[0, 0, yaw_deg[0]], [0, 0, yaw_deg[1]]])
        world = World(
            SampledTrajectory([0.0, 100.0], ends, rpy, np.tile(velocity, (2, 1))),
            mount=MountPose(),
            pole_ne_m=(0, 0),
        )
        world.start(t0_ns)
        return world

    return make


def names(messages) -> list[str]:
    return [type(message).__name__.split("_")[0] for message in messages]


def log(client, *requests: str) -> None:
    for request in requests:
        assert b"<OK" in client.ask(f"LOG {request}\r\n".encode(), 0.03)


def from_frames(stream: bytes) -> bytes:
    """Leave out what comes before the first binary frame."""
    return stream[stream.index(b"\xaa\x44") :]


# --- power-up


def test_after_power_up_there_is_a_prompt_and_no_time(connect, edie):
    client = connect(generation=OEM6, fine_after_s=20.0, aligned_after_s=5.0)
    assert client.listen(0.1) == b"[COM1]"
    log(client, "TIMEA ONTIME 1", "BESTPOSB ONTIME 1", "INSPVASB ONTIME 0.1")
    for message in edie(client.listen(10.0)):
        assert message.header.week == 0
        assert message.header.milliseconds < 12_000
        assert names([message])[0] in ("TIME", "BESTPOS")  # and nothing inertial
        head = message.to_dict()["header"]
        assert (head["time_status"], head["receiver_status"]) == (20, 0x004C0000)
        if names([message]) == ["TIME"]:
            assert (message.clock_model_status, message.utc_year, message.utc_time_status) == (3, 0, 0)
        else:
            assert (message.solution_status, message.position_type, message.latitude) == (1, 0, 0.0)


def test_time_comes_with_a_jump_to_the_week_and_status_events(connect, edie):
    client = connect(generation=OEM6, fine_after_s=3.2, aligned_after_s=5.0, gps_week=2345)
    client.ask(b"LOG COM1 TIMEB ONTIME 1\r\n", 0.5)
    messages = edie(client.listen(5.0))
    weeks = [week for week, _ in itertools.groupby(message.header.week for message in messages)]
    assert weeks == [0, 2345]
    events = [message for message in messages if names([message]) == ["RXSTATUSEVENT"]]
    assert [(event.header.sequence, event.bit_position, event.event) for event in events] == [
        (2, 18, 0), (1, 19, 0), (0, 22, 0),
    ]  # fmt: skip
    assert all(message.to_dict()["header"]["receiver_status"] == 0 for message in messages[-2:])


def test_the_held_event_log_goes_only_by_force(connect, host):
    for command, silent in ((b"UNLOGALL\r\n", False), (b"UNLOGALL THISPORT TRUE\r\n", True)):
        client = connect(fine_after_s=3.0)
        client.ask(command, 0.5)
        assert (client.listen(5.0) == b"") is silent


def test_a_log_on_hold_survives_unlogall(connect, edie):
    client = connect()
    log(client, "COM1 TIMEB ONTIME 1 0 HOLD", "BESTPOSB ONTIME 1")
    client.ask(b"UNLOGALL COM1\r\n")
    assert names(edie(client.listen(2.0))) == ["TIME"] * 2


# --- alignment


def test_the_azimuth_is_the_course_at_first_and_slews_to_the_mounting(connect, moving, edie):
    client = connect(
        moving((0.0, 8.0, 0.0), (90.0, 90.0)), mounting_yaw_deg=90.0, aligned_after_s=1.0, complete_s=20.0
    )
    log(client, "INSPVAB ONTIME 0.5")
    messages = edie(from_frames(client.listen(25.0)))
    complete = [message.azimuth for message in messages if message.ins_solution_status == 7]
    assert complete[0] == pytest.approx(90.0, abs=3.0)
    assert np.all(np.diff(complete) > 0)
    assert complete[-1] == pytest.approx(180.0, abs=3.0)
    good = [message for message in messages if message.ins_solution_status == 3]
    assert len(good) > 5
    for message in good:  # GOOD, and 90° off course
        course = np.rad2deg(np.arctan2(message.east_vel, message.north_vel))
        assert message.azimuth - course == pytest.approx(90.0)


def test_attitude_is_the_imus_own(connect, parked, edie, t0_ns):
    leaning = SampledTrajectory(
        [0.0, 1e6], np.zeros((2, 3)), np.deg2rad([[3.0, 5.0, 40.0]] * 2), np.zeros((2, 3))
    )
    client = connect(parked(trajectory=leaning), mounting_yaw_deg=90.0, aligned_after_s=-5.0)
    log(client, "INSATTB ONTIME 1")
    message = edie(client.listen(1.0))[0]
    # The IMU's forward axis is the vehicle's right one: its nose is down by the vehicle's roll
    assert message.pitch == pytest.approx(-3.0, abs=0.05)
    assert message.roll == pytest.approx(5.0, abs=0.05)
    assert message.azimuth == pytest.approx(130.0, abs=0.5)


# --- faults


@pytest.mark.parametrize("kind", ["bad_crc", "truncated"])
def test_spoiled_frames_are_spoiled_and_the_rest_are_whole(connect, kind):
    client = connect(faults=Faults(**{kind: 0.3}))
    log(client, "INSPVASB ONTIME 0.02")
    parser = oem.Parser()
    parser.write(client.listen(5.0))
    found = list(parser)
    good = [message for message in found if isinstance(message, oem.Message)]
    assert 140 < len(good) < 210
    assert any(isinstance(message, novatel_edie.UnknownBytes) for message in found)


@pytest.mark.parametrize(
    ("generation", "port", "bit"),
    [(OEM6, "COM1", 8), (OEM6, "COM2", 9), (OEM4, "COM3", 10), (OEM7, "COM3", 8), (OEM6, "USB1", 11)],
)
def test_lost_bytes_are_told_in_the_status_word(connect, generation, port, bit):
    client = connect(generation=generation, port=port, faults=Faults(dropped=0.1))
    log(client, "BESTPOSB ONTIME 0.05")
    stream = client.listen(20.0)
    statuses = [stamp.status for _, message_id, _, stamp in span.frames(stream) if message_id == 42]
    assert 300 < len(statuses) < 390
    told = {status & ~generation.status for status in statuses}
    assert told == {0, 1 << bit}
    assert b"#RXSTATUSEVENTA," in stream


def test_a_status_that_changes_is_told_to_who_asked(connect, edie):
    client = connect(fine_after_s=4.0)
    client.ask(b"UNLOGALL THISPORT TRUE\r\n")
    first, second = edie(from_frames(client.ask(b"LOG RXSTATUSB ONCHANGED\r\n", 6.0)))
    assert [message.status_words[0].status_word for message in (first, second)] == [0x024C0000, 0x02000000]


# --- replies


def test_an_ascii_command_is_answered_in_ascii(connect, edie):
    client = connect()
    command = span.ascii_line("LOGA", ["COM1", "BESTPOSB", "ONTIME", "1", "0", "NOHOLD"], Stamp(0, 0))
    reply = client.ask(command, 0.05)
    assert reply.startswith(b"#LOGR,COM1,0,")
    assert span.parse_line(reply.decode().strip())[-1] == "OK"
    assert names(edie(client.listen(2.0))) == ["BESTPOS"] * 2
    wrong = client.ask(command.replace(b"BESTPOSB", b"BESTVELB"), 0.05)
    assert b";Invalid Checksum*" in wrong


def test_a_binary_command_may_ask_for_ascii_and_is_refused_in_binary(connect):
    client = connect()
    for message_id, kind, found in (
        (42, 0x20, b"#BESTPOSA,"),
        (42, 0x40, b"<BESTPOS "),
        (42, 0, b"\xaa\x44"),
    ):
        body = struct.pack("<IHBBIddI", 0xC0, message_id, kind, 0, 2, 1.0, 0.0, 0)
        reply = client.ask(span.long_frame(1, body, Stamp(0, 0, source=2)), 0.05)
        assert len(reply) == 38
        assert (reply[6], reply[28:34]) == (0x82, b"\x01\0\0\0OK")
        assert found in client.listen(1.0)
        client.ask(b"UNLOGALL\r\n", 0.05)
    body = struct.pack("<IHBBIddI", 0xC0, 9999, 0, 0, 2, 1.0, 0.0, 0)
    reply = client.ask(span.long_frame(1, body, Stamp(0, 0)), 0.05)
    assert reply[28:-4] == b"\x07\0\0\0Invalid Message. Field = 2"


def test_in_binary_mode_only_binary_is_heard(connect):
    client = connect()
    assert client.ask(b"INTERFACEMODE COM1 NOVATELBINARY NOVATELBINARY ON\r\n") == OK
    assert client.ask(b"LOG BESTPOSB ONTIME 1\r\n", 2.0) == b""
    body = struct.pack("<4I", 1, 1, 1, 1)
    assert len(client.ask(span.long_frame(3, body, Stamp(0, 0)), 0.1)) == 38
    assert client.ask(b"UNLOGALL\r\n") == OK


@pytest.mark.parametrize("name", [name for name in LOGS if LOGS[name].paced is Paced.IMU])
def test_imu_logs_come_by_sample_only(connect, name):
    client = connect(generation=OEM6)
    reply = client.ask(f"LOG {name}B ONTIME 0.01\r\n".encode(), 0.05)
    assert reply == b"\r\n<ERROR:Trigger ONTIME not valid for this log\r\n[COM1]"
    assert client.ask(f"LOG {name}B ONNEW\r\n".encode(), 0.015).startswith(b"\r\n<OK")
    assert len(list(span.frames(client.listen(1.0)))) == pytest.approx(100, abs=2)


@pytest.mark.parametrize(("generation", "most"), [(OEM4, 30), (OEM6, 64), (OEM7, 80)])
def test_there_are_only_so_many_logs(connect, generation, most):
    client = connect(generation=generation)
    there = [name for name in LOGS if generation.has(name) and LOGS[name].paced is Paced.EPOCH]
    requests = [f"LOG COM1_{i} {name}B ONTIME 10" for i in range(9) for name in there]
    replies = [client.ask(f"{request}\r\n".encode(), 0.05) for request in requests[:most]]
    taken = sum(b"<OK" in reply for reply in replies)
    assert taken == most - 1  # and the held one
    assert b"<ERROR:Not Enough Resources" in replies[-1]


# --- resets


def test_what_was_saved_comes_back_after_a_restart(connect, edie):
    client = connect()
    log(client, "TIMEB ONTIME 1")
    assert client.ask(b"SERIALCONFIG COM1 57600\r\n", 0.05) == OK
    client.baud = 57600
    assert b"<OK" in client.ask(b"SAVECONFIG\r\n", 0.05)
    log(client, "BESTPOSB ONTIME 1")
    client.device.restart(client.t_ns)
    assert client.listen(0.9) == b""
    stream = client.listen(3.0)
    assert stream.startswith(b"[COM1]")
    assert set(names(edie(from_frames(stream)))) == {"TIME"}


def test_a_restart_aligns_anew(connect, edie):
    client = connect(aligned_after_s=0.5, complete_s=0.5)
    log(client, "INSPVASB ONTIME 0.1")
    client.ask(b"SAVECONFIG\r\n", 2.0)
    assert client.ask(b"RESET\r\n", 0.09).count(b"<OK") == 1
    statuses = [
        int(m.ins_solution_status) for m in edie(from_frames(client.listen(4.0).split(b"[COM1]")[-1]))
    ]
    assert statuses[0] == 9
    assert statuses[-1] == 3


def test_a_factory_reset_leaves_the_slowest_rate_and_no_logs(connect):
    client = connect()
    log(client, "TIMEB ONTIME 1")
    client.ask(b"SAVECONFIG\r\n", 0.01)
    assert OK in client.ask(b"FRESET\r\n", 0.09)
    client.baud = 9600
    assert client.listen(3.0) == b"[COM1]"
    assert client.ask(b"UNLOGALL\r\n") == OK


def test_two_breaks_and_silence_reset_the_port(connect):
    client = connect()
    log(client, "TIMEB ONTIME 1")
    client.ask(b"INTERFACEMODE COM1 NOVATELBINARY NOVATEL OFF\r\n", 0.1)
    client.device.hear_break(client.t_ns)
    client.listen(1.5)
    assert client.device.baud == 115200
    client.device.hear_break(client.t_ns)
    client.listen(1.0)
    client.baud = 9600
    assert client.listen(3.0) == b""
    assert client.ask(b"UNLOGALL\r\n") == OK


@pytest.mark.parametrize("spoilt", ["off", "short", "talk", "far apart"])
def test_other_breaks_do_nothing(connect, spoilt):
    client = connect()
    if spoilt == "off":
        client.ask(b"SERIALCONFIG COM1 115200 N 8 1 N OFF\r\n")
    seconds = 0.1 if spoilt == "short" else 0.3
    client.device.hear_break(client.t_ns, seconds)
    client.listen(5.0 if spoilt == "far apart" else 1.5)
    client.device.hear_break(client.t_ns, seconds)
    if spoilt == "talk":
        client.ask(b"\r\n", 0.1)
    client.listen(1.0)
    assert client.device.baud == 115200


# --- ports


def test_a_usb_port_has_no_rate(connect, edie):
    client = connect(port="ICOM1")
    client.baud = 300
    assert client.ask(b"LOG BESTPOSB ONTIME 1\r\n", 0.05) == b"\r\n<OK\r\n[ICOM1]"
    frame = client.listen(1.0)
    assert names(edie(frame)) == ["BESTPOS"]
    assert frame[7] == 0xA0
    assert b"<ERROR" in client.ask(b"SERIALCONFIG THISPORT 9600\r\n", 0.05)
    assert b"<OK" in client.ask(b"SERIALCONFIG COM1 9600\r\n", 0.05)
    client.ask(b"LOG TIMEA ONCE\r\n", 0.01)
    assert b"#TIMEA,ICOM1,0," in client.listen(0.1)


def test_the_same_log_on_a_virtual_port_comes_twice(connect, edie):
    client = connect(port="USB1", also=[("BESTPOSB", 5.0)])
    log(client, "BESTPOSB ONTIME 1")
    messages = edie(client.listen(20.0))
    ports = [message.header.port_address for message in messages]
    assert (ports.count(0xA0), ports.count(0xBE)) == (20, 4)
    twins = itertools.groupby(messages, lambda message: message.header.milliseconds)
    for _, (one, *others) in ((ms, list(same)) for ms, same in twins):
        assert all(other.latitude == one.latitude for other in others)


def test_a_port_is_unlogged_with_or_without_its_virtual_ports(connect):
    client = connect()
    log(client, "COM1 BESTPOSB ONTIME 1", "COM1_7 BESTPOSB ONTIME 1", "COM2 BESTPOSB ONTIME 1")
    assert len(client.listen(1.0)) == 2 * 104
    client.ask(b"UNLOGALL COM1\r\n")
    assert client.listen(1.0)[7] == 0x27
    client.ask(b"UNLOGALL COM1_ALL\r\n")
    assert client.listen(2.0) == b""


def test_the_source_bits_are_in_every_long_header(connect, edie):
    client = connect(source=2)
    log(client, "BESTPOSB ONTIME 1")
    frame = client.listen(1.0)
    assert frame[6] == 2
    assert names(edie(frame)) == ["BESTPOS"]


# --- time


def test_inertial_solutions_may_be_of_before_their_headers_time(connect, moving, edie):
    client = connect(moving(), body_offset_s=-0.003245, gps_week=2100, gps_s0=604_790.5, aligned_after_s=0.0,
                     complete_s=0.0)  # fmt: skip
    log(client, "INSPVAB ONTIME 1", "TIMESYNCB ONTIME 1", "INSPVASA ONTIME 1")
    messages = edie(client.listen(12.0))
    poses = [message for message in messages if names([message])[0].startswith("INSPVA")]
    for pose in poses:
        of_header = pose.header.week * 604_800 + pose.header.milliseconds / 1000
        assert pose.week * 604_800 + pose.seconds - of_header == pytest.approx(-0.003245, abs=1e-6)
    assert {(pose.header.week, pose.week) for pose in poses} == {(2100, 2100), (2101, 2100), (2101, 2101)}
    first, last = poses[0], poses[-2]
    metres = (last.latitude - first.latitude) * 111_000
    seconds = (last.week - first.week) * 604_800 + last.seconds - first.seconds
    assert metres == pytest.approx(5.0 * seconds, rel=2e-3)
    assert all(m.milliseconds == m.header.milliseconds for m in messages if names([m]) == ["TIMESYNC"])


def test_a_pose_is_of_its_body_time(connect, moving, edie):
    def lat(offset_s):
        client = connect(moving(), body_offset_s=offset_s, aligned_after_s=-5.0)
        log(client, "INSPOSB ONTIME 1")
        return edie(client.listen(1.0))[0].latitude

    assert (lat(0.0) - lat(-0.02)) * 110_900 == pytest.approx(5.0 * 0.02, rel=5e-3)


# --- events


def test_events_are_stamped_to_ten_nanoseconds(connect, edie):
    client = connect(generation=OEM6)
    log(client, "MARKTIMEB ONNEW", "MARK1TIMEA ONNEW", "MARK2TIMEB ONNEW")
    receiver = client.device
    t_ns = client.t_ns + 123_456_789
    client.t_ns = t_ns
    receiver.mark(t_ns)
    messages = edie(client.listen(0.1))
    assert names(messages) == ["MARKTIME", "MARK1TIME"]
    week, ms = divmod(receiver.gps_ms(t_ns), span.WEEK_MS)
    for message in messages:
        assert (message.week, message.header.milliseconds) == (week, ms)
        assert message.seconds == pytest.approx(200_000.25 + (t_ns - receiver._t0_ns) * 1e-9, abs=6e-9)
    receiver.mark(client.t_ns, 2)
    assert names(edie(client.listen(0.1))) == ["MARK2TIME"]
    assert b"<ERROR:Trigger ONTIME not valid" in client.ask(b"LOG MARKTIMEB ONTIME 1\r\n", 0.05)


def test_a_log_may_be_wanted_at_events(connect, moving, edie):
    client = connect(moving(), aligned_after_s=-5.0)
    log(client, "INSPVASB ONMARK")
    assert client.listen(2.0) == b""
    client.device.mark(client.t_ns)
    assert names(edie(client.listen(0.1))) == ["INSPVAS"]


# --- the IMU, the antennas


@pytest.mark.parametrize(("generation", "share"), [(OEM7, 1.0), (OEM6, 0.2)])
def test_corrected_increments_sum_up_to_the_turn(connect, moving, edie, generation, share):
    """OEM6 says only the last of the five samples of its IMU in 50 ms."""
    client = connect(moving((5.0, 0.0, 0.0), (0.0, 170.0)), generation=generation, aligned_after_s=-5.0)
    log(client, "CORRIMUDATAB ONTIME 0.05" if generation is OEM6 else "CORRIMUDATAB ONTIME 0.2")
    messages = edie(client.listen(10.0))
    rates = np.array([list(message.to_dict().values())[2:5] for message in messages])
    turned = rates[:, 2].sum()
    assert np.rad2deg(turned) == pytest.approx(-17.0 * share, rel=1e-2)  # clockwise, about an axis that is up
    assert rates[:, :2] == pytest.approx(0, abs=1e-9)


def test_raw_counts_feel_gravity_and_the_earths_turn(connect, parked, edie):
    client = connect(parked())
    log(client, "RAWIMUSXB ONNEW")
    message = edie(from_frames(client.listen(0.5)))[0]
    assert message.accel_z * G320.accel_mps / 0.008 == pytest.approx(9.80665, rel=1e-6)
    assert abs(message.accel_x) < 2
    lat = np.deg2rad(-33.889)
    north = 7.292115e-5 * np.cos(lat) * 0.008 / G320.gyro_rad
    up = 7.292115e-5 * np.sin(lat) * 0.008 / G320.gyro_rad
    assert (message.gyro_x, message.gyro_y, message.gyro_z) == pytest.approx((0, -north, up), abs=1)
    assert (message.imu_type, message.imu_status) == (41, 0xEA59FE00)


def test_the_second_antennas_heading_is_not_the_azimuth(connect, parked, edie):
    client = connect(parked(), second_antenna_m=(0.0, 1.2, 0.0))
    log(client, "HEADING2B ONNEW")
    message = edie(client.listen(1.0))[0]
    assert (message.b_length, message.heading, message.pitch) == pytest.approx((1.2, 90.0, 0.0))


@pytest.mark.parametrize("undulation_m", [-36.5, 22.5])
def test_heights_are_each_what_they_are(connect, edie, undulation_m):
    client = connect(undulation_m=undulation_m, lever_arm_m=(0.0, 0.0, -1.5), aligned_after_s=-5.0)
    log(client, "INSPVAB ONTIME 1", "INSPVAXB ONTIME 1", "BESTPOSB ONTIME 1")
    antenna, x, pose = edie(client.listen(1.0))
    assert x.undulation == undulation_m
    assert x.orthometric_height + undulation_m == pytest.approx(pose.height, abs=1e-9)
    assert antenna.orthometric_height - x.orthometric_height == pytest.approx(1.5, abs=1e-6)


def test_the_configuration_says_where_the_antenna_is(connect, edie):
    client = connect(lever_arm_m=(-0.3, 0.1, -0.6), mounting_yaw_deg=90.0)
    (reply,) = edie(client.ask(b"LOG INSCONFIGB ONCE\r\n", 0.1)[len(OK) :])
    assert reply.ins_translations[0].offset == pytest.approx([0.3, 0.1, 0.6])  # right, forward, up of the IMU


def test_a_set_rotation_is_logged(connect, edie):
    client = connect(generation=OEM6)
    client.ask(b"VEHICLEBODYROTATION 0 0 -90\r\n")
    (message,) = edie(client.ask(b"LOG VEHICLEBODYROTATIONB ONCE\r\n", 0.1)[len(OK) :])
    assert message.input == [0.0, 0.0, -90.0]


# --- twins


@pytest.mark.parametrize("generation", [OEM4, OEM6, OEM7])
def test_binary_and_ascii_twins_of_one_receiver_agree(connect, moving, edie, generation):
    client = connect(
        moving((5.0, 1.0, 0.3), (0.0, 170.0)), baud=230400, generation=generation, aligned_after_s=-5.0
    )
    for name in (name for name in LOGS if generation.has(name) and LOGS[name].paced is Paced.EPOCH):
        client.ask(f"LOG {name}B ONTIME 1\r\nLOG {name}A ONTIME 1\r\n".encode(), 0.05)
        one, other = edie(client.listen(1.0))
        client.ask(b"UNLOGALL\r\n", 0.05)
        if name == "BESTGPSPOS":
            continue  # which the maker's decoder does not know
        assert names([one, other]) == [name] * 2
        assert one.header.milliseconds == other.header.milliseconds
        for field, value in one.to_dict().items():
            if field != "header" and not isinstance(value, str):
                said = np.array(other.to_dict()[field], float)
                assert said == pytest.approx(np.array(value, float), abs=5.1e-5), (name, field)
