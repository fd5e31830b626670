"""One laser's beams to passes: each at its own time and pose, and only those that met the pole."""

import random

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from polecal.calib import Kind, Mount, points_nav
from polecal.daemon import fusion
from polecal.daemon.routine import State
from polecal.drivers.emulated import laser_telegrams as lms
from polecal.drivers.emulated.drive import SampledTrajectory
from polecal.drivers.emulated.laser import EmulatedLaser
from polecal.drivers.emulated.laser_telegrams import Variant
from polecal.drivers.emulated.receiver import EmulatedReceiver
from polecal.drivers.emulated.virtual import STREAM_LOGS, play
from polecal.drivers.emulated.world import HAND_MEASURED, Reflector, World


def straight(speed_mps=5.0, yaw_rate_radps=0.0, seconds=60.0):
    """Northwards from 0, 1 m west of the pole at 40 m, after standing for 6 s; or round and round."""
    t = np.arange(0.0, seconds, 0.02)
    go = np.maximum(t - 6.0, 0.0)
    yaw = yaw_rate_radps * go
    position = np.column_stack([speed_mps * go, np.full(len(t), -1.0), np.full(len(t), -0.1)])
    velocity = np.column_stack([np.where(go > 0, speed_mps, 0.0), np.zeros((len(t), 2))])
    return SampledTrajectory(t, position, np.column_stack([np.zeros((len(t), 2)), yaw]), velocity)


def world_of(trajectory, **changes):
    given = {"mount": HAND_MEASURED, "pole_ne_m": (40.0, 0.0), "range_noise_m": 0.0}
    return World(trajectory, **given | changes)


def axis_m(returns, mount=HAND_MEASURED):
    """North and east of the pole's axis by each pole return, with the true mount."""
    pole = returns[returns.kind == Kind.POLE]
    values = {key: getattr(mount, key) for key in ("x_m", "y_m", "z_m", "roll_deg", "pitch_deg", "yaw_deg")}
    return points_nav(pole, Mount(**values))[:, :2]


def test_at_15_m_per_s_every_beam_lands_on_the_pole(begun, settings, streaming):
    """One time for a whole scan would smear it by 80 cm, and the receiver's latency by 7 cm."""
    world = world_of(straight(15.0))
    played = begun(settings()).feed(streaming(world, 10.5, latency_floor_s=0.0)).finish()
    (stored,) = (one for _, one in played.passes)
    at = axis_m(stored.returns) + world_origin(world)
    off = np.linalg.norm(at - np.array(world.pole_ne_m), axis=1)
    assert len(off) > 30
    assert 0.0 < np.median(off) < 0.045  # the pole's radius, and centimetres of the laser's own rounding
    assert off.max() < 0.07


def test_while_turning_too_every_beam_lands_on_the_pole(begun, settings, streaming):
    world = world_of(straight(0.2, 1.5), pole_ne_m=(4.0, 0.0))
    played = begun(settings()).feed(streaming(world, 20.0, latency_floor_s=0.0)).finish()
    assert len(played.passes) >= 2
    for _, stored in played.passes:
        off = np.linalg.norm(axis_m(stored.returns) + world_origin(world) - world.pole_ne_m, axis=1)
        assert np.median(off) < 0.045
        assert off.max() < 0.08


def world_origin(world):
    """Where n's origin is in the world: at the first good pose, where the vehicle stood."""
    return world.trajectory.pose([0.0])[0][0, :2]


def test_a_returns_time_is_its_own(begun, settings, streaming):
    """Interlaced: neighbouring beams are measured in different turns of the mirror."""
    played = begun(settings()).feed(streaming(world_of(straight()), 16.0)).finish()
    (stored,) = (one for _, one in played.passes)
    pole = stored.returns.kind == Kind.POLE
    bearing_deg, gps_ns = np.degrees(stored.returns.bearing_rad[pole]), stored.gps_ns[pole]
    scans = np.flatnonzero(np.diff(gps_ns) > 20_000_000)
    assert len(scans)
    turns = (gps_ns - gps_ns[0]) / 13_320_000 + bearing_deg / 360
    quarter = np.round(bearing_deg * 4).astype(int)
    first = turns - (-quarter % 4)  # what is left is whole scans of four turns, but for a constant
    assert np.abs((first - first[0] + 2) % 4 - 2).max() < 0.05


def test_the_plate_next_to_the_pole_never_counts(drive, recorded):
    places = {one.place for _, one in recorded.played.passes}
    channel = recorded.played.pipeline._lasers["front"].channel
    pole = {place for place in places if channel.places.could_be_pole(place)}
    assert len(pole) == 1
    truth = np.array(drive.world.pole_ne_m) - world_origin(drive.world)
    assert np.linalg.norm(np.array(channel.places.at(pole.pop())) - truth) < 0.2
    assert recorded.played.laser()["dropped"][fusion.OTHER_REFLECTOR] > 1000


def test_a_second_post_on_one_side_does_not_count(begun, settings, streaming, drive):
    """As thin as the pole, a metre and a half beside the way: seen, kept apart, and not calibrated on."""
    post = 0.07
    truth = drive.world
    other = Reflector(
        truth.pole_ne_m[0] + 4.5, truth.pole_ne_m[1] + 3.5, facing_deg=45.0, width_m=post, height_m=2.4
    )
    world = World(truth.trajectory, mount=truth.mount, pole_ne_m=truth.pole_ne_m, reflectors=(other,), seed=1)
    played = begun(settings()).feed(streaming(world, 60.0)).finish()
    places = {one.place for _, one in played.passes}
    assert len(places) > 1
    laser = played.laser()
    by_place = {place: sum(one.place == place for _, one in played.passes) for place in places}
    channel = played.pipeline._lasers["front"].channel
    at = {place: np.array(channel.places.at(place)) + world_origin(world) for place in places}
    pole = min(places, key=lambda place: np.linalg.norm(at[place] - truth.pole_ne_m))
    assert laser["passes"] == by_place[pole]
    for key in ("roll_deg", "pitch_deg", "yaw_deg"):
        assert laser["estimate"][key] == pytest.approx(getattr(truth.mount, key), abs=0.15)
    for key in ("x_m", "y_m"):
        assert laser["estimate"][key] == pytest.approx(getattr(truth.mount, key), abs=0.03)


def test_a_return_counts_once_though_the_pole_is_seen_in_pieces(recorded):
    """The ground beside it, too."""
    passes = [stored for _, stored in recorded.played.passes]
    assert len(passes) > 3
    for stored in passes:
        beams = np.column_stack([stored.gps_ns, np.round(np.degrees(stored.returns.bearing_rad) * 100)])
        assert len(np.unique(beams, axis=0)) == len(beams)


def test_where_there_is_a_plate_and_no_pole_nothing_is_calibrated(begun, settings, streaming, drive):
    truth = drive.world
    world = World(
        truth.trajectory, mount=truth.mount, pole_ne_m=(500.0, 500.0), reflectors=truth.reflectors, seed=1
    )
    played = begun(settings()).feed(streaming(world, 60.0)).finish()
    assert played.state is State.REJECTED
    assert played.dropped()[fusion.OTHER_REFLECTOR] > 500
    assert played.laser()["passes"] == 0
    assert played.laser()["estimate"] is None
    assert played.pipeline.calibration() is None


def test_a_gap_in_the_navigation_costs_the_beams_in_it_and_they_are_counted(begun, settings, streaming):
    world = world_of(straight(3.0))
    chunks = streaming(world, 19.0)
    from_ns, to_ns = (chunks[0][1] + round(s * 1e9) for s in (17.2, 17.8))
    gap = [chunk for chunk in chunks if chunk[0] != "span" or not from_ns <= chunk[1] < to_ns]
    whole = begun(settings()).feed(chunks).finish()
    holed = begun(settings()).feed(gap).finish()
    assert State.ALIGNING not in holed.states[3:]  # 0.6 s: shorter than what counts as lost
    lost = holed.dropped().get(fusion.NO_POSE, 0) - whole.dropped().get(fusion.NO_POSE, 0)
    assert 0.5 * 19 * 401 < lost < 0.7 * 19 * 401
    (one,), (other,) = ([stored for _, stored in each.passes] for each in (whole, holed))
    kept = set(other.gps_ns.tolist())
    missing = np.array(sorted(set(one.gps_ns.tolist()) - kept))
    assert len(missing)
    assert missing[-1] - missing[0] < 0.7e9
    at = axis_m(other.returns) + world_origin(world)
    assert np.linalg.norm(at - world.pole_ne_m, axis=1).max() < 0.1


def test_a_navigation_that_stays_away_is_waited_for_only_so_long(begun, settings, streaming):
    chunks = streaming(world_of(straight(0.3), pole_ne_m=(8.0, 0.0)), 32.0)  # in view all the while
    from_ns = chunks[0][1] + 12 * 10**9
    played = begun(settings()).feed(each for each in chunks if each[0] != "span" or each[1] < from_ns)
    assert played.state is State.ALIGNING
    channel = played.pipeline._lasers["front"].channel
    assert len(channel._waiting) <= 256
    assert played.dropped()[fusion.WAITED_TOO_LONG] > 0


def test_a_hiccup_of_the_receivers_line_moves_no_return(begun, settings, streaming):
    """Poses that come 0.8 s late, in pieces: their clock starts anew, and nothing is placed by it until
    it is known again."""
    world = world_of(straight(3.0))
    held_up, chunks = [], []
    for device, t_ns, data in streaming(world, 19.0):
        seconds = (t_ns - 10**12) / 1e9
        if device == "span" and 17.2 <= seconds < 18.0:
            held_up.append(data)
            continue
        if held_up and seconds >= 18.0:
            late = b"".join(held_up)
            chunks += [("span", t_ns, late[at : at + 1000]) for at in range(0, len(late), 1000)]
            held_up = []
        chunks.append((device, t_ns, data))
    played = begun(settings()).feed(chunks).finish()
    for _, stored in played.passes:
        off = np.linalg.norm(axis_m(stored.returns) + world_origin(world) - world.pole_ne_m, axis=1)
        assert off.max() < 0.1


@pytest.mark.parametrize("off_s", [0.3, 1.4])
def test_a_laser_that_was_switched_off_and_on_is_stamped_by_its_new_count(begun, settings, off_s):
    """Its count of turns starts somewhere else; what was learnt of it before is of no use."""
    t0_ns = 10**12
    world = world_of(straight(1.5, seconds=90.0))
    receiver = EmulatedReceiver(world, t0_ns=t0_ns, seed=1, latency_floor_s=0.0)
    receiver.force_logs(t0_ns, STREAM_LOGS)
    before = EmulatedLaser(world, t0_ns=t0_ns, seed=1)
    before.force_stream(t0_ns)
    again_ns = t0_ns + round((20.0 + 3.0 + off_s) * 1e9)
    after = EmulatedLaser(world, t0_ns=again_ns - 7 * 10**9, seed=2)  # its mirror turns, its count is another
    played = begun(settings())
    played.feed(play({"front": before, "span": receiver}, start_ns=t0_ns, seconds=20.0, chunk_s=0.007))
    played.feed(play({"span": receiver}, start_ns=played.last_ns, seconds=3.0 + off_s, chunk_s=0.007))
    after.force_stream(again_ns)
    played.feed(
        play({"front": after, "span": receiver}, start_ns=again_ns, seconds=13.0, chunk_s=0.007)
    ).finish()
    assert max(one.t_ns[1] for _, one in played.passes) > again_ns + 6 * 10**9
    for _, stored in played.passes:
        off = np.linalg.norm(axis_m(stored.returns) + world_origin(world) - world.pole_ne_m, axis=1)
        assert off.max() < 0.1


def test_a_vehicle_that_stands_adds_nothing(begun, settings, streaming, parked):
    played = begun(settings()).feed(streaming(parked(), 12.0)).finish()
    assert State.COLLECTING in played.states
    assert not played.passes
    assert played.dropped()[fusion.STANDING] > 10_000


def test_what_waits_to_be_placed_when_a_run_ends_is_placed(begun, settings, streaming):
    """Scans are placed by the second, and a run may end at any moment."""
    chunks = streaming(world_of(straight(3.0)), 18.4)  # the pole is in view
    longer = begun(settings()).feed(chunks).finish()
    shorter = (
        begun(settings()).feed(chunk for chunk in chunks if chunk[1] < chunks[-1][1] - 400_000_000).finish()
    )
    (one,), (other,) = ([stored for _, stored in each.passes] for each in (longer, shorter))
    assert 0.3e9 < one.t_ns[1] - other.t_ns[1] < 0.5e9
    assert np.array_equal(one.gps_ns[: len(other.gps_ns)], other.gps_ns)


def test_scans_of_another_variant_are_counted_and_not_used(begun, settings, streaming, t0_ns, drive):
    played = begun(settings())
    front = EmulatedLaser(drive.world, t0_ns=t0_ns, seed=1)
    front.force_stream(t0_ns, Variant(180, 50))
    span = EmulatedReceiver(drive.world, t0_ns=t0_ns, seed=1)
    span.force_logs(t0_ns, STREAM_LOGS)
    played.feed(play({"front": front, "span": span}, start_ns=t0_ns, seconds=3.0))
    scans = played.pipeline.device("front")["frames"]
    assert scans > 50
    assert played.dropped() == {fusion.OTHER_VARIANT: scans * 361}
    assert played.state is State.CONNECTING


@pytest.mark.parametrize(("fov_deg", "resolution_deg"), [(100, 0.5), (180, 0.5), (180, 1.0)])
def test_every_variant_is_placed_by_its_own_timing(begun, settings, fov_deg, resolution_deg, t0_ns):
    world = world_of(straight(8.0))
    front = EmulatedLaser(world, t0_ns=t0_ns, seed=1)
    front.force_stream(t0_ns, Variant(fov_deg, round(100 * resolution_deg)))
    span = EmulatedReceiver(world, t0_ns=t0_ns, seed=1, latency_floor_s=0.0)
    span.force_logs(t0_ns, STREAM_LOGS)
    laser = {"fov_deg": fov_deg, "resolution_deg": resolution_deg}
    played = begun(settings(laser=laser))
    played.feed(play({"front": front, "span": span}, start_ns=t0_ns, seconds=13.0, chunk_s=0.007)).finish()
    at = np.vstack([axis_m(stored.returns) for _, stored in played.passes]) + world_origin(world)
    off = np.linalg.norm(at - world.pole_ne_m, axis=1)
    assert len(off) > 40
    assert off.max() < 0.08


def test_a_laser_without_indices_is_stamped_as_its_bytes_come(begun, settings, streaming, monkeypatch):
    monkeypatch.setattr(lms, "STREAM_CONFIG", lms.STREAM_CONFIG[:4] + b"\x00" + lms.STREAM_CONFIG[5:])
    world = world_of(straight(3.0))
    played = begun(settings()).feed(streaming(world, 19.0, latency_floor_s=0.0)).finish()
    (stored,) = (one for _, one in played.passes)
    off = np.linalg.norm(axis_m(stored.returns) + world_origin(world) - world.pole_ne_m, axis=1)
    assert off.max() < 0.1


def test_bit_flips_and_garbage_cost_frames_and_nothing_else(begun, settings, drive):
    """One chunk in 30 has a bit flipped, one in 40 has bytes added, one in 50 is lost; in both streams."""
    chance = random.Random(7)
    hurt = []
    for device, t_ns, whole in drive.until(45.0):
        data = whole
        mood = chance.random()
        if mood < 0.02:
            continue
        if mood < 0.05:
            at = chance.randrange(len(data))
            data = whole[:at] + bytes([whole[at] ^ 1 << chance.randrange(8)]) + whole[at + 1 :]
        elif mood < 0.075:
            at = chance.randrange(len(data))
            data = whole[:at] + chance.randbytes(chance.randrange(1, 200)) + whole[at:]
        hurt.append((device, t_ns, data))
    played = begun(settings()).feed(hurt)
    for name in ("front", "span"):
        assert played.pipeline.device(name)["bad_frames"] > 10
    assert played.state is State.COLLECTING
    played.finish()
    estimate = played.laser()["estimate"]
    for key in ("roll_deg", "pitch_deg", "yaw_deg"):
        assert estimate[key] == pytest.approx(getattr(drive.world.mount, key), abs=0.15)


def test_garbage_alone_is_survived_and_gives_nothing(begun, settings):
    chance = random.Random(3)
    played = begun(settings())
    played.feed(
        (("front", "span")[number % 2], 10**12 + number * 10**6, chance.randbytes(chance.randrange(1, 4096)))
        for number in range(300)
    ).finish()
    assert played.states == [State.CONNECTING, State.CALIBRATING, State.REJECTED]


def test_a_rotation_of_the_world_is_a_rotation(drive):
    """The worlds here and the calibration speak of the same angles."""
    angles = (drive.world.mount.yaw_deg, drive.world.mount.pitch_deg, drive.world.mount.roll_deg)
    expected = Rotation.from_euler("ZYX", angles, degrees=True).as_matrix()
    assert drive.world.mount.matrix == pytest.approx(expected, abs=1e-12)
