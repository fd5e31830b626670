"""A session's folder to what its runs left, and to a pipeline that stands where the last of them ended."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Mapping
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from polecal.calib import Kind, Pass, Returns
from polecal.calib.moments import Moments, of_sums
from polecal.daemon import config as configuration
from polecal.daemon import facts, recorder
from polecal.daemon.choices import Choice
from polecal.daemon.config import Config
from polecal.daemon.control import Code, Refused
from polecal.daemon.facts import Facts
from polecal.daemon.passes import Kept, most_of_one
from polecal.daemon.past import Past
from polecal.daemon.pipeline import Pipeline
from polecal.daemon.quality import Quality
from polecal.daemon.recorder import Event, RecorderError
from polecal.daemon.replay import BEGIN, CHOICE
from polecal.daemon.routine import State
from polecal.daemon.sessions import (
    DAMAGE,
    FACTS,
    QUALITY,
    REPLAY,
    Session,
    SessionError,
    captures_of,
    folders,
    read_calibration,
    read_yaml,
)
from polecal.daemon.spill import Spill

_OF_THE_PLACE = ("state_dir", "runtime_dir", "storage", "page", "port")
"""Keys of the configuration that may change from day to day."""


def find(state_dir: Path, name: object) -> Path:
    """Give a session's folder. Raises Refused."""
    for folder in folders(state_dir):
        if folder.name == name:
            return folder
    raise Refused(f"there is no session {name}", "see `polecal-field sessions`", Code.USAGE)


def reopen(folder: Path) -> tuple[Session, Pipeline]:
    """Give a session that is over, and a pipeline that stands where it ended. Raises SessionError."""
    metadata, config = told(folder)
    session = Session(folder, metadata["created"], len(captures_of(folder)))
    pipeline = Pipeline(config, session=session.id, created=session.created, folder=folder)
    pipeline.reopen(past_of(folder), time.monotonic_ns())
    return session, pipeline


def choose(folder: Path, said: object, *, drop: bool, by: str, at: str) -> dict[str, Any]:
    """Drop or keep a pass of a session that is over, and write its calibration anew; give what changed.

    Raises Refused, and SessionError where it cannot be read or written: nothing has changed then.
    """
    session, pipeline = reopen(folder)
    choice = replace(pipeline.choice(said, drop=drop, by=by, at=at), ended=True)
    change = pipeline.choose(time.monotonic_ns(), choice)
    result = pipeline.calibration()
    if result is not None:
        session.write_calibration(result)
    return change


def resume(folder: Path, config: Config) -> tuple[Session, Past]:
    """Give the next day of a session, and what it starts from.

    Raises SessionError, and Refused where the configuration is not the session's: its passes would be
    judged by another one than they were made with; or where there may be no more of them.
    """
    metadata, before = told(folder)
    differ = list(_differences(before.model_dump(), config.model_dump()))
    if differ:
        raise Refused(
            f"session {folder.name} was made with another configuration: {', '.join(differ)}",
            f"start polecald with the one in {folder / 'session.yaml'}, or begin a new session",
            Code.CONFIG,
        )
    past = past_of(folder)
    most = config.routine.max_passes
    if full := [name for name, passes in past.passes.items() if most_of_one(passes) >= most]:
        raise Refused(
            f"session {folder.name} has all of the {most} passes of {' and '.join(full)} that it may have",
            "begin a new session; the verdict of this one says what to mend first",
            Code.USAGE,
        )
    return Session(folder, metadata["created"], past.site + 1), past


def past_of(folder: Path) -> Past:
    """Read what a session's runs left. Raises SessionError."""
    captures = captures_of(folder)
    if not captures:
        raise SessionError(f"{folder}: has no capture", "bring its capture.mcap back")
    passes: dict[str, list[Kept]] = {}
    spill = Spill(folder)
    for path in sorted((folder / "passes").glob("*.npz"), key=lambda each: (len(each.name), each.name)):
        passes.setdefault(path.stem.rpartition("-")[0], []).append(read_pass(path).spilled(spill))
    every = {name: sorted({one.where for one in kept}) for name, kept in passes.items()}
    content = read_calibration(folder)
    if content is not None and content.get("captures", 1) == len(captures):
        poles = {
            laser["name"]: [(each["site"], each["place"]) for each in laser["reflectors"]]
            for laser in content["lasers"]
            if "reflectors" in laser
        }
        return Past(
            site=len(captures),
            passes=passes,
            poles=every | poles,
            choices=tuple(Choice.from_dict(each) for each in content.get("choices", [])),
            ended=State(content["state"]),
            reference_point=content["lasers"][0].get("reference_point"),
            origin=_origin(content),
        )
    choices, earlier_poles = _recorded(captures[-1])
    site = len(captures) - 1
    poles = {
        name: sorted({*earlier_poles.get(name, []), *(where for where in each if where[0] == site)})
        for name, each in every.items()
    }
    return Past(site=len(captures), passes=passes, poles=poles, choices=choices)


def read_pass(path: Path) -> Kept:
    """Read a pass's file, also of a version that wrote less into it. Raises SessionError."""
    try:
        with path.open("rb") as stream, np.load(stream, allow_pickle=False) as file:
            keys = [(int(part), Kind(int(kind))) for part, kind in file["block_slice_kind"]]
            blocks = dict(zip(keys, _blocks(file), strict=True))
            site = int(file["site"]) if "site" in file else 0
            gps_ns = file["gps_ns"]
            if "direction" in file:
                known = {name: file[name].item() for name in FACTS}
                about = Facts(gps_ns=(int(gps_ns.min()), int(gps_ns.max())), **known)
                quality = Quality(**{name: _told_value(file[name].item()) for name in QUALITY})
            else:
                names = [part.name for part in fields(Returns) if part.name in file]
                about = facts.of(Returns(**{name: file[name] for name in names}), gps_ns)
                quality = Quality()
            first_ns, last_ns = file["t_ns"].tolist()
            number = int(path.stem.rpartition("-")[2])
            return Kept(
                int(file["place"]), (first_ns, last_ns), Pass.of(number, blocks, site), about, quality
            )
    except DAMAGE as error:
        raise SessionError(f"{path}: cannot be read: {error}", REPLAY) from error


def _blocks(file: Mapping[str, NDArray[Any]]) -> list[Moments]:
    """Read blocks of sums."""
    counts, firsts = file["block_count"].tolist(), file["block_first"]
    if "block_packed" not in file:  # as polecal wrote before 2026-11: all features, whole matrices
        every = np.arange(firsts.shape[1])
        return [
            of_sums(*each)
            for each in zip(counts, [every] * len(counts), firsts, file["block_second"], strict=True)
        ]
    features = [np.flatnonzero(has) for has in file["block_features"]]
    ends = np.cumsum([len(has) * (len(has) + 1) // 2 for has in features])
    packed = np.split(file["block_packed"], ends[:-1])
    return [
        Moments(count, has, first[has], sums)
        for count, has, first, sums in zip(counts, features, firsts, packed, strict=True)
    ]


def _origin(content: dict[str, Any]) -> tuple[float, float, float] | None:
    origin = content.get("origin")
    return None if origin is None else (origin["lat_deg"], origin["lon_deg"], origin["height_m"])


def _told_value(value: Any) -> Any:
    return None if isinstance(value, float) and math.isnan(value) else value


def told(folder: Path) -> tuple[dict[str, Any], Config]:
    """Read what a session was told at its start, and its configuration. Raises SessionError, ConfigError."""
    path = folder / "session.yaml"
    metadata = read_yaml(path)
    if not {"created", "config"} <= metadata.keys():
        raise SessionError(f"{path}: does not say how the session was made", REPLAY)
    return metadata, configuration.loads(metadata["config"], str(path))


def _recorded(capture: Path) -> tuple[tuple[Choice, ...], dict[str, list[tuple[int, int]]]]:
    """Find the choices, and the earlier days' reflectors, of a run that left them in its capture alone."""
    choices: list[Choice] = []
    poles: dict[str, list[tuple[int, int]]] = {}
    try:
        for item in recorder.read(capture):
            if not isinstance(item, Event):
                continue
            if item.content.get("event") == BEGIN and (past := item.content.get("past")):
                choices = [Choice.from_dict(each) for each in past["choices"]]
                poles = {
                    name: [(site, place) for site, place in each] for name, each in past["poles"].items()
                }
            elif item.content.get("event") == CHOICE:
                choices.append(Choice.from_dict(item.content["choice"]))
    except RecorderError as error:
        raise SessionError(str(error), error.hint) from error
    return tuple(choices), poles


def _differences(before: Any, now: Any, path: str = "") -> Iterator[str]:
    """Give the keys in which two configurations differ that passes depend on."""
    if isinstance(before, dict) and isinstance(now, dict):
        for key in before.keys() | now.keys():
            if key not in _OF_THE_PLACE:
                yield from _differences(before.get(key), now.get(key), f"{path}.{key}".lstrip("."))
    elif isinstance(before, list | tuple) and isinstance(now, list | tuple) and len(before) == len(now):
        for number, (one, other) in enumerate(zip(before, now, strict=True)):
            yield from _differences(one, other, f"{path}[{number}]")
    elif before != now:
        yield path
