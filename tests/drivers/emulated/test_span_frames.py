"""Our frames against the sheet's vectors and the maker's decoder."""

import json

import pytest

from polecal.drivers.emulated import span_frames as span
from polecal.drivers.emulated.span_frames import LOGS, InsStatus, Solution, Stamp


@pytest.fixture(scope="module")
def vectors(protocol):
    return {entry["name"]: entry for entry in json.loads((protocol / "novatel-vectors.json").read_text())}


SOLUTION = Solution(
    Stamp(2400, 345_678_910, status=0x02000020),
    position=(-33.889, 151.193, 61.25),
    velocity=(1.5, -2.5, 0.125),
    attitude=(1.25, -2.5, 271.5),
    antenna=(-33.8890011, 151.1930022, 62.5),
    undulation_m=22.4,
)


def test_every_binary_vector_is_read_and_its_crc_is_ours(vectors):
    read = 0
    for name, entry in vectors.items():
        if entry["encoding"].startswith("binary") and "NEGATIVE" not in name:
            frame = bytes.fromhex(entry["hex"])
            assert span.frame_size(frame) == len(frame), name
            found = span.parse_frame(frame)
            assert found is not None, name
            assert (found[0], found[2].week, found[2].ms) == tuple(
                entry["header"][key] for key in ("msg_id", "week", "ms")
            )
            read += 1
    assert read >= 25


def test_a_flipped_bit_is_not_a_frame(vectors):
    frame = bytearray.fromhex(vectors["INSPVAXB driven"]["hex"])
    frame[60] ^= 4
    assert span.parse_frame(bytes(frame)) is None
    assert list(span.frames(bytes(frame))) == []


def test_a_response_is_the_real_ones_but_for_its_software_build(vectors):
    real = bytes.fromhex(vectors["LOGB command response OK"]["hex"])
    stamp = Stamp(1687, 419249437, status=0)
    ours = span.long_frame(1, b"\x01\0\0\0OK", stamp, definition=0xFFFF, response=True)
    assert ours[:12] == real[:12]
    assert ours[13:26] == real[13:26]
    assert ours[28:34] == real[28:34]


def test_a_real_short_frame_is_rebuilt_to_the_byte(vectors):
    entry = vectors["INSPVASB OEM6"]
    said = entry["decoded"]
    solution = Solution(
        Stamp(said["week"], entry["header"]["ms"]),
        (said["lat_deg"], said["lon_deg"], said["h_ellipsoid_m"]),
        (said["v_north"], said["v_east"], said["v_up"]),
        (said["roll_deg"], said["pitch_deg"], said["azimuth_deg"]),
        (0.0, 0.0, 0.0),
    )
    assert LOGS["INSPVAS"].frame(solution) == bytes.fromhex(entry["hex"])


@pytest.mark.parametrize("name", sorted(set(LOGS) - {"BESTGNSSPOS"}))
def test_the_makers_decoder_knows_every_log_by_its_name_and_time(edie, name):
    (message,) = edie(LOGS[name].frame(SOLUTION))
    said = type(message).__name__
    assert said.split("_")[0] == name
    assert message.header.week == 2400
    assert message.header.milliseconds == 345_678_910
    if not LOGS[name].short and LOGS[name].definition:
        assert said.endswith(f"_{LOGS[name].definition:04X}")


@pytest.mark.parametrize("name", ["INSPVA", "INSPVAS", "INSPVAX"])
def test_poses_are_decoded_as_they_were(edie, name):
    (message,) = edie(LOGS[name].frame(SOLUTION))
    assert (message.latitude, message.longitude) == SOLUTION.position[:2]
    assert (message.north_vel, message.east_vel, message.up_vel) == SOLUTION.velocity
    assert (message.roll, message.pitch, message.azimuth) == SOLUTION.attitude
    assert message.ins_solution_status == InsStatus.SOLUTION_GOOD
    if name == "INSPVAX":
        assert message.orthometric_height + message.undulation == pytest.approx(61.25, abs=1e-9)
        assert message.azimuth_std_dev == pytest.approx(SOLUTION.sigma[8])
        assert message.position_type == span.PosType.INS_RTKFIXED
    else:
        assert message.height == 61.25
        assert message.seconds == 345_678.910


def test_bestpos_is_the_antennas_place_above_the_sea(edie):
    (message,) = edie(LOGS["BESTPOS"].frame(SOLUTION))
    assert (message.latitude, message.longitude) == SOLUTION.antenna[:2]
    assert message.orthometric_height + message.undulation == pytest.approx(62.5, abs=1e-9)
    assert message.base_id == "0001"


def test_covariances_are_the_squares_of_the_deviations(edie):
    (message,) = edie(LOGS["INSCOV"].frame(SOLUTION))
    fields = message.to_dict()
    matrices = [value for value in fields.values() if isinstance(value, list)]
    roots = [[matrix[i] ** 0.5 for i in (0, 4, 8)] for matrix in matrices]
    lat, lon, height, north, east, up, roll, pitch, azimuth = SOLUTION.sigma
    assert roots == [
        pytest.approx([lat, lon, height]),
        pytest.approx([pitch, roll, azimuth]),
        pytest.approx([north, east, up]),
    ]


def test_time_says_the_utc_of_the_gps_epoch(edie, vectors):
    real = vectors["TIMEB utc_offset -16"]
    (theirs,) = edie(bytes.fromhex(real["hex"]))
    stamp = Stamp(theirs.header.week, int(theirs.header.milliseconds))
    (ours,) = edie(LOGS["TIME"].frame(Solution(stamp, *[(0.0, 0.0, 0.0)] * 4)))
    assert ours.utc_offset == -18.0
    assert (ours.utc_year, ours.utc_month, ours.utc_day, ours.utc_hour, ours.utc_minute) == (
        2014,
        11,
        24,
        20,
        30,
    )
    assert ours.utc_millisecond + 2000 == theirs.utc_millisecond  # 16 leap seconds then, 18 now


def test_an_unaligned_pose_is_the_captured_placeholder(edie, vectors):
    (real,) = edie(bytes.fromhex(vectors["INSPVAXB un-aligned placeholder"]["hex"]))
    solution = span.unaligned(Stamp(1815, 413060000), (0.0, 0.0, 0.0))
    (ours,) = edie(LOGS["INSPVAX"].frame(solution))
    for field in ("ins_solution_status", "position_type", "latitude", "longitude", "azimuth", "roll_std_dev"):
        assert getattr(ours, field) == getattr(real, field), field
    assert ours.orthometric_height + ours.undulation == pytest.approx(real.height + real.undulation, abs=1e-3)
