"""A STATUS object to what an operator reads at a glance, at most 80 columns by 24 lines."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Iterable, Mapping
from typing import Any

from rich.console import Console, ConsoleOptions, RenderResult
from rich.text import Text

WIDTH, HEIGHT = 80, 23  # of 80 by 24: the prompt needs a line too
NONE = "—"

_UNKNOWNS = ("x_m", "y_m", "z_m", "roll_deg", "pitch_deg", "yaw_deg")
_STATE_STYLES = {
    "connecting": "bold yellow",
    "aligning": "bold yellow",
    "collecting": "bold cyan",
    "calibrating": "bold cyan",
    "accepted": "bold green",
    "rejected": "bold red",
    "fault": "bold red",
}
_DEVICE_STYLES = {"streaming": "green", "connecting": "yellow", "lost": "red"}
_DONE, _BEGUN, _EMPTY = ("✓", "green"), ("~", "yellow"), ("·", "red")

_ROSE_WIDTH, _ROSE_RADIUS_X, _ROSE_RADIUS_Y = 37, 10.3, 4.6
_ROSE_HEIGHT = 11  # N, nine rows, S
_CELL = 9  # 330°✓1250
_ROSE_SLICES = 12  # more would overlap
_GRID_SLICES = 24  # more are marks alone
_PROBLEM_LINES = 2  # of a device's problem, and again of its hint
_LEAST_TALK = 3  # lines for verdict and notes; where a rose leaves fewer, there is none
_ASCII = str.maketrans({"✓": "+", "·": "-", "●": "*", "○": "o", "—": "-", "▶": ">", "→": ">", "…": "~"}) | (
    str.maketrans({"°": "d", "±": "+", "√": "", "–": "-", "×": "x", "─": "-", "σ": "s"})
)


class Screen:
    """A STATUS object that rich can print; keys that are missing or None show as a dash."""

    def __init__(self, status: Mapping[str, Any]) -> None:
        self._status = status

    def __rich_console__(self, _: Console, options: ConsoleOptions) -> RenderResult:
        width = min(options.max_width, WIDTH)
        for line in _lines(self._status, width):
            if options.ascii_only:
                line.plain = line.plain.translate(_ASCII).encode("ascii", "replace").decode()
            line.rstrip()
            line.truncate(width, overflow="ellipsis")
            line.no_wrap = True
            yield line


def _lines(status: Mapping[str, Any], width: int) -> list[Text]:
    lasers = _list(status.get("lasers"))
    top = [_title(status, width)]
    for device in _list(status.get("devices")):
        top += _device(device, width)
    top.append(Text("─" * width, style="dim"))
    bottom = _said("▶ next: ", [status["next"]], width, 2, "bold") if status.get("next") else []
    top = top[: HEIGHT - len(bottom)]
    room = HEIGHT - len(top) - len(bottom)
    notes = _said("! ", _list(status.get("notes")), width, 3, "yellow")
    ended = status.get("state") in ("accepted", "rejected")
    if len(lasers) == 1 and room - len(notes) >= 1 + _ROSE_HEIGHT + _LEAST_TALK:
        middle = _whole(lasers[0], width)
        middle += notes
        middle += _verdict(lasers[0], ended, width, room - len(middle))
    else:
        middle = notes[: max(0, room)]
        for number, laser in enumerate(lasers):
            share = (room - len(middle)) // (len(lasers) - number)
            middle += _brief(laser, ended, width, share)
    return [*top, *middle, *bottom]


def _title(status: Mapping[str, Any], width: int) -> Text:
    state = str(status.get("state") or NONE)
    line = Text(" polecal  ", style="bold")
    line.append(f"{state:<12}", style=_STATE_STYLES.get(state, "bold"))
    line.append(_short(status.get("session") or "no session", width - 40), style="default not bold")
    since = status.get("since_s")
    if status.get("session") and isinstance(since, int | float):
        told = f"for {_duration(since)} "
        line.append(" " * max(1, width - line.cell_len - len(told)))
        line.append(told, style="not bold dim")
    return line


def _device(device: Mapping[str, Any], width: int) -> list[Text]:
    state = str(device.get("state") or NONE)
    style = _DEVICE_STYLES.get(state, "dim")
    line = Text(" ")
    line.append("● " if state == "streaming" else "○ ", style=style)
    line.append(f"{_short(device.get('name') or NONE, 8):<9}")
    line.append(f"{state:<10}", style=style)
    line.append(f"{_number(device.get('rate_hz'), 1):>6} Hz ")
    ins = device.get("ins_status")
    if ins:
        line.append(f"{_short(ins, 22):<22} ", style="green" if ins == "INS_SOLUTION_GOOD" else "yellow")
    else:
        line.append(f"{_tail(device.get('port') or NONE, 22):<22} ", style="dim")
    line.append(f"{_count(device.get('frames'), 4):>4} frames")
    for key, word in (("bad_frames", "bad"), ("reconnects", "lost")):
        if device.get(key):
            line.append(f" {_count(device[key])} {word}", style="yellow")
    lines = [line]
    if state != "streaming":
        for key, mark, shade in (("problem", "", "red"), ("hint", "→ ", "")):
            if device.get(key):
                lines += _said("     " + mark, [device[key]], width, _PROBLEM_LINES, shade)
    return lines


def _whole(laser: Mapping[str, Any], width: int) -> list[Text]:
    """Draw one laser: a title, the rose, and beside it what was found."""
    slices = _list(laser.get("coverage"))
    done = f"{sum(bool(part.get('done')) for part in slices)} of {len(slices)}"
    title = Text(f" {laser.get('name') or NONE}", style="bold")
    title.append(f"   {_passes(laser)}, {done} slices done", style="not bold")
    title.append("     ✓ done  ~ too little  · nothing", style="not bold dim")
    rose = _rose(slices, done) if len(slices) <= _ROSE_SLICES else _grid(slices)
    table = [Text(), *_table(laser), Text(), *_costs(laser)]
    body = []
    for row in range(_ROSE_HEIGHT):
        line = rose[row] if row < len(rose) else Text()
        line.append(" " * max(0, _ROSE_WIDTH + 1 - line.cell_len))
        body.append(line.append(table[row]) if row < len(table) else line)
    return [title, *body]


def _rose(slices: list[Mapping[str, Any]], done: str) -> list[Text]:
    """Draw the slices as a compass, north up: first heading of each, mark, returns on the pole."""
    middle, half = _ROSE_WIDTH // 2, _ROSE_HEIGHT // 2
    rows: dict[int, list[tuple[int, Text]]] = {row: [] for row in range(-half, half + 1)}
    for index, part in enumerate(slices):
        angle = 2 * math.pi * (index + 0.5) / len(slices)
        mark, style = _mark(part)
        cell = Text(f"{360 * index // len(slices):>3}°")
        cell.append(f"{mark}{_count(part.get('pole_returns'), 4)}", style=style)
        aside = round(_ROSE_RADIUS_X * math.sin(angle))
        column = middle + aside if aside > 0 else middle + aside + 1 - cell.cell_len
        if aside == 0:
            column = middle - _CELL // 2
        row = round(-_ROSE_RADIUS_Y * math.cos(angle))
        rows[min(max(row, 1 - half), half - 1)].append((column, cell))
    if not rows[0]:
        rows[0] = [(1, Text("W", "dim")), (_ROSE_WIDTH - 2, Text("E", "dim"))]
    rows[0].append((middle - len(done) // 2, Text(done, "bold")))
    rows[-half], rows[half] = [(middle, Text("N", "dim"))], [(middle, Text("S", "dim"))]
    lines = []
    for row in sorted(rows):
        line = Text()
        for column, cell in sorted(rows[row], key=lambda each: each[0]):
            line.append(" " * max(0, column - line.cell_len)).append(cell)
        lines.append(line)
    return lines


def _grid(slices: list[Mapping[str, Any]]) -> list[Text]:
    """Show more slices than a compass holds: as a table, or as marks alone."""
    many = len(slices) > _GRID_SLICES
    columns = 30 if many else 3
    lines = []
    for first in range(0, len(slices), columns):
        line = Text(f"{360 * first // len(slices):>3}° " if many else " ")
        for index in range(first, min(first + columns, len(slices))):
            mark, style = _mark(slices[index])
            if many:
                line.append(mark, style=style)
            else:
                line.append(f"{360 * index // len(slices):>3}°")
                line.append(f"{mark}{_count(slices[index].get('pole_returns')):<6}", style=style)
        lines.append(line)
    return lines


def _table(laser: Mapping[str, Any]) -> list[Text]:
    estimate, sigma, measured = (_dict(laser.get(key)) for key in ("estimate", "sigma", "measured"))
    lines = [Text(f"{'':5}{'found':>9}{'σ':>8}{'by hand':>9}{'change':>8}", style="dim")]
    for key in _UNKNOWNS:
        name, _, unit = key.partition("_")
        found, hand, digits = estimate.get(key), measured.get(key), 3 if unit == "m" else 2
        change = NONE
        if isinstance(found, int | float) and isinstance(hand, int | float):
            change = _number(found - hand, digits, "+")
        held = name in _list(laser.get("held"))
        line = Text(f"{name:<5}").append(f"{_number(found, digits):>9}", style="bold")
        line.append(f"{'held' if held else _spread(sigma.get(key)):>8}", style="yellow" if held else "")
        line.append(f"{_number(hand, digits):>9}{change:>8} {'m' if unit == 'm' else '°'}", style="dim")
        lines.append(line)
    return lines


def _costs(laser: Mapping[str, Any]) -> list[Text]:
    now, hand = laser.get("cost_m"), laser.get("measured_cost_m")
    line = Text("cost  ").append(f"{_number(now, 3):>8}", style="bold").append(" m")
    line.append(f"   by hand {_number(hand, 3)} m", style="dim")
    lines = [line]
    gain = laser.get("improvement")
    if isinstance(gain, int | float):
        lines.append(Text(f"      improving by {100 * gain:.1f} %", style="dim"))
    return lines


def _verdict(laser: Mapping[str, Any], ended: bool, width: int, room: int) -> list[Text]:
    verdict = _dict(laser.get("verdict"))
    reasons = _list(verdict.get("reasons"))
    if verdict.get("accepted"):
        return _said("✓ accepted  ", reasons or [""], width, room, "bold green")
    dropped = _dict(laser.get("dropped"))
    unused = "not used: " + ", ".join(f"{_count(count)} {reason}" for reason, count in dropped.items())
    first = "✗ rejected: " if ended else "not yet: "
    lines = _said(first, reasons, width, room, "red" if ended else "") if reasons else []
    return [*lines, *(_said("", [unused], width, room - len(lines), "dim") if dropped else [])]


def _brief(laser: Mapping[str, Any], ended: bool, width: int, room: int) -> list[Text]:
    """Tell of one laser among several, in three lines and its verdict."""
    slices = _list(laser.get("coverage"))
    line = Text(f" {_short(laser.get('name') or NONE, 12)}", style="bold")
    line.append(f"  {_passes(laser)}  slices ", style="not bold")
    for part in slices[:_GRID_SLICES]:
        mark, style = _mark(part)
        line.append(mark, style=f"not bold {style}")
    cost = f"  cost {_number(laser.get('cost_m'), 3)} m, by hand {_number(laser.get('measured_cost_m'), 3)} m"
    lines = [line.append(cost, style="not bold")]
    estimate, sigma = _dict(laser.get("estimate")), _dict(laser.get("sigma"))
    for keys, unit in ((_UNKNOWNS[:3], "m"), (_UNKNOWNS[3:], "°")):
        line = Text("   ")
        for key in keys:
            name = key.partition("_")[0]
            spread = "held" if name in _list(laser.get("held")) else _spread(sigma.get(key))
            found = _number(estimate.get(key), 3 if unit == "m" else 2)
            line.append(f"{name:<5} {found:>7} {spread:<10}")
        lines.append(line.append(unit))
    return [*lines, *_verdict(laser, ended, width, room - len(lines))][: max(0, room)]


def _said(mark: str, sentences: Iterable[object], width: int, most: int, style: str) -> list[Text]:
    """Wrap sentences, the mark before the first, the rest set in as far; what does not fit is counted."""
    first = mark if mark.startswith(" ") else " " + mark
    wrapped: list[list[str]] = []
    for sentence in sentences:
        wrapped.append(
            textwrap.wrap(
                " ".join(str(sentence).split()),
                width - 1,
                initial_indent=" " * len(first) if wrapped else first,
                subsequent_indent=" " * (len(first) + 2),
            )
            or [first]
        )
    lines = [line for each in wrapped for line in each]
    if len(lines) > most:
        lines = lines[: max(0, most)]
        if lines:
            last = lines[-1] if len(lines[-1]) < width - 2 else lines[-1].rpartition(" ")[0]
            lines[-1] = f"{last.rstrip(' ,;')} …"
    return [Text(line, style=style) for line in lines]


def _mark(part: Mapping[str, Any]) -> tuple[str, str]:
    if part.get("done"):
        return _DONE
    return _BEGUN if part.get("pole_returns") or part.get("passes") else _EMPTY


def _passes(laser: Mapping[str, Any]) -> str:
    count = laser.get("passes")
    return f"{_count(count)} pass{'' if count == 1 else 'es'}"


def _number(value: Any, digits: int, sign: str = "") -> str:
    if not isinstance(value, int | float) or not math.isfinite(value):
        return NONE
    return f"{value:{sign}.{digits}f}"


def _spread(value: Any) -> str:
    told = _number(value, 3)
    return told if told == NONE else f"±{told}"


def _count(value: object, most: int = 5) -> str:
    """Write a number of things in at most so many characters."""
    if not isinstance(value, int):
        return NONE
    for unit in ("", "k", "M"):
        if len(f"{value}{unit}") <= most:
            break
        value //= 1000
    return f"{value}{unit}"


def _duration(seconds: float) -> str:
    minutes, seconds = divmod(int(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    if hours:
        return f"{hours} h {minutes} min"
    return f"{minutes} min {seconds} s" if minutes else f"{seconds} s"


def _short(value: object, most: int) -> str:
    text = str(value)
    return text if len(text) <= most else text[: most - 1] + "…"


def _tail(value: object, most: int) -> str:
    text = str(value)
    return text if len(text) <= most else "…" + text[len(text) - most + 1 :]


def _list(value: object) -> list[Any]:
    return list(value) if isinstance(value, list | tuple) else []


def _dict(value: object) -> dict[str, Any]:
    return value if isinstance(value, dict) else {}
