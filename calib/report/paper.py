"""A simulated rig with the paper's numbers to its results in kind: Tables IV and V, and Fig. 7."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence
from dataclasses import astuple, dataclass
from pathlib import Path

import matplotlib as mpl
import numpy as np
from numpy.typing import NDArray

from polecal.calib import moments, solve
from polecal.calib.blas import one_thread
from polecal.calib.coverage import slice_of
from polecal.calib.estimate import Result, calibrate
from polecal.calib.observations import PARAMETERS, Kind, Mount, Returns
from polecal.calib.report.rig import Rig, drive

mpl.use("Agg")
from matplotlib import pyplot as plt

Indices = NDArray[np.int64]
Draw = Callable[[Returns, int, np.random.Generator], Indices]

_SLICE_DEG = 30

Row = tuple[float, ...]
"""√c (m), x, y, z (m), yaw, pitch, roll (°): a row of the paper's tables."""

TABLE_4: dict[str, tuple[int, Row]] = {
    "measured by hand": (415447, (0.1161, 0.0, -0.35, -1.0, 0.0, -8.0, 0.0)),
    "pole + ground": (415447, (0.0305, -0.029, -0.360, -0.996, -2.017, -8.182, -0.528)),
    "pole only": (22506, (0.0355, -0.025, -0.357, -0.997, -2.070, -8.496, -0.041)),
}
TABLE_5: dict[int, Row] = {
    215: (0.0421, 0.016, -0.373, -1.022, -1.228, -7.796, -0.099),
    428: (0.0389, 0.012, -0.351, -1.003, -1.544, -8.767, -0.309),
    1056: (0.0378, 0.009, -0.348, -1.005, -1.615, -8.617, -0.278),
    2072: (0.0355, -0.007, -0.349, -1.002, -1.706, -8.659, -0.293),
    4072: (0.0338, -0.013, -0.344, -0.997, -1.831, -8.973, -0.344),
    10064: (0.0336, -0.018, -0.345, -0.992, -1.839, -8.892, -0.322),
    17979: (0.0327, -0.021, -0.342, -0.979, -1.937, -8.890, -0.382),
    56350: (0.0309, -0.026, -0.360, -0.994, -1.972, -8.381, -0.464),
    90864: (0.0306, -0.028, -0.363, -0.995, -2.011, -8.265, -0.476),
}
POLE_RETURNS, GROUND_RETURNS = 22506, 415447 - 22506


def _mount(row: Row) -> Mount:
    _, x, y, z, yaw, pitch, roll = row
    return Mount(x, y, z, roll, pitch, yaw)


TRUE = _mount(TABLE_4["pole + ground"][1])
HAND = _mount(TABLE_4["measured by hand"][1])

RIG = Rig(
    TRUE,
    passes=96,
    approach_m=(5.0, 0.9),
    aside_m=(0.5, 1.4),
    pole_radius_m=0.02,
    position_sigma_m=(0.012, 0.012, 0.012),
    rpy_sigma_deg=(0.03, 0.03, 0.08),
)
"""How it drove, its pole and its errors the paper does not say: these give costs like its own."""


@dataclass(frozen=True, slots=True)
class Found:
    """A mount, and √c of Eq. 7 there on all data."""

    returns: int
    mount: Mount
    cost_m: float


@dataclass(frozen=True, slots=True)
class Study:
    """What the drive gives: Table IV, Table V, and Fig. 7 in both ways to draw."""

    hand: Found
    whole: Found
    pole_only: Found
    with_radius: Result
    draws: dict[str, dict[int, list[Found]]]
    """By way of drawing and number of returns."""


@one_thread
def study(
    returns: Returns,
    seed: int,
    *,
    pole_radius_m: float,
    sizes: Sequence[int] = tuple(TABLE_5),
    draws: int = 12,
    hand: Mount = HAND,
) -> Study:
    """Find the mount as the paper does, by Eq. 7 from the hand-measured one: from all returns and few."""
    rng = np.random.default_rng(seed)
    everything = form(returns)
    start = np.concatenate([hand.vector, np.zeros(len(solve.EXTRAS))])

    def found(some: Returns, of: solve.Form) -> Found:
        vector = solve.minimise(of, start, solve.EXTRAS)
        return Found(len(some), Mount.from_vector(vector[:6]), solve.cost_m(everything, vector))

    def few(draw: Draw, size: int) -> Found:
        some = returns[draw(returns, size, rng)]
        return found(some, form(some))

    poles = returns[returns.kind == Kind.POLE]
    return Study(
        hand=Found(len(returns), hand, solve.cost_m(everything, start)),
        whole=found(returns, everything),
        pole_only=found(poles, form(poles)),
        with_radius=calibrate(returns, hand, pole_radius_m, pass_error=True),
        draws={
            way: {size: [few(draw, size) for _ in range(draws)] for size in sizes}
            for way, draw in DRAWS.items()
        },
    )


def form(returns: Returns) -> solve.Form:
    """Give Eq. 7 of a cloud, as if it were one pass: Eqs. 5 and 6 know of none."""
    pole, ground = (
        solve.Scatter([moments.of(returns[returns.kind == kind])]).form(np.array([True])) for kind in Kind
    )
    return solve.Form(pole, ground)


def one_by_one(returns: Returns, size: int, rng: np.random.Generator) -> Indices:
    """Draw so many returns, from every slice of platform yaw as many, pole and ground in proportion."""
    return np.concatenate([rng.choice(there, some, replace=False) for there, some in _shares(returns, size)])


def in_stretches(returns: Returns, size: int, rng: np.random.Generator) -> Indices:
    """Draw likewise, but from each slice one stretch of successive returns, as a vehicle gathers them."""
    shares = _shares(returns, size)
    begin = np.tile(rng.random(len(shares) // len(Kind)), len(Kind))  # a slice's pole and ground together
    firsts = [int(part * (len(there) - some + 1)) for part, (there, some) in zip(begin, shares, strict=True)]
    return np.concatenate(
        [there[first : first + some] for first, (there, some) in zip(firsts, shares, strict=True)]
    )


DRAWS: dict[str, Draw] = {"one by one": one_by_one, "in stretches": in_stretches}


def _shares(returns: Returns, size: int) -> list[tuple[Indices, int]]:
    """Give for each kind and slice the returns there are, and how many of them to draw."""
    slices = slice_of(returns.rpy_rad[:, 2], _SLICE_DEG)
    pole = returns.kind == Kind.POLE
    poles = round(size * float(pole.mean()))
    shares = []
    for of_kind, wanted in ((pole, poles), (~pole, size - poles)):
        there = [np.flatnonzero(of_kind & (slices == part)) for part in range(360 // _SLICE_DEG)]
        level = np.zeros(len(there), dtype=np.int64)  # raised evenly, up to what is there
        most = np.array([len(some) for some in there])
        while (left := min(wanted, most.sum()) - level.sum()) > 0:
            thirsty = np.flatnonzero(level < most)
            each, over = divmod(int(left), len(thirsty))
            level[thirsty] += each
            level[thirsty[:over]] += 1
            level = np.minimum(level, most)
        shares += list(zip(there, level.tolist(), strict=True))
    return shares


def tables(done: Study) -> str:
    """Give Tables IV and V as text, the paper's row above the one found here, and Fig. 7's numbers."""
    heading = f"{'':18}{'':7}{'N':>7}{'√c':>9}{'x':>8}{'y':>8}{'z m':>8}{'yaw':>9}{'pitch':>8}{'roll °':>8}"
    lines = ["Table IV", heading]
    rows = (done.hand, done.whole, done.pole_only)
    for (name, (count, row)), here in zip(TABLE_4.items(), rows, strict=True):
        lines += [_line(name, "paper", count, row), _line("", "here", here.returns, _row(here))]
    best = done.with_radius
    lines.append(
        _line("and pole's radius", "here", done.whole.returns, _row(Found(0, best.mount, best.cost_m)))
    )
    sigma = best.sigma
    lines.append(_line("", "± σ", None, (None, *_row(Found(0, sigma, 0.0))[1:])))
    lines += [
        "",
        "Table V: a stretch at random from every 30° slice of platform yaw; √c on all data",
        heading,
    ]
    first = {size: some[0] for size, some in done.draws["in stretches"].items()}
    for size, here in first.items():
        if size in TABLE_5:
            lines.append(_line("", "paper", size, TABLE_5[size]))
        lines.append(_line("", "here", here.returns, _row(here)))
    lines += ["", "Fig. 7: √c in m on all data, from N returns (mean, and the worst of the draws)"]
    lines.append(f"{'N':>7}{'paper':>10}" + "".join(f"{way:>20}" for way in done.draws))
    for size in first:
        costs = [np.array([one.cost_m for one in some[size]]) for some in done.draws.values()]
        paper = f"{TABLE_5[size][0]:10.4f}" if size in TABLE_5 else " " * 10
        lines.append(f"{size:7}{paper}" + "".join(f"{of.mean():12.4f}{of.max():8.4f}" for of in costs))
    lines.append(f"{done.whole.returns:7}{TABLE_4['pole + ground'][1][0]:10.4f}{done.whole.cost_m:12.4f}")
    return "\n".join(lines)


def _row(found: Found) -> Row:
    x, y, z, roll, pitch, yaw = astuple(found.mount)
    return (found.cost_m, x, y, z, yaw, pitch, roll)


def _line(name: str, whose: str, count: int | None, row: Sequence[float | None]) -> str:
    shown = [
        "" if value is None else f"{value:.{4 if column == 0 else 3}f}" for column, value in enumerate(row)
    ]
    widths = (9, 8, 8, 8, 9, 8, 8)
    cells = "".join(f"{value:>{width}}" for value, width in zip(shown, widths, strict=True))
    return f"{name:18}{whose:7}{'' if count is None else count:>7}{cells}"


def plot(done: Study, true: Mount, path: Path) -> None:
    """Draw Fig. 7, and beneath it how far off the mounts are that were found, as a PNG."""
    figure, (above, metres, degrees) = plt.subplots(
        3, 1, figsize=(8, 10), sharex=True, height_ratios=(5, 3, 3), layout="constrained"
    )
    for colour, (way, by_size) in zip(("tab:blue", "tab:orange"), done.draws.items(), strict=True):
        sizes = list(by_size)
        costs_mm = 1e3 * np.array([[one.cost_m for one in some] for some in by_size.values()])
        above.fill_between(sizes, costs_mm.min(1), costs_mm.max(1), color=colour, alpha=0.18, lw=0)
        above.plot(sizes, costs_mm.mean(1), "o-", ms=4, color=colour, label=f"returns drawn {way}")
    above.axhline(1e3 * done.whole.cost_m, color="0.4", lw=1, ls="--")
    above.annotate(
        f"all {done.whole.returns:,} returns: {1e3 * done.whole.cost_m:.1f} mm",
        (1, 1e3 * done.whole.cost_m),
        (0, -4),
        ("axes fraction", "data"),
        "offset points",
        ha="right",
        va="top",
        color="0.3",
    )
    above.plot(
        list(TABLE_5), [1e3 * row[0] for row in TABLE_5.values()], "k^:", ms=5, lw=1, label="the paper's rig"
    )
    above.set(ylabel="√c on all data, mm", title="Fig. 7 in kind: cost against the returns it was found from")
    above.legend(frameon=False, title="mean, least and most of the draws")
    by_size = done.draws["in stretches"]
    sizes = list(by_size)
    vectors = np.array([[one.mount.vector for one in some] for some in by_size.values()])
    off = np.sqrt(((vectors - true.vector) ** 2).mean(axis=1)) * [*[1e3] * 3, *[180 / np.pi] * 3]
    for axes, columns, unit in ((metres, range(3), "mm"), (degrees, range(3, 6), "°")):
        for column, marker in zip(columns, "osD", strict=True):
            (line,) = axes.plot(sizes, off[:, column], f"{marker}-", ms=4)
            axes.annotate(
                PARAMETERS[column],
                (sizes[-1], off[-1, column]),
                (8, 0),
                textcoords="offset points",
                va="center",
                color=line.get_color(),
            )
        axes.set(yscale="log", ylabel=f"off the truth, {unit}")
    metres.set_title(
        "The mounts found in stretches (rms): Eq. 7 puts the pole's radius into x", fontsize="medium"
    )
    degrees.set(xscale="log", xlabel="N, returns drawn from every 30° slice of platform yaw")
    for axes in (above, metres, degrees):
        axes.grid(which="major", color="0.9")
        axes.spines[["top", "right"]].set_visible(False)
    figure.savefig(path, dpi=130)
    plt.close(figure)


def main(argv: Sequence[str] | None = None) -> int:
    """Drive the rig, print the tables, draw the plot."""
    parser = argparse.ArgumentParser(prog="./dev paper", description=__doc__)
    parser.add_argument("--out", type=Path, default=Path(), help="folder for fig7.png")
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args(argv)
    arguments.out.mkdir(parents=True, exist_ok=True)
    returns = drive(RIG, np.random.default_rng(arguments.seed), POLE_RETURNS, GROUND_RETURNS)
    done = study(returns, arguments.seed, pole_radius_m=RIG.pole_radius_m)
    path = arguments.out / "fig7.png"
    plot(done, RIG.mount, path)
    sys.stdout.write(f"{tables(done)}\n\n{path}\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
