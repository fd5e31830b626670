"""Chunks to calibrations: what a run comes to, and what it says on the way."""

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest

from polecal.calib import estimate
from polecal.daemon.routine import State
from polecal.drivers.emulated.laser import EmulatedLaser
from polecal.drivers.emulated.receiver import EmulatedReceiver, load_recording
from polecal.drivers.emulated.virtual import STREAM_LOGS, play
from polecal.drivers.emulated.world import MountPose, NavError, World, demo_world

ANGLES = ("roll_deg", "pitch_deg", "yaw_deg")
KEYS = ("x_m", "y_m", "z_m", *ANGLES)


def errors(laser, truth):
    return {key: laser["estimate"][key] - getattr(truth, key) for key in KEYS}


def cut_anew(chunks, size):
    """The same bytes with the same stamps, in chunks of at most ``size`` bytes."""
    for device, t_ns, data in chunks:
        for at in range(0, len(data), size):
            yield device, t_ns, data[at : at + size]


def like(world, **changes):
    """A world as another, but for something."""
    given = {
        name: getattr(world, name)
        for name in ("trajectory", "mount", "pole_ne_m", "pole_radius_m", "reflectors", "nav_error")
    }
    return World(**{**given, "seed": 1, **changes})


class Flat:
    """A drive's way on ground without a slope."""

    def __init__(self, drive):
        self._drive = drive

    def pose(self, t_s):
        position, rpy, velocity = self._drive.pose(t_s)
        level = [1.0, 1.0, 0.0]
        return position * level + [0, 0, -0.1], rpy * [0, 0, 1.0], velocity * level


# --- a good run


def test_the_demonstration_is_accepted_and_finds_the_true_pose(recorded, drive):
    assert recorded.played.state is State.ACCEPTED
    laser = recorded.played.laser()
    off = errors(laser, drive.world.mount)
    assert max(abs(off[key]) for key in ANGLES) <= 0.08
    assert max(abs(off[key]) for key in ("x_m", "y_m")) <= 0.015
    assert abs(off["z_m"]) <= 0.05 or laser["held"] == ["z"]
    for key in KEYS:
        assert abs(off[key]) <= 3 * laser["sigma"][key], key
    assert laser["measured_cost_m"] >= 3 * laser["cost_m"]
    assert laser["verdict"] == {"accepted": True, "reasons": []}
    assert all(part["done"] for part in laser["coverage"])


def test_a_run_goes_through_its_states_each_with_a_reason(recorded, drive):
    assert recorded.played.states == [
        State.CONNECTING,
        State.ALIGNING,
        State.COLLECTING,
        State.CALIBRATING,
        State.ACCEPTED,
    ]
    moments = [t_ns for t_ns, *_ in recorded.played.transitions]
    assert moments == sorted(moments)
    assert moments[-1] == moments[-2] < drive.chunks[-1][1]  # it ends by itself, before the drive does
    assert all(why for *_, why in recorded.played.transitions)


def test_once_it_has_ended_nothing_changes(recorded):
    pipeline = recorded.played.pipeline
    before = pipeline.calibration(), pipeline.status(), len(recorded.played.transitions)
    for device, t_ns in (("front", 10**15), ("span", 10**15)):
        pipeline.feed(device, t_ns, b"\x02\x80\xd6\x02\xb0" * 400)
    pipeline.finish(10**15, "again")
    assert (pipeline.calibration(), pipeline.status(), len(recorded.played.transitions)) == before


def test_the_same_chunks_give_the_same_to_the_last_digit(begun, settings, drive):
    one, other = (begun(settings()).feed(drive.until(40.0)).finish() for _ in range(2))
    assert one.pipeline.calibration() == other.pipeline.calibration() is not None
    assert one.transitions == other.transitions
    assert one.pipeline.status() == other.pipeline.status()


@pytest.mark.parametrize(("size", "sigmas"), [(1, 1.0), (37, 0.3)])
def test_where_chunks_are_cut_hardly_matters(begun, settings, drive, size, sigmas):
    """In small chunks of one stamp it is lost how much of the line's time lies within them."""
    chunks = drive.until(30.0)
    whole = begun(settings()).feed(chunks).finish().laser()
    pieces = begun(settings()).feed(cut_anew(chunks, size)).finish().laser()
    assert whole["passes"] == pieces["passes"] > 0
    assert pieces["cost_m"] == pytest.approx(whole["cost_m"], rel=0.1 * sigmas)
    for key in KEYS:
        assert pieces["estimate"][key] == pytest.approx(
            whole["estimate"][key], abs=sigmas * whole["sigma"][key]
        ), key


def test_status_tells_what_to_drive_next_and_counts_what_came(begun, settings, drive):
    played = begun(settings()).feed(drive.until(60.0))
    status = played.pipeline.status()
    assert status["state"] == "collecting"
    laser = played.laser()
    open_slices = [part["slice"] for part in laser["coverage"] if not part["done"]]
    assert 0 < len(open_slices) < 12
    assert "heading" in status["next"]
    assert str(open_slices[-1] * 30) in status["next"] or str(open_slices[-1] * 30 + 30) in status["next"]
    span, front = played.pipeline.device("span"), played.pipeline.device("front")
    assert span["rate_hz"] == pytest.approx(100, rel=0.03)
    assert front["rate_hz"] == pytest.approx(18.77, rel=0.01)
    assert span["ins_status"] == "INS_SOLUTION_GOOD"
    assert span["frames"] == pytest.approx(60 * 102, abs=20)
    assert front["frames"] == pytest.approx(60 * 18.77, abs=3)
    assert span["bad_frames"] == front["bad_frames"] == 0


def test_two_lasers_in_one_world_are_both_calibrated(begun, settings, drive, t0_ns):
    behind = MountPose(-0.62, 0.23, -0.93, 0.7, -7.1, 178.2)
    rear_world = like(drive.world, mount=behind, seed=5)
    rear = EmulatedLaser(rear_world, t0_ns=t0_ns, seed=9)
    rear.force_stream(t0_ns)
    heard = [*drive.until(70.0), *play({"rear": rear}, start_ns=t0_ns, seconds=70.0, chunk_s=0.007)]
    heard.sort(key=lambda chunk: chunk[1])
    measured = {"x_m": -0.6, "y_m": 0.2, "z_m": -0.9, "roll_deg": 0.0, "pitch_deg": -8.0, "yaw_deg": 180.0}
    front = settings().lasers[0].model_dump()
    config = settings(lasers=[front, front | {"name": "rear", "port": "/dev/lms-rear", "mount": measured}])
    played = begun(config).feed(heard).finish()
    assert {name for name, _ in played.passes} == {"front", "rear"}
    lasers = played.pipeline.calibration()["lasers"]
    assert [laser["name"] for laser in lasers] == ["front", "rear"]
    for laser, truth in zip(lasers, (drive.world.mount, behind), strict=True):
        off = errors(laser, truth)
        assert max(abs((off[key] + 180) % 360 - 180) for key in ANGLES) <= 0.15
        assert max(abs(off[key]) for key in ("x_m", "y_m")) <= 0.025
        assert laser["passes"] > 5
        assert not any("disagree" in reason for reason in laser["verdict"]["reasons"])


def test_two_lasers_of_which_one_is_held_where_it_is_not_are_both_rejected_and_why(
    begun, settings, drive, t0_ns
):
    """The same laser twice, the second measured 15 cm off, and said to be good to a centimetre."""
    heard = [chunk for device, t_ns, data in drive.until(70.0) for chunk in _twice(device, t_ns, data)]
    front = settings().lasers[0].model_dump()
    measured = front["mount"] | {"y_m": front["mount"]["y_m"] + 0.15}
    copy = front | {"name": "copy", "port": "/dev/lms-copy", "mount": measured, "hold": ["y"]}
    copy["mount_sigma"] = {"xyz_m": 0.01, "rpy_deg": 5.0}
    played = begun(settings(lasers=[front, copy])).feed(heard).finish()
    assert played.state is State.REJECTED
    for laser in played.pipeline.calibration()["lasers"]:
        assert not laser["verdict"]["accepted"]
        assert any("front and copy disagree" in reason for reason in laser["verdict"]["reasons"])
    assert played.transitions[-1][3].count("front and copy disagree") == 1


def test_a_laser_that_saw_some_of_the_passes_learns_from_one_that_saw_all(begun, settings, drive, t0_ns):
    heard = [chunk for device, t_ns, data in drive.chunks for chunk in _twice(device, t_ns, data)]
    front = settings().lasers[0].model_dump()
    lasers = [front, front | {"name": "copy", "port": "/dev/lms-copy"}]
    all_of_it = begun(settings(lasers=lasers)).feed(heard).finish().pipeline.past()
    some = [one for one in all_of_it.passes["copy"] if one.id % 3]
    past = replace(all_of_it, passes=all_of_it.passes | {"copy": some})
    undemanding = {"cost_m": 1.0, "left_out_m": 1.0, "improvement": 0.9, "doubling": 0.9}
    pipeline = begun(settings(lasers=lasers, accept=undemanding, routine={"slices_needed": 1})).pipeline
    pipeline.reopen(past, t0_ns)
    whole, part = (pipeline.status()["lasers"][index] for index in range(2))
    assert whole["shared"] is None
    assert part["shared"]["laser"] == "front"
    assert part["shared"]["passes"] == part["passes"] >= 8
    for key in ("x_m", "y_m"):
        assert part["estimate"][key] == pytest.approx(whole["estimate"][key], abs=2e-3), "and so is the same"


def _twice(device, t_ns, data):
    return [(name, t_ns, data) for name in (("front", "copy") if device == "front" else (device,))]


# --- runs that come to nothing


def test_without_anything_a_run_ends_rejected_with_the_reason(begun, settings):
    played = begun(settings()).finish()
    assert played.states == [State.CONNECTING, State.CALIBRATING, State.REJECTED]
    assert played.transitions[-1][3] == "front: no pass of the pole yet"
    assert played.pipeline.calibration() is None
    assert played.laser()["estimate"] is None


def test_before_it_has_begun_nothing_is_taken(settings, drive):
    from polecal.daemon.pipeline import Pipeline

    pipeline = Pipeline(settings())
    for chunk in drive.until(2.0):
        pipeline.feed(*chunk)
    assert pipeline.status()["state"] == "idle"
    assert pipeline.device("span")["frames"] == 0
    pipeline.finish(0, "nothing to finish")
    assert pipeline.status()["state"] == "idle"


def test_a_device_that_is_not_configured_is_none_of_its_business(begun, settings, drive):
    played = begun(settings())
    played.feed(
        ("side" if device == "front" else device, t_ns, data) for device, t_ns, data in drive.until(9)
    )
    assert played.state is State.CONNECTING
    assert played.pipeline.status()["next"].startswith("wait")


def test_a_receiver_that_never_aligns_gives_nothing_and_the_reason_is_shown(
    begun, settings, drive, captures, t0_ns
):
    """A real one, 199 s of INS_ALIGNING with placeholder poses, beside a laser that sees the pole."""
    data, offsets, arrival_s = load_recording(captures / "span_driver_basic_fix_unaligned_10hz.bin")
    ends = [*offsets[1:], len(data)]
    span = [
        ("span", t0_ns + round((arrived - arrival_s[0]) * 1e9), data[begin:end])
        for begin, end, arrived in zip(offsets, ends, arrival_s, strict=True)
    ]
    front = [chunk for chunk in drive.chunks if chunk[0] == "front"]
    config = settings(navigation={"port": "/dev/span", "rate_hz": 10, "baud": 115200})
    played = begun(config).feed(sorted([*span, *front], key=lambda chunk: chunk[1]))
    assert played.states == [State.CONNECTING, State.ALIGNING]
    status = played.pipeline.status()
    assert any("INS_ALIGNING" in note for note in status["notes"])
    assert "align" in status["next"]
    assert played.pipeline.device("span")["ins_status"] == "INS_ALIGNING"
    assert played.pipeline.device("span")["rate_hz"] == pytest.approx(10, rel=0.1)
    assert not played.passes
    played.finish()
    assert played.state is State.REJECTED
    assert played.pipeline.calibration() is None


def test_a_solution_that_is_lost_leads_back_to_aligning_and_on_again(begun, settings, drive, t0_ns):
    def of(chunk):
        return (chunk[1] - t0_ns) / 1e9

    hole = [chunk for chunk in drive.until(40.0) if chunk[0] == "front" or not 20.0 < of(chunk) < 24.0]
    played = begun(settings()).feed(hole)
    assert played.states[1:] == [State.ALIGNING, State.COLLECTING, State.ALIGNING, State.COLLECTING]
    lost_ns, *_, why = played.transitions[3]
    assert (lost_ns - t0_ns) / 1e9 == pytest.approx(22.0, abs=0.1)
    assert "2 s" in why


def test_poses_that_are_not_good_are_not_used(begun, settings, drive, t0_ns):
    """The receiver says INS_ALIGNING again from 12 s on: what follows counts for nothing."""
    world = like(drive.world)
    front = EmulatedLaser(world, t0_ns=t0_ns, seed=1)
    receiver = EmulatedReceiver(world, t0_ns=t0_ns, seed=1)
    front.force_stream(t0_ns)
    receiver.force_logs(t0_ns, STREAM_LOGS)
    devices = {"front": front, "span": receiver}
    played = begun(settings()).feed(play(devices, start_ns=t0_ns, seconds=12.0, chunk_s=0.007))
    receiver._aligned_s = float("inf")
    played.feed(play(devices, start_ns=played.last_ns, seconds=10.0, chunk_s=0.007))
    assert played.state is State.ALIGNING
    assert "INS_ALIGNING" in played.transitions[-1][3]
    assert any("INS_ALIGNING" in note for note in played.pipeline.status()["notes"])
    assert all(one.gps_ns.max() < played.pipeline._navigation.trajectory.last_ns for _, one in played.passes)
    last_s = receiver.gps_ms(played.last_ns) / 1e3 - played.pipeline._navigation.trajectory.last_ns / 1e9
    assert last_s == pytest.approx(10.0, abs=0.2)


def test_with_poor_navigation_a_run_is_rejected_with_its_reasons_and_ends_by_itself(
    begun, settings, streaming, drive
):
    error = NavError(drive.world.trajectory.pass_times_s, 3, 8 * NavError.SIGMA)
    played = begun(settings(routine={"slices_needed": 6}))
    played.feed(streaming(like(drive.world, nav_error=error), 100.0))
    assert_hopeless(played, "cost", "above 0.050 m")


def test_a_hand_measurement_that_cannot_be_right_is_a_reason_and_ends_the_run(begun, settings, drive):
    """Said to be known to a degree, and 5 degrees off."""
    laser = settings().lasers[0].model_dump()
    laser["mount"]["yaw_deg"] = -3.0
    laser["mount_sigma"]["rpy_deg"] = 1.0
    played = begun(settings(laser=laser, routine={"slices_needed": 6})).feed(drive.until(100.0))
    assert_hopeless(played, "yaw", "from the hand measurement")


def test_a_run_ends_with_as_many_passes_as_there_may_be_and_says_so(begun, settings, drive):
    played = begun(settings(routine={"max_passes": 5})).feed(drive.chunks)
    assert played.states[-2:] == [State.CALIBRATING, State.REJECTED]
    assert played.transitions[-2][3] == "front: all 5 passes that there may be"
    assert max(Counter(row["place"] for row in played.pipeline.passes()).values()) == 5
    (reason,) = [one for one in played.laser()["verdict"]["reasons"] if "still not good enough" in one]
    assert reason.startswith("5 passes, still not good enough")
    assert reason in played.transitions[-1][3]
    assert any("no pass" in one for one in played.laser()["verdict"]["reasons"])
    played.pipeline.choose(played.last_ns, played.pipeline.choice("2", drop=True, by="ann", at="2026-11-22"))
    assert reason in played.laser()["verdict"]["reasons"]  # no other is driven in its place


def test_it_is_said_beforehand_that_there_may_be_no_more_passes(begun, settings, drive):
    played, said = begun(settings(routine={"max_passes": 12})), {}
    for chunk in drive.until(60.0):
        if played.feed([chunk]).passes and len(played.passes) not in said:
            notes = [note for note in played.pipeline.status()["notes"] if "passes more" in note]
            said[len(played.passes)] = (
                notes,
                Counter(one.place for _, one in played.passes).most_common(1)[0][1],
            )
    assert said[1] == ([], 1)
    assert len(said) > 3
    for notes, there in list(said.values())[1:]:
        assert notes == [f"front: {12 - there} passes more, and the session ends as it is then"] * (there > 1)


def test_passes_that_make_a_result_good_count_though_there_may_be_no_more(begun, settings, drive):
    accepted = begun(settings()).feed(drive.chunks)
    assert accepted.state is State.ACCEPTED
    most = max(Counter(row["place"] for row in accepted.pipeline.passes()).values())
    played = begun(settings(routine={"max_passes": most})).feed(drive.chunks)
    assert played.state is State.ACCEPTED
    assert played.laser()["verdict"]["reasons"] == []


def assert_hopeless(played, *words):
    assert played.states[-2:] == [State.CALIBRATING, State.REJECTED], played.laser()
    assert "would not help" in played.transitions[-2][3]
    verdict = played.laser()["verdict"]
    assert not verdict["accepted"]
    assert any(all(word in reason for word in words) for reason in verdict["reasons"])
    assert words[1] in played.transitions[-1][3]
    assert played.pipeline.calibration()["state"] == "rejected"


@pytest.fixture(scope="module")
def flat(begun, settings, streaming):
    """A drive on ground without a slope, before it is finished, and the true mount.

    Of this one the first pass alone puts the laser a million kilometres away.
    """
    other = demo_world(2)
    world = like(other, trajectory=Flat(other.trajectory))
    return begun(settings()).feed(streaming(world, 70.0)), world.mount


def test_on_flat_ground_z_is_held_as_measured_and_said_to_be(flat):
    played, truth = flat
    laser = played.laser()
    assert laser["passes"] > 5
    assert laser["held"] == ["z"]
    assert laser["estimate"]["z_m"] == -1.0
    assert laser["sigma"]["z_m"] == pytest.approx(0.1)
    off = errors(laser, truth)
    assert max(abs(off[key]) for key in ("roll_deg", "yaw_deg")) <= 0.08
    assert abs(off["pitch_deg"]) <= 0.3  # on the level only the cosine of 7 degrees tells it
    assert max(abs(off[key]) for key in ("x_m", "y_m")) <= 0.015


def test_on_flat_ground_of_mirror_images_the_one_near_the_hand_measurement_is_taken(flat):
    """Upside down and under the ground everything fits as well: roll and pitch with their signs changed."""
    played, truth = flat
    setup = played.pipeline._lasers["front"].setup
    passes = [one.moments for _, one in played.passes if one.place == 0]
    for sign in (1.0, -1.0):
        measured = replace(setup.measured, pitch_deg=sign * setup.measured.pitch_deg)
        result = estimate(passes, replace(setup, measured=measured), everywhere=True)
        assert result.mount.pitch_deg == pytest.approx(sign * truth.pitch_deg, abs=0.5)


def test_a_run_that_is_ended_early_is_calibrated_as_far_as_it_went(begun, settings, drive):
    played = begun(settings()).feed(drive.until(60.0)).finish()
    assert played.state is State.REJECTED
    reasons = played.laser()["verdict"]["reasons"]
    assert any("slice" in reason for reason in reasons)
    assert np.isfinite(list(played.laser()["estimate"].values())).all()
    assert played.pipeline.calibration()["state"] == "rejected"
