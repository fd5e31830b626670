"""The operator's command, ``polecal-field``: each verb to the daemon, or to a file, and back in words."""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import re
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from enum import Enum
from io import BufferedReader
from pathlib import Path
from typing import Any, NoReturn, cast

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn
from rich.text import Text

from polecal import PolecalError, __version__
from polecal.daemon import control, tables
from polecal.daemon.control import Client, Code, Refused
from polecal.daemon.routine import State
from polecal.daemon.screen import Screen
from polecal.daemon.watch import Terminal, Watch

# The verbs that calculate or decode import what they need themselves: numpy takes longer than a status.

_SOCKET = "/run/polecal/control.sock"
_CONFIG = "/etc/polecal/polecal.yaml"
_STATUS_S = 1.0
_ANSWER_S = 10.0
_LIST_S = 30.0  # a session of many passes may have to be calibrated again
_START_S = 300.0  # a device search tries every rate, twice, and may write an EEPROM
_REPORT_S = 600.0  # hours of driving to read through, at a low priority
_STOP_S = 120.0  # the devices are left polite, and what there is may be calibrated
_POLL_S = 0.5
_SEE_STATUS = "see `polecal-field status`"
_DECODE_BYTES = 4096
COMPLETED = ("bash", "zsh", "fish", "sessions", "passes")
_FORMATS = ("yaml", "json", "urdf", "ros2", "autoware", "snark", "libbot")
_ROUTES = ("geojson", "gpx", "csv")
_EXIT_BY_STATE = {State.ACCEPTED: 0, State.REJECTED: Code.REJECTED, State.FAULT: Code.DEVICE}
_WORKING = (State.CONNECTING, State.ALIGNING, State.COLLECTING)


def main(argv: list[str] | None = None) -> int:
    """Run ``polecal-field``; give its exit code."""
    argv = sys.argv[1:] if argv is None else argv
    try:
        arguments = make_parser().parse_args(argv)
        code = int(arguments.run(arguments))
        sys.stdout.flush()
        return code
    except PolecalError as error:
        if "--json" in argv:
            _print_json(control.as_message(error))
        _complain(str(error), error.hint)
        return control.code_of(error)
    except BrokenPipeError:  # whoever read has enough
        _forget_output()
        return 0
    except OSError as error:  # whatever it is, the operator needs no traceback of it
        try:
            sys.stdout.flush()
        except OSError:
            _forget_output()
        where = f"{error.filename}: " if error.filename else ""
        _complain(
            f"{where}{error.strerror or error}", "see whether there is room, and who may read and write"
        )
        return Code.DEGRADED
    except KeyboardInterrupt:
        return 130


def _forget_output() -> None:
    """Let what Python flushes at its exit go nowhere, as it would fail again."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        raise Refused(message, f"see `{self.prog} --help`", Code.USAGE)


def _common() -> _Parser:
    """Make the options that may stand before the verb and after it."""
    common = _Parser(add_help=False, argument_default=argparse.SUPPRESS)
    common.add_argument("--socket", type=Path, metavar="PATH", help=f"the daemon's, else {_SOCKET}")
    common.add_argument("--json", action="store_true", help="print what the daemon says, as it is")
    return common


def make_parser() -> argparse.ArgumentParser:
    """Make the parser of ``polecal-field``, which its manual and completion are made of, too."""
    about = "Calibrate the pose of a vehicle's laser in the field."
    parser = _Parser(prog="polecal-field", description=about, parents=[_common()])
    parser.set_defaults(socket=Path(os.environ.get("POLECAL_SOCKET") or _SOCKET), json=False)
    parser.add_argument("--version", action="version", version=__version__, help="print its version")
    verbs = parser.add_subparsers(title="verbs", required=True, metavar="VERB")

    def verb(run: Callable[[argparse.Namespace], int], about: str) -> _Parser:
        name = run.__name__.strip("_")
        made = verbs.add_parser(
            name, parents=[_common()], help=about, description=about[:1].upper() + about[1:] + "."
        )
        made.set_defaults(run=run)
        return made

    start = verb(_start, "begin a session; returns once every device streams")
    start.add_argument("--name", metavar="NAME", help="goes into the session's name")
    start.add_argument("--continue", dest="session", metavar="SESSION", help="go on with it, on another day")
    start.add_argument("--force", action="store_true", help="also where a session is running, which ends")
    status = verb(_status, "show how it stands and what to drive next")
    status.add_argument("--watch", action="store_true", help="go on showing it, until Ctrl-C")
    wait = verb(_wait, "wait until the calibration is accepted or rejected")
    wait.add_argument("--for", dest="state", choices=[str(state) for state in State], help="until this state")
    wait.add_argument("--timeout", type=float, metavar="S", help="give up after so many seconds")
    stop = verb(_stop, "end the session")
    stop.add_argument("--calibrate", action="store_true", help="calibrate with what there is")
    result = verb(_result, "print a calibration, by default the last accepted one")
    result.add_argument("session", nargs="?", metavar="SESSION", help="its name, or a folder's path")
    result.add_argument("--format", choices=_FORMATS, default="yaml", help="for which system")
    result.add_argument("--parent", metavar="FRAME", help="the body's frame, else as that system calls it")
    report = verb(_report, "write a session's report, an HTML page, and name it")
    report.add_argument("session", nargs="?", metavar="SESSION", help="its name, or a folder's path")
    report.add_argument("--out", type=Path, metavar="FILE", help="elsewhere than into the session's folder")
    report.add_argument("--png", type=Path, metavar="DIR", help="the drawings, too, as PNG")
    passes = verb(_passes, "list a session's passes, by default the present or last one's")
    passes.add_argument("session", nargs="?", metavar="SESSION", help="its name")
    for done in (_drop, _keep):
        about = "leave a pass out" if done is _drop else "take a pass back"
        chosen = verb(done, f"{about}, calibrate again, and show what changed")
        chosen.add_argument("name", metavar="PASS", help="like 7, or like front-007")
        chosen.add_argument("--session", metavar="SESSION", help="by default the present or last one")
    verb(_sessions, "list the sessions")
    routed = verb(_route, "print the drive that fills what is missing, around the pole")
    routed._negative_number_matcher = re.compile(r"-\.?\d")  # -33.9,151.2 is a place and no option
    routed.add_argument("session", nargs="?", metavar="SESSION", help="by default the present or last one")
    routed.add_argument("--format", choices=_ROUTES, help="for which program; else in words")
    routed.add_argument("--out", type=Path, metavar="FILE", help="into it; its ending says which format")
    place = "where the pole is, degrees; until it was seen"
    routed.add_argument("--pole", type=_numbers, metavar="LAT,LON", help=place)
    lengths = {
        "--half-width": ("half_width_m", "half of the vehicle's width, else 0.6"),
        "--radius": ("turn_radius_m", "of its turns, else 5"),
        "--area": ("area_m", "how far from the pole it may go, else 20"),
    }
    for option, (name, about) in lengths.items():
        routed.add_argument(option, dest=name, type=float, metavar="M", help=about)
    speeds = "fast and slow, m/s, else 3,1.5"
    routed.add_argument("--speeds", dest="speeds_mps", type=_numbers, metavar="V,V", help=speeds)
    replay = verb(_replay, "run a capture through the whole pipeline again, without a daemon")
    replay.add_argument("capture", type=Path, metavar="CAPTURE", help="its file, or its session's folder")
    replay.add_argument("--config", type=Path, metavar="FILE", help="instead of the capture's own")
    replay.add_argument("--out", type=Path, metavar="DIR", help="where calibration and passes go")
    imported = verb(_import, "make a capture of raw serial dumps, for replay")
    arrivals, rate = "byte_offset,host_time_s of its dump", "bytes/s without arrivals, else its line's rate"
    lms: dict[str, Any] = {"action": "append", "default": []}
    imported.add_argument(
        "--lms",
        **lms | {"required": True},
        metavar="[NAME=]FILE",
        help="what a laser said; once for each of the configuration, NAME= only if there are several",
    )
    imported.add_argument("--lms-arrivals", **lms, metavar="[NAME=]CSV", help=arrivals)
    imported.add_argument("--lms-rate", **lms, metavar="[NAME=]B", help=rate)
    imported.add_argument("--span", type=Path, required=True, metavar="FILE", help="what the receiver said")
    imported.add_argument("--span-arrivals", type=Path, metavar="CSV", help=arrivals)
    imported.add_argument("--span-rate", type=float, metavar="B", help=rate)
    imported.add_argument("--config", type=Path, required=True, metavar="FILE", help="what it replays with")
    imported.add_argument("--out", type=Path, required=True, metavar="CAPTURE", help="the capture to make")
    export = verb(_export, "write a capture's bytes as raw serial dumps, a file a device")
    export.add_argument("capture", type=Path, metavar="CAPTURE", help="its file, or its session's folder")
    export.add_argument("--out", type=Path, required=True, metavar="DIR", help="where the dumps go")
    doctor = verb(_doctor, "look for what is wrong with ports, devices, disk and clock")
    doctor.add_argument("--config", type=Path, metavar="FILE", help=f"else $POLECAL_CONFIG, else {_CONFIG}")
    decode = verb(_decode, "print a raw byte file as JSON lines, one a frame")
    decode.add_argument("file", metavar="FILE", help="- for standard input")
    decode.add_argument(
        "--as", dest="kind", choices=["sick_lms", "novatel_span"], required=True, help="whose bytes"
    )
    emulate = verb(_emulate, "run an emulated laser and receiver on pseudo-terminals")
    emulate.add_argument("--lms-link", metavar="PATH", help="name the laser's terminal so")
    emulate.add_argument("--span-link", metavar="PATH", help="name the receiver's terminal so")
    emulate.add_argument("--seed", type=int, default=1, metavar="N", help="which drive in which world")
    emulate.add_argument("--seconds", type=float, metavar="S", help="end after so long")
    steered = "the vehicle drives the routes that come on standard input, each a line of GeoJSON"
    emulate.add_argument("--route", action="store_true", help=steered)
    demo = verb(_demo, "calibrate emulated devices with a real daemon; found against true")
    demo.add_argument("--out", type=Path, metavar="DIR", help="where all of it goes")
    demo.add_argument("--seed", type=int, default=1, metavar="N", help="which drive in which world")
    demo.add_argument("--route", action="store_true", help="with a vehicle that drives what `route` says")
    completion = verb(_completion, "print what makes a shell complete this command's arguments")
    completion.add_argument("shell", choices=COMPLETED, help="or of what to print the names")
    return parser


def _start(arguments: argparse.Namespace) -> int:
    request = {"class": "START", "name": arguments.name, "force": arguments.force}
    if arguments.session is not None:
        request["continue"] = arguments.session
    answers: list[dict[str, Any] | PolecalError] = []

    def ask() -> None:
        try:
            answers.append(client.request(request))
        except PolecalError as error:
            answers.append(error)

    with Client(arguments.socket, _START_S) as client, Client(arguments.socket, _STATUS_S) as looking:
        asking = threading.Thread(target=ask, daemon=True)  # so that Ctrl-C need not wait for it
        asking.start()
        said: dict[str, str] = {}
        while asking.is_alive():
            asking.join(_POLL_S)
            if asking.is_alive():
                _say_waiting(looking, said)
    answer = answers[0]
    if isinstance(answer, PolecalError):
        raise answer
    if arguments.json:
        _print_json(answer)
        return 0
    print(f"session {answer.get('session')} has started")
    for device in answer.get("devices") or []:
        about = " on ".join(str(device[key]) for key in ("identity", "port") if device.get(key))
        print(f"  {device.get('name')}: {device.get('state')}, {about}")
    return 0


def _say_waiting(client: Client, said: dict[str, str]) -> None:
    """Tell on stderr what each device is doing, if it is something new."""
    with contextlib.suppress(Refused):
        for device in client.request({"class": "STATUS"}).get("devices") or []:
            name, state = device.get("name"), device.get("state")
            told = device.get("problem") or f"{state} on {device.get('port')}"
            if said.get(name) != told and state != "closed":
                said[name] = told
                print(f"  {name}: {told} ...", file=sys.stderr)


def _status(arguments: argparse.Namespace) -> int:
    if arguments.watch:
        return _watch(arguments)
    deadline_s = time.monotonic() + _STATUS_S
    with Client(arguments.socket, _STATUS_S) as client:
        client.patience(max(0.01, deadline_s - time.monotonic()))
        status = client.request({"class": "STATUS"})
    _show(status, arguments)
    return _health(status)


def _watch(arguments: argparse.Namespace) -> int:
    terminal = Terminal.of(sys.stdout)
    redrawn = terminal.redraws and not arguments.json
    status: dict[str, Any] = {}
    shown = Watch(terminal, sys.stdout) if redrawn else contextlib.nullcontext()
    with (
        Client(arguments.socket, _ANSWER_S) as client,
        contextlib.suppress(KeyboardInterrupt),
        shown as watch,
    ):
        for status in client.watch():
            if watch is not None:
                watch.show(status)
            else:
                _show(status, arguments)
                sys.stdout.flush()
    if redrawn:  # the other screen is gone: leave the last state on this one
        _show(status, arguments)
    return _health(status)


def _health(status: dict[str, Any]) -> int:
    """Give 1 for a fault, or for a device that should stream and does not."""
    devices = status.get("devices") or []
    silent = any(device.get("state") != "streaming" for device in devices)
    state = status.get("state")
    return Code.DEGRADED if state == State.FAULT or (state in _WORKING and silent) else 0


def _wait(arguments: argparse.Namespace) -> int:
    deadline_s = time.monotonic() + (float("inf") if arguments.timeout is None else arguments.timeout)
    wanted = arguments.state
    last = None
    with Client(arguments.socket, _ANSWER_S) as client:
        while True:
            status = client.request({"class": "STATUS"})
            state = status.get("state")
            if last not in (None, state) and not arguments.json:
                print(f"  {state}", file=sys.stderr)
            last = state
            if state == wanted or (wanted is None and state in _EXIT_BY_STATE):
                _show(status, arguments)
                return 0 if wanted else _EXIT_BY_STATE[state]
            if state in _EXIT_BY_STATE:
                code = _EXIT_BY_STATE[state] or Code.DEGRADED
                raise Refused(f"it ended {state}, and will not be {wanted}", _SEE_STATUS, code)
            if state == State.IDLE and wanted is None:
                raise Refused("no session is running", "start one by `polecal-field start`", Code.USAGE)
            left_s = deadline_s - time.monotonic()
            if left_s <= 0:
                raise Refused(f"still {state} after {arguments.timeout:g} s", _SEE_STATUS)
            time.sleep(min(_POLL_S, left_s))


def _stop(arguments: argparse.Namespace) -> int:
    with Client(arguments.socket, _STOP_S) as client:
        answer = client.request({"class": "STOP", "calibrate": arguments.calibrate})
    if arguments.json:
        _print_json(answer)
    else:
        print(f"session {answer.get('session')} has ended: {answer.get('state')}")
    for note in answer.get("notes", []):
        _complain(note, _SEE_STATUS)
    state, done = answer.get("state"), Code.DEGRADED if answer.get("notes") else 0
    return (_EXIT_BY_STATE[state] if arguments.calibrate and state in _EXIT_BY_STATE else 0) or done


def _result(arguments: argparse.Namespace) -> int:
    if arguments.session and os.sep in arguments.session:
        from polecal.daemon.sessions import CALIBRATION, SessionError, read_calibration  # noqa: PLC0415

        if (found := read_calibration(Path(arguments.session))) is None:
            raise SessionError(
                f"{arguments.session}: has no {CALIBRATION}", "name a session's or a replay's folder with one"
            )
        answer = {"class": "RESULT"} | found
    else:
        with Client(arguments.socket, _ANSWER_S) as client:
            answer = client.request({"class": "RESULT", "session": arguments.session})
    content = {key: value for key, value in answer.items() if key != "class"}
    verdicts = [laser["verdict"]["accepted"] for laser in content["lasers"]]
    accepted = content.get("state") == State.ACCEPTED and all(verdicts)
    if arguments.json:
        _print_json(answer)
    elif accepted and arguments.format == "json":
        print(json.dumps(content, indent=2, ensure_ascii=False, allow_nan=False))
    elif accepted and arguments.format == "yaml":
        import yaml  # noqa: PLC0415

        print(yaml.safe_dump(content, sort_keys=False, allow_unicode=True), end="")
    else:
        from polecal.calib.export import export  # noqa: PLC0415

        print(export(content, arguments.format, arguments.parent), end="")
    if not accepted:
        _complain("this calibration was rejected", "see the reasons in its verdict; do not use it")
        return Code.REJECTED
    return 0


def _report(arguments: argparse.Namespace) -> int:
    answer: dict[str, Any] = {"class": "REPORT"}
    folder = Path(arguments.session) if arguments.session and os.sep in arguments.session else None
    if folder is None:
        with Client(arguments.socket, _REPORT_S) as client:
            answer = client.request({"class": "REPORT", "session": arguments.session})
    if folder is not None or arguments.out is not None or arguments.png is not None:
        from polecal.daemon import reporting  # noqa: PLC0415

        folder = folder or Path(answer["path"]).parent
        answer["path"] = str(reporting.write(folder, arguments.out, arguments.png))
    if arguments.json:
        _print_json(answer)
    else:
        print(answer["path"])
    return 0


def _passes(arguments: argparse.Namespace) -> int:
    answer = _whole(arguments, {"class": "PASSES", "session": arguments.session}, "passes")
    _tell(answer, arguments, tables.passes)
    return 0


def _sessions(arguments: argparse.Namespace) -> int:
    _tell(_whole(arguments, {"class": "SESSIONS"}, "sessions"), arguments, tables.sessions)
    return 0


def _whole(arguments: argparse.Namespace, request: dict[str, Any], rows: str) -> dict[str, Any]:
    """Ask page by page, and give one answer with all rows."""
    with Client(arguments.socket, _LIST_S) as client:
        answer = client.request(request)
        while answer["next"] is not None:
            more = client.request(request | {"from": answer["next"]})
            answer = answer | {rows: [*answer[rows], *more[rows]], "next": more["next"]}
    return answer


def _numbers(text: str) -> list[float]:
    return [float(part) for part in text.split(",")]


def _route(arguments: argparse.Namespace) -> int:
    from polecal.daemon import routefile  # noqa: PLC0415

    asked = ("session", "pole", "half_width_m", "turn_radius_m", "area_m", "speeds_mps")
    with Client(arguments.socket, _LIST_S) as client:
        route = client.request({"class": "ROUTE"} | {name: getattr(arguments, name) for name in asked})
    ending = arguments.out.suffix[1:] if arguments.out else ""
    form = arguments.format or (ending if ending in _ROUTES else "geojson" if arguments.out else None)
    if form is not None and (arguments.out or not arguments.json):
        text = routefile.FORMATS[form](route)
        if arguments.out is None:
            print(text, end="")
            return 0
        arguments.out.write_text(text, encoding="utf-8")
    _tell(route, arguments, routefile.words)
    return 0


def _drop(arguments: argparse.Namespace) -> int:
    return _choose(arguments, "DROP")


def _keep(arguments: argparse.Namespace) -> int:
    return _choose(arguments, "KEEP")


def _choose(arguments: argparse.Namespace, what: str) -> int:
    request = {"class": what, "pass": arguments.name, "session": arguments.session}
    with Client(arguments.socket, _LIST_S) as client:
        answer = client.request(request)
    _tell(answer, arguments, tables.change)
    return _EXIT_BY_STATE.get(answer["after"]["state"], 0)


def _tell(
    answer: dict[str, Any],
    arguments: argparse.Namespace,
    table: Callable[[Mapping[str, Any]], Iterator[Text]],
) -> None:
    if arguments.json:
        _print_json(answer)
        return
    console = Console()
    for line in table(answer):
        console.print(line, soft_wrap=True)


def _replay(arguments: argparse.Namespace) -> int:
    from polecal.daemon.recorder import RecorderError  # noqa: PLC0415
    from polecal.daemon.replay import replay  # noqa: PLC0415

    try:
        with _progress() as progress:
            outcome = replay(arguments.capture, arguments.config, arguments.out, progress)
    except RecorderError as error:
        raise Refused(str(error), error.hint, Code.USAGE) from error
    _show(outcome.status, arguments)
    if outcome.cut:
        _complain(f"warning: {outcome.cut}", "what is above comes from that part")
    if not arguments.json:
        print(f"calibration and passes: {outcome.out}" if outcome.result else "no pass, so no calibration")
    return 0 if outcome.accepted else Code.REJECTED


@contextlib.contextmanager
def _progress() -> Iterator[Callable[[float], None] | None]:
    """Draw a bar on stderr, if that is a terminal, for what is told the part done."""
    console = Console(stderr=True)
    if not console.is_terminal:
        yield None
        return
    columns = (TextColumn("replay"), BarColumn(), TaskProgressColumn(), TimeRemainingColumn())
    with Progress(*columns, console=console, transient=True) as bar:
        task = bar.add_task("replay", total=1.0)
        yield lambda done: bar.update(task, completed=done)


def _import(arguments: argparse.Namespace) -> int:
    from polecal.daemon import config as configuration  # noqa: PLC0415
    from polecal.daemon.transfer import dumps_of, import_dumps, line_rate  # noqa: PLC0415

    config = configuration.load(arguments.config)
    span = arguments.span_arrivals or arguments.span_rate or line_rate(config.navigation.baud)
    dumps = dumps_of(config, arguments.lms, arguments.lms_arrivals, arguments.lms_rate)
    notes = import_dumps(arguments.out, config, dumps | {configuration.SPAN: (arguments.span, span)})
    for note in notes:
        what, _, hint = note.rpartition("; ")
        _complain(f"warning: {what}", hint)
    if arguments.json:
        _print_json({"class": "IMPORT", "capture": str(arguments.out), "notes": list(notes)})
    else:
        print(f"capture: {arguments.out}")
    return 0


def _export(arguments: argparse.Namespace) -> int:
    from polecal.daemon.transfer import export_dumps  # noqa: PLC0415

    paths = [str(path) for path in export_dumps(arguments.capture, arguments.out)]
    if arguments.json:
        _print_json({"class": "EXPORT", "paths": paths})
    else:
        print("\n".join(paths))
    return 0


def _doctor(arguments: argparse.Namespace) -> int:
    from polecal.daemon import config as configuration  # noqa: PLC0415
    from polecal.daemon.doctor import as_message, examine, exit_code, in_words  # noqa: PLC0415

    path = (
        arguments.config or os.environ.get("POLECAL_CONFIG") or (_CONFIG if Path(_CONFIG).exists() else None)
    )
    config = configuration.load(path) if path else None
    if sys.stderr.isatty():
        print("looking; silent devices take up to half a minute ...", file=sys.stderr)
    unnamed = arguments.socket == Path(_SOCKET)
    checks = examine(config, config.socket if config is not None and unnamed else arguments.socket)
    if arguments.json:
        _print_json(as_message(checks))
    else:
        console = Console()
        console.print(in_words(checks, console.width if console.is_terminal else None), soft_wrap=True)
    return exit_code(checks)


def _decode(arguments: argparse.Namespace) -> int:
    if arguments.kind == "sick_lms":
        from polecal.drivers import sick_lms as driver  # noqa: PLC0415
    else:
        from polecal.drivers import novatel_span as driver  # type: ignore[no-redef]  # noqa: PLC0415
    skips: list[Any] = []
    framer: Any = driver.Framer(on_skip=skips.append)
    describer: Any = driver.Describer()
    number = 0

    def put(frames: list[Any]) -> None:
        nonlocal number
        for item in sorted([*frames, *skips], key=lambda each: each.offset):
            where = {"offset": item.offset, "length": len(item.data)}
            if isinstance(item, driver.Frame):
                _print_json({"frame": number, **where, **describer.describe(item)})
                number += 1
            else:
                reason = item.reason.value if isinstance(item.reason, Enum) else item.reason
                _print_json({"frame": None, "name": "garbage", **where, "reason": reason})
        skips.clear()
        sys.stdout.flush()  # a live stream is read as it comes

    with _opened(arguments.file) as stream:
        while data := stream.read1(_DECODE_BYTES):
            put(framer.feed(data, 0))
    put(framer.close() or [])
    return 0


@contextlib.contextmanager
def _opened(name: str) -> Iterator[BufferedReader]:
    if name == "-":
        yield cast(BufferedReader, sys.stdin.buffer)
        return
    try:
        stream = Path(name).open("rb")  # noqa: SIM115
    except OSError as error:
        raise Refused(f"{name}: cannot be read: {error.strerror}", "name a file", Code.USAGE) from error
    with stream:
        yield stream


def _emulate(arguments: argparse.Namespace) -> int:
    from polecal.drivers.emulated.serve import run_emulate  # noqa: PLC0415

    orders = sys.stdin if arguments.route else None
    return run_emulate(arguments.lms_link, arguments.span_link, arguments.seed, arguments.seconds, orders)


def _demo(arguments: argparse.Namespace) -> int:
    from polecal.daemon.demo import demo  # noqa: PLC0415

    console = Console(stderr=arguments.json)
    out = arguments.out or Path(tempfile.mkdtemp(prefix="polecal-demo-"))
    content = demo(out, arguments.seed, console, routed=arguments.route)
    if arguments.json:
        _print_json({"class": "RESULT"} | content)
    return 0 if content["state"] == State.ACCEPTED else Code.REJECTED


def _completion(arguments: argparse.Namespace) -> int:
    from polecal.daemon.completion import names, script  # noqa: PLC0415

    if arguments.shell in ("sessions", "passes"):
        print("\n".join(names(arguments.socket, arguments.shell)))
    else:
        print(script(make_parser(), arguments.shell))
    return 0


def _show(status: dict[str, Any], arguments: argparse.Namespace) -> None:
    if arguments.json:
        _print_json(status)
    else:
        terminal = Terminal.of(sys.stdout)
        terminal.console(sys.stdout).print(Screen(status, ascii_only=terminal.ascii_only))


def _print_json(content: dict[str, Any]) -> None:
    print(control.encode(content).decode(), end="")


def _complain(what: str, hint: str) -> None:
    print(f"polecal-field: {what}", f"hint: {hint or 'see `man polecal-field`'}", sep="\n", file=sys.stderr)


if __name__ == "__main__":
    sys.exit(main())
