"""ROUTE: what it is for, where the pole is, and each format read back by other code."""

import csv
import io
import json
from xml.etree import ElementTree

import geojson
import gpxpy
import numpy as np
import pymap3d
import pytest
import structlog

from polecal.calib.coverage import headings
from polecal.daemon import archive, field, reporting, route, routefile
from polecal.daemon.control import MAX_LINE_BYTES, ControlServer, Refused, encode
from polecal.daemon.pipeline import Pipeline
from polecal.daemon.routine import State
from polecal.daemon.service import Service
from polecal.drivers.emulated.world import REFERENCE

POLE = [-33.889, 151.193]
ROOM = {"turn_radius_m": 3.0, "area_m": 15.0}


@pytest.fixture(scope="module")
def halfway(begun, settings, drive):
    """A session after a minute's drive, and its configuration."""
    config = settings()
    return begun(config).feed(drive.until(60.0)).pipeline, config


@pytest.fixture(scope="module")
def answer(halfway):
    pipeline, config = halfway
    return {"session": "s1"} | route.answer(config, pipeline.stand(), ROOM)


def passes(told):
    return [leg for leg in told["legs"] if leg["kind"] == "pass"]


# --- what it is for


def test_the_route_drives_what_the_next_sentence_names(answer, halfway):
    coverage = halfway[0].status()["lasers"][0]["coverage"]
    missing = [part["slice"] for part in coverage if not part["done"]]
    assert 0 < len(missing) < 12
    assert {leg["slice"] for leg in passes(answer)} == set(missing)
    assert answer["next"] == halfway[0].status()["next"]
    assert headings(missing, 30) in answer["why"][0]
    for leg in passes(answer):
        assert leg["heading_deg"] == leg["slice"] * 30 + 15


def test_it_goes_round_the_pole_where_that_was_seen(answer, drive):
    pole = answer["pole"]
    assert pole["known"] == "seen"
    at = (REFERENCE.lat_deg, REFERENCE.lon_deg, REFERENCE.height_m)
    north, east, _ = pymap3d.geodetic2ned(pole["lat_deg"], pole["lon_deg"], pole["height_m"], *at)
    assert np.hypot(north - drive.world.pole_ne_m[0], east - drive.world.pole_ne_m[1]) < 0.05
    for leg in answer["legs"]:
        assert np.hypot(*np.array(leg["points"])[:, :2].T).min() >= answer["clearance_m"] - 0.01


def test_it_begins_where_the_vehicle_is(answer, drive):
    north, east, heading_deg = answer["legs"][0]["points"][0]
    position, rpy, _ = drive.world.trajectory.pose(60.0 - 0.06)
    assert np.hypot(*(np.array([north, east]) + drive.world.pole_ne_m - position[0, :2])) < 0.4
    assert np.cos(np.radians(heading_deg) - rpy[0, 2]) > 0.99


def test_reverse_and_two_speeds_are_asked_for_while_the_time_offset_is_not_told(
    answer, halfway, begun, settings, drive
):
    early = begun(settings()).feed(drive.until(25.0)).pipeline
    assert "time_s" not in early.status()["lasers"][0]["extras"]
    told = route.answer(halfway[1], early.stand(), ROOM)
    assert any("time offset" in why for why in told["why"])
    assert {leg["direction"] for leg in passes(told)} == {"forward", "reverse"}
    assert len({leg["speed_mps"] for leg in passes(told)}) == 2
    assert "time_s" in halfway[0].status()["lasers"][0]["extras"]
    assert not any("time offset" in why for why in answer["why"])
    assert {leg["direction"] for leg in passes(answer)} == {"forward"}


def test_an_accepted_session_needs_nothing(recorded, drive):
    config = archive.told(recorded.session.folder)[1]
    told = {"session": "s1"} | route.answer(config, recorded.played.pipeline.stand(), {})
    assert told["legs"] == []
    assert told["why"] == ["the session is accepted: nothing is missing"]
    for write in routefile.FORMATS.values():
        assert write(told) is not None
    assert [str(line) for line in routefile.words(told)][1].strip() == told["why"][0]


def test_a_session_that_is_over_is_asked_by_its_name(recorded, drive, settings):
    """Its pole and n's origin are in its calibration; no vehicle is anywhere."""
    service = Service(settings(state_dir=str(recorded.session.folder.parents[1])))
    told = service.handle({"class": "ROUTE", "session": recorded.session.id})
    assert (told["session"], told["state"], told["legs"]) == (recorded.session.id, "accepted", [])
    stand = archive.reopen(recorded.session.folder)[1].stand()
    live = recorded.played.pipeline.stand()
    assert stand.here is None
    assert stand.origin == pytest.approx(live.origin)
    assert len(stand.lasers[0].today) == len(live.lasers[0].today) > 0


def test_once_all_slices_are_done_it_goes_on_from_all_sides(halfway, recorded):
    stand = recorded.played.pipeline.stand()
    (laser,) = stand.lasers
    refused = type(laser.result.verdict)(False, ("the cost still improves",), hopeless=False)
    result = type(laser.result)(
        **{name: getattr(laser.result, name) for name in laser.result.__slots__} | {"verdict": refused}
    )
    changed = {name: getattr(laser, name) for name in laser.__slots__} | {"result": result}
    asked = {name: getattr(stand, name) for name in stand.__slots__}
    going = route.Stand(**asked | {"state": State.COLLECTING, "lasers": [route.LaserStand(**changed)]})
    told = route.answer(halfway[1], going, ROOM)
    slices = {leg["slice"] for leg in passes(told)}
    assert len(slices) == 6
    assert len({part % 2 for part in slices}) == 1  # every other
    assert "from all sides" in told["why"][0]
    hopeless = type(refused)(False, ("the cost is too high",), hopeless=True)
    result = type(result)(
        **{name: getattr(result, name) for name in result.__slots__} | {"verdict": hopeless}
    )
    over = route.Stand(
        **asked | {"state": State.REJECTED, "lasers": [route.LaserStand(**changed | {"result": result})]}
    )
    told = route.answer(halfway[1], over, ROOM)
    assert told["legs"] == []
    assert "would not help" in told["why"][0]


# --- before anything was seen


def test_before_the_pole_was_seen_it_must_be_given_and_is_kept_farther_off(settings):
    config = settings()
    stand = Pipeline(config).stand()
    with pytest.raises(Refused, match="where the pole is") as error:
        route.answer(config, stand, {})
    assert "--pole" in error.value.hint
    told = route.answer(config, stand, {"pole": POLE})
    assert told["pole"]["known"] == "given"
    assert (told["pole"]["lat_deg"], told["pole"]["lon_deg"]) == tuple(POLE)
    assert {leg["slice"] for leg in passes(told)} == set(range(12))
    assert told["clearance_m"] > 2.0


@pytest.mark.parametrize(
    "request_",
    [
        {"pole": [151.2, -33.9]},
        {"pole": [1.0]},
        {"pole": "here"},
        {"pole": [float("nan"), 0.0]},
        {"turn_radius_m": -1.0},
        {"area_m": "wide"},
        {"half_width_m": True},
        {"speeds_mps": [3.0]},
        {"speeds_mps": [3.0, 100.0]},
    ],
)
def test_what_cannot_be_meant_is_refused(request_, settings):
    config = settings()
    with pytest.raises(Refused) as error:
        route.answer(config, Pipeline(config).stand(), {"pole": POLE} | request_)
    assert error.value.code == 2
    assert error.value.hint


def test_the_longest_route_fits_into_a_reply(settings):
    config = settings(routine={"slice_deg": 10, "slices_needed": 36})
    told = route.answer(
        config, Pipeline(config).stand(), {"pole": POLE, "turn_radius_m": 20.0, "area_m": 200.0}
    )
    assert told["left_out"] > 0
    assert len(encode(told)) < MAX_LINE_BYTES - 1000


# --- formats


def test_geojson_is_read_by_other_code_and_lies_where_the_legs_are(answer, monkeypatch):
    monkeypatch.setattr(geojson.geometry, "DEFAULT_PRECISION", 9)  # it would read decimetres
    read = geojson.loads(routefile.geojson(answer))
    assert read.is_valid, read.errors()
    point, *lines = read["features"]
    assert point["geometry"]["type"] == "Point"
    assert len(lines) == len(answer["legs"])
    lon0, lat0 = point["geometry"]["coordinates"]
    for line, leg in zip(lines, answer["legs"], strict=True):
        assert line["geometry"]["type"] == "LineString"
        assert {key: line["properties"][key] for key in ("kind", "direction", "speed_mps", "leg")} == {
            key: leg[key] for key in ("kind", "direction", "speed_mps", "leg")
        }
        lon, lat = np.array(line["geometry"]["coordinates"]).T
        assert_there(lat, lon, lat0, lon0, leg)


def assert_there(lat, lon, lat0, lon0, leg):
    """By the radii of curvature, as there is no pymap3d in it."""
    eccentricity2, radius_m = 0.00669437999, 6378137.0
    flat = 1 - eccentricity2 * np.sin(np.radians(lat0)) ** 2
    north = np.radians(lat - lat0) * (radius_m * (1 - eccentricity2) / flat**1.5 + 60.0)
    east = np.radians(lon - lon0) * (radius_m / flat**0.5 + 60.0) * np.cos(np.radians(lat0))
    points = np.array(leg["points"])
    assert np.abs(north - points[:, 0]).max() < 0.005
    assert np.abs(east - points[:, 1]).max() < 0.005


def test_gpx_is_read_by_other_code_and_has_its_elements_in_the_schemas_order(answer):
    text = routefile.gpx(answer)
    read = gpxpy.parse(text)
    assert (read.version, read.creator, len(read.waypoints)) == ("1.1", "polecal", 1)
    assert len(read.routes) == len(answer["legs"])
    pole = read.waypoints[0]
    for one, leg in zip(read.routes, answer["legs"], strict=True):
        assert one.number == leg["leg"]
        assert leg["direction"] in one.description
        lat, lon = np.array([(point.latitude, point.longitude) for point in one.points]).T
        assert_there(lat, lon, pole.latitude, pole.longitude, leg)
    space = "{http://www.topografix.com/GPX/1/1}"
    root = ElementTree.fromstring(text.encode())
    order = ["metadata", "wpt", "rte", "trk", "extensions"]
    tags = [order.index(child.tag.removeprefix(space)) for child in root]
    assert tags == sorted(tags)
    order = ["name", "cmt", "desc", "src", "link", "number", "type", "extensions", "rtept"]
    for one in root.iter(f"{space}rte"):
        tags = [order.index(child.tag.removeprefix(space)) for child in one]
        assert tags == sorted(tags)


def test_csv_has_metres_from_the_pole(answer):
    rows = list(csv.DictReader(io.StringIO(routefile.local_csv(answer))))
    wanted = {"north_m", "east_m", "heading_deg", "speed_mps", "direction", "leg"}
    assert wanted <= set(rows[0])
    assert len(rows) == sum(len(leg["points"]) for leg in answer["legs"])
    first = answer["legs"][0]
    assert [float(rows[0][key]) for key in ("north_m", "east_m", "heading_deg")] == first["points"][0]


def test_words_name_every_approach_within_80_columns(answer):
    lines = [str(line) for line in routefile.words(answer)]
    head = next(number for number, line in enumerate(lines) if line.split()[:2] == ["leg", "heading"])
    rows = lines[head + 1 :]
    assert [int(row.split()[0]) for row in rows] == [leg["leg"] for leg in passes(answer)]
    assert all(len(row) <= 80 for row in rows)
    assert any(" left " in line for line in lines)
    assert any(" right " in line for line in lines)


# --- the command


class Daemon:
    """Answers ROUTE, and keeps what it was asked."""

    def __init__(self, told):
        self.told, self.asked = told, None

    def handle(self, request):
        self.asked = request
        return self.told


@pytest.fixture
def daemon(answer, tmp_path, monkeypatch):
    monkeypatch.setenv("POLECAL_SOCKET", str(tmp_path / "control.sock"))
    structlog.configure(logger_factory=structlog.WriteLoggerFactory(io.StringIO()))
    made = Daemon(answer)
    with ControlServer(tmp_path / "control.sock", made):
        yield made
    structlog.reset_defaults()


def test_the_command_prints_what_is_asked_for(daemon, answer, capsys):
    assert field.main(["route"]) == 0
    assert "approaches" in capsys.readouterr().out
    for form, write in routefile.FORMATS.items():
        assert field.main(["route", "--format", form]) == 0
        assert capsys.readouterr().out == write(answer)
    assert field.main(["--json", "route", "s1"]) == 0
    assert json.loads(capsys.readouterr().out) == json.loads(encode(answer))
    assert daemon.asked["session"] == "s1"


def test_the_command_writes_a_file_by_its_ending(daemon, answer, tmp_path, capsys):
    for name, form in (("a.gpx", "gpx"), ("a.csv", "csv"), ("a.geojson", "geojson"), ("a.json", "geojson")):
        assert field.main(["route", "--out", str(tmp_path / name)]) == 0
        assert (tmp_path / name).read_text() == routefile.FORMATS[form](answer)
    assert field.main(["route", "--format", "csv", "--out", str(tmp_path / "b.txt")]) == 0
    assert (tmp_path / "b.txt").read_text() == routefile.local_csv(answer)
    assert "approaches" in capsys.readouterr().out


def test_the_command_says_what_the_vehicle_is_and_a_place_in_the_south(daemon):
    options = ["--half-width", "0.9", "--radius", "6", "--area", "30", "--speeds", "4,2"]
    assert field.main(["route", "--pole", "-33.889,151.193", *options]) == 0
    asked = daemon.asked
    assert asked["pole"] == POLE
    assert (asked["half_width_m"], asked["turn_radius_m"], asked["area_m"]) == (0.9, 6.0, 30.0)
    assert asked["speeds_mps"] == [4.0, 2.0]


def test_a_place_that_is_none_is_a_usage_error(daemon, capsys):
    assert field.main(["route", "--pole", "here"]) == 2
    assert "hint:" in capsys.readouterr().err


def test_the_report_draws_what_the_route_drives(answer, halfway):
    legs = route.to_draw(halfway[1], halfway[0].stand())
    assert {leg.slice for leg in legs if leg.kind == "pass"} == {leg["slice"] for leg in passes(answer)}


def test_a_report_of_an_unfinished_session_lays_its_route(recorded, tmp_path):
    folder = tmp_path / "20261122T000000Z-cut"
    (folder / "passes").mkdir(parents=True)
    for name in ("session.yaml", "calibration.yaml"):
        text = (recorded.session.folder / name).read_text(encoding="utf-8")
        rejected = text.replace("state: accepted", "state: rejected", 1)
        (folder / name).write_text(rejected, encoding="utf-8")
    for path in sorted((recorded.session.folder / "passes").glob("*.npz"))[:4]:
        (folder / "passes" / path.name).write_bytes(path.read_bytes())
    assert reporting._still_to_drive(folder) == ()  # a replay's: nothing is driven there
    (folder / "capture.mcap").symlink_to(recorded.session.capture)
    legs = reporting._still_to_drive(folder)
    driven = {leg.slice for leg in legs if leg.kind == "pass"}
    assert 0 < len(driven) < 12
    (folder / "session.yaml").unlink()
    assert reporting._still_to_drive(folder) == ()
