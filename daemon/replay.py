"""A capture to what its run gave, or would have given with another configuration."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from polecal.daemon import config as configuration
from polecal.daemon import recorder
from polecal.daemon.pipeline import Pipeline
from polecal.daemon.recorder import RecorderError
from polecal.daemon.routine import State
from polecal.daemon.sessions import CALIBRATION, Session, SessionError

BEGIN, FINISH, TICK = "begin", "finish", "tick"
"""Events that are inputs of the pipeline, and so part of a replay."""

_PROGRESS_EVERY = 500  # records


@dataclass(frozen=True, slots=True)
class Outcome:
    """What a replay came to; ``result`` is the content of calibration.yaml, None without a pass."""

    result: dict[str, Any] | None
    status: dict[str, Any]
    out: Path
    cut: str | None
    accepted: bool


def play(pipeline: Pipeline, item: recorder.Record | recorder.Event) -> None:
    """Give a pipeline what it was given when this was recorded."""
    if isinstance(item, recorder.Record):
        if item.direction == "rx":
            pipeline.feed(item.device, item.t_ns, item.data)
    elif item.content.get("event") == BEGIN:
        pipeline.begin(item.t_ns)
    elif item.content.get("event") == FINISH:
        pipeline.finish(item.t_ns, item.content["why"])
    elif item.content.get("event") == TICK:
        pipeline.tick(item.t_ns)


def replay(
    capture: Path,
    config: Path | None,
    out: Path | None,
    progress: Callable[[float], None] | None,
) -> Outcome:
    """Play a capture through the pipeline; calibration and passes go to ``out``.

    ``config`` is a configuration file, else the capture's own is used; ``out`` is a folder beside the
    capture if None. ``progress`` is told the part done, 0 to 1. A capture that was cut off is used as far
    as it goes, and what there is then is calibrated.

    Raises RecorderError, ConfigError, SessionError.
    """
    source = recorder.read(capture)
    recorded = source.metadata
    lacking = ", ".join(key for key in ("session", "created", "config") if key not in recorded)
    if lacking:
        raise RecorderError(f"{capture}: does not say its {lacking}", "name a session's capture.mcap")
    settings = configuration.load(config) if config else configuration.loads(recorded["config"], str(capture))
    out = out or capture.parent / "replay"
    session = Session(out, recorded["created"])
    try:
        (out / "passes").mkdir(parents=True, exist_ok=True)
        for old in (*(out / "passes").glob("*.npz"), out / CALIBRATION):  # of an earlier replay
            old.unlink(missing_ok=True)
    except OSError as error:
        raise SessionError(
            f"{out}: cannot be made: {error.strerror}", "name another folder to write to"
        ) from error
    pipeline = Pipeline(
        settings, session=recorded["session"], created=recorded["created"], on_pass=session.write_pass
    )
    last_ns = 0
    for number, record in enumerate(source):
        last_ns = record.t_ns
        play(pipeline, record)
        if progress is not None and number % _PROGRESS_EVERY == 0:
            progress(source.used_bytes / source.size_bytes)
    pipeline.finish(last_ns, "the capture ends here")
    result = pipeline.calibration()
    if result is not None:
        session.write_calibration(result)
    if progress is not None:
        progress(1.0)
    accepted = pipeline.routine.state is State.ACCEPTED
    kinds = {laser.name: "sick_lms" for laser in settings.lasers} | {configuration.SPAN: "novatel_span"}
    devices = [
        {"name": name, "kind": kind, "port": str(capture), "state": "replayed"} | pipeline.device(name)
        for name, kind in kinds.items()
    ]
    status = {"class": "STATUS", "session": recorded["session"], "devices": devices} | pipeline.status()
    return Outcome(result, status, out, source.cut, accepted)
