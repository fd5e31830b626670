"""What PASSES, DROP, KEEP and SESSIONS answer, to tables of at most 80 columns."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

from rich.text import Text

from polecal.daemon.screen import NONE, WIDTH

_DIRECTIONS = {"forward": "fwd", "reverse": "rev", "both": "both", "turning": "turn", "standing": "stand"}
_STYLES = {"used": "", "set aside": "yellow", "dropped": "red", "other reflector": "dim"}
_UNKNOWNS = ("x_m", "y_m", "z_m", "roll_deg", "pitch_deg", "yaw_deg")
_MEGA = 1e6


def passes(answer: Mapping[str, Any]) -> Iterator[Text]:
    """Give a PASSES object: a line a pass, and one more for each that is not used."""
    rows = answer["passes"]
    used = sum(row["use"] == "used" for row in rows)
    passes = "1 pass" if len(rows) == 1 else f"{len(rows)} passes"
    yield Text(f"session {answer['session']}, {answer['state']}: {passes}, {used} used")
    if not rows:
        return
    wide = max(len(row["name"]) for row in rows)
    yield Text(
        f"{'pass':<{wide}} {'UTC':<8} {'s':>3} {'heading':>7} {'pole':>5} {'ground':>6} "
        f"{'m/s':>4} {'':<5} {'near/mean':>9} {'off':>4} {'±mm':>3} {'nav':>6}",
        style="bold",
    )
    day = None
    for row in rows:
        today = row["start"][:10]
        if today != day:
            yield Text(f"{today}" + (f", day {row['site'] + 1}" if row["site"] else ""), style="dim")
            day = today
        yield from _pass(row, wide)


def _pass(row: Mapping[str, Any], wide: int) -> Iterator[Text]:
    pole, ground = (sum(part[kind] for part in row["slices"]) for kind in ("pole", "ground"))
    seconds = (row["gps_ns"][1] - row["gps_ns"][0]) / 1e9
    heading = f"{round(row['heading_deg']) % 360}±{row['span_deg'] / 2:.0f}"
    near = f"{row['nearest_m']:.1f}/{row['mean_m']:.1f}"
    nav = _nav(row)
    line = Text(
        f"{row['name']:<{wide}} {row['start'][11:19]} {seconds:>3.0f} {heading:>7} {pole:>5} "
        f"{ground:>6} {abs(row['speed_mps']):>4.1f} {_DIRECTIONS.get(row['direction'], NONE):<5} "
        f"{near:>9} {_mm(row['offset_m']):>4} {_mm(row['spread_m']):>3} {nav:>6}",
        style=_STYLES.get(row["use"], ""),
    )
    yield line
    notes = [f"{row['use']}: {row['why']}"] if row["use"] != "used" else []
    if row["ins_status"] not in (None, "INS_SOLUTION_GOOD"):
        notes.append(f"at times {row['ins_status']}")
    if row["unused_poses"]:
        notes.append(f"{row['unused_poses']} poses not used")
    for note in notes:
        yield Text(_short(f"{'':<{wide}} └ {note}", WIDTH), style="dim")


def _nav(row: Mapping[str, Any]) -> str:
    """Give what the navigation was worth at its worst: σ of position, or what the position rested on."""
    if row["position_sigma_m"] is not None:
        return f"±{row['position_sigma_m']:.2f}m"
    told = str(row["position_type"] or NONE).removeprefix("INS_").removeprefix("RTK")
    return _short(told.removeprefix("NARROW_"), 6)


def change(answer: Mapping[str, Any]) -> Iterator[Text]:
    """Give what DROP or KEEP changed: each unknown and its σ, before and after, and the verdict."""
    before, after = answer["before"], answer["after"]
    done = "dropped" if answer["dropped"] else "kept"
    yield Text(f"pass {answer['name']} of session {answer['session']} is {done}", style="bold")
    yield Text(f"{'':<6}{'before':>10}{'σ':>9}{'after':>11}{'σ':>9}{'change':>10}", style="dim")
    for key in _UNKNOWNS:
        name, _, unit = key.partition("_")
        digits = 4 if unit == "m" else 3
        (was, was_sigma), (now, now_sigma) = ((_of(each, key, digits)) for each in (before, after))
        moved = NONE
        if before["estimate"] and after["estimate"]:
            moved = f"{after['estimate'][key] - before['estimate'][key]:+.{digits}f}"
        yield Text(
            f"{name:<6}{was:>10}{was_sigma:>9}{now:>11}{now_sigma:>9}{moved:>10} "
            f"{'m' if unit == 'm' else '°'}"
        )
    yield Text(
        f"{'√c':<6}{_number(before['cost_m'], 4):>10}{'':>9}{_number(after['cost_m'], 4):>11}{'':>19} m"
    )
    yield Text(f"{'passes':<6}{before['passes']:>10}{'':>9}{after['passes']:>11}")
    for key, words in (("slices_lost", "no longer covered"), ("slices_won", "covered now")):
        if answer[key]:
            yield Text(f"{words}: slices {', '.join(map(str, answer[key]))}", style="yellow")
    yield from _verdicts(before, after)


def _of(each: Mapping[str, Any], key: str, digits: int) -> tuple[str, str]:
    if not each["estimate"]:
        return NONE, NONE
    held = key.partition("_")[0] in each["held"]
    return _number(each["estimate"][key], digits), "held" if held else _number(each["sigma"][key], digits)


def _verdicts(before: Mapping[str, Any], after: Mapping[str, Any]) -> Iterator[Text]:
    was, now = (_verdict(each) for each in (before, after))
    good = after["verdict"]["accepted"]
    yield Text(f"{was} → {now}" if was != now else f"still {now}", style="green" if good else "yellow")
    for reason in after["verdict"]["reasons"]:
        yield Text(_short(f"  {reason}", WIDTH))


def _verdict(each: Mapping[str, Any]) -> str:
    ended = each["state"] in ("accepted", "rejected")
    return (
        each["state"] if ended else f"{each['state']}, {'good' if each['verdict']['accepted'] else 'not yet'}"
    )


def sessions(answer: Mapping[str, Any]) -> Iterator[Text]:
    """Give a SESSIONS object: a line a session."""
    rows: Sequence[Mapping[str, Any]] = answer["sessions"]
    if not rows:
        yield Text("no session yet: start one by `polecal-field start`")
        return
    yield Text(
        f"{'session':<32} {'state':<11} {'passes':>6} {'√c m':>11} {'MB':>6} {'days':>4} {'kept':>4}",
        style="bold",
    )
    for row in rows:
        costs = "/".join(_number(cost, 3) for cost in _values(row["cost_m"])) or NONE
        yield Text(
            f"{_short(row['session'], 32):<32} {row['state']:<11} {row['passes']:>6} {costs:>11} "
            f"{row['size_bytes'] / _MEGA:>6.0f} {row['captures']:>4} {'yes' if row['preserved'] else '':>4}"
        )
        if row["problem"]:
            yield Text(_short(f"  └ {row['problem']}", WIDTH), style="red")


def _values(costs: Mapping[str, float | None]) -> Iterable[float | None]:
    return costs.values()


def _mm(value: float | None) -> str:
    """Give metres as whole millimetres."""
    return NONE if value is None else f"{1000 * value:.0f}"


def _number(value: float | None, digits: int) -> str:
    return NONE if value is None else f"{value:.{digits}f}"


def _short(text: str, most: int) -> str:
    return text if len(text) <= most else text[: most - 1] + "…"
