"""The table of logs against the maker's decoder and the sheet's vectors, each in every form."""

import json
from collections.abc import Iterator
from dataclasses import replace
from types import SimpleNamespace

import pytest

from polecal.drivers.emulated import span_generations as generations
from polecal.drivers.emulated import span_solution as solutions
from polecal.drivers.emulated.span_enums import EventType, EventWord, InsStatus, PosType, TimeStatus
from polecal.drivers.emulated.span_frames import PORT_IDS, Stamp
from polecal.drivers.emulated.span_logs import LOGS, NAME_OF_ID, Form, named
from polecal.drivers.emulated.span_solution import Setup, Solution

SOLUTION = Solution(
    Stamp(2400, 345_678_910, status=0x02000020),
    position=(-33.889, 151.193, 61.25),
    velocity=(1.5, -2.5, 0.125),
    attitude=(1.25, -2.5, 271.5),
    antenna=(-33.8890011, 151.1930022, 62.5),
    setup=Setup(rotation=(0.0, 1.0, -90.0), undulation=22.4),
    body_offset_s=-0.003245,
    baseline=(1.25, 123.5, -0.5),
    increment=(0.001, -0.002, 0.003, -0.04, 0.05, 0.098),
    mark=(2400, 345678.91234567),
    event=(EventWord.STATUS, 8, EventType.SET, "overrun"),
)
ALIGNING = replace(
    SOLUTION,
    stamp=Stamp(0, 12_000, status=0x004C0000, time_status=TimeStatus.UNKNOWN),
    position=solutions.PLACEHOLDER,
    velocity=solutions.ZERO,
    attitude=solutions.ZERO,
    sigma=solutions.NO_SIGMA,
    ins_status=InsStatus.INS_ALIGNING,
)


def flat(value: object) -> Iterator[object]:
    """The values of a decoded message, or of a log, in order."""
    if isinstance(value, dict):
        for key, each in value.items():
            if key != "header" and key.removesuffix("_length") in (key, "b"):  # not a group's count
                yield from flat(each)
    elif isinstance(value, (list, tuple)):
        for each in value:
            yield from flat(each)
    else:
        yield value


def ours(log, solution) -> list[object]:
    """What a log says, without the counts of its groups, which the maker's decoder leaves out."""
    return list(flat([getattr(solution, part.name) for part in log.parts]))


def same(theirs: object, value: object, tolerance: float) -> bool:
    if isinstance(value, float):
        return theirs == pytest.approx(value, abs=tolerance, rel=1e-6 if tolerance else 1e-7)
    return theirs == value


@pytest.mark.parametrize("form", [Form.BINARY, Form.ASCII])
@pytest.mark.parametrize("solution", [SOLUTION, ALIGNING], ids=["good", "powered up"])
@pytest.mark.parametrize("name", sorted(set(LOGS) - {"BESTGPSPOS"}))
def test_the_makers_decoder_finds_every_value_of_every_log(edie, name, solution, form):
    log = LOGS[name]
    (message,) = edie(log.frame(name, solution, solution.stamp, form=form))
    said = type(message).__name__.split("_")
    assert said[0] == name
    if log.definition and name != "MARK2TIME":  # to which the maker gives another definition
        assert int(said[1], 16) == log.definition
    assert message.header.week == solution.stamp.week
    assert message.header.milliseconds == solution.stamp.ms
    if not log.short:
        head = message.to_dict()["header"]
        assert head["receiver_status"] == solution.stamp.status
        assert head["time_status"] == solution.stamp.time_status
    expected = ours(log, solution)
    found = list(flat(message.to_dict()))
    assert len(found) == len(expected)
    digits = 0.0 if form is Form.BINARY else 5.1e-5
    for theirs, value in zip(found, expected, strict=True):
        assert same(theirs, value, digits), (theirs, value)


@pytest.mark.parametrize("name", sorted(set(LOGS) - {"BESTGPSPOS"}))
def test_abbreviated_logs_read_as_the_maker_writes_them(edie, name):
    log = LOGS[name]
    (message,) = edie(log.frame(name, SOLUTION, SOLUTION.stamp))
    words = log.frame(name, SOLUTION, SOLUTION.stamp, form=Form.ABBREVIATED).decode()
    theirs = message.to_abbrev_ascii().message.decode()
    assert words.endswith("\r\n")
    assert all(line.startswith("<") for line in words.splitlines())
    if name in ("MARK2TIME", "INSCOV", "INSCOVS", "CORRIMUDATA", "CORRIMUDATAS", "BESTVEL") or not (
        log.definition or log.short
    ):
        words, theirs = words.splitlines()[1][:28], theirs.splitlines()[1][:28]  # digits and headers differ
    assert words.split() == theirs.split()


def test_the_log_that_the_maker_has_forgotten_has_its_twins_body():
    twin = LOGS["BESTGNSSPOS"].frame("BESTGNSSPOS", SOLUTION, SOLUTION.stamp)
    frame = LOGS["BESTGPSPOS"].frame("BESTGPSPOS", SOLUTION, SOLUTION.stamp)
    assert frame[28:-4] == twin[28:-4]
    assert int.from_bytes(frame[4:6], "little") == 423


def test_values_are_where_their_names_say(edie):
    def read(name):
        return edie(LOGS[name].frame(name, SOLUTION, SOLUTION.stamp))[0]

    pose = read("INSPVA")
    assert (pose.latitude, pose.longitude, pose.height) == SOLUTION.position
    assert (pose.north_vel, pose.east_vel, pose.up_vel) == SOLUTION.velocity
    assert (pose.roll, pose.pitch, pose.azimuth) == SOLUTION.attitude
    assert (pose.week, pose.seconds) == (2400, pytest.approx(345_678.906755, abs=1e-9))
    pose = read("INSPVAX")
    assert pose.orthometric_height + pose.undulation == pytest.approx(61.25, abs=1e-9)
    assert pose.azimuth_std_dev == pytest.approx(SOLUTION.sigma[8])
    assert pose.position_type == PosType.INS_RTKFIXED
    antenna = read("BESTPOS")
    assert (antenna.latitude, antenna.longitude) == SOLUTION.antenna[:2]
    assert antenna.orthometric_height + antenna.undulation == pytest.approx(62.5, abs=1e-9)
    lat, lon, height, north, east, up, roll, pitch, azimuth = SOLUTION.sigma
    matrices = [value for value in read("INSCOV").to_dict().values() if isinstance(value, list)]
    assert [[matrix[i] ** 0.5 for i in (0, 4, 8)] for matrix in matrices] == [
        pytest.approx([lat, lon, height]),
        pytest.approx([pitch, roll, azimuth]),
        pytest.approx([north, east, up]),
    ]
    raw = read("RAWIMUX")
    imu = generations.G320
    assert raw.imu_type == imu.kind
    assert [raw.accel_z, raw.accel_y, raw.accel_x] == [
        round(v / imu.accel_mps) for v in (0.098, -0.05, -0.04)
    ]
    assert [raw.gyro_z, raw.gyro_y, raw.gyro_x] == [round(v / imu.gyro_rad) for v in (0.003, 0.002, 0.001)]
    assert read("MARK1TIME").seconds == 345678.91234567


def test_a_body_time_before_its_header_belongs_to_the_week_before():
    early = replace(SOLUTION, stamp=Stamp(2101, 0))
    assert (early.week, early.seconds) == (2100, pytest.approx(604_799.996755))
    assert (early.gps_week, early.gps_ms) == (2101, 0)


# --- the sheet's vectors


@pytest.fixture(scope="module")
def vectors(protocol):
    return {entry["name"]: entry for entry in json.loads((protocol / "novatel-vectors.json").read_text())}


def again(log, message) -> SimpleNamespace:
    """What a decoded message says, by the names of our layout."""
    fields = message.to_dict()
    groups = [value for key, value in fields.items() if f"{key}_length" in fields]
    plain = flat({key: value for key, value in fields.items() if f"{key}_length" not in fields})
    values = {}
    for part in log.parts:
        if part.group:
            values[part.name] = [list(flat(item)) for item in groups.pop(0)]
        elif len(part.kinds) > 1:
            values[part.name] = [next(plain) for _ in part.kinds]
        else:
            values[part.name] = next(plain)
    return SimpleNamespace(**values)


BINARY = [
    "INSPVAXB driven", "BESTPOSB INS_PPP", "CORRIMUDATAB long header", "TIMEB utc_offset -16", "INSCOVB",
    "INSPVAXB un-aligned placeholder", "INSPVASB short header", "INSSTDEVB", "INSCONFIGB", "INSPVAXB OEM7",
    "INSPVAXB pair (MSL height)", "INSPVASB pair (ellipsoidal height)", "HEADING2B", "RXSTATUSB",
    "TIMEB OEM7", "BESTPOSB USB1 OEM6", "INSPVASB OEM6",
]  # fmt: skip


@pytest.mark.parametrize("name", BINARY)
def test_a_real_binary_log_is_rebuilt_to_the_byte(edie, vectors, name):
    real = bytes.fromhex(vectors[name]["hex"])
    (message,) = edie(real)
    head = vectors[name]["header"]
    log_name = NAME_OF_ID[head["msg_id"]]
    log = LOGS[log_name]
    if log.short:
        stamp = Stamp(head["week"], head["ms"])
    else:
        port = next(port for port, first in PORT_IDS.items() if first & 0xFF == head["port"] & 0xE0)
        stamp = Stamp(
            head["week"], head["ms"], head["rx_status"], port, head["port"] & 0x1F, head["msg_type"],
            TimeStatus(head["time_status"]), head["idle_raw"], head["sw_version"], head["sequence"],
        )  # fmt: skip
    frame = log.frame(log_name, again(log, message), stamp, definition=head.get("reserved"))
    assert frame == real


ASCII = [
    "INSPVASA short", "INSPVAA", "INSPVAXA OEM7 real RTK", "INSPVAXA OEM7 docs", "TIMEA", "MARKTIMEA",
    "TIMESYNCA", "RAWIMUSXA OEM7", "BESTPOSA OEM7", "CORRIMUDATASA", "INSATTA aligning (real)",
    "INSATTA good (real)", "VERSIONA OEM4 SPAN (real)", "VERSIONA OEM6", "INSPVASA real", "INSPVAA real",
    "TIMEA at power-up UNKNOWN/INVALID", "RXSTATUSEVENTA unsolicited",
]  # fmt: skip


@pytest.mark.parametrize("name", ASCII)
def test_a_real_ascii_log_is_rebuilt_to_the_letter(edie, vectors, name):
    text = vectors[name]["ascii"]
    (message,) = edie(text.encode() + b"\r\n")
    head = text.partition(";")[0].split(",")
    log_name, form = named(head[0][1:])
    assert form is Form.ASCII
    log, definition = LOGS[log_name], None
    if log.short:
        stamp = Stamp(int(head[1]), round(float(head[2]) * 1000))
    else:
        definition = int(head[8], 16)
        stamp = Stamp(
            int(head[5]), round(float(head[6]) * 1000), int(head[7], 16), head[1], 0, 0, TimeStatus[head[4]],
            round(float(head[3]) * 2), int(head[9]), int(head[2]),
        )  # fmt: skip
    line = log.frame(log_name, again(log, message), stamp, form=form, definition=definition)
    assert line.decode() == text + "\r\n"


def test_an_unaligned_pose_is_the_captured_placeholder(edie, vectors):
    (real,) = edie(bytes.fromhex(vectors["INSPVAXB un-aligned placeholder"]["hex"]))
    (ours,) = edie(LOGS["INSPVAX"].frame("INSPVAX", ALIGNING, ALIGNING.stamp))
    for field in ("ins_solution_status", "position_type", "latitude", "longitude", "azimuth", "roll_std_dev"):
        assert getattr(ours, field) == getattr(real, field), field
    assert ours.orthometric_height + ours.undulation == pytest.approx(real.height + real.undulation, abs=1e-3)


def test_time_says_the_utc_of_the_gps_epoch(edie, vectors):
    (theirs,) = edie(bytes.fromhex(vectors["TIMEB utc_offset -16"]["hex"]))
    stamp = Stamp(theirs.header.week, int(theirs.header.milliseconds))
    (ours,) = edie(LOGS["TIME"].frame("TIME", replace(SOLUTION, stamp=stamp), stamp))
    assert ours.utc_offset == -18.0
    utc = ("utc_year", "utc_month", "utc_day", "utc_hour", "utc_minute")
    assert [getattr(ours, field) for field in utc] == [2014, 11, 24, 20, 30]
    assert ours.utc_millisecond + 2000 == theirs.utc_millisecond  # 16 leap seconds then, 18 now


# --- generations


@pytest.mark.parametrize(
    ("generation", "there", "lacking"),
    [
        (
            generations.OEM4,
            "BESTGPSPOS INSPVAS MARKTIME VEHICLEBODYROTATION",
            "INSPVAX INSSTDEV MARK1TIME RAWIMUSX",
        ),
        (generations.OEMV, "BESTGPSPOS INSCOVS RAWIMUS", "INSPVAX INSCONFIG BESTGNSSPOS HEADING2"),
        (
            generations.OEM6,
            "INSPVAX BESTGNSSPOS MARK1TIME RAWIMUSX HEADING2",
            "INSSTDEV BESTGPSPOS INSCONFIG",
        ),
        (generations.OEM7, "INSPVAX INSSTDEVS INSCONFIG MARK2TIME", "BESTGPSPOS VEHICLEBODYROTATION"),
    ],
)
def test_each_generation_has_its_logs(generation, there, lacking):
    assert all(generation.has(name) for name in there.split())
    assert not any(generation.has(name) for name in lacking.split())


@pytest.mark.parametrize(
    ("generation", "words", "hardware"),
    [
        (generations.OEM4, 4, "OEM4g2"), (generations.OEMV, 4, "OEMV"), (generations.OEM6, 4, "OEM6"),
        (generations.OEM7, 5, "OEM7"),
    ],
)  # fmt: skip
def test_each_generation_says_what_it_is(edie, generation, words, hardware):
    solution = replace(SOLUTION, setup=Setup(generation))
    (status,) = edie(LOGS["RXSTATUS"].frame("RXSTATUS", solution, solution.stamp))
    assert len(status.status_words) == words
    (version,) = edie(LOGS["VERSION"].frame("VERSION", solution, solution.stamp))
    assert version.versions[0].hardware_version.startswith(hardware)
