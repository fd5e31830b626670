"""Sums that are kept in a file: the same numbers, and no pass lost where there is no file."""

import gc
import os
import resource
from pathlib import Path

import numpy as np
import pytest

from polecal.daemon import pipeline as pipelines
from polecal.daemon.recorder import RecorderError
from polecal.daemon.spill import Spill


@pytest.fixture
def arrays():
    rng = np.random.default_rng(0)
    return [rng.normal(size=size) for size in (5886, 4095, 0, 5886)]


def read(held):
    return held() if callable(held) else held


def files_open():
    return len(list(Path("/proc/self/fd").iterdir()))


def test_what_is_put_aside_comes_back_to_the_last_bit_and_leaves_no_file(tmp_path, arrays):
    before = files_open()
    spill = Spill(tmp_path, in_memory_bytes=0)
    held = [spill.put(array) for array in arrays]
    assert all(map(callable, held[:2]))
    for _ in range(2):
        assert all(np.array_equal(read(one), array) for one, array in zip(held, arrays, strict=True))
    assert list(tmp_path.iterdir()) == []
    del spill
    gc.collect()
    assert np.array_equal(read(held[0]), arrays[0])  # while any is still to be fetched, the file stays
    held.clear()
    gc.collect()
    assert files_open() == before


def test_the_first_of_them_need_no_disk(tmp_path, arrays):
    spill = Spill(tmp_path, in_memory_bytes=arrays[0].nbytes + arrays[1].nbytes)
    assert [callable(spill.put(array)) for array in arrays] == [False, False, False, True]


def test_without_a_folder_all_stays_in_memory(arrays):
    spill = Spill(None, in_memory_bytes=0)
    assert all(spill.put(array) is array for array in arrays)


def test_what_a_full_disk_does_not_take_stays_in_memory(tmp_path, arrays):
    """A file may have 60 kB: one array and a part of the next."""
    spill = Spill(tmp_path, in_memory_bytes=0)
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (60_000, limits[1]))
    try:
        held = [spill.put(array) for array in arrays]
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    held.append(spill.put(arrays[0]))  # there is room again
    assert [callable(one) for one in held] == [True, False, False, False, True]
    assert all(np.array_equal(read(one), of) for one, of in zip(held, [*arrays, arrays[0]], strict=True))


def test_a_folder_that_takes_no_file_is_done_without(tmp_path, arrays):
    spill = Spill(tmp_path / "gone", in_memory_bytes=0)
    assert spill.put(arrays[0]) is arrays[0]


@pytest.mark.parametrize(
    "fail",
    [lambda file: os.ftruncate(file, 1000), lambda file: os.pwrite(file, bytes(4096), 8192)],
    ids=["cut off", "a page lost"],
)
def test_what_the_disk_does_not_give_back_is_told_and_where_it_comes_from_again(tmp_path, arrays, fail):
    spill = Spill(tmp_path, in_memory_bytes=0)
    held = spill.put(arrays[0])
    fail(spill._file)
    with pytest.raises(RecorderError, match="cannot be read back") as error:
        held()
    assert "replay" in error.value.hint


def sums_of(pipeline):
    return [
        of
        for laser in pipeline._lasers.values()
        for one in laser.passes
        for of in one.moments.totals.values()
    ]


@pytest.fixture
def driven(drive, begun, settings, monkeypatch):
    """Drives for 100 s with sums kept in a folder, drops a pass and ends; gives the pipeline."""

    def run(folder):
        with monkeypatch.context() as patched:
            patched.setattr(pipelines, "Spill", lambda _: Spill(folder, in_memory_bytes=0))
            pipeline = begun(settings()).feed(drive.until(100.0)).pipeline
        pipeline.choose(10**13, pipeline.choice("2", drop=True, by="ann", at="2026-11-22T03:17:00+00:00"))
        pipeline.finish(10**13, "asked to stop")
        return pipeline

    return run


def test_a_run_whose_sums_are_on_the_disk_gives_the_same_to_the_last_bit(driven, tmp_path):
    here, there = driven(None), driven(tmp_path)
    assert len(there.passes()) > 3
    assert all(callable(of.held) for of in sums_of(there))
    assert here.calibration() == there.calibration()
    assert here.passes() == there.passes()


def test_a_run_whose_disk_fills_on_the_way_keeps_all_its_passes(driven, small_disk):
    here, there = driven(None), driven(small_disk("200k"))
    assert {callable(of.held) for of in sums_of(there)} == {True, False}
    assert here.calibration() == there.calibration()
    del there
    gc.collect()  # the disk is to be taken away
