"""A session's folder, or a replay's, to its report: one HTML page that needs nothing else.

Drawing takes seconds of calculation, so the daemon has it done by a process of its own
(``python -m polecal.daemon.reporting FOLDER``). Whatever goes wrong there costs nothing but the page.
"""

from __future__ import annotations

import argparse
import fcntl
import importlib.util
import os
import subprocess
import sys
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from polecal import PolecalError, __version__
from polecal.calib import CalibrationError, Mount, Pass, Returns, estimate
from polecal.calib.estimate import Setup, split
from polecal.calib.route import Leg
from polecal.daemon import archive, recorder, results, route, sessions
from polecal.daemon import config as configuration
from polecal.daemon.config import SPAN, Config, Laser
from polecal.daemon.navigation import name_of
from polecal.daemon.recorder import Event, RecorderError
from polecal.daemon.routine import State
from polecal.daemon.sessions import CAPTURED_IN, SessionError, captures_of
from polecal.drivers.novatel_span import Framer, accuracy, nav_state, parse

if TYPE_CHECKING:  # matplotlib is an extra
    from polecal.calib.report.evidence import Seen
    from polecal.calib.report.page import LaserReport, Page

NAME = "report.html"

_EVERY_NS = 500_000_000  # of the navigation's many poses
_LONGEST_S = 500.0
_NEEDED = ("matplotlib", "jinja2")


class ReportError(PolecalError):
    """A report that cannot be made."""


def lacking() -> str:
    """Say which packages a report needs that are not here; empty if all are."""
    return " and ".join(name for name in _NEEDED if importlib.util.find_spec(name) is None)


def write(folder: Path, out: Path | None = None, png: Path | None = None) -> Path:
    """Write a folder's report, by default into it; its drawings as PNG into ``png``, if given.

    Gives the page's path. Raises ReportError, SessionError, ConfigError.
    """
    if lack := lacking():
        raise ReportError(
            f"a report needs {lack}, which is not installed",
            "install polecal with its extra: pip install 'polecal[report]'",
        )
    path = out or folder / NAME
    with _alone(folder):
        page = _page(folder)
        sessions.write_whole(path, page.html.encode())
    if png is not None:
        try:
            png.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise ReportError(f"{png}: cannot be made: {error.strerror}", "name another folder") from error
        for drawing in page.drawings:
            sessions.write_whole(png / f"{drawing.name}.png", drawing.png)
    return path


@contextmanager
def _alone(folder: Path) -> Iterator[None]:
    """Wait until nobody else writes the folder's report: at a run's end the daemon does, and one may ask."""
    try:
        held = os.open(folder, os.O_RDONLY)
    except OSError as error:
        raise SessionError(f"{folder}: {error.strerror}", "see `polecal-field sessions`") from error
    try:
        fcntl.flock(held, fcntl.LOCK_EX)
        yield
    finally:
        os.close(held)


def command(folder: Path) -> list[str]:
    """Give what a process of its own is run as, to write a folder's report."""
    return [sys.executable, "-m", __spec__.name, str(folder)]


def write_apart(folder: Path) -> Path:
    """Write a folder's report by a process of its own, however long that takes. Raises ReportError."""
    try:
        done = subprocess.run(  # noqa: S603
            command(folder), capture_output=True, check=False, timeout=_LONGEST_S
        )
    except subprocess.TimeoutExpired as error:
        raise ReportError(
            f"{folder}: its report took longer than {_LONGEST_S:.0f} s",
            f"write it without the daemon: `polecal-field report {folder}/`",
        ) from error
    if done.returncode:
        what, _, hint = done.stderr.decode(errors="replace").strip().rpartition("\nhint: ")
        raise ReportError((what or hint).rpartition("\n")[2], hint if what else "")
    return folder / NAME


@dataclass(slots=True)
class _Heard:
    """What the captures tell: navigation quality and the routine's states, over time."""

    t_ns: list[int] = field(default_factory=list)
    values: list[tuple[float, ...]] = field(default_factory=list)
    status: list[str] = field(default_factory=list)
    history: list[tuple[int, str, str]] = field(default_factory=list)
    first_ns: int | None = None


def _page(folder: Path) -> Page:
    from polecal.calib.report.figures import Quality  # noqa: PLC0415
    from polecal.calib.report.page import Report, render  # noqa: PLC0415

    meta, home = _metadata(folder)
    config = configuration.loads(meta["config"], str(folder / "session.yaml"))
    content = sessions.read_calibration(folder) or {}
    notes: list[str] = []
    heard = _listen(home, notes)
    lasers, passes_ns = [], []
    for laser in config.lasers:
        told, seen = _laser(folder, config, laser, content, notes)
        lasers.append(told)
        passes_ns += [one.t_ns for one in seen]
    ended = [one for one in heard.history if one[1] in ("accepted", "rejected", "idle", "fault")]
    state = content.get("state") or (ended[-1][1] if ended else "not finished")
    first_ns = heard.first_ns or 0
    quality = None
    if heard.t_ns:
        position_m, height_m, roll_pitch_deg, azimuth_deg = np.array(heard.values).T
        quality = Quality(
            t_s=(np.array(heard.t_ns) - first_ns) / 1e9,
            position_m=position_m,
            height_m=height_m,
            roll_pitch_deg=roll_pitch_deg,
            azimuth_deg=azimuth_deg,
            status=tuple(heard.status),
            passes_s=tuple(sorted({((a - first_ns) / 1e9, (b - first_ns) / 1e9) for a, b in passes_ns})),
        )
    why = [reason for _, entered, reason in heard.history if entered in ("calibrating", "fault")]
    report = Report(
        title=f"Calibration of {', '.join(laser.name for laser in config.lasers)}, session {meta['session']}",
        state=state,
        why=why[-1] if why else "",
        lasers=lasers,
        quality=quality,
        facts=_facts(meta, folder, content),
        notes=notes,
        history=[((t_ns - first_ns) / 1e9, entered, reason) for t_ns, entered, reason in heard.history],
        configuration=meta["config"],
        route=() if state == State.ACCEPTED else _still_to_drive(folder),
    )
    return render(report)


def _still_to_drive(folder: Path) -> Sequence[Leg]:
    """Lay the route that a session still needs; none where that is not known, nor of a replay."""
    if not sessions.captures_of(folder):
        return ()
    try:
        config = archive.told(folder)[1]
        return route.to_draw(config, archive.reopen(folder)[1].stand())
    except PolecalError:  # the report says elsewhere what cannot be read
        return ()


def _metadata(folder: Path) -> tuple[dict[str, str], Path]:
    """Find what a session was told, and the folder of its captures: of a replay, the one it was made from."""
    path = folder / "session.yaml"
    if not path.exists():
        raise SessionError(
            f"{folder}: is no session's folder", "name one with a session.yaml in it, or replay its capture"
        )
    told = sessions.read_yaml(path)
    if {"session", "config"} <= told.keys():
        return told, Path(told.get(CAPTURED_IN, folder))
    raise SessionError(f"{path}: does not say how the session was made", sessions.REPLAY)


def _facts(meta: Mapping[str, str], folder: Path, content: Mapping[str, Any]) -> list[tuple[str, str]]:
    facts = [
        ("session", meta["session"]),
        ("created", meta.get("created", "unknown")),
        ("folder", str(folder.resolve())),
        ("recorded by", f"polecal {meta.get('polecal', 'of unknown version')}"),
        ("report by", f"polecal {__version__}"),
    ]
    points = {str(laser.get("reference_point") or "") for laser in content.get("lasers", [])} - {""}
    return [*facts, *(("the body's origin is", point) for point in sorted(points))]


def _listen(home: Path, notes: list[str]) -> _Heard:
    """Read what the receiver told of itself from the captures in a folder."""
    heard = _Heard()
    captures = captures_of(home)
    if not captures:
        notes.append("There is no capture in the session's folder: nothing is told of the navigation.")
    for path in captures:
        framer = Framer()
        sigma: tuple[float, ...] = (np.nan,) * 4
        try:
            for item in recorder.read(path):
                if heard.first_ns is None:
                    heard.first_ns = item.t_ns
                if isinstance(item, Event):
                    if item.content.get("event") == "state":
                        heard.history.append((item.t_ns, item.content["new"], item.content.get("why", "")))
                elif item.device == SPAN and item.direction == "rx":
                    sigma = _hear(framer, item.t_ns, item.data, sigma, heard)
        except RecorderError as error:
            notes.append(f"The capture could not be read: {error}")
    return heard


def _hear(
    framer: Framer, t_ns: int, data: bytes, sigma: tuple[float, ...], heard: _Heard
) -> tuple[float, ...]:
    for frame in framer.feed(data, t_ns):
        if not frame.kind.checked or frame.is_response:
            continue
        due = not heard.t_ns or t_ns - heard.t_ns[-1] >= _EVERY_NS
        pose = nav_state(frame) if due else None
        if (pose is None or pose.log.startswith("INSPVAX")) and (told := accuracy(parse(frame))) is not None:
            sigma = (
                max(told.position_m[:2]),
                told.position_m[2],
                max(told.attitude_deg[:2]),
                told.attitude_deg[2],
            )
        if pose is not None:
            heard.t_ns.append(t_ns)
            heard.values.append(sigma)
            heard.status.append(str(name_of(pose.ins_status)))
    return sigma


def _laser(
    folder: Path, config: Config, laser: Laser, content: Mapping[str, Any], notes: list[str]
) -> tuple[LaserReport, list[Seen]]:
    from polecal.calib.report.evidence import gather  # noqa: PLC0415
    from polecal.calib.report.page import LaserReport  # noqa: PLC0415

    setup = results.setup_of(config, laser)
    seen = _passes(folder, laser.name, setup, content, notes)
    entry = _entry(content, laser.name) or _anew(laser.name, setup, seen, notes)
    evidence = None
    if entry["estimate"] is not None and any(not one.why_not for one in seen):
        extras = {name: one["value"] for name, one in entry.get("extras", {}).items()}
        evidence = gather(seen, setup, Mount(**entry["estimate"]), entry["held"], extras)
    held_why = {
        name: "the configuration asks for it (hold)"
        if name in laser.hold
        else "the drive tells it no better than the hand measurement does"
        for name in entry["held"]
    }
    told = {"extras": {}, "measured": setup.measured.as_dict()} | dict(entry)
    return LaserReport(laser.name, setup, told, evidence, held_why, _to_know_more(setup, entry)), seen


def _entry(content: Mapping[str, Any], laser: str) -> dict[str, Any]:
    """Give a laser's part of ``calibration.yaml``, empty where there is none."""
    return next((one for one in content.get("lasers", []) if one["name"] == laser), {})


def _to_know_more(setup: Setup, entry: Mapping[str, Any]) -> str:
    if "covariance" not in entry:
        return ""
    worst = results.weakest(setup, np.array(entry["covariance"]))
    return f"what is known worst is {worst.name}; {worst.drive}"


def _anew(name: str, setup: Setup, seen: Sequence[Seen], notes: list[str]) -> dict[str, Any]:
    """Calibrate for the report alone, where the run did not: never as accepted."""
    used = [
        Pass.of(one.id, split(one.returns, setup.need.slice_deg), one.site) for one in seen if not one.why_not
    ]
    try:
        result = estimate(used, setup, everywhere=True) if used else None
    except CalibrationError as error:
        notes.append(f"{name}: {error}")
        result = None
    if result is None:
        return results.entry(name, setup, None)
    notes.append(f"{name}: the run ended without a calibration; these numbers were made for this report.")
    made = results.calibration(name, setup, result, "", "")
    reasons = ["the run ended without a calibration", *made["verdict"]["reasons"]]
    return made | {"verdict": {"accepted": False, "reasons": reasons}}


def _passes(
    folder: Path,
    laser: str,
    setup: Setup,
    content: Mapping[str, Any],
    notes: list[str],
) -> list[Seen]:
    """Read a laser's stored passes, and say of each why it was not used, if it was not."""
    from polecal.calib.report.evidence import Seen  # noqa: PLC0415

    stored = []
    for path in sorted(
        (folder / "passes").glob(f"{laser}-*.npz"), key=lambda each: (len(each.name), each.name)
    ):
        of, _, number = path.stem.rpartition("-")
        if of != laser or not number.isdigit():
            continue
        try:
            with path.open("rb") as stream, np.load(stream, allow_pickle=False) as file:
                names = [part.name for part in fields(Returns) if part.name in file]
                returns = Returns(**{name: file[name] for name in names})
                first_ns, last_ns = file["t_ns"].tolist()
                site = int(file["site"]) if "site" in file else 0
                stored.append((int(number), (first_ns, last_ns), returns, (site, int(file["place"]))))
        except Exception as error:  # zip, numpy and zlib each have their own
            notes.append(f"{path.name} could not be read, and is left out: {error}")
    dropped: dict[int, str] = {}
    for choice in content.get("choices", []):
        if choice["laser"] == laser:
            dropped.pop(choice["number"], None)
            if choice["drop"]:
                dropped[choice["number"]] = f"dropped by {choice.get('by', 'the operator')}"
    entry = _entry(content, laser)
    aside = {one["pass"]: one["why"] for one in entry.get("set_aside", [])}
    pole = _pole_of([(where, returns) for _, _, returns, where in stored], setup, entry)
    return [
        Seen(
            number,
            t_ns,
            returns,
            where[0],
            dropped.get(number) or aside.get(number) or ("" if where in pole else "another reflector"),
        )
        for number, t_ns, returns, where in stored
    ]


def _pole_of(
    stored: Sequence[tuple[tuple[int, int], Returns]], setup: Setup, entry: Mapping[str, Any]
) -> set[tuple[int, int]]:
    """Say which reflector, of each site, is the pole: as was written, else the one seen most evenly."""
    if "reflectors" in entry:
        return {(one["site"], one["place"]) for one in entry["reflectors"]}
    counts: dict[tuple[int, int], Counter[int]] = {}
    for where, returns in stored:
        one = Pass.of(0, split(returns[returns.kind == 0], setup.need.slice_deg))
        counts.setdefault(where, Counter()).update(one.pole_returns)
    enough = setup.need.min_pole_returns
    best = {
        site: max(
            (where for where in counts if where[0] == site),
            key=lambda where: sum(min(count, enough) for count in counts[where].values()),
        )
        for site in {where[0] for where in counts}
    }
    return set(best.values())


def main(argv: Sequence[str] | None = None) -> int:
    """Write a folder's report; on standard error is what stood in its way."""
    parser = argparse.ArgumentParser(prog="polecal.daemon.reporting", description=__doc__)
    parser.add_argument("folder", type=Path)
    arguments = parser.parse_args(argv)
    os.nice(10)
    try:
        write(arguments.folder)
    except PolecalError as error:
        sys.stderr.write(f"{error}\nhint: {error.hint}\n")
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
