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
_PACE_SLICES = 3  # done, before a pace can be told
_LONG_S, _SOON_S = 10 * 3600, 1800  # of disk left: no need to tell, and need to shout
_BARS = "▁▂▃▄▅▆▇█"
_SPARKS = 24
_NOW = " now {:>5}"
_PROBLEM_LINES = 2  # of a device's problem, and again of its hint
_LEAST_TALK = 3  # lines for verdict and notes; where a rose leaves fewer, there is none
_ASCII = str.maketrans("✓✗·●○—▶→…°–×─−±σ²≤≥" + _BARS, "+x.*o->>~d-x--~s2<>" + "_.-=+*#@") | {ord("√"): None}


class Screen:
    """A STATUS object that rich can print; keys that are missing or None show as a dash."""

    def __init__(self, status: Mapping[str, Any], *, ascii_only: bool = False) -> None:
        self._status = status
        self._ascii_only = ascii_only

    def __rich_console__(self, _: Console, options: ConsoleOptions) -> RenderResult:
        ascii_only = self._ascii_only or options.ascii_only
        yield from lines(self._status, min(options.max_width, WIDTH), ascii_only=ascii_only)


def lines(status: Mapping[str, Any], width: int = WIDTH, *, ascii_only: bool = False) -> list[Text]:
    """Draw a STATUS object: at most `HEIGHT` lines of at most ``width`` columns, without a line's end."""
    drawn = _lines(status, width)
    for line in drawn:
        line.plain = "".join(char for char in line.plain if char.isprintable())
        if ascii_only:
            line.plain = line.plain.translate(_ASCII).encode("ascii", "replace").decode()
        line.rstrip()
        line.truncate(width, overflow="ellipsis" if not ascii_only else "crop")
        line.no_wrap = True
    return drawn


def _lines(status: Mapping[str, Any], width: int) -> list[Text]:
    lasers = _list(status.get("lasers"))
    top = [_title(status, width)]
    for device in _list(status.get("devices")):
        top += _device(device, width)
    top.append(_rule(status, width))
    bottom = _said("▶ next: ", [status["next"]], width, 2, "bold") if status.get("next") else []
    top = top[: HEIGHT - len(bottom)]
    room = HEIGHT - len(top) - len(bottom)
    notes = _said("! ", _list(status.get("notes")), width, 3, "yellow")
    state = str(status.get("state"))
    if len(lasers) == 1 and room - len(notes) >= 1 + _ROSE_HEIGHT + _LEAST_TALK:
        middle = _whole(lasers[0], width)
        middle += notes
        middle += _verdict(lasers[0], state, width, room - len(middle))
    else:
        middle = notes[: max(0, room)]
        for number, laser in enumerate(lasers):
            share = (room - len(middle)) // (len(lasers) - number)
            middle += _brief(laser, state, width, share)
    return [*top, *middle, *bottom]


def _rule(status: Mapping[str, Any], width: int) -> Text:
    """Draw the line below the devices; at its end what is left of the drive and of the disk."""
    told = []
    if (drive_s := _drive_left_s(status)) is not None:
        told.append(f"at this pace {_duration(drive_s, coarse=True)} of driving left")
    disk = _dict(status.get("disk"))
    if isinstance(disk.get("left_s"), int | float):
        left_s = disk["left_s"]
        told.append(f"disk full in {_duration(left_s, coarse=True)}" if left_s < _LONG_S else "disk ok")
    elif isinstance(disk.get("free_mb"), int | float):
        told.append(f"disk {disk['free_mb']:.0f} MB")
    said = "".join(f" {each} ──" for each in told)
    line = Text().append("─" * max(0, width - len(said)), style="dim")
    soon = isinstance(disk.get("left_s"), int | float) and disk["left_s"] < _SOON_S
    return line.append(said, style="bold yellow" if soon else "")


def _drive_left_s(status: Mapping[str, Any]) -> float | None:
    """Give how long the slices that are missing will take, if they come as those did that are done."""
    run_s = status.get("run_s")
    if status.get("state") != "collecting" or not isinstance(run_s, int | float):
        return None
    left_s = []
    for laser in _list(status.get("lasers")):
        slices = _list(laser.get("coverage"))
        needed = min(_dict(laser.get("need")).get("slices_needed") or len(slices), len(slices))
        done = sum(bool(part.get("done")) for part in slices)
        if done < _PACE_SLICES:
            return None
        left_s.append(run_s * max(0, needed - done) / done)
    return max(left_s, default=0.0) or None


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
    kind = str(device.get("position_type") or "").removeprefix("INS_")
    if kind and line.cell_len + 1 + len(kind) <= width:
        line.append(f" {kind}", style="dim")
    lines = [line]
    health = _dict(device.get("health"))
    faults = [
        *_list(health.get("faults")),
        *(["its window is dirty: clean it"] if health.get("polluted") else []),
    ]
    if faults:
        lines += _said("     ", ["the laser reports: " + "; ".join(map(str, faults))], width, 1, "yellow")
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
    need = _dict(laser.get("need"))
    legend = "   ✓ has, −63 lacks returns, −1p passes" if need else "   ✓ done ~ begun · not"
    title.append(legend, style="not bold dim")
    rose = _rose(slices, need, done) if len(slices) <= _ROSE_SLICES else _grid(slices, need)
    table = [Text(), *_table(laser), Text(), *_costs(laser)]
    body = []
    for row in range(_ROSE_HEIGHT):
        line = rose[row] if row < len(rose) else Text()
        line.append(" " * max(0, _ROSE_WIDTH + 1 - line.cell_len))
        body.append(line.append(table[row]) if row < len(table) else line)
    return [title, *body]


def _rose(slices: list[Mapping[str, Any]], need: Mapping[str, Any], done: str) -> list[Text]:
    """Draw the slices as a compass, north up: first heading of each, mark, returns on the pole or missing."""
    middle, half = _ROSE_WIDTH // 2, _ROSE_HEIGHT // 2
    rows: dict[int, list[tuple[int, Text]]] = {row: [] for row in range(-half, half + 1)}
    for index, part in enumerate(slices):
        angle = 2 * math.pi * (index + 0.5) / len(slices)
        mark, style = _mark(part)
        cell = Text(f"{360 * index // len(slices):>3}°")
        cell.append(_amount(part, need, mark), style=style)
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


def _grid(slices: list[Mapping[str, Any]], need: Mapping[str, Any]) -> list[Text]:
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
                line.append(f"{_amount(slices[index], need, mark):<7}", style=style)
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
    passing = _dict(laser.get("passing"))
    if spark := _spark(_list(laser.get("costs_m")), _SPARKS - len(_NOW) * bool(passing)):
        lines.append(Text("√c    ").append(spark, style="cyan"))
        if passing:
            lines[-1].append(_NOW.format(_number(passing.get("cost_m"), 3)), style="bold cyan")
    gain = laser.get("improvement")
    if isinstance(gain, int | float):
        lines.append(Text(f"      improving by {100 * gain:.1f} %", style="dim"))
    return lines


def _verdict(laser: Mapping[str, Any], state: str, width: int, room: int) -> list[Text]:
    verdict = _dict(laser.get("verdict"))
    reasons = _list(verdict.get("reasons"))
    if verdict.get("accepted"):
        if state == "accepted":
            return _said("✓ accepted  ", reasons or [""], width, room, "bold green")
        met = f"its own criteria are met; the session is {state}"  # another laser's may not be
        return _said("✓ ", [met], width, room, "")
    dropped = _dict(laser.get("dropped"))
    unused = "not used: " + ", ".join(f"{_count(count)} {reason}" for reason, count in dropped.items())
    ended = state in ("accepted", "rejected")
    first = "✗ rejected: " if ended else "not yet: "
    lines = _said(first, reasons, width, room, "red" if ended else "") if reasons else []
    return [*lines, *(_said("", [unused], width, room - len(lines), "dim") if dropped else [])]


def _brief(laser: Mapping[str, Any], state: str, width: int, room: int) -> list[Text]:
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
    spark = _spark(_list(laser.get("costs_m")), _SPARKS)
    if spark and room > len(lines) + 1:
        lines.append(Text("   √c    ").append(spark, style="cyan"))
    return [*lines, *_verdict(laser, state, width, room - len(lines))][: max(0, room)]


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


def _amount(part: Mapping[str, Any], need: Mapping[str, Any], mark: str) -> str:
    """Write what a slice has, with a mark, or what it still needs: "✓412", "−63", "−1p"."""
    returns, passes = part.get("pole_returns"), part.get("passes")
    if not part.get("done") and isinstance(returns, int) and isinstance(passes, int):
        lacks = need.get("min_pole_returns", 0) - returns
        if lacks > 0:
            return f"−{_count(lacks, 4)}"
        if (lacks := need.get("min_passes", 0) - passes) > 0:
            return f"−{_count(lacks, 3)}p"
    return mark + _count(returns, 4)


def _spark(values: list[Any], most: int) -> str:
    """Draw numbers as bars, the last ``most``; the highest bar is the largest of them."""
    numbers = [float(value) for value in values if isinstance(value, int | float) and math.isfinite(value)]
    numbers = numbers[-most:]
    top = max(numbers, default=0.0)
    if top <= 0:
        return ""
    return "".join(_BARS[min(len(_BARS) - 1, int(len(_BARS) * max(0.0, n) / top))] for n in numbers)


def _passes(laser: Mapping[str, Any]) -> str:
    count, earlier = laser.get("passes"), laser.get("earlier_passes")
    told = f"{_count(count)} pass{'' if count == 1 else 'es'}"
    return f"{told} ({_count(earlier)} of earlier days)" if earlier else told


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


def _duration(seconds: float, *, coarse: bool = False) -> str:
    """Write a time; ``coarse`` to two figures or so, so that it does not change at each look."""
    if coarse:
        for unit, length in (("h", 3600), ("min", 60)):
            if seconds >= 2 * length:
                return f"{seconds / length:.0f} {unit}"
        return f"{max(10, round(seconds, -1)):.0f} s"
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
