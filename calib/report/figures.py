"""A report's evidence to drawings: SVG that goes into a page as it is, and PNG for elsewhere.

Ink is drawn in one colour that no data has, and becomes the page's own, so that a page may be light or dark.
"""

from __future__ import annotations

import io
import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PathCollection
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure
from matplotlib.projections.polar import PolarAxes

from polecal.calib.coverage import Need
from polecal.calib.geometry import Array
from polecal.calib.report.evidence import Cloud, Evidence, Residuals, Weight

INK, PALE = "#1f2328", "#8b949e"
BLUE, ORANGE, RED = "#3a7ebf", "#d9822b", "#c2403a"
_STYLE: Any = {
    "svg.fonttype": "none",
    "svg.hashsalt": "polecal",
    "font.family": ["DejaVu Sans", "sans-serif"],
    "font.size": 9.0,
    "axes.titlesize": 10.0,
    "axes.edgecolor": PALE,
    "axes.linewidth": 0.8,
    "axes.labelcolor": INK,
    "axes.titlecolor": INK,
    "text.color": INK,
    "xtick.color": PALE,
    "ytick.color": PALE,
    "xtick.labelcolor": INK,
    "ytick.labelcolor": INK,
    "grid.color": PALE,
    "grid.alpha": 0.3,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "legend.frameon": False,
    "figure.facecolor": "none",
    "axes.facecolor": "none",
    "savefig.facecolor": "none",
}
styled = mpl.rc_context(_STYLE)
HEADINGS = LinearSegmentedColormap.from_list(
    "headings", ["#2f6fd0", "#62c4bb", "#d8a520", "#8f2a5c", "#2f6fd0"], N=256
)
"""Of a heading from north by east: opposite ones differ in lightness or along blue and yellow, which all
colour-blind readers see; none is lost on a white page or a dark one."""
_MM = 1000.0


@dataclass(frozen=True, slots=True)
class Drawing:
    """One figure, its caption and what it shows, for whoever cannot see it."""

    name: str
    title: str
    caption: str
    alt: str
    svg: str
    png: bytes


@dataclass(frozen=True, slots=True)
class Quality:
    """What the navigation said of itself, every second or so: times in s from the session's first record.

    Sigmas are NaN where the receiver told none. ``status`` has an INS status for each time.
    """

    t_s: Array
    position_m: Array
    """North or east, whichever is worse."""
    height_m: Array
    roll_pitch_deg: Array
    azimuth_deg: Array
    status: tuple[str, ...]
    passes_s: tuple[tuple[float, float], ...]


@styled
def drawn(figure: Figure, name: str, title: str, caption: str, alt: str) -> Drawing:
    """Write a figure both ways."""
    page, picture = io.StringIO(), io.BytesIO()
    figure.savefig(page, format="svg", dpi=160, metadata={"Date": None})
    figure.savefig(picture, format="png", dpi=130, facecolor="white")
    svg = re.sub(r"^.*?(?=<svg )", "", page.getvalue(), flags=re.DOTALL)
    svg = re.sub(r"<metadata>.*?</metadata>", "", svg, flags=re.DOTALL)
    for colour, ours in ((INK, "var(--ink)"), (PALE, "var(--pale)")):
        svg = svg.replace(colour, ours)
    # ids are the page's: one drawing must not take another's
    svg = re.sub(r'(id="|href="#|url\(#)', rf"\g<1>{name}-", svg)
    svg = re.sub(
        r'<svg [^>]*?viewBox="([^"]*)"[^>]*>', r'<svg viewBox="\1" aria-hidden="true">', svg, count=1
    )
    return Drawing(name, title, caption, alt, svg, picture.getvalue())


@styled
def pole(name: str, evidence: Evidence, radius_m: float) -> Drawing:
    """Draw the pole from above and from the side, before and after (Figs. 2, 3, 5, 6)."""
    figure = Figure(figsize=(9.6, 6.4), layout="constrained")
    axes = figure.subplots(2, 3, height_ratios=(1, 1))
    extent = np.quantile(np.abs(evidence.before.points_m[:, :2]), 0.995) * 1.15
    wide = max(float(extent), 3 * radius_m)
    close = max(3 * radius_m, float(np.quantile(np.abs(evidence.after.points_m[:, :2]), 0.995)) * 1.2)
    close = min(close, wide)
    top = max(0.5, *(1.05 * float(one.points_m[:, 2].max()) for one in (evidence.before, evidence.after)))
    for column, (cloud, half, words) in enumerate(
        (
            (evidence.before, wide, "before: as measured by hand"),
            (evidence.after, wide, "after, to the same scale"),
            (evidence.after, close, "after, enlarged"),
        )
    ):
        above, side = axes[0, column], axes[1, column]
        _above(above, cloud, half, radius_m)
        above.set_title(words)
        drawn_points = _side(side, cloud, half, top, radius_m)
        if column:
            above.set_ylabel("")
            side.set_ylabel("")
    _headings(figure, axes, drawn_points)
    spread = [
        _MM * float(np.sqrt(cloud.points_m[:, :2].var(axis=0).sum()))
        for cloud in (evidence.before, evidence.after)
    ]
    return drawn(
        figure,
        f"{name}-pole",
        "The pole, before and after",
        "Returns on the pole from above (top) and from the side (bottom), coloured by the vehicle's heading; "
        "the ground nearby in grey. A wrong yaw or offset tears the pole apart by heading; circle and "
        "lines are the pole's true size.",
        f"Point clouds of the pole: its returns scatter by {spread[0]:.0f} mm in plan with the hand-measured "
        f"mount, and by {spread[1]:.0f} mm with the mount found.",
    )


def _above(axes: Axes, cloud: Cloud, half_m: float, radius_m: float) -> None:
    north, east = cloud.points_m[:, 0], cloud.points_m[:, 1]
    _scatter(axes, east, north, cloud.heading_rad)
    turn = np.linspace(0, 2 * np.pi, 90)
    axes.plot(radius_m * np.cos(turn), radius_m * np.sin(turn), color=INK, lw=1)
    axes.set(
        xlim=(-half_m, half_m), ylim=(-half_m, half_m), xlabel="east, m", ylabel="north, m", aspect="equal"
    )
    axes.grid()


def _side(axes: Axes, cloud: Cloud, half_m: float, top: float, radius_m: float) -> PathCollection:
    axes.scatter(
        cloud.ground_m[:, 1], cloud.ground_m[:, 2], s=1, color=PALE, alpha=0.4, lw=0, rasterized=True
    )
    points = _scatter(axes, cloud.points_m[:, 1], cloud.points_m[:, 2], cloud.heading_rad)
    for side in (-radius_m, radius_m):
        axes.plot([side, side], [0, top], color=INK, lw=0.8)
    axes.set(xlim=(-half_m, half_m), ylim=(-0.15 * top, top), xlabel="east, m", ylabel="up, m")
    axes.grid()
    return points


def _scatter(axes: Axes, x: Array, y: Array, heading_rad: Array) -> PathCollection:
    return axes.scatter(
        x,
        y,
        c=np.degrees(heading_rad) % 360,
        cmap=HEADINGS,
        vmin=0,
        vmax=360,
        s=3,
        lw=0,
        alpha=0.8,
        rasterized=True,
    )


def _headings(figure: Figure, axes: Sequence[Axes] | Array, points: PathCollection) -> None:
    bar = figure.colorbar(points, ax=axes, location="bottom", shrink=0.5, aspect=40, pad=0.02)
    if bar.solids is not None:
        bar.solids.set_alpha(1.0)
    bar.outline.set_visible(False)
    bar.set_ticks([0, 90, 180, 270, 360], labels=["north", "east", "south", "west", "north"])
    bar.set_label("heading of the vehicle")


@styled
def rose(name: str, coverage: Sequence[dict[str, int]], need: Need) -> Drawing:
    """Draw how many pole returns each slice of heading has."""
    counts = np.array([part["pole_returns"] for part in coverage], dtype=float)
    done = np.array([part["done"] for part in coverage], dtype=bool)
    width = 2 * np.pi / len(counts)
    middle = (np.arange(len(counts)) + 0.5) * width
    figure = Figure(figsize=(4.6, 4.6), layout="constrained")
    axes = figure.add_subplot(projection="polar")
    assert isinstance(axes, PolarAxes)
    axes.set_theta_zero_location("N")
    axes.set_theta_direction(-1)
    bars = axes.bar(middle, counts, width * 0.92, color=np.where(done, BLUE, ORANGE))
    for bar, is_done in zip(bars, done, strict=True):
        bar.set_hatch("" if is_done else "///")
    for at, part in zip(middle, coverage, strict=True):
        axes.text(
            at,
            max(counts.max(), need.min_pole_returns) * 1.12,
            f"{part['passes']}",
            ha="center",
            va="center",
        )
    turn = np.linspace(0, 2 * np.pi, 200)
    axes.plot(turn, np.full(200, need.min_pole_returns), color=RED, lw=1.2, ls="--")
    axes.set_ylim(0, max(counts.max(), need.min_pole_returns) * 1.22)
    axes.set_xticks(np.radians([0, 90, 180, 270]), ["N", "E", "S", "W"])
    axes.yaxis.set_major_locator(mpl.ticker.MaxNLocator(3))
    axes.set_rlabel_position(float(np.degrees(middle[int(np.argmin(counts))])))  # where no bar is in the way
    axes.grid(True)
    axes.spines["polar"].set_visible(False)
    empty = [index for index, part in enumerate(coverage) if not part["done"]]
    lacking = f"; not done: slices {', '.join(map(str, empty))}" if empty else "; all are done"
    return drawn(
        figure,
        f"{name}-rose",
        "Headings covered",
        f"Pole returns in each {need.slice_deg}° slice of heading; the number at the rim is of passes. The "
        f"dashed circle is what a slice needs, {need.min_pole_returns}; a hatched slice is not done.",
        f"Rose of {len(counts)} slices with {counts.min():.0f} to {counts.max():.0f} pole returns{lacking}.",
    )


@styled
def curve(name: str, evidence: Evidence, threshold_m: float) -> Drawing:
    """Draw √c against returns (Fig. 7)."""
    passes, returns, cost_m = (np.array(column) for column in zip(*evidence.curve, strict=True))
    figure = Figure(figsize=(9.6, 3.8), layout="constrained")
    axes = figure.subplots()
    axes.plot(returns, _MM * cost_m, "o-", color=BLUE, ms=4, label="as found")
    axes.axhline(_MM * evidence.measured_cost_m, color=PALE, lw=1.2, ls=":", label="as measured by hand")
    axes.axhline(_MM * threshold_m, color=RED, lw=1.2, ls="--", label="highest that is accepted")
    axes.set(yscale="log", xlabel="returns used, in the order driven", ylabel="√c on all returns, mm")
    axes.set_xlim(0, returns[-1] * 1.03)
    axes.xaxis.set_major_formatter(mpl.ticker.StrMethodFormatter("{x:,.0f}"))
    axes.yaxis.set_major_locator(mpl.ticker.LogLocator(subs=(1, 2, 3, 5)))
    axes.yaxis.set_major_formatter(mpl.ticker.StrMethodFormatter("{x:g}"))
    axes.yaxis.set_minor_formatter(mpl.ticker.NullFormatter())
    above = axes.twiny()
    some = np.arange(0, len(passes), -(-len(passes) // 15))
    above.set_xlim(axes.get_xlim())
    above.set_xticks(returns[some], [str(number) for number in passes[some]])
    above.set_xlabel("passes")
    axes.legend()
    axes.grid()
    return drawn(
        figure,
        f"{name}-cost",
        "Cost against returns",
        "The mount found from the first passes alone, costed on all returns: where the line is flat, more of "
        "the same driving would bring nothing.",
        f"√c on all returns falls from {_MM * evidence.measured_cost_m:.0f} mm as measured by hand to "
        f"{_MM * cost_m[-1]:.1f} mm with all {passes[-1]} passes.",
    )


@styled
def residuals(name: str, evidence: Evidence, slice_deg: int) -> Drawing:
    """Draw how far returns are off, by slice, range and bearing, before and after."""
    kinds = (
        ("pole, along the beam, mm", evidence.pole_before, evidence.pole_after, 0),
        ("pole, across it, mm", evidence.pole_before, evidence.pole_after, 1),
        ("ground, down, mm", evidence.ground_before, evidence.ground_after, 0),
    )
    figure = Figure(figsize=(9.6, 6.8), layout="constrained")
    axes = figure.subplots(3, 3, sharey="row", sharex="col")
    for row, (words, before, after, column) in enumerate(kinds):
        for index, (label, edges, key) in enumerate(_bins(evidence, slice_deg)):
            one = axes[row, index]
            one.axhline(0, color=PALE, lw=0.8)
            _spread(one, before, column, edges, key, colour=PALE, words="as measured by hand")
            _spread(one, after, column, edges, key, colour=BLUE, words="as found")
            one.grid()
            if row == 2:
                one.set_xlabel(label)
        axes[row, 0].set_ylabel(words)
    axes[0, 0].legend(fontsize=8)
    after_mm = [
        _MM * float(part.offset_m[:, column].std()) if len(part.offset_m) else 0.0
        for _, _, part, column in kinds
    ]
    return drawn(
        figure,
        f"{name}-residuals",
        "Residuals",
        "Distance of pole returns from the pole's axis, and of ground returns from the ground: the "
        "median of each bin, and the band that holds the middle 80 %. What is left should not depend on "
        "heading, range or bearing.",
        f"Residuals as found scatter by {after_mm[0]:.0f} mm along the beam and {after_mm[1]:.0f} mm across "
        f"it on the pole, and by {after_mm[2]:.0f} mm on the ground.",
    )


def _bins(evidence: Evidence, slice_deg: int) -> tuple[tuple[str, Array, str], ...]:
    ranges = np.concatenate([evidence.pole_after.range_m, evidence.ground_after.range_m])
    bearings = np.degrees(
        np.concatenate([evidence.pole_after.bearing_rad, evidence.ground_after.bearing_rad])
    )
    far = float(np.quantile(ranges, 0.99))
    return (
        ("heading of the vehicle, °", np.arange(0, 361, slice_deg, dtype=float), "slice"),
        ("range, m", np.linspace(0, far, 13), "range"),
        ("bearing (positive right), °", np.linspace(bearings.min(), bearings.max() + 1e-6, 13), "bearing"),
    )


def _spread(
    axes: Axes, part: Residuals, column: int, edges: Array, key: str, *, colour: str, words: str
) -> None:
    """Draw the median and the middle 80 % of residuals in bins of one thing."""
    of = {
        "slice": (part.slice + 0.5) * (edges[1] - edges[0]),
        "range": part.range_m,
        "bearing": np.degrees(part.bearing_rad),
    }[key]
    where = np.digitize(of, edges) - 1
    middle, band = [], []
    for index in range(len(edges) - 1):
        some = _MM * part.offset_m[where == index, column]
        if len(some) >= 5:
            middle.append((edges[index] + edges[index + 1]) / 2)
            band.append(np.quantile(some, [0.1, 0.5, 0.9]))
    if middle:
        low, mid, high = np.array(band).T
        axes.fill_between(middle, low, high, color=colour, alpha=0.25, lw=0)
        axes.plot(middle, mid, "o-", color=colour, ms=3, lw=1.2, label=words)


@styled
def influence(name: str, weights: Sequence[Weight], sigma: Array, free: Sequence[bool]) -> Drawing | None:
    """Draw how far the result moves without each pass; None where that is not known."""
    known = [one for one in weights if one.shift is not None]
    if not known:
        return None
    scale = np.where(np.array(free) & (sigma > 0), sigma, np.inf)
    moved = np.array([one.shift for one in known]) / scale
    figure = Figure(figsize=(9.6, 3.4), layout="constrained")
    axes = figure.subplots()
    axes.axhspan(-1, 1, color=PALE, alpha=0.15, lw=0)
    axes.axhline(0, color=PALE, lw=0.8)
    names = ("x", "y", "z", "roll", "pitch", "yaw")
    for index, (word, marker) in enumerate(zip(names, "osD^v*", strict=True)):
        if free[index]:
            colour = (BLUE, "#57b8b0", PALE, ORANGE, RED, "#a83a70")[index]
            at = np.arange(len(known)) + 0.12 * (index - 2.5)
            axes.plot(at, moved[:, index], marker, color=colour, ms=5, label=word)
    axes.set_xticks(range(len(known)), [str(one.id) for one in known])
    axes.set(xlabel="pass left out", ylabel="the result moves by, in its σ")
    axes.grid(axis="y")
    axes.legend(ncols=6, loc="upper left", bbox_to_anchor=(0, 1.16))
    most = np.unravel_index(int(np.argmax(np.abs(moved))), moved.shape)
    return drawn(
        figure,
        f"{name}-influence",
        "What each pass weighs",
        "How far each unknown moves when one pass is left out and the rest is solved again, in units of that "
        "unknown's σ. A pass that stands out carries the result alone: look at it, or drive it again.",
        f"Without pass {known[most[0]].id}, {names[most[1]]} moves most, by {abs(moved[most]):.1f} of its σ.",
    )


@styled
def navigation(name: str, quality: Quality) -> Drawing:
    """Draw the navigation's own standard deviations and its status over time, the passes shaded."""
    names = list(dict.fromkeys(quality.status))
    figure = Figure(figsize=(9.6, 3.8 + 0.25 * len(names)), layout="constrained")
    metres, degrees, status = figure.subplots(3, 1, sharex=True, height_ratios=(6, 6, 1 + len(names)))
    for axes, unit, lines in (
        (metres, "m", ((quality.position_m, "north, east"), (quality.height_m, "height"))),
        (degrees, "°", ((quality.roll_pitch_deg, "roll, pitch"), (quality.azimuth_deg, "azimuth"))),
    ):
        for (values, word), colour in zip(lines, (BLUE, ORANGE), strict=True):
            told = np.where(values > 0, values, np.nan)  # 0 before it knows
            axes.plot(quality.t_s, told, color=colour, lw=1.2, label=word)
        axes.set_ylabel(f"σ, {unit}")
        axes.set_yscale("log")
        axes.yaxis.set_major_formatter(mpl.ticker.StrMethodFormatter("{x:g}"))
        axes.legend(ncols=2, loc="upper right")
        axes.grid()
    if not np.isfinite(quality.position_m).any():
        metres.text(
            0.5, 0.5, "the receiver told no standard deviations", transform=metres.transAxes, ha="center"
        )
    good = [each == "INS_SOLUTION_GOOD" for each in quality.status]
    level = [names.index(each) for each in quality.status]
    status.scatter(quality.t_s, level, s=6, c=[BLUE if each else RED for each in good], marker="s", lw=0)
    status.set_yticks(
        range(len(names)), [each.removeprefix("INS_").lower().replace("_", " ") for each in names]
    )
    status.set(xlabel="time since the first record, s", ylim=(-0.7, len(names) - 0.3))
    for axes in (metres, degrees, status):
        for first, last in quality.passes_s:
            axes.axvspan(first, last, color=PALE, alpha=0.2, lw=0)
    part = sum(good) / max(1, len(good))
    return drawn(
        figure,
        name,
        "Navigation over time",
        "The receiver's own standard deviations and status; passes of the pole are shaded.",
        f"The inertial solution was good for {part:.0%} of the time; its statuses were {', '.join(names)}.",
    )
