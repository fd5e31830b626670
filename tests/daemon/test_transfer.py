"""Raw dumps become a capture that replays, and come back to the byte."""

import json
import os
import shutil

import pytest

from polecal.daemon import field, recorder
from polecal.daemon.config import dump
from polecal.daemon.recorder import Record, Recorder, RecorderError
from polecal.daemon.replay import replay
from polecal.daemon.sessions import CALIBRATION
from polecal.daemon.transfer import export_dumps, import_dumps


@pytest.fixture
def short(recorded, tmp_path):
    """The first part of a recorded session's capture, as a file that was cut off."""
    path = tmp_path / "short.mcap"
    whole = recorded.session.capture
    path.write_bytes(whole.read_bytes()[: whole.stat().st_size // 4])
    return path


def test_a_capture_that_is_exported_and_imported_again_gives_the_same_calibration(
    short, settings, tmp_path, capsys
):
    dumps = tmp_path / "dumps"
    with pytest.raises(RecorderError, match="is cut off") as caught:
        export_dumps(short, dumps)
    assert str(dumps) in caught.value.hint
    items = [item for item in recorder.read(short) if isinstance(item, Record)]
    for name in ("front", "span"):
        said = b"".join(item.data for item in items if item.device == name)
        assert (dumps / f"{name}.bin").read_bytes() == said
    config = tmp_path / "polecal.yaml"
    config.write_text(dump(settings()))
    made = tmp_path / "made.mcap"
    command = ["import", "--lms", dumps / "front.bin", "--span", dumps / "span.bin", "--config", config]
    arrivals = [
        *("--lms-arrivals", dumps / "front.arrivals.csv"),
        *("--span-arrivals", dumps / "span.arrivals.csv"),
    ]
    assert field.main([str(word) for word in (*command, *arrivals, "--out", made)]) == 0
    assert capsys.readouterr() == (f"capture: {made}\n", "")
    again = [item for item in recorder.read(made) if isinstance(item, Record)]
    assert again == items
    live, outcome = replay(short, None, tmp_path / "live", None), replay(made, None, tmp_path / "out", None)
    assert outcome.cut is None
    first, second = (
        [(laser["estimate"], laser["cost_m"]) for laser in each.result["lasers"]] for each in (live, outcome)
    )
    assert first == second
    assert (outcome.out / CALIBRATION).exists()

    back = tmp_path / "back"
    assert field.main(["export", str(made), "--out", str(back)]) == 0
    assert sorted(os.listdir(back)) == sorted(os.listdir(dumps))
    for name in os.listdir(back):
        assert (back / name).read_bytes() == (dumps / name).read_bytes()
    assert field.main(["export", str(made), "--out", str(back)]) != 0  # nothing is written over
    assert "File exists" in capsys.readouterr().err


def test_a_recorded_drive_of_a_receiver_is_taken_with_its_arrivals(captures, settings, tmp_path):
    name = "span_driver_ins_ppp_driven_20hz"
    said, laser = captures / f"{name}.bin", tmp_path / "lms.bin"
    laser.write_bytes(b"")
    made = tmp_path / "made.mcap"
    assert import_dumps(
        made, settings(), {"front": (laser, 50_000.0), "span": (said, captures / f"{name}.arrivals.csv")}
    )
    items = [item for item in recorder.read(made) if isinstance(item, Record)]
    assert b"".join(item.data for item in items) == said.read_bytes()
    assert (items[-1].t_ns - items[0].t_ns) / 1e9 == pytest.approx(114, abs=2)
    (dumped,) = export_dumps(made, tmp_path / "back")
    assert dumped.read_bytes() == said.read_bytes()


def test_without_arrivals_it_is_stamped_evenly_and_that_is_said(settings, tmp_path, capsys):
    config = tmp_path / "polecal.yaml"
    config.write_text(dump(settings()))
    lms, span, made = tmp_path / "lms.bin", tmp_path / "span.bin", tmp_path / "made.mcap"
    lms.write_bytes(bytes(range(256)) * 40)
    span.write_bytes(b"\xaaD\x13" * 1000)
    command = ["import", "--lms", lms, "--span", span, "--config", config, "--out", made]
    assert field.main([*map(str, command), "--span-rate", "1000"]) == 0
    told = capsys.readouterr().err
    assert "front: has no arrival times: stamped evenly at 50000 bytes/s" in told
    assert "span: has no arrival times: stamped evenly at 1000 bytes/s" in told
    items = [item for item in recorder.read(made) if isinstance(item, Record)]
    last = {item.device: item.t_ns for item in items}
    assert last == {"front": 10**9 + 10240 * 20_000, "span": 10**9 + 3000 * 10**6}
    assert [item.t_ns for item in items] == sorted(item.t_ns for item in items)


@pytest.fixture
def two(settings, drive, tmp_path):
    """A drive with two lasers as dumps with their arrivals, and the configuration's file."""
    config = settings()
    front = config.lasers[0]
    both = config.model_copy(
        update={"lasers": (front, front.model_copy(update={"name": "rear", "port": "/dev/rear"}))}
    )
    (tmp_path / "polecal.yaml").write_text(dump(both))
    with Recorder(tmp_path / "taken.mcap", {"config": dump(both)}) as writing:
        for device, t_ns, data in drive.until(60):
            writing.write(device, "rx", t_ns, data)
            if device == "front":
                writing.write("rear", "rx", t_ns + 100_000, data)
    export_dumps(tmp_path / "taken.mcap", tmp_path / "dumps")
    return tmp_path


def asked(folder, *more, without=()):
    """The command that imports the dumps of two lasers."""
    dumps = folder / "dumps"
    options = {
        "--lms front": ["--lms", f"front={dumps / 'front.bin'}"],
        "--lms rear": ["--lms", f"rear={dumps / 'rear.bin'}"],
        "--lms-arrivals front": ["--lms-arrivals", f"front={dumps / 'front.arrivals.csv'}"],
        "--lms-arrivals rear": ["--lms-arrivals", f"rear={dumps / 'rear.arrivals.csv'}"],
        "--span": ["--span", str(dumps / "span.bin")],
        "--span-arrivals": ["--span-arrivals", str(dumps / "span.arrivals.csv")],
    }
    words = [word for name, pair in options.items() if name not in without for word in pair]
    command = ["import", *words, "--config", str(folder / "polecal.yaml"), "--out", str(folder / "made.mcap")]
    return field.main([*command, *map(str, more)])


def test_dumps_of_several_lasers_become_one_capture_and_each_is_calibrated(two, capsys):
    assert asked(two) == 0
    assert capsys.readouterr() == (f"capture: {two / 'made.mcap'}\n", "")
    taken, made = (
        [item for item in recorder.read(two / name) if isinstance(item, Record)]
        for name in ("taken.mcap", "made.mcap")
    )
    for name in ("front", "rear", "span"):
        assert [item for item in made if item.device == name] == [
            item for item in taken if item.device == name
        ]
    export_dumps(two / "made.mcap", two / "back")
    for name in os.listdir(two / "dumps"):
        assert (two / "back" / name).read_bytes() == (two / "dumps" / name).read_bytes()
    front, rear = replay(two / "made.mcap", None, two / "out", None).result["lasers"]
    assert (front["name"], rear["name"]) == ("front", "rear")
    assert front["passes"] == rear["passes"] > 2
    assert rear["cost_m"] < rear["measured_cost_m"]


def test_what_is_wrong_with_the_options_is_said_and_nothing_is_made(two, capsys):
    def said(*more, without=()):
        assert asked(two, *more, without=without) != 0
        assert not (two / "made.mcap").exists()
        return capsys.readouterr().err

    assert "rear: has no dump" in said(without=["--lms rear"])
    assert "left: is no laser" in said("--lms", "left=x.bin")
    assert "front, rear" in said("--lms", "left=x.bin")
    assert "x.bin: does not say of which laser" in said("--lms", "x.bin")
    assert "front: is given twice" in said("--lms", "front=x.bin")
    assert "fast is no rate" in said("--lms-rate", "rear=fast", without=["--lms-arrivals rear"])
    assert "nan is no rate" in said("--lms-rate", "rear=nan", without=["--lms-arrivals rear"])


def test_a_laser_without_arrivals_is_stamped_from_the_others_first_arrival(two, capsys):
    assert asked(two, "--lms-rate", "rear=20000", without=["--lms-arrivals rear"]) == 0
    told = capsys.readouterr().err
    assert "rear: has no arrival times: stamped evenly at 20000 bytes/s" in told
    assert "front" not in told.replace("front: only", "")
    items = [item for item in recorder.read(two / "made.mcap") if isinstance(item, Record)]
    begins = {name: next(item.t_ns for item in items if item.device == name) for name in ("rear", "front")}
    assert abs(begins["rear"] - begins["front"]) < 100_000_000


def test_arrivals_of_another_dump_are_refused(two, capsys):
    short = two / "dumps" / "rear.bin"
    short.write_bytes(short.read_bytes()[:1000])
    assert asked(two) != 0
    told = capsys.readouterr().err
    assert "arrived, but" in told
    assert "has only 1000" in told
    assert not (two / "made.mcap").exists()


def test_dumps_that_end_apart_are_told_of_and_such_that_never_met_are_refused(two, capsys):
    path = two / "dumps" / "rear.arrivals.csv"
    head, *rows = path.read_text().splitlines()
    times = [row.split(",") for row in rows]

    def later(by_s):
        path.write_text("\n".join([head, *(f"{at},{float(t) + by_s:.9f}" for at, t in times)]))

    later(20)
    assert asked(two) == 0
    told = capsys.readouterr().err
    assert "rear: only the 40.0 s that all dumps share are of use, not 0.0 s before and 20.0 s after" in told
    (two / "made.mcap").unlink()
    later(3600)
    assert asked(two) != 0
    assert "rear begins 3540.0 s after" in capsys.readouterr().err
    assert not (two / "made.mcap").exists()


def test_dumps_that_were_mixed_up_are_told_of(two, capsys):
    dumps = two / "dumps"
    for name in ("span.bin", "span.arrivals.csv"):
        shutil.copyfile(dumps / name.replace("span", "front"), dumps / name)
    assert asked(two) == 0
    assert "span: nothing of a NovAtel receiver" in capsys.readouterr().err


def test_of_one_that_could_not_be_written_nothing_is_left(two, monkeypatch, capsys):
    def fail(*_):
        raise RecorderError("no room")

    monkeypatch.setattr(Recorder, "write", fail)
    assert asked(two) != 0
    assert "no room" in capsys.readouterr().err
    assert not (two / "made.mcap").exists()


def test_recorded_data_of_a_laser_and_a_receiver_are_taken_together(captures, settings, tmp_path):
    """A real LMS200's stream, which was logged in another form, beside a real receiver's drive."""
    lines = [json.loads(line) for line in (captures / "lms200-stream.jsonl").read_text().splitlines()]
    said = [(line["t"], bytes.fromhex(line["hex"])) for line in lines if line["from"] == "lms"]
    laser, times, offset = tmp_path / "lms.bin", ["byte_offset,host_time_s"], 0
    name = "span_driver_ins_ppp_driven_20hz"
    begin_s = float((captures / f"{name}.arrivals.csv").read_text().splitlines()[1].split(",")[1])
    for t_s, data in said:
        times.append(f"{offset},{begin_s + t_s - said[0][0]:.6f}")
        offset += len(data)
    laser.write_bytes(b"".join(data for _, data in said))
    (tmp_path / "lms.csv").write_text("\n".join(times))
    config = settings({"baud": 38400, "fov_deg": 180, "resolution_deg": 0.5})
    made = tmp_path / "made.mcap"
    notes = import_dumps(
        made,
        config,
        {
            "front": (laser, tmp_path / "lms.csv"),
            "span": (captures / f"{name}.bin", captures / f"{name}.arrivals.csv"),
        },
    )
    assert ["span: only the" in note for note in notes] == [True]
    outcome = replay(made, None, tmp_path / "out", None)
    front, span = outcome.status["devices"]
    assert front["frames"] == len(said)
    assert span["frames"] > 2000
    assert outcome.result is None  # nobody drove past a pole
    assert not outcome.accepted


@pytest.mark.parametrize(
    "content",
    [
        *("", "byte_offset,host_time_s\n", "offset,time\n0,1.0\n", "byte_offset,host_time_s\n5,1.0\n"),
        "byte_offset,host_time_s\n0,one\n",
        *("byte_offset,host_time_s\n0,-1.5\n", "byte_offset,host_time_s\n0,1.5,7\n"),
        "byte_offset,host_time_s\n0,1.0\n30,2.0\n",
        "byte_offset,host_time_s\n0\n",
        "byte_offset,host_time_s\n0,2.0\n9,1.0\n",
        "byte_offset,host_time_s\n0,1.0\n9,2.0\n8,3.0\n",
    ],
)
def test_an_arrivals_file_that_makes_no_sense_is_refused(settings, tmp_path, content):
    said, arrivals = tmp_path / "span.bin", tmp_path / "span.csv"
    said.write_bytes(bytes(20))
    arrivals.write_text(content)
    with pytest.raises(RecorderError, match=r"arrivals file|rise|only 20") as caught:
        import_dumps(tmp_path / "made.mcap", settings(), {"span": (said, arrivals)})
    assert "arrivals file" in caught.value.hint
    assert not (tmp_path / "made.mcap").exists()


def test_a_dump_that_is_not_there_is_named(settings, tmp_path):
    with pytest.raises(RecorderError, match="nowhere"):
        import_dumps(tmp_path / "made.mcap", settings(), {"span": (tmp_path / "nowhere.bin", 100.0)})
