"""Raw dumps become a capture that replays, and come back to the byte."""

import os

import pytest

from polecal.daemon import field, recorder
from polecal.daemon.config import dump
from polecal.daemon.recorder import Record, RecorderError
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


@pytest.mark.parametrize(
    "content",
    [
        *("", "byte_offset,host_time_s\n", "offset,time\n0,1.0\n", "byte_offset,host_time_s\n5,1.0\n"),
        "byte_offset,host_time_s\n0,one\n",
        "byte_offset,host_time_s\n0\n",
        "byte_offset,host_time_s\n0,2.0\n9,1.0\n",
        "byte_offset,host_time_s\n0,1.0\n9,2.0\n8,3.0\n",
    ],
)
def test_an_arrivals_file_that_makes_no_sense_is_refused(settings, tmp_path, content):
    said, arrivals = tmp_path / "span.bin", tmp_path / "span.csv"
    said.write_bytes(bytes(20))
    arrivals.write_text(content)
    with pytest.raises(RecorderError, match=r"arrivals file|rise") as caught:
        import_dumps(tmp_path / "made.mcap", settings(), {"span": (said, arrivals)})
    assert "byte_offset" in caught.value.hint
    assert not (tmp_path / "made.mcap").exists()


def test_a_dump_that_is_not_there_is_named(settings, tmp_path):
    with pytest.raises(RecorderError, match="nowhere"):
        import_dumps(tmp_path / "made.mcap", settings(), {"span": (tmp_path / "nowhere.bin", 100.0)})
