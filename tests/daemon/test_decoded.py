"""A finalised capture has what its chunks mean, as the official reader and decoders find it."""

import errno
import json
import os
import shutil
from collections import Counter, defaultdict
from datetime import UTC, datetime
from types import SimpleNamespace

import numpy as np
import pytest
import yaml
from jsonschema import Draft202012Validator
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory
from scipy.spatial.transform import Rotation, Slerp
from structlog.testing import capture_logs

from polecal.daemon import finalise as finalising
from polecal.daemon import recorder
from polecal.daemon.decoded import Decoder
from polecal.daemon.finalise import Finaliser, finalise
from polecal.daemon.recorder import Record, Recorder
from polecal.daemon.sessions import CALIBRATION
from polecal.daemon.transfer import export_dumps, import_dumps
from polecal.drivers.novatel_span import Framer as Span
from polecal.drivers.novatel_span import MessageId, parse
from polecal.drivers.sick_lms import Framer, Scan, decode

POLE, GROUND = 0, 1
DTYPES = {7: "<f4", 1: "u1"}  # of foxglove.NumericType, what is used


def copied(recorded, folder):
    """A session's folder with its capture as it was written; not its passes, which nothing here reads."""
    folder.mkdir()
    shutil.copyfile(recorded.session.capture, folder / "capture.mcap")
    return folder / "capture.mcap"


def shown(path):
    """All that the official reader finds in a file, decoded by the official decoder, CRCs on."""
    every = SimpleNamespace(topics=defaultdict(list), schemas={}, raw=[], metadata={}, size=defaultdict(int))
    decoders = DecoderFactory()
    with path.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        every.summary = reader.get_summary()
        every.metadata = {record.name: record.metadata for record in reader.iter_metadata()}
        for schema, channel, message in reader.iter_messages(log_time_order=False):
            every.size[channel.topic] += len(message.data)
            if channel.message_encoding == recorder.RAW:
                every.raw.append((channel.topic, message.log_time, message.data))
                continue
            if channel.message_encoding == "json":
                content = json.loads(message.data)
                if schema is not None:
                    assert schema.encoding == "jsonschema"
                    rules = json.loads(schema.data)
                    Draft202012Validator.check_schema(rules)
                    Draft202012Validator(rules).validate(content)
            else:
                content = decoders.decoder_for(channel.message_encoding, schema)(message.data)
            every.schemas[channel.topic] = schema and schema.name
            every.topics[channel.topic].append((message.log_time, content))
    return every


def stamp_ns(time):
    return time.seconds * 10**9 + time.nanos


def points(cloud):
    """A cloud's points, (N, 3), and kinds, as its fields say where they are."""
    names = [field.name for field in cloud.fields]
    packed = np.frombuffer(
        cloud.data,
        np.dtype(
            {
                "names": names,
                "formats": [DTYPES[field.type] for field in cloud.fields],
                "offsets": [field.offset for field in cloud.fields],
                "itemsize": cloud.point_stride,
            }
        ),
    )
    return np.stack([packed[axis] for axis in "xyz"], axis=1).astype(float), packed["kind"]


def pose(transform):
    t, r = transform.translation, transform.rotation
    return np.array([t.x, t.y, t.z]), Rotation.from_quat([r.x, r.y, r.z, r.w])


@pytest.fixture(scope="module")
def finalised(recorded, tmp_path_factory):
    """The drive's capture, finalised by itself, and what is in it."""
    path = copied(recorded, tmp_path_factory.mktemp("decoded") / "session")
    done = finalise(path)
    return SimpleNamespace(path=path, done=done, shown=shown(path))


@pytest.fixture(scope="module")
def frames(finalised):
    """Where the body was in the map at times of UTC, and the frames that stay."""
    moving, still = [], {}
    for _, transform in finalised.shown.topics["/tf"]:
        if transform.child_frame_id == "body":
            assert transform.parent_frame_id == "map"
            moving.append((stamp_ns(transform.timestamp), *pose(transform)))
        else:
            still[transform.child_frame_id] = (transform.parent_frame_id, *pose(transform))
    times = np.array([each[0] for each in moving])
    places = np.stack([each[1] for each in moving])
    turns = Slerp(times - times[0], Rotation.concatenate([each[2] for each in moving]))

    def at(ns):
        where = np.array([np.interp(ns, times, places[:, axis]) for axis in range(3)])
        return where, turns(ns - times[0])

    return SimpleNamespace(at=at, first=times[0], last=times[-1], still=still, places=places)


def test_it_says_what_was_added_and_every_channel_has_a_well_known_schema(finalised, tell):
    found = finalised.shown
    assert found.schemas == {
        "/front/scan": "foxglove.LaserScan",
        "/front/points/measured": "foxglove.PointCloud",
        "/front/points/calibrated": "foxglove.PointCloud",
        "/span/fix": "foxglove.LocationFix",
        "/tf": "foxglove.FrameTransform",
        "/clock": "polecal.Clock",
        "/pole_pass": "polecal.PolePass",
        "/events": None,
    }
    count = Counter({topic: len(messages) for topic, messages in found.topics.items()})
    assert finalised.done.decoded == count.total() - count["/events"]
    assert finalised.done.not_decoded is None
    assert {index.compression for index in found.summary.chunk_indexes} == {"zstd"}
    before, after = finalised.done.size_bytes
    tell(f"{before / 1e6:.1f} MB as written, {after / 1e6:.1f} MB finalised; {dict(count)}")


def test_what_was_recorded_is_the_same_to_the_byte_and_in_the_same_order(finalised, recorded, tmp_path):
    before = list(recorder.read(recorded.session.capture))
    assert list(recorder.read(finalised.path)) == before
    raw = [(f"/{item.device}/rx", item.t_ns, item.data) for item in before if isinstance(item, Record)]
    assert finalised.shown.raw == raw
    export_dumps(finalised.path, tmp_path / "dumps")
    for name in ("front", "span"):
        said = b"".join(data for topic, _, data in raw if topic == f"/{name}/rx")
        assert (tmp_path / "dumps" / f"{name}.bin").read_bytes() == said


def test_one_that_is_finalised_again_has_nothing_twice(finalised, tmp_path):
    path = tmp_path / "capture.mcap"
    shutil.copyfile(finalised.path, path)
    again = finalise(path)
    assert (again.messages, again.decoded) == (finalised.done.messages, finalised.done.decoded)
    assert shown(path).size == finalised.shown.size


def test_a_scan_has_the_ranges_and_angles_that_the_driver_decoded(finalised, drive):
    framer, scans = Framer(), {}
    for device, t_ns, data in drive.chunks:
        if device == "front":
            for frame in framer.feed(data, t_ns):
                scans[t_ns] = decode(Scan.parse(frame), 0x01)
    found = finalised.shown.topics["/front/scan"]
    assert len(found) > 3000
    for t_ns, scan in found:
        np.testing.assert_array_equal(scan.ranges, scans[t_ns].ranges_m)
        np.testing.assert_array_equal(scan.intensities, scans[t_ns].reflectivity)
        assert (scan.start_angle, scan.end_angle) == pytest.approx(np.radians((-50, 50)))
        assert scan.frame_id == "front"
        assert scan.pose.orientation.w == 1
    assert np.isnan([scan.ranges for _, scan in found]).any()  # the sky


def test_the_pole_is_tighter_by_the_calibration_than_as_measured(finalised, drive, tell):
    passes = {content["id"]: content for _, content in finalised.shown.topics["/pole_pass"]}
    of_pole = [one for one in passes.values() if one["use"] != "other reflector"]
    assert 12 < len(of_pole) < len(passes)
    spread = {}
    for how in ("measured", "calibrated"):
        clouds = [points(cloud) for _, cloud in finalised.shown.topics[f"/front/points/{how}"]]
        assert [len(kind) for _, kind in clouds] == [sum(one["returns"].values()) for one in of_pole]
        ground = np.concatenate([cloud[kind == GROUND] for cloud, kind in clouds])
        pole = np.concatenate([cloud[kind == POLE] for cloud, kind in clouds])
        assert pole[:, 2].max() - np.median(ground[:, 2]) > 0.9  # it stands up, not down
        spread[how] = np.sqrt(pole[:, :2].var(axis=0).sum()), ground[:, 2].std()
    assert spread["calibrated"][0] < 0.3 * spread["measured"][0]
    assert spread["calibrated"][1] < 0.5 * spread["measured"][1]
    for one in of_pole:
        assert one["calibrated_cost_m"] < one["measured_cost_m"]
        assert one["direction"] == "forward"
    told = [f"{how}: pole {pole:.3f} m, ground {ground:.3f} m" for how, (pole, ground) in spread.items()]
    tell("; ".join(told))


def test_scans_through_the_frames_meet_the_pole_where_the_cloud_has_it(finalised, frames):
    """All conversions at once: a beam's angle, the laser on the body, the body in the map."""
    assert {child: frame[0] for child, frame in frames.still.items()} == {
        "front/measured": "body",
        "front/calibrated": "body",
        "front": "front/calibrated",
    }
    offset, turned = frames.still["front/calibrated"][1:]
    clouds = finalised.shown.topics["/front/points/calibrated"]
    every = [content for _, content in finalised.shown.topics["/pole_pass"]]
    passes = [one for one in every if one["use"] != "other reflector"]
    at = next(index for index, one in enumerate(passes) if one["returns"]["pole"] > 200)
    cloud, kind = points(clouds[at][1])
    pole = np.median(cloud[kind == POLE], axis=0)
    level = np.median(cloud[kind == GROUND, 2])
    begin, end = (passes[at][key]["sec"] * 10**9 + passes[at][key]["nsec"] for key in ("begin", "end"))
    bright, ground = [], []
    for _, scan in finalised.shown.topics["/front/scan"]:
        ns = stamp_ns(scan.timestamp)
        if not begin < ns < end:
            continue
        angle = np.linspace(scan.start_angle, scan.end_angle, len(scan.ranges))
        flat = np.array(scan.ranges)[:, None] * np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
        where, turn = frames.at(ns)
        in_map = turn.apply(turned.apply(flat) + offset) + where
        bright.append(in_map[np.array(scan.intensities) > 0.5])
        ground.append(in_map[np.array(scan.intensities) < 0.1, 2])
    bright, ground = np.concatenate(bright), np.concatenate(ground)
    near = bright[np.linalg.norm(bright[:, :2] - pole[:2], axis=1) < 1.0]
    assert len(near) > 150
    # The beams of a scan are given one time here, not each its own: centimetres at 2 m/s.
    np.testing.assert_allclose(np.median(near, axis=0)[:2], pole[:2], atol=0.05)
    assert np.nanmedian(ground) == pytest.approx(level, abs=0.05)


def test_the_body_moves_in_the_map_as_the_fixes_do_on_the_earth(finalised, frames, drive):
    fixes = [fix for _, fix in finalised.shown.topics["/span/fix"]]
    assert all(fix.frame_id == "body" for fix in fixes)
    assert fixes[0].latitude == pytest.approx(-33.889, abs=1e-3)
    east_m, north_m = (np.ptp(frames.places[:, axis]) for axis in range(2))
    trusted = [fix for fix in fixes if fix.metadata[0].value == "true"]
    assert len(trusted) == len(frames.places)
    metre_deg = 360 / 40_008_000
    assert np.ptp([fix.latitude for fix in trusted]) / metre_deg == pytest.approx(north_m, rel=0.01)
    cosine = np.cos(np.radians(fixes[0].latitude))
    assert np.ptp([fix.longitude for fix in trusted]) / metre_deg * cosine == pytest.approx(east_m, rel=0.01)
    gaps = np.diff([stamp_ns(fix.timestamp) for fix in fixes])
    assert np.median(gaps) == 50_000_000
    for fix in trusted[::100]:
        _, turn = frames.at(stamp_ns(fix.timestamp))
        ahead = turn.apply([1.0, 0.0, 0.0])
        off = np.degrees(np.arctan2(ahead[0], ahead[1]) - fix.heading)
        assert (off + 180) % 360 - 180 == pytest.approx(0, abs=0.1)
        assert turn.apply([0.0, 0.0, 1.0])[2] > 0.9  # up


def test_log_times_are_the_hosts_and_stamps_are_utc(finalised, drive, t0_ns):
    last_ns = drive.chunks[-1][1]
    for messages in finalised.shown.topics.values():
        assert t0_ns <= min(t_ns for t_ns, _ in messages)
        assert max(t_ns for t_ns, _ in messages) <= last_ns
    clock = [content for _, content in finalised.shown.topics["/clock"]]
    known = [each for each in clock if each["source"] == "receiver"]
    assert clock[0]["source"] == "host"
    assert clock[0]["gps"] is None
    assert len(known) > 160
    utc_ns, gps_ns, host_ns = (
        np.array([each[key]["sec"] * 10**9 + each[key]["nsec"] for each in known])
        for key in ("utc", "gps", "host")
    )
    epoch = datetime(1980, 1, 6, tzinfo=UTC).timestamp()
    assert np.ptp(utc_ns - host_ns) < 10_000_000  # ms in minutes: the clocks drift
    assert set(utc_ns - gps_ns) == {int(epoch - 18) * 10**9}
    said = Span()
    times = [
        parse(frame)
        for device, t_ns, data in drive.chunks
        if device == "span"
        for frame in said.feed(data, t_ns)
        if frame.message_id == MessageId.TIME
    ]
    assert {time.utc_offset_s for time in times} == {-18.0}
    apart_ns = np.median(utc_ns - host_ns)
    scans = [each for each in finalised.shown.topics["/front/scan"] if each[0] > host_ns[0]]
    assert len(scans) > 2900
    for t_ns, scan in scans:
        # A scan takes 53 ms, its telegram 16 ms on the line.
        assert -0.12 < (stamp_ns(scan.timestamp) - apart_ns - t_ns) / 1e9 < -0.02


def test_the_clouds_are_shown_by_the_calibration_beside_the_capture_if_it_is_this_sessions(
    finalised, recorded, tmp_path
):
    other = yaml.safe_load((recorded.session.folder / CALIBRATION).read_text())
    other["lasers"][0]["estimate"]["x_m"] = 0.4
    other["lasers"][0]["cost_m"] = 0.4
    heard = Heard(finalised.path, 0.25)
    for session, x_m in ((recorded.session.id, 0.4), ("another", None)):
        other["lasers"][0]["session"] = session
        folder = tmp_path / session
        folder.mkdir()
        (folder / CALIBRATION).write_text(yaml.safe_dump(other))
        found = shown(heard.into(folder))
        (about,) = [frame for _, frame in found.topics["/tf"] if frame.child_frame_id == "front/calibrated"]
        assert (about.translation.x == pytest.approx(0.4)) == (x_m is not None)
        assert len(found.topics["/front/points/calibrated"]) == len(found.topics["/front/points/measured"])


class Heard:
    """The first part of a capture, to be finalised in other circumstances."""

    def __init__(self, path, part):
        capture = recorder.read(path)
        items = list(capture)
        self.items, self.metadata = items[: int(len(items) * part)], capture.metadata

    def into(self, folder, *, without=None, how=finalise, **changes):
        """Record it in a folder, and have it finalised there."""
        with Recorder(folder / "capture.mcap", self.metadata | changes) as writing:
            for item in self.items:
                if isinstance(item, Record):
                    if item.device != without:
                        writing.write(item.device, item.direction, item.t_ns, item.data)
                else:
                    writing.event(item.t_ns, item.content)
        self.done = how(writing.path)
        return writing.path


def test_a_session_without_navigation_has_its_scans_by_the_hosts_time(finalised, tmp_path):
    heard = Heard(finalised.path, 0.1)
    found = shown(heard.into(tmp_path, without="span"))
    assert set(found.topics) == {"/events", "/clock", "/front/scan", "/tf"}
    assert {frame.child_frame_id for _, frame in found.topics["/tf"]} == {"front/measured", "front"}
    assert {content["source"] for _, content in found.topics["/clock"]} == {"host"}
    created = datetime.fromisoformat(heard.metadata["created"]).timestamp()
    first = found.topics["/front/scan"][0][1]
    assert stamp_ns(first.timestamp) / 1e9 == pytest.approx(created, abs=1.0)
    assert found.metadata["polecal.decoded"]["state"] == "rejected"


def test_a_session_without_a_laser_has_where_it_was(finalised, tmp_path):
    found = shown(Heard(finalised.path, 0.1).into(tmp_path, without="front"))
    assert set(found.topics) == {"/events", "/clock", "/span/fix", "/tf"}


def test_poses_that_are_not_good_are_not_shown(captures, settings, tmp_path):
    name = "span_driver_basic_fix_unaligned_10hz"
    (tmp_path / "lms.bin").write_bytes(b"")
    path = tmp_path / "capture.mcap"
    import_dumps(
        path,
        settings(),
        {
            "front": (tmp_path / "lms.bin", 50_000.0),
            "span": (captures / f"{name}.bin", captures / f"{name}.arrivals.csv"),
        },
    )
    assert finalise(path).not_decoded is None
    assert set(shown(path).topics) == {"/events", "/clock", "/tf"}


def test_a_capture_that_is_cut_off_or_damaged_is_decoded_as_far_as_it_is_whole(finalised, tmp_path):
    whole = Heard(finalised.path, 0.1).into(tmp_path, how=lambda _: None)
    for at, said in ((0, "is cut off"), (200, "is damaged")):
        folder = tmp_path / said
        folder.mkdir()
        path = folder / "capture.mcap"
        content = whole.read_bytes()
        half = len(content) // 2
        path.write_bytes(content[:half] + bytes(at) + (content[half + at :] if at else b""))
        done = finalise(path)
        assert said in done.recovered
        assert done.decoded > 100
        assert len(shown(path).topics["/front/scan"]) > 50


def test_a_run_that_was_not_made_by_a_session_is_indexed_only(tmp_path):
    writing = Recorder(tmp_path / "capture.mcap", {"config": "lasers: []\n"})
    writing.write("front", "rx", 1, b"some bytes")
    writing.close()
    done = finalise(writing.path)
    assert (done.messages, done.decoded) == (1, 0)
    assert "session, created" in done.not_decoded
    assert [item.data for item in recorder.read(writing.path)] == [b"some bytes"]


def test_where_it_is_not_asked_for_there_is_none(finalised, tmp_path):
    heard = Heard(finalised.path, 0.02)
    path = heard.into(tmp_path, how=lambda path: finalise(path, decoded=False))
    assert heard.done.not_decoded == "it is not asked for"
    assert heard.done.size_bytes[1] < heard.done.size_bytes[0]
    assert set(shown(path).topics) == {"/events"}
    assert list(recorder.read(path)) == heard.items


@pytest.mark.parametrize("method", ["__init__", "take", "finish"])
def test_a_bug_in_decoding_costs_nothing_that_was_recorded(finalised, tmp_path, monkeypatch, method):
    def fail(*_):
        raise ZeroDivisionError("a bug")

    monkeypatch.setattr(Decoder, method, fail)
    heard = Heard(finalised.path, 0.02)
    path = heard.into(tmp_path)
    assert "a bug" in heard.done.not_decoded
    assert list(recorder.read(path)) == heard.items
    assert set(shown(path).topics) == {"/events"}
    assert os.listdir(tmp_path) == ["capture.mcap"]


@pytest.mark.parametrize("error", [OSError(errno.ENOSPC, "No space left"), OSError(errno.EIO, "I/O error")])
def test_a_disk_that_fails_while_the_last_clouds_are_written_is_told_with_what_to_do(
    finalised, tmp_path, monkeypatch, error
):
    def fail(*_):
        raise error

    monkeypatch.setattr(Decoder, "finish", fail)
    done = Heard(finalised.path, 0.02)
    path = done.into(tmp_path)
    assert list(recorder.read(path)) == done.items
    assert "what was recorded is whole" in done.done.not_decoded
    assert "room" in done.done.not_decoded
    assert "Error(" not in done.done.not_decoded


def test_where_the_disk_has_room_only_for_what_was_recorded_the_rest_is_left_out(
    recorded, small_disk, tmp_path
):
    """5.4 MB and 4 MB of it compressed; with all else it would be 13 MB."""
    folder = small_disk("13m")
    path = copied(recorded, folder / "session")
    done = finalise(path, 2_000_000)
    assert done.not_decoded.startswith("too little room on the disk: what was recorded is whole; make room")
    assert list(recorder.read(path)) == list(recorder.read(recorded.session.capture))
    assert os.listdir(path.parent) == ["capture.mcap"]


def test_where_the_disk_is_full_in_the_midst_of_it_the_rest_is_left_out(recorded, small_disk, monkeypatch):
    monkeypatch.setattr(finalising, "_LOOK_EVERY", 10**9)  # as if another had filled it since
    path = copied(recorded, small_disk("12m") / "session")
    done = finalise(path)
    assert done.not_decoded.startswith("too little room on the disk: what was recorded is whole; make room")
    assert done.messages == sum(1 for _ in recorder.read(recorded.session.capture))


def test_one_that_is_killed_at_it_is_done_by_the_next_start(recorded, tmp_path, until):
    state = tmp_path / "sessions"
    state.mkdir()
    path = copied(recorded, state / "a")
    before = path.read_bytes()
    part = path.with_name(".capture.mcap.part")
    with Finaliser(tmp_path) as finaliser:
        until(lambda: part.exists() and part.stat().st_size > 1_000_000, 60.0)
        finaliser.close()
    assert path.read_bytes() == before
    with capture_logs() as logs, Finaliser(tmp_path) as finaliser:
        finaliser.join()
    (said,) = logs
    assert said["event"] == "capture indexed"
    assert said["decoded"] > 9000
    assert os.listdir(path.parent) == ["capture.mcap"]
