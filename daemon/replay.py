"""A capture to what its run gave, or would have given with another configuration."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from polecal.daemon import config as configuration
from polecal.daemon import recorder
from polecal.daemon.choices import Choice
from polecal.daemon.control import Refused
from polecal.daemon.pipeline import Pipeline
from polecal.daemon.recorder import Event, Record, RecorderError
from polecal.daemon.routine import RoutineError, State
from polecal.daemon.sessions import CALIBRATION, CAPTURED_IN, Session, SessionError, captures_of

BEGIN, FINISH, TICK, CHOICE = "begin", "finish", "tick", "choice"
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


def play(pipeline: Pipeline, item: Record | Event, *, as_told: bool = True) -> None:
    """Give a pipeline what it was given when this was recorded.

    ``as_told`` says that it has the configuration of then, so that its passes have the same numbers. Raises
    Refused where a pass that was dropped is not there.
    """
    if isinstance(item, Record):
        if item.direction == "rx":
            pipeline.feed(item.device, item.t_ns, item.data)
        return
    event = item.content.get("event")
    if event == BEGIN:
        told = item.content.get("past")
        pipeline.begin(item.t_ns, pipeline.past().as_told(told, same_passes=as_told) if told else None)
    elif event == FINISH:
        pipeline.finish(item.t_ns, item.content["why"])
    elif event == TICK:
        pipeline.tick(item.t_ns)
    elif event == CHOICE:
        pipeline.choose(item.t_ns, Choice.from_dict(item.content["choice"]))


def replay(
    capture: Path,
    config: Path | None,
    out: Path | None,
    progress: Callable[[float], None] | None,
) -> Outcome:
    """Play a session through the pipeline; ``out`` becomes a folder like a session's, without its capture.

    ``capture`` is its folder or its capture; a session that was gone on with is played from its first day
    on, and what was dropped after its end is dropped. ``config`` is a configuration file, else the capture's
    own is used; ``out`` is a folder beside the capture if None. ``progress`` is told the part done, 0 to 1. A
    capture that was cut off is used as far as it goes, and what there is then is calibrated.

    Raises RecorderError, ConfigError, SessionError.
    """
    sources = _days(capture)
    capture = sources[0].path
    recorded = sources[0].metadata
    settings = configuration.load(config) if config else configuration.loads(recorded["config"], str(capture))
    out = out or capture.parent / "replay"
    if out.resolve() == capture.parent.resolve():
        raise SessionError(
            f"{out}: is the session itself, whose passes and calibration would be lost",
            "name another folder to write to",
        )
    session = Session(out, recorded["created"])
    try:
        (out / "passes").mkdir(parents=True, exist_ok=True)
        for old in (*(out / "passes").glob("*.npz"), out / CALIBRATION):  # of an earlier replay
            old.unlink(missing_ok=True)
    except OSError as error:
        raise SessionError(
            f"{out}: cannot be made: {error.strerror}", "name another folder to write to"
        ) from error
    session.write_told(
        session.metadata(settings)
        | {"session": recorded["session"], CAPTURED_IN: str(capture.parent.resolve())}
    )
    pipeline = Pipeline(
        settings,
        session=recorded["session"],
        created=recorded["created"],
        folder=out,
        on_pass=session.write_pass,
    )
    player = _Player(pipeline, session, as_told=config is None)
    whole_bytes, done_bytes = sum(source.size_bytes for source in sources), 0
    for source in sources:
        for number, record in enumerate(source):
            player.play(record)
            if progress is not None and number % _PROGRESS_EVERY == 0:
                progress((done_bytes + source.used_bytes) / whole_bytes)
        done_bytes += source.size_bytes
    pipeline.finish(player.last_ns, "the capture ends here")
    player.choose_again(capture.parent / CALIBRATION, recorded["session"])
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
    notes = [source.cut for source in sources if source.cut is not None] + player.notes
    return Outcome(result, status, out, "; ".join(notes) or None, accepted)


class _Player:
    """Plays what was recorded to a pipeline, and keeps the session's folder in step with it."""

    def __init__(self, pipeline: Pipeline, session: Session, *, as_told: bool) -> None:
        self.last_ns = 0
        self.notes: list[str] = []
        self._pipeline, self._session, self._as_told = pipeline, session, as_told

    def play(self, item: Record | Event) -> None:
        """Do what was done when it was recorded."""
        self.last_ns = item.t_ns
        if isinstance(item, Record):
            play(self._pipeline, item)
            return
        try:
            play(self._pipeline, item, as_told=self._as_told)
        except Refused as error:
            self.notes.append(str(error))
        except (RoutineError, LookupError, TypeError, ValueError, AttributeError) as error:
            self.notes.append(f"an event in it makes no sense ({error!r}): {item.content}")
            return
        if item.content.get("event") == BEGIN and "past" in item.content:
            self._begun(item.content["past"])

    def choose_again(self, calibration: Path, session: str) -> None:
        """Repeat what was chosen after the end, when no capture was open any more. Raises SessionError."""
        try:
            content = yaml.safe_load(calibration.read_text(encoding="utf-8"))
            if content["lasers"][0]["session"] != session:
                return
            choices = [Choice.from_dict(each) for each in content.get("choices", [])]
        except FileNotFoundError:
            return
        except (OSError, ValueError, KeyError, TypeError, IndexError, yaml.YAMLError) as error:
            raise SessionError(
                f"{calibration}: what was dropped after the end cannot be read: {error}",
                "replay a copy of the capture alone, in another folder",
            ) from error
        for choice in choices:
            if choice.ended and choice not in self._pipeline.choices:
                try:
                    self._pipeline.choose(self.last_ns, choice)
                except Refused as error:
                    self.notes.append(str(error))

    def _begun(self, told: dict[str, Any]) -> None:
        """Say which passes of earlier days are lacking, and remove those that the run never knew."""
        there = {row["name"] for row in self._pipeline.passes()}
        lacking = sum(map(len, told["passes"].values())) - len(there)
        if self._as_told and lacking:
            self.notes.append(f"{lacking} passes of earlier days are not in it: name the session's folder")
        for path in (self._session.folder / "passes").glob("*.npz"):
            if path.stem not in there:  # of a run that was killed before it had written it
                path.unlink()


def _days(path: Path) -> list[recorder.Capture]:
    """Open a session's captures, day by day, of its folder or any of them. Raises RecorderError."""
    folder = path if path.is_dir() else path.parent
    paths = captures_of(folder)
    if path.is_dir() and not paths:
        raise RecorderError(f"{path}: there is no capture in it", "name a session's folder")
    if not path.is_dir() and path not in paths:
        paths = [path]
    named = recorder.read(path if not path.is_dir() else paths[0])
    lacking = ", ".join(key for key in ("session", "created", "config") if key not in named.metadata)
    if lacking:
        raise RecorderError(f"{named.path}: does not say its {lacking}", "name a session's capture.mcap")
    sources = [recorder.read(each) for each in paths]
    return [each for each in sources if each.metadata.get("session") == named.metadata["session"]]
