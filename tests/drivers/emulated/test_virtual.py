import novatel_edie
import numpy as np
from novatel_edie import oem

from polecal.drivers.emulated import laser_telegrams as lms
from polecal.drivers.emulated.receiver import load_recording
from polecal.drivers.emulated.virtual import Rig, play
from polecal.drivers.emulated.world import HAND_MEASURED

START_NS = 5_000_000_000


def record(seconds, **how):
    rig = Rig.demo(how.pop("world", 2), START_NS)
    rig.stream(START_NS)
    return list(play({"front": rig.laser, "span": rig.receiver}, start_ns=START_NS, seconds=seconds, **how))


def test_chunks_come_in_time_order_and_join_to_whole_telegrams():
    chunks = record(10.0, jitter_s=0.0005)
    stamps = [t_ns for _, t_ns, _ in chunks]
    assert stamps == sorted(stamps)
    assert stamps[0] >= START_NS
    front = b"".join(data for name, _, data in chunks if name == "front")
    size = 814
    assert len(front) // size > 180
    for at in range(0, len(front) - size, size):
        body = front[at : at + size]
        assert lms.crc16(body[:-2]) == int.from_bytes(body[-2:], "little")
    parser = oem.Parser()
    span = b"".join(data for name, _, data in chunks if name == "span")
    found = []
    for at in range(0, len(span), 4096):
        parser.write(span[at : at + 4096])
        found += [message for message in parser if not isinstance(message, novatel_edie.UnknownBytes)]
    assert len(found) > 1000
    assert {int(m.ins_solution_status) for m in found[-50:] if hasattr(m, "ins_solution_status")} == {3}


def test_the_same_seed_is_the_same_recording_whatever_it_is_cut_into():
    def joined(chunks, wanted):
        return b"".join(data for name, _, data in chunks if name == wanted)

    once, again, coarse = record(4.0), record(4.0), record(4.0, chunk_s=0.01)
    assert once == again
    for name in ("front", "span"):
        assert joined(coarse, name)[:20_000] == joined(once, name)[:20_000]
    assert joined(record(4.0, world=3), "front") != joined(once, "front")


def test_jitter_makes_stamps_late_never_early():
    plain = record(2.0, chunk_s=0.001)
    late = record(2.0, chunk_s=0.001, jitter_s=0.002)
    delay = np.array([b[1] - a[1] for a, b in zip(plain, late, strict=True)])
    assert delay.min() >= 0
    assert delay.mean() > 1_000_000


def test_a_script_is_what_the_host_writes():
    rig = Rig.demo(0, START_NS)
    ask = lms.telegram(0, b"\x3a")
    script = [(START_NS + 10**9, "front", ask), (START_NS + 2 * 10**9, "span", b"UNLOGALL\r\n")]
    heard = list(
        play({"front": rig.laser, "span": rig.receiver}, start_ns=START_NS, seconds=10.0, script=script)
    )
    front = b"".join(data for name, _, data in heard if name == "front")
    assert front.endswith(b"\x06" + lms.reply(0xBA, b"LMS291;S05;V02.10 "))
    assert b"".join(data for name, _, data in heard if name == "span") == b"\r\n<OK\r\n[COM1]"
    assert next(t_ns for name, t_ns, _ in heard if name == "span") > START_NS + 2 * 10**9


def test_a_recorded_rig_sees_the_pole_from_all_twelve_slices(captures):
    recording = load_recording(captures / "span_driver_ins_ppp_driven_20hz.bin")
    rig = Rig.recorded(recording, t0_ns=START_NS, mount=HAND_MEASURED)
    rig.stream(START_NS)
    devices = {"front": rig.laser, "span": rig.receiver}
    heard = list(play(devices, start_ns=START_NS, seconds=115.0, chunk_s=0.005))
    assert b"".join(data for name, _, data in heard if name == "span") == recording[0]
    assert rig.world.start_ns == START_NS + 20_000_000
    front = b"".join(data for name, _, data in heard if name == "front")
    bearing = np.deg2rad(50 - 0.25 * np.arange(401))
    returns = np.zeros(12, int)
    for at in range(0, len(front) - 814, 814):
        words = np.frombuffer(front, "<u2", 401, at + 7)
        t_s = at / 814 * 4 * 0.01332 - 0.02
        rpy = rig.world.trajectory.pose([max(t_s, 0.0)])[1]
        bright = (words >> 13 >= 6) & ((words & 0x1FFF) < 800)
        returns[int(np.rad2deg(rpy[0, 2]) % 360 // 30)] += np.count_nonzero(bright & (np.abs(bearing) < 0.9))
    assert returns.min() > 0
