"""The same event reads well on a terminal, in the journal and in a file."""

import io
import json
import os

import pytest
import structlog

from polecal.daemon import log


@pytest.fixture(autouse=True)
def _own_configuration():
    yield
    structlog.reset_defaults()


class Terminal(io.StringIO):
    def isatty(self):
        return True


def test_a_file_gets_json_lines_with_time_and_level():
    stream = io.StringIO()
    log.configure(stream)
    structlog.get_logger().bind(device="front").warning("device trouble", problem="a\nb", n=3, path=io)
    (line,) = stream.getvalue().splitlines()
    told = json.loads(line)
    assert told["event"] == "device trouble"
    assert told["level"] == "warning"
    assert (told["device"], told["problem"], told["n"]) == ("front", "a\nb", 3)
    assert told["timestamp"].endswith("Z")


def test_a_terminal_gets_readable_lines():
    stream = Terminal()
    log.configure(stream)
    structlog.get_logger().info("streaming", device="front")
    assert "streaming" in stream.getvalue()
    assert not stream.getvalue().startswith("{")


def test_the_level_decides_what_is_told():
    stream = io.StringIO()
    log.configure(stream, "warning")
    logger = structlog.get_logger()
    logger.info("quiet")
    logger.error("loud")
    assert [json.loads(line)["event"] for line in stream.getvalue().splitlines()] == ["loud"]


def test_the_journal_gets_one_line_an_event_with_its_priority(tmp_path, monkeypatch):
    with (tmp_path / "journal").open("w+") as stream:
        about = os.fstat(stream.fileno())
        monkeypatch.setenv("JOURNAL_STREAM", f"{about.st_dev}:{about.st_ino}")
        log.configure(stream)
        logger = structlog.get_logger()
        logger.info("streaming", device="front", identity="LMS291;S05 V02.19", note="")
        try:
            raise RuntimeError("boom")
        except RuntimeError:
            logger.exception("a request failed")
        stream.seek(0)
        first, second = stream.read().splitlines()
    assert first == '<6>streaming device=front identity="LMS291;S05 V02.19" note=""'
    assert second.startswith('<3>a request failed exception="Traceback')
    assert "boom" in second


def test_a_stream_that_is_not_the_journals_gets_json_also_under_systemd(tmp_path, monkeypatch):
    monkeypatch.setenv("JOURNAL_STREAM", "1:2")
    with (tmp_path / "redirected").open("w+") as stream:
        log.configure(stream)
        structlog.get_logger().info("streaming")
        stream.seek(0)
        assert json.loads(stream.read())["event"] == "streaming"
