"""The driver and the emulated receiver, each written from the sheet alone, on pseudo-terminals."""

from __future__ import annotations

import contextlib
import threading
import time

import numpy as np
import pytest

from polecal.drivers.emulated.drive import SampledTrajectory
from polecal.drivers.emulated.receiver import EmulatedReceiver, Faults, PlaybackReceiver, load_recording
from polecal.drivers.emulated.serve import serve
from polecal.drivers.emulated.span_generations import OEM4, OEM6, OEM7, OEMV
from polecal.drivers.emulated.world import MountPose, World
from polecal.drivers.errors import DeviceError, DeviceProtocolError
from polecal.drivers.novatel_span import (
    Accuracy,
    Deduplicator,
    Framer,
    MessageId,
    NovatelSpan,
    PositionType,
    accuracy,
    nav_state,
    parse,
    position_type,
)

DRIVEN = "span_driver_ins_ppp_driven_20hz.bin"


class Span(NovatelSpan):
    """With less patience, as a pseudo-terminal is quick."""

    answer_s = 0.4
    patience_s = 1.0
    quiet_s = 0.05


class Host:
    """A driver's life on a receiver's pseudo-terminal, and all that it heard and said."""

    def __init__(self, receiver, baud, rate_hz):
        self.receiver = receiver
        self.changed = threading.Condition()
        self.heard, self.said = b"", b""
        self._unserve, ready = threading.Event(), threading.Event()
        paths = []

        def note(found):
            paths.extend(found)
            ready.set()

        self._server = threading.Thread(
            target=serve, args=([(None, receiver)],), kwargs={"stop": self._unserve, "ready": note}
        )
        self._server.start()
        assert ready.wait(5)
        self.device = Span("span", paths[0], baud, self._tap, rate_hz=rate_hz)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self.device.run, args=(self.device.open(self._stop),))
        self._thread.start()

    def _tap(self, direction, _, data):
        with self.changed:
            if direction == "rx":
                self.heard += data
            else:
                self.said += data
            self.changed.notify_all()

    def wait_for(self, condition, timeout_s=10.0):
        with self.changed:
            assert self.changed.wait_for(condition, timeout_s), (self.device.state, self.device.problem)

    def streams(self, poses=20):
        """Wait until it streams, and give the frames from so many poses."""
        self.wait_for(lambda: self.device.state == "streaming")
        begin = len(self.heard)
        self.wait_for(lambda: sum(map(is_pose, self.frames(begin))) >= poses)
        return self.frames(begin)

    def frames(self, begin=0):
        return Framer().feed(self.heard[begin:], 0)

    def leave(self):
        self._stop.set()
        self._thread.join()

    def close(self):
        self.leave()
        self._unserve.set()
        self._server.join()


def is_pose(frame):
    return nav_state(frame) is not None


@pytest.fixture
def world():
    """A vehicle that drives north-east at 5 m/s."""
    ends = np.array([[0.0, 0.0, -0.1], [3500.0, 3500.0, -0.1]])
    rpy = np.deg2rad([[0.0, 0.0, 45.0]] * 2)
    velocity = np.tile([3.5, 3.5, 0.0], (2, 1))
    return World(
        SampledTrajectory([0.0, 1000.0], ends, rpy, velocity), mount=MountPose(), pole_ne_m=(0.0, 0.0)
    )


@pytest.fixture
def make(world):
    """Make a driver on an emulated receiver that is aligned; all are closed at the end."""
    with contextlib.ExitStack() as stack:

        def pair(receiver=None, host_baud=230400, rate_hz=50.0, orders=(), **options):
            now_ns = time.monotonic_ns()
            given = {"aligned_after_s": -5.0, "baud": 115200, **options}
            receiver = receiver or EmulatedReceiver(world, t0_ns=now_ns - 10**9, **given)
            for order in orders:
                receiver.receive(now_ns - 10**9, order, receiver.baud)
                receiver.transmit(now_ns - 10**8, receiver.baud)
            host = Host(receiver, host_baud, rate_hz)
            stack.callback(host.close)
            return host

        yield pair


def wanted(receiver):
    """The logs on the receiver's own port, as name and period in s."""
    return {key.name: want.period_ms / 1000 for key, want in receiver._logs.items() if not key.virtual}


@pytest.mark.parametrize(
    ("generation", "quality", "order", "point"),
    [
        (OEM4, "INSCOVS", b"COM COM1,230400,N,8,1,N,OFF,ON", "does not say"),
        (OEMV, "INSCOVS", b"COM COM1,230400,N,8,1,N,OFF,ON", "does not say"),
        (OEM6, "INSPVAX", b"SERIALCONFIG COM1 230400 N 8 1 N OFF", "does not say"),
        (OEM7, "INSPVAX", b"SERIALCONFIG COM1 230400 N 8 1 N OFF", "the IMU's centre of navigation"),
    ],
    ids=["OEM4", "OEMV", "OEM6", "OEM7"],
)
def test_each_generation_is_found_set_to_our_rate_and_made_to_log_what_is_needed(
    make, generation, quality, order, point
):
    host = make(generation=generation, baud=9600)
    frames = host.streams()
    assert host.receiver.baud == 230400
    assert wanted(host.receiver) == {"INSPVAS": 0.02, "BESTPOS": 1.0, "TIME": 1.0, quality: 1.0}
    assert order in host.said
    assert b"SAVECONFIG" not in host.said
    assert host.device.pose is MessageId.INSPVAS
    assert generation.versions[0][3] in host.device.identity
    assert point in host.device.reference_point
    answers = {"OK"} if generation is not OEM6 else {"OK", "ERROR:Invalid Message. Field = 2"}  # INSCONFIG
    assert set(host.device.results.values()) == answers
    states = [state for frame in frames if (state := nav_state(frame))]
    assert all(state.good for state in states)
    assert np.allclose(np.diff([state.gps_ns for state in states]), 20_000_000)
    for state in states:
        north, east, _ = state.velocity_ned_mps
        assert state.azimuth_deg == pytest.approx(np.degrees(np.arctan2(east, north)), abs=1.0)


def test_what_poses_are_judged_by_comes_beside_them(make):
    host = make(generation=OEM7)
    host.streams()
    host.wait_for(lambda: {"BESTPOS", "TIME", "INSPVAX"} <= {frame.name for frame in host.frames()})
    told = [said for frame in host.frames() if (said := accuracy(parse(frame)))]
    assert told[-1] == Accuracy(*(pytest.approx(t, rel=1e-6) for t in zip(*[iter(SIGMA)] * 3, strict=True)))
    types = {position_type(parse(frame)) for frame in host.frames()} - {None}
    assert types == {PositionType.INS_RTKFIXED}


SIGMA = (0.012, 0.012, 0.015, 0.01, 0.01, 0.01, 0.015, 0.015, 0.04)


@pytest.mark.parametrize(
    "refused", [["INSPVAX"], ["INSPVAX", "INSSTDEVS"], ["INSPVAX", "INSSTDEVS", "INSCOVS"]]
)
def test_what_is_refused_is_replaced_or_gone_without(make, refused):
    host = make(generation=OEM7, refused=refused)
    host.streams()
    left = {"INSSTDEVS", "INSCOVS"} - set(refused)
    assert wanted(host.receiver).keys() - {"INSPVAS", "BESTPOS", "TIME"} == set(sorted(left)[-1:])
    assert host.device.results["LOG INSPVAXB ONTIME 1"] == "ERROR:Invalid Message. Field = 2"


def test_satellites_own_position_is_asked_for_where_the_best_one_is_refused(make):
    host = make(generation=OEM4, refused=["BESTPOS"])
    host.streams()
    assert "BESTGPSPOS" in wanted(host.receiver)


def test_a_receiver_without_pose_logs_is_an_error_with_its_own_words(make):
    host = make(refused=["INSPVAS", "INSPVAX"])
    host.wait_for(lambda: host.device.problem is not None)
    assert isinstance(host.device.problem, DeviceProtocolError)
    assert "refuses every pose log" in str(host.device.problem)
    assert "INSPVASB ONTIME 0.02: ERROR:Invalid Message. Field = 2" in str(host.device.problem)


def test_a_rate_that_the_line_cannot_carry_is_refused_with_the_arithmetic(make):
    host = make(host_baud=115200, rate_hz=200.0, baud=115200)
    host.wait_for(lambda: host.device.problem is not None)
    assert type(host.device.problem) is DeviceError
    assert "(104 B x 200 + 104 + 76 + 158 B) x 10 bits = 211380 bit/s, 183% of the line" in str(
        host.device.problem
    )
    assert "INSPVAS" not in wanted(host.receiver)


def test_a_port_that_hears_only_binary_is_spoken_to_in_binary(make):
    host = make(orders=[b"INTERFACEMODE COM1 NOVATELBINARY NOVATELBINARY ON\r\n"], baud=230400)
    host.streams()
    assert host.receiver.baud == 230400
    assert set(host.device.results.values()) == {"OK"}


@pytest.mark.parametrize("mode", ["NOVATEL NOVATEL", "NOVATELBINARY NOVATELBINARY"])
def test_a_port_that_gives_no_replies_is_set_up_all_the_same(make, mode):
    host = make(orders=[f"INTERFACEMODE COM1 {mode} OFF\r\n".encode()], baud=230400)
    host.streams()
    assert wanted(host.receiver) == {"INSPVAS": 0.02, "BESTPOS": 1.0, "TIME": 1.0, "INSPVAX": 1.0}
    assert set(host.device.results.values()) == {""}


def test_logs_of_an_earlier_run_are_stopped(make):
    orders = [b"LOG INSATTA ONTIME 0.1\r\n", b"LOG BESTVELB ONTIME 1 0 HOLD\r\n"]
    host = make(orders=orders)
    host.streams()
    assert wanted(host.receiver).keys() == {"INSPVAS", "BESTPOS", "TIME", "INSPVAX"}


def test_a_port_without_a_rate_is_taken_as_it_is(make):
    host = make(port="USB1")
    host.streams()
    assert b"SERIALCONFIG" not in host.said


def test_copies_that_somebody_elses_port_gets_are_dropped_once(make):
    host = make(baud=230400, also=[("INSPVASB", 0.02), ("BESTPOSB", 1.0)])
    host.wait_for(lambda: host.device.state == "streaming")
    begin = len(host.heard)
    host.wait_for(lambda: sum(map(is_pose, host.frames(begin))) >= 60)
    frames = [frame for frame in host.frames(begin) if is_pose(frame)]
    once = Deduplicator()
    kept = [frame for frame in frames if once.is_new(frame)]
    assert len(kept) in (len(frames) // 2, len(frames) // 2 + 1)
    assert np.allclose(np.diff([nav_state(frame).gps_ns for frame in kept]), 20_000_000)


def test_a_receiver_that_restarts_is_noticed_and_set_up_again(make):
    """It comes up at its saved rate, 9600, with a prompt; until then it is silent."""
    host = make(generation=OEM6, baud=9600)
    host.streams()
    host.device.silence_s = 0.5
    host.receiver.restart(time.monotonic_ns())
    host.wait_for(lambda: host.device.reconnects == 1 and host.device.state == "streaming", 20.0)
    assert host.receiver.baud == 230400
    assert wanted(host.receiver) == {"INSPVAS": 0.02, "BESTPOS": 1.0, "TIME": 1.0, "INSPVAX": 1.0}


def test_a_receiver_that_restarts_and_streams_by_itself_is_set_up_again(make):
    """Saved at our rate with another log rate: bytes never cease, but its greeting is heard."""
    host = make(generation=OEM6, baud=230400, orders=[b"LOG INSPVASB ONTIME 0.1\r\n", b"SAVECONFIG\r\n"])
    host.streams()
    host.receiver.restart(time.monotonic_ns())
    host.wait_for(lambda: host.device.reconnects == 1 and host.device.state == "streaming", 20.0)
    assert wanted(host.receiver)["INSPVAS"] == 0.02


def test_a_receiver_that_does_not_know_the_time_yet_is_said_to_and_used_as_soon_as_it_does(make):
    host = make(fine_after_s=4.5, baud=230400)
    host.wait_for(lambda: host.device.problem is not None)
    assert "no INSPVASB came" in str(host.device.problem)
    assert "time is UNKNOWN" in str(host.device.problem)
    host.wait_for(lambda: host.device.state == "streaming", 20.0)


def test_frames_that_are_spoiled_on_the_line_cost_only_themselves(make):
    host = make(baud=230400, faults=Faults(bad_crc=0.1, truncated=0.1, dropped=0.05))
    host.streams(poses=60)
    assert host.device.reconnects == 0


def test_a_receiver_that_is_left_is_silent(make):
    host = make()
    host.streams()
    host.leave()
    assert wanted(host.receiver) == {}
    assert host.device.state == "closed"


def test_a_recorded_drive_comes_through_byte_for_byte(make, captures):
    data, offsets, arrival_s = load_recording(captures / DRIVEN)
    # A fifth of the drive, and not too fast: what the host does not read for half a second is lost.
    count = sum(moment - arrival_s[0] < 20.0 for moment in arrival_s)
    recording = data[: offsets[count]], offsets[:count], arrival_s[:count]
    receiver = PlaybackReceiver(*recording, t0_ns=time.monotonic_ns(), baud=921600, speed=4.0)
    host = make(receiver, host_baud=921600, rate_hz=20.0)
    host.wait_for(lambda: host.device.state == "streaming")
    host.wait_for(lambda: receiver.done)
    assert host.device.pose is MessageId.INSPVAX
    recorded = [frame.data for frame in Framer().feed(recording[0], 0) if is_pose(frame)]
    host.wait_for(lambda: recorded[-1] in host.heard)
    heard = [frame.data for frame in host.frames() if is_pose(frame)]
    assert len(recorded) > 390
    assert (heard == recorded) is True  # bytes by the kilobyte help nobody to see what is missing
